"""A model judged on logs: it runs freely from each log's initial state on the log's commands, and
is compared with the recording channel by channel.

Where a log starts, its recording says within what its first samples leave open
(`preprocessing.initial_states.follow_recording`). Errors are simulated minus recorded, in SI."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.recipe import Thresholds
from ehbench.config.recipe.sensor import Sensor
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis import Case, ask, misread
from ehbench.plant.build import Maps
from ehbench.plant.foreign import model_of
from ehbench.plant.model import Model
from ehbench.plant.stiffness import short_steps
from ehbench.plant.ties import tied_words
from ehbench.preprocessing.initial_states import Followed, follow_recording
from ehbench.preprocessing.observations import (
    OF_VALVES,
    alternatives,
    channels_asked,
    column,
    commanded,
    not_described,
    payload_of,
    position_of,
    stood_for,
    supply_off,
)
from ehbench.preprocessing.preparation import PreparedLog, prepare
from ehbench.runtime.cores import cores
from ehbench.validation.baseline import black_boxes
from ehbench.validation.checks import checks_of, unrequested
from ehbench.validation.residuals import Pair, compare_channel, pair_of
from ehbench.validation.results import LogResult, Overlap, Validation
from ehbench.validation.sweeps import sweeps_of
from ehbench.validation.transients import transients_of, unjudged
from ehbench.vocabulary import Message, Progress, message, setting
from ehbench.vocabulary.errors import EhbenchError, FmuError, InputError, LogError, placed
from ehbench.vocabulary.messages import of_log
from ehbench.vocabulary.quantities import GAUGES
from ehbench.vocabulary.text import numbered

CHANNELS = ("q", "qd", "p_head", "p_rod")


@dataclass(frozen=True)
class VerdictSettings:
    """Numbers of the verdict on a model."""

    unexplained: float = setting(
        0.3,
        "",
        "rms residual of a channel, share of its spread, from which a reservation is made",
        "the fit that the template requires",
    )
    above_noise: float = setting(
        3.0, "", "rms residual, in those of the channel's noise, that is more than noise", "99.7 %"
    )


SETTINGS = VerdictSettings()
_KNOWN = ("q", "qd", "x", "v", "p_head", "p_rod", *GAUGES, *OF_VALVES)


def validate_rig(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    thresholds: Thresholds | None = None,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    progress: Progress | None = None,
    leans: Sequence[Mapping[str, Any]] = (),
) -> Validation:
    """Judge a rig on logs.

    A log that cannot be simulated is kept, marked, and rejects the model; a log in which no valve
    is commanded, or one the model was fitted to, is shown and does not count. Payloads come from
    each record's ``meta["payload"]``.

    Args:
        rig: with its identified numbers.
        logs: name and record of each.
        channels: quantities judged on every moved cylinder.
        thresholds: what is required.
        flow_maps: measured maps by edge name.
        fitted_on: names of those logs that the model was fitted to.
        progress: called with (log, share done).
        leans: what the fit of the rig found: ``speaking_against(fit.as_json())``.

    Raises:
        InputError: a payload or channel that the rig does not have, no logs, or one that
            `preprocessing.prepare` refuses."""
    prepared = prepare_validation(rig, logs, channels, flow_maps, fitted_on)
    prepared = replace(prepared, leans=tuple(leans))
    return run_validation(prepared, thresholds, progress)


@dataclass(frozen=True)
class JudgedLog:
    """A log to be judged.

    ``fitted`` says that the model was fitted to it, ``overlap`` to which of its samples,
    ``scored`` which part [s] counts (None: all), ``failure`` why it cannot be judged."""

    log: PreparedLog
    fitted: bool = False
    scored: tuple[float, float] | None = None
    overlap: tuple[Overlap, ...] = ()
    failure: LogError | None = None

    @property
    def counted(self) -> Record:
        """The part of the record that counts."""
        record = self.log.record
        return record if self.scored is None else record.between(*self.scored)


@dataclass(frozen=True)
class PreparedValidation:
    """The input of a validation, before anything is simulated; ``training`` are name and record of
    logs that the rig was fitted to, for the black box beside it, ``leans`` what its fit is
    sensitive to, as in ``parameters.json``."""

    rig: Rig
    channels: tuple[str, ...]
    logs: tuple[JudgedLog, ...]
    flow_maps: Maps | None = None
    training: tuple[tuple[str, Record], ...] = ()
    leans: tuple[Mapping[str, Any], ...] = ()

    def cases(self, results: Sequence[LogResult] = ()) -> list[Case]:
        """The logs as `ehbench.diagnosis.ask` takes them, sensors as the results have them."""
        sensors = {result.name: result.sensors for result in results}
        cases = []
        for item in self.logs:
            log, known = item.log, sensors.get(item.log.name, {})
            if item.failure is None:
                bias = {t.name: t.bias(known[t.name]) for t in log.terms if t.name in known}
                moved = commanded(log.model, log.record)
                facts = log.name, log.record, log.model, moved, self.flow_maps, item.scored
                cases.append(Case(*facts, log.terms, bias))
        return cases


def prepare_validation(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str] = CHANNELS,
    flow_maps: Maps | None = None,
    fitted_on: Collection[str] = (),
    sensors: Sequence[Sensor] = (),
) -> PreparedValidation:
    """Prepare the logs of a validation; arguments and errors as in `validate_rig`, and ``sensors``:
    what is known of sensors and drivers, or estimated of each log by itself."""
    models = models_of(rig, logs, channels, flow_maps)
    names = numbered([name for name, _ in logs])
    judged = tuple(
        prepare_log(
            name, record, models[payload_of(record) or ""], given in fitted_on, sensors=sensors
        )
        for name, (given, record) in zip(names, logs, strict=True)
    )
    return PreparedValidation(rig, tuple(channels), judged, flow_maps)


def run_validation(
    prepared: PreparedValidation,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    workers: int = 0,
    diagnose: bool = True,
) -> Validation:
    """Judge what `prepare_validation` prepared: by thresholds, by what the residuals say, by what
    the fit of the rig is sensitive to, by what nothing explains.

    Args:
        prepared: the logs, the rig and what its fit left.
        thresholds, progress: as in `validate_rig`.
        workers: threads, 0 for one a core; the result does not depend on them.
        diagnose: whether the residuals are asked for faults."""
    required = thresholds or Thresholds()

    def judge(log: JudgedLog) -> LogResult:
        return _judge(log, prepared.channels, required)

    results: list[LogResult] = []
    with ThreadPoolExecutor(min(workers or cores(), len(prepared.logs))) as pool:
        for result in pool.map(judge, prepared.logs):
            results.append(result)
            if progress is not None:
                progress(result.name, len(results) / len(prepared.logs))
    records = [log.log.record for log in prepared.logs]
    results, black_box, better = black_boxes(results, records, prepared.training)
    reasons = tuple(_reasons(results))
    against = _speaking_against(results)
    warnings = tuple(of_log(log.name, text) for log in results for text in log.warnings)
    plain = required.model_dump()
    plain["max_error"] = {name: float(value) for name, value in required.max_error.items()}
    for key in ("response_phase_error", "response_delay_error"):
        plain[key] = getattr(required, key) and float(getattr(required, key))
    verdict = Validation(
        prepared.rig.name,
        not reasons,
        reasons,
        tuple(text for text in warnings if text not in against),
        plain,
        tuple(results),
        reservations=(*better, *_unexplained(results)),
        black_box=black_box,
    ).with_fit(prepared.leans)
    if diagnose:
        if progress is not None:
            progress("diagnosing the residuals", 1.0)
        cases = prepared.cases(results)
        verdict = verdict.with_structure(ask(cases))
        against += [note for case in cases for note in misread(case)]
    return verdict.weighed(against, [False] * len(against))


def prepare_log(
    name: str,
    record: Record,
    model: Model,
    fitted: bool = False,
    scored: tuple[float, float] | None = None,
    seen: Callable[[Record], tuple[Overlap, ...]] = lambda record: (),
    sensors: Sequence[Sensor] = (),
) -> JudgedLog:
    """A log to be judged.

    Args:
        name: of the log.
        record: of the log.
        model: with the log's payload.
        fitted: whether the model was fitted to it, whatever its samples.
        scored: the part [s] that counts, None for all of it.
        seen: where a record has samples that the model was fitted to.
        sensors: what is known of its sensors and drivers, or estimated.

    Raises:
        InputError: one that `preprocessing.prepare` refuses, or no samples in ``scored``."""
    try:
        log = JudgedLog(prepare(name, record, model, sensors), fitted, scored)
    except LogError as error:
        return JudgedLog(PreparedLog(name, record, model), fitted, scored, failure=error)
    counted, t = log.counted, log.log.record.t
    if counted.t.size < 3:
        text = message("validation.nothing_scored", log=name, start=t[0], stop=t[-1])
        raise InputError(text)
    overlap = seen(counted)
    return replace(log, fitted=fitted or bool(overlap), overlap=overlap)


def models_of(
    rig: Rig,
    logs: Sequence[tuple[str, Record]],
    channels: Sequence[str],
    flow_maps: Maps | None,
    where: Callable[..., Mapping[str, Any]] = lambda *location: {},
) -> dict[str, Model]:
    """The model for each payload of the logs, by name, '' for none; arguments and errors as in
    `validate_rig`, their place by ``where``."""
    if not logs:
        raise InputError(message("validation.no_logs"))
    for index, (name, record) in enumerate(logs):
        with placed(where("data", index), name):
            rig.with_payload(payload_of(record))
    for channel in channels:
        if channel not in _KNOWN:
            fields = {"rig": rig.name, "channel": channel, "known": ", ".join(_KNOWN)}
            raise InputError(message("validation.unknown_channel", **fields))
    payloads = {payload_of(record) for _, record in logs}
    return {payload or "": model_of(rig, flow_maps, payload) for payload in payloads}


def _reasons(results: Sequence[LogResult]) -> Iterator[str]:
    for log in results:
        if log.failure:
            yield message("validation.not_simulated", log=log.name, reason=log.failure)
    counted = [log for log in results if log.status == "held_out"]
    for log in counted:
        yield from (f"{log.name}: {check.sentence}" for check in log.checks if not check.passed)
    if not any(log.checks for log in counted):
        fitted = ", ".join(log.name for log in results if log.status == "fitted")
        if fitted:
            yield message("validation.all_fitted", logs=fitted)
        else:
            yield message("validation.no_check")


def _speaking_against(results: Sequence[LogResult]) -> list[str]:
    """Notes that give a cause and what to write for it, the first of each kind."""
    first: dict[str, str] = {}
    for log in results:
        for text in log.warnings if log.status == "held_out" else ():
            if "cause" in getattr(text, "fields", {}):
                first.setdefault(getattr(text, "key", ""), of_log(log.name, text))
    return list(first.values())


def _unexplained(results: Sequence[LogResult]) -> Iterator[Message]:
    """The worst channel that the model leaves much of, whatever its noise."""
    worst = max(
        (
            (1.0 - 0.01 * item.fit_percent, log.name, item)
            for log in results
            if log.status == "held_out"
            for item in log.channels
            if item.fit_percent is not None
            and 1.0 - 0.01 * item.fit_percent > SETTINGS.above_noise * item.noise_share
        ),
        key=lambda entry: entry[0],
        default=None,
    )
    if worst is not None and worst[0] > SETTINGS.unexplained:
        share, log, item = worst
        yield message("validation.unexplained", log=log, channel=item.channel, share=share)


def _judge(judged: JudgedLog, channels: tuple[str, ...], required: Thresholds) -> LogResult:
    log, counted = judged.log, judged.counted
    record, model = log.record, log.model
    moved = commanded(model, counted)
    facts = LogResult(
        name=log.name,
        payload=payload_of(record) or "none",
        status="fitted" if judged.fitted else "held_out" if moved else "still",
        duration=float(np.ptp(counted.t)),
        sample_time=record.sample_time,
        scored=None if judged.scored is None else (float(counted.t[0]), float(counted.t[-1])),
        overlap=judged.overlap,
        moved=moved,
        held=tuple(c.name for c in model.rig.cylinder if c.name not in moved),
    )
    warnings = [*log.notes, *_not_counted(judged, moved)]
    wished = [c for name in moved for word in channels for c in channels_asked(record, name, word)]
    free = _free(model, record, wished)
    try:
        if judged.failure is not None:
            raise LogError(str(judged.failure).removeprefix(f"{log.name}: "))
        result = _followed(log, moved, free)
        simulated = result.replay(model)
        warnings += short_steps(model, result.true, result.start)
    except FmuError:  # says nothing of the log
        raise
    except EhbenchError as error:
        names = [name for item in wished for name in alternatives(item)]
        series = {"t": record.t} | {name: record[name] for name in names if name in record}
        facts = replace(facts, warnings=tuple(warnings), series=series)
        return replace(facts, status="failed", failure=str(error))
    whole, lacking = _pairs(record, simulated, free)
    for channel in lacking:  # of which somebody asked, by name or by a threshold
        words = {*stood_for(channel.rpartition(".")[2])}
        if channels != CHANNELS or words & {*required.fit_percent, *required.max_error}:
            warnings.append(message("validation.channel_missing", channel=channel))
    warnings += supply_off(record, simulated, model.rig)
    series, keep = {"t": record.t}, (record.t >= counted.t[0]) & (record.t <= counted.t[-1])
    for name, pair in whole.items():
        series |= {name: pair.recorded, f"simulated.{name}": pair.simulated}
    pairs = {name: pair.part(keep) for name, pair in whole.items()}
    results = [compare_channel(counted, model, name, pair) for name, pair in pairs.items()]
    warnings += [f"{item.channel}: {item.note}" for item in results if item.note]
    rings = () if "qd" in tied_words(record) else moved
    windows = [w for cylinder in rings for w in transients_of(counted, model, cylinder, pairs)]
    coherence = required.response_coherence
    sweeps = [s for name in moved for s in sweeps_of(counted, model, name, pairs, coherence)]
    checks = checks_of(results, windows, sweeps, required, model.rig)
    warnings += [message("validation.no_threshold")] if moved and not checks else []
    warnings += [*unjudged(rings, windows), *unrequested(results, required, model.rig, record)]
    return replace(
        facts,
        channels=tuple(results),
        transients=tuple(windows),
        sensors={t.name: t.value(result.bias[t.name]) for t in log.terms if t.std > 0.0},
        sweeps=tuple(sweeps),
        checks=tuple(checks),
        warnings=tuple(warnings),
        series=series,
    )


def _not_counted(log: JudgedLog, moved: Sequence[str]) -> Iterator[str]:
    spans = [f"{item.start:g} … {item.stop:g} s (of {item.log})" for item in log.overlap]
    if spans:
        yield message("validation.samples_fitted", spans=", ".join(spans))
    elif log.fitted:
        yield message("validation.fitted")
    if not moved:
        yield message("validation.no_motion")
    spans = not_described(log.log.model, log.counted) if not log.failure else ()
    for what, cylinder, void in spans:
        fields = {"t": log.counted.t[int(np.argmax(void))], "share": 100 * np.mean(void)}
        yield message(f"validation.{what}", cylinder=cylinder, **fields)


def _free(model: Model, record: Record, channels: Sequence[str]) -> list[str]:
    """The channels that a replay of the record has, or what stands for it, and that are not tied
    to it."""
    tied = tied_words(record)
    return [
        channel
        for channel in channels
        if channel.rpartition(".")[2] not in tied
        and any(model.shows(c if c in record else position_of(c)) for c in alternatives(channel))
    ]


def _pairs(
    record: Record, simulated: Record, required: Sequence[str]
) -> tuple[dict[str, Pair], list[str]]:
    """(recorded and simulated by channel, the channels that neither the log nor a stand-in has)."""
    pairs: dict[str, Pair] = {}
    lacking = []
    for channel in required:
        for name in alternatives(channel):
            if name not in pairs and (pair := pair_of(record, simulated, name)) is not None:
                pairs[name] = pair
                break
        else:
            lacking.append(channel)
    return pairs, lacking


def _followed(log: PreparedLog, moved: Sequence[str], required: Sequence[str]) -> Followed:
    """The initial state and the sensors of a log, by the channels that are judged."""
    record = log.record
    options = (
        [name for name in alternatives(channel) if column(record, name, record) is not None]
        for channel in required
    )
    channels = list(dict.fromkeys(names[0] for names in options if names))
    return follow_recording(log.model, record, moved, channels, log.terms)
