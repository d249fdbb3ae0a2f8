"""What a fit does not make again: parts of a plant that no value changes, and simulations that it
has made before.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.identification import simulator
from ehbench.identification.simulator import CHANNELS, Simulator, prepare
from ehbench.plant.build import Kept, Plant
from ehbench.plant.many import map_threads
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import EhbenchError
from tests.virtual_logs import virtual_log
from tools.studies.recovery_study import BEDS, bed

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"


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


@pytest.fixture
def fitted():
    """A simulator of two logs and their shifts of start, none."""
    rig = load_rig(RIGS / "slide_servo.toml")
    model = Model.of(rig)
    logs = [
        prepare(model, virtual_log("slide_servo", rig, "steps", seed, 1.0), f"log {seed}", CHANNELS)
        for seed in (1, 2)
    ]
    made = Simulator(rig, logs, ["bulk_modulus", "carriage.damping"], None, 2)
    yield made


def test_a_point_is_simulated_once(fitted, monkeypatch):
    """Asked for again it is what it was, and counts as an evaluation; another start, another value,
    other steps or a rough look are simulations of their own.
    """
    made: list[int] = []
    simulated = Simulator._simulated

    def counted(self, points, *given):
        made.append(len(points))
        return simulated(self, points, *given)

    monkeypatch.setattr(Simulator, "_simulated", counted)
    values, still = [8e8, 2e3], fitted.unshifted()
    shifted = [still[0] + 0.5, still[1]]
    first, meshes = fitted.begin(values, still)
    again, _ = fitted.begin(list(values), fitted.unshifted())
    assert made == [2, 0] and fitted.effort.evaluations == 4
    assert all(one is other for one, other in zip(first, again, strict=True))
    moved, _ = fitted.begin(values, shifted)
    assert made[-1] == 1 and not np.array_equal(moved[0], first[0]) and moved[1] is first[1]
    fitted.begin([8e8, 2.1e3], still)
    fitted.begin(values, still, slack=100.0)
    fitted.each([(values, k, still[k]) for k in (0, 1)], meshes)
    fitted.each([(values, k, still[k]) for k in (0, 1, 0)], [meshes[0].copy(), meshes[1]])
    assert made[3:] == [2, 2, 2, 1]


def test_what_is_remembered_has_bounds(fitted, monkeypatch):
    """The oldest goes first; what is asked for once more becomes the latest."""
    still = fitted.unshifted()
    size = simulator._bytes(fitted._meshed([([8e8, 2e3], 0, still[0])])[0])
    latest = simulator._Latest()
    monkeypatch.setattr(simulator, "REMEMBERED", 2.5 * size)
    one = fitted._meshed([([8e8, 2e3], 0, still[0])])[0]
    for key in ("a", "b"):
        latest.keep(key, one)
    assert latest.of("a") is one
    latest.keep("c", one)
    assert ["a" in latest, "b" in latest, "c" in latest] == [True, False, True]


def test_a_failure_in_any_thread_is_raised():
    def work(i: int) -> int:
        if i == 3:
            raise ValueError("the fourth")
        return i

    with pytest.raises(ValueError, match="the fourth"):
        map_threads(work, range(200), 4)
    assert map_threads(lambda i: i * i, range(50), 4) == [i * i for i in range(50)]
