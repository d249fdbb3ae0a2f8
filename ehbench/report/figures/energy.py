"""Energy ledgers as figures read them, as their JSON has them: ``rows`` with name, energy [J],
group, label, cylinder and interval, and ``source``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ehbench.report.words import fixed, number, places_of

Ledger = Mapping[str, Any]
Unit = tuple[float, str]  # (J per unit, unit)


def unit_for(ledgers: Sequence[Ledger]) -> Unit:
    """The unit in which the largest energy is a number of few digits."""
    maximum = max((abs(row["energy"]) for ledger in ledgers for row in ledger["rows"]), default=0.0)
    return (1e6, "MJ") if maximum >= 1e8 else (1e3, "kJ") if maximum >= 1e5 else (1.0, "J")


def half_of(row: Mapping[str, Any]) -> float | None:
    """Half the 95 % interval of a row [J]; None where it has none."""
    interval = row.get("interval")
    return None if interval is None or None in interval else 0.5 * (interval[1] - interval[0])


def energy_text(energy: float, half: float | None, unit: Unit, whole: float = 0.0) -> str:
    """``424 ± 21 J · 7.7 %``, the share where ``whole`` [J] is given."""
    value = energy / unit[0]
    if half is not None and half > 0.0 and math.isfinite(half):
        places = max(places_of(half / unit[0]), -2)
        text = f"{fixed(value, places)} ± {fixed(half / unit[0], places)}"
    else:
        text = number(value, 3)
    counts = whole > 0.0 and abs(energy) > 1e-5 * whole
    share = f" · {number(100 * energy / whole, 2)} %" if counts else ""
    return f"{text} {unit[1]}{share}"


def part_of(row: Mapping[str, Any]) -> str | None:
    """The stack to which a row belongs; None for rows that are not summed."""
    group, word = row["group"], row["name"].rsplit(".", 1)[-1]
    if group == "valve":
        ends = row["label"].rsplit(", ", 1)[-1].split(" → ")
        return "in" if "supply" in ends else "out" if "tank" in ends else "cross"
    if group == "loss":
        rubs = ("friction", "damping", "end_stop", "mount", "sway")
        return "mechanical" if word in rubs else "oil"
    if word in ("stop", "mount_spring"):
        return "mechanical"
    return {"load": "load", "store": "store", "residual": "rest"}.get(group)
