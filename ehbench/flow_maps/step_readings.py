"""Flow readings from step logs without a flowmeter: what the cylinder takes, an edge has passed.

While the commands stand, and one edge alone feeds or drains a chamber, that edge passes

    flow = ±(A·v) + V/β · dp/dt + C_tm (p − p_other) + C_em (p − p_tank)

with the pressures, the speed and the areas of the log and of the rig (continuity, Merritt 1967).
Blocks of a stretch are its readings; a flow map is fitted to them as to those of a cylinder's
speed."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ehbench.data.flowmeter import FlowmeterData
from ehbench.data.record import Record
from ehbench.flow_maps.readings import readings_table
from ehbench.parts.cylinder import chamber_of, chamber_oil, linkage_arrays
from ehbench.parts.nodes import SUPPLY, TANK
from ehbench.parts.oil import bulk_of
from ehbench.plant.layout import SIDES
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import SETTINGS as OBSERVED
from ehbench.preprocessing.observations import least_changes
from ehbench.preprocessing.preparation import preprocess
from ehbench.signals.series import transients
from ehbench.vocabulary import InsufficientData, message, setting


@dataclass(frozen=True)
class StepSettings:
    """Numbers by which a block of a step log is a reading."""

    steady: float = setting(0.25, "", "largest rms of a drop, as a share", "its root is then 1 %")
    drop: float = setting(2e-3, "", "smallest drop, of the supply's pressure", "sensor errors")


SETTINGS = StepSettings()


@dataclass(frozen=True)
class _Block:
    """Some samples from the ``first`` on: pressures [Pa] by node, and what flows into each chamber
    on average [m³/s], by node."""

    first: int
    pressure: dict[int, np.ndarray]
    inflow: dict[int, float]


def step_readings(
    name: str, record: Record, model: Model, settle: float, span: float
) -> FlowmeterData:
    """The readings that a log gives of every edge that alone feeds or drains a chamber.

    Args:
        name: of the log, for ``file``; ``line`` is the first sample of a reading, from 1.
        record: pressures of both ends, speed or position, commands.
        model: areas, volumes, leakage and oil are its rig's, and the supply's pressure where the
            log has none.
        settle: after a change of a command [s].
        span: of a reading [s].

    Raises:
        InputError: as `preprocessing.preprocess`.
        InsufficientData: no reading; says what is needed."""
    record, notes = preprocess(name, record, model)
    rows: list[tuple[str, str, float, float, float, int, int]] = []
    for index, cylinder in enumerate(model.layout.cylinders):
        if any(f"{cylinder}.p_{side}" not in record for side in SIDES):
            continue
        minimum = least_changes(model.rig.cylinder[index], record)
        if not minimum:
            continue
        commands = np.column_stack([record[channel] for channel in minimum])
        standing = transients(record.t, commands, minimum=np.array([*minimum.values()]))
        for trial, window in enumerate(standing):
            window = slice(window.start + round(settle / record.sample_time), window.stop)
            for block in _steady_blocks(model, index, record, window, span):
                rows += [
                    (*reading, trial, block.first + 1)
                    for reading in _readings(model, record, block)
                ]
    if not rows:
        raise InsufficientData(message("flow_maps.no_step_reading", log=name, time=settle + span))
    valve, way, command, drop, flow, trial, line = map(np.array, zip(*rows, strict=True))
    columns = {"valve": valve, "direction": way, "trial": trial, "line": line, "file": name}
    table = readings_table(command, drop, flow, method="cylinder", **columns)
    return replace(table, warnings=tuple(f"{name}: {text}" for text in notes))


def _steady_blocks(
    model: Model, index: int, record: Record, window: slice, span: float
) -> Iterator[_Block]:
    """Means over pieces of a stretch, of a cylinder whose chambers are neither empty nor
    relieved."""
    row, tick = model.plant.cylinders[index], record.sample_time
    x, v = _motion(model, index, record)
    nodes = tuple(int(chamber_of(row, side)[0]) for side in range(len(SIDES)))
    if x is None or v is None or any(model.plant.nodes[node].line >= 0 for node in nodes):
        return
    table, count = _pressures(model, record), max(8, round(span / tick))
    weight, edge = _weights(count)
    for first in range(window.start, window.stop - count + 1, count):
        part = slice(first, first + count)
        pressure = {node: values[part] for node, values in table.items()}
        inside = [pressure[node] for node in nodes]
        empty = OBSERVED.empty * row.cavitation_pressure
        if np.min(inside) < empty or np.max(inside) > row.relief_pressure:
            continue
        mean, tank = [float(weight @ item) for item in inside], float(weight @ pressure[TANK])
        inflow = {}
        for side, node in enumerate(nodes):
            _, area, _, leakage = chamber_of(row, side)
            volume = chamber_oil(row, side, float(weight @ x[part]))
            rate = float(np.mean(inside[side][-edge:]) - np.mean(inside[side][:edge]))
            rate /= (count - edge) * tick
            lost = row.leakage_internal * (mean[side] - mean[1 - side])
            lost += leakage * (mean[side] - tank)
            squeezed = volume / bulk_of(row, mean[side]) * rate
            inflow[node] = area * float(weight @ v[part]) + squeezed + lost
        yield _Block(first, pressure, inflow)


def _weights(count: int) -> tuple[np.ndarray, int]:
    """(weights of samples, how many at either end): with them the mean of a rate is exactly the
    difference between the means of the ends: a chamber that rings takes many times the flow."""
    edge = max(1, count // 8)
    weight = np.convolve(np.convolve(np.ones(count - edge), np.ones(edge)), np.ones(2))
    return weight / weight.sum(), edge


def _motion(
    model: Model, index: int, record: Record
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """(stroke [m], speed [m/s]) of a cylinder; None where the log does not tell."""
    row, name = model.plant.cylinders[index], model.layout.cylinders[index]
    pinned = model.rig.cylinder[index].linkage is not None
    x = record[f"{name}.x"] if f"{name}.x" in record else None
    lever = None
    if pinned and f"{name}.q" in record:
        stroke, lever = linkage_arrays(row, record[f"{name}.q"])
        x = stroke if x is None else x
    v = record[f"{name}.v"] if f"{name}.v" in record else None
    if v is None and lever is not None and f"{name}.qd" in record:
        v = lever * record[f"{name}.qd"]
    if v is None and x is not None:
        v = np.gradient(x, record.sample_time)
    return x, v


def _pressures(model: Model, record: Record) -> dict[int, np.ndarray]:
    """Pressure [Pa] of each node, shape (samples,): recorded, or that of the rig's supply and
    tank."""
    supply = model.rig.supply
    known = {SUPPLY: ("p_supply", supply.pressure), TANK: ("p_tank", supply.tank_pressure)}
    table = {
        node: record[channel] if channel in record else np.full(record.t.size, float(value))
        for node, (channel, value) in known.items()
    }
    for row, name in zip(model.plant.cylinders, model.layout.cylinders, strict=True):
        for side, node in zip(SIDES, (row.node_head, row.node_rod), strict=True):
            if f"{name}.p_{side}" in record:
                table[int(node)] = record[f"{name}.p_{side}"]
    return table


def _readings(
    model: Model, record: Record, block: _Block
) -> Iterator[tuple[str, str, float, float, float]]:
    """(edge, direction, command [V], drop [Pa], flow [m³/s]) of each edge that alone feeds or
    drains a chamber; one between both chambers is read once."""
    plant, names, seen = model.plant, model.layout, set()
    commands = [f"{names.valves[edge.valve]}.command" for edge in plant.edges]

    def may_pass(i: int) -> bool:
        edge = plant.edges[i]
        if edge.unmetered or commands[i] not in record:
            return bool(edge.unmetered)
        return edge.sign * record[commands[i]][block.first] > min(edge.deadband, 0.0)

    for node, inflow in block.inflow.items():
        joined = [i for i, e in enumerate(plant.edges) if node in (e.from_node, e.to_node)]
        opened = [i for i in joined if may_pass(i)]
        if len(opened) != 1:
            continue
        (i,) = opened
        if plant.edges[i].unmetered or i in seen:
            continue
        seen.add(i)
        start, end = int(plant.edges[i].from_node), int(plant.edges[i].to_node)
        drops = block.pressure[start] - block.pressure[end]
        weight, _ = _weights(drops.size)
        root = float(weight @ (np.sign(drops) * np.sqrt(np.abs(drops))))
        drop = root * abs(root)
        minimum = SETTINGS.drop * float(model.rig.supply.pressure)
        if abs(drop) < minimum or float(np.std(drops)) > SETTINGS.steady * abs(drop):
            continue
        flow = float(np.sign(drop)) * (inflow if end == node else -inflow)
        side = "forward" if drop > 0.0 else "reverse"
        yield names.edges[i], side, float(record[commands[i]][block.first]), abs(drop), flow
