"""Linear models of one cylinder about operating points, from the equations (SPEC 3).

All other joints are held. A model has the states ``v, p_head, p_rod``, those of the cylinder's
further parts, then those of each valve at work, in SI."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ehbench.parts.friction import friction_slope
from ehbench.parts.oil import bulk_of
from ehbench.parts.valve import valve_rates
from ehbench.plant.model import Model
from ehbench.tune.operating_point import FED, INTO, OperatingPoint, hoses_of

AT_ZERO = 1.0e-7  # share of the fastest pole below which a pole is one at zero
# a cylinder's further states, and that of a supply that feels it
PART_STATES = ("p_line_head", "p_line_rod", "p_supply", "sway", "sway_speed", "mount_deflection")


@dataclass(frozen=True)
class LinearModel:
    """``ẋ = A x + B u + E f`` about an operating point: u [V] the commands of the valves at work, f
    [N] a force on the rod.

    ``states`` name x: ``v, p_head, p_rod``, the pressure of each line, that of a load-sensing
    supply that follows this load, what sways, the deflection of a mount, the states of each valve
    with dynamics, then those of the Padé forms of delays; all SI. ``valves`` number u. Poles
    beyond ``fastest`` [rad/s] are those of the Padé forms."""

    states: tuple[str, ...]
    valves: tuple[int, ...]
    a: np.ndarray
    b: np.ndarray
    e: np.ndarray
    fastest: float = math.inf

    @cached_property
    def swing(self) -> float:
        """Natural frequency [rad/s] of its least damped poles but those at zero."""
        poles = np.linalg.eigvals(self.a)
        poles = poles[np.abs(poles) > AT_ZERO * np.abs(poles).max()]
        return float(np.abs(poles[np.argmax(poles.real / np.abs(poles))]))


class ValveBlock(NamedTuple):
    """A valve as ``ẋ = a x + b u``, opening ``= c x``; ``states``: positions in the plant's
    state."""

    states: tuple[int, ...]
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray


def valve_block(model: Model, valve: int) -> ValveBlock:
    """The elements of a valve, which are linear, from their own rates."""
    plant, row = model.plant, model.plant.valves[valve]
    elements = plant.elements[row.first : row.first + row.count]
    states = tuple(k for item in elements for k in range(item.state, item.state + item.states))
    size = len(states)
    table, c = np.empty((size, size + 1)), np.empty(size)
    for k in range(size + 1):
        y, rates = np.zeros(model.layout.states), np.zeros(model.layout.states)
        if k < size:
            y[states[k]] = 1.0
        opening, _ = valve_rates(row, 0.0 if k < size else 1.0, plant, y, rates)
        table[:, k] = rates[list(states)]
        if k < size:
            c[k] = opening
    return ValveBlock(states, table[:, :size], table[:, size], c)


class _Sensing(NamedTuple):
    """A load-sensing pump: the ``side`` that it feeds and feels, the ``rate`` [1/s] at which it
    follows."""

    side: int
    rate: float


def _sensing(model: Model, point: OperatingPoint) -> _Sensing | None:
    """How its pressure follows the point's; None where it follows nothing, as at its highest."""
    supply = model.plant.supply
    if supply.margin == 0.0 or point.p_supply >= supply.pressure:
        return None
    softer = bulk_of(supply, point.p_supply) / supply.bulk_modulus
    sides = [FED[path.path] for path in point.paths if path.path in FED]
    return _Sensing(sides[0], softer / supply.lag) if sides else None


def part_states(model: Model, point: OperatingPoint) -> list[int]:
    """Places in the plant's state of the cylinder's lines, its supply if it follows, sway and
    mount."""
    row = model.plant.cylinders[model.layout.cylinders.index(point.cylinder)]
    supply = [] if _sensing(model, point) is None else [int(model.plant.at.supply)]
    mount = [int(row.mount_state)] if row.mount_state >= 0 else []
    sway = [int(row.sway_state), int(row.sway_state) + 1] if row.sway_state >= 0 else []
    return [hose.state for hose in hoses_of(model, point)] + supply + sway + mount


def states_of(
    model: Model, point: OperatingPoint
) -> tuple[tuple[int, ...], dict[int, ValveBlock], tuple[str, ...]]:
    valves = tuple(dict.fromkeys(p.valve for p in point.paths))
    moving = {i: valve_block(model, i) for i in valves if model.plant.valves[i].count}
    states = [*part_states(model, point), *(k for block in moving.values() for k in block.states)]
    names = (model.layout.state_names[k] for k in states)
    return valves, moving, ("v", "p_head", "p_rod", *names)


def development_model(model: Model, point: OperatingPoint) -> LinearModel:
    """The linear development model from the equations (SPEC 3), valve edges with their own slopes.

    ``m_eq v̇ = A1 P1 − A2 P2 − (b_eq + friction) v + m_eq·bend·v + f``; ``V/β Ṗ`` = inflow of
    each chamber, volumes fixed, β of the oil at its pressure; ``Q = gain·opening + slope·Δp`` along
    each edge; valves as their elements are; ``Ṗs = (P − Ps)/lag`` of a load-sensing pump."""
    plant = model.plant
    row = plant.cylinders[model.layout.cylinders.index(point.cylinder)]
    valves, moving, names = states_of(model, point)
    size = len(names)
    a, b, e = np.zeros((size, size)), np.zeros((size, len(valves))), np.zeros(size)
    areas, hoses = np.array([row.area_head, row.area_rod]), hoses_of(model, point)
    pump, at_pump = _sensing(model, point), 3 + len(hoses)
    a[0, :3] = (
        point.bend - (point.damping + point.friction) / point.mass,
        areas[0] / point.mass,
        -areas[1] / point.mass,
    )
    e[0] = 1.0 / point.mass
    pressures = (point.p_head, point.p_rod)
    stiff = [bulk_of(row, p) for p in pressures]
    stiff += [bulk_of(hose.row, pressures[hose.side] + hose.drop) for hose in hoses]
    stiff = np.array(stiff)
    stiff /= (point.volume_head, point.volume_rod, *(hose.row.volume for hose in hoses))
    inflow = np.zeros((2 + len(hoses), size))
    inflow[:2, 0] = -areas[0], areas[1]
    inflow[0, 1:3] = -row.leakage_internal - row.leakage_head, row.leakage_internal
    inflow[1, 1:3] = row.leakage_internal, -row.leakage_internal - row.leakage_rod
    if row.mount_state >= 0:
        _give_way(row, point, names, a, inflow)
    if row.sway_state >= 0:
        _swaying(row, point, names, a)
    into_u, port = np.zeros((2 + len(hoses), len(valves))), [0, 1]
    for item, hose in enumerate(hoses, 2):
        port[hose.side] = item
        for node, sign in ((item, -1.0), (hose.side, 1.0)):
            inflow[node, 1 + item] += sign * hose.slope
            inflow[node, 1 + hose.side] -= sign * hose.slope
    sizes = (block.b.size for block in moving.values())
    starts = list(itertools.accumulate([first_valve(names), *sizes]))[:-1]
    at = dict(zip(moving, starts, strict=True))
    for path in point.paths:
        side = INTO[path.path]
        inflow[np.ix_(port, [1 + node for node in port])] -= path.slope * np.outer(side, side)
        if path.valve in moving:
            first, c = at[path.valve], moving[path.valve].c
            inflow[port, first : first + c.size] += path.gain * np.outer(side, c)
        else:
            into_u[port, valves.index(path.valve)] += path.gain * side
        if pump is not None and path.path in FED:
            inflow[port, at_pump] += path.slope * side
    nodes = slice(1, 1 + len(stiff))
    a[nodes], b[nodes] = stiff[:, None] * inflow, stiff[:, None] * into_u
    if pump is not None:
        a[at_pump, 1 + port[pump.side]], a[at_pump, at_pump] = pump.rate, -pump.rate
    for i, block in moving.items():
        rows = slice(at[i], at[i] + block.b.size)
        a[rows, rows], b[rows, valves.index(i)] = block.a, block.b
    return with_delays(LinearModel(names, valves, a, b, e), model)


def _give_way(
    row: Any, point: OperatingPoint, names: Sequence[str], a: np.ndarray, inflow: np.ndarray
) -> None:
    """Write the row of a mount's deflection, and what the piston's speed u in its barrel changes of
    the others: ``(c + f) u = c v + A1 P1 − A2 P2 − k δ``, f the slope of the friction."""
    at, slope = first_valve(names) - 1, float(friction_slope(row, point.v))
    slip = np.zeros(len(names))
    slip[:3] = row.mount_damping, row.area_head, -row.area_rod
    slip[at] = -row.mount_stiffness
    slip /= row.mount_damping + slope
    slip[0] -= 1.0
    a[0] -= slope / point.mass * slip
    a[at] = slip
    inflow[:2] += np.outer((-row.area_head, row.area_rod), slip)


def _swaying(row: Any, point: OperatingPoint, names: Sequence[str], a: np.ndarray) -> None:
    """Write the rows of what sways, and its pull on the rod: ``m dw/dt = −(k z + c (w − v))``."""
    z = next(i for i, name in enumerate(names) if name.endswith(".sway"))
    pull = np.zeros(len(names))
    pull[[0, z, z + 1]] = -row.sway_damping, row.sway_stiffness, row.sway_damping
    a[0] += pull / point.mass
    a[z, [0, z + 1]] = -1.0, 1.0
    a[z + 1] = -pull / row.sway_mass


def write_delay(a: np.ndarray, at: int, delay: float) -> tuple[float, float]:
    """Write the two states of a delay T [s] into ``a`` from ``at`` on, in Padé form: e^(−sT) ≈ 1 −
    2 a1 s/(s² + a1 s + a0), a1 = 6/T, a0 = 12/T²; (how its input drives the second of them, what
    the output has of that besides the input)."""
    root, twice = math.sqrt(12.0) / delay, 12.0 / delay
    a[at, at + 1], a[at + 1, at], a[at + 1, at + 1] = root, -root, -0.5 * twice
    return root, -twice / root


def with_delays(linear: LinearModel, model: Model) -> LinearModel:
    """The model with the delays of its valves before them. Their states stand last."""
    late = model.plant.valves.delay[list(linear.valves)]
    size, fixed = len(linear.a), 2 * int(np.count_nonzero(late))
    if not fixed:
        return linear
    a, b = np.zeros((size + fixed, size + fixed)), np.zeros((size + fixed, len(late)))
    a[:size, :size], b[:size] = linear.a, linear.b
    names = list(linear.states)
    for i, delay in zip(np.flatnonzero(late), late[late > 0.0], strict=True):
        at = len(names)
        b[at + 1, i], share = write_delay(a, at, delay)
        a[:size, at + 1] = share * linear.b[:, i]
        names += [f"{model.layout.valves[linear.valves[i]]}.late_{k}" for k in (1, 2)]
    e = np.append(linear.e, np.zeros(fixed))
    return LinearModel(tuple(names), linear.valves, a, b, e, 2.5 / float(late.max()))


def first_valve(names: Sequence[str]) -> int:
    """How many states of a linear model stand before those of the valves."""
    return names.index("p_rod") + 1 + sum(name.rsplit(".", 1)[-1] in PART_STATES for name in names)


def are_rates(names: Sequence[str]) -> np.ndarray:
    """Which states of a linear model are rates of openings."""
    return np.array([name.endswith(".rate") for name in names])


def faster(linear: LinearModel, factor: float) -> LinearModel:
    """The model with valves ``factor`` times as fast at the same damping ratio."""
    a, b, rates = linear.a.copy(), linear.b.copy(), are_rates(linear.states)
    valves = slice(first_valve(linear.states), None)
    quick = np.where(rates, factor**2, factor)[valves, None]
    a[valves], b[valves] = a[valves] * quick, b[valves] * quick
    a[valves, rates] /= factor
    return LinearModel(linear.states, linear.valves, a, b, linear.e, linear.fastest * factor)
