"""The frequency response of recording and model where a command sweeps, one against the other.

Both are estimated alike (`ehbench.frequency_response`), from the command to a channel of its
cylinder, so averages and laws that are not linear act alike on both."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ehbench.data.record import Record
from ehbench.frequency_response.response import SETTINGS as RESPONSE
from ehbench.frequency_response.response import (
    Averaging,
    Curve,
    Response,
    estimate,
    prepare_signals,
)
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import least_change
from ehbench.validation.residuals import Pair
from ehbench.validation.results import Sweep
from ehbench.validation.transients import OSCILLATES, steps_only
from ehbench.vocabulary import Z95, EhbenchError, setting


@dataclass(frozen=True)
class SweepSettings:
    """Numbers by which a command sweeps."""

    changes: int = setting(40, "", "least number of changes of a command that sweeps", "no steps")
    stand: float = setting(0.1, "", "share of a sweep for which its command may stand", "no steps")
    band: float = setting(
        2.0, "", "least ratio of the highest to the lowest frequency that counts", "an octave"
    )
    share: float = setting(
        0.5, "", "least share of a band's frequencies that count", "fewer are coherent by chance"
    )


SETTINGS = SweepSettings()
ONE_SIDED = 1.645  # standard deviations that 95 % stay below


def sweeps_of(
    record: Record, model: Model, cylinder: str, pairs: Mapping[str, Pair], coherence: float
) -> list[Sweep]:
    """The responses of a cylinder's channels to its command that sweeps most, if one does.

    Args:
        record: what is judged of the log, evenly sampled.
        model: of the rig.
        cylinder: whose command and channels.
        pairs: channels recorded and simulated.
        coherence: of the recording, from which a frequency counts."""
    swept = _sweeping(record, model, cylinder)
    if swept is None:
        return []
    command, span = swept
    results = []
    for channel, pair in pairs.items():
        if not channel.startswith(f"{cylinder}.") or channel.rsplit(".", 1)[1] not in OSCILLATES:
            continue
        recorded = _response(record, command, channel, pair.recorded, span, coherence)
        if recorded is None:
            continue
        known = recorded.frequency[recorded.coherent]
        if known.size < RESPONSE.line or known[-1] < SETTINGS.band * known[0]:
            continue
        among = np.count_nonzero(
            (recorded.frequency >= known[0]) & (recorded.frequency <= known[-1])
        )
        if known.size < SETTINGS.share * among:
            continue
        simulated = _response(record, command, channel, pair.simulated, span, 0.0)
        results.append(_sweep_of(command, channel, recorded, simulated))
    return results


def _sweeping(record: Record, model: Model, cylinder: str) -> tuple[str, slice] | None:
    """(the command of a cylinder that sweeps most, the samples over which it does), None if none
    does: one that steps now and then has no spectrum to speak of."""
    best: tuple[float, str, slice] | None = None
    for item, valve in model.rig.valves():
        channel = f"{cylinder}.{valve.name}.command"
        if item.name != cylinder or channel not in record:
            continue
        level = steps_only(record[channel], least_change(valve))
        changes = np.flatnonzero(np.diff(level)) + 1
        if changes.size < SETTINGS.changes:
            continue
        span = slice(int(changes[0]), int(changes[-1]) + 1)
        if np.max(np.diff(changes)) > SETTINGS.stand * (changes[-1] - changes[0]):
            continue
        # the least change is a share of the driver's range
        size = float(np.std(level[span])) / least_change(valve)
        if best is None or size > best[0]:
            best = (size, channel, span)
    return None if best is None else best[1:]


def _response(
    record: Record, command: str, channel: str, y: np.ndarray, span: slice, coherence: float
) -> Response | None:
    """The response of a channel to a command; None where no frequency is coherent."""
    pair = {command: record[command][span], channel: y[span]}
    try:
        log = [("log", Record(record.t[span], pair))]
        return estimate(prepare_signals(log, (command, channel), Averaging(coherence=coherence)))
    except EhbenchError:
        return None


def _sweep_of(command: str, channel: str, recorded: Response, simulated: Response | None) -> Sweep:
    at = recorded.coherent
    known = recorded.frequency[at]
    facts = Sweep(
        input=command,
        channel=channel,
        band=(float(known[0]), float(known[-1])),
        frequencies=int(known.size),
        averages=recorded.averages,
        coherence=(float(np.mean(recorded.coherence[at])), None),
        delay=(_delay(recorded, at), None),
        recorded=Curve.of(recorded, known[-1]),
    )
    if simulated is None:
        return facts
    # the standard error of a gain is a share of it, and as many radians of the phase
    error = (recorded.gain_high[at] / recorded.gain[at] - 1.0) / Z95
    ratio = simulated.gain[at] / recorded.gain[at]
    turn = np.angle(np.exp(1j * (simulated.phase - recorded.phase)[at]))
    known = np.isfinite(error) & np.isfinite(ratio)
    delay, interval, doubt = _delay(simulated, at), recorded.delay, math.inf
    if interval is not None and interval.low is not None and interval.high is not None:
        doubt = 0.5 * (interval.high - interval.low)
    return replace(
        facts,
        coherence=(facts.coherence[0], float(np.nanmean(simulated.coherence[at]))),
        delay=(facts.delay[0], delay),
        delay_error=max(0.0, abs(delay - facts.delay[0]) - doubt),
        gain_ratio=float(np.median(ratio[known])),
        gain_error=_beyond(ratio[known] - 1.0, error[known]),
        phase_error=_beyond(turn[known], error[known]),
        simulated=Curve.of(simulated, facts.band[1]),
    )


def _beyond(differences: np.ndarray, errors: np.ndarray) -> float:
    """Root mean square of differences, without what their standard errors make of it in 95 % of
    cases: for normal errors e, the mean of (d² − e²) scatters by √(2 Σ e⁴)/n."""
    scatter = math.sqrt(2.0 * float(np.sum(errors**4))) / errors.size
    chance = float(np.mean(errors**2)) + ONE_SIDED * scatter
    return math.sqrt(max(0.0, float(np.mean(differences**2)) - chance))


def _delay(response: Response, at: np.ndarray) -> float:
    """Mean slope −dφ/dω [s] over the frequencies that count in the recording."""
    omega = 2.0 * math.pi * response.frequency[at]
    return -float(np.polyfit(omega, np.unwrap(response.phase[at]), 1)[0])
