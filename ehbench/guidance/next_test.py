"""Which test would tell a parameter best: candidates simulated on the fitted rig, and what each
would add to what the logs say.

The covariance of a fit is ``H⁻¹``, H the normal matrix of its residuals with each log's start
eliminated. A test adds its own normal matrix ``H'``, which the fitted model gives before the test
is run; the interval then shrinks by ``√((H + H')⁻¹/H⁻¹)`` of its diagonal entry (Ljung 1999,
ch. 13). Residuals of the test are taken to be as large and as coloured as those of the logs."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.covariance import eliminate
from ehbench.identification.estimate import estimate_starts, information
from ehbench.identification.hydraulics import PreparedFit, problem_over
from ehbench.identification.problem import initial
from ehbench.identification.search import Coordinate
from ehbench.identification.simulator import Log, channels_of, prepare
from ehbench.plant.foreign import model_of
from ehbench.plant.model import Start
from ehbench.preprocessing.observations import column
from ehbench.vocabulary import MAD, EhbenchError, InputError, InsufficientData, Progress, message

# when a waveform drives out and back [s]
WAVES = {
    "steps": (((0.4, 1.0),), ((1.8, 2.4),)),
    "pulses": (((0.4, 0.55), (1.6, 1.75)), ((1.0, 1.15), (2.2, 2.35))),
    "long steps": (((0.4, 1.6),), ((2.0, 3.2),)),
}


@dataclass(frozen=True)
class Drive:
    """What moves a cylinder out and back: shares of the largest command by valve."""

    cylinder: str
    out: Mapping[str, float]
    back: Mapping[str, float]


@dataclass(frozen=True)
class Trial:
    """A test: ``commands`` as a trial recipe has them, SI; ``stroke`` [m] where it starts."""

    cylinder: str
    wave: str
    amplitude: float
    stroke: float
    payload: str | None
    commands: tuple[Mapping[str, Any], ...]
    seconds: float = 3.5


@dataclass(frozen=True)
class Proposal:
    """A test, with the 95 % interval [SI] that the parameter would have with its log beside those
    there are, and the share of its present width (None where it has none).
    """

    trial: Trial
    interval: tuple[float, float]
    share: float | None

    def width(self) -> float:
        """Of the interval [SI]."""
        return self.interval[1] - self.interval[0]


@dataclass(frozen=True)
class Known:
    """A fitted parameter as its run left it: value and interval [SI], None where the logs do not
    excite it, and the share of its variance that no log lessens."""

    name: str
    value: float
    interval: tuple[float, float] | None
    from_fixed: float = 0.0


def widest(fitted: Sequence[Known], search: Sequence[Coordinate]) -> str:
    """The least known parameter: one without an interval, else with the widest."""

    def width(item: Known, c: Coordinate) -> float:
        if item.interval is None:
            return math.inf
        return c.of(max(item.interval[1], c.lower)) - c.of(max(item.interval[0], c.lower))

    return max(zip(fitted, search, strict=True), key=lambda pair: width(*pair))[0].name


def must_be_fitted(name: str, names: Collection[str]) -> None:
    """Refuse a name that is none of those fitted.

    Raises:
        InputError: names those that were.
    """
    if name not in names:
        raise InputError(message("guidance.not_fitted", name=name, names=", ".join(names)))


def propose(
    prepared: PreparedFit, fitted: Sequence[Known], name: str, progress: Progress | None = None
) -> list[Proposal]:
    """Tests by what they would leave of the interval of parameter ``name``, the best first.

    Args:
        prepared: the fit's logs and parameters, its rig with the fitted values.
        fitted: what the fit found, in the order of the parameters.
        name: of the parameter to sharpen.
        progress: called with a sentence and the share done.

    Raises:
        InputError: the parameter was not fitted.
        InsufficientData: no test is possible that keeps off the ends of the stroke.
    """
    names = [c.name for c in prepared.search]
    must_be_fitted(name, names)
    report = progress or (lambda sentence, share: None)
    report("what the logs say", 0.0)
    planner = _Planner(prepared, fitted, names.index(name))
    results: list[Proposal] = []
    firsts = [
        trial
        for drive in planner.drives
        for wave in WAVES
        for share in (0.15, 0.3, 0.5, 0.85)  # of the valves' largest command
        for trial in planner.trials(drive, wave, share)
    ]
    for number, trial in enumerate(firsts):
        report("trying tests", 0.1 + 0.5 * number / len(firsts))
        results += planner.judged(trial)
    results.sort(key=Proposal.width)
    loads = (None, *prepared.rig.payload)
    drives = {drive.cylinder: drive for drive in planner.drives}
    more = [
        trial
        for item in (result.trial for result in results[:3])
        for trial in planner.trials(
            drives[item.cylinder], item.wave, item.amplitude, (0.5, 0.3, 0.7), loads
        )
        if trial != item
    ]
    for number, trial in enumerate(more):
        report("trying postures and loads", 0.6 + 0.4 * number / len(more))
        results += planner.judged(trial)
    if not results:
        raise InsufficientData(message("guidance.no_test"))
    return sorted(results, key=Proposal.width)


class _Planner:
    """What the logs say of the parameters, and what a test would add.

    Args:
        which: number of the parameter to sharpen.
    """

    def __init__(self, prepared: PreparedFit, fitted: Sequence[Known], which: int) -> None:
        self.prepared, self.fitted, self.which = prepared, fitted, which
        self.values = [item.value for item in fitted]
        excited = [item for item in fitted if item.interval is not None]
        self.rig = prepared.rig.with_values({item.name: item.value for item in excited})
        # with dead bands as wide as the logs leave them: what a test must open for sure
        ends = {item.name: item.interval[1] for item in excited if item.interval}
        self.shut = self.rig.with_values({n: u for n, u in ends.items() if n.endswith(".deadband")})
        problem = problem_over(prepared, prepared.logs)
        state = estimate_starts(problem, self.values)
        blocks, prior = information(problem, state)
        self.sensors = state.theta[len(fitted) :]
        self.scales, self.weight = state.scales, state.prior_weight
        self.normal = np.sum([eliminate(b, self.weight).normal for b in blocks], axis=0)
        self.normal = self.normal + prior.normal
        self.live = [i for i, item in enumerate(fitted) if item.interval or i == which]
        self.live += range(len(fitted), len(self.normal))
        # half of each present interval in search coordinates over the error for white residuals;
        # the median stands for one without
        wider, errors = {}, dict(zip(self.live, self._error(self.normal), strict=True))
        for i, (c, item) in enumerate(zip(prepared.search, fitted, strict=True)):
            if (half := c.half(item.value, item.interval)) is not None:
                wider[i] = half * math.sqrt(1.0 - item.from_fixed) / max(errors[i], 1e-300)
        self.widening = wider.get(which, float(np.median([*wider.values()])) if wider else 2.0)
        known = fitted[which]
        half = prepared.search[which].half(known.value, known.interval) or 0.0
        self.fixed = half * math.sqrt(known.from_fixed)
        self.drives = list(drives_of(self.rig, prepared.logs))
        # of the sensors by quantity, from how consecutive samples differ
        noise: dict[str, list[float]] = {}
        for log in prepared.logs:
            for name, y in log.record.channels.items():
                if not name.endswith("command"):
                    spread = MAD * float(np.median(np.abs(np.diff(y)))) / math.sqrt(2.0)
                    noise.setdefault(name.rsplit(".", 1)[-1], []).append(spread)
        self.noise = {word: float(np.median(sizes)) for word, sizes in noise.items()}

    def _error(self, normal: np.ndarray) -> np.ndarray:
        """Standard errors of the live parameters in search coordinates, for white residuals."""
        part = normal[np.ix_(self.live, self.live)]
        size = np.sqrt(np.maximum(np.diag(part), 1e-300))
        inverse = np.linalg.pinv(part / np.outer(size, size), hermitian=True)
        return np.sqrt(np.maximum(np.diag(inverse), 0.0)) / size

    def trials(
        self,
        drive: Drive,
        wave: str,
        amplitude: float,
        postures: Sequence[float] = (0.5,),
        loads: Sequence[str | None] = (None,),
    ) -> list[Trial]:
        """A waveform at an amplitude from several strokes, then with several loads."""
        stroke = float(self.rig.cylinder_named(drive.cylinder).stroke)
        commands = tuple(entries_of(self.shut, drive, wave, amplitude))
        starts = [(share, None) for share in postures] + [(postures[0], load) for load in loads[1:]]
        return [
            Trial(drive.cylinder, wave, amplitude, share * stroke, load, commands)
            for share, load in starts
        ]

    def judged(self, trial: Trial) -> list[Proposal]:
        """What a test would leave of the interval; nothing where it cannot be run."""
        try:
            log = self._log(trial)
            problem = problem_over(self.prepared, [log])
            state = initial(problem)
            pairs = zip(self.prepared.search, self.values, strict=True)
            state = replace(
                state,
                coarse=False,
                scales={c: self.scales.get(c, 1.0) for c in state.scales},
                theta=np.array([*(c.of(x) for c, x in pairs), *self.sensors]),
            )
            (block,), _ = information(problem, state)
        except EhbenchError:
            return []
        after = self.normal + eliminate(block, self.weight).normal
        k = self.live.index(self.which)
        c, known = self.prepared.search[self.which], self.fitted[self.which]
        errors = (self._error(normal)[k] for normal in (after, self.normal))
        half, before = (math.hypot(self.widening * float(std), self.fixed) for std in errors)
        middle = c.of(self.values[self.which])
        share = half / before if known.interval and before > 0.0 else None
        return [Proposal(trial, (c.at(middle - half), c.at(middle + half)), share)]

    def _log(self, trial: Trial) -> Log:
        """The log that the fitted rig would record of a test.

        Raises:
            InsufficientData: it runs into an end or beyond the pressures.
        """
        tick = self.prepared.logs[0].record.sample_time
        t = np.arange(round(trial.seconds / tick) + 1) * tick
        model = model_of(self.rig, self.prepared.flow_maps, trial.payload)
        begin = model.trim(model.posture({trial.cylinder: f"{trial.stroke!r} m"}))
        table = {f"{name}.command": y for name, y in commands_of(trial.commands, t).items()}
        built = model.replay(Record(t, table, {}), start=Start(begin))
        # what a careful person would not run; emptied chambers are no part of the model
        stroke = float(self.rig.cylinder_named(trial.cylinder).stroke)
        x = built.channels.get(f"{trial.cylinder}.x", np.full(t.size, trial.stroke))
        if np.min(x) < 0.04 * stroke or np.max(x) > 0.96 * stroke:
            raise InsufficientData(message("guidance.hits_end", cylinder=trial.cylinder))
        ends = (f"{trial.cylinder}.{word}" for word in ("p_head", "p_rod"))
        supply = float(self.rig.supply.pressure)
        shown = [built[name] for name in ends if name in built] or [np.array([supply])]
        if np.max(shown) > 1.5 * supply or np.min(shown) < 2.0e5:
            raise InsufficientData(message("guidance.bad_pressure", cylinder=trial.cylinder))
        rng = np.random.default_rng(0)
        measured = {name for log in self.prepared.logs for name in log.record.channels}
        channels = {
            name: y + self.noise.get(name.rsplit(".", 1)[-1], 0.0) * rng.standard_normal(y.size)
            for name, y in built.channels.items()
            if name in measured
        }
        record = Record(built.t, channels, {"payload": trial.payload or "none"})
        terms = self.prepared.logs[0].start.terms
        channels, each = self.prepared.options.channels, self.prepared.logs[0].each
        log = prepare(model, record, "test", channels, terms, each, None)
        clean = Record(built.t, built.channels, record.meta)
        return replace(log, recorded=channels_of(log, clean))


def drives_of(rig: Rig, logs: Sequence[Log]) -> list[Drive]:
    """What drove each cylinder: shares of the largest command by valve in fast motion."""
    results: dict[str, Drive] = {}
    for log, name in ((item, name) for item in logs for name in item.commanded):
        record, cylinder = log.record, rig.cylinder_named(name)
        speeds = (column(record, f"{name}.{word}", record) for word in ("v", "qd"))
        speed = next((values for values in speeds if values is not None), None)
        if name in results or speed is None:
            continue
        if cylinder.linkage and f"{name}.v" not in record and f"{name}.x" not in record:
            speed = cylinder.linkage.sign * speed
        reach, sides = 0.3 * float(np.max(np.abs(speed))), []
        for sign in (1.0, -1.0):
            rows, side = sign * speed > reach, {}
            for valve in cylinder.valve:
                channel = f"{name}.{valve.name}.command"
                if channel in record and rows.any():
                    mean = float(np.median(record[channel][rows])) - float(valve.rest)
                    side[f"{name}.{valve.name}"] = mean
            top = max((abs(u) for u in side.values()), default=0.0)
            sides.append({v: round(u / top, 2) for v, u in side.items() if abs(u) > 0.05 * top})
        if all(sides):
            results[name] = Drive(name, *sides)
    return list(results.values())


def entries_of(rig: Rig, drive: Drive, wave: str, amplitude: float) -> list[dict[str, Any]]:
    """Steps [V] of a waveform, one entry each: shares of what a valve has beyond its dead bands."""
    valves = {f"{c.name}.{v.name}": v for c, v in rig.valves()}
    entries = []
    for side, spans in zip((drive.out, drive.back), WAVES[wave], strict=True):
        for start, stop in spans:
            for valve, share in side.items():
                item = valves[valve]
                low, high = float(item.command_min), float(item.command_max)
                reach = max(abs(low), abs(high))
                bands = (float(e.deadband) for e in item.edge if e.sign * share > 0.0)
                shut = max(bands, default=0.0)
                volts = math.copysign(shut, share) + amplitude * share * max(reach - shut, 0.0)
                volts = min(max(volts, low), high)
                entry = {"valve": valve, "kind": "step", "amplitude": round(volts, 3)}
                entries.append(entry | {"start": start, "stop": stop})
    return entries


def commands_of(entries: Sequence[Mapping[str, Any]], t: np.ndarray) -> dict[str, np.ndarray]:
    """Commands [V] by valve of steps, at times ``t`` [s]."""
    results: dict[str, np.ndarray] = {}
    for entry in entries:
        on = (t >= entry["start"] - 1e-9) & (t < entry["stop"] - 1e-9)
        results[entry["valve"]] = results.get(entry["valve"], 0.0) + entry["amplitude"] * on
    return results
