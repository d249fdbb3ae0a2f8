"""What an identification leaves: the rig with its new values, how each log fits at them, and what
is doubtful."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.config.recipe.sensor import reading_row
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis import Case, misread
from ehbench.identification.fixed_numbers import counts_on
from ehbench.identification.frequency_domain import ResponseFit, followed, late_responses
from ehbench.identification.groups import Group
from ehbench.identification.means import compared_as
from ehbench.identification.search import Coordinate
from ehbench.identification.simulator import Log, Shifts, Simulator, channels_of, seen_as
from ehbench.plant.ties import tied_words
from ehbench.preprocessing.observations import noise_of, read_off, supply_off
from ehbench.preprocessing.sensors import Term
from ehbench.signals.series import Ringing, correlation_time, fit_percent, lowpass, rms
from ehbench.vocabulary import InsufficientData, Message, message, quantity, setting
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.messages import of_log
from ehbench.vocabulary.quantities import GAUGES

SHOWN = ("q", "qd", "x", "v", "p_head", "p_rod", *GAUGES)


@dataclass(frozen=True)
class ResultSettings:
    """Numbers of the notes on a fit."""

    little: float = setting(
        0.1, "", "residual of a channel, of its spread, up to which nothing is said", "fits of 90 %"
    )
    structure: float = setting(3.0, "", "residual over noise that is more than noise", "clear")
    fine: float = setting(0.005, "", "smallest noise of a channel, of its spread", "best sensors")
    opposite: float = setting(
        -0.5, "", "correlation below which a channel goes the other way", "clear"
    )
    late: float = setting(0.25, "", "smallest delay that is told, in samples", "fits hide half")
    latest: float = setting(5.0, "", "largest delay of first order, in samples", "chosen")
    explains: float = setting(0.2, "", "part of the residual that a delay explains", "clear")


SETTINGS = ResultSettings()


@dataclass(frozen=True)
class FittedParameter:
    """One fitted number, SI. ``std`` and ``interval`` (95 %) are None where the data give none;
    ``error_from`` says which standard error it is: ``hac`` or ``acf`` (coloured residuals within
    each log), ``counts`` (resolution of the readings), ``jackknife`` (leaving out one log at a
    time), ``windows``, or ``range``: the interval is what the logs do not deny, and ``std`` a share
    of its width. ``from_data`` is the share of what is known of it that is not its ``prior``'s (a
    standard deviation, None for none), ``from_starts`` the share of its variance that it has
    because the logs' starts are estimated, ``from_fixed`` the share that standard errors of fixed
    numbers and of flow maps cause."""

    name: str
    unit: str
    value: float
    std: float | None
    interval: tuple[float, float] | None
    lower: float
    upper: float
    start: float
    status: str
    samples: int
    error_from: str = ""
    prior: float | None = None
    from_data: float = 1.0
    from_starts: float = 0.0
    from_fixed: float = 0.0


@dataclass(frozen=True)
class Match:
    """One transient whose ringing was matched: natural frequency [rad/s] and damping ratio,
    recorded and simulated."""

    log: str
    cylinder: str
    channels: tuple[str, ...]
    start: float
    stop: float
    recorded: Ringing
    simulated: Ringing


@dataclass(frozen=True)
class LogFit:
    """How well one log is reproduced, by channel: NRMSE fit [%], rms residual [SI] and its
    correlation time [samples], over the samples that count; ``counted`` is their share [%],
    ``samples`` how many the log has. Where it is compared as means of ``mean_of`` samples, residual
    and correlation time are of these, and those that fill none at the end are no samples. ``start``
    is where the simulation starts [SI] where that was estimated, ``start_shift`` by how much it was
    moved from what the first samples say; ``responses`` is what was compared where that are
    frequency responses."""

    name: str
    payload: str
    samples: int
    fit_percent: dict[str, float]
    residual_rms: dict[str, float]
    correlation_time: dict[str, float]
    counted: dict[str, float]
    start: dict[str, float] = field(default_factory=dict)
    start_shift: dict[str, float] = field(default_factory=dict)
    responses: tuple[ResponseFit, ...] = ()
    mean_of: int = field(kw_only=True)


@dataclass(frozen=True)
class SensorFit:
    """What was found of a channel's sensor [SI]: its ``word`` (offset, scale, lag, delay), the
    ``log`` that it is of, '' for all; ``prior`` is the standard deviation that the recipe gave it
    about ``known``."""

    channel: str
    word: str
    log: str
    unit: str
    value: float
    std: float
    interval: tuple[float, float]
    known: float
    prior: float

    @classmethod
    def of(cls, term: Term, log: str, bias: float, std: float, quantile: float) -> SensorFit:
        """Of a bias with its standard error."""
        size = abs(term.per)
        value, half = term.value(bias), quantile * size * std
        unit = reading_row(term.channel, term.word).unit
        ends = (value - half, value + half)
        known = term.value(0.0)
        return cls(
            term.channel, term.word, log, unit, value, size * std, ends, known, size * term.std
        )


@dataclass(frozen=True)
class Moved:
    """An estimate ``name`` [SI] that would be ``there`` in place of ``here``, off by so many half
    widths of its 95 % interval."""

    name: str
    here: float
    there: float
    halves: float


@dataclass(frozen=True)
class Lean:
    """A held number ``name`` that the logs would have at ``there`` ± ``std`` in place of ``here``
    [SI], the share of the squares that are left which that explains, the estimates that ``moved``
    with it, the most by its interval first, the ``remedy``, a line of recipe or rig file that
    frees it, and a ``sentence`` on all that. What a sensor or a driver is taken to have none of has
    the name of its channel and of that, such as ``press.v.lag``."""

    name: str
    here: float
    there: float
    std: float
    explains: float
    moved: tuple[Moved, ...]
    remedy: str
    sentence: str = ""

    @property
    def beyond(self) -> float:
        """By how many half widths of its interval the estimate that moves most would be off."""
        return self.moved[0].halves if self.moved else 0.0


@dataclass(frozen=True)
class Doubts:
    """What a fit took as known: ``warnings`` of the fixed gain that the logs deny most, the fixed
    numbers with which estimates would leave their intervals, the likeliest first (``leans``), and
    what was not asked because the fit itself took few simulations (``unasked``)."""

    warnings: tuple[str, ...] = ()
    leans: tuple[Lean, ...] = ()
    unasked: tuple[str, ...] = ()


@dataclass(frozen=True)
class HydraulicsFit:
    """What an identification found. ``rig`` carries the fitted values; ``correlation`` is between
    the parameters with a standard error, in the order of ``correlated_names``; ``scales`` [SI] is
    what each channel's residual was divided by; ``sensors`` what was found of the logs' own,
    ``groups`` the products of parameters that the logs know though they do not know each,
    ``counts_on`` a sentence on what is held that a parameter is known in relation to,
    ``left_over`` one on what the model does not follow, empty where that is little or noise,
    ``compared`` one on each log that is compared as means of several samples, ``leans`` the held
    numbers that the logs deny and without which the parameters would come out beyond their
    intervals, ``unasked`` faults that so short a fit did not ask for."""

    rig: Rig
    method: str
    parameters: tuple[FittedParameter, ...]
    correlated_names: tuple[str, ...]
    correlation: tuple[tuple[float, ...], ...]
    logs: tuple[LogFit, ...]
    matches: tuple[Match, ...]
    scales: dict[str, float]
    warnings: tuple[str, ...]
    evaluations: int
    iterations: int
    recordings: tuple[tuple[str, dict[str, np.ndarray]], ...]
    sensors: tuple[SensorFit, ...] = ()
    groups: tuple[Group, ...] = ()
    counts_on: tuple[str, ...] = ()
    left_over: str = ""
    compared: tuple[str, ...] = ()
    leans: tuple[Lean, ...] = ()
    unasked: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> FittedParameter:
        """The fitted parameter of that name.

        Raises:
            KeyError: it was not fitted."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)

    def as_json(self) -> dict[str, Any]:
        """Everything but the rig and the time series as plain values, for `rundir.write_json`; what
        is unknown is None."""
        return asdict(replace(self, rig=None, recordings=())) | {
            "rig": self.rig.name,
            "recordings": [name for name, _ in self.recordings],
        }


@dataclass(frozen=True)
class Estimate:
    """What a method found: its parameters in the order searched, and what belongs to them; fields
    as in `HydraulicsFit`. ``cutoff`` [Hz]: of the low-pass on what is left of each log; ``shifts``
    of their starts, None for none; ``shared`` the values of the simulator's parameters behind those
    that were searched, ``sensors`` what was found of these."""

    method: str
    fitted: Sequence[FittedParameter]
    warnings: Sequence[str]
    iterations: int
    names: Sequence[str] = ()
    correlation: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    matches: Sequence[Match] = ()
    scales: Mapping[str, float] = field(default_factory=dict)
    cutoff: float | None = None
    shifts: Shifts | None = None
    shared: Sequence[float] = ()
    sensors: Sequence[SensorFit] = ()
    groups: Sequence[Group] = ()
    doubts: Doubts = Doubts()


def not_excited(c: Coordinate, samples: int) -> FittedParameter:
    """A parameter that the logs do not tell: it stays at its start."""
    return FittedParameter(
        name=c.name,
        unit=c.row.unit,
        value=c.start,
        std=None,
        interval=None,
        lower=c.lower,
        upper=c.upper,
        start=c.start,
        status="not_excited",
        samples=samples,
    )


def _misread(
    simulator: Simulator, values: Sequence[float], starts: Sequence[float]
) -> Iterator[Message]:
    """Notes on logs whose payload or channels are not those that the recipe states."""
    now, before = simulator.models(values), simulator.models(starts)
    for log in simulator.logs:
        case = Case(
            log.name,
            log.record,
            now[log.payload],
            log.commanded,
            simulator.maps,
            terms=log.start.terms,
        )
        yield from misread(case, replace(case, model=before[log.payload]))


def finish(simulator: Simulator, result: Estimate) -> HydraulicsFit:
    """The result: the rig with its new values, and how each log fits at them.

    Raises:
        InsufficientData: the fitted model follows no channel of any log better than its mean."""
    warnings: list[str] = [text for log in simulator.logs for text in log.warnings]
    warnings += [*result.warnings, *_statuses(result.fitted, simulator, result.warnings)]
    logs, recordings = [], []
    shifts = simulator.unshifted() if result.shifts is None else result.shifts
    values = [*(item.value for item in result.fitted), *result.shared]
    begun = [*(item.start for item in result.fitted), *result.shared]
    starts, replays = simulator.replay(values, shifts)
    warnings += [*simulator.short_steps(values, shifts), *_misread(simulator, values, begun)]
    moving: dict[str, list[Record]] = {}
    for k, (log, replayed) in enumerate(zip(simulator.logs, replays, strict=True)):
        simulated = channels_of(log, replayed)
        fit = _log_fit(log, simulated, result.cutoff)
        if result.shifts is not None:
            fit = replace(fit, start=starts[k], start_shift=log.start.moved(shifts[k]))
        if log.band is None:
            warnings += [*_late(log, simulated), *_turned(log, simulated)]
        else:
            fit = replace(fit, responses=followed(log, replayed))
            warnings += late_responses(log, simulated)
        off = supply_off(log.record, replayed, simulator.rig)
        warnings += [of_log(log.name, text) for text in off]
        logs.append(fit)
        recordings.append((log.name, _recording(log, seen_as(log, replayed))))
        for name in log.live:
            moving.setdefault(name, []).append(replayed)
    laws = simulator.rig.model is None  # nobody knows what the numbers of an FMU count on
    known = [item.name for item in result.fitted if laws and item.interval is not None]
    count = len(logs)
    source = f"identified from {count} log{'s' if count > 1 else ''}, {result.method}"
    values = {}
    for item in (item for item in result.fitted if item.status != "not_excited"):
        facts = {"std": item.std, "lower": item.lower, "upper": item.upper, "source": source}
        values[item.name] = Value(item.value, sure="identified", **facts)
    return HydraulicsFit(
        rig=simulator.rig.with_values(values),
        method=result.method,
        parameters=tuple(result.fitted),
        correlated_names=tuple(result.names),
        correlation=tuple(tuple(map(float, row)) for row in result.correlation),
        logs=tuple(logs),
        matches=tuple(result.matches),
        scales=dict(result.scales),
        warnings=tuple(_poor(logs) + warnings),
        evaluations=simulator.effort.evaluations,
        iterations=result.iterations,
        recordings=tuple(recordings),
        sensors=tuple(result.sensors),
        groups=tuple(result.groups),
        counts_on=counts_on(simulator.rig, known, moving),
        left_over=_left_over(simulator.logs, logs),
        compared=_compared(simulator.logs),
        leans=result.doubts.leans,
        unasked=result.doubts.unasked,
    )


def _statuses(
    fitted: Sequence[FittedParameter], simulator: Simulator, told: Sequence[str] = ()
) -> list[str]:
    """A warning of each parameter that is not excited, at a bound if it is not ``told``, or that no
    ordinary rig has."""
    warnings, rig = [], simulator.rig
    records = [log.record for log in simulator.logs]
    notes = (text for text in told if isinstance(text, Message))
    limited = {text.fields["name"] for text in notes if text.key == "identification.at_limit"}
    for item in fitted:
        fields = {"name": item.name, "value": rig.shown(item.name, item.value)}
        if item.status == "not_excited" and (channel := read_off(item.name, records)):
            warnings.append(message("identification.read_off", channel=channel, **fields))
        elif item.status == "not_excited":
            warnings.append(message("identification.not_excited", **fields))
        elif item.status == "at_bound" and item.name not in limited:
            is_low = item.value - item.lower < item.upper - item.value
            shut = item.name.endswith(".deadband") and item.value == 0.0
            key = "identification.closed_deadband" if shut else "identification.at_bound"
            warnings.append(message(key, side="lower" if is_low else "upper", **fields))
        elif item.status == "estimated" and not quantity(item.name).ordinary(item.value):
            low, high = (rig.shown(item.name, end) for end in quantity(item.name).usual)
            warnings.append(message("identification.unusual", low=low, high=high, **fields))
    return warnings


def _log_fit(log: Log, simulated: np.ndarray, cutoff: float | None) -> LogFit:
    left = simulated - log.recorded
    left = lowpass(left, log.sample_time, cutoff) if cutoff else left
    samples, each = log.each * len(left), log.each
    fit = LogFit(log.name, log.payload or "none", samples, {}, {}, {}, {}, mean_of=each)
    for channel, y, model, rest, counts in zip(
        log.channels, log.recorded.T, simulated.T, left.T, log.counts.T, strict=True
    ):
        some = counts if counts.any() else ~counts
        fit.fit_percent[channel] = fit_percent(y[some], model[some])
        fit.residual_rms[channel] = rms(rest[some])
        fit.correlation_time[channel] = correlation_time(rest[some])
        fit.counted[channel] = 100.0 * float(np.mean(counts))
    return fit


def _recording(log: Log, replayed: Record) -> dict[str, np.ndarray]:
    """Recorded and simulated channels of the cylinders that move."""
    shown = [f"{cylinder}.{word}" for cylinder in log.live for word in SHOWN]
    shown = [channel for channel in shown if channel in log.seen and channel in replayed]
    given = tied_words(log.record)
    built = [channel for channel in shown if channel.rpartition(".")[2] not in given]
    return (
        {"t": log.seen.t}
        | {channel: log.seen[channel] for channel in shown}
        | {f"simulated.{channel}": replayed[channel] for channel in built}
    )


def _turned(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning of each channel that goes the other way than the fitted model has it."""
    results: list[str] = []
    for channel, y, model, counts in zip(
        log.channels, log.recorded.T, simulated.T, log.counts.T, strict=True
    ):
        if not counts.any():
            continue
        seen, built = (item[counts] - np.mean(item[counts]) for item in (y, model))
        size, alike = rms(seen) * rms(built), float(np.mean(seen * built))
        if alike < SETTINGS.opposite * size:
            fields = {"log": log.name, "channel": channel, "likeness": alike / size}
            results.append(message("identification.other_way", **fields))
    return results


def _poor(logs: Sequence[LogFit]) -> list[str]:
    """A loud warning of the channels that are followed worse than by their mean; refuses a fit that
    has nothing else."""
    fits = {
        f"{log.name}: {channel}": value
        for log in logs
        for channel, value in log.fit_percent.items()
        if math.isfinite(value)
    }
    poor = {name: value for name, value in fits.items() if value < 0.0}
    if not poor:
        return []
    worst = sorted(poor.items(), key=lambda item: item[1])[:4]
    fields = {"worst": ", ".join(f"{name} {value:.0f} %" for name, value in worst)}
    if len(poor) == len(fits):
        raise InsufficientData(message("identification.follows_nothing", **fields))
    fields |= {"poor": len(poor), "all": len(fits)}
    return [message("identification.does_not_follow", **fields)]


def _left_over(logs: Sequence[Log], fits: Sequence[LogFit]) -> str:
    """A sentence on the channel that is followed worst, where what is left of it is neither little
    nor noise: a parameter takes up what the model lacks, and its interval does not know of that."""
    worst: tuple[float, str] = (SETTINGS.little, "")
    for log, fit in zip(logs, fits, strict=True):
        for channel, y, counts in zip(log.channels, log.recorded.T, log.counts.T, strict=True):
            if log.band is not None or not counts.any():
                continue
            share = 1.0 - 0.01 * fit.fit_percent[channel]
            noise = max(noise_of(log.seen, channel), SETTINGS.fine * float(np.std(y)))
            times = fit.residual_rms[channel] / noise
            if share > worst[0] and times > SETTINGS.structure:
                fields = {"channel": channel, "log": log.name, "share": 100.0 * share}
                worst = share, message("identification.left_over", times=times, **fields)
    return worst[1]


def _compared(logs: Sequence[Log]) -> tuple[str, ...]:
    """How logs are compared that are not sample by sample, in words: those alike together."""
    alike: dict[str, list[str]] = {}
    for log in logs:
        if log.means is not None:
            alike.setdefault(compared_as(log.record, log.means), []).append(log.name)
    texts = []
    for how, names in alike.items():
        listed = "all logs" if len(names) == len(logs) > 1 else " and ".join(names)
        key = "identification.is_compared" if len(names) == 1 else "identification.are_compared"
        texts.append(message(key, logs=listed, how=how))
    return tuple(texts)


def _late(log: Log, simulated: np.ndarray) -> list[str]:
    """A warning if moving the simulation a little would explain a fifth of what is left.

    To first order ``simulated(t) − recorded(t) = delay · d simulated/dt``. Fitted parameters take
    up more than half of a shift, so a quarter of a sample may well be a whole one."""
    tick = log.sample_time
    left = (simulated - log.recorded) * log.counts
    slope = np.gradient(simulated, tick, axis=0) * log.counts
    size = np.maximum(np.sqrt(np.mean(left**2, axis=0)), 1e-300)
    left, slope = left / size, slope / size
    power = float(np.sum(slope**2))
    if not power:
        return []
    delay = float(np.sum(slope * left)) / power
    is_delay = SETTINGS.late * tick <= abs(delay) <= SETTINGS.latest * tick
    if not is_delay or delay**2 * power < SETTINGS.explains * float(np.sum(left**2)):
        return []
    key = "identification.late" if delay > 0 else "identification.early"
    return [message(key, log=log.name, delay=abs(delay) * 1e3)]
