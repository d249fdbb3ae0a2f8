"""A path of the tip as motions of cylinders: straight lines from point to point, a rest at each,
turned into strokes by the mechanism's own kinematics.

Along a line of length s the strokes are quintic splines through postures that inverse kinematics
finds a few millimetres apart; how s goes with time is a trajectory with bounded jerk."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.recipe import Motion, TrialRecipe
from ehbench.control.trajectory import A, J, V, X, point_to_point
from ehbench.parts.cylinder import joint_range_of, linkage_arrays
from ehbench.physics.tip import FOUND, Chain, Found, polish, reach, tip_of
from ehbench.plant.model import Model
from ehbench.trial.motion import limits_of
from ehbench.vocabulary import InputError, from_si, message, placed, quantity, setting

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


@dataclass(frozen=True)
class PathSettings:
    """How finely a path of the tip becomes postures."""

    spacing: float = setting(0.01, "m", "largest distance between postures", "chosen")
    postures: int = setting(16, "", "smallest number of postures of a line", "chosen")
    coarse: int = setting(9, "", "postures that follow one another", "they stay near")
    error: float = setting(1.0e-5, "m", "largest distance of the tip to its line", "chosen")
    doublings: int = setting(4, "", "doublings of the postures", "ends near singular ones")
    tries: int = setting(64, "", "postures to try for a first point", "six joints, two each")


PATH = PathSettings()


@dataclass(frozen=True)
class Mover:
    """The cylinders that a path moves, by number, and the mechanism that they move."""

    recipe: TrialRecipe
    motion: Motion
    model: Model
    chain: Chain
    moved: dict[str, int]

    @classmethod
    def of(cls, recipe: TrialRecipe, motion: Motion, model: Model) -> Mover:
        """What a recipe's path moves.

        Raises:
            InputError: it names no cylinder of the rig.
        """
        plant, names = model.plant, model.layout.cylinders
        for index, name in enumerate(motion.cylinders):
            with placed(recipe.at(*motion.where, "cylinders", index)):
                model.rig.cylinder_named(name)
        moved = {name: names.index(name) for name in motion.cylinders or names}
        low, high = np.full((2, len(model.layout.joints)), np.nan)
        q = model.posture(recipe.posture)
        low[:], high[:] = q, q
        for index in moved.values():
            row = plant.cylinders[index]
            low[row.joint], high[row.joint] = sorted(joint_range_of(row))
        return cls(
            recipe, motion, model, Chain(plant.kind, plant.links, plant.gravity, low, high), moved
        )

    @property
    def free(self) -> np.ndarray:
        """True for the joints that it moves."""
        free = np.zeros(self.chain.low.size, bool)
        free[[int(self.model.plant.cylinders[i].joint) for i in self.moved.values()]] = True
        return free

    def first(self, point: np.ndarray) -> Found:
        """A posture with the tip at a point: the one nearest to the recipe's. Of a point out of
        reach, the one that comes nearest."""
        begin = self.model.posture(self.recipe.posture)
        result = reach(self.chain, point, begin, self.free)
        if result.there:
            return result
        choices = [(0.2, 0.8) if free else (0.5,) for free in self.free]
        span = self.chain.high - self.chain.low
        tried = [result]
        for share in list(product(*choices))[: PATH.tries]:
            tried.append(reach(self.chain, point, self.chain.low + share * span, self.free))
        there = [item for item in tried if item.there]
        if there:
            return min(there, key=lambda entry: float(np.linalg.norm(entry.q - begin)))
        return min(tried, key=lambda entry: entry.miss)

    def refuse(self, result: Found, what: str, index: int) -> None:
        """Refuse a point that the tip does not come to.

        Raises:
            InputError: which, by how much, at whose end of stroke.
        """
        if result.there:
            return
        ends, rig = [], self.model.rig
        for name, number in self.moved.items():
            row = self.model.plant.cylinders[number]
            way = int(result.beyond[int(row.joint)])
            if way:
                retracted, extended = joint_range_of(row)
                out = (way > 0) == (extended > retracted)
                end = float(row.stroke) if out else 0.0
                ends.append(f"'{name}' at its {rig.shown('x', end)} end")
        reason = message(
            {1: "trial.one_line", 2: "trial.one_surface"}.get(len(self.moved), "trial.stretched")
        )
        raise InputError(
            message(
                "trial.out_of_reach",
                place=what,
                distance=rig.shown("x", result.miss),
                stopped=f": {' and '.join(ends)}" if ends else "",
                reason="" if ends else reason,
            ),
            **self.recipe.at(*self.motion.where, "points", index),
        )

    def between(self, point: np.ndarray, start: np.ndarray, index: int) -> np.ndarray:
        """The posture nearest to ``start`` with the tip at a point of the line to point ``index``.

        Raises:
            InputError: it is out of reach.
        """
        result = reach(self.chain, point, start, self.free)
        place = message("trial.between", before=index, number=index + 1, point=self.at(point))
        self.refuse(result, place, index)
        return result.q

    def at(self, point: np.ndarray) -> str:
        """Where a point [m] is, in the unit that the recipe's points have."""
        row = quantity("tip")
        unit = self.motion.points[0].parts[0].unit or row.unit
        return "(" + ", ".join(f"{from_si(item, unit, row):.4g}" for item in point) + f") {unit}"

    def strokes(self, q: np.ndarray) -> np.ndarray:
        """Strokes [m] of the cylinders that it moves, shape (postures, cylinders)."""
        rows = [self.model.plant.cylinders[i] for i in self.moved.values()]
        return np.column_stack([linkage_arrays(row, q[:, int(row.joint)])[0] for row in rows])

    def leg(
        self, ends: tuple[np.ndarray, np.ndarray], q: np.ndarray, index: int
    ) -> tuple[float, BSpline, np.ndarray]:
        """(length [m] of the line between two points, the strokes' spline by the way made on it,
        the posture at the second), from posture q at the first on.

        Raises:
            InputError: it cannot be followed.
        """
        from scipy.interpolate import make_interp_spline

        (item, other), chain, slack = ends, self.chain, 1e-9
        length = float(np.linalg.norm(other - item))
        where = self.recipe.at(*self.motion.where, "points", index)
        if length <= FOUND:
            raise InputError(message("trial.same_point", number=index + 1, before=index), **where)
        coarse = np.linspace(0.0, 1.0, PATH.coarse)
        begun = []  # each the nearest to the one before
        for point in item + coarse[:, None] * (other - item):
            q = self.between(point, q, index)
            begun.append(q)
        near = make_interp_spline(coarse, np.array(begun), k=3)
        count = max(PATH.postures, int(np.ceil(length / PATH.spacing)))
        off = 0.0
        for _ in range(PATH.doublings):
            share = np.linspace(0.0, 1.0, 2 * count + 1)  # every other one to see how far it is off
            line = item + share[:, None] * (other - item)
            starts = near(share)
            postures, miss = polish(chain, line, starts, self.free)
            out = (postures < chain.low - slack) | (postures > chain.high + slack)
            for i in np.flatnonzero(out[:, self.free].any(axis=1) | (miss > FOUND)):
                postures[i] = self.between(line[i], starts[i], index)
            built = self.strokes(postures)
            curve = make_interp_spline(length * share[::2], built[::2], k=5)
            apart = np.abs(curve(length * share[1::2]) - built[1::2])
            off = float((apart * _tip_slope(self, postures[1::2])).sum(axis=1).max())
            if off <= PATH.error:
                return length, curve, postures[-1]
            count *= 2
        distance = self.model.rig.shown("x", off)
        raise InputError(
            message("trial.near_singular", before=index, number=index + 1, distance=distance),
            **where,
        )


def route(recipe: TrialRecipe, model: Model) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """(where its cylinders start [m], their tables of x, v, a, j), by cylinder, along a recipe's
    path, of the design ``model``.

    Raises:
        InputError: a point that the tip cannot come to, or a line between two that it leaves, with
            the line of the recipe.
    """
    motion = recipe.motion
    assert isinstance(motion, Motion)  # asked of a path only
    mover = Mover.of(recipe, motion, model)
    points = [np.array(point.value, float) for point in motion.points]
    results = [mover.first(point) for point in points]
    for index, (item, point) in enumerate(zip(results, points, strict=True)):
        mover.refuse(item, message("trial.point", number=index + 1, point=mover.at(point)), index)
    q, lengths, curves = results[0].q, [], []
    start = mover.strokes(q[None])[0]
    for index, (item, other) in enumerate(zip(points[:-1], points[1:], strict=True), 1):
        length, curve, q = mover.leg((item, other), q, index)
        lengths.append(length)
        curves.append(curve)
    # the way made along the whole path: s, ṡ, s̈, s⃛
    ends = np.cumsum(lengths)
    limits, tick = limits_of(recipe, motion, len(points)), 1.0 / float(recipe.rate)
    table = point_to_point([0.0, *ends.tolist()], tick=tick, **limits)
    tables = np.zeros((len(mover.moved), len(table), 4))
    of = np.searchsorted(ends[:-1], table[:, X], side="right")
    for number, curve in enumerate(curves):  # the chain rule on each line's splines
        rows = np.flatnonzero(of == number)
        s, v, a, j = table[rows].T
        s = np.clip(s - (ends[number] - lengths[number]), 0.0, lengths[number])
        x, first, second, third = (curve(s, order).T for order in range(4))
        tables[:, rows, X] = x
        tables[:, rows, V] = first * v
        tables[:, rows, A] = second * v**2 + first * a
        tables[:, rows, J] = third * v**3 + 3.0 * second * v * a + first * j
    starts = dict(zip(mover.moved, start.tolist(), strict=True))
    return starts, dict(zip(mover.moved, tables, strict=True))


def _tip_slope(mover: Mover, q: np.ndarray) -> np.ndarray:
    """How far the tip moves for a stroke of each cylinder [m/m], shape (postures, cylinders)."""
    step, slopes = 1e-6, []
    for number in mover.moved.values():
        row = mover.model.plant.cylinders[number]
        joint = int(row.joint)
        moved = q.copy()
        moved[:, joint] += step
        way = np.linalg.norm(tip_of(mover.chain, moved) - tip_of(mover.chain, q), axis=1)
        slopes.append(way / step / np.abs(linkage_arrays(row, q[:, joint])[1]))
    return np.column_stack(slopes)
