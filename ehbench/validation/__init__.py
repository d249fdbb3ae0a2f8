"""Judge a model on logs it was not fitted to: simulated against recorded, residuals, ringing, a
verdict with reasons.

The model runs freely from each log's start on the log's commands (`Model.replay`); where that start
is, the recording says within what its first samples leave open
(`starts.follow`). Errors are simulated minus recorded, in SI."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.recipe import Thresholds
from ehbench.config.recipe.sensor import Sensor
from ehbench.config.rig import Rig, Valve
from ehbench.data.record import Record
from ehbench.diagnosis import Case
from ehbench.plant.build import Maps
from ehbench.plant.model import Model
from ehbench.plant.ties import tied_words
from ehbench.preprocessing.initial_states import Followed, follow
from ehbench.preprocessing.observations import (
    OF_VALVES,
    alternatives,
    channels_asked,
    column,
    least_change,
    payload_of,
    stood_for,
    supply_off,
)
from ehbench.preprocessing.preparation import numbered, preprocess
from ehbench.preprocessing.sensors import Term, known_taken_out, terms_of
from ehbench.runtime.cores import cores
from ehbench.validation.checks import checks_of, unasked
from ehbench.validation.residuals import Pair, compare, pair_of
from ehbench.validation.results import (
    ChannelResult,
    Check,
    Correlation,
    LogResult,
    Overlap,
    Ring,
    Transient,
    Validation,
    read_validation,
)
from ehbench.validation.sweeps import sweeps_of
from ehbench.validation.transients import transients_of, unjudged
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError
from ehbench.vocabulary.progress import Progress
from ehbench.vocabulary.quantities import GAUGES

__all__ = [
    "ChannelResult",
    "Check",
    "Correlation",
    "LogResult",
    "Overlap",
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

    ``fitted`` says that the model was fitted to it, ``overlap`` to which of its samples,
    ``scored`` which part [s] counts (None: all), ``failure`` why it cannot be judged, ``terms``
    what its sensors make of it beside what is known, which ``record`` has no more of."""

    name: str
    record: Record
    model: Model
    fitted: bool = False
    scored: tuple[float, float] | None = None
    overlap: tuple[Overlap, ...] = ()
    warnings: tuple[str, ...] = ()
    failure: LogError | None = None
    terms: tuple[Term, ...] = ()


@dataclass(frozen=True)
class PreparedValidation:
    """What a validation takes in, before anything is simulated."""

    rig: Rig
    channels: tuple[str, ...]
    logs: tuple[TakenLog, ...]
    flow_maps: Maps | None = None

    def cases(self, results: Sequence[LogResult] = ()) -> list[Case]:
        """The logs as `ehbench.diagnosis.ask` takes them, sensors as the results have them."""
        sensors = {result.name: result.sensors for result in results}
        return [
            Case(
                log.name,
                log.record,
                log.model,
                _moved(log.model, log.record)[0],
                self.flow_maps,
                log.scored,
                log.terms,
                {
                    term.name: term.excess(sensors[log.name][term.name])
                    for term in log.terms
                    if term.name in sensors.get(log.name, {})
                },
            )
            for log in self.logs
            if log.failure is None
        ]


def prepare_validation(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    where: Callable[..., Mapping[str, Any]] = lambda *location: {},
    sensors: Sequence[Sensor] = (),
) -> PreparedValidation:
    """Take in the logs of a validation; arguments and errors as in `validate_rig`, and ``sensors``:
    what is known of sensors and drivers, or estimated of each log by itself.
    """
    models = models_of(rig, logs, channels, flow_maps, where)
    names = numbered([name for name, _ in logs])
    seen, records = [name in fitted_on for name, _ in logs], [record for _, record in logs]
    taken = tuple(
        taken_log(name, record, models[payload_of(record) or ""], fitted, sensors=sensors)
        for name, fitted, record in zip(names, seen, records, strict=True)
    )
    return PreparedValidation(rig, tuple(channels), taken, flow_maps)


def run_validation(
    prepared: PreparedValidation,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    workers: int = 0,
) -> Validation:
    """Judge what `prepare_validation` took in; arguments as in `validate_rig`.

    ``workers``: threads, 0 for one a core; the result does not depend on them."""
    requested = thresholds or Thresholds()
    logs = prepared.logs

    def judge(log: TakenLog) -> LogResult:
        return _judge(log, prepared.channels, requested)

    results = []
    with ThreadPoolExecutor(max(1, min(workers or cores(), len(logs)))) as pool:
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
        _plain(requested),
        tuple(results),
    )


def taken_log(
    name: str,
    record: Record,
    model: Model,
    fitted: bool = False,
    scored: tuple[float, float] | None = None,
    seen: Callable[[Record], tuple[Overlap, ...]] = lambda record: (),
    sensors: Sequence[Sensor] = (),
) -> TakenLog:
    """A log as the judge takes it.

    Args:
        name: of the log.
        record: of the log.
        model: with the log's payload.
        fitted: whether the model was fitted to it, whatever its samples.
        scored: the part [s] that counts, None for all of it.
        seen: where a record has samples that the model was fitted to.
        sensors: what is known of its sensors and drivers, or estimated.

    Raises:
        InputError: one that `preprocessing.preprocess` refuses, or no samples in ``scored``.
    """
    record = known_taken_out(name, record, sensors)
    terms = terms_of(sensors, [record])
    try:
        record, warnings = preprocess(name, record, model)
    except LogError as error:
        return TakenLog(name, record, model, fitted, scored, failure=error)
    counted = record if scored is None else _within(record, scored)
    if counted.t.size < 3:
        raise InputError(
            f"{name}: no samples from score_start to score_stop",
            hint=f"it runs from {record.t[0]:g} to {record.t[-1]:g} s",
        )
    overlap = seen(counted)
    known = fitted or bool(overlap)
    return TakenLog(name, record, model, known, scored, overlap, warnings, terms=terms)


def _within(record: Record, span: tuple[float, float]) -> Record:
    """The part of a record from and to these times [s]."""
    keep = (record.t >= span[0]) & (record.t <= span[1])
    channels = {name: values[keep] for name, values in record.channels.items()}
    return replace(record, t=record.t[keep], channels=channels)


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


def _plain(requested: Thresholds) -> dict[str, Any]:
    """The thresholds as plain values, in SI."""
    return requested.model_dump() | {
        "max_error": {name: float(value) for name, value in requested.max_error.items()},
        "response_phase_error": requested.response_phase_error
        and float(requested.response_phase_error),
        "response_delay_error": requested.response_delay_error
        and float(requested.response_delay_error),
    }


def _check_channels(rig: Rig, channels: Sequence[str]) -> None:
    known = ("q", "qd", "x", "v", "p_head", "p_rod", *GAUGES, *OF_VALVES)
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


def _judge(log: TakenLog, channels: tuple[str, ...], requested: Thresholds) -> LogResult:
    record, model = log.record, log.model
    counted = record if log.scored is None else _within(record, log.scored)
    moved, fixed = _moved(model, counted)
    facts = LogResult(
        name=log.name,
        payload=payload_of(record) or "none",
        status="fitted" if log.fitted else "held_out" if moved else "still",
        duration=float(np.ptp(counted.t)) if counted.t.size else 0.0,
        sample_time=record.sample_time,
        scored=None if log.scored is None else (float(counted.t[0]), float(counted.t[-1])),
        overlap=log.overlap,
        moved=moved,
        held=fixed,
    )
    warnings = [*log.warnings, *_doubts(log, moved)]
    try:
        if log.failure is not None:
            raise LogError(str(log.failure).removeprefix(f"{log.name}: "))
        result = _followed(log, moved, _free(record, channels))
        simulated = result.replay(model)
    except EhbenchError as error:
        return replace(
            facts,
            status="failed",
            failure=str(error),
            warnings=tuple(warnings),
            series=_recorded(record, moved, channels),
        )
    whole, lacking = _pairs(record, simulated, moved, _free(record, channels))
    warnings += [*_missed(lacking, channels, requested), *supply_off(record, simulated, model.rig)]
    keep = (record.t >= counted.t[0]) & (record.t <= counted.t[-1])
    pairs = {name: pair.part(keep) for name, pair in whole.items()}
    results = [compare(counted, model, name, pair) for name, pair in pairs.items()]
    warnings += [f"{item.channel}: {item.note}" for item in results if item.note]
    rings = () if "qd" in tied_words(record) else moved
    windows = [w for cylinder in rings for w in transients_of(counted, model, cylinder, pairs)]
    sweeps = [
        sweep
        for cylinder in moved
        for sweep in sweeps_of(counted, model, cylinder, pairs, requested.response_coherence)
    ]
    checks = checks_of(results, windows, sweeps, requested, model.rig)
    if moved and not checks:
        warnings.append("no threshold applies to what the log shows, so nothing is judged on it")
    return replace(
        facts,
        channels=tuple(results),
        transients=tuple(windows),
        sensors={t.name: t.value(result.excess[t.name]) for t in log.terms if t.std > 0.0},
        sweeps=tuple(sweeps),
        checks=tuple(checks),
        warnings=(
            *warnings,
            *unjudged(rings, windows),
            *unasked(results, requested, model.rig, record),
        ),
        series=_series(record, whole),
    )


def _missed(
    lacking: Sequence[str], channels: tuple[str, ...], requested: Thresholds
) -> Iterator[str]:
    """A note of each channel that a log lacks and that somebody asked for, by name or by a
    threshold.
    """
    for channel in lacking:
        words = {*stood_for(channel.rpartition(".")[2])}
        if channels != CHANNELS or words & {*requested.fit_percent, *requested.max_error}:
            yield f"the log has nothing to judge '{channel}' by"


def _free(record: Record, channels: Sequence[str]) -> list[str]:
    """Those of the channels that a record does not give to the simulation."""
    given = tied_words(record)
    return [word for word in channels if word not in given]


def _doubts(log: TakenLog, moved: Sequence[str]) -> list[str]:
    """Why a log does not count, if it does not."""
    sentences = []
    if log.fitted:
        when = ", ".join(
            f"{item.start:g} … {item.stop:g} s (of {item.log})" for item in log.overlap
        )
        sentences.append(
            "THE MODEL WAS FITTED TO THIS LOG"
            + (f", to its samples at {when}" if when else "")
            + ": it is shown, and the verdict rests on the others"
        )
    if not moved:
        sentences.append(
            "the log carries no motion: no valve was commanded, so nothing is judged on it"
        )
    return sentences


def _wanted(record: Record, moved: Sequence[str], channels: Sequence[str]) -> list[str]:
    """The channels of a log, by full name, that quantities ask for."""
    return [
        item for name in moved for word in channels for item in channels_asked(record, name, word)
    ]


def _pairs(
    record: Record, simulated: Record, moved: Sequence[str], channels: Sequence[str]
) -> tuple[dict[str, Pair], list[str]]:
    """(recorded and simulated by channel, the channels that neither the log nor a stand-in has)."""
    pairs: dict[str, Pair] = {}
    lacking = []
    for required in _wanted(record, moved, channels):
        open_ = [name for name in alternatives(required) if name not in pairs]
        both = ((name, pair_of(record, simulated, name)) for name in open_)
        name, pair = next(((name, pair) for name, pair in both if pair), (required, None))
        if pair is None:
            lacking.append(required)
        else:
            pairs[name] = pair
    return pairs, lacking


def _followed(log: TakenLog, moved: Sequence[str], channels: Sequence[str]) -> Followed:
    """Where the log starts and how its sensors are, as the cylinders that are judged tell it."""
    record = log.record
    required = _wanted(record, moved, channels)
    inputs = [
        next(
            (name for name in alternatives(item) if column(record, name, record) is not None), None
        )
        for item in required
    ]
    inputs = list(dict.fromkeys(filter(None, inputs)))
    return follow(log.model, record, moved, inputs, log.terms)


def _series(record: Record, pairs: Mapping[str, Pair]) -> dict[str, np.ndarray]:
    series = {"t": record.t}
    for name, pair in pairs.items():
        series |= {name: pair.recorded, f"simulated.{name}": pair.simulated}
    return series


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
    required = _wanted(record, moved, channels)
    names = [name for channel in required for name in alternatives(channel)]
    return {"t": record.t} | {name: record[name] for name in names if name in record}
