"""Several cylinders at once: the motion of each, as long as the longest and no faster than the
pump allows, and what each law is told of the others'.
"""

from __future__ import annotations

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
from ehbench.control.trajectory import ORDERS, V, X, with_preview
from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of
from ehbench.physics.arm import SLIDE
from ehbench.physics.tip import Chain, tip_of
from ehbench.signals.series import rms
from ehbench.trial.controllers import Design, controller_of
from ehbench.trial.measures import FINAL
from ehbench.trial.motion import References
from ehbench.trial.sharing import RESERVE, Pace, pace_of

SLOWED = 0.999  # pace below which a motion counts as slowed down
STANDS = 1.0e-4  # [m/s] below which the tip counts as standing


@dataclass(frozen=True)
class Driven:
    """A cylinder that a controller moves: the trial as it would be for it alone, its design, and
    what it shall do.
    """

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
    longer = []
    for motion in motions:
        still = np.zeros((count - len(motion.table), ORDERS))
        still[:, X] = motion.table[-1, X]
        longer.append(
            replace(motion, table=np.ascontiguousarray(np.concatenate([motion.table, still])))
        )
    return longer


@dataclass(frozen=True)
class Plan:
    """What several cylinders shall do together, a row a tick.

    ``tip`` is where that brings the tip [m], shape (samples, 3), ``way`` its way as a unit vector;
    ``demand`` the flow that the motion draws from the supply as it is desired [m³/s], ``pace`` at
    which it runs, ``limit`` the pump's [m³/s], ``longer`` [s] what the trial lasts longer for it.
    """

    chain: Chain
    joints: tuple[str, ...]
    posture: np.ndarray
    tip: np.ndarray
    way: np.ndarray
    demand: np.ndarray
    pace: np.ndarray
    limit: float
    longer: float

    def channels(self, rows: slice, coordinates: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The plan's channels over some rows of a trial, and where the tip was by the joint
        ``coordinates`` that are given; past its end the plan stands.
        """
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
        built = {f"tip_{axis}": tip[:, i] for i, axis in enumerate("xyz")}
        built |= {f"tip_{axis}_desired": desired[:, i] for i, axis in enumerate("xyz")}
        built["tip_error"] = np.linalg.norm(error, axis=1)
        built["tip_across"] = np.linalg.norm(across, axis=1)
        built["flow_demand"] = np.where(beyond, 0.0, self.demand[at])
        built["flow_planned"] = built["flow_demand"] * self.pace[at]
        built["pace"] = self.pace[at]
        return built

    def measures(self, record: Record, rows: int) -> dict[str, Any]:
        """``tip`` errors [m] of a trial up to a row, and ``sharing`` of the pump's flow."""
        error, across = (record[name][:rows] for name in ("tip_error", "tip_across"))
        slow = self.pace < SLOWED
        tick = float(record.t[1] - record.t[0]) if record.t.size > 1 else 0.0
        sharing = {
            "flow_limit": self.limit if math.isfinite(self.limit) else None,
            "flow_demand": float(self.demand.max()),
            "flow_planned": float((self.demand * self.pace).max()),
            "slowed": float(np.count_nonzero(slow)) * tick,
            "pace": float(self.pace.min()),
            "longer": self.longer,
        }
        tip = {
            "max_error": float(error.max()),
            "rms_error": rms(error),
            "final_error": float(np.mean(error[record.t[:rows] >= record.t[rows - 1] - FINAL])),
            "max_across": float(across.max()),
        }
        return {"tip": tip, "sharing": sharing}


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
    """The table that each law runs over: its own motion, for a law that counts on the others' that
    of all joints behind it, and for one that looks ahead what speeds are to come.
    """
    joints = joints_of(driven)[1] if len(driven) > 1 else None
    widened = []
    for item in driven:
        chosen = controller_of(item.recipe)
        law = None if chosen.kind is None else LAWS[chosen.kind]
        wide = table = item.references.table
        if law is not None and joints is not None and chosen.coupling and law.ahead > 0.0:
            wide = among_others(table, joints, law.ahead)
        if law is not None and law.preview > 0.0:
            tick = 1.0 / float(item.recipe.rate)
            wide = with_preview(wide, table[:, V], law.preview, tick)
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
        share: False leaves the motions as they are.
    """
    design, recipe = driven[0].design, driven[0].recipe
    plant, tick = design.model.plant, 1.0 / float(recipe.rate)
    mechanism = Mechanism(plant.kind, plant.gravity, plant.links, plant.cylinders.joint, design.q)
    q, joints = joints_of(driven)
    torque = torques(mechanism, q, joints)
    line = Pressures(low, low, float(plant.supply.pressure), float(plant.tank_pressure))
    demand = np.zeros(len(q))
    for item, rule in zip(driven, rules, strict=True):
        axis, joint = (
            axis_of(item.design.circuit, mechanism, item.design.row),
            int(item.design.row.joint),
        )
        motion = Motion(item.references.table[:, V], torque[:, joint], q[:, joint])
        demand += required_flow(axis, motion, line, tick, rule)
    limit = float(plant.supply.flow_limit)
    pace = None
    if share and math.isfinite(limit):
        pace = pace_of(demand, (1.0 - RESERVE) * limit, tick)
    before, built = len(q), np.ones(len(q))
    if pace is not None:
        driven = tuple(
            replace(item, references=slower(item.references, pace, tick)) for item in driven
        )
        q, demand, built = pace.of(q, tick), pace.of(demand, tick), pace.pace
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
        _way(tip, tick),
        demand,
        built,
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


def _way(tip: np.ndarray, tick: float) -> np.ndarray:
    """Unit vectors of the tip's way, shape (samples, 3); where it stands that on which it came, or
    first goes; 0 if it never moves.
    """
    speed = np.gradient(tip, tick, axis=0)
    size = np.linalg.norm(speed, axis=1)
    moves = np.flatnonzero(size > STANDS)
    if not moves.size:
        return np.zeros_like(speed)
    last = moves[np.maximum(np.searchsorted(moves, np.arange(len(tip)), side="right") - 1, 0)]
    return speed[last] / size[last, None]
