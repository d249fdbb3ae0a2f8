"""What the controlled cylinder shall do, as a table of references, one row a tick."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.config.recipe import CylinderMotion, Motion, TrialRecipe
from ehbench.config.rig import Rig
from ehbench.control.functions import (
    CROSS,
    DIRECTION,
    HEAD_TANK,
    OVERRUNNING,
    ROD_TANK,
    SUPPLY_HEAD,
    SUPPLY_ROD,
    Circuit,
    capacity,
    coupled,
    pack_rules,
    path_drop,
    planned,
)
from ehbench.control.measured import Pressures
from ehbench.control.trajectory import ORDERS, A, J, V, X, point_to_point, velocity_steps
from ehbench.control.valve_level import pump_speed, top_speed
from ehbench.parts.supply import sensed
from ehbench.runtime.memory import rows_of
from ehbench.trial.commands import log_with
from ehbench.trial.controllers import Design
from ehbench.trial.lever import LEVER_CHANNELS, Lever, commanded
from ehbench.vocabulary import VOCABULARY, InputError, Quantity, message, placed, setting
from ehbench.vocabulary.codes import FUNCTIONS
from ehbench.vocabulary.fields import Value, read_value


@dataclass(frozen=True)
class MotionSettings:
    """Defaults of a motion."""

    rest: float = setting(0.5, "s", "rest before and after each step", "a swing decays")
    speed_up: float = setting(0.2, "s", "time to full speed without stated limits", "usual")


MOTION = MotionSettings()
ROUNDING = 1e-9  # [m] of a stroke that follows from an angle
_SHARE = Quantity(
    "share", "r", "dimensionless", "%", "share of the full speed, negative retracts", -2, 2
)


@dataclass(frozen=True)
class Level:
    """A step of desired speed: rows ``first`` to ``stop``, speed [m/s], and its share of the full
    speed in that direction if known."""

    first: int
    stop: int
    speed: float
    share: float | None


@dataclass(frozen=True)
class References:
    """``table`` of x_d, v_d, a_d, j_d, shape (samples, 4), the levels of speed in it, and the row
    at which its last cycle begins; how far ``apart`` [m] the cylinder stood, and the time [s] on
    the ``way`` from there; the ``lever`` of an operator, and ``inputs``, what it said."""

    table: np.ndarray
    levels: tuple[Level, ...] = ()
    last_cycle: int = 0
    apart: float = 0.0
    way: float = 0.0
    lever: Lever | None = None
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, len(LEVER_CHANNELS))))


def references(recipe: TrialRecipe, design: Design, low_pressure: float) -> References:
    """The table of a trial, as long as the recipe's duration or, without one, as its motion.

    Raises:
        InputError: a motion that is incomplete or leaves the stroke, with the line."""
    motion = recipe.motion
    if motion is None:
        return lasting(recipe, design, rest(design))
    with placed(recipe.at(*motion.where)):
        desired = MOTIONS[motion.kind](recipe, motion, design, low_pressure)
    return lasting(recipe, design, from_its_start(recipe, desired, design))


def starts_of(recipe: TrialRecipe, rig: Rig) -> dict[str, float]:
    """The strokes [m] at which the motions of a recipe begin, by cylinder; without those of motions
    that begin where their cylinder stands.

    Raises:
        InputError: a log of a motion without its strokes."""
    starts = {}
    for motion in () if recipe.motion is None else recipe.motion.each:
        cylinder = motion.cylinder or rig.cylinder[0].name
        if motion.kind == "file" and motion.file is not None:
            name = f"{cylinder}.x_desired"
            with placed(recipe.at(*motion.where)):
                starts[cylinder] = float(log_with(name, recipe.file(motion.file))[name][0])
        elif motion.waypoints:
            starts[cylinder] = float(motion.waypoints[0])
    return starts


def from_its_start(recipe: TrialRecipe, desired: References, design: Design) -> References:
    """A motion that begins where the cylinder stands, if need be off its first row: on the way it
    makes up for the difference, within the speed, acceleration and jerk that it has itself."""
    table, tick = desired.table, 1.0 / float(recipe.rate)
    apart = design.x - float(table[0, X])
    if abs(apart) < ROUNDING:
        return desired
    speed, acceleration, jerk = np.abs(table[:, V:]).max(axis=0).tolist()
    speed = speed or abs(apart) / MOTION.speed_up
    limits = _limits(speed, acceleration or None, jerk or None)
    way = point_to_point([apart, 0.0], tick=tick, **limits)
    rows = max(len(way), len(table))
    table = standing(table, rows) + standing(way, rows)
    return replace(desired, table=table, apart=apart, way=(len(way) - 1) * tick)


def rest(design: Design) -> References:
    """The motion of a cylinder that stands, or whose motion cannot be known yet."""
    return References(np.tile([design.x, 0.0, 0.0, 0.0], (2, 1)))


def lasting(recipe: TrialRecipe, design: Design, desired: References) -> References:
    """A motion for as long as the recipe says, if it does.

    Raises:
        InputError: it leaves the stroke, with the line."""
    motion = recipe.motion
    rate, table = float(recipe.rate), desired.table
    if recipe.duration is not None:
        with placed(recipe.at("duration")):
            count = rows_of(float(recipe.duration), rate) + 1
        if desired.lever is not None:  # a log that is played ends the trial
            count = min(count, len(table))
        table = standing(table, count)[:count]
    stroke = float(design.row.stroke)
    out = np.flatnonzero((table[:, X] < 0.0) | (table[:, X] > stroke))
    if out.size:
        where = recipe.at(*motion.where) if motion is not None else {}
        raise InputError(
            message(
                "trial.leaves_stroke",
                cylinder=design.cylinder,
                t=float(out[0] / rate),
                stroke=design.rig.shown("x", stroke),
                start=design.rig.shown("x", design.x),
            ),
            **where,
        )
    levels = tuple(
        Level(level.first, min(level.stop, len(table)), level.speed, level.share)
        for level in desired.levels
        if level.first < len(table)
    )
    last_cycle = min(desired.last_cycle, len(table) - 2)
    return replace(desired, table=table, levels=levels, last_cycle=last_cycle)


def standing(table: np.ndarray, rows: int) -> np.ndarray:
    """A table of references of at least so many rows: after its end it stands."""
    still = np.zeros((max(rows - len(table), 0), ORDERS))
    still[:, X] = table[-1, X]
    return np.ascontiguousarray(np.concatenate([table, still]))


def full_speed(design: Design, way: int, low_pressure: float) -> float:
    """The largest steady speed [m/s], ≥ 0, in a direction (±1) at the start posture, as the design
    model has it.

    Supply and drivers set it: the lesser of the pump's flow limit and of what the wide-open valves
    pass in the plain working function for the load there, the off-side chamber at ``low_pressure``
    [Pa] above tank; on one spool both edges stand wide open.

    Raises:
        InputError: the valves have no function for it."""
    circuit = design.circuit
    force, p = _at_start(design, low_pressure)
    along = int(-way * force > 0.0)
    fits = [
        f
        for f in range(1, len(FUNCTIONS))
        if circuit.able[f] and (DIRECTION[f], OVERRUNNING[f]) == (way, along)
    ]
    if not fits:
        word = "extend" if way > 0 else "retract"
        raise InputError(message("trial.no_function", cylinder=design.cylinder, direction=word))
    function = min(fits, key=lambda f: CROSS[f] >= 0)
    if coupled(circuit, function):
        speed = _spool_speed(circuit, way, force, p)
    else:
        if CROSS[function] >= 0:
            supply = float(design.model.plant.supply.pressure)
            p = planned(
                function, force, p, circuit, pack_rules(circuit.area_rod, supply, low_pressure)
            )
        speed = top_speed(function, p, circuit)
    return float(min(speed, pump_speed(function, circuit)))


def open_speed(design: Design, way: int) -> float:
    """The steady speed [m/s], ≥ 0, in a direction (±1) with the edges from the supply and to the
    tank wide open and the load of the start posture; 0 where one of them is missing."""
    force, p = _at_start(design, 0.0)
    area = design.circuit.area_head if way > 0 else design.circuit.area_rod
    most = float(design.circuit.supply[0].flow_limit) / area
    return min(_spool_speed(design.circuit, way, force, p), most)


def _at_start(design: Design, low_pressure: float) -> tuple[float, Pressures]:
    """The load force [N] at the start posture and the pressures there, the off-side chamber at
    ``low_pressure`` [Pa] above tank."""
    model, row = design.model, design.row
    p_tank = model.plant.tank_pressure
    # a load-sensing pump rises from its standby as far as the fed chamber asks for
    p_supply = float(sensed(p_tank, model.plant.supply))
    start = model.trim(design.q, p_tank + low_pressure)
    places = (model.layout.state(name, design.index) for name in ("p_head", "p_rod"))
    p_head, p_rod = (float(start[place]) for place in places)
    force = p_head * float(row.area_head) - p_rod * float(row.area_rod)
    return force, Pressures(p_head, p_rod, p_supply, p_tank)


def _spool_speed(circuit: Circuit, way: int, force: float, start: Pressures) -> float:
    """Speed [m/s] of a cylinder on one spool that stands wide open, under a load force [N]."""
    p_supply, p_tank = start.supply, start.tank
    area_head, area_rod = circuit.area_head, circuit.area_rod
    into, out = (SUPPLY_HEAD, ROD_TANK) if way > 0 else (SUPPLY_ROD, HEAD_TANK)
    area_in, area_out = (area_head, area_rod) if way > 0 else (area_rod, area_head)

    def speeds(rod: float) -> tuple[float, float]:
        p = Pressures((force + area_rod * rod) / area_head, rod, p_supply, p_tank)
        return (
            capacity(circuit, into, path_drop(into, p, circuit)) / area_in,
            capacity(circuit, out, path_drop(out, p, circuit)) / area_out,
        )

    # the higher both pressures, the less comes in and the more goes out (extending; retracting the
    # same): bisect the balance
    highest = float(circuit.supply[0].pressure)
    low, high = p_tank - abs(force) / area_rod, highest + abs(force) / area_rod
    for _ in range(60):
        middle = 0.5 * (low + high)
        entering, leaving = speeds(middle)
        low, high = (middle, high) if entering > leaving else (low, middle)
    return min(speeds(0.5 * (low + high)))


def _steps(recipe: TrialRecipe, motion: Motion, design: Design, low_pressure: float) -> References:
    tick = 1.0 / float(recipe.rate)
    speeds, shares, times = [], [], []
    duration, travel = motion.duration, motion.travel
    for index, text in enumerate(motion.levels):
        where = recipe.at(*motion.where, "levels", index)
        share = None
        if text.rstrip().endswith("%"):
            share = float(read_value(text, _SHARE))
            way = -1 if share < 0 else 1
            full = motion.full_speed
            speed = share * (full_speed(design, way, low_pressure) if full is None else float(full))
        else:
            speed = float(read_value(text, VOCABULARY["v"]))
        if speed == 0.0:
            raise InputError(message("trial.zero_level", number=index + 1), **where)
        speeds.append(speed)
        shares.append(share)
        if duration is None:
            assert travel is not None  # the recipe's model sees to it
            times.append(float(travel) / abs(speed))
        else:
            times.append(float(duration))
    rest = MOTION.rest if motion.rest is None else float(motion.rest)
    table = velocity_steps(speeds, duration=times, tick=tick, rest=rest, x=design.x)
    row, levels = round(rest / tick), []
    for speed, share, time in zip(speeds, shares, times, strict=True):
        rows = max(1, round(time / tick))
        levels.append(Level(row, row + rows, speed, share))
        row += rows + round(rest / tick)
    return References(table, tuple(levels))


def limits_of(recipe: TrialRecipe, motion: CylinderMotion, points: int) -> dict[str, Any]:
    """The limits [m/s, m/s², m/s³], rests [s] and profile with which a motion goes through so many
    points.

    Raises:
        InputError: rests that are not one for all or one for each."""
    assert motion.speed is not None  # the recipe's model sees to it
    holds = [float(h) for h in motion.hold] or [MOTION.rest]
    if len(holds) not in (1, points):
        problem = message("trial.hold_count", count=len(holds), points=points)
        raise InputError(problem, **recipe.at(*motion.where, "hold"))
    hold = holds[0] if len(holds) == 1 else holds
    limits = _limits(float(motion.speed), motion.acceleration, motion.jerk)
    return limits | {"hold": hold, "profile": motion.profile}


def _limits(
    speed: float, acceleration: Value | float | None, jerk: Value | float | None
) -> dict[str, Any]:
    """The limits [m/s, m/s², m/s³] of a motion, the usual ones where it states none."""
    rise = speed / MOTION.speed_up if acceleration is None else float(acceleration)
    bend = 4.0 * rise / MOTION.speed_up if jerk is None else float(jerk)
    return {"speed": speed, "acceleration": rise, "jerk": bend}


def _points(recipe: TrialRecipe, motion: Motion, design: Design, low_pressure: float) -> References:
    points = [float(x) for x in motion.waypoints]
    limits = limits_of(recipe, motion, len(points))
    holds = np.broadcast_to(limits["hold"], len(points)).tolist()

    def cycled(cycles: int) -> np.ndarray:
        way = limits | {"hold": holds[:1] + cycles * holds[1:]}
        repeated = points[:1] + cycles * points[1:]
        return point_to_point(repeated, tick=1.0 / float(recipe.rate), **way)

    before = len(cycled(motion.cycles - 1)) - 1 if motion.cycles > 1 else 0
    return References(cycled(motion.cycles), last_cycle=before)


def _file(recipe: TrialRecipe, motion: Motion, design: Design, low_pressure: float) -> References:
    """A log with ``<cylinder>.x_desired`` and, where it has them, speed, acceleration and jerk;
    else a quintic spline's."""
    from scipy.interpolate import make_interp_spline

    assert motion.file is not None  # the recipe's model sees to it
    path = recipe.file(motion.file)
    names = [f"{design.cylinder}.{name}_desired" for name in "xvaj"]
    record = log_with(names[X], path)
    if record.t.size < 6:
        raise InputError(message("trial.short_motion_file", count=record.t.size), file=path)
    t = record.t - record.t[0]
    tick = 1.0 / float(recipe.rate)
    times = np.arange(rows_of(float(t[-1]), float(recipe.rate)) + 1) * tick
    table = np.zeros((times.size, ORDERS))
    inside = np.minimum(times, t[-1])
    curve = make_interp_spline(t, record[names[X]], k=5)
    for column in (X, V, A, J):
        if column > X and names[column] in record:
            curve = make_interp_spline(t, record[names[column]], k=5)
        elif column > X:
            curve = curve.derivative()
        table[:, column] = curve(inside)
    return References(table)


def _operator(
    recipe: TrialRecipe, motion: CylinderMotion, design: Design, low_pressure: float
) -> References:
    table, lever, inputs = commanded(recipe, motion, design, limits_of(recipe, motion, 1))
    return References(table, lever=lever, inputs=inputs)


MOTIONS: dict[str, Callable[[TrialRecipe, Motion, Design, float], References]] = {
    "velocity_steps": _steps,
    "point_to_point": _points,
    "file": _file,
    "operator": _operator,
}
