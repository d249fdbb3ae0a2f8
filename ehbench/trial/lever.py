"""Levers: how a person's deflections become the motion of a cylinder.

A lever's deflection becomes a desired speed, and that a desired stroke, by rules that know nothing
of the clock: the deflections of a log give the same motion once more, to the bit."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ehbench.config.recipe import CylinderMotion, TrialRecipe
from ehbench.control.trajectory import ORDERS, A, X
from ehbench.preprocessing.time_base import parts_of
from ehbench.runtime.memory import rows_of
from ehbench.trial.commands import log_with
from ehbench.trial.controllers import Design
from ehbench.vocabulary import InputError, message, placed, setting

DEFLECTION, DEADMAN = range(2)  # columns of what a lever said
LEVER_CHANNELS = ("operator", "deadman")  # by which logs have them


@dataclass(frozen=True)
class OperatorSettings:
    """Numbers of a motion that an operator commands."""

    reserve: float = setting(
        0.02, "", "stroke kept from the margin, as a share", "following error of a sound trial"
    )


OPERATOR = OperatorSettings()


@dataclass(frozen=True)
class Lever:
    """How a deflection becomes the motion of a cylinder: full ``speed`` [m/s], ``acceleration``
    [m/s²] at most, ``dead_zone``, the strokes between ``low`` and ``high`` [m], ``tick`` [s]; the
    ``axis`` of a joystick."""

    speed: float
    acceleration: float
    dead_zone: float
    low: float
    high: float
    tick: float
    axis: str = ""

    def follow(self, x: float, v: float, deflection: float) -> tuple[float, float, float]:
        """Stroke [m], speed [m/s] and acceleration [m/s²] one tick after ``x`` and ``v``.

        The speed goes to its share of the full one as fast as allowed, and never is so high that
        the cylinder could not stop within the strokes."""
        share = max(abs(deflection) - self.dead_zone, 0.0) / (1.0 - self.dead_zone)
        step = self.acceleration * self.tick
        desired = math.copysign(self.speed * share, deflection)
        faster = min(max(desired, v - step), v + step)
        faster = min(faster, self._stopping_speed(self.high - x, v))
        faster = max(faster, -self._stopping_speed(x - self.low, -v))
        return x + 0.5 * self.tick * (v + faster), faster, (faster - v) / self.tick

    def _stopping_speed(self, distance: float, v: float) -> float:
        """The highest speed u [m/s] one tick later from which the cylinder stops within a distance
        [m]: ``(v + u) h/2 + u²/2a = distance − a h²/8``, the last for the tick in which it stops.
        """
        half, a = 0.5 * self.tick, self.acceleration
        ahead = max(distance - half * v - 0.5 * a * half**2, 0.0)
        return a * (math.sqrt(half**2 + 2.0 * ahead / a) - half)

    def table(self, x: float, deflections: np.ndarray) -> np.ndarray:
        """References x, v, a, j of a stand at ``x`` [m] and of the deflection in each row."""
        table, v = np.zeros((len(deflections), ORDERS)), 0.0
        table[:, X] = x
        for row, deflection in enumerate(deflections[1:].tolist(), 1):
            x, v, a = self.follow(x, v, deflection)
            table[row, : A + 1] = x, v, a
        return table


def commanded(
    recipe: TrialRecipe, motion: CylinderMotion, design: Design, limits: Mapping[str, float]
) -> tuple[np.ndarray, Lever, np.ndarray]:
    """(table of references, lever, what it said in each row) of a cylinder that an operator moves:
    of the log that the motion names, else a stand for the recipe's duration; ``limits`` are speed
    [m/s] and acceleration [m/s²].

    Raises:
        InputError: a log without the lever's channel, or with a gap."""
    rate, stroke, margin = float(recipe.rate), float(design.row.stroke), recipe.limits.stroke_margin
    room = OPERATOR.reserve * stroke + (0.0 if margin is None else float(margin))
    speed, rise, zone = limits["speed"], limits["acceleration"], float(motion.dead_zone)
    lever = Lever(speed, rise, zone, room, stroke - room, 1.0 / rate, motion.axis)
    if motion.file is not None:
        inputs = _logged(recipe, motion.file, design.cylinder)
    else:
        assert recipe.duration is not None  # the recipe's model sees to it
        with placed(recipe.at("duration")):
            inputs = np.zeros((rows_of(float(recipe.duration), rate) + 1, len(LEVER_CHANNELS)))
    return lever.table(design.x, inputs[:, DEFLECTION]), lever, inputs


def _logged(recipe: TrialRecipe, file: str, cylinder: str) -> np.ndarray:
    """What a lever said in a log or in the run of a trial, shape (rows, 2); nothing where the
    dead-man switch is open.

    Raises:
        InputError: a log without the lever's channel, or with a gap."""
    rate, names = float(recipe.rate), [f"{cylinder}.{name}" for name in LEVER_CHANNELS]
    path = recipe.file(file)
    record = log_with(names[DEFLECTION], path)
    lever = {name: y for name, y in record.channels.items() if name in names}
    before, *after = (part.record.t for part in parts_of(file, replace(record, channels=lever))[0])
    if after:  # a deflection would be held where nobody may have held the lever
        fields = {"t": before[-1], "seconds": after[0][0] - before[-1]}
        raise InputError(message("trial.lever_gap", **fields), file=path)
    t = record.t - record.t[0]
    times = np.arange(rows_of(float(t[-1]), rate) + 1) / rate
    rows = np.searchsorted(t, times + 0.1 / rate, side="right") - 1
    pressed = record.channels.get(names[DEADMAN], np.ones(t.size))
    return np.column_stack([record[names[DEFLECTION]] * (pressed > 0.0), pressed])[rows]
