"""What a fit does not make again: parts of a plant that no value changes."""

import numpy as np
import pytest

from ehbench.plant.build import Kept, Plant
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import EhbenchError
from tools.studies.recovery_study import BEDS, bed


def numbers(plant: Plant) -> list[object]:
    """All that stands in a plant."""
    return [part.tobytes() if isinstance(part, np.ndarray | np.void) else part for part in plant]


@pytest.mark.parametrize("name", BEDS)
def test_a_plant_of_kept_parts_is_the_plant(name):
    """Whatever number of whatever part is another."""
    rig, kept = bed(name).rig, Kept()
    known, other = rig.parameters(), 0
    for payload in (None, *rig.payload):
        before = numbers(Model.of(rig, None, payload, kept).plant)
        for parameter, value in known.items():
            try:
                moved = rig.with_values({parameter: 1.02 * float(value) + 1e-9}, known)
                fresh = numbers(Model.of(moved, None, payload).plant)
            except EhbenchError:
                continue
            assert numbers(Model.of(moved, None, payload, kept).plant) == fresh, parameter
            assert numbers(Model.of(rig, None, payload, kept).plant) == before, parameter
            other += fresh != before
    assert other >= 0.5 * len(known)
