"""What the oil's temperature has to do with a flow map: readings taken while the oil warmed with
the drop or the command show both in one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ehbench.data.flowmeter import FlowmeterData
from ehbench.flow_maps.results import FlowMapFit, Units
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si

FEWEST = 8  # readings with a temperature that say something of it
WARMS = 3.0  # [K] by which it must go with what else was varied, from its least to its most …
GOES_WITH = 0.6  # … and the correlation beyond which it does
PASSES = 0.1  # share of the largest flow from which a reading's share says something
SURELY, MATTERS = 4.0, 0.01  # standard errors, and share of the flow, of a change that is told
_TEN = 10.0  # [K] for which that change is said


def warmed(rows: FlowmeterData, show: Units, unit: str) -> Iterator[str]:
    """A sentence for the drop and for the command where the temperature goes with it: no fit can
    tell what each does to the flow.

    Args:
        rows: readings of one edge in one direction.
        show: units of the sentences.
        unit: in which temperatures are shown.
    """
    known = np.isfinite(rows.temperature) & (rows.pressure_drop > 0.0)
    if known.sum() < FEWEST:
        return
    warm = rows.temperature[known]
    drop, command = rows.pressure_drop[known], rows.command[known]
    # an orifice, and so what heats the oil, goes with the root of the drop
    for values, message, which in (
        (np.sqrt(drop), "drop", tuple(map(show.drop, (drop.min(), drop.max())))),
        (command, "command", tuple(map(show.volts, (command.min(), command.max())))),
    ):
        if not (np.ptp(values) > 0.0 and np.ptp(warm) > 0.0):
            continue
        along = float(np.corrcoef(values, warm)[0, 1])
        slope, at_zero = np.polyfit(values, warm, 1)
        ends = at_zero + slope * np.array([values.min(), values.max()])
        if abs(along) > GOES_WITH and abs(ends[1] - ends[0]) > WARMS:
            low, high = (
                f"{from_si(end, unit, VOCABULARY['temperature']):.3g} {unit}" for end in ends
            )
            yield (
                f"the oil's temperature goes with the {message} (correlation {along:+.2f}): "
                f"{low} at {which[0]}, {high} at {which[1]}; what the oil's viscosity does to "
                f"the flow is in the map as if the {message} did it. Take some of "
                "these readings again in the other order, or at one temperature"
            )


def warm_flow(fit: FlowMapFit, rows: FlowmeterData) -> Iterator[str]:
    """A sentence where what a map leaves of the readings goes with the temperature: the map is of
    the mean one.

    What the temperature shares with drop and command the map has already, so this tells what is
    left of its effect at least.

    Args:
        fit: of the readings.
        rows: the readings.
    """
    used = np.isfinite(rows.temperature) & np.isfinite(fit.residuals) & (np.abs(fit.sigmas) < 5.0)
    used &= rows.flow > PASSES * fit.map.rated_flow
    count = int(used.sum())
    if count < FEWEST or np.ptp(rows.temperature[used]) < WARMS:
        return
    warm = rows.temperature[used] - rows.temperature[used].mean()
    share = fit.residuals[used] / (rows.flow - fit.residuals)[used]
    slope, level = np.polyfit(warm, share, 1)
    left = share - level - slope * warm
    std = float(np.sqrt(np.sum(left**2) / (count - 2) / np.sum(warm**2)))
    if abs(slope) > SURELY * std and abs(slope) * np.ptp(warm) > MATTERS:
        yield (
            f"readings pass {100.0 * _TEN * slope:+.2g} ± {100.0 * _TEN * 1.96 * std:.2g} % for "
            f"each {_TEN:g} K of the oil, at one command and drop: the map is of the mean "
            "temperature"
        )
