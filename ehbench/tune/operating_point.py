"""Operating points: steady motions of one cylinder, of a working function at a posture, payload
and speed, with all other joints held (SPEC 3), and the state of the plant in them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control.functions import (
    DIRECTION,
    HEAD,
    METERED,
    METERING,
    OVERRUNNING,
    PATH_FLOWS,
    RAISED,
    SUPPLY_HEAD,
    SUPPLY_ROD,
    Circuit,
    coupled,
    path_drop,
    widest,
)
from ehbench.control.measured import Pressures
from ehbench.control.valve_level import pump_speed, top_speed
from ehbench.parts.cylinder import chamber_oil, joint_of, linkage_of
from ehbench.parts.edge import edge_command, edge_flow
from ehbench.parts.friction import friction_settle, friction_slope, friction_steady
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.parts.line import drop_for, line_conductance
from ehbench.parts.load import force_on
from ehbench.parts.mount import mount_settle
from ehbench.parts.supply import from_rail, sensed
from ehbench.parts.sway import sway_settle
from ehbench.parts.valve import valve_settle
from ehbench.physics.arm import gravity_torque, mass_matrix, work_size
from ehbench.plant.layout import SIDES
from ehbench.plant.model import Model
from ehbench.vocabulary import InputError, Message, message, setting
from ehbench.vocabulary.codes import FUNCTIONS

# what a path adds to the oil of (head, rod); its drop changes with their pressures by the negative
# of this
INTO = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (-1, 1), (1, -1), (1, 0), (0, 1)], dtype=float)
FED = {SUPPLY_HEAD: 0, SUPPLY_ROD: 1}  # paths from the supply, by the side to which they lead


@dataclass(frozen=True)
class OperatingPointSettings:
    """Numbers of the search for steady motions."""

    difference: float = setting(1.0e-5, "", "step of central differences", "rounding 1e-10")
    halvings: int = setting(12, "", "bisections of the full speed", "0.02 % of it")


POINT = OperatingPointSettings()


@dataclass(frozen=True)
class Equivalent:
    """What a joint and all it carries is to its cylinder over the stroke, other joints held (thesis
    B.1–B.4).

    Arrays over ``x`` [m]: joint coordinate ``q`` [rad], ``lever`` ∂x/∂q [m/rad], ``curvature``
    ∂lever/∂q [m/rad²], ``mass`` m_eq [kg], ``gravity_force`` F_eq [N], the cylinder force that
    carries the load at rest, ``damping`` b_eq [N·s/m]."""

    x: np.ndarray
    q: np.ndarray
    lever: np.ndarray
    curvature: np.ndarray
    mass: np.ndarray
    gravity_force: np.ndarray
    damping: np.ndarray


def equivalent(
    model: Model, cylinder: int, x: np.ndarray, posture: Mapping[str, str | float] | None = None
) -> Equivalent:
    """Equivalent mass, gravity force and damping of a cylinder over its stroke.

    ``m_eq = D_jj/lever²``, ``F_eq = c_j/lever``, ``b_eq = b_j/lever²`` (SPEC 3).

    Args:
        model: with its payload.
        cylinder: its number.
        x: strokes [m], shape (points,).
        posture: of the other joints, as `Model.posture`; mid-stroke by default."""
    plant = model.plant
    row = plant.cylinders[cylinder]
    joint = int(row.joint)
    q = model.posture(posture)
    n = q.size
    mass, gravity, work = np.empty((n, n)), np.empty(n), np.empty(work_size(n))
    table = np.empty((len(x), 6))
    for at, stroke in zip(table, x, strict=True):
        q[joint] = joint_of(row, stroke)
        _, lever, bend = linkage_of(row, q[joint])
        mass_matrix(plant.kind, plant.links, q, mass, work)
        gravity_torque(plant.kind, plant.links, plant.gravity, q, gravity, work)
        damping = plant.links[joint].damping
        at[:] = (
            q[joint],
            lever,
            bend,
            mass[joint, joint] / lever**2,
            gravity[joint] / lever,
            damping / lever**2,
        )
    return Equivalent(np.asarray(x, float), *table.T)


@dataclass(frozen=True)
class Path:
    """One path of a working function at an operating point.

    ``flow`` [m³/s] along it at ``drop`` [Pa], through ``edge`` of ``valve`` at ``command`` [V];
    ``slope`` ∂Q/∂Δp [m³/(s·Pa)] and ``gain`` ∂Q/∂opening [m³/(s·V)] there. ``metering`` marks the
    path that sets the motion. ``reachable``: the driver can open so far."""

    path: int
    edge: str
    valve: int
    flow: float
    drop: float
    command: float
    slope: float
    gain: float
    metering: bool
    reachable: bool


@dataclass(frozen=True)
class OperatingPoint:
    """A steady motion of one cylinder: working function, payload, stroke ``x`` [m] and speed ``v``
    [m/s], extension positive.

    ``mass, gravity_force, damping`` are m_eq, F_eq, b_eq of `equivalent`; ``friction`` [N·s/m] is
    the slope of the cylinder's own steady friction less that of forces on its rod; ``bend`` [1/s]
    the part of ∂v̇/∂v from the changing lever; ``load_force`` P_L [N]; pressures [Pa] gauge,
    ``p_supply`` that of the supply's line under this load; volumes [m³]. ``possible``: every drop
    is along its flow and every valve can open so far. ``fits``: also the off-side chamber stands at
    its set-point. ``note`` says what is missing, ``where`` stroke and speed in the units that
    people see."""

    cylinder: str
    function: str
    payload: str
    x: float
    v: float
    q: tuple[float, ...]
    lever: float
    mass: float
    gravity_force: float
    damping: float
    friction: float
    bend: float
    load_force: float
    p_head: float
    p_rod: float
    p_supply: float
    p_tank: float
    volume_head: float
    volume_rod: float
    paths: tuple[Path, ...]
    possible: bool
    fits: bool
    note: str = ""
    where: str = ""

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"{self.function}, {self.payload}, {self.where}"


@dataclass(frozen=True)
class Aim:
    """The steady motion that is requested.

    ``share``: speed as a share of the largest that the valves and the pump carry there; without
    it ``speed``: the speed itself, ≥ 0 [m/s]. ``low_pressure``: set-point of the off-side chamber
    above tank [Pa]. ``cross_drop``: planned drop of the seventh function [Pa]. ``payload``: what
    the model carries, by name. ``posture`` of the other joints, as `Model.posture`. ``sensed``: the
    highest pressure of other cylinders that a load-sensing pump senses [Pa]."""

    low_pressure: float
    cross_drop: float
    share: float | None = None
    speed: float = 0.0
    payload: str = "none"
    posture: Mapping[str, str | float] | None = None
    sensed: float = -math.inf


@dataclass(frozen=True)
class _Settled:
    """What a speed needs: load force [N], pressures [Pa], what had to give for them."""

    force: float
    p_head: float
    p_rod: float
    note: Message | None = None


@dataclass(frozen=True)
class _Motion:
    """A working function at a posture, ``here.x[index]``, at any speed v [m/s]."""

    model: Model
    circuit: Circuit
    function: int
    here: Equivalent
    index: int
    aim: Aim

    @property
    def row(self) -> Any:
        """The cylinder's row."""
        return self.model.plant.cylinders[self.circuit.cylinder]

    @property
    def p_tank(self) -> float:
        """Pressure of the tank [Pa]."""
        return self.model.plant.tank_pressure

    @property
    def fed(self) -> int | None:
        """The side that the supply feeds, None where it feeds none."""
        at_work = PATH_FLOWS[self.function].any(axis=1)
        return next((side for path, side in FED.items() if at_work[path]), None)

    def at_ports(self, p_head: float, p_rod: float) -> Pressures:
        """Pressures between which the edges stand [Pa], the supply's as it is in steady motion."""
        load = self.p_tank if self.fed is None else (p_head, p_rod)[self.fed]
        line = sensed(max(load, self.p_tank, self.aim.sensed), self.model.plant.supply)
        return Pressures(p_head, p_rod, line, self.p_tank)

    def railed(self, at: Pressures) -> bool:
        """Whether the side that the supply feeds takes from the low rail."""
        if self.fed is None:
            return False
        return bool(from_rail((at.head, at.rod)[self.fed], self.model.plant.supply))

    @property
    def together(self) -> bool:
        """Whether one command serves both ends."""
        return coupled(self.circuit, self.function)

    def ports(self, v: float, p_head: float, p_rod: float) -> tuple[Pressures, np.ndarray]:
        """What the edges stand between at chamber pressures [Pa], and the flow along each path
        [m³/s] that keeps both chambers steady (thesis 2.4, 2.5); a line's drop lies between."""
        row, p_tank = self.row, self.p_tank
        across = row.leakage_internal * (p_head - p_rod)
        q_head = row.area_head * v + across + row.leakage_head * (p_head - p_tank)
        q_rod = row.area_rod * v + across - row.leakage_rod * (p_rod - p_tank)
        at, into = [p_head, p_rod], (q_head, -q_rod)
        for (cylinder, end), line in zip(
            self.model.layout.lines, self.model.plant.lines, strict=True
        ):
            if cylinder == self.circuit.cylinder:
                at[SIDES.index(end)] += drop_for(into[SIDES.index(end)], line)
        return self.at_ports(*at), PATH_FLOWS[self.function] @ (q_head, q_rod)

    def chambers(self, force: float, off: float) -> tuple[float, float]:
        """(p_head, p_rod) [Pa] that carry the force with the off-side at ``off``."""
        head, rod = self.row.area_head, self.row.area_rod
        if METERED[self.function] == HEAD:
            return (force + rod * off) / head, off
        return off, (head * off - force) / rod

    def resistance(self, v: float) -> float:
        """What friction takes and no force from outside gives [N]."""
        return friction_steady(self.row, v) - self.push(v)

    def push(self, v: float) -> float:
        """Force from outside on the rod [N], positive pushes it out."""
        stroke, plant, played = float(self.here.x[self.index]), self.model.plant, np.zeros(0)
        return float(force_on(self.circuit.cylinder, stroke, v, played, plant))

    def push_slope(self, v: float) -> float:
        """Slope [N·s/m] of the outer forces on the rod at speed v, by central differences."""
        around = POINT.difference * max(abs(v), COULOMB_SPEED)
        return float((self.push(v + around) - self.push(v - around)) / (2 * around))

    def settle(self, v: float) -> _Settled:
        """What carries the motion at speed v."""
        here, i, row, p_tank = self.here, self.index, self.row, self.p_tank
        bend = here.curvature[i] * v * v / here.lever[i] ** 2
        force = here.gravity_force[i] + here.damping[i] * v - here.mass[i] * bend
        force += self.resistance(v)
        if RAISED[self.function]:
            cross = self.aim.cross_drop
            p_head = (force + cross * row.area_rod) / (row.area_head - row.area_rod)
            return _Settled(force, p_head, p_head + cross)
        off = p_tank + self.aim.low_pressure
        if v != 0.0 and self.together:
            off = self.common_opening(v, force)
        pressures = self.chambers(force, off)
        if min(pressures) >= p_tank:
            return _Settled(force, *pressures)
        other = p_tank + self.aim.low_pressure
        if METERED[self.function] == HEAD:
            off = (row.area_head * other - force) / row.area_rod
        else:
            off = (force + row.area_rod * other) / row.area_head
        note = message("tune.raised", pressure=self.model.rig.text("p_rod", off, 0))
        return _Settled(force, *self.chambers(force, off), note)

    def common_opening(self, v: float, force: float) -> float:
        """Off-side pressure [Pa] at which one opening passes both flows: on the low rail, else on
        the line."""

        from scipy.optimize import brentq

        circuit, lead = self.circuit, int(METERING[self.function])
        at_work = map(int, np.flatnonzero(PATH_FLOWS[self.function].any(axis=1)))
        follow = next(path for path in at_work if path != lead)

        def ports(off: float) -> tuple[Pressures, np.ndarray]:
            return self.ports(v, *self.chambers(force, off))

        def surplus(off: float) -> float:
            """Flow beyond the required one at the other end of the opening [m³/s]."""
            at, need = ports(off)
            command = _command(circuit, lead, need[lead], max(path_drop(lead, at, circuit), 1.0))
            return _flow(circuit, follow, path_drop(follow, at, circuit), command) - need[follow]

        low, high = self.p_tank, self.model.plant.supply.pressure
        ends = [low + 1.0, high - 1.0]
        if self.railed(ports(ends[0])[0]) and not self.railed(ports(ends[1])[0]):
            first, last = ends  # about the pressure above which the low rail is not enough
            while first < (middle := 0.5 * (first + last)) < last:
                railed = self.railed(ports(middle)[0])
                first, last = (middle, last) if railed else (first, middle)
            ends[1:1] = first, last
        for first, last in zip(ends[::2], ends[1::2], strict=True):
            if not surplus(first) * surplus(last) > 0.0:
                root: Any = brentq(surplus, first, last, rtol=np.float64(1e-14))
                return float(root)
        return low if abs(surplus(ends[0])) < abs(surplus(ends[-1])) else high

    def give(self, v: float, settled: _Settled) -> float:
        """How far the mount has given way [m]."""
        if self.row.mount_state < 0:
            return 0.0
        return (settled.force - friction_steady(self.row, v)) / self.row.mount_stiffness

    def misfit(self, way: float, settled: _Settled) -> Message | None:
        """Why the working function does not fit this motion."""
        if OVERRUNNING[self.function] != (-way * settled.force > 0.0) and not settled.note:
            return message("tune.wrong_load")
        return settled.note

    def paths(self, v: float, settled: _Settled) -> tuple[Path, ...]:
        """The paths at work at speed v."""
        circuit, function, names = self.circuit, self.function, self.model.layout.edges
        pressures, need = self.ports(v, settled.p_head, settled.p_rod)
        paths = [
            _path(circuit, function, p, need[p], path_drop(p, pressures, circuit), names)
            for p in map(int, np.flatnonzero(PATH_FLOWS[function].any(axis=1)))
        ]
        if self.together:
            lead = next(p for p in paths if p.metering)
            paths = [
                _path(circuit, function, p.path, p.flow, p.drop, names, lead.command) for p in paths
            ]
        return tuple(paths)

    def troubles(self, v: float, settled: _Settled, paths: Sequence[Path]) -> list[Message]:
        """What is impossible."""
        results = [message("tune.no_drop", edge=p.edge) for p in paths if not p.drop > 0.0]
        blocked = [p.edge for p in paths if p.drop > 0.0 and not p.reachable]
        results += [message("tune.no_flow", edge=edge) for edge in blocked]
        if max(settled.p_head, settled.p_rod) > self.row.relief_pressure:
            results.append(message("tune.relief"))
        if self.short(v, settled, paths):
            results.append(message("tune.short_pump"))
        return results

    def short(self, v: float, settled: _Settled, paths: Sequence[Path]) -> bool:
        """Whether the pump of the high one of two rails cannot bring the required flow."""
        supply = self.model.plant.supply
        if supply.rail == 0.0 or self.railed(self.ports(v, settled.p_head, settled.p_rod)[0]):
            return False
        return sum(path.flow for path in paths if path.path in FED) > supply.flow_limit

    def impossible(self, v: float) -> bool:
        """Whether speed v is."""
        settled = self.settle(v)
        return bool(self.troubles(v, settled, self.paths(v, settled)))

    def largest_speed(self) -> float:
        """The largest speed that valves and pump carry, ≥ 0 [m/s]."""
        way, rest = DIRECTION[self.function], self.settle(0.0)
        pressures = self.at_ports(rest.p_head, rest.p_rod)
        top = top_speed(self.function, pressures, self.circuit)
        if not self.railed(pressures):
            top = min(top, pump_speed(self.function, self.circuit))
        if not self.impossible(way * top):
            return top
        low = 0.0
        for _ in range(POINT.halvings):
            middle = 0.5 * (low + top)
            low, top = (low, middle) if self.impossible(way * middle) else (middle, top)
        return low


def operating_point(
    model: Model, circuit: Circuit, function: int, here: Equivalent, index: int, aim: Aim
) -> OperatingPoint:
    """The steady motion of a working function at posture ``here.x[index]``.

    The off-side chamber stands at ``low_pressure`` above tank; in the seventh function at
    ``cross_drop`` above the head end; with one command for both ends, where the common opening puts
    it. The other chamber carries ``F_eq + (b_eq + friction) v``. Where that would need less than
    tank pressure, the off-side is raised until the metered chamber stands at ``low_pressure``, and
    the point does not fit.

    Args:
        model: with its payload.
        circuit: of the cylinder, which can do ``function``.
        function: index into FUNCTIONS, not hold.
        here: of `equivalent`, with ``aim.posture``.
        index: into ``here``.
        aim: what is requested.

    Raises:
        InputError: a function that the circuit cannot do, or a force played from a log."""
    _check(model, circuit, function)
    motion = _Motion(model, circuit, function, here, index, aim)
    row, way = motion.row, DIRECTION[function]
    speed = motion.largest_speed() * aim.share if aim.share is not None else aim.speed
    v = way * float(speed)
    settled = motion.settle(v)
    paths = motion.paths(v, settled)
    troubles, note = motion.troubles(v, settled, paths), motion.misfit(way, settled)
    q, x = model.posture(aim.posture), here.x[index] + motion.give(v, settled)
    q[row.joint] = here.q[index]
    return OperatingPoint(
        cylinder=model.layout.cylinders[circuit.cylinder],
        function=FUNCTIONS[function],
        payload=aim.payload,
        x=float(here.x[index]),
        v=float(v),
        q=tuple(map(float, q)),
        lever=float(here.lever[index]),
        mass=float(here.mass[index]),
        gravity_force=float(here.gravity_force[index]),
        damping=float(here.damping[index]),
        friction=float(friction_slope(row, v)) - motion.push_slope(v),
        bend=float(2.0 * here.curvature[index] * v / here.lever[index] ** 2),
        load_force=float(settled.force),
        p_head=float(settled.p_head),
        p_rod=float(settled.p_rod),
        p_supply=float(motion.ports(v, settled.p_head, settled.p_rod)[0].supply),
        p_tank=float(motion.p_tank),
        volume_head=float(chamber_oil(row, 0, x)),
        volume_rod=float(chamber_oil(row, 1, x)),
        paths=paths,
        possible=not troubles,
        fits=not troubles and not note,
        note="; ".join([*([note] if note else []), *troubles]),
        where=f"x = {model.rig.text('x', here.x[index], 0)}, v = {model.rig.text('v', v, 0, '+')}",
    )


def _check(model: Model, circuit: Circuit, function: int) -> None:
    """Refuse forces from a log, and functions that the circuit cannot do."""
    if model.layout.played:
        force = model.layout.played[0]
        raise InputError(message("tune.played_force", rig=model.rig.name, force=force))
    if function < 1 or circuit.able[function] == 0:
        cylinder, name = model.layout.cylinders[circuit.cylinder], FUNCTIONS[function]
        raise InputError(message("tune.unable", cylinder=cylinder, function=name))


def _flow(circuit: Circuit, path: int, drop: float, command: float) -> float:
    """Flow [m³/s] along a path at a drop [Pa] along it and an opening [V]."""
    edge, along = circuit.paths[path], circuit.along[path]
    return along * edge_flow(along * drop, command, circuit.edges[edge], circuit.maps)


def _command(circuit: Circuit, path: int, flow: float, drop: float) -> float:
    """Command [V] at which a path passes a flow [m³/s] at a drop [Pa], both along it."""
    edge, along = circuit.paths[path], circuit.along[path]
    return edge_command(along * drop, along * flow, circuit.edges[edge], circuit.maps)


def _path(
    circuit: Circuit,
    function: int,
    path: int,
    flow: float,
    drop: float,
    names: tuple[str, ...],
    command: float | None = None,
) -> Path:
    """A path at a flow and drop along it; at ``command`` where another path decides it."""
    if command is None:
        command = _command(circuit, path, flow, drop)
    edge, dp, du = (
        int(circuit.paths[path]),
        POINT.difference * max(abs(drop), 1e4),
        POINT.difference * max(abs(command), 0.1),
    )
    slope = (
        _flow(circuit, path, drop + dp, command) - _flow(circuit, path, drop - dp, command)
    ) / (2 * dp)
    gain = (_flow(circuit, path, drop, command + du) - _flow(circuit, path, drop, command - du)) / (
        2 * du
    )
    maximum, sign = widest(circuit, edge, circuit.along[path] * drop), circuit.edges[edge].sign
    passes = _flow(circuit, path, drop, command) >= flow * (1 - 1e-6)
    saturated = gain == 0.0 and flow != 0.0  # or shut, as leakage passes more than the flow
    reachable = passes and not saturated and sign * command <= sign * maximum * (1 + 1e-9)
    return Path(
        int(path),
        names[edge],
        int(circuit.edges[edge].valve),
        float(flow),
        float(drop),
        float(command),
        float(slope),
        float(gain),
        bool(path == METERING[function]),
        bool(reachable),
    )


class Hose(NamedTuple):
    """A line: ``side`` of its end, place of its ``state``, ``row``, ``drop`` [Pa] towards the
    chamber."""

    side: int
    state: int
    row: Any
    drop: float

    @property
    def slope(self) -> float:
        """Of its flow over its drop [m³/(s·Pa)]."""
        dp = POINT.difference * max(abs(self.drop), 1e4)
        more, less = self.drop + dp, self.drop - dp
        gained = more * line_conductance(more, self.row)
        return (gained - less * line_conductance(less, self.row)) / (2 * dp)


def hoses_of(model: Model, point: OperatingPoint) -> list[Hose]:
    """The lines of the point's cylinder."""
    index = model.layout.cylinders.index(point.cylinder)
    into = sum((path.flow * INTO[path.path] for path in point.paths), np.zeros(2))
    hoses = []
    for (cylinder, end), row in zip(model.layout.lines, model.plant.lines, strict=True):
        if cylinder == index:
            side, state = SIDES.index(end), model.layout.state(f"p_line_{end}", index)
            hoses.append(Hose(side, state, row, drop_for(float(into[side]), row)))
    return hoses


def state_of(model: Model, point: OperatingPoint) -> tuple[np.ndarray, np.ndarray]:
    """(plant state, commands [V]) of the steady motion; other cylinders stand, valves shut."""
    names = model.layout
    index = names.cylinders.index(point.cylinder)
    y = model.trim(np.array(point.q))
    command = model.rest_commands(1)[0]
    y[names.state("qd", int(model.plant.cylinders[index].joint))] = point.v / point.lever
    y[names.state("p_head", index)], y[names.state("p_rod", index)] = point.p_head, point.p_rod
    y[model.plant.at.supply] = point.p_supply
    for path in point.paths:
        command[path.valve] = path.command
        valve_settle(model.plant.valves[path.valve], path.command, model.plant, y)
    friction_settle(model.plant.cylinders[index], point.v, y)
    for hose in hoses_of(model, point):
        y[hose.state] = (point.p_head, point.p_rod)[hose.side] + hose.drop
    mount_settle(model.plant.cylinders[index], point.v, y, model.plant)
    sway_settle(model.plant.cylinders[index], point.v, y)
    return y, command
