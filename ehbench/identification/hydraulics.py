"""Bulk modulus, damping and whatever else a recipe names, from step logs: output error, or the
thesis's matching.

Output error takes all logs at once: the parameters are those with which the simulated rates and
pressures come nearest to the recorded ones in weighted least squares. The thesis's way (2.3) turns
the bulk modulus until the simulated transients ring at the recorded frequency, then each joint's
damping until they decay alike.

Either way a number leaves with unit, standard error, 95 % interval, bounds, sample count and a
status word: ``estimated``; ``at_bound``: the data push it beyond its bound; ``not_excited``: the
data do not tell it, it stays at its start and its interval is unbounded; ``correlated``: the data
tell it only together with another one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.config.recipe.sensor import Sensor
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.frequency_response.response import Averaging
from ehbench.identification.estimate import estimate
from ehbench.identification.frequency_domain import on_response
from ehbench.identification.journal import Journal
from ehbench.identification.matching import Matching, refuse_unmatched
from ehbench.identification.means import SETTINGS as MEANS
from ehbench.identification.means import Decimate
from ehbench.identification.problem import Problem, problem_of
from ehbench.identification.results import HydraulicsFit
from ehbench.identification.search import Coordinate, Where, coordinates, of_sensors
from ehbench.identification.simulator import CHANNELS, Log, Simulator, prepare, shut
from ehbench.parts.edge import edge_law
from ehbench.plant.build import Maps, map_of
from ehbench.plant.foreign import model_of
from ehbench.plant.paced import AUTO, Step
from ehbench.plant.ties import tied_words
from ehbench.preprocessing.observations import payload_of
from ehbench.preprocessing.sensors import Term, known_taken_out, terms_of
from ehbench.signals.series import correlation_time
from ehbench.vocabulary import VOCABULARY, Z95, Progress, message
from ehbench.vocabulary.errors import InputError, InsufficientData, placed
from ehbench.vocabulary.quantities import meant


@dataclass(frozen=True)
class FitOptions:
    """What a fit of parameters to step logs may be told.

    Args:
        method: ``output_error`` or ``thesis``.
        start, lower, upper: SI numbers or texts with unit, by parameter name.
        prior: standard deviations about the rig's values that are known beside the data, likewise,
            or as a share such as ``"3 %"``; output error only.
        channels: what to compare, of every cylinder that moves or is asked to, or full names. Rates
            and pressures by default: an angle is the integral of the flow map's error.
        sensors: what is known of sensors and drivers, or estimated; method ``thesis`` takes only
            what is known.
        cutoff: low-pass [Hz] on recorded and simulated alike; output error only.
        response: the command to which the channels' frequency responses are compared, in place of
            their samples, and how they are averaged; output error only.
        decimate: samples of a log of which the mean is compared with that of the simulation; 1: all
            are compared, ``"auto"``: as many as take next to nothing from what the log tells, of a
            log faster than 1 kHz (`identification.means`).
        max_iterations: of the solver.
        step: of the integration [s], or ``"auto"``: chosen by the guard, the same ones for all that
            differences are taken of.
        workers: threads; 0 for one per core. The result does not depend on it."""

    method: str = "output_error"
    start: Mapping[str, str | float] = field(default_factory=dict)
    lower: Mapping[str, str | float] = field(default_factory=dict)
    upper: Mapping[str, str | float] = field(default_factory=dict)
    prior: Mapping[str, str | float] = field(default_factory=dict)
    channels: Sequence[str] = CHANNELS
    sensors: Sequence[Sensor] = ()
    cutoff: float | None = None
    response: tuple[str, Averaging] | None = None
    decimate: Decimate = "auto"
    max_iterations: int = 100
    step: Step = AUTO
    workers: int = 0


def identify_hydraulics(
    rig: Rig,
    records: Sequence[tuple[str, Record]],
    parameters: Sequence[str],
    options: FitOptions | None = None,
    flow_maps: Maps | None = None,
    progress: Progress | None = None,
    where: Where = lambda *location: {},
) -> HydraulicsFit:
    """Fit parameters of ``rig.parameters()`` to step logs.

    Args:
        rig: where the search starts, unless the options say otherwise.
        records: (name, log); a log's ``meta["payload"]`` names the payload carried, or ``none``.
        parameters: names; with method ``thesis`` only ``bulk_modulus`` and joint (or slide)
            dampings.
        options: method, start, bounds, channels and settings of the solver.
        flow_maps: measured maps (forward, reverse or None) by edge name.
        progress: called with a sentence and the share done.
        where: file and line of a recipe's key, for the errors: `Recipe.at`.

    Raises:
        InputError: unknown parameter or payload, a bad start or bound, or one the method does not
            take; a log that `preprocessing.preprocess` refuses; a cutoff above half the rate of a
            log.
        InsufficientData: no log tells anything about any parameter, or the fit follows none."""
    return run_fit(prepare_fit(rig, records, parameters, options, flow_maps, where), progress)


@dataclass(frozen=True)
class PreparedFit:
    """What a fit takes in, before anything is simulated."""

    rig: Rig
    parameters: tuple[str, ...]
    search: list[Coordinate]
    logs: tuple[Log, ...]
    options: FitOptions
    flow_maps: Maps | None = None


def prepare_fit(
    rig: Rig,
    records: Sequence[tuple[str, Record]],
    parameters: Sequence[str],
    options: FitOptions | None = None,
    flow_maps: Maps | None = None,
    where: Where = lambda *location: {},
) -> PreparedFit:
    """Take in the logs and parameters of a fit; arguments as in `identify_hydraulics`.

    Raises:
        InputError: as in `identify_hydraulics`.
        InsufficientData: a log in which nothing is commanded, or none in which a valve opens."""
    requested = options or FitOptions()
    decimate = _decimate(records, requested, where)
    _refuse_inert(rig, parameters, flow_maps, where)
    bounds = (requested.start, requested.lower, requested.upper)
    search = coordinates(rig, parameters, *bounds, where, requested.prior)
    records = [(name, known_taken_out(name, record, requested.sensors)) for name, record in records]
    terms = terms_of(requested.sensors, [record for _, record in records])
    _refuse_options(records, requested, search, terms, where)
    logs, closed = [], []
    for index, (name, record) in enumerate(records):
        with placed(where("data", index), name):
            rig.with_payload(payload_of(record))
        model = model_of(rig, flow_maps, payload_of(record))
        log = prepare(model, record, name, requested.channels, terms, decimate, requested.cutoff)
        free = any(name.endswith(("deadband", "overlap")) for name in parameters)
        if not (free or rig.model) and (why := shut(model, log)):
            warning = message("identification.all_shut", log=name, reason=why)
            closed.append(warning)
            log = replace(log, warnings=(*log.warnings, warning))
        logs.append(log if requested.response is None else on_response(log, *requested.response))
        half = 0.5 / log.sample_time
        if requested.cutoff is not None and requested.cutoff >= half:
            fields = {"cutoff": requested.cutoff, "log": name, "half": half}
            raise InputError(message("identification.high_cutoff", **fields), **where("cutoff"))
    if len(closed) == len(logs):
        raise InsufficientData(closed[0])
    return PreparedFit(rig, tuple(parameters), search, tuple(logs), requested, flow_maps)


def _decimate(
    records: Sequence[tuple[str, Record]], requested: FitOptions, where: Where
) -> Decimate:
    """How many samples of a log are compared as one mean; one where a method needs every sample.

    Raises:
        InputError: a given number is none, or leaves a log too few, or the method needs them all;
            an unknown method, logs that no name tells."""
    if requested.method not in ("output_error", "thesis"):
        raise InputError(message("identification.unknown_method", name=requested.method))
    if not records or len({name for name, _ in records}) < len(records):
        raise InputError(message("identification.unnamed_logs"))
    given, thesis = requested.decimate, requested.method == "thesis"
    whole = thesis or requested.response is not None
    if given == "auto":
        return 1 if whole else given
    place = where("decimate")
    if isinstance(given, bool) or not isinstance(given, int) or given < 1:
        raise InputError(message("identification.no_count", given=repr(given)), **place)
    if whole and given > 1:
        key = "identification.thesis_means" if thesis else "identification.response_means"
        raise InputError(message(key, count=given), **place)
    for name, record in records:
        count = record.t.size
        if given > 1 and count < MEANS.fewest * given:
            several = count // MEANS.fewest > 1
            key = "identification.large_means" if several else "identification.short_log"
            fields = {"log": name, "each": given, "samples": count, "means": count // given}
            fields |= {"fewest": MEANS.fewest, "maximum": count // MEANS.fewest}
            raise InputError(message(key, **fields), **place)
    return given


def _refuse_options(
    records: Sequence[tuple[str, Record]],
    requested: FitOptions,
    search: Sequence[Coordinate],
    terms: Sequence[Term],
    where: Where,
) -> None:
    """Refuse options that do not go together, what the thesis's way cannot fit or know, and
    channels to compare that no log of any rig has."""
    thesis, response = requested.method == "thesis", requested.response is not None
    if thesis:
        refuse_unmatched(search)
    tied = any(tied_words(record) for _, record in records)
    wrong = {
        "identification.response_low_pass": (response and requested.cutoff is not None, "cutoff"),
        "identification.thesis_prior": (thesis and requested.prior, "prior"),
        "identification.thesis_response": (thesis and response, "response"),
        "identification.thesis_tied": (thesis and tied, "tied"),
        "identification.thesis_sensor": (thesis and any(t.std > 0.0 for t in terms), "sensor"),
    }
    for key, (is_so, place) in wrong.items():
        if is_so:
            raise InputError(message(key), **where(place))
    for channel in requested.channels:
        if (word := channel.rpartition(".")[2]) not in VOCABULARY:
            text = message("identification.no_quantity", word=word, near=meant(channel))
            raise InputError(text, **where("channels"))


def _refuse_inert(
    rig: Rig, parameters: Sequence[str], flow_maps: Maps | None, where: Where
) -> None:
    """Refuse the law's numbers of an edge that goes by its measured map, and the factor of one that
    does not; of an FMU what it does not take."""
    known = rig.parameters() if rig.model is None else rig.model.settable
    for name in parameters:
        if rig.model is not None and name not in known:
            text = message("identification.fmu_parameter", name=name, known=", ".join(known))
            raise InputError(text, **where("parameters"))
    for edge_name, edge in rig.all_edges().items():
        measured = map_of(flow_maps, edge_name) is not None
        for word in (n.rpartition(".")[2] for n in parameters if n.rpartition(".")[0] == edge_name):
            key, right = "identification.edge_is_mapped", "map_factor"
            if not measured:
                needs = edge_law(edge.law).needs
                key, right = "identification.edge_is_unmapped", next(iter(needs), "flow_gain")
            inert = word not in ("map_factor", "cracking_pressure")
            if inert if measured else word == "map_factor":
                fields = {"edge": edge_name, "rig": rig.name, "word": word, "right": right}
                raise InputError(message(key, **fields), **where("parameters"))


def run_fit(
    prepared: PreparedFit, progress: Progress | None = None, journal: Journal | None = None
) -> HydraulicsFit:
    """Fit what `prepare_fit` took in; ``progress`` as in `identify_hydraulics`, ``journal`` of how
    far output error has come.

    Raises:
        InsufficientData: no log tells anything about any parameter, or the fit follows none."""
    requested, search = prepared.options, prepared.search
    simulator, maximum = simulator_of(prepared, prepared.logs), requested.max_iterations
    if prepared.rig.model is not None:  # what fails where it begins fails everywhere
        sensors = of_sensors(prepared.logs[0].start.terms)
        starts = [c.start for c in (*search, *sensors)]
        simulator.replay(starts, simulator.unshifted())
    if requested.method == "thesis":
        return Matching(simulator, search, progress or (lambda text, share: None), maximum).fit()
    return estimate(problem_over(prepared, prepared.logs, progress, journal))[0]


def problem_over(
    prepared: PreparedFit,
    logs: Sequence[Log],
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Problem:
    """The problem of a fit over logs; ``progress`` and ``journal`` as of `run_fit`."""
    simulator, limits = simulator_of(prepared, logs), prepared.options
    given = progress, limits.max_iterations, limits.cutoff, journal
    return problem_of(simulator, prepared.search, *given)


def simulator_of(prepared: PreparedFit, logs: Sequence[Log]) -> Simulator:
    """Logs simulated at the parameters of a fit and at what is shared of their sensors."""
    sensors, requested = of_sensors(logs[0].start.terms), prepared.options
    names = [*prepared.parameters, *(c.name for c in sensors)]
    given = prepared.flow_maps, requested.workers, requested.step
    return Simulator(prepared.rig, logs, names, *given)


@dataclass(frozen=True)
class Variant:
    """One named valve dynamics in a comparison: its fit, and the geometric mean over all logs and
    channels of the residual's rms relative to the best variant (1 for the best), with its 95 %
    ``interval``: the data decide against it where that lies above 1."""

    dynamics: str
    relative_rms: float
    interval: tuple[float, float]
    fit: HydraulicsFit

    def as_json(self) -> dict[str, Any]:
        """Plain values for `rundir.write_json`."""
        return {
            "dynamics": self.dynamics,
            "relative_rms": self.relative_rms,
            "interval": list(self.interval),
            "fit": self.fit.as_json(),
        }


def with_each_dynamics(rig: Rig, variants: Sequence[str]) -> dict[str, Rig]:
    """The rig with each named valve dynamics in place of any of the others, by name.

    Raises:
        InputError: a variant the rig does not have, or no valve on any of them."""
    for name in variants:
        if name not in rig.dynamics:
            fields = {"rig": rig.name, "name": name, "known": ", ".join(rig.dynamics) or "none"}
            raise InputError(message("identification.no_dynamics", **fields))
    if not any(set(valve.series) & set(variants) for _, valve in rig.valves()):
        names = ", ".join(variants)
        raise InputError(message("identification.unused_dynamics", rig=rig.name, names=names))

    return {
        name: rig.with_valves(lambda _, valve, name=name: valve.with_dynamics(variants, name))
        for name in variants
    }


def ranked(fits: Mapping[str, HydraulicsFit]) -> tuple[Variant, ...]:
    """Fits of the same logs with one valve dynamics each, best first."""
    level = {
        name: np.mean(
            [math.log(max(x, 1e-300)) for log in fit.logs for x in log.residual_rms.values()]
        )
        for name, fit in fits.items()
    }
    order = sorted(fits, key=lambda name: level[name])
    best, variants = order[0], []
    for name in order:
        more, half = level[name] - level[best], Z95 * _doubt(fits[name], fits[best])
        ends = (math.exp(more - half), math.exp(more + half))
        variants.append(Variant(name, math.exp(more), ends, fits[name]))
    return tuple(variants)


def _doubt(item: HydraulicsFit, other: HydraulicsFit) -> float:
    """Standard error of the mean over all logs and channels of ln(rms/rms of the other).

    A sample moves ln(rms_a/rms_b) by ½ (e_a²/rms_a² − e_b²/rms_b²) over their number; those of all
    channels of a log go together, and neighbours as far as their correlation time reaches."""
    variance, count = 0.0, 0
    for (_, a), (_, b), log in zip(item.recordings, other.recordings, item.logs, strict=True):
        moves = np.zeros(a["t"].size)
        for name in log.residual_rms:
            for built, sign in ((a, 0.5), (b, -0.5)):
                square = np.nan_to_num(built[name] - built[f"simulated.{name}"]) ** 2
                moves += sign * square / max(float(square.mean()), 1e-300)
        count += len(log.residual_rms)
        variance += float(moves.var()) * correlation_time(moves) / moves.size
    return math.sqrt(variance) / count
