"""Nodes of the hydraulic circuit: supply, tank, the two chambers of each cylinder, its lines."""

from __future__ import annotations

from ehbench.compiled import part_kernel, record
from ehbench.parts.oil import held

SUPPLY, TANK = 0, 1

# A node. Where its pressure stands in the ``state`` (−1: it stays at ``pressure`` [Pa]); the number
# of the ``cylinder`` whose chamber it is (−1: none) and its ``side``, 0 head and 1 rod; the number
# of the ``line`` that it is instead (−1: none).
NODE = record(
    *(("state", "i8"), ("pressure", "f8"), ("cylinder", "i8"), ("side", "i8"), ("line", "i8"))
)


@part_kernel
def node_pressure(y, plant, node):
    """Pressure [Pa] of a node at plant state y."""
    row = plant.nodes[node]
    return row.pressure if row.state < 0 else y[row.state]


@part_kernel
def node_held(plant, node, pressure):
    """Energy [J/m³] that compression to a pressure [Pa] holds in the oil of a node."""
    cylinder, line = plant.nodes[node].cylinder, plant.nodes[node].line
    if line >= 0:
        return held(plant.lines[line], pressure)
    if cylinder < 0:
        return held(plant.supply, pressure)
    return held(plant.cylinders[cylinder], pressure)
