"""Whether a log's stroke and joint angle agree with the pins of the rig file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ehbench.parts.cylinder import linkage_arrays
from ehbench.quantities import quantity
from ehbench.structure.cases import Case
from ehbench.units import from_si

OFF = 0.005  # share of the stroke by which they may disagree
NOISES = 6.0  # or so many of the standard deviations of their difference's noise


def disagreements(cases: Sequence[Case]) -> Iterator[tuple[str, str, str, float]]:
    """(cylinder, sentence, cure, by how much [m]) of each that disagrees, the worst log of each."""
    worst: dict[str, tuple[float, str]] = {}
    for case in cases:
        for index, cylinder in enumerate(case.model.rig.cylinder):
            names = [f"{cylinder.name}.{word}" for word in ("x", "q")]
            if cylinder.pins is None or any(name not in case.record for name in names):
                continue
            x, q = (case.record[name] for name in names)
            from_pins, _ = linkage_arrays(case.model.plant.cylinders[index], q)
            off = x - from_pins
            noise = math.sqrt(float(np.mean(np.diff(off, 3) ** 2)) / 20.0)
            level, most = float(np.median(off)), float(off[np.argmax(np.abs(off))])
            allowed = max(OFF * float(cylinder.stroke), NOISES * noise)
            apart = level if abs(level) > allowed else most if abs(most) > 2.0 * allowed else 0.0
            if abs(apart) > abs(worst.get(cylinder.name, (0.0, ""))[0]):
                worst[cylinder.name] = (apart, case.name)
    for name, (off, log) in worst.items():
        unit = cases[0].model.rig.unit_of("x")
        shown = f"{from_si(abs(off), unit, quantity('x')):.3g} {unit}"
        yield (
            name,
            f"{name}.x and {name}.q of {log} disagree with the pins by {shown}",
            f"check the pins of {name} (phase, retracted_length, l_a, l_b) and the offset and sign "
            f"of {name}.x and {name}.q",
            off,
        )
