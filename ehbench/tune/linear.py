"""Linear models of one cylinder about steady motions: from the equations, and from the compiled
plant (SPEC 3).

All other joints are held. An operating point is a steady motion of a working function at a posture,
payload and speed; its linear model has the states ``v, p_head, p_rod``, then ``opening`` and
``rate`` of each valve at work, in SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ehbench.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.control.functions import (
    DIRECTION,
    HEAD,
    METERED,
    METERING,
    OVERRUNNING,
    PATH_FLOWS,
    Circuit,
    circuit,
    coupled,
    path_drop,
    supply_draw,
    widest,
)
from ehbench.control.measured import Pressures
from ehbench.control.valve_level import top_speed
from ehbench.errors import InputError
from ehbench.parts.cylinder import chamber_oil, joint_of, linkage_of
from ehbench.parts.edge import edge_command, edge_flow
from ehbench.parts.friction import friction_steady
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.parts.load import force_on
from ehbench.parts.oil import bulk_of
from ehbench.parts.valve import valve_settle
from ehbench.physics.arm import gravity_torque, mass_matrix, work_size
from ehbench.plant.build import Maps, map_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.model import Model

# what a path adds to the oil of (head, rod); its drop changes with their pressures by the negative
# of this
INTO = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (-1, 1), (1, -1)], dtype=float)
DIFFERENCE = (
    1.0e-5  # relative step of central differences: their error and the rounding are both near 1e-10
)
SPEED_HALVINGS = 12  # to find the full speed to 0.02 %
AT_ZERO = 1.0e-7  # share of the fastest pole below which a pole is one at zero
DELAY_ORDER = 2  # of the Padé form of the delay; its phase is exact to 1e-4 rad up to ω·delay = 0.8


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
    model: Model, cylinder: int, x: np.ndarray, held: Mapping[str, str | float] | None = None
) -> Equivalent:
    """Equivalent mass, gravity force and damping of a cylinder over its stroke.

    ``m_eq = D_jj/lever²``, ``F_eq = c_j/lever``, ``b_eq = b_j/lever²`` (SPEC 3).

    Args:
        model: with its payload.
        cylinder: its number.
        x: strokes [m], shape (points,).
        held: posture of the other joints, as `Model.posture`; mid-stroke by default.
    """
    plant = model.plant
    row = plant.cylinders[cylinder]
    joint = int(row.joint)
    q = model.posture(held)
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
    the slope of the cylinder's own friction less that of forces on its rod; ``bend`` [1/s] the part of ∂v̇/∂v from the changing
    lever; ``load_force`` P_L [N]; pressures [Pa] gauge; volumes [m³]. ``possible``: every drop is
    along its flow and every valve can open so far. ``fits``: also the off-side chamber stands at
    its set-point. ``note`` says what is missing."""

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

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"{self.function}, {self.payload}, x = {self.x * 1e3:.0f} mm, v = {self.v * 1e3:+.0f} mm/s"


def circuit_of(model: Model, cylinder: int, maps: Maps | None = None) -> Circuit:
    """The circuit of a cylinder as controllers take it, from a model and the measured maps it was
    built on.
    """
    plant = model.plant
    measured = [map_of(maps, name) for name in model.layout.edges]
    row = plant.cylinders[cylinder]
    ranges = np.column_stack([plant.valves.lowest, plant.valves.highest])
    return circuit(
        cylinder,
        row.area_head,
        row.area_rod,
        plant.edges,
        plant.maps,
        ranges,
        measured,
    )


def operating_point(
    model: Model,
    circuit: Circuit,
    function: int,
    here: Equivalent,
    index: int,
    *,
    share: float | None = None,
    speed: float | None = None,
    low_pressure: float,
    cross_drop: float,
    payload: str = "none",
    held: Mapping[str, str | float] | None = None,
) -> OperatingPoint:
    """The steady motion of a working function at posture ``here.x[index]``.

    The off-side chamber stands at ``low_pressure`` above tank; in the seventh function at
    ``cross_drop`` above the head end; with one command for both ends, where the common opening puts
    it. The other chamber carries ``F_eq + (b_eq + friction) v``. Where that would need less than
    tank pressure, the off-side is raised until the metered chamber stands at ``low_pressure``, and
    the point does not fit.

    Args:
        model: with its payload.
        circuit: of the cylinder, able of ``function``.
        function: index into FUNCTIONS, not hold.
        here: of `equivalent`, with ``held``.
        index: into ``here``.
        share: speed as a share of the largest that the valves and the pump carry there, or
        speed: the speed [m/s] itself, ≥ 0.
        low_pressure: set-point of the off-side chamber above tank [Pa].
        cross_drop: planned drop of the seventh function [Pa].

    Raises:
        InputError: neither or both of share and speed, or a function that the circuit is not able
            of, or a force on its rod that is played from a log.
    """
    if model.layout.played:
        raise InputError(
            f"rig '{model.rig.name}' plays the force '{model.layout.played[0]}' from a log, and a "
            "steady motion knows no log",
            hint="give [[cylinder.force]] another kind for tuning",
        )
    if (share is None) == (speed is None):
        raise InputError("an operating point takes a speed or a share of the full speed")
    if function < 1 or circuit.able[function] == 0:
        raise InputError(f"the valves of the cylinder are not able of '{FUNCTIONS[function]}'")
    plant = model.plant
    row = plant.cylinders[circuit.cylinder]
    areas = row.area_head, row.area_rod
    head = METERED[function] == HEAD
    way = DIRECTION[function]
    p_supply, p_tank = plant.supply.pressure, plant.tank_pressure
    leaks = row.leakage_internal, row.leakage_head, row.leakage_rod

    def flows(v: float, p_head: float, p_rod: float) -> np.ndarray:
        """Flow along each path [m³/s] that keeps both chambers steady (thesis 2.4, 2.5)."""
        across = leaks[0] * (p_head - p_rod)
        q_head = areas[0] * v + across + leaks[1] * (p_head - p_tank)
        q_rod = areas[1] * v + across - leaks[2] * (p_rod - p_tank)
        return PATH_FLOWS[function] @ (q_head, q_rod)

    def chambers(force: float, off: float) -> tuple[float, float]:
        """(p_head, p_rod) [Pa] that carry the force with the off-side at ``off``."""
        return (
            ((force + areas[1] * off) / areas[0], off)
            if head
            else (off, (areas[0] * off - force) / areas[1])
        )

    def resistance(v: float) -> float:
        """What friction takes and no force from outside gives [N]."""
        stroke, none = float(here.x[index]), np.zeros(0)
        return friction_steady(row, v) - force_on(circuit.cylinder, stroke, v, none, plant)

    def settle(v: float) -> tuple[float, float, float, str]:
        """(load force, p_head, p_rod, what had to give) at speed v."""
        bend = here.curvature[index] * v * v / here.lever[index] ** 2
        force = here.gravity_force[index] + here.damping[index] * v - here.mass[index] * bend
        force += resistance(v)
        if function == EXTEND_RESISTIVE_REGENERATION:
            p_head = (force + cross_drop * areas[1]) / (areas[0] - areas[1])
            return force, p_head, p_head + cross_drop, ""
        off = p_tank + low_pressure
        if v != 0.0 and together:
            off = _common_opening(
                circuit,
                function,
                lambda p: (*chambers(force, p), p_supply, p_tank),
                lambda *p: flows(v, *p),
            )
        note = ""
        p_head, p_rod = chambers(force, off)
        if min(p_head, p_rod) < p_tank:
            other = p_tank + low_pressure
            off = (
                (force + areas[1] * other) / areas[0]
                if not head
                else (areas[0] * other - force) / areas[1]
            )
            note = f"the load does not suit this function: off-side raised to {off / 1e3:.0f} kPa to keep the metered chamber full"
            p_head, p_rod = chambers(force, off)
        return force, p_head, p_rod, note

    def at(v: float) -> tuple[tuple[float, float, float, str], tuple[Path, ...], list[str]]:
        """(what `settle` says, paths, what is impossible) at speed v."""
        settled = settle(v)
        need = flows(v, *settled[1:3])
        drops = [path_drop(p, Pressures(*settled[1:3], p_supply, p_tank)) for p in used]
        paths = [
            _path(circuit, function, p, need[p], drop, names)
            for p, drop in zip(used, drops, strict=True)
        ]
        if together:
            lead = next(p for p in paths if p.metering)
            paths = [
                _path(circuit, function, p.path, p.flow, p.drop, names, lead.command) for p in paths
            ]
        troubles = [f"{p.edge} has no drop along its flow" for p in paths if not p.drop > 0.0]
        troubles += [
            f"{p.edge} cannot pass its flow" for p in paths if p.drop > 0.0 and not p.reachable
        ]
        if max(settled[1:3]) > row.relief_pressure:
            troubles.append("a relief valve would open")
        return settled, tuple(paths), troubles

    names, together = model.layout.edges, coupled(circuit, function)
    used = np.flatnonzero(PATH_FLOWS[function].any(axis=1))
    if speed is None:
        top = top_speed(function, Pressures(*settle(0.0)[1:3], p_supply, p_tank), circuit)
        drawn = supply_draw(function, circuit)
        top = min(top, plant.supply.flow_limit / drawn) if drawn > 0 else top
        if at(way * top)[2]:
            low = 0.0
            for _ in range(SPEED_HALVINGS):
                low, top = (
                    (low, 0.5 * (low + top))
                    if at(way * 0.5 * (low + top))[2]
                    else (0.5 * (low + top), top)
                )
            top = low
        speed = share * top
    v = way * float(speed)
    (force, p_head, p_rod, note), paths, troubles = at(v)
    if OVERRUNNING[function] != (-way * force > 0.0) and not note:
        note = "the load does not suit this function"
    q = model.posture(held)
    q[row.joint] = here.q[index]
    around = DIFFERENCE * max(abs(v), COULOMB_SPEED)
    slope = resistance(v + around) - resistance(v - around)
    return OperatingPoint(
        cylinder=model.layout.cylinders[circuit.cylinder],
        function=FUNCTIONS[function],
        payload=payload,
        x=float(here.x[index]),
        v=float(v),
        q=tuple(map(float, q)),
        lever=float(here.lever[index]),
        mass=float(here.mass[index]),
        gravity_force=float(here.gravity_force[index]),
        damping=float(here.damping[index]),
        friction=float(slope / (2 * around)),
        bend=float(2.0 * here.curvature[index] * v / here.lever[index] ** 2),
        load_force=float(force),
        p_head=float(p_head),
        p_rod=float(p_rod),
        p_supply=float(p_supply),
        p_tank=float(p_tank),
        volume_head=float(chamber_oil(row, 0, here.x[index])),
        volume_rod=float(chamber_oil(row, 1, here.x[index])),
        paths=paths,
        possible=not troubles,
        fits=not troubles and not note,
        note="; ".join([note] * bool(note) + troubles),
    )


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
    """A path of a function at a flow and drop along it; at ``command`` where another path decides
    it.
    """
    if command is None:
        command = _command(circuit, path, flow, drop)
    edge, dp, du = (
        int(circuit.paths[path]),
        DIFFERENCE * max(abs(drop), 1e4),
        DIFFERENCE * max(abs(command), 0.1),
    )
    slope = (
        _flow(circuit, path, drop + dp, command) - _flow(circuit, path, drop - dp, command)
    ) / (2 * dp)
    gain = (_flow(circuit, path, drop, command + du) - _flow(circuit, path, drop, command - du)) / (
        2 * du
    )
    most, sign = widest(circuit, edge, circuit.along[path] * drop), circuit.edges[edge].sign
    passes = _flow(circuit, path, drop, command) >= flow * (1 - 1e-6)
    saturated = gain == 0.0 and flow > 0.0
    reachable = passes and not saturated and sign * command <= sign * most * (1 + 1e-9)
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


def _common_opening(circuit: Circuit, function: int, pressures, flows) -> float:
    """Off-side pressure [Pa] at which one opening passes both ends' flows."""
    from scipy.optimize import brentq

    lead = int(METERING[function])
    follow = next(p for p in np.flatnonzero(PATH_FLOWS[function].any(axis=1)) if p != lead)

    def excess(off: float) -> float:
        at = Pressures(*pressures(off))
        need = flows(at.head, at.rod)
        command = _command(circuit, lead, need[lead], max(path_drop(lead, at), 1.0))
        return _flow(circuit, follow, path_drop(follow, at), command) - need[follow]

    low, high = pressures(0.0)[3], pressures(0.0)[2]
    ends = excess(low + 1.0), excess(high - 1.0)
    if ends[0] * ends[1] > 0:
        return low if abs(ends[0]) < abs(ends[1]) else high
    return float(brentq(excess, low + 1.0, high - 1.0, xtol=1e-3, rtol=1e-14))


@dataclass(frozen=True)
class LinearModel:
    """``ẋ = A x + B u + E f`` about an operating point: u [V] the commands of the valves at work, f
    [N] a force on the rod.

    ``states`` name x: ``v, p_head, p_rod``, then ``opening, rate`` of each valve with dynamics; all
    SI. ``valves`` number u."""

    states: tuple[str, ...]
    valves: tuple[int, ...]
    a: np.ndarray
    b: np.ndarray
    e: np.ndarray


def _states(
    model: Model, point: OperatingPoint
) -> tuple[tuple[int, ...], list[int], tuple[str, ...]]:
    valves = tuple(dict.fromkeys(p.valve for p in point.paths))
    moving = [i for i in valves if model.plant.valves[i].count]
    names = ["v", "p_head", "p_rod"]
    for i in moving:
        names += [f"{model.layout.valves[i]}.opening", f"{model.layout.valves[i]}.rate"]
    return valves, moving, tuple(names)


def development_model(model: Model, point: OperatingPoint) -> LinearModel:
    """The linear development model from the equations (SPEC 3), valve edges with their own slopes.

    ``m_eq v̇ = A1 P1 − A2 P2 − (b_eq + friction) v + m_eq·bend·v + f``; ``V/β Ṗ`` = inflow of
    each chamber, volumes fixed, β of the oil at its pressure; ``Q = gain·opening + slope·Δp`` along each edge; valves of second
    order."""
    plant = model.plant
    row = plant.cylinders[model.layout.cylinders.index(point.cylinder)]
    valves, moving, names = _states(model, point)
    size = len(names)
    a, b, e = np.zeros((size, size)), np.zeros((size, len(valves))), np.zeros(size)
    areas = np.array([row.area_head, row.area_rod])
    a[0, :3] = (
        point.bend - (point.damping + point.friction) / point.mass,
        areas[0] / point.mass,
        -areas[1] / point.mass,
    )
    e[0] = 1.0 / point.mass
    stiff = np.array([bulk_of(row, point.p_head), bulk_of(row, point.p_rod)])
    stiff /= (point.volume_head, point.volume_rod)
    inflow = np.zeros((2, size))
    inflow[:, 0] = -areas[0], areas[1]
    inflow[0, 1:3] = -row.leakage_internal - row.leakage_head, row.leakage_internal
    inflow[1, 1:3] = row.leakage_internal, -row.leakage_internal - row.leakage_rod
    into_u = np.zeros((2, len(valves)))
    for path in point.paths:
        side = INTO[path.path]
        inflow[:, 1:3] -= path.slope * np.outer(side, side)
        if path.valve in moving:
            inflow[:, 3 + 2 * moving.index(path.valve)] += path.gain * side
        else:
            into_u[:, valves.index(path.valve)] += path.gain * side
    a[1:3], b[1:3] = stiff[:, None] * inflow, stiff[:, None] * into_u
    for k, i in enumerate(moving):
        at = 3 + 2 * k
        a[at, at + 1] = 1.0
        element = plant.elements[plant.valves[i].first]
        a[at + 1, at : at + 2] = -element.stiffness, -element.damping
        b[at + 1, valves.index(i)] = element.stiffness
    return LinearModel(names, valves, a, b, e)


def faster(linear: LinearModel, factor: float) -> LinearModel:
    """The model with valves ``factor`` times as fast at the same damping ratio."""
    a, b = linear.a.copy(), linear.b.copy()
    a[4::2], b[4::2] = a[4::2] * factor**2, b[4::2] * factor**2
    a[range(4, len(a), 2), range(4, len(a), 2)] /= factor
    return LinearModel(linear.states, linear.valves, a, b, linear.e)


def state_of(model: Model, point: OperatingPoint) -> tuple[np.ndarray, np.ndarray]:
    """(plant state, commands [V]) of the steady motion; other cylinders carry their loads, their
    valves shut.
    """
    names = model.layout
    index = names.cylinders.index(point.cylinder)
    y = model.trim(np.array(point.q))
    command = model.rest_commands(1)[0]
    y[names.state("qd", int(model.plant.cylinders[index].joint))] = point.v / point.lever
    y[names.state("p_head", index)], y[names.state("p_rod", index)] = point.p_head, point.p_rod
    for path in point.paths:
        command[path.valve] = path.command
        valve_settle(model.plant.valves[path.valve], path.command, model.plant, y)
    return y, command


def plant_model(
    model: Model,
    point: OperatingPoint,
    *,
    others: Literal["held", "free"] = "held",
    position: bool = False,
) -> LinearModel:
    """The same linear model from central differences of the compiled plant.

    With the other joints held their acceleration is zero, ``q̈_j = (D q̈)_j/D_jj`` with q̈ of the
    free plant; ``free`` leaves them to the reaction forces at this instant. ``position`` adds the
    stroke ``x`` as first state: what the development model leaves out."""
    plant, layout = model.plant, model.layout
    index = layout.cylinders.index(point.cylinder)
    row = plant.cylinders[index]
    joint = int(row.joint)
    valves, moving, names = _states(model, point)
    base, rest = state_of(model, point)
    n = len(layout.joints)
    at_qd, at_head = layout.state("qd", joint), layout.state("p_head", index)
    work = np.empty(plant.at.work)
    arm_work, mass, rate = np.empty(work_size(n)), np.empty((n, n)), np.empty(base.size)
    names = (("x",) if position else ()) + names
    picks = [(layout.state("opening", i), layout.state("rate", i)) for i in moving]

    def motion(z: np.ndarray) -> np.ndarray:
        """Rates of the reduced state for offsets z of (x, v, p_head, p_rod, openings and rates,
        commands).
        """
        y, u = base.copy(), rest.copy()
        y[joint] = joint_of(row, point.x + z[0]) if z[0] else base[joint]
        _, lever, bend = linkage_of(row, y[joint])
        y[at_qd] = (point.v + z[1]) / lever
        y[at_head : at_head + 2] += z[2:4]
        for k, (opening, speed) in enumerate(picks):
            y[opening] += z[4 + 2 * k]
            y[speed] += z[5 + 2 * k]
        u[list(valves)] += z[4 + 2 * len(picks) :]
        derivatives(y, u, plant, rate, work)
        acceleration = rate[at_qd]
        if others == "held":
            mass_matrix(plant.kind, plant.links, y[:n], mass, arm_work)
            acceleration = mass[joint] @ rate[n : 2 * n] / mass[joint, joint]
        out = [
            point.v + z[1],
            lever * acceleration + bend * y[at_qd] ** 2,
            rate[at_head],
            rate[at_head + 1],
        ]
        for opening, speed in picks:
            out += [rate[opening], rate[speed]]
        return np.array(out)

    steps = np.concatenate(
        [
            [1e-5, 1e-5 * max(1.0, abs(point.v) / 0.01), 30.0, 30.0],
            [1e-4, 1e-2] * len(picks),
            [1e-4] * len(valves),
        ]
    )
    columns = []
    for k, h in enumerate(steps):
        z = np.zeros(steps.size)
        z[k] = h
        columns.append((motion(z) - motion(-z)) / (2 * h))
    table = np.array(columns).T
    first, size = (0 if position else 1), 4 + 2 * len(picks)
    e = np.zeros(size - first)
    e[1 - first] = 1.0 / point.mass
    if others == "free":
        mass_matrix(plant.kind, plant.links, base[:n], mass, arm_work)
        e[1 - first] = point.lever**2 * np.linalg.inv(mass)[joint, joint]
    return LinearModel(names, valves, table[first:, first:size], table[first:, size:], e)


@dataclass(frozen=True)
class Law:
    """The pressure feedback in linear form: ``Q = A v_d − K_p F(s) P``, off-side ``Q = A v_d +
    off_gain·(set-point − P)``.

    ``washout`` ω_w and ``ramp_washout`` ω_r [rad/s], ``F = s/(s + ω_w)·s/(s + ω_r)``, 0 for none;
    ``off_gain`` [m³/(s·Pa)]; ``delay`` [s] from pressure to command; ``feedback`` the metered
    chamber's pressure, or the load force over the metered area."""

    washout: float
    off_gain: float
    delay: float
    ramp_washout: float = 0.0
    feedback: Literal["metered", "load"] = "metered"


@dataclass(frozen=True)
class Loop:
    """An operating point under the control law with K_p left open: ``ẋ = (a + K_p b c) x + d v_d +
    e f``, ``v = x[0]``.

    ``b`` is the feedback flow's way in, ``c`` what is fed back [Pa], so the root locus is that of
    ``1 + K_p L``, L = −c (s − a)⁻¹ b. ``off`` is the part of a that the off-side's pressure control
    makes, of rank one. Poles beyond ``fastest`` [rad/s] are those of the delay's Padé form. States
    are scaled; ``v`` stays in m/s."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    e: np.ndarray
    off: np.ndarray
    fastest: float

    def closed(self, gain: float | np.ndarray) -> np.ndarray:
        """State matrix at a gain [m³/(s·Pa)], or a stack of them."""
        return self.a + np.multiply.outer(np.asarray(gain), np.outer(self.b, self.c))

    def damping_ratio(self, gain: float | np.ndarray) -> np.ndarray:
        """Least damping ratio of the closed loop at a gain, or at each of several."""
        return damping_ratio(np.linalg.eigvals(self.closed(gain)), self.fastest)


def close(linear: LinearModel, point: OperatingPoint, circuit: Circuit, law: Law) -> Loop:
    """The loop of a linear model under the control law.

    The valve level inverts each edge at its measured drop: ``δu = (δQ − slope·δΔp)/gain``, with
    pressures ``delay`` old (Padé form). Where one command serves both ends the path that sets the
    motion decides it."""
    function = FUNCTIONS.index(point.function)
    areas = np.array([circuit.area_head, circuit.area_rod])
    head = METERED[function] == HEAD
    size, held = linear.a.shape[0], 2 * DELAY_ORDER if law.delay > 0 else 0
    corners = [corner for corner in (law.washout, law.ramp_washout) if corner > 0]
    total = size + held + len(corners)
    a = np.zeros((total, total))
    a[:size, :size] = linear.a
    seen = np.zeros((2, total))  # pressures as the controller has them
    seen[:, 1:3] = np.eye(2)
    if held:
        # e^(−sT) ≈ 1 − 2 a1 s/(s² + a1 s + a0), a1 = 6/T, a0 = 12/T²
        root, twice = math.sqrt(12.0) / law.delay, 12.0 / law.delay
        for k in range(2):
            at = size + 2 * k
            a[at, at + 1], a[at + 1, at], a[at + 1, at + 1] = root, -root, -0.5 * twice
            a[at + 1, 1 + k] = root
            seen[k, at + 1] = -twice / root
    back = seen[0 if head else 1].copy()
    if law.feedback == "load":
        back = (areas[0] * seen[0] - areas[1] * seen[1]) / (areas[0] if head else -areas[1])
    for at, corner in enumerate(corners, size + held):
        a[at] = corner * back
        a[at, at] -= corner
        back[at] -= 1.0
    # chamber flows (Q1, Q2) for the pressures seen, for the feedback flow, for v_d
    held_flow = np.zeros((2, total))
    if head:
        held_flow[1] = law.off_gain * (
            seen[1] - (seen[0] if function == EXTEND_RESISTIVE_REGENERATION else 0.0)
        )
    else:
        held_flow[0] = -law.off_gain * seen[0]
    way_in = np.array([-1.0, 0.0]) if head else np.array([0.0, 1.0])
    orders, off = np.zeros((2, len(linear.valves), total))
    direct, drive = np.zeros((2, len(linear.valves)))
    together = coupled(circuit, function)
    for path in point.paths:
        if together and not path.metering:
            continue
        i, share = linear.valves.index(path.valve), PATH_FLOWS[function, path.path]
        orders[i] = path.slope * INTO[path.path] @ seen / path.gain
        off[i] = share @ held_flow / path.gain
        direct[i], drive[i] = share @ way_in / path.gain, share @ areas / path.gain
    put = np.zeros((total, len(linear.valves)))
    put[:size] = linear.b
    a += put @ (orders + off)
    e = np.zeros(total)
    e[:size] = linear.e
    scale = np.ones(total)
    scale[1:3] = 1.0e6
    scale[size:] = 1.0e6
    scale[4:size:2] = 100.0
    ratio = scale / scale[:, None]
    fastest = 2.5 / law.delay if held else math.inf
    return Loop(
        a * ratio,
        put @ direct / scale,
        back * scale,
        put @ drive / scale,
        e / scale,
        put @ off * ratio,
        fastest,
    )


def damping_ratio(poles: np.ndarray, fastest: float = math.inf) -> np.ndarray:
    """Least damping ratio of the poles along the last axis: −Re s/|s|; 1 for real stable poles, −1 for real unstable ones.

    Poles at zero, such as that of a chamber which nothing holds, do not count, nor stable ones
    beyond ``fastest`` [rad/s]."""
    size = np.abs(poles)
    counts = (size > AT_ZERO * size.max(axis=-1, keepdims=True)) & (
        (size < fastest) | (poles.real > 0.0)
    )
    return np.where(counts, -poles.real / np.where(counts, size, 1.0), 1.0).min(axis=-1)


def dominant(poles: np.ndarray, fastest: float = math.inf) -> complex:
    """The least damped of the poles that `damping_ratio` counts, upper half plane; the slowest
    where all are real.
    """
    size = np.abs(poles)
    counts = (size > AT_ZERO * size.max()) & ((size < fastest) | (poles.real > 0.0))
    among = poles[counts]
    best = among[np.lexsort((np.abs(among), -among.real / np.abs(among)))[0]]
    return complex(best.real, abs(best.imag))
