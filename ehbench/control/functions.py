"""Working functions of a cylinder: which metering edges move it, chosen from desired speed,
load and pressures (thesis 3.1, 3.2).

A circuit is seen as eight directed paths between supply, tank, head and rod end. A working function
uses two of them; its chamber flows, ``flow_head`` Q1 into the head end and ``flow_rod`` Q2 out of
the rod end (both have the sign of the speed: Q1 = A1 v, Q2 = A2 v at steady speed), are shared out
over its paths by ``PATH_FLOWS``. One chamber, ``METERED``, sets the motion through the path
``METERING``; the other, the off-side, is held at a set pressure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.control.measured import Pressures
from ehbench.control.records import blank, constants, numbers, reals, rows_of
from ehbench.parts.edge import MAP, PUMP, edge_flow, edge_known
from ehbench.parts.edge.preload import preload
from ehbench.parts.supply import SUPPLY, drawn_at, metered_at, offered
from ehbench.physics.flow_map import ValveMaps
from ehbench.runtime.compiled import kernel, record
from ehbench.vocabulary import InputError, message, setting
from ehbench.vocabulary.codes import (
    EXTEND_RESISTIVE_FED_AT_ROD,
    EXTEND_RESISTIVE_REGENERATION,
    FUNCTIONS,
    HOLD,
    OK,
    RETRACT_OVERRUNNING_THROUGH_ROD,
    STALLED,
    UNABLE,
)

PATHS = (
    *("supply_head", "head_tank", "supply_rod", "rod_tank", "head_rod", "rod_head"),
    *("tank_head", "tank_rod"),
)
SUPPLY_HEAD, HEAD_TANK, SUPPLY_ROD, ROD_TANK, HEAD_ROD, ROD_HEAD = range(6)
TANK_HEAD, TANK_ROD = 6, 7  # of a chamber that draws its oil from the tank, by an open edge
NONE, HEAD, ROD = 0, 1, 2

# direction, load along the motion, chamber that sets the motion, its path, then (path, share of Q1,
# share of Q2)
_TABLE = (
    (0, 0, NONE, -1, ()),
    (1, 0, HEAD, SUPPLY_HEAD, ((SUPPLY_HEAD, 1, 0), (ROD_TANK, 0, 1))),
    (1, 1, ROD, ROD_TANK, ((SUPPLY_HEAD, 1, 0), (ROD_TANK, 0, 1))),
    (1, 1, ROD, ROD_HEAD, ((SUPPLY_HEAD, 1, -1), (ROD_HEAD, 0, 1))),
    (-1, 0, ROD, SUPPLY_ROD, ((SUPPLY_ROD, 0, -1), (HEAD_TANK, -1, 0))),
    (-1, 1, HEAD, HEAD_TANK, ((SUPPLY_ROD, 0, -1), (HEAD_TANK, -1, 0))),
    (-1, 1, HEAD, HEAD_TANK, ((HEAD_ROD, 0, -1), (HEAD_TANK, -1, 1))),
    (1, 0, HEAD, SUPPLY_HEAD, ((SUPPLY_HEAD, 1, -1), (ROD_HEAD, 0, 1))),
    (-1, 1, HEAD, HEAD_ROD, ((HEAD_ROD, -1, 0), (ROD_TANK, -1, 1))),
    (1, 0, HEAD, ROD_HEAD, ((ROD_HEAD, 1, 0), (SUPPLY_ROD, 1, -1))),
    (-1, 1, HEAD, HEAD_TANK, ((TANK_ROD, 0, -1), (HEAD_TANK, -1, 0))),
    (1, 1, ROD, ROD_TANK, ((TANK_HEAD, 1, 0), (ROD_TANK, 0, 1))),
)
DIRECTION = np.array([row[0] for row in _TABLE])
OVERRUNNING = np.array([row[1] for row in _TABLE])
METERED = np.array([row[2] for row in _TABLE])
METERING = np.array([row[3] for row in _TABLE])
PATH_FLOWS = np.zeros((len(_TABLE), len(PATHS), 2))  # [function, path]: shares of (Q1, Q2)
for _f, _row in enumerate(_TABLE):
    for _path, _a, _b in _row[4]:
        PATH_FLOWS[_f, _path] = _a, _b
# the path that joins the two ends in a regenerating function, −1 in the others
CROSS = np.array(
    [next((p for p, _, _ in row[4] if p in (HEAD_ROD, ROD_HEAD)), -1) for row in _TABLE]
)

# functions whose off-side, the rod end, stands at Δp3 above the head end
RAISED = (DIRECTION == 1) & (METERED == HEAD) & (CROSS == ROD_HEAD)
# functions for a circuit without others of their direction: the off-side stands open to the tank
VENTED = np.array([shares[TANK_HEAD:].any() for shares in PATH_FLOWS])
# functions for a circuit that has lost every other one of their direction and load
SPARE = (RETRACT_OVERRUNNING_THROUGH_ROD, EXTEND_RESISTIVE_FED_AT_ROD)

RULE_NAMES = (
    "speed_start",
    "speed_stop",
    "force_band",
    "drop_start",
    "drop_stop",
    "reserve",
    "supply_margin",
    "supply_band",
    "cross_drop",
    "dwell",
    "speed_sure",
    "desired_corner",
    "power_band",
)
CHOICES = ("ranked", "least_power")  # by the number that the rule ``choice`` is
RANKED, LEAST_POWER = range(2)
# the rules of a recipe, what follows from its gains, its choice, and 0 or 1
ALL_RULES = (*RULE_NAMES, "low_pressure", "choice", "allow_seventh")
RULES = record(*reals(ALL_RULES))  # the rules of selection, see `pack_rules`


@dataclass(frozen=True)
class FunctionSettings:
    """Defaults of the rules of function selection, and its fixed numbers."""

    pressures: float = setting(20.0, "", "supply pressure over drops and margins", "thesis 3.2")
    speed_start: float = setting(2.0e-4, "m/s", "desired speed that begins a motion", "noise")
    speed_stop: float = setting(1.0e-4, "m/s", "desired speed that ends a motion", "half of that")
    sure: float = setting(5.0, "", "speed without low-pass, in speed_start", "chosen")
    corner: float = setting(20.0, "rad/s", "low-pass of small desired speeds", "chosen")
    reserve: float = setting(0.2, "", "flow to spare where a function begins", "chosen")
    dwell: float = setting(0.1, "s", "time between two changes of function", "chosen")
    power_band: float = setting(0.05, "", "saving that changes the function", "chosen")
    filled: float = setting(0.5, "", "pressure of a full chamber, of low_pressure", "above tank")
    filled_active: float = setting(0.25, "", "the same where the function is at work", "half of it")
    probe_drop: float = setting(1.0e6, "Pa", "drop at which edges of a path compare", "usual")


FUNCTION = constants(FunctionSettings())


class Circuit(NamedTuple):
    """One cylinder's metering edges as controllers take them: plain numbers and arrays, made by
    `circuit`.

    ``edges, maps`` are the plant's (all cylinders'); ``lowest, highest`` [V] the range of every
    valve's command; ``first, count`` where this cylinder's edges stand in ``edges``. ``paths``
    [8] is the edge that serves each path, −1 for none, ``along`` [8] its direction: +1 where
    the edge points along the path, else −1. ``able`` [functions] is 1 for each working function
    that the circuit can do. ``domain``, ``domain_at`` [edges, 2]: the validity domain of each
    map, see `ehbench.control.valve_level.inside`. ``play`` [V], shape (count,): the width of
    each edge's hysteresis as its map has it, 0 where that is not known. ``supply`` [1] is the
    plant's line, which says at what pressure an edge finds the supply, see `supply_pressure`.
    ``trim``, shape (count, 2): gain [1] and shift of the deadband [V] by which each edge
    differs from its law; a controller that learns writes it (`ehbench.control.map_learning`)."""

    cylinder: int
    area_head: float
    area_rod: float
    first: int
    count: int
    edges: np.recarray
    maps: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    paths: np.ndarray
    along: np.ndarray
    able: np.ndarray
    domain: np.ndarray
    domain_at: np.ndarray
    play: np.ndarray
    supply: np.recarray
    trim: np.ndarray


@kernel
def widest(circuit, edge, drop):
    """Command [V] that opens an edge as far as driver and map allow at a ``drop`` [Pa] along it."""
    valve = circuit.edges[edge].valve
    sign = circuit.edges[edge].sign
    reach = circuit.highest[valve] if sign > 0.0 else -circuit.lowest[valve]
    reach = min(reach, edge_known(drop, circuit.edges[edge], circuit.maps))
    return sign * max(reach, 0.0)


@kernel
def supply_pressure(chamber, p, circuit):
    """Pressure [Pa] at an edge to a ``chamber`` [Pa]: measured, the low rail's, or soon the
    pump's."""
    return offered(p.supply, chamber, circuit.supply[0])


@kernel
def path_drop(path, p, circuit):
    """Pressure drop [Pa] along a path at `Pressures`, positive where oil flows its way."""
    if path == SUPPLY_HEAD:
        return supply_pressure(p.head, p, circuit) - p.head
    if path == HEAD_TANK:
        return p.head - p.tank
    if path == SUPPLY_ROD:
        return supply_pressure(p.rod, p, circuit) - p.rod
    if path == ROD_TANK:
        return p.rod - p.tank
    if path >= TANK_HEAD:
        return p.tank - (p.head if path == TANK_HEAD else p.rod)
    return p.head - p.rod if path == HEAD_ROD else p.rod - p.head


@kernel
def metering_drop(path, p, circuit):
    """As `path_drop`, but from the supply's pressure that is there already."""
    if path == SUPPLY_HEAD:
        return metered_at(p.supply, p.head, circuit.supply[0]) - p.head
    if path == SUPPLY_ROD:
        return metered_at(p.supply, p.rod, circuit.supply[0]) - p.rod
    return path_drop(path, p, circuit)


@kernel
def capacity(circuit, path, drop):
    """Largest flow [m³/s] of a path at a drop [Pa] along it; 0 without an edge. From
    the tank a chamber draws what it needs."""
    edge = circuit.paths[path]
    if path >= TANK_HEAD and edge >= 0:
        return math.inf
    if edge < 0 or drop <= 0.0:
        return 0.0
    along = circuit.along[path]
    opening = widest(circuit, edge, along * drop)
    return along * edge_flow(along * drop, opening, circuit.edges[edge], circuit.maps)


@kernel
def supply_draw(function, circuit):
    """Oil that a function draws from the supply per stroke [m³/m]: A1, A2, A1 − A2 or 0."""
    way = DIRECTION[function]
    drawn = 0.0
    for path in (SUPPLY_HEAD, SUPPLY_ROD):
        drawn += way * (
            PATH_FLOWS[function, path, 0] * circuit.area_head
            + PATH_FLOWS[function, path, 1] * circuit.area_rod
        )
    return drawn


@kernel
def feasible(function, active, v_d, load_force, p, circuit, rules):
    """True where a function can move the load at the present pressures; a function that is
    ``active`` stays more easily.

    In each, oil must be able to flow through the path that sets the motion. Meter-in: the supply
    carries the load. Regeneration: the drop across the ends is enough and the cross-port edge at
    full command carries its flow at it. With a raised rod end: see `raised_feasible`."""
    supply = circuit.supply[0]  # the highest pressure that it brings
    maximum = p.supply if supply.margin == 0.0 else max(p.supply, supply.pressure)
    cross = CROSS[function]
    # fed at the rod, the drop of the path that sets the motion is the planned one
    fed_at_rod = RAISED[function] and METERING[function] == cross
    if path_drop(METERING[function], p, circuit) <= 0.0 and not fed_at_rod:
        return False
    if cross < 0:
        metered = circuit.area_head if METERED[function] == HEAD else circuit.area_rod
        return OVERRUNNING[function] == 1 or abs(load_force) < metered * maximum
    if RAISED[function]:
        return raised_feasible(function, active, v_d, load_force, maximum, circuit, rules)
    headroom = 1.0 if active else 1.0 + rules.reserve
    drop = path_drop(cross, p, circuit)
    return drop > (rules.drop_stop if active else rules.drop_start) and capacity(
        circuit, cross, drop
    ) >= headroom * area_of(function, cross, circuit) * abs(v_d)


@kernel
def area_of(function, path, circuit):
    """Flow along a path of a function per speed of the cylinder [m²], ≥ 0."""
    head, rod = PATH_FLOWS[function, path, 0], PATH_FLOWS[function, path, 1]
    return abs(head * circuit.area_head + rod * circuit.area_rod)


@kernel
def raised_feasible(function, active, v_d, load_force, p_supply, circuit, rules):
    """True where a `RAISED` function can move the load, at the planned drop Δp3, as its drop only
    comes about in use.

    ``p_head = (F + Δp3 A2)/(A1 − A2)``, the end that the supply feeds stands below ``Ps − margin``
    (SPEC 4), and both edges carry their flows there."""
    headroom, speed = 1.0 if active else 1.0 + rules.reserve, abs(v_d)
    difference = circuit.area_head - circuit.area_rod
    if difference <= 0.0:
        return False
    needed = (load_force + rules.cross_drop * circuit.area_rod) / difference
    path, cross = SUPPLY_HEAD, CROSS[function]
    if PATH_FLOWS[function, SUPPLY_ROD, 0] != 0.0:
        path, needed = SUPPLY_ROD, needed + rules.cross_drop
    margin = p_supply - needed
    passing = headroom * area_of(function, cross, circuit) * speed
    return (
        margin > rules.supply_margin + (0.0 if active else rules.supply_band)
        and capacity(circuit, cross, rules.cross_drop) >= passing
        and capacity(circuit, path, margin) >= headroom * difference * speed
    )


@kernel
def suits(function, way, along, circuit, rules):
    """True for a function of this direction (±1) and load that circuit and rules allow."""
    return (
        DIRECTION[function] == way
        and OVERRUNNING[function] == along
        and circuit.able[function] == 1
        and (function != EXTEND_RESISTIVE_REGENERATION or rules.allow_seventh != 0.0)
    )


@kernel
def planned(function, load_force, p, circuit, rules):
    """`Pressures` at which a function carries a load [N] in steady motion: the off-side at its set-
    point, the other by the balance of forces; NaN where areas allow none."""
    a1, a2, low = circuit.area_head, circuit.area_rod, p.tank + rules.low_pressure
    if RAISED[function]:
        head = (load_force + rules.cross_drop * a2) / (a1 - a2) if a1 > a2 else math.nan
        return Pressures(head, head + rules.cross_drop, p.supply, p.tank)
    if METERED[function] == HEAD:
        return Pressures((load_force + low * a2) / a1, low, p.supply, p.tank)
    return Pressures(low, (low * a1 - load_force) / a2, p.supply, p.tank)


@kernel
def carries(function, active, v_d, plan, circuit, rules):
    """True where a function carries ``v_d`` [m/s] at its `planned` pressures: no empty chamber,
    ``supply_margin`` left, every path passes its share; an ``active`` one stays more easily."""
    headroom, speed = 1.0 if active else 1.0 + rules.reserve, abs(v_d)
    filled = FUNCTION.filled_active if active else FUNCTION.filled
    minimum = plan.tank + filled * rules.low_pressure
    margin = rules.supply_margin + (0.0 if active else rules.supply_band)
    if not (plan.head >= minimum and plan.rod >= minimum):
        return False
    for path in range(len(PATHS)):
        share = area_of(function, path, circuit)
        if share == 0.0:
            continue
        drop = path_drop(path, plan, circuit)
        if drop < margin and (path == SUPPLY_HEAD or path == SUPPLY_ROD):
            return False
        if capacity(circuit, path, drop) < headroom * share * speed:
            return False
    return True


@kernel
def pump_force(function, plan, circuit):
    """Energy that a function takes from the pumps per stroke [J/m] at its `planned` pressures."""
    way, taken = DIRECTION[function], 0.0
    for path in (SUPPLY_HEAD, SUPPLY_ROD):
        drawn = PATH_FLOWS[function, path, 0] * circuit.area_head
        drawn += PATH_FLOWS[function, path, 1] * circuit.area_rod
        chamber = plan.head if path == SUPPLY_HEAD else plan.rod
        taken += way * drawn * drawn_at(plan.supply, chamber, circuit.supply[0])
    return taken


@kernel
def least_power(now, way, v_d, load_force, p, circuit, rules):
    """The function of a direction that carries the reference with least pump power, HOLD for none.

    The load may be along the motion or against it: what counts are the planned pressures. A
    function that is at work stays until another takes less by ``power_band`` of it."""
    best, minimum = HOLD, math.inf
    for function in range(1, len(FUNCTIONS)):
        if not suits(function, way, OVERRUNNING[function], circuit, rules):
            continue
        plan = planned(function, load_force, p, circuit, rules)
        active = function == now
        if not carries(function, active, v_d, plan, circuit, rules):
            continue
        if path_drop(METERING[function], p, circuit) <= 0.0:
            continue
        cost = pump_force(function, plan, circuit) * (1.0 - (rules.power_band if active else 0.0))
        if cost < minimum:
            best, minimum = function, cost
    return best


@kernel
def meters(function, v_d, p, circuit):
    """True where the path that sets the motion passes ``v_d`` [m/s] at its present drop; whether a
    regenerating function does is what makes it `feasible`."""
    path = METERING[function]
    passing = capacity(circuit, path, path_drop(path, p, circuit))
    return CROSS[function] >= 0 or passing >= area_of(function, path, circuit) * abs(v_d)


@kernel
def ranked(now, way, v_d, load_force, p, circuit, rules):
    """(function, status): of those that suit and are feasible the one that draws least; else the
    plainest. The load's hysteresis keeps only a function whose metering path passes ``v_d``."""
    band = 0.0
    if DIRECTION[now] == way and meters(now, v_d, p, circuit):
        band = -rules.force_band if OVERRUNNING[now] == 1 else rules.force_band
    along = 1 if -way * load_force > band else 0
    best, minimum, plain, maximum = HOLD, math.inf, HOLD, -1.0
    for function in range(1, len(FUNCTIONS)):
        if not suits(function, way, along, circuit, rules):
            continue
        draw = supply_draw(function, circuit)
        if draw > maximum:
            plain, maximum = function, draw
        if draw < minimum and feasible(
            function, function == now, v_d, load_force, p, circuit, rules
        ):
            best, minimum = function, draw
    if best == HOLD:
        return plain, UNABLE if plain == HOLD else STALLED
    return best, OK


@kernel
def steady_reference(v_d, slow, tick, rules):
    """The desired speed [m/s] by which motions begin, turn and end, after ``slow`` a tick ago.

    Above ``speed_sure``, and where no speed at all is desired, it is ``v_d`` itself; between, that
    behind a low-pass of ``desired_corner``, so that noise about the dead zone moves nothing."""
    if v_d == 0.0 or abs(v_d) > rules.speed_sure:
        return v_d
    slow = min(max(slow, -rules.speed_sure), rules.speed_sure)
    return slow - math.expm1(-rules.desired_corner * tick) * (v_d - slow)


@kernel
def direction(now, v_d, rules):
    """Direction of the desired speed, ±1 or 0, with a dead zone that is narrower once it moves."""
    way = DIRECTION[now]
    if way == 0 or way * v_d <= rules.speed_stop:
        way = 0 if abs(v_d) <= rules.speed_start else (1 if v_d > 0.0 else -1)
    return way


@kernel
def select(now, age, v_d, load_force, p, circuit, rules):
    """(working function, status) for this tick, by the rule ``choice``: `ranked`, or `least_power`
    where some function carries the reference, else ranked.

    The direction is that of ``v_d`` with a dead zone (hold inside it); ranked, the load is along
    the motion where ``direction·load_force < 0``, with a band of hysteresis. A change of direction,
    and to or from hold, is made at once; another change only after the minimum dwell. Pure: the
    caller keeps ``now`` and ``age``.

    Args:
        now: the working function of the last tick.
        age: time since it was taken up [s].
        v_d: desired speed [m/s], extension positive, of `steady_reference` where it may be noisy.
        load_force: P_L = p_head A1 − p_rod A2 [N], measured or desired.
        p: `Pressures` [Pa].
        circuit: of the cylinder.
        rules: of `pack_rules`.

    Returns:
        Index into FUNCTIONS, and OK; STALLED: none that suits is feasible, this is the plainest of
        them, or one that stays for its dwell has ceased to be;
        UNABLE: the circuit has no function for this motion and load, so it holds.
    """
    way = direction(now, v_d, rules)
    if way == 0:
        return HOLD, OK
    best, status = HOLD, OK
    if rules.choice == LEAST_POWER:
        best = least_power(now, way, v_d, load_force, p, circuit, rules)
    if best == HOLD:
        best, status = ranked(now, way, v_d, load_force, p, circuit, rules)
    if DIRECTION[now] == way and best != now and age < rules.dwell:
        fit = feasible(now, True, v_d, load_force, p, circuit, rules)
        return now, OK if fit else STALLED
    return best, status


def default_pressure(supply_pressure: float) -> float:
    """Drop, margin or set-point [Pa] by default: a share of the supply pressure."""
    return supply_pressure / FUNCTION.pressures


def pack_rules(
    area_rod: float,
    supply_pressure: float,
    low_pressure: float | None = None,
    choice: str = CHOICES[RANKED],
    **given: float,
) -> np.record:
    """The rules of `select`, a record of type RULES, with defaults in shares of the supply pressure
    Ps.

    Args:
        area_rod: A2 [m²].
        supply_pressure: Ps [Pa].
        low_pressure: set-point of the off-side chamber above tank [Pa], Ps/20; the default of
            ``force_band`` follows from it.
        choice: `ranked` or `least_power`.
        given: rules by name [SI] instead of their defaults; `VOCABULARY` says what they are.
            ``force_band`` is half of ``low_pressure``·A2, so that in the band neither the function
            before nor the one after lets a chamber cavitate.

    Raises:
        InputError: an unknown rule, a number that is negative or not finite, or that ends a state
            above where it begins.
    """
    known = (*RULE_NAMES, "choice", "allow_seventh")
    for name in given:
        if name not in known:
            raise InputError(message("control.unknown_rule", name=name, known=", ".join(known)))
    if choice not in CHOICES:
        known = ", ".join(CHOICES)
        raise InputError(message("control.unknown_choice", choice=choice, known=known))
    part = default_pressure(supply_pressure)
    low = part if low_pressure is None else low_pressure
    margin = given.get("supply_margin", part)
    defaults = {
        "speed_start": FUNCTION.speed_start,
        "speed_stop": FUNCTION.speed_stop,
        "force_band": 0.5 * low * area_rod,
        "drop_start": part,
        "drop_stop": 0.5 * given.get("drop_start", part),
        "reserve": FUNCTION.reserve,
        "supply_margin": margin,
        "supply_band": margin,
        "cross_drop": part,
        "dwell": FUNCTION.dwell,
        "speed_sure": FUNCTION.sure * given.get("speed_start", FUNCTION.speed_start),
        "desired_corner": FUNCTION.corner,
        "power_band": FUNCTION.power_band,
        "low_pressure": low,
        "allow_seventh": 0.0,
        "choice": CHOICES.index(choice),
    }
    rules = blank(RULES)
    for name, value in (defaults | given).items():
        rules[name] = value
    if not all(0.0 <= value < math.inf for value in numbers(rules, ALL_RULES).values()):
        raise InputError(message("control.negative_rule"))
    if rules.speed_stop > rules.speed_start or rules.drop_stop > rules.drop_start:
        raise InputError(message("control.stop_above_start"))
    return rules


def circuit(
    cylinder: int,
    area_head: float,
    area_rod: float,
    edges: np.recarray,
    maps: np.ndarray,
    ranges: np.ndarray,
    measured: Sequence[ValveMaps | None] | None = None,
    supply: np.record | None = None,
) -> Circuit:
    """The circuit of one cylinder, from the plant's arrays.

    Of several edges on one path the one that carries most at ``probe_drop`` serves it. A function
    is able where every path has an edge and its valves open no other edge of any cylinder and are
    asked for one sign only: four edges on one spool are able of the four without regeneration. It
    is able of a `SPARE` function where it has no other for that direction and load, of a `VENTED`
    one where it has none for that direction.

    Args:
        cylinder: its number; its head end is node 2 + 2·cylinder, its rod end the next one.
        area_head, area_rod: [m²].
        edges, maps: the plant's; ranges: lowest, highest command [V] of its valves, (valves, 2).
        measured: the flow maps of every edge that follows one, None for the others.
        supply: the plant's, by default one of constant pressure.

    Raises:
        InputError: no valve's edge touches it, a pump does, or an edge lacks its map.
    """
    lowest, highest = np.ascontiguousarray(ranges.T, float)
    head, rod = 2 + 2 * cylinder, 3 + 2 * cylinder
    touching, beside = _edges_at(edges, cylinder, (head, rod))
    domain, domain_at = _domains(edges, measured)
    paths, along = np.full(len(PATHS), -1, np.int64), np.ones(len(PATHS))
    able = np.zeros(len(FUNCTIONS), np.int64)
    whole = Circuit(
        int(cylinder),
        float(area_head),
        float(area_rod),
        int(touching[0]),
        int(touching[-1] - touching[0] + 1),
        edges,
        np.ascontiguousarray(maps, float),
        lowest,
        highest,
        paths,
        along,
        able,
        domain,
        domain_at,
        _plays(touching, measured),
        rows_of(SUPPLY, supply),
        np.tile([1.0, 0.0], (int(touching[-1] - touching[0] + 1), 1)),
    )
    ends = ((0, head), (head, 1), (0, rod), (rod, 1), (head, rod), (rod, head), (1, head), (1, rod))
    for path, between in enumerate(ends):
        drain = paths[{TANK_HEAD: ROD_TANK, TANK_ROD: HEAD_TANK}.get(path, path)]
        serving = [*touching, *beside] if path >= TANK_HEAD else [*touching]
        paths[path], along[path] = _serving(whole, serving, between, drain)
    able[:] = _able(paths, edges)
    return whole


def _edges_at(
    edges: np.recarray, cylinder: int, nodes: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the edges that touch some nodes: those with a command, those without.

    Raises:
        InputError: none has a command, or one is a pump.
    """
    touching = np.isin(edges.from_node, nodes) | np.isin(edges.to_node, nodes)
    if (edges.law[touching] == PUMP).any():
        raise InputError(message("control.pump_edge"))
    commanded, beside = (
        np.flatnonzero(touching & has) for has in (edges.valve >= 0, edges.valve < 0)
    )
    if not commanded.size:
        raise InputError(message("control.no_edge", cylinder=cylinder))
    return commanded, beside


def _serving(
    circuit: Circuit, touching: Sequence[int], between: tuple[int, int], drain: int
) -> tuple[int, float]:
    """(edge that carries most between two nodes at ``probe_drop``, its direction); −1 for none. One
    that the command of edge ``drain`` opens goes first, one that it shuts last."""
    serving, along, best = -1, 1.0, (0, 0.0)
    edges = circuit.edges
    ends = list(zip(edges.from_node.tolist(), edges.to_node.tolist(), strict=True))
    for edge in touching:
        forward = ends[edge] == between
        if not forward and (ends[edge] != between[::-1] or edges.blocked[edge] == 1):
            continue
        way = 1.0 if forward else -1.0
        drop = FUNCTION.probe_drop
        drop = drop + preload(edges[edge]) if forward else -drop
        opening = widest(circuit, edge, drop)
        flow = way * edge_flow(drop, opening, edges[edge], circuit.maps)
        beside = drain < 0 or edges.valve[edge] != edges.valve[drain]
        rank = 1 if beside else (2 if edges.sign[edge] == edges.sign[drain] else 0)
        if flow > 0.0 and (rank, flow) > best:
            serving, along, best = edge, way, (rank, flow)
    return serving, along


def _able(paths: np.ndarray, edges: np.recarray) -> list[bool]:
    """Which functions have an edge on every path whose command opens no other; a spare one only
    where no plain one serves, a vented one only where no other moves that way."""
    touching = ((edges.from_node >= 2) | (edges.to_node >= 2)).tolist()
    commands = list(zip(edges.valve.tolist(), edges.sign.tolist(), strict=True))
    able = []
    for function in range(len(FUNCTIONS)):
        chosen = paths[PATH_FLOWS[function].any(axis=1)].tolist()
        opened = {commands[e] for e in chosen if e >= 0 and commands[e][0] >= 0}
        able.append(
            min(chosen, default=0) >= 0
            and len({valve for valve, _ in opened}) == len(opened)
            and not any(
                touching[e] and command in opened and e not in chosen
                for e, command in enumerate(commands)
            )
        )
    kinds = list(zip(DIRECTION.tolist(), OVERRUNNING.tolist(), strict=True))
    plain = {kinds[f] for f in range(1, EXTEND_RESISTIVE_REGENERATION) if able[f]}
    ways = {kinds[f][0] for f, item in enumerate(able) if item and not VENTED[f]}
    return [
        item and not (kinds[f][0] in ways if VENTED[f] else f in SPARE and kinds[f] in plain)
        for f, item in enumerate(able)
    ]


def able_functions(circuit: Circuit, lost: int) -> list[bool]:
    """Which working functions a circuit can do without the valve of number ``lost``."""
    paths = circuit.paths.copy()
    paths[(paths >= 0) & (circuit.edges.valve[paths] == lost)] = -1
    return _able(paths, circuit.edges)


def _domains(edges: np.ndarray, measured: Sequence | None) -> tuple[np.ndarray, np.ndarray]:
    """(validity domains: count, commands, lowest and highest drops; where each edge's two start, or
    −1)."""
    parts, at, size = [np.zeros(1)], np.full((edges.shape[0], 2), -1, np.int64), 1
    for edge, row in enumerate(edges):
        pair = None if measured is None else measured[edge]
        if row.law != MAP:
            continue
        if pair is None:
            raise InputError(message("control.no_domain", edge=edge))
        for side, item in enumerate((pair.forward, pair.reverse)):
            if item is not None:
                part = np.concatenate(
                    [[item.hull_command.size], item.hull_command, item.hull_low, item.hull_high]
                )
                at[edge, side] = size
                parts.append(part)
                size += part.size
    return np.concatenate(parts), at


def _plays(touching: np.ndarray, measured: Sequence | None) -> np.ndarray:
    """Widths [V] of the hysteresis of a cylinder's edges, by the wider of an edge's two maps."""
    count = int(touching[-1] - touching[0] + 1)
    play = np.zeros(count)
    for i in range(count):
        pair = None if measured is None else measured[touching[0] + i]
        for item in () if pair is None else (pair.forward, pair.reverse):
            play[i] = max(play[i], 0.0 if item is None else item.hysteresis)
    return play


def coupled(circuit: Circuit, function: int) -> bool:
    """True where one command meters all edges of a working function, as on a spool."""
    chosen = circuit.paths[PATH_FLOWS[function].any(axis=1)]
    return (
        circuit.able[function] == 1
        and chosen.size > 1
        and not VENTED[function]
        and bool((circuit.edges.valve[chosen] == circuit.edges.valve[chosen[0]]).all())
    )
