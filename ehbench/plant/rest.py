"""Pressures at which a cylinder rests whose chambers are joined to supply or tank by check valves,
underlapped edges or valves that cannot shut."""

from typing import Any

import numpy as np

from ehbench.parts.edge import CHECK, PUMP, edge_flow
from ehbench.parts.nodes import SUPPLY, TANK
from ehbench.parts.supply import sensed
from ehbench.parts.valve import limited
from ehbench.plant.build import Plant
from ehbench.runtime.compiled import kernel, part_kernel

LOW_SIDE = 0.1  # share of the supply pressure at which a chamber that carries nothing stands
CREEPS = 1.0e-5  # [m/s]: a cylinder that goes on slower at rest stands
HALVINGS = 60  # of the level's bracket: to the last digits


def open_at_rest(plant: Plant) -> np.ndarray:
    """Which edges may be open while all valves are at rest, shape (edges,): check valves,
    underlaps, those of a valve that cannot shut; no leaks of maps."""
    edges, valves = plant.edges, plant.valves
    law, valve = edges["law"], edges["valve"]
    rests = np.minimum(np.maximum(0.0, valves["lowest"]), valves["highest"])
    metered = (valve >= 0) & (law != PUMP)
    return (metered & (edges["sign"] * rests[valve] > edges["deadband"])) | (law == CHECK)


def resting(plant: Plant, row: np.record, force: float) -> tuple[float, float]:
    """(p_head, p_rod) [Pa] of a cylinder that carries ``force`` [N] at rest.

    The chamber that the load does not press on stands at a tenth of the supply pressure. A chamber
    that a check valve feeds from the supply stands at the supply's pressure at least. Where that
    leaves a flow at rest, both pressures go up or down together, the load carried all the way, to
    where one chamber gains by their ratio of areas what the other loses, ``A2·Q_head + A1·Q_rod =
    0``: there the pressures stay, while the cylinder creeps at ``Q_head/A1``.

    Args:
        row: of the cylinder.
        force: what the piston has to push with, out positive.
    """
    opens = open_at_rest(plant)
    if not opens.any():
        return carrying(row, force, plant.supply.pressure * LOW_SIDE)
    edges, chambers = _edges_at(plant, row, opens), (row.node_head, row.node_rod)
    checks = edges[(edges.law == CHECK) & (edges.from_node == SUPPLY)]
    fed = [bool(np.any(checks.to_node == node)) for node in chambers]
    low = plant.supply.pressure * (1.0 if all(fed) else LOW_SIDE)
    head, rod = carrying(row, force, low)
    if fed[0] and head < plant.supply.pressure:
        head = plant.supply.pressure
        rod = (head * row.area_head - force) / row.area_rod
    if fed[1] and rod < plant.supply.pressure:
        rod = plant.supply.pressure
        head = (force + rod * row.area_rod) / row.area_head

    def head_at(rod: float) -> float:
        return (force + rod * row.area_rod) / row.area_head

    def gain(rod: float) -> float:
        flows = [_inflow(plant, edges, row, head_at(rod), rod, node) for node in range(2)]
        return row.area_rod * flows[0] + row.area_head * flows[1]

    first, tank = gain(rod), plant.tank_pressure
    if first == 0.0:
        return head, rod
    lowest = max(tank, (tank * row.area_head - force) / row.area_rod)
    near, far, span = rod, rod, max(plant.supply.pressure, 1.0e5)
    for _ in range(12):
        far = rod + span if first > 0.0 else max(rod - span, lowest)
        if gain(far) * first <= 0.0:
            break
        span *= 2.0
    for _ in range(HALVINGS):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if gain(middle) * first > 0.0 else (near, middle)
    return head_at(far), far


def creep(plant: Plant, row: np.record, head: float, rod: float) -> float:
    """Speed [m/s], out positive, at the pressures [Pa] of `resting`: ``Q_head/A1``."""
    edges = _edges_at(plant, row, open_at_rest(plant))
    return _inflow(plant, edges, row, head, rod, 0) / row.area_head


def _edges_at(plant: Plant, row: np.record, opens: np.ndarray) -> Any:
    """Rows of the edges that are open, as `open_at_rest` has them, at a cylinder's chambers."""
    shown: Any = plant.edges_at_chambers
    chambers = (row.node_head, row.node_rod)
    adjacent = np.isin(shown.from_node, chambers) | np.isin(shown.to_node, chambers)
    return shown[adjacent & opens]


def carrying(row: np.record, force: float, low: float) -> tuple[float, float]:
    """(p_head, p_rod) [Pa] that carry a ``force`` [N], one of them at ``low`` and none below."""
    if force + low * row.area_rod >= low * row.area_head:
        return (force + low * row.area_rod) / row.area_head, low
    return low, (low * row.area_head - force) / row.area_rod


@part_kernel
def _pressure_at(node, plant, row, head, rod):
    """Pressure [Pa] at a node beside a cylinder at rest; 0 at any that is none of these."""
    if node == row.node_head:
        return head
    if node == row.node_rod:
        return rod
    tank = plant.nodes[TANK].pressure
    if node == TANK:
        return tank
    return sensed(tank, plant.supply) if node == SUPPLY else 0.0


@kernel
def _inflow(plant, edges, row, head, rod, side):
    """Flow [m³/s] into a chamber, 0 head and 1 rod, along ``edges`` at rest."""
    node, total = row.node_head if side == 0 else row.node_rod, 0.0
    for e in range(edges.shape[0]):
        edge = edges[e]
        way = int(edge.to_node == node) - int(edge.from_node == node)
        if way == 0:
            continue
        first = _pressure_at(edge.from_node, plant, row, head, rod)
        last = _pressure_at(edge.to_node, plant, row, head, rod)
        opening = limited(0.0, plant.valves[edge.valve]) if edge.valve >= 0 else 0.0
        if edge.law == CHECK and edge.pilot >= 0:
            opening = max(_pressure_at(edge.pilot, plant, row, head, rod) - first, 0.0)
        total += way * edge_flow(first - last, opening, edge, plant.maps)
    return total
