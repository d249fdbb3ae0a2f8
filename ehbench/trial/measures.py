"""How well a trial did, from arrays in SI, and what a law learnt of its flow maps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ehbench.data.record import Record
from ehbench.diagnosis.recordings import STILL
from ehbench.machines.protocol import Machine, static_flow_of
from ehbench.parts.edge import edge_flows, edge_onset
from ehbench.signals.series import ringing, rms, stretches_of
from ehbench.trial.controllers import Design
from ehbench.vocabulary import setting
from ehbench.vocabulary.codes import STALLED, UNABLE


@dataclass(frozen=True)
class MeasureSettings:
    """Numbers of the measures of a trial."""

    band: float = setting(0.05, "", "band of a settled speed, of the rise", "usual definition")
    steady: float = setting(1.0 / 3.0, "", "last part of a step that is steady", "swings decay")
    unsettled: float = setting(0.9, "", "time by which a step settles, of it", "chosen")
    shaped: float = setting(
        1e-3,
        "",
        "share of a step that its shaped speed lacks as the decay begins",
        "filters near it",
    )
    lasts: float = setting(0.1, "s", "shortest shortfall of speed", "corrections are shorter")
    less: float = setting(2.0e-3, "", "smallest shortfall, of the desired speed", "noise")
    final: float = setting(0.1, "s", "end over which the final error is averaged", "noise")
    used: float = setting(0.05, "", "flow of a used edge, of its largest", "chosen")
    openings: tuple = setting((0.15, 1.0, 12), "", "openings that are compared", "chosen")
    shifts: tuple = setting((-1.0, 1.0, 401), "V", "deadbands that are compared", "chosen")


MEASURES = MeasureSettings()


@dataclass(frozen=True)
class StepMeasures:
    """A step of desired speed and what came of it; None where it cannot be read off.

    ``speed`` asked and ``steady_speed`` reached (windowed mean of the last third) [m/s];
    ``steady_error`` their difference as a share of what was asked, negative if too slow;
    ``overshoot`` beyond the steady speed as a share of the rise to it; ``settling_time`` [s] after
    which the speed stays within 5 % of that rise; ``rms_error`` [m/s] against the desired speed;
    ``damping_ratio`` and ``natural_frequency`` [rad/s] of the decay, ``ringing`` says why there are
    none; ``damping_ratio_fitted`` is a likely value where the decay is too fast to ring, or that of
    the decay. A speed that hardly moved or swings ever more has neither overshoot nor settling
    time."""

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
    asked: np.ndarray | None = None,
) -> StepMeasures:
    """Measures of one step from ``before`` to ``speed`` [m/s] that begins at ``t[0]``.

    Args:
        t: [s], shape (samples,), from the step on, as long as it lasts.
        v: speed [m/s].
        others: more channels that ring with it, such as the chamber pressures.
        share: of the full speed, handed on.
        asked: desired speed [m/s] as the controller shapes it, shape (samples,), None where it
            jumps; the decay begins once it has come.
    """
    last = v[-max(1, round(MEASURES.steady * v.size)) :]
    # what still rings cancels under a window that fades in and out, and a drift counts as by the
    # plain mean
    steady = float(np.average(last, weights=np.hanning(last.size + 2)[1:-1]))
    way = math.copysign(1.0, speed - before)
    rise = steady - before
    overshoot = settling = None
    if way * rise > MEASURES.band * abs(speed - before):
        overshoot = max(0.0, float(np.max(way * (v - steady)))) / abs(rise)
        off = np.flatnonzero(np.abs(v - steady) > MEASURES.band * abs(rise))
        # a speed that was off a tenth before the end has not settled
        inside = int(off[-1]) + 1 if off.size else 0
        settling = float(t[inside] - t[0]) if inside < MEASURES.unsettled * v.size else None
    shaped = 0
    if asked is not None:
        lacks = np.flatnonzero(np.abs(asked - speed) > MEASURES.shaped * abs(speed - before))
        shaped = int(lacks[-1]) + 1 if lacks.size else 0
    swing = ringing(t[shaped:], np.column_stack([v, *others])[shaped:])
    if swing.ok and swing.damping_ratio < 0.0:  # what grows has no steady speed to overshoot
        overshoot = settling = None
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
    stroke against the desired one."""
    e = x - x_desired
    return {
        "max_error": float(np.abs(e).max()),
        "rms_error": rms(e),
        "final_error": float(np.mean(e[t >= t[-1] - MEASURES.final])),
    }


def function_measures(
    t: np.ndarray, function: np.ndarray, status: np.ndarray, v_desired: np.ndarray
) -> dict[str, float]:
    """How working functions were chosen: the shares of the ticks that were ``stalled`` and
    ``unable``; ``changes`` of the function per second [1/s], and per second of rest those
    ``changes_at_rest``, while no speed was desired."""
    changed = np.diff(function.round()) != 0.0
    rest = (v_desired[1:] == 0.0) & (v_desired[:-1] == 0.0)
    tick = float(t[1] - t[0])
    return {
        "stalled": float(np.mean(status == STALLED)),
        "unable": float(np.mean(status == UNABLE)),
        "changes": float(changed.sum()) / (tick * max(changed.size, 1)),
        "changes_at_rest": float((changed & rest).sum()) / (tick * max(int(rest.sum()), 1)),
    }


def unmoved_measures(
    t: np.ndarray, x: np.ndarray, x_desired: np.ndarray
) -> dict[str, float] | None:
    """For how long a cylinder that stood still was to move, ``duration`` [s], and its mean speed
    ``desired`` [m/s] then; None of one that moved.

    Args:
        t: [s], evenly spaced, shape (samples,).
        x: measured stroke [m].
        x_desired: desired stroke [m].
    """
    steps = np.abs(np.diff(x_desired))
    lasted = float(t[1] - t[0]) * int(np.count_nonzero(steps))
    if lasted < MEASURES.lasts or np.ptp(x) >= STILL * np.ptp(x_desired):
        return None
    return {"duration": lasted, "desired": float(steps.sum()) / lasted}


def short_measures(
    t: np.ndarray, v: np.ndarray, v_desired: np.ndarray, saturated: np.ndarray
) -> dict[str, float] | None:
    """The longest stretch of at least ``lasts`` in which valves were at their end and the cylinder
    went slower than desired on the whole; None where there is none.

    ``start`` and ``duration`` [s], the mean speeds ``desired`` and ``reached`` [m/s], positive in
    the desired direction.

    Args:
        t: [s], evenly spaced, shape (samples,).
        v: measured speed [m/s].
        v_desired: desired speed [m/s].
        saturated: where a valve was at its end.
    """
    tick, results = float(t[1] - t[0]), None
    for start, end in stretches_of(saturated & (v_desired != 0.0)).tolist():
        desired = float(np.mean(np.abs(v_desired[start:end])))
        reached = float(np.mean(v[start:end] * np.sign(v_desired[start:end])))
        lasted = tick * (end - start)
        longest = MEASURES.lasts if results is None else results["duration"]
        if lasted > longest and reached < (1.0 - MEASURES.less) * desired:
            results = {"start": float(t[start]), "duration": lasted}
            results |= {"desired": desired, "reached": reached}
    return results


def learnt_maps(design: Design, machine: Machine, record: Record, rows: int) -> dict[str, Any]:
    """Of each edge that passed oil the correction at the end, and where the machine can tell, the
    true one.

    ``gain`` [1] and ``shift`` of the deadband [V]; ``true_gain``, ``true_shift`` fit the machine's
    own flow at the openings that were used; ``error_before`` and ``error_after`` [1] are the
    largest errors of the map there, of its largest flow, without and with the correction."""
    results: dict[str, Any] = {}
    for number, edge in enumerate(design.edges):
        name = f"{edge}.map_gain"
        if name not in record:
            continue
        use = _use(design, number, record, rows)
        if use is None:
            continue
        gain, shift = (float(record[f"{edge}.map_{word}"][rows - 1]) for word in ("gain", "shift"))
        results[edge] = {"gain": gain, "shift": shift}
        flow = static_flow_of(machine)
        if flow is not None:
            results[edge] |= _true_correction(design, number, use, flow(edge, *use), (gain, shift))
    return results


def _use(
    design: Design, number: int, record: Record, rows: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """How an edge was used: (commands [V] from near its onset up to the largest, the median drop
    [Pa] along it at each); None where it was not."""
    edge, row = design.edges[number], design.circuit.edges[design.circuit.first + number]
    flow = np.abs(record[f"{edge}.flow_desired"][:rows])
    used = flow > MEASURES.used * flow.max(initial=0.0)
    command = row.sign * record[f"{design.valves[row.valve]}.command"][:rows]
    onset = abs(float(edge_onset(row, design.circuit.maps)))
    used &= command > onset
    if not used.any():
        return None
    nodes = {"supply": "p_supply", "tank": "p_tank"} | {
        end: f"{design.cylinder}.p_{end}" for end in ("head", "rod")
    }
    item = design.rig.all_edges()[edge]
    pressures = [record[nodes[end]][:rows][used] for end in (item.from_, item.to)]
    drop = float(np.median(pressures[0] - pressures[1]))
    maximum, openings = float(command[used].max()), np.linspace(*MEASURES.openings)
    commands = row.sign * (onset + openings * (maximum - onset))
    return None if drop == 0.0 else (commands, np.full(commands.size, drop))


def _true_correction(
    design: Design,
    number: int,
    use: tuple[np.ndarray, np.ndarray],
    true: np.ndarray,
    learnt: tuple[float, float],
) -> dict[str, float]:
    commands, drops = use
    row, maps = design.circuit.edges[design.circuit.first + number], design.circuit.maps

    def mapped(shift: float) -> np.ndarray:
        flows = np.empty(commands.size)
        edge_flows(drops, commands - row.sign * shift, row, maps, flows)
        return flows

    tried = []
    for shift in np.linspace(*MEASURES.shifts).tolist():
        flow = mapped(shift)
        gain = float(flow @ true) / max(float(flow @ flow), 1e-300)
        tried.append((float(np.sum((gain * flow - true) ** 2)), gain, shift))
    _, gain, shift = min(tried)
    largest = float(np.abs(true).max()) or 1.0
    before, after = mapped(0.0) - true, learnt[0] * mapped(learnt[1]) - true
    return {
        "true_gain": gain,
        "true_shift": shift,
        "error_before": float(np.abs(before).max()) / largest,
        "error_after": float(np.abs(after).max()) / largest,
    }
