"""A rig as the tables that kernels read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ehbench.compiled import table
from ehbench.errors import InputError
from ehbench.parts import edge as edges
from ehbench.parts import valve as valves
from ehbench.parts.cylinder import CYLINDER, joint_of, linkage_of
from ehbench.parts.edge import EDGE
from ehbench.parts.end_stop import STOP_DEPTH
from ehbench.parts.nodes import NODE, SUPPLY, TANK
from ehbench.parts.supply import SUPPLY as SUPPLY_LINE
from ehbench.parts.valve import ELEMENT, VALVE
from ehbench.physics import arm
from ehbench.physics.cylinder import DIRECT, PINS
from ehbench.physics.flow_map import FlowMap, ValveMaps, pack
from ehbench.plant.layout import SIDES, Layout, Offsets, layout
from ehbench.rig import Chain, Edge, Rig, Slide, Valve

Maps = Mapping[str, ValveMaps]


class Plant(NamedTuple):
    """A rig as flat tables, the one argument type of every kernel.

    ``kind``, ``gravity`` and ``links`` are those of `ehbench.physics.arm`; the records of the other
    tables are described beside their parts: `ehbench.parts.cylinder`, ``.nodes``, ``.valve``,
    ``.edge``, ``.supply``. ``maps`` are the packed flow maps, ``at`` says where things lie.
    """

    kind: int
    gravity: np.ndarray
    links: np.recarray
    cylinders: np.recarray
    nodes: np.recarray
    valves: np.recarray
    elements: np.recarray
    edges: np.recarray
    maps: np.ndarray
    supply: np.record
    at: Offsets

    @property
    def tank_pressure(self) -> float:
        """[Pa]"""
        return float(self.nodes[TANK].pressure)

    def at_pressures(self, supply: float | None = None, tank: float | None = None) -> Plant:
        """This plant with a set pressure and a tank pressure [Pa] of their own; what is not given
        stays.
        """
        line, nodes = table(1, SUPPLY_LINE), self.nodes.copy()
        line[0] = self.supply
        if supply is not None:
            line[0].pressure = supply
        if tank is not None:
            nodes[TANK].pressure = tank
        return self._replace(supply=line[0], nodes=nodes)


def build(rig: Rig, maps: Maps | None = None) -> Plant:
    """The compiled form of a rig.

    Args:
        rig: with its payload already applied (``rig.with_payload``).
        maps: measured flow maps by edge name (``edge`` or ``cylinder.edge``); they replace the
            edge's analytic law.

    Raises:
        InputError: an edge asks for a map that is not given.
    """
    names = layout(rig)
    kind, links, up = _mechanism(rig)
    edge_rows, data = _edges(rig, names, maps or {})
    valve_rows, elements = _valves(rig, names)
    return Plant(
        kind=kind,
        gravity=float(rig.gravity) * np.array(up),
        links=links,
        cylinders=_cylinders(rig, names, kind, links),
        nodes=_nodes(rig, names),
        valves=valve_rows,
        elements=elements,
        edges=edge_rows,
        maps=data,
        supply=_supply(rig),
        at=names.offsets(),
    )


def _mechanism(rig: Rig) -> tuple[int, np.recarray, tuple[float, float, float]]:
    """(kind, links, the base-frame direction that points up)."""
    if isinstance(rig.mechanism, Slide):
        body, links = rig.mechanism, table(1, arm.LINK)
        links[0] = arm.pack_slide(float(body.mass), float(body.damping), float(body.incline))
        return arm.SLIDE, links, (0.0, 0.0, 1.0)
    return arm.CHAIN, _links(rig.mechanism), _up(rig.mechanism)


def _up(chain: Chain) -> tuple[float, float, float]:
    return (0.0, 0.0, 1.0) if chain.first_axis == "vertical" else (0.0, 1.0, 0.0)


def _links(chain: Chain) -> np.recarray:
    links = table(len(chain.joint), arm.LINK)
    for at, joint in enumerate(chain.joint):
        xx, yy, zz, xy, xz, yz = joint.inertia.value
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.linalg.eigvalsh(inertia).min() < 0 or float(joint.mass) < 0:
            raise InputError(
                f"the inertia of link '{joint.name}' is that of no body: it has a negative "
                "principal moment"
            )
        frame = (joint.dh_a, joint.dh_d, joint.dh_alpha, joint.dh_theta, joint.mass)
        links[at] = arm.pack_link(
            *map(float, frame), joint.com.value, inertia, float(joint.joint_damping)
        )
    return links


def _cylinders(rig: Rig, names: Layout, kind: int, links: np.recarray) -> np.recarray:
    rows = table(len(rig.cylinder), CYLINDER)
    for index, (row, item) in enumerate(zip(rows, rig.cylinder, strict=True)):
        row.joint, row.geometry = names.joints.index(item.joint), DIRECT
        if item.pins is not None:
            row.geometry = PINS
            row.l_a, row.l_b = float(item.pins.l_a), float(item.pins.l_b)
            row.side, row.phase = item.pins.sign, float(item.pins.phase)
            row.retracted_length = float(item.pins.retracted_length)
        row.area_head, row.area_rod = item.areas()
        for key in ("stroke", "volume_head", "volume_rod", "friction_viscous", "friction_coulomb"):
            row[key] = float(getattr(item, key))
        for key in ("leakage_internal", "leakage_head", "leakage_rod"):
            row[key] = float(getattr(item, key))
        oil, relief = item.bulk_modulus or rig.oil.bulk_modulus, item.relief_pressure
        row.bulk_modulus = float(oil)
        row.relief_pressure = math.inf if relief is None else float(relief)
        row.cavitation_pressure = float(rig.oil.cavitation_pressure)
        row.stop_stiffness = float(rig.supply.pressure) * row.area_head / STOP_DEPTH
        row.node_head, row.node_rod = (names.node(index, side) for side in SIDES)
        row.friction = names.frictions[index]
        row.mobility = _mobility(kind, links, row)
    return rows


def _mobility(kind: int, links: np.recarray, row: np.record) -> float:
    """Largest acceleration at the cylinder per force on it [1/kg] over its stroke, the other joints
    at zero and free.
    """
    n, joint = links.shape[0], int(row.joint)
    mass, work, most = np.empty((n, n)), np.empty(arm.work_size(n)), 0.0
    for x in np.linspace(0.0, row.stroke, 5):
        q = np.zeros(n)
        q[joint] = joint_of(row, x)
        arm.mass_matrix(kind, links, q, mass, work)
        _, lever, _ = linkage_of(row, q[joint])
        most = max(most, lever**2 * float(np.linalg.inv(mass)[joint, joint]))
    return most


def _nodes(rig: Rig, names: Layout) -> np.recarray:
    rows = table(names.nodes, NODE)
    rows.state = rows.cylinder = -1
    rows[SUPPLY].state = names.state("p_supply")
    rows[TANK].pressure = float(rig.supply.tank_pressure)
    for index in range(len(names.cylinders)):
        for side, end in enumerate(SIDES):
            row = rows[names.node(index, end)]
            row.state, row.cylinder, row.side = names.state(f"p_{end}", index), index, side
    return rows


def _valves(rig: Rig, names: Layout) -> tuple[np.recarray, np.recarray]:
    rows, elements = table(len(names.valves), VALVE), table(len(names.elements), ELEMENT)
    at = 0
    for index, (row, (_, item)) in enumerate(zip(rows, rig.valves(), strict=True)):
        row.lowest, row.highest = float(item.command_min), float(item.command_max)
        row.first, row.output = at, -1
        for law in (law for valve, law in names.elements if valve == index):
            omega, zeta = rig.dynamics[item.dynamics].frequency_and_damping()
            set_second_order(elements[at], omega, zeta)
            elements[at].law, elements[at].states = law, len(valves.LAWS[law].states)
            elements[at].state = row.output = names.state("opening", index)
            at += 1
        row.count = at - row.first
    return rows, elements


def set_second_order(element: np.record, omega: float, zeta: float) -> None:
    """Give an element its natural frequency [rad/s] and damping ratio."""
    element.stiffness, element.damping = omega**2, 2 * zeta * omega
    element.fastest = math.sqrt(element.stiffness)


def _edges(rig: Rig, names: Layout, maps: Maps) -> tuple[np.recarray, np.ndarray]:
    """(rows, packed flow maps)."""
    rows, packed = table(len(names.edges), EDGE), []
    for row, name, (item, valve, edge) in zip(rows, names.edges, rig.edges(), strict=True):
        cylinder = names.cylinders.index(item.name)
        row.from_node, row.to_node = names.node(cylinder, edge.from_), names.node(cylinder, edge.to)
        row.valve = names.valves.index(f"{item.name}.{valve.name}")
        row.sign, row.blocked = edge.sign, edge.reverse == "blocked"
        _law(row, edge, map_of(maps, name), packed, rig, valve)
    data, offsets = pack(packed) if packed else (np.zeros(1), np.zeros(0, dtype=np.int64))
    for key in ("forward", "reverse"):
        chosen = rows[key] >= 0
        rows[key][chosen] = np.asarray(offsets)[rows[key][chosen]]
    return rows, data


def map_of(maps: Maps | None, edge: str) -> ValveMaps | None:
    """The measured maps of an edge, by ``<cylinder>.<edge>`` or by ``<edge>`` alone."""
    maps = maps or {}
    return maps.get(edge) or maps.get(edge.split(".", 1)[1])


def _law(
    row: np.record,
    edge: Edge,
    given: ValveMaps | None,
    packed: list[FlowMap],
    rig: Rig,
    valve: Valve,
) -> None:
    if edge.law == "map" and given is None:
        raise InputError(
            f"edge '{valve.edge_name(edge)}' of rig '{rig.name}' follows a flow map, and none is "
            "given for it",
            hint="name a run with flow_maps",
        )
    gain = edge.flow_gain if edge.law == "orifice" else edge.compensated_gain
    row.law = edges.MAP if given is not None else edges.BY_NAME[edge.law]
    row.gain = 0.0 if gain is None else float(gain)
    row.deadband, row.compensation_drop = float(edge.deadband), float(edge.compensation_drop)
    row.forward = row.reverse = -1
    if given is not None:
        for key in ("forward", "reverse"):
            one = getattr(given, key)
            if one is not None:
                row[key] = len(packed)
                packed.append(one)


def _supply(rig: Rig) -> np.record:
    row = table(1, SUPPLY_LINE)[0]
    row.pressure, row.flow_limit = float(rig.supply.pressure), float(rig.supply.flow_limit)
    row.volume, row.bulk_modulus = float(rig.supply.volume), float(rig.oil.bulk_modulus)
    return row
