"""Nodes of the hydraulic circuit: supply, tank, the two chambers of each cylinder, its lines."""

from ehbench.parts.oil import stored
from ehbench.parts.supply import from_rail
from ehbench.runtime.compiled import part_kernel, record

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
def ends_of(y, plant, edge):
    """(pressures [Pa] that an edge finds where it begins and where it ends, whether its supply is
    the low rail) at plant state y. Check valves keep oil from flowing back into a load-sensing
    pump."""
    first = node_pressure(y, plant, edge.from_node)
    last = node_pressure(y, plant, edge.to_node)
    if plant.supply.margin > 0.0:
        if edge.from_node == SUPPLY:
            return max(first, last), last, False
        if edge.to_node == SUPPLY:
            return first, max(first, last), False
    if plant.supply.rail > 0.0:
        if edge.from_node == SUPPLY and from_rail(last, plant.supply):
            return plant.supply.rail, last, True
        if edge.to_node == SUPPLY and from_rail(first, plant.supply):
            return first, plant.supply.rail, True
    return first, last, False


@part_kernel
def node_stored(plant, node, pressure):
    """Energy [J/m³] that compression to a pressure [Pa] holds in the oil of a node."""
    cylinder, line = plant.nodes[node].cylinder, plant.nodes[node].line
    if line >= 0:
        return stored(plant.lines[line], pressure)
    if cylinder < 0:
        return stored(plant.supply, pressure)
    return stored(plant.cylinders[cylinder], pressure)
