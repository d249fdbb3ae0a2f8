"""A rig as the tables that kernels read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ehbench.config.rig import Cylinder, Edge, FixedEdge, Joint, Rig, Slide
from ehbench.parts import edge as edges
from ehbench.parts import friction
from ehbench.parts import valve as valves
from ehbench.parts.accumulator import COLUMNS as ACCUMULATOR
from ehbench.parts.cylinder import CYLINDER, CYLINDER_FIELDS, PINS_OF
from ehbench.parts.edge import EDGE
from ehbench.parts.end_stop import STOP_DEPTH
from ehbench.parts.line import LINE
from ehbench.parts.load import FORCE, force_fields
from ehbench.parts.nodes import NODE, TANK
from ehbench.parts.oil import EXPONENT
from ehbench.parts.supply import SUPPLY as SUPPLY_LINE
from ehbench.parts.valve import ELEMENT, VALVE
from ehbench.physics import arm
from ehbench.physics.cylinder import DIRECT, PINS, RACK, joint_angle, linkage
from ehbench.physics.flow_map import FlowMap, ValveMaps, pack
from ehbench.plant.layout import SIDES, Layout, Offsets, layout
from ehbench.runtime.compiled import table, table_of
from ehbench.vocabulary import InputError
from ehbench.vocabulary.fields import Value

_KEPT = 256  # things that plants have in common
Maps = Mapping[str, ValveMaps]
# as `linkage` takes them
PinNumbers = tuple[int, float, float, float, float, float]


class Plant(NamedTuple):
    """A rig as flat tables, the one argument type of every kernel.

    ``kind``, ``gravity`` and ``links`` are those of `ehbench.physics.arm`; the records of the other
    tables are described beside their parts: `ehbench.parts.cylinder`, ``.nodes``, ``.valve``,
    ``.edge``, ``.line``, ``.supply``, ``.load``. ``maps`` are the packed flow maps, ``at`` says
    where things lie."""

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
    forces: np.recarray
    lines: np.recarray
    at: Offsets

    @property
    def tank_pressure(self) -> float:
        """[Pa]"""
        return float(self.nodes[TANK].pressure)

    @property
    def edges_at_chambers(self) -> np.recarray:
        """Its edges as if no line stood between them and the chambers."""
        edges = self.edges.copy()
        for line in self.lines:
            for end in ("from_node", "to_node"):
                edges[end][edges[end] == line.node] = line.chamber
        return edges

    def commanded_before(self, command: np.ndarray, late: np.ndarray | float = 0.0) -> Plant:
        """This plant, commanded ``command`` [V] before the first tick, the valves' first, and each
        valve ``late`` [s] beside its own delay."""
        valves = self.valves.copy()
        valves["before"] = command[: valves.shape[0]]
        valves["delay"] += late
        return self._replace(valves=valves)

    def at_pressures(self, supply: float | None = None, tank: float | None = None) -> Plant:
        """This plant with a set pressure and a tank pressure [Pa], where given."""
        line, nodes = table(1, SUPPLY_LINE), self.nodes.copy()
        line[0] = self.supply
        if supply is not None and line[0].margin == 0.0:  # else it is the load's, not the pump's
            line[0].pressure = supply
        if tank is not None:
            nodes[TANK].pressure = tank
        return self._replace(supply=line[0], nodes=nodes)


class Kept:
    """What plants of one layout and one set of maps share: built once of the same parts of a rig.
    Such plants must not be written to."""

    def __init__(self) -> None:
        self._made: dict[tuple[Any, ...], tuple[Any, Any]] = {}

    def of(self, make: Callable[..., Any], parts: Iterable[Any], *arguments: Any) -> Any:
        """``make(*arguments)``, which hangs on these ``parts`` of a rig."""
        fixed = tuple(parts)
        key = (make, *map(id, fixed))
        result = self._made.get(key)
        if result is None:
            if len(self._made) >= _KEPT:
                self._made.clear()
            # with the parts, so that no other comes to have the number of one that is gone
            result = self._made[key] = (fixed, make(*arguments))
        return result[1]


def build(rig: Rig, names: Layout, maps: Maps | None = None, shared: Kept | None = None) -> Plant:
    """The compiled form of a rig.

    Args:
        rig: with its payload already applied (``rig.with_payload``).
        names: its layout.
        maps: measured flow maps by edge name (``edge`` or ``cylinder.edge``); they replace the
            edge's analytic law.
        shared: of other plants of this layout and these maps.

    Raises:
        InputError: an edge asks for a map that is not given.
    """
    shared = shared or Kept()
    valve_parts = [valve for _, valve in rig.valves()]
    fixed = [edge for _, edge in rig.fixed_edges()]
    kind, links, up = shared.of(_mechanism, [rig.mechanism], rig, shared)
    edge_rows, data = shared.of(_edges, [*valve_parts, *fixed], rig, names, maps or {})
    valve_rows, elements = shared.of(_valves, [*valve_parts, *rig.dynamics.values()], rig, names)
    return Plant(
        kind=kind,
        gravity=float(rig.gravity) * np.array(up),
        links=links,
        cylinders=_cylinders(rig, names, kind, links),
        nodes=shared.of(_nodes, [rig.supply], rig, names),
        valves=valve_rows,
        elements=elements,
        edges=edge_rows,
        maps=data,
        supply=shared.of(_supply, [rig.supply, rig.oil], rig),
        forces=shared.of(_forces, [force for c in rig.cylinder for force in c.force], rig, names),
        lines=_lines(rig, names),
        at=shared.of(Layout.offsets, [], names),
    )


def links_of(rig: Rig) -> np.recarray:
    """The links of a rig with its payload, or its slide."""
    return _mechanism(rig, Kept())[1]


def load_of(rig: Rig, cylinder: int) -> float:
    """Smallest mass [kg] that a cylinder moves over its stroke, other joints free."""
    kind, links, _ = _mechanism(rig, Kept())
    return 1.0 / float(_cylinders(rig, layout(rig), kind, links)[cylinder].mobility)


def _mechanism(rig: Rig, shared: Kept) -> tuple[int, np.recarray, tuple[float, float, float]]:
    """(kind, links, the base-frame direction that points up)."""
    body = rig.mechanism
    if isinstance(body, Slide):
        link = arm.pack_slide(float(body.mass), float(body.damping), float(body.incline))
        return arm.SLIDE, table_of([link], arm.LINK), (0.0, 0.0, 1.0)
    links = table_of([shared.of(_link, [joint], joint) for joint in body.joint], arm.LINK)
    up = (0.0, 0.0, 1.0) if body.first_axis == "vertical" else (0.0, 1.0, 0.0)
    return arm.CHAIN, links, up


def _link(joint: Joint) -> dict[str, Any]:
    xx, yy, zz, xy, xz, yz = joint.inertia.value
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    frame = float(joint.dh_a), float(joint.dh_d), float(joint.dh_alpha), float(joint.dh_theta)
    return arm.pack_link(
        *frame, float(joint.mass), joint.com.value, inertia, float(joint.joint_damping)
    )


def _cylinders(rig: Rig, names: Layout, kind: int, links: np.recarray) -> np.recarray:
    rows, bodies = [], links.copy()
    bodies["damping"] = 0.0  # which is no part of how heavy they are
    for index, item in enumerate(rig.cylinder):
        head, rod = item.areas()
        relief, pins = item.relief_pressure, pins_of(item)
        joint = names.joints.index(item.joint)
        numbers = {key: float(getattr(item, key)) for key in CYLINDER_FIELDS}
        mobility, free = _mobility(kind, bodies.tobytes(), pins, joint, numbers["stroke"])
        pressed = float(rig.supply.pressure)  # a piston into its end stop
        if rig.supply.accumulator is not None and relief is not None:
            pressed = max(pressed, float(relief))  # a pump may bring a charge line up to it
        rows.append(
            numbers
            | oil_fields(rig, item.bulk_modulus)
            | friction.LAWS[names.frictions[index]].pack(item)
            | dict(zip(PINS_OF, pins, strict=True))
            | {
                "joint": joint,
                "area_head": head,
                "area_rod": rod,
                "relief_pressure": math.inf if relief is None else float(relief),
                "cavitation_pressure": float(rig.oil.cavitation_pressure),
                "stop_stiffness": pressed * head / STOP_DEPTH,
                "mobility": mobility,
                "joint_mobility": free,
                "node_head": names.node(index, "head"),
                "node_rod": names.node(index, "rod"),
                "friction": names.frictions[index],
                "friction_state": names.friction_state(index),
                "friction_states": len(friction.LAWS[names.frictions[index]].states),
                "mount_state": -1,
                "sway_state": -1,
                "tied_position": -1,
                "tied_rate": -1,
            }
        )
        if item.mount is not None:
            rows[-1] |= {"mount_state": names.state("mount_deflection", index)} | item.mount.row()
        if item.sway is not None:
            rows[-1] |= {"sway_state": names.state("sway", index)} | item.sway.row()
    return table_of(rows, CYLINDER)


def pins_of(item: Cylinder) -> PinNumbers:
    """Arguments of `ehbench.physics.cylinder.linkage` before the angle."""
    pins, rack = item.pins, item.rack
    if rack is not None:
        ends = float(rack.radius), 0.0, float(rack.sign), 0.0, float(rack.retracted_angle)
        return (RACK, *ends)
    if pins is None:
        return (DIRECT, 0.0, 0.0, 0.0, 0.0, 0.0)
    lengths, phase = (float(pins.l_a), float(pins.l_b)), float(pins.phase)
    return (PINS, *lengths, float(pins.sign), phase, float(pins.retracted_length))


@lru_cache(maxsize=64)
def _mobility(
    kind: int, packed: bytes, pins: PinNumbers, joint: int, stroke: float
) -> tuple[float, float]:
    """Largest acceleration at the cylinder per force on it [1/kg], and of its joint per torque
    [1/(kg·m²)], over its stroke, the other joints at zero and free.

    Args:
        packed: bytes of the links, without damping. Fits make many plants of one mechanism.
    """
    links = np.frombuffer(packed, arm.LINK).copy().view(np.recarray)
    n = links.shape[0]
    angles = joint_angle(*pins, np.linspace(0.0, stroke, 5))
    mass, work, q = np.empty((angles.size, n, n)), np.empty(arm.work_size(n)), np.zeros(n)
    for item, angle in zip(mass, angles, strict=True):
        q[joint] = angle
        arm.mass_matrix(kind, links, q, item, work)
    free = np.linalg.inv(mass)[:, joint, joint].tolist()
    levers = (linkage(*pins, angle)[1] for angle in angles.tolist())
    return max(lever**2 * per for lever, per in zip(levers, free, strict=True)), max(free)


def _nodes(rig: Rig, names: Layout) -> np.recarray:
    rows = [
        {"state": names.state("p_supply"), "cylinder": -1},
        {"state": -1, "pressure": float(rig.supply.tank_pressure), "cylinder": -1},
    ]
    for index in range(len(names.cylinders)):
        rows += [
            {"state": names.state(f"p_{end}", index), "cylinder": index, "side": side}
            for side, end in enumerate(SIDES)
        ]
    rows = [row | {"line": -1} for row in rows]
    rows += [
        {"state": names.state(f"p_line_{end}", index), "cylinder": index, "line": number}
        for number, (index, end) in enumerate(names.lines)
    ]
    return table_of(rows, NODE)


def _lines(rig: Rig, names: Layout) -> np.recarray:
    rows = []
    items = ((item, line) for item in rig.cylinder for line in item.line)
    for (index, end), (item, line) in zip(names.lines, items, strict=True):
        gain = line.orifice_gain
        row = {
            "node": names.port(index, end),
            "chamber": names.node(index, end),
            "cylinder": index,
            "volume": float(line.volume),
            "resistance": float(line.resistance or 0.0),
            "choke": 0.0 if gain is None else float(gain) ** -2,
            "relief_pressure": math.inf,
            "cavitation_pressure": float(rig.oil.cavitation_pressure),
        }
        rows.append(row | oil_fields(rig, line.bulk_modulus or item.bulk_modulus))
    return table_of(rows, LINE)


def _valves(rig: Rig, names: Layout) -> tuple[np.recarray, np.recarray]:
    rows, elements = [], []
    for index, (_, item) in enumerate(rig.valves()):
        first, output = len(elements), -1
        for element in (element for element in names.elements if element.valve == index):
            output, states = element.state, len(valves.LAWS[element.law].states)
            place = {"law": element.law, "state": output, "states": states}
            elements.append(place | rig.dynamics[element.dynamics].row())
        lowest, highest = item.given
        count = len(elements) - first
        late = sum(rig.dynamics[name].late() for name in item.series)
        ends = {"lowest": lowest, "highest": highest, "delay": late, "before": item.rest}
        rows.append(ends | {"first": first, "count": count, "output": output})
    return table_of(rows, VALVE), table_of(elements, ELEMENT)


def _edges(rig: Rig, names: Layout, maps: Maps) -> tuple[np.recarray, np.ndarray]:
    rows: list[dict[str, Any]] = []
    packed: list[tuple[FlowMap, float]] = []
    for name, (item, valve, edge) in zip(names.edges, rig.edges(), strict=False):
        cylinder, given = names.cylinders.index(item.name), map_of(maps, name)
        if edge.law == "pump" and given is not None:
            raise InputError(f"edge '{name}' of rig '{rig.name}' is a pump: no flow map is of it")
        if edge.law == "map" and given is None:
            raise InputError(
                f"edge '{valve.edge_name(edge)}' of rig '{rig.name}' follows a flow map, and none "
                "is given for it",
                hint="name a run with flow_maps",
            )
        row = {
            "from_node": names.port(cylinder, edge.from_),
            "to_node": names.port(cylinder, edge.to),
            "valve": names.valves.index(f"{item.name}.{valve.name}"),
            "sign": edge.sign,
            "blocked": edge.reverse == "blocked",
            "cracking_pressure": float(edge.cracking_pressure),
            "unmetered": not edges.edge_law(edge.law).metering,
        }
        row |= _law(edge, given, packed)
        if "deadband" in row:
            row["deadband"] = valve.onset(edge)
        rows.append(row)
    for item, edge in rig.fixed_edges():  # without a command
        cylinder = names.cylinders.index(item.name)
        row = {
            "from_node": names.port(cylinder, edge.from_),
            "to_node": names.port(cylinder, edge.to),
            "valve": -1,
            "sign": 1.0,
            "unmetered": 1,
            "pilot": -1 if edge.pilot is None else names.port(cylinder, edge.pilot),
        }
        rows.append(row | _law(edge, None, []))
    data, offsets = pack([item for item, _ in packed], [factor for _, factor in packed])
    for row in rows:
        for key in ("forward", "reverse"):
            row[key] = int(offsets[row[key]]) if row[key] >= 0 else -1
    return table_of(rows, EDGE), data


def map_of(maps: Maps | None, edge: str) -> ValveMaps | None:
    """The measured maps of an edge, by ``<cylinder>.<edge>`` or by ``<edge>`` alone."""
    maps = maps or {}
    return maps.get(edge) or maps.get(edge.split(".", 1)[1])


def _law(
    edge: Edge | FixedEdge, given: ValveMaps | None, packed: list[tuple[FlowMap, float]]
) -> dict[str, Any]:
    """Fields of an edge's law; its maps go to ``packed`` with the edge's factor."""
    law = edges.edge_law("map" if given is not None else edge.law)
    row = {"law": edges.BY_NAME[law.name], "forward": -1, "reverse": -1} | law.pack(edge)
    for key in ("forward", "reverse"):
        item = getattr(given, key, None)
        if item is not None:
            row[key] = len(packed)
            packed.append((item, float(edge.map_factor) if isinstance(edge, Edge) else 1.0))
    return row


def _forces(rig: Rig, names: Layout) -> np.recarray:
    rows = []
    for index, item in enumerate(rig.cylinder):
        for force in item.force:
            played = -1
            if force.channel is not None:
                played = len(names.valves) + names.played.index(force.channel)
            rows.append({"cylinder": index, "played": played} | force_fields(force))
    return table_of(rows, FORCE)


def _supply(rig: Rig) -> np.record:
    supply = rig.supply
    row: dict[str, float] = {"tied": -1}
    row |= {key: float(getattr(supply, key)) for key in ("pressure", "flow_limit", "volume")}
    if supply.load_sensing is not None:
        load = supply.load_sensing
        row |= {"margin": float(load.load_margin), "lag": float(load.load_lag)}
    if supply.low_rail is not None:
        low = supply.low_rail
        row |= {"rail": float(low.rail_pressure), "rail_margin": float(low.rail_margin)}
    if supply.accumulator is not None:
        row |= {key: float(getattr(supply.accumulator, key)) for key, _ in ACCUMULATOR}
    return table_of([row | oil_fields(rig)], SUPPLY_LINE)[0]


def oil_fields(rig: Rig, bulk_modulus: Value | None = None) -> dict[str, float]:
    """Fields of a row of oil, its bulk modulus ``bulk_modulus`` where given."""
    oil = rig.oil
    return {
        "bulk_modulus": float(bulk_modulus or oil.bulk_modulus),
        "air": float(oil.air_fraction or 0.0),
        "polytropic": float(oil.polytropic_exponent or EXPONENT),
    }
