"""Several cylinders at once: the motion of each, as long as the longest and no faster than the
pump allows, and the others' motions for laws that use them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.control.axis import Mechanism, axis_of
from ehbench.control.coupling import among_others, joint_motion
from ehbench.control.measured import Pressures
from ehbench.control.registry import LAWS
from ehbench.control.required_flow import Motion, required_flow, torques
from ehbench.control.trajectory import V, X, with_preview
from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of
from ehbench.physics.arm import SLIDE
from ehbench.physics.tip import Chain, tip_of
from ehbench.trial.controllers import Design, controller_of
from ehbench.trial.measures import tracking_measures
from ehbench.trial.motion import References, standing
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class CoordinationSettings:
    """Numbers of several cylinders on one pump."""

    reserve: float = setting(0.1, "", "pump flow kept for corrections", "chosen")
    smooth: float = setting(0.15, "s", "desired time over which the pace changes", "chosen")
    slowed: float = setting(0.999, "", "pace that counts as slowed down", "rounding")
    still: float = setting(1.0e-4, "m/s", "speed of a standing tip", "rounding")


COORDINATION = CoordinationSettings()


@dataclass(frozen=True)
class Pace:
    """How fast time runs along a desired motion, one row a tick of real time.

    ``at`` [s] of the desired motion; ``pace`` σ = d(at)/dt, 1 where nothing is cut, and its
    derivatives ``rate`` [1/s] and ``bend`` [1/s²] in real time."""

    at: np.ndarray
    pace: np.ndarray
    rate: np.ndarray
    bend: np.ndarray

    def of(self, values: np.ndarray, tick: float) -> np.ndarray:
        """Values of the desired motion, a row a tick, as they come in real time."""
        rows = np.arange(len(values)) * tick
        flat = values.reshape(len(values), -1)
        taken = np.column_stack([np.interp(self.at, rows, column) for column in flat.T])
        return taken.reshape((self.at.size, *values.shape[1:]))

    def table(self, desired: np.ndarray, tick: float) -> np.ndarray:
        """A table of x, v, a, j in real time: ``v = v̂ σ``, ``a = â σ² + v̂ σ̇``,
        ``j = ĵ σ³ + 3 â σ σ̇ + v̂ σ̈``."""
        x, v, a, j = self.of(desired, tick).T
        s, rate, bend = self.pace, self.rate, self.bend
        columns = [x, v * s, a * s**2 + v * rate, j * s**3 + 3.0 * a * s * rate + v * bend]
        return np.ascontiguousarray(np.column_stack(columns))


def pace_of(flow: np.ndarray, limit: float, tick: float) -> Pace | None:
    """The pace at which a motion draws no more than a limit; None where it never would.

    The least share that the flow allows within ``smooth`` on either side, smoothed over as much by
    a bell that ends there: so it is nowhere above what the flow allows, and its second derivative
    is continuous.

    Args:
        flow: that the desired motion draws [m³/s], a row a tick.
        limit: [m³/s], > 0.
        tick: [s]."""
    from scipy.ndimage import minimum_filter1d

    share = np.minimum(1.0, limit / np.maximum(flow, 1e-3 * limit))
    if (share == 1.0).all():
        return None
    half = max(1, round(COORDINATION.smooth / tick))
    bell = (1.0 - (np.arange(-half, half + 1) / (half + 1.0)) ** 2) ** 3
    minimum = minimum_filter1d(share, 2 * half + 1, mode="nearest")
    pace = np.convolve(np.pad(minimum, half, mode="edge"), bell / bell.sum(), mode="valid")
    slope = np.gradient(pace, tick)
    curve = np.gradient(slope, tick)
    # real time at each row of the desired motion, then the other way round
    real = np.concatenate([[0.0], np.cumsum(0.5 * tick * (1.0 / pace[1:] + 1.0 / pace[:-1]))])
    rows = np.arange(flow.size) * tick
    at = np.interp(np.arange(int(np.ceil(real[-1] / tick - 1e-9)) + 1) * tick, real, rows)
    sigma, first, second = (np.interp(at, rows, item) for item in (pace, slope, curve))
    return Pace(at, sigma, first * sigma, second * sigma**2 + first**2 * sigma)


@dataclass(frozen=True)
class Driven:
    """A cylinder that a controller moves: the trial as it would be for it alone, its design, and
    what it shall do."""

    recipe: TrialRecipe
    design: Design
    references: References

    @property
    def cylinder(self) -> str:
        """Its name."""
        return self.design.cylinder


def as_long(motions: Sequence[References]) -> list[References]:
    """Motions that all last as long as the longest: the others stand where they end."""
    count = max(len(motion.table) for motion in motions)
    return [replace(motion, table=standing(motion.table, count)) for motion in motions]


@dataclass(frozen=True)
class Plan:
    """What several cylinders shall do together, a row a tick.

    ``tip`` is where that brings the tip [m], shape (samples, 3), ``way`` its way as a unit vector;
    ``required`` the flow that the desired motion draws from the supply [m³/s], ``pace`` at
    which it runs, ``limit`` the pump's [m³/s], ``longer`` [s] what the trial lasts longer for it.
    """

    chain: Chain
    joints: tuple[str, ...]
    posture: np.ndarray
    tip: np.ndarray
    way: np.ndarray
    required: np.ndarray
    pace: np.ndarray
    limit: float
    longer: float

    def channels(self, rows: slice, coordinates: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The plan's channels over some rows of a trial, and where the tip was by the joint
        ``coordinates`` that are given; past its end the plan stands."""
        at = np.minimum(np.arange(rows.start, rows.stop), len(self.tip) - 1)
        beyond = np.arange(rows.start, rows.stop) >= len(self.tip)
        q = np.tile(self.posture, (at.size, 1))
        for joint, channel in enumerate(self.joints):
            if channel in coordinates:
                q[:, joint] = coordinates[channel]
        tip, desired = tip_of(self.chain, q), self.tip[at]
        error = tip - desired
        along = np.einsum("ij,ij->i", error, self.way[at])
        across = error - along[:, None] * self.way[at]
        channels = {f"tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
        channels |= {f"tip_{axis}_desired": desired[:, i] for i, axis in enumerate("xyz")}
        channels["tip_error"] = np.linalg.norm(error, axis=1)
        channels["tip_across"] = np.linalg.norm(across, axis=1)
        channels["flow_demand"] = np.where(beyond, 0.0, self.required[at])
        channels["flow_planned"] = channels["flow_demand"] * self.pace[at]
        channels["pace"] = self.pace[at]
        return channels

    def measures(self, record: Record, rows: int) -> dict[str, Any]:
        """``tip`` errors [m] of a trial up to a row, and ``sharing`` of the pump's flow."""
        t, error, across = (record[name][:rows] for name in ("t", "tip_error", "tip_across"))
        slow = self.pace < COORDINATION.slowed
        tick = float(record.t[1] - record.t[0]) if record.t.size > 1 else 0.0
        sharing = {
            "flow_limit": self.limit if math.isfinite(self.limit) else None,
            "flow_demand": float(self.required.max()),
            "flow_planned": float((self.required * self.pace).max()),
            "slowed": float(np.count_nonzero(slow)) * tick,
            "pace": float(self.pace.min()),
            "longer": self.longer,
        }
        tip = tracking_measures(t, error, np.zeros(rows))
        return {"tip": tip | {"max_across": float(across.max())}, "sharing": sharing}


def joints_of(driven: Sequence[Driven]) -> tuple[np.ndarray, np.ndarray]:
    """(q of all joints, shape (samples, n); q̇, q̈, q⃛, shape (3, samples, n)) of a motion."""
    design, count = driven[0].design, len(driven[0].references.table)
    q = np.tile(design.q, (count, 1))
    moved = np.zeros((3, count, design.q.size))
    for item in driven:
        row, table = item.design.row, item.references.table
        joint = int(row.joint)
        q[:, joint] = joint_of(row, table[:, X])
        moved[:, :, joint] = joint_motion(row, q[:, joint], table).T
    return q, moved


def tables_of(driven: Sequence[Driven]) -> list[np.ndarray]:
    """The table that each law runs over: its cylinder's motion, for a law that uses the others'
    that of all joints after it, and for one that looks ahead the speeds to come."""
    # what an operator will do nobody knows
    known = all(item.references.lever is None for item in driven)
    joints = joints_of(driven)[1] if known and len(driven) > 1 else None
    widened = []
    for item in driven:
        chosen = controller_of(item.recipe)
        law = None if chosen.kind is None else LAWS[chosen.kind]
        wide = table = item.references.table
        if law is not None and joints is not None and chosen.coupling and law.ahead > 0.0:
            wide = among_others(table, joints, law.ahead)
        if law is not None and law.preview > 0.0:
            tick = 1.0 / float(item.recipe.rate)
            preview = law.preview if known else 0.0
            wide = with_preview(wide, table[:, V], preview, tick)
        widened.append(wide)
    return widened


def planned(
    driven: Sequence[Driven], rules: Sequence[np.record], low: float, share: bool
) -> tuple[tuple[Driven, ...], Plan]:
    """What several cylinders shall do together, slowed down where the pump has not enough if
    ``share``.

    Args:
        driven: the cylinders with the motions that are desired, all of one length.
        rules: of function selection of each.
        low: pressure [Pa] of a chamber that carries nothing.
        share: False leaves the motions as they are."""
    design, recipe = driven[0].design, driven[0].recipe
    plant, tick = design.model.plant, 1.0 / float(recipe.rate)
    mechanism = Mechanism(plant.kind, plant.gravity, plant.links, plant.cylinders.joint, design.q)
    q, joints = joints_of(driven)
    torque = torques(mechanism, q, joints)
    line = Pressures(low, low, float(plant.supply.pressure), float(plant.tank_pressure))
    required = np.zeros(len(q))
    for item, rule in zip(driven, rules, strict=True):
        row = item.design.row
        axis, joint = axis_of(item.design.circuit, mechanism, row, plant.forces), int(row.joint)
        motion = Motion(item.references.table[:, V], torque[:, joint], q[:, joint])
        required += required_flow(axis, motion, line, tick, rule)
    limit = float(plant.supply.flow_limit)
    pace = None
    if share and math.isfinite(limit):
        pace = pace_of(required, (1.0 - COORDINATION.reserve) * limit, tick)
    before, run_pace = len(q), np.ones(len(q))
    if pace is not None:
        driven = tuple(
            replace(item, references=slower(item.references, pace, tick)) for item in driven
        )
        q, required, run_pace = pace.of(q, tick), pace.of(required, tick), pace.pace
    none = np.full(design.q.size, np.nan)
    chain = Chain(plant.kind, plant.links, plant.gravity, none, none)
    tip = tip_of(chain, q)
    names = design.model.layout.cylinders
    channel = "x" if plant.kind == SLIDE else "q"
    by_joint = {int(row.joint): f"{name}.{channel}" for name, row in zip(names, plant.cylinders)}
    plan = Plan(
        chain,
        tuple(by_joint.get(joint, "") for joint in range(design.q.size)),
        design.q,
        tip,
        _direction(tip, tick),
        required,
        run_pace,
        limit,
        (len(q) - before) * tick,
    )
    return tuple(driven), plan


def slower(motion: References, pace: Pace, tick: float) -> References:
    """A motion at a pace of its own."""
    table = pace.table(motion.table, tick)
    levels = tuple(
        replace(
            level,
            first=int(np.searchsorted(pace.at, level.first * tick)),
            stop=int(np.searchsorted(pace.at, level.stop * tick)),
        )
        for level in motion.levels
    )
    return replace(motion, table=table, levels=levels)


def _direction(tip: np.ndarray, tick: float) -> np.ndarray:
    """Unit vectors of the tip's way, shape (samples, 3); where it stands that on which it came, or
    first goes; 0 if it never moves."""
    speed = np.gradient(tip, tick, axis=0)
    size = np.linalg.norm(speed, axis=1)
    moves = np.flatnonzero(size > COORDINATION.still)
    if not moves.size:
        return np.zeros_like(speed)
    last = moves[np.maximum(np.searchsorted(moves, np.arange(len(tip)), side="right") - 1, 0)]
    return speed[last] / size[last, None]
