"""How well a trial did: pure functions of arrays in SI."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.signals.series import ringing, rms
from ehbench.vocabulary.codes import STALLED, UNABLE

BAND = 0.05  # a step has settled once it stays this near to its steady speed
STEADY = 1.0 / 3.0  # the steady speed is the windowed mean over this last part of a step
LASTS = 0.1  # [s] at its end, what is shorter is a correction's, not the motion's
LESS = 2.0e-3  # of the desired speed: what is less short is noise
FINAL = 0.1  # [s] at the end of a trial over which the final error is averaged


@dataclass(frozen=True)
class StepMeasures:
    """A step of desired speed and what came of it; None where it cannot be read off.

    ``speed`` asked and ``steady_speed`` reached (windowed mean of the last third) [m/s];
    ``steady_error`` their difference as a share of what was asked, negative if too slow;
    ``overshoot`` beyond the steady speed as a share of the rise to it; ``settling_time`` [s] after
    which the speed stays within 5 % of that rise; ``rms_error`` [m/s] against the desired speed;
    ``damping_ratio`` and ``natural_frequency`` [rad/s] of the decay, ``ringing`` says why there are
    none; ``damping_ratio_fitted`` is a likely value where the decay is too fast to ring, or that of
    the decay. A speed that hardly moved has neither overshoot nor settling time."""

    start: float
    duration: float
    speed: float
    share: float | None
    steady_speed: float
    steady_error: float
    overshoot: float | None
    settling_time: float | None
    rms_error: float
    damping_ratio: float | None
    damping_ratio_fitted: float | None
    natural_frequency: float | None
    ringing: str


def step_measures(
    t: np.ndarray,
    v: np.ndarray,
    speed: float,
    before: float = 0.0,
    others: Sequence[np.ndarray] = (),
    share: float | None = None,
) -> StepMeasures:
    """Measures of one step from ``before`` to ``speed`` [m/s] that begins at ``t[0]``.

    Args:
        t: [s], shape (samples,), from the step on, as long as it lasts.
        v: speed [m/s].
        others: more channels that ring with it, such as the chamber pressures.
        share: of the full speed, handed on.
    """
    last = v[-max(1, round(STEADY * v.size)) :]
    # what still rings cancels under a window that fades in and out, and a drift counts as by the
    # plain mean
    steady = float(np.average(last, weights=np.hanning(last.size + 2)[1:-1]))
    way = math.copysign(1.0, speed - before)
    rise = steady - before
    overshoot = settling = None
    if way * rise > BAND * abs(speed - before):
        overshoot = max(0.0, float(np.max(way * (v - steady)))) / abs(rise)
        off = np.flatnonzero(np.abs(v - steady) > BAND * abs(rise))
        # a speed that was off a tenth before the end has not settled
        inside = int(off[-1]) + 1 if off.size else 0
        settling = float(t[inside] - t[0]) if inside < 0.9 * v.size else None
    swing = ringing(t, np.column_stack([v, *others]))
    fitted = swing.damping_ratio if swing.ok else swing.fitted_damping
    return StepMeasures(
        float(t[0]),
        float(t[-1] - t[0]),
        speed,
        share,
        steady,
        steady / speed - 1.0,
        overshoot,
        settling,
        rms(v - speed),
        swing.damping_ratio if swing.ok else None,
        None if math.isnan(fitted) else fitted,
        swing.natural_frequency if swing.ok else None,
        swing.reason,
    )


def tracking_measures(t: np.ndarray, x: np.ndarray, x_desired: np.ndarray) -> dict[str, float]:
    """``max_error``, ``rms_error`` and ``final_error`` [m] (mean of the last 0.1 s, signed) of a
    stroke against the desired one.
    """
    e = x - x_desired
    return {
        "max_error": float(np.abs(e).max()),
        "rms_error": rms(e),
        "final_error": float(np.mean(e[t >= t[-1] - FINAL])),
    }


def function_measures(
    t: np.ndarray, function: np.ndarray, status: np.ndarray, v_desired: np.ndarray
) -> dict[str, float]:
    """How working functions were chosen: the shares of the ticks that were ``stalled`` and
    ``unable``; ``changes`` of the function per second [1/s], and per second of rest those
    ``changes_at_rest``, while no speed was desired.
    """
    changed, rest = (
        np.diff(function.round()) != 0.0,
        (v_desired[1:] == 0.0) & (v_desired[:-1] == 0.0),
    )
    tick = float(t[1] - t[0])
    return {
        "stalled": float(np.mean(status == STALLED)),
        "unable": float(np.mean(status == UNABLE)),
        "changes": float(changed.sum()) / (tick * max(changed.size, 1)),
        "changes_at_rest": float((changed & rest).sum()) / (tick * max(int(rest.sum()), 1)),
    }


def short_measures(
    t: np.ndarray, v: np.ndarray, v_desired: np.ndarray, saturated: np.ndarray
) -> dict[str, float] | None:
    """The longest stretch of at least LASTS in which valves were at their end and the cylinder went
    slower than desired on the whole; None where there is none.

    ``start`` and ``duration`` [s], the mean speeds ``desired`` and ``reached`` [m/s], positive in
    the desired direction.

    Args:
        t: [s], evenly spaced, shape (samples,).
        v: measured speed [m/s].
        v_desired: desired speed [m/s].
        saturated: where a valve was at its end.
    """
    short = np.concatenate([[0], (saturated & (v_desired != 0.0)).astype(int), [0]])
    starts, ends = np.flatnonzero(np.diff(short) > 0), np.flatnonzero(np.diff(short) < 0)
    tick, results = float(t[1] - t[0]), None
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        desired = float(np.mean(np.abs(v_desired[start:end])))
        reached = float(np.mean(v[start:end] * np.sign(v_desired[start:end])))
        lasted = tick * (end - start)
        longest = LASTS if results is None else results["duration"]
        if lasted > longest and reached < (1.0 - LESS) * desired:
            results = {"start": float(t[start]), "duration": lasted}
            results |= {"desired": desired, "reached": reached}
    return results
