"""Judge a model on logs it was not fitted to: simulated against recorded, residuals, ringing, a
verdict with reasons.

The model runs freely from each log's start on the log's commands (`Model.replay`); nothing recorded
later corrects it. Errors are simulated minus recorded, in SI."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ehbench import signals
from ehbench.errors import EhbenchError, InputError, LogError, ModelRejected
from ehbench.intake import take_in
from ehbench.plant.build import Maps
from ehbench.plant.model import MOVED, Model
from ehbench.quantities import quantity
from ehbench.recipe import Thresholds
from ehbench.record import Record
from ehbench.rig import Rig, Valve
from ehbench.rundir import read_json
from ehbench.units import from_si

CHANNELS = ("q", "qd", "p_head", "p_rod")
NOISE = 0.5  # von Neumann ratio (1 for white noise, 0 for a smooth signal) above which a channel only shows noise
RATE_CUTOFF = 20.0  # [Hz] of the low-pass before a rate is taken from a position
LAG_STEP, LAG_SPAN = (
    0.01,
    0.5,
)  # [s]: residuals are averaged over LAG_STEP before they are correlated up to LAG_SPAN
CLEAR_CYCLES, CLEAR_DAMPING = (
    1.5,
    0.35,
)  # a recorded ringing of fewer cycles, or better damped, is shown and not judged
_RATE_OF = {"qd": "q", "v": "x"}
_STAND_IN = {
    "q": "x",
    "x": "q",
    "qd": "v",
    "v": "qd",
}  # what moves with a quantity where a log lacks it
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Correlation:
    """A correlation over lags [s], the half-width of its 95 % band at each lag, and the share [%]
    of lags outside.

    ``of`` names what the residual is correlated with: itself (lag 0 left out), or a command ``lag``
    seconds earlier."""

    of: str
    lag: tuple[float, ...]
    value: tuple[float, ...]
    band: tuple[float, ...]
    outside_percent: float


@dataclass(frozen=True)
class ChannelResult:
    """One channel of one log, in the SI ``unit``. Errors are simulated minus recorded.

    ``fit_percent`` is the NRMSE fit, None where the recording shows no motion; ``max_error`` the
    error largest in size, with its sign; ``derived`` says that the log has no such channel and both
    sides were taken from the position's rate. ``note`` says in words why something is missing."""

    channel: str
    unit: str
    fit_percent: float | None
    max_error: float
    bias: float
    rms_error: float
    derived: bool = False
    autocorrelation: Correlation | None = None
    cross_correlation: tuple[Correlation, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Ring:
    """Natural frequency [rad/s] and damping ratio of one side of a transient with their standard
    errors; None: no ringing.

    ``cycles`` pass before it has decayed or the window ends; ``reason`` says why there is none.
    """

    natural_frequency: float | None = None
    natural_frequency_std: float | None = None
    damping_ratio: float | None = None
    damping_ratio_std: float | None = None
    cycles: float = 0.0
    reason: str = ""

    @property
    def clear(self) -> bool:
        """Whether it rings long enough for its frequency to be told from drift, so that a model can
        be judged by it.
        """
        return (
            self.damping_ratio is not None
            and self.damping_ratio <= CLEAR_DAMPING
            and self.cycles >= CLEAR_CYCLES
        )


@dataclass(frozen=True)
class Transient:
    """The ringing of a cylinder after a command change, recorded and simulated over the same window
    [s].
    """

    cylinder: str
    start: float
    stop: float
    recorded: Ring
    simulated: Ring


@dataclass(frozen=True)
class Check:
    """One thing asked of the model on one log: what was reached (None: nothing to compare) and what
    was asked.
    """

    what: str
    reached: float | None
    asked: float
    unit: str
    passed: bool
    sentence: str


@dataclass(frozen=True)
class LogResult:
    """One log. ``status``: ``held_out`` (it counts), ``fitted`` (the model was fitted to it),
    ``still``, or ``failed``.

    ``moved`` cylinders had a valve commanded and are judged, ``held`` ones are not. ``failure``
    says why a log could not be simulated. ``series`` are the recorded and, as
    ``simulated.<channel>``, the simulated channels; it is not in the JSON."""

    name: str
    payload: str
    status: str
    duration: float
    sample_time: float
    moved: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    channels: tuple[ChannelResult, ...] = ()
    transients: tuple[Transient, ...] = ()
    checks: tuple[Check, ...] = ()
    failure: str = ""
    warnings: tuple[str, ...] = ()
    series: dict[str, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    @property
    def passed(self) -> bool:
        """Whether everything asked of the model on this log was reached, and something was asked."""
        return not self.failure and bool(self.checks) and all(check.passed for check in self.checks)


@dataclass(frozen=True)
class Validation:
    """The verdict on a rig: ``accepted`` if some held-out log was judged and all of them passed;
    else ``reasons`` say why not.
    """

    rig: str
    accepted: bool
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    thresholds: dict[str, Any]
    logs: tuple[LogResult, ...]

    @property
    def verdict(self) -> str:
        """``accepted`` or ``rejected``."""
        return "accepted" if self.accepted else "rejected"

    def as_json(self) -> dict[str, Any]:
        """Plain values for ``validation.json``; `read_validation` is the way back."""
        table = asdict(self) | {"verdict": self.verdict}
        for log, result in zip(table["logs"], self.logs, strict=True):
            del log["series"]
            log["passed"] = result.passed
        return table

    def series(self) -> dict[str, dict[str, np.ndarray]]:
        """By log, columns named ``t [s]``, ``boom.q [rad]`` (recorded) and ``simulated.boom.q
        [rad]``, in SI.
        """
        return {
            log.name: {
                f"{name} [{quantity(name).unit}]": values for name, values in log.series.items()
            }
            for log in self.logs
            if log.series
        }

    def require(self) -> None:
        """Pass if accepted.

        Raises:
            ModelRejected: with the first reason.
        """
        if not self.accepted:
            raise ModelRejected(
                f"rig '{self.rig}' is rejected: {self.reasons[0]}",
                hint="; ".join(self.reasons[1:4]) or None,
            )


def read_validation(path: Path) -> Validation:
    """The validation of a run folder or of a ``validation.json``, without its series.

    Raises:
        InputError: no such file, or not a validation.
    """
    path = path / "validation.json" if path.is_dir() else path
    table = read_json(path)

    def many(kind: type, rows: list[dict[str, Any]]) -> tuple[Any, ...]:
        return tuple(made(kind, row) for row in rows)

    def made(kind: type, row: dict[str, Any]) -> Any:
        known = {f.name for f in fields(kind)}
        return kind(
            **{
                key: tuple(value) if isinstance(value, list) else value
                for key, value in row.items()
                if key in known
            }
        )

    def channel(row: dict[str, Any]) -> ChannelResult:
        auto = row["autocorrelation"] and made(Correlation, row["autocorrelation"])
        return made(
            ChannelResult,
            row
            | {
                "autocorrelation": auto,
                "cross_correlation": many(Correlation, row["cross_correlation"]),
            },
        )

    def transient(row: dict[str, Any]) -> Transient:
        return made(
            Transient, row | {side: made(Ring, row[side]) for side in ("recorded", "simulated")}
        )

    def log(row: dict[str, Any]) -> LogResult:
        nested = {
            "channels": [channel(c) for c in row["channels"]],
            "transients": [transient(w) for w in row["transients"]],
        }
        return made(LogResult, row | nested | {"checks": many(Check, row["checks"])})

    try:
        return made(Validation, table | {"logs": [log(row) for row in table["logs"]]})
    except (KeyError, TypeError) as error:
        raise InputError(
            f"is no validation: {error}", file=path, hint="name a finished run of stage 'validate'"
        ) from None


def validate_rig(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    thresholds: Thresholds | None = None,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    progress: Progress | None = None,
    workers: int = 0,
    where: Callable[..., Mapping[str, Any]] = lambda *location: {},
) -> Validation:
    """Judge a rig on logs.

    A log that cannot be simulated is kept, marked, and rejects the model; a log in which no valve
    is commanded, or one the model was fitted to, is shown and does not count. Payloads come from
    each record's ``meta["payload"]``.

    Args:
        rig: with its identified numbers.
        logs: name and record of each.
        channels: quantities judged on every moved cylinder.
        thresholds: what is asked.
        flow_maps: measured maps by edge name.
        fitted_on: names of those logs that the model was fitted to.
        progress: told (log, share done).
        workers: threads; 0 for one a core.
        where: file and line of a recipe's key, for the errors: `Recipe.at`.

    Raises:
        InputError: a payload or channel that the rig does not have, no logs, or one that
            `intake.take_in` refuses.
    """
    prepared = prepare_validation(rig, logs, channels, flow_maps, fitted_on, where)
    return run_validation(prepared, thresholds, progress, workers)


@dataclass(frozen=True)
class TakenLog:
    """A log as the judge takes it: evenly sampled, with the doubts about it.

    ``fitted`` says that the model was fitted to it, ``failure`` why it cannot be judged."""

    name: str
    record: Record
    model: Model
    fitted: bool = False
    warnings: tuple[str, ...] = ()
    failure: LogError | None = None


@dataclass(frozen=True)
class PreparedValidation:
    """What a validation takes in, before anything is simulated."""

    rig: Rig
    channels: tuple[str, ...]
    logs: tuple[TakenLog, ...]


def prepare_validation(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    where: Callable[..., Mapping[str, Any]] = lambda *location: {},
) -> PreparedValidation:
    """Take in the logs of a validation; arguments and errors as in `validate_rig`."""
    models = models_of(rig, logs, channels, flow_maps, where)
    taken = tuple(
        taken_log(name, record, models[_payload(record)], fitted)
        for name, fitted, record in _distinct(logs, fitted_on)
    )
    return PreparedValidation(rig, tuple(channels), taken)


def run_validation(
    prepared: PreparedValidation,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    workers: int = 0,
) -> Validation:
    """Judge what `prepare_validation` took in; arguments as in `validate_rig`."""
    asked = thresholds or Thresholds()
    logs = prepared.logs

    def judge(log: TakenLog) -> LogResult:
        return _judge(log, prepared.channels, asked)

    results = []
    with ThreadPoolExecutor(max(1, min(workers or os.cpu_count() or 1, len(logs)))) as pool:
        for result in pool.map(judge, logs):
            results.append(result)
            if progress is not None:
                progress(result.name, len(results) / len(logs))
    reasons, warnings = _verdict(results)
    return Validation(
        prepared.rig.name,
        not reasons,
        tuple(reasons),
        tuple(warnings),
        _plain(asked),
        tuple(results),
    )


def taken_log(name: str, record: Record, model: Model, fitted: bool) -> TakenLog:
    """A log as the judge takes it.

    Raises:
        InputError: one that `intake.take_in` refuses.
    """
    try:
        record, warnings = take_in(name, record, model)
    except LogError as error:
        return TakenLog(name, record, model, fitted, failure=error)
    return TakenLog(name, record, model, fitted, warnings)


def models_of(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    flow_maps: Maps | None = None,
    where: Callable[..., Mapping[str, Any]] = lambda *location: {},
) -> dict[str, Model]:
    """The model for each payload of the logs, by name, '' for none; arguments and errors as in
    `validate_rig`.
    """
    if not logs:
        raise InputError(
            "there is no log to validate on", hint="name at least one held-out log under 'data'"
        )
    for index, (name, record) in enumerate(logs):
        try:
            rig.with_payload(_payload(record) or None)
        except InputError as error:
            raise InputError(
                f"{name}: {error.message}", **where("data", index), hint=error.hint
            ) from None
    _check_channels(rig, channels)
    return {
        payload: Model.of(rig, flow_maps, payload or None)
        for payload in {_payload(record) for _, record in logs}
    }


def _plain(asked: Thresholds) -> dict[str, Any]:
    """The thresholds as plain values, in SI."""
    return asked.model_dump() | {
        "max_error": {name: float(value) for name, value in asked.max_error.items()}
    }


def _payload(record: Record) -> str:
    payload = record.meta.get("payload", "")
    return "" if payload == "none" else payload


def _distinct(
    logs: Sequence[tuple[str, Record]], fitted_on: Collection[str]
) -> list[tuple[str, bool, Record]]:
    """(name, whether fitted to, record) of each log; those of one name are numbered from the second
    on.
    """
    seen: dict[str, int] = {}
    found = []
    for name, record in logs:
        seen[name] = seen.get(name, 0) + 1
        found.append(
            (name if seen[name] == 1 else f"{name}_{seen[name]}", name in fitted_on, record)
        )
    return found


def _check_channels(rig: Rig, channels: Sequence[str]) -> None:
    known = ("q", "qd", "x", "v", "p_head", "p_rod")
    for channel in channels:
        if channel not in known:
            raise InputError(
                f"rig '{rig.name}' cannot be judged on channel '{channel}'",
                hint="channels are of " + ", ".join(known),
            )


def _verdict(results: Sequence[LogResult]) -> tuple[list[str], list[str]]:
    """(reasons to reject, warnings)."""
    warnings = [f"{log.name}: {text}" for log in results for text in log.warnings]
    reasons = [
        f"{log.name}: could not be simulated: {log.failure}" for log in results if log.failure
    ]
    counted = [log for log in results if log.status == "held_out"]
    reasons += [
        f"{log.name}: {check.sentence}"
        for log in counted
        for check in log.checks
        if not check.passed
    ]
    if not any(log.checks for log in counted):
        fitted = [log.name for log in results if log.status == "fitted"]
        why = (
            f"the model was fitted to {', '.join(fitted)}, so none is held out"
            if fitted
            else "no held-out log supports a check"
        )
        reasons.append("nothing was judged: " + why)
    return reasons, warnings


def _judge(log: TakenLog, channels: tuple[str, ...], asked: Thresholds) -> LogResult:
    name, record, model, fitted = log.name, log.record, log.model, log.fitted
    warnings = list(log.warnings)
    moved, held = _moved(model, record)
    status = "fitted" if fitted else "held_out" if moved else "still"
    if fitted:
        warnings.append(
            "THE MODEL WAS FITTED TO THIS LOG: it is shown, and the verdict rests on the others"
        )
    if not moved:
        warnings.append(
            "the log carries no motion: no valve was commanded, so nothing is judged on it"
        )
    facts = {
        "name": name,
        "payload": _payload(record) or "none",
        "duration": float(np.ptp(record.t)) if record.t.size else 0.0,
        "sample_time": record.sample_time,
        "moved": moved,
        "held": held,
    }
    try:
        if log.failure is not None:
            raise LogError(str(log.failure).removeprefix(f"{name}: "))
        simulated = model.replay(record)
    except EhbenchError as error:
        return LogResult(
            **facts,
            status="failed",
            failure=str(error),
            warnings=tuple(warnings),
            series=_recorded(record, moved, channels),
        )
    pairs: dict[str, tuple[np.ndarray, np.ndarray, bool]] = {}
    series: dict[str, np.ndarray] = {"t": record.t}
    results = []
    for cylinder in moved:
        for word in channels:
            choices = (
                (name, _pair(record, simulated, name))
                for name in _names(cylinder, word)
                if name not in pairs
            )
            found, pair = next(((name, pair) for name, pair in choices if pair), ("", None))
            if pair is None:
                warnings.append(f"the log has nothing to judge '{cylinder}.{word}' by")
                continue
            pairs[found] = pair
            series[found], series[f"simulated.{found}"] = pair[:2]
            results.append(_compare(record, model, found, *pair))
            if results[-1].note:
                warnings.append(f"{found}: {results[-1].note}")
    windows = tuple(
        window for cylinder in moved for window in _transients(record, model, cylinder, pairs)
    )
    checks = tuple(_checks(results, windows, asked, model.rig))
    if moved and not checks:
        warnings.append("no threshold applies to what the log shows, so nothing is judged on it")
    for cylinder in moved:
        mine = [w for w in windows if w.cylinder == cylinder]
        if not any(w.recorded.clear for w in mine):
            why = (
                f": {mine[0].recorded.reason or 'too few cycles'}" if mine else ": no command steps"
            )
            warnings.append(
                f"{cylinder} does not ring clearly in the recording{why}; natural frequency and decay are not judged"
            )
    return LogResult(
        **facts,
        status=status,
        channels=tuple(results),
        transients=windows,
        checks=checks,
        warnings=tuple(warnings),
        series=series,
    )


def _names(cylinder: str, word: str) -> list[str]:
    """The channel of a quantity and the one that may stand in for it."""
    return [f"{cylinder}.{name}" for name in (word, _STAND_IN.get(word)) if name]


def _moved(model: Model, record: Record) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(cylinders with a commanded valve, the others), in the rig's order."""

    def given(cylinder: str, valve: Valve) -> bool:
        channel = f"{cylinder}.{valve.name}.command"
        if channel not in record:
            return False
        span = MOVED * (float(valve.command_max) - float(valve.command_min))
        return (
            float(np.ptp(record[channel])) > span
            or float(np.max(np.abs(record[channel] - valve.rest))) > 2.0 * span
        )

    moved = tuple(
        c.name for c in model.rig.cylinder if any(given(c.name, valve) for valve in c.valve)
    )
    return moved, tuple(c.name for c in model.rig.cylinder if c.name not in moved)


def _recorded(
    record: Record, moved: Sequence[str], channels: Sequence[str]
) -> dict[str, np.ndarray]:
    names = [name for cylinder in moved for word in channels for name in _names(cylinder, word)]
    return {"t": record.t} | {name: record[name] for name in names if name in record}


def _pair(
    record: Record, simulated: Record, channel: str
) -> tuple[np.ndarray, np.ndarray, bool] | None:
    """(recorded, simulated, whether derived) of a channel, None if the log cannot give it.

    A rate that was not recorded is taken from both positions alike, behind a low-pass at
    RATE_CUTOFF."""
    if channel in record:
        return record[channel], simulated[channel], False
    cylinder, word = channel.rsplit(".", 1)
    source = f"{cylinder}.{_RATE_OF.get(word, '')}"
    if source not in record:
        return None
    smooth = (
        signals.lowpass(one[source], record.sample_time, RATE_CUTOFF) for one in (record, simulated)
    )
    recorded, modelled = (np.gradient(y, record.sample_time) for y in smooth)
    return recorded, modelled, True


def _compare(
    record: Record,
    model: Model,
    channel: str,
    recorded: np.ndarray,
    simulated: np.ndarray,
    derived: bool,
) -> ChannelResult:
    error = simulated - recorded
    numbers = {
        "channel": channel,
        "unit": quantity(channel).unit,
        "max_error": float(error[np.argmax(np.abs(error))]),
        "bias": float(np.mean(error)),
        "rms_error": signals.rms(error),
        "derived": derived,
    }
    variance = float(np.var(recorded))
    if math.sqrt(variance) <= 1e-9 * float(np.max(np.abs(recorded))):
        return ChannelResult(
            fit_percent=None, note="the recording is constant, so it has no fit", **numbers
        )
    if float(np.mean(np.diff(recorded) ** 2)) > 2.0 * NOISE * variance:
        return ChannelResult(
            fit_percent=None,
            note="the recording shows no motion beyond its noise, so it has no fit",
            **numbers,
        )
    cylinder = channel.rsplit(".", 1)[0]
    inputs = [
        f"{valve}.command"
        for valve in model.layout.valves
        if valve.startswith(f"{cylinder}.") and f"{valve}.command" in record
    ]
    block = max(1, round(LAG_STEP / record.sample_time))
    residual = _averaged(error, block)
    lags = min(max(1, round(LAG_SPAN / (block * record.sample_time))), len(residual) // 4)
    lag = block * record.sample_time * np.arange(lags + 1)
    if lags < 2 or float(np.ptp(residual)) <= 1e-12 * float(np.max(np.abs(recorded))):
        return ChannelResult(fit_percent=signals.fit_percent(recorded, simulated), **numbers)
    auto = _correlation(
        channel,
        lag[1:],
        signals.autocorrelation(residual, lags)[1:],
        signals.autocorrelation_band(residual, lags)[1:],
    )
    cross = []
    for name in inputs:
        command = _averaged(record[name], block)
        if float(np.ptp(command)) > 0.0:
            band = np.full(lags + 1, signals.correlation_band(residual, command))
            cross.append(
                _correlation(name, lag, signals.correlation(residual, command, lags)[lags:], band)
            )
    return ChannelResult(
        fit_percent=signals.fit_percent(recorded, simulated),
        autocorrelation=auto,
        cross_correlation=tuple(cross),
        **numbers,
    )


def _averaged(y: np.ndarray, block: int) -> np.ndarray:
    count = len(y) // block
    return np.mean(y[: count * block].reshape(count, block), axis=1)


def _correlation(of: str, lag: np.ndarray, value: np.ndarray, band: np.ndarray) -> Correlation:
    rounded = [
        tuple(float(f"{number:.6g}") for number in numbers) for numbers in (lag, value, band)
    ]
    return Correlation(of, *rounded, outside_percent=100.0 * float(np.mean(np.abs(value) > band)))


def _transients(
    record: Record,
    model: Model,
    cylinder: str,
    pairs: dict[str, tuple[np.ndarray, np.ndarray, bool]],
) -> list[Transient]:
    """The ringing after each change of the cylinder's own commands, until any command changes
    again.
    """
    rows = zip(model.layout.valves, model.plant.valves, strict=True)
    names = {f"{valve}.command": row for valve, row in rows if f"{valve}.command" in record}
    given = [
        _held(record[name], MOVED * (valve.highest - valve.lowest)) for name, valve in names.items()
    ]
    own = np.column_stack(
        [
            command
            for command, name in zip(given, names, strict=True)
            if name.startswith(f"{cylinder}.")
        ]
    )
    seen = [
        pair[:2]
        for channel, pair in pairs.items()
        if channel.startswith(f"{cylinder}.") and _rings(channel)
    ]
    found = []
    for window in signals.transients(record.t, np.column_stack(given)):
        before = max(0, window.start - 1 - round(0.02 / record.sample_time))
        if not seen or not np.any(own[window.start] != own[before : window.start]):
            continue
        measured, modelled = (
            np.column_stack([pair[side][window] for pair in seen]) for side in (0, 1)
        )
        t = record.t[window]
        recorded = signals.ringing(t, measured)
        simulated = signals.ringing_like(t, modelled, recorded)
        found.append(
            Transient(
                cylinder,
                float(t[0]),
                recorded.stop if recorded.ok else float(t[-1]),
                _ring(recorded),
                _ring(simulated),
            )
        )
    return found


def _held(command: np.ndarray, span: float) -> np.ndarray:
    """A command that keeps its value until it has changed by more than ``span`` [V], so that noise
    makes no steps.
    """
    last, held = command[0], np.empty_like(command)
    for i, value in enumerate(command.tolist()):
        if abs(value - last) > span:
            last = value
        held[i] = last
    return held


def _rings(channel: str) -> bool:
    """Whether oscillation shows in a channel; a position integrates it away."""
    return channel.rsplit(".", 1)[1] in ("qd", "v", "p_head", "p_rod")


def _ring(found: signals.Ringing) -> Ring:
    if not found.ok:
        return Ring(cycles=found.cycles, reason=found.reason)
    numbers = (
        found.natural_frequency,
        found.natural_frequency_std,
        found.damping_ratio,
        found.damping_ratio_std,
    )
    return Ring(*numbers, cycles=found.cycles)


def _checks(
    results: Sequence[ChannelResult], windows: Sequence[Transient], asked: Thresholds, rig: Rig
) -> list[Check]:
    checks = []
    for result in results:
        word, name = result.channel.rsplit(".", 1)[1], _words(result.channel)
        least = asked.fit_percent.get(word, asked.fit_percent.get(_STAND_IN.get(word, "")))
        if least is not None and result.fit_percent is not None:
            reached = result.fit_percent
            sentence = f"{name} fit {reached:.3g} % is {'not ' * (reached >= least)}below the {least:g} % asked"
            checks.append(
                Check(
                    f"{result.channel} fit", reached, least, "percent", reached >= least, sentence
                )
            )
        if word in asked.max_error:
            row, unit = quantity(word), rig.unit_of(word)
            reached, most = abs(result.max_error), float(asked.max_error[word])
            shown = [f"{from_si(value, unit, row):.3g}" for value in (reached, most)]
            sentence = f"{name} error reaches {shown[0]} {unit}; {shown[1]} {unit} is allowed"
            checks.append(
                Check(
                    f"{result.channel} max error",
                    reached,
                    most,
                    result.unit,
                    reached <= most,
                    sentence,
                )
            )
        for wanted, kind, found in (
            (
                asked.whiteness,
                "autocorrelation",
                [result.autocorrelation] if result.autocorrelation else [],
            ),
            (asked.independence, "correlation with commands", list(result.cross_correlation)),
        ):
            if wanted and found:
                reached = max(one.outside_percent for one in found)
                passed = reached <= asked.outside_percent
                allowed = f"{asked.outside_percent:g} % is allowed"
                sentence = f"{name} residual {kind} leaves its band at {reached:.0f} % of the lags; {allowed}"
                checks.append(
                    Check(
                        f"{result.channel} residual {kind}",
                        reached,
                        asked.outside_percent,
                        "percent",
                        passed,
                        sentence,
                    )
                )
    for cylinder, mine in groupby(
        (w for w in windows if w.recorded.clear), key=lambda w: w.cylinder
    ):
        group = list(mine)
        for key, limit in (
            ("natural_frequency", asked.natural_frequency_error),
            ("damping_ratio", asked.damping_ratio_error),
        ):
            if limit is not None:
                checks.append(_ringing_check(cylinder, key, group, limit))
    return checks


def _ringing_check(cylinder: str, key: str, windows: Sequence[Transient], limit: float) -> Check:
    """The worst window: fails where the difference exceeds what is allowed by more than two of its
    standard errors.
    """
    what = f"{cylinder} {key.replace('_', ' ')}"
    silent = [w for w in windows if w.simulated.natural_frequency is None]
    if silent:
        when, why = silent[0].start, silent[0].simulated.reason
        sentence = f"{what}: the recording rings from {when:.2f} s on, the model does not ({why})"
        return Check(what, None, limit, "share", False, sentence)

    def miss(window: Transient) -> tuple[float, float]:
        """(difference, its standard error) as shares of the recorded value."""
        recorded, simulated = getattr(window.recorded, key), getattr(window.simulated, key)
        spread = math.hypot(
            getattr(window.recorded, f"{key}_std"), getattr(window.simulated, f"{key}_std")
        )
        scale = max(abs(recorded), 1e-9)
        return abs(simulated - recorded) / scale, spread / scale

    worst = max(windows, key=lambda w: miss(w)[0] - 2.0 * miss(w)[1])
    reached, spread = miss(worst)
    passed = reached - 2.0 * spread <= limit
    scale, unit = (0.5 / math.pi, " Hz") if key == "natural_frequency" else (1.0, "")
    sides = (worst.simulated, worst.recorded)
    shown = [
        f"{scale * getattr(side, key):.3g} ± {scale * getattr(side, key + '_std'):.2g}{unit}"
        for side in sides
    ]
    apart = f"{100 * reached:.0f} % apart; {100 * limit:g} % is allowed"
    sentence = f"{what} {shown[0]} against {shown[1]} recorded from {worst.start:.2f} s on, {apart}"
    return Check(what, reached, limit, "share", passed, sentence)


def _words(channel: str) -> str:
    cylinder, word = channel.rsplit(".", 1)
    plain = {
        "q": "position",
        "qd": "rate",
        "x": "stroke",
        "v": "speed",
        "p_head": "head pressure",
        "p_rod": "rod pressure",
    }
    return f"{cylinder} {plain[word]}"
