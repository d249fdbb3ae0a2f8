"""Judge a model on logs it was not fitted to: simulated against recorded, residuals, ringing, a
verdict with reasons.

The model runs freely from each log's start on the log's commands (`Model.replay`); where that start
is, the recording says within what its first samples leave open
(`estimated_start`). Errors are simulated minus recorded, in SI."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench import signals
from ehbench.errors import EhbenchError, InputError, LogError
from ehbench.observations import TOGETHER, alternatives, column, least_change, payload_of
from ehbench.plant.build import Maps
from ehbench.plant.model import Model, Start
from ehbench.preprocessing import numbered, preprocess
from ehbench.recipe import Thresholds
from ehbench.record import Record
from ehbench.rig import Rig, Valve
from ehbench.starts import estimated_start
from ehbench.validation.checks import checks_of
from ehbench.validation.residuals import Pair, compare, pair_of
from ehbench.validation.results import (
    ChannelResult,
    Check,
    Correlation,
    LogResult,
    Ring,
    Transient,
    Validation,
    read_validation,
)

__all__ = [
    "ChannelResult",
    "Check",
    "Correlation",
    "LogResult",
    "PreparedValidation",
    "Ring",
    "TakenLog",
    "Transient",
    "Validation",
    "models_of",
    "prepare_validation",
    "read_validation",
    "run_validation",
    "taken_log",
    "validate_rig",
]

CHANNELS = ("q", "qd", "p_head", "p_rod")
Progress = Callable[[str, float], None]


def validate_rig(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    thresholds: Thresholds | None = None,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    progress: Progress | None = None,
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
        where: file and line of a recipe's key, for the errors: `Recipe.at`.

    Raises:
        InputError: a payload or channel that the rig does not have, no logs, or one that
            `preprocessing.preprocess` refuses.
    """
    prepared = prepare_validation(rig, logs, channels, flow_maps, fitted_on, where)
    return run_validation(prepared, thresholds, progress)


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
    names = numbered([name for name, _ in logs])
    seen, records = [name in fitted_on for name, _ in logs], [record for _, record in logs]
    taken = tuple(
        taken_log(name, record, models[payload_of(record) or ""], fitted)
        for name, fitted, record in zip(names, seen, records, strict=True)
    )
    return PreparedValidation(rig, tuple(channels), taken)


def run_validation(
    prepared: PreparedValidation,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    workers: int = 0,
) -> Validation:
    """Judge what `prepare_validation` took in; arguments as in `validate_rig`.

    ``workers``: threads, 0 for one a core; the result does not depend on them."""
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
        InputError: one that `preprocessing.preprocess` refuses.
    """
    try:
        record, warnings = preprocess(name, record, model)
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
            rig.with_payload(payload_of(record))
        except InputError as error:
            raise InputError(
                f"{name}: {error.message}", **where("data", index), hint=error.hint
            ) from None
    _check_channels(rig, channels)
    return {
        payload or "": Model.of(rig, flow_maps, payload)
        for payload in {payload_of(record) for _, record in logs}
    }


def _plain(asked: Thresholds) -> dict[str, Any]:
    """The thresholds as plain values, in SI."""
    return asked.model_dump() | {
        "max_error": {name: float(value) for name, value in asked.max_error.items()}
    }


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
    record, model = log.record, log.model
    moved, held = _moved(model, record)
    facts = LogResult(
        name=log.name,
        payload=payload_of(record) or "none",
        status="fitted" if log.fitted else "held_out" if moved else "still",
        duration=float(np.ptp(record.t)) if record.t.size else 0.0,
        sample_time=record.sample_time,
        moved=moved,
        held=held,
    )
    warnings = list(log.warnings)
    if log.fitted:
        warnings.append(
            "THE MODEL WAS FITTED TO THIS LOG: it is shown, and the verdict rests on the others"
        )
    if not moved:
        warnings.append(
            "the log carries no motion: no valve was commanded, so nothing is judged on it"
        )
    try:
        if log.failure is not None:
            raise LogError(str(log.failure).removeprefix(f"{log.name}: "))
        simulated = model.replay(record, start=_start(model, record, moved, channels))
    except EhbenchError as error:
        return replace(
            facts,
            status="failed",
            failure=str(error),
            warnings=tuple(warnings),
            series=_recorded(record, moved, channels),
        )
    pairs: dict[str, Pair] = {}
    results = []
    for wanted in (f"{cylinder}.{word}" for cylinder in moved for word in channels):
        open_ = [name for name in alternatives(wanted) if name not in pairs]
        both = ((name, pair_of(record, simulated, name)) for name in open_)
        name, pair = next(((name, pair) for name, pair in both if pair), (wanted, None))
        if pair is None:
            warnings.append(f"the log has nothing to judge '{wanted}' by")
            continue
        pairs[name] = pair
        results.append(compare(record, model, name, pair))
        if results[-1].note:
            warnings.append(f"{name}: {results[-1].note}")
    windows = [w for cylinder in moved for w in _transients(record, model, cylinder, pairs)]
    checks = checks_of(results, windows, asked, model.rig)
    if moved and not checks:
        warnings.append("no threshold applies to what the log shows, so nothing is judged on it")
    return replace(
        facts,
        channels=tuple(results),
        transients=tuple(windows),
        checks=tuple(checks),
        warnings=(*warnings, *_unclear(moved, windows)),
        series=_series(record, pairs),
    )


def _start(model: Model, record: Record, moved: Sequence[str], channels: Sequence[str]) -> Start:
    """Where the log starts, as the cylinders that are judged tell it."""
    wanted = [f"{cylinder}.{word}" for cylinder in moved for word in channels]
    told = [
        next((name for name in alternatives(one) if column(record, name, record) is not None), None)
        for one in wanted
    ]
    return estimated_start(model, record, moved, list(dict.fromkeys(filter(None, told))))


def _series(record: Record, pairs: Mapping[str, Pair]) -> dict[str, np.ndarray]:
    series = {"t": record.t}
    for name, pair in pairs.items():
        series |= {name: pair.recorded, f"simulated.{name}": pair.simulated}
    return series


def _unclear(moved: Sequence[str], windows: Sequence[Transient]) -> Iterator[str]:
    """A warning of each cylinder whose ringing cannot be judged."""
    for cylinder in moved:
        mine = [w for w in windows if w.cylinder == cylinder]
        if not any(w.recorded.clear for w in mine):
            why = (
                f": {mine[0].recorded.reason or 'too few cycles'}" if mine else ": no command steps"
            )
            yield (
                f"{cylinder} does not ring clearly in the recording{why}; natural frequency and "
                "decay are not judged"
            )


def _moved(model: Model, record: Record) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(cylinders with a commanded valve, the others), in the rig's order."""

    def given(cylinder: str, valve: Valve) -> bool:
        channel = f"{cylinder}.{valve.name}.command"
        if channel not in record:
            return False
        span = least_change(valve)
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
    wanted = (f"{cylinder}.{word}" for cylinder in moved for word in channels)
    names = [name for channel in wanted for name in alternatives(channel)]
    return {"t": record.t} | {name: record[name] for name in names if name in record}


def _transients(
    record: Record, model: Model, cylinder: str, pairs: Mapping[str, Pair]
) -> list[Transient]:
    """The ringing after each change of the cylinder's own commands, until any command changes
    again.
    """
    least = {f"{c.name}.{v.name}.command": least_change(v) for c, v in model.rig.valves()}
    names = [f"{valve}.command" for valve in model.layout.valves if f"{valve}.command" in record]
    given = np.column_stack([_held(record[name], least[name]) for name in names])
    own = given[:, [name.startswith(f"{cylinder}.") for name in names]]
    seen = [
        pair
        for channel, pair in pairs.items()
        if channel.startswith(f"{cylinder}.") and _rings(channel)
    ]
    found = []
    for window in signals.transients(record.t, given):
        before = max(0, window.start - 1 - round(TOGETHER / record.sample_time))
        if not seen or not np.any(own[window.start] != own[before : window.start]):
            continue
        t = record.t[window]
        measured = np.column_stack([pair.recorded[window] for pair in seen])
        modelled = np.column_stack([pair.simulated[window] for pair in seen])
        recorded = signals.ringing(t, measured)
        simulated = signals.ringing_like(t, modelled, recorded)
        stop = recorded.stop if recorded.ok else float(t[-1])
        found.append(Transient(cylinder, float(t[0]), stop, Ring.of(recorded), Ring.of(simulated)))
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
