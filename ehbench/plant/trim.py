"""What a start depends on, and how a state settles in it."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from ehbench.parts.accumulator import COLUMNS as ACCUMULATOR
from ehbench.parts.cylinder import CYLINDER, linkage_of
from ehbench.parts.edge import EDGE
from ehbench.parts.friction import COLUMNS as FRICTION
from ehbench.parts.line import LINE
from ehbench.parts.load import FORCE
from ehbench.parts.mount import mount_settle
from ehbench.parts.nodes import NODE
from ehbench.parts.oil import OIL_COLUMNS
from ehbench.parts.supply import SUPPLY as SUPPLY_LINE
from ehbench.parts.sway import sway_settle
from ehbench.parts.valve import ELEMENT, VALVE
from ehbench.physics.arm import LINK
from ehbench.plant.build import Plant
from ehbench.plant.rest import open_at_rest

# pressure [Pa] of the chambers that no load presses on: of all cylinders, or by name of some
LowSide = float | Mapping[str, float] | None
# fields of a plant's tables that no start asks for: how its oil gives way, what flows and what
# takes energy while it moves; of what friction has, a mount's deflection may; then those that a
# start at rest does not ask for, but one in motion does
_IDLE = {
    "links": ("damping",),
    "cylinders": (
        *(name for name, *_ in OIL_COLUMNS),
        *("volume_head", "volume_rod", "leakage_internal", "leakage_head", "leakage_rod"),
        *("relief_pressure", "cavitation_pressure", "stop_stiffness"),
        *("mobility", "joint_mobility"),
    ),
    "edges": tuple(set(EDGE.names or ()) - {"law", "from_node", "to_node"}),
    "lines": tuple(set(LINE.names or ()) - {"node", "chamber", "cylinder"}),
    "supply": tuple(name for name, *_ in (*OIL_COLUMNS, *ACCUMULATOR)),
}
_TABLES = {
    **{"links": LINK, "cylinders": CYLINDER, "nodes": NODE, "valves": VALVE, "elements": ELEMENT},
    **{"edges": EDGE, "forces": FORCE, "lines": LINE, "supply": SUPPLY_LINE},
}
_MOVING = {
    "valves": ("delay",),
    "elements": tuple(set(ELEMENT.names or ()) - {"law", "state", "states"}),
}


def start_key(plant: Plant, moves: bool) -> tuple[object, ...]:
    """All of a plant that its start along a recording depends on, at rest or where it ``moves``."""
    mounts = plant.cylinders["mount_state"].max(initial=-1) >= 0
    requested = _needed(moves, mounts, bool(open_at_rest(plant).any()))
    parts: list[object] = [plant.kind, plant.gravity.tobytes(), plant.at]
    for name, spans in requested:
        rows: Any = getattr(plant, name)
        packed, size = rows.tobytes(), rows.dtype.itemsize
        starts = range(0, len(packed), size)
        parts.append(b"".join([packed[at + a : at + b] for at in starts for a, b in spans]))
    return tuple(parts)


@cache
def _needed(
    moves: bool, mounts: bool, opens: bool
) -> tuple[tuple[str, tuple[tuple[int, int], ...]], ...]:
    """(table of a plant, the bytes of its rows that `start_key` asks for, as spans)."""
    results = []
    for name, layout in _TABLES.items():
        idle = {*_IDLE.get(name, ()), *(() if moves else _MOVING.get(name, ()))}
        idle = set() if name == "edges" and opens else idle
        idle |= set(FRICTION) if name == "cylinders" and not mounts else set()
        counted = np.zeros(layout.itemsize + 1, dtype=np.int8)
        for field, (kind, first, *_) in (layout.fields or {}).items():
            counted[first : first + kind.itemsize] = field not in idle
        ends = np.flatnonzero(np.diff(counted, prepend=0)).tolist()
        results.append((name, tuple(zip(ends[::2], ends[1::2], strict=True))))
    return tuple(results)


def settle_parts(plant: Plant, y: np.ndarray) -> None:
    """Settle lines, mounts and what sways in ``y``, by the pressures of the chambers."""
    if plant.lines.size:
        at: Any = plant.nodes.state
        for line in plant.lines:
            y[at[line.node]] = y[at[line.chamber]]
    table = plant.cylinders
    if max(table["mount_state"].max(initial=-1), table["sway_state"].max(initial=-1)) < 0:
        return
    for row in table:
        mount_settle(row, 0.0, y, plant)
        _, lever, _ = linkage_of(row, y[row.joint])
        sway_settle(row, lever * y[plant.at.rates + row.joint], y)


def carry(
    row: np.record, balanced: tuple[float, float], seen: list[float | None]
) -> tuple[float, ...]:
    """(p_head, p_rod) [Pa] as a recording has them, moved as little as possible together until they
    carry the load that ``balanced`` carries.

    Args:
        row: of the cylinder.
        balanced: pressures that carry the load [Pa].
        seen: mean pressures of the recording [Pa], None where it has none."""
    force = balanced[0] * row.area_head - balanced[1] * row.area_rod
    p_head, p_rod = seen
    if p_head is None and p_rod is None:
        return balanced
    if p_head is None:
        p_head = (force + p_rod * row.area_rod) / row.area_head
    elif p_rod is None:
        p_rod = (p_head * row.area_head - force) / row.area_rod
    missing = force - p_head * row.area_head + p_rod * row.area_rod
    missing /= row.area_head**2 + row.area_rod**2
    return p_head + missing * row.area_head, p_rod - missing * row.area_rod
