"""Where a motion starts: postures, and the state at rest in one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.parts.accumulator import COLUMNS as ACCUMULATOR
from ehbench.parts.cylinder import CYLINDER, joint_of, joint_range_of, linkage_of
from ehbench.parts.edge import EDGE
from ehbench.parts.friction import COLUMNS as FRICTION
from ehbench.parts.line import LINE
from ehbench.parts.load import FORCE, force_on
from ehbench.parts.mount import mount_settle
from ehbench.parts.nodes import NODE
from ehbench.parts.oil import OIL_COLUMNS
from ehbench.parts.supply import SUPPLY as SUPPLY_LINE
from ehbench.parts.supply import sensed
from ehbench.parts.sway import sway_settle
from ehbench.parts.valve import ELEMENT, VALVE, valve_settle
from ehbench.physics.arm import LINK, SLIDE, gravity_torque, work_size
from ehbench.plant.build import Plant
from ehbench.plant.layout import Layout
from ehbench.plant.rest import carrying, open_at_rest, resting
from ehbench.vocabulary.errors import InputError, SimulationError
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY

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
        *("relief_pressure", "cavitation_pressure", "stop_stiffness", "mobility"),
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


def posture(
    rig: Rig, plant: Plant, names: Layout, required: Mapping[str, str | float] | None
) -> np.ndarray:
    """As `Model.posture`."""
    q = np.zeros(len(names.joints))
    for row in plant.cylinders:
        q[row.joint] = joint_of(row, 0.5 * row.stroke)
    if required is not None and not isinstance(required, Mapping):
        example = f'{{"{names.cylinders[0]}": "120 mm"}}'
        raise InputError(message("plant.no_posture", given=repr(required), example=example))
    for name, value in (required or {}).items():
        if name in names.cylinders:
            index = names.cylinders.index(name)
            joint = int(plant.cylinders[index].joint)
        elif name in names.joints:
            joint = names.joints.index(name)
            index = next(iter(np.flatnonzero(plant.cylinders.joint == joint).tolist()), -1)
        else:
            raise InputError(
                f"posture names '{name}', which is no cylinder or joint",
                hint="there are " + ", ".join(names.cylinders),
            )
        given = isinstance(value, str)
        q[joint] = _coordinate(rig, plant, index, name, value) if given else float(value)
        if index < 0:
            continue
        low, high = sorted(joint_range_of(plant.cylinders[index]))
        if not low - 1e-9 <= q[joint] <= high + 1e-9:
            word, decimals = ("x", 1) if plant.kind == SLIDE else ("q", 2)
            first, last, at = (rig.text(word, number, decimals) for number in (low, high, q[joint]))
            raise InputError(
                f"posture {name} = {at} lies outside the stroke",
                hint=f"the stroke allows {first.partition(' ')[0]} to {last}",
            )
    return q


def _coordinate(rig: Rig, plant: Plant, index: int, name: str, text: str) -> float:
    """A joint coordinate from a text: an angle, or a length that is a stroke."""
    try:
        return float(read_value(text, VOCABULARY["x" if plant.kind == SLIDE else "q"]))
    except InputError:
        row = plant.cylinders[index]
        stroke = float(read_value(text, VOCABULARY["x"]))
        if not 0 <= stroke <= row.stroke:
            raise InputError(
                f"posture {name} = {text} lies outside the stroke",
                hint=f"0 to {rig.text('x', row.stroke, 1)}",
            ) from None
        return float(joint_of(row, stroke))


def trim(
    plant: Plant,
    names: Layout,
    rig: Rig,
    q: np.ndarray,
    low_side: LowSide = None,
    command: np.ndarray | None = None,
) -> np.ndarray:
    """As `Model.trim`."""
    n = len(names.joints)
    y = np.zeros(names.states)
    y[:n] = q
    torque = np.empty(n)
    gravity_torque(plant.kind, plant.links, plant.gravity, q, torque, np.empty(work_size(n)))
    played = np.zeros(len(names.valves) + len(names.played)) if command is None else command
    for index, row in enumerate(plant.cylinders):
        name = names.cylinders[index]
        low = low_side.get(name) if isinstance(low_side, Mapping) else low_side
        if low is not None:
            read_value(f"{low} Pa", VOCABULARY["p_head"])  # refuses no pressure
        x, lever, _ = linkage_of(row, q[row.joint])
        if abs(lever) < 1e-6:
            raise SimulationError(
                f"cylinder '{name}' has no lever at this posture, so nothing holds the load"
            )
        force = torque[row.joint] / lever
        if plant.forces.shape[0]:
            force -= force_on(index, x, 0.0, played, plant)
        fixed = resting(plant, row, force) if low is None else carrying(row, force, low)
        y[names.state("p_head", index)], y[names.state("p_rod", index)] = fixed
    for valve, (_, item) in zip(plant.valves, rig.valves(), strict=True):
        valve_settle(valve, item.rest, plant, y)
    y[plant.at.supply] = sensed(plant.tank_pressure, plant.supply)
    settle_parts(plant, y)
    return y


def start_key(plant: Plant, moves: bool) -> tuple[object, ...]:
    """All of a plant that its start along a recording depends on, at rest or where it ``moves``."""
    requested = _needed(moves, mounted(plant), bool(open_at_rest(plant).any()))
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


def mounted(plant: Plant) -> bool:
    """Whether the mount of a cylinder gives way."""
    return plant.cylinders["mount_state"].max(initial=-1) >= 0


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
        seen: mean pressures of the recording [Pa], None where it has none.
    """
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
