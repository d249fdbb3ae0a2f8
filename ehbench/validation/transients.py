"""Ringing of a cylinder after a command step, recorded and simulated, and whether it can be judged.

A window is judged only where something rings: its command stands for several periods, the
oscillation decays, and halves of the window show the same frequency."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ehbench.data.record import Record
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import SETTINGS as OBSERVATION
from ehbench.preprocessing.observations import least_change, noise_of
from ehbench.signals import series
from ehbench.validation.residuals import Pair
from ehbench.validation.results import Ring, Transient
from ehbench.vocabulary import message, setting
from ehbench.vocabulary.quantities import GAUGES


@dataclass(frozen=True)
class TransientSettings:
    """Numbers by which a ringing can be judged."""

    periods: float = setting(2.5, "", "periods for which the command must stand", "a decay shows")
    creep: float = setting(
        0.1, "", "share of the step by which a standing command may move", "sines move more"
    )
    halves: float = setting(
        0.15, "", "share by which the frequency of a half may differ", "friction changes it less"
    )
    quiet: float = setting(
        1.3,
        "",
        "mean square of a window's error, in that of noise, that tells nothing of a model",
        "two standard errors of a window of 100 samples",
    )
    sigmas: float = setting(
        3.0,
        "",
        "standard errors that the halves may differ further, and by which it must decay",
        "chance: noise of a narrow band decays as often as it grows",
    )


SETTINGS = TransientSettings()
OSCILLATES = ("qd", "v", "p_head", "p_rod", *GAUGES)  # a position integrates an oscillation away


def transients_of(
    record: Record, model: Model, cylinder: str, pairs: Mapping[str, Pair]
) -> list[Transient]:
    """The ringing after each change of the cylinder's own commands, until any command changes
    again."""
    minimum = {f"{c.name}.{v.name}.command": least_change(v) for c, v in model.rig.valves()}
    names = [f"{valve}.command" for valve in model.layout.valves if f"{valve}.command" in record]
    given = np.column_stack([steps_only(record[name], minimum[name]) for name in names])
    mine = [name.startswith(f"{cylinder}.") for name in names]
    stepped, raw = given[:, mine], np.column_stack([record[name] for name in names])[:, mine]
    seen = {
        channel: pair
        for channel, pair in pairs.items()
        if channel.startswith(f"{cylinder}.") and channel.rsplit(".", 1)[1] in OSCILLATES
    }
    noise = np.array([noise_of(record, channel) for channel in seen])
    results = []
    for window in series.transients(record.t, given):
        before = max(0, window.start - 1 - round(OBSERVATION.together / record.sample_time))
        if not seen or not np.any(stepped[window.start] != stepped[before : window.start]):
            continue
        t = record.t[window]
        if not stands(raw[before : window.stop], window.start - before):
            none = Ring(reason=message("validation.command_moves"))
            results.append(Transient(cylinder, float(t[0]), float(t[-1]), none, none))
            continue
        measured = np.column_stack([pair.recorded[window] for pair in seen.values()])
        modelled = np.column_stack([pair.simulated[window] for pair in seen.values()])
        recorded = series.ringing(t, measured)
        simulated = series.ringing_like(t, modelled, recorded)
        stop, note = float(t[-1]), ""
        if recorded.ok:
            stop, note = recorded.stop, why_not_judged(t, measured, recorded)
            living = t <= stop
            error = np.var((modelled - measured)[living], axis=0)
            if not note and np.all(error <= SETTINGS.quiet * noise**2):
                note = message("validation.only_noise_left")
        rings = (Ring.of(recorded), Ring.of(simulated))
        results.append(Transient(cylinder, float(t[0]), stop, *rings, note=note))
    return results


def steps_only(command: np.ndarray, span: float) -> np.ndarray:
    """A command that keeps its value until it has changed by more than ``span`` [V], so that noise
    makes no steps."""
    last, retained = command[0], np.empty_like(command)
    for i, value in enumerate(command.tolist()):
        if abs(value - last) > span:
            last = value
        retained[i] = last
    return retained


def stands(commands: np.ndarray, begin: int) -> bool:
    """Whether commands [V], shape (samples, valves), stand from sample ``begin`` on where they have
    just stepped: a sine or a slow ramp only seems to, within the noise. Two samples tell nothing.
    """
    if len(commands) - begin < 3:
        return False
    step = float(np.max(np.abs(commands[begin] - commands[0])))
    parts = np.array([part.mean(axis=0) for part in np.array_split(commands[begin:], 3)])
    return float(np.max(np.ptp(parts, axis=0))) <= SETTINGS.creep * step


def why_not_judged(t: np.ndarray, y: np.ndarray, result: series.Ringing) -> str:
    """Why an oscillation that was found in a window cannot be judged; '' if it can.

    Args:
        t: of the window, while the command stands [s].
        y: what rings, shape (samples, channels).
        result: the ringing in it."""
    if result.damping_ratio <= SETTINGS.sigmas * result.damping_ratio_std:
        return message("validation.grows", damping=result.damping_ratio)
    shape = math.sqrt(max(0.0, 1.0 - result.damping_ratio**2))
    periods = float(t[-1] - t[0]) * result.natural_frequency * shape / (2.0 * math.pi)
    if periods < SETTINGS.periods:
        return message("validation.short_stand", periods=periods)
    living = int(np.searchsorted(t, result.stop, side="right"))
    guess = (result.natural_frequency, max(result.damping_ratio, 0.02))
    parts = (slice(0, living // 2), slice(living // 2, living))
    halves = [series.ringing(t[part], y[part], guess, trim=False) for part in parts]
    halves = [half for half in halves if half.ok]
    if not halves:
        return message("validation.no_half")
    for half in halves:
        off = abs(half.natural_frequency - result.natural_frequency)
        error = math.hypot(half.natural_frequency_std, result.natural_frequency_std)
        if off > SETTINGS.halves * result.natural_frequency + SETTINGS.sigmas * error:
            hertz = [item.natural_frequency / (2.0 * math.pi) for item in (half, result)]
            return message("validation.halves_differ", half=hertz[0], whole=hertz[1])
    return ""


def unjudged(moved: Sequence[str], windows: Sequence[Transient]) -> Iterator[str]:
    """A warning of each cylinder whose ringing cannot be judged."""
    for cylinder in moved:
        mine = [w for w in windows if w.cylinder == cylinder]
        if not mine:
            yield message("validation.no_steps", cylinder=cylinder)
        elif not any(w.judged for w in mine):
            few = message("validation.few_cycles")
            reasons = [w.note or w.recorded.reason or few for w in mine]
            reason = max(dict.fromkeys(reasons), key=reasons.count)
            count = len(mine)
            yield message("validation.not_clear", cylinder=cylinder, reason=reason, count=count)
