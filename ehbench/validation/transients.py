"""Ringing of a cylinder after a command step, recorded and simulated, and whether it can be judged.

A window is judged only where something rings: its command stands for several periods of what is
found, the oscillation decays, and halves of the window tell the same frequency."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ehbench.data.record import Record
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import TOGETHER, least_change
from ehbench.signals import series
from ehbench.validation.residuals import Pair
from ehbench.validation.results import Ring, Transient
from ehbench.vocabulary.quantities import GAUGES

STANDS = 2.5  # periods of what rings for which the command must stand
CREEPS = 0.1  # share of the step by which a standing command may still move
REPEATS = 0.15  # share by which the frequency of a half may differ, beyond three standard errors
ALIKE = 3.0  # these standard errors
OSCILLATES = ("qd", "v", "p_head", "p_rod", *GAUGES)  # a position integrates an oscillation away


def transients_of(
    record: Record, model: Model, cylinder: str, pairs: Mapping[str, Pair]
) -> list[Transient]:
    """The ringing after each change of the cylinder's own commands, until any command changes
    again.
    """
    minimum = {f"{c.name}.{v.name}.command": least_change(v) for c, v in model.rig.valves()}
    names = [f"{valve}.command" for valve in model.layout.valves if f"{valve}.command" in record]
    given = np.column_stack([held(record[name], minimum[name]) for name in names])
    mine = [name.startswith(f"{cylinder}.") for name in names]
    own, raw = given[:, mine], np.column_stack([record[name] for name in names])[:, mine]
    seen = [
        pair
        for channel, pair in pairs.items()
        if channel.startswith(f"{cylinder}.") and channel.rsplit(".", 1)[1] in OSCILLATES
    ]
    results = []
    for window in series.transients(record.t, given):
        before = max(0, window.start - 1 - round(TOGETHER / record.sample_time))
        if not seen or not np.any(own[window.start] != own[before : window.start]):
            continue
        t = record.t[window]
        if not stands(raw[before : window.stop], window.start - before):
            none = Ring(reason="the command does not stand")
            results.append(Transient(cylinder, float(t[0]), float(t[-1]), none, none))
            continue
        measured = np.column_stack([pair.recorded[window] for pair in seen])
        modelled = np.column_stack([pair.simulated[window] for pair in seen])
        recorded = series.ringing(t, measured)
        simulated = series.ringing_like(t, modelled, recorded)
        stop, note = float(t[-1]), ""
        if recorded.ok:
            stop, note = recorded.stop, doubt(t, measured, recorded)
        rings = (Ring.of(recorded), Ring.of(simulated))
        results.append(Transient(cylinder, float(t[0]), stop, *rings, note=note))
    return results


def held(command: np.ndarray, span: float) -> np.ndarray:
    """A command that keeps its value until it has changed by more than ``span`` [V], so that noise
    makes no steps.
    """
    last, retained = command[0], np.empty_like(command)
    for i, value in enumerate(command.tolist()):
        if abs(value - last) > span:
            last = value
        retained[i] = last
    return retained


def stands(commands: np.ndarray, begin: int) -> bool:
    """Whether commands [V], shape (samples, valves), stand from sample ``begin`` on where they have
    just stepped: a sine or a slow ramp only seems to, within the noise.
    """
    step = float(np.max(np.abs(commands[begin] - commands[0])))
    parts = np.array([part.mean(axis=0) for part in np.array_split(commands[begin:], 3)])
    return float(np.max(np.ptp(parts, axis=0))) <= CREEPS * step


def doubt(t: np.ndarray, y: np.ndarray, result: series.Ringing) -> str:
    """Why an oscillation that was found in a window cannot be judged; '' if it can.

    Args:
        t: of the window, while the command stands [s].
        y: what rings, shape (samples, channels).
        found: in it.
    """
    if result.damping_ratio <= 0.0:
        return f"it grows (damping ratio {result.damping_ratio:.2g})"
    shape = math.sqrt(max(0.0, 1.0 - result.damping_ratio**2))
    periods = float(t[-1] - t[0]) * result.natural_frequency * shape / (2.0 * math.pi)
    if periods < STANDS:
        return f"the command stands for {periods:.1f} periods of it only"
    halves = [half for half in _halves(t, y, result) if half.ok]
    if not halves:
        return "no half of the window shows it alone"
    for half in halves:
        off = abs(half.natural_frequency - result.natural_frequency)
        error = math.hypot(half.natural_frequency_std, result.natural_frequency_std)
        if off > REPEATS * result.natural_frequency + ALIKE * error:
            hertz = [
                item.natural_frequency / (2.0 * math.pi) for item in (half, result)
            ]  # as the sentence shows them
            return f"half of the window tells {hertz[0]:.3g} Hz, the whole {hertz[1]:.3g} Hz"
    return ""


def _halves(t: np.ndarray, y: np.ndarray, result: series.Ringing) -> Iterator[series.Ringing]:
    """The oscillation as each half of the part in which it lives shows it."""
    living = int(np.searchsorted(t, result.stop, side="right"))
    guess = (result.natural_frequency, max(result.damping_ratio, 0.02))
    for part in (slice(0, living // 2), slice(living // 2, living)):
        yield series.ringing(t[part], y[part], guess, trim=False)


def unjudged(moved: Sequence[str], windows: Sequence[Transient]) -> Iterator[str]:
    """A warning of each cylinder whose ringing cannot be judged."""
    for cylinder in moved:
        mine = [w for w in windows if w.cylinder == cylinder]
        if not any(w.judged for w in mine):
            why = ": no command steps"
            if mine:
                reasons = [w.note or w.recorded.reason or "too few cycles" for w in mine]
                why = f": {max(dict.fromkeys(reasons), key=reasons.count)}"
                why += f" ({len(mine)} windows)" if len(mine) > 1 else ""
            yield (
                f"{cylinder} does not ring clearly in the recording{why}; natural frequency and "
                "decay are not judged"
            )
