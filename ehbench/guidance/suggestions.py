"""What would better a fit: likely changes of model and sensors, each fitted to some windows of the
logs and compared on the others; the simplest that is not worse than the best comes first.

Every log is cut into windows of equal length, and every other window is left out of a fit: twice,
so that each is left out once. Simulations run through; only what they are compared on differs. A
change is kept, and others tried on top of it, as long as what is left out gets smaller."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from ehbench.config.recipe.sensor import ESTIMATE, WORDS, Sensor, reading_row
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis.faults import Hypothesis, hypotheses
from ehbench.guidance.comparison import Comparison, comparison_of
from ehbench.identification.basins import at_values, descend, foreseen, nearest_basin
from ehbench.identification.hydraulics import FitOptions, PreparedFit, prepare_fit, problem_over
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.identification.problem import Problem, effects, evaluate, initial, jacobian
from ehbench.identification.simulator import Log
from ehbench.report.blocks import Cell, Grid
from ehbench.report.terminal import Answer
from ehbench.signals.series import white_noise
from ehbench.vocabulary import EhbenchError, InputError, Progress, message
from ehbench.vocabulary.fields import Value

SECONDS = 120.0  # of trying, by default
ROUNDS = 5  # changes on top of one another, at most
SHOWN = 16  # rows on a terminal
# no such rig, or no such fit
IMPOSSIBLE = (EhbenchError, ValueError, ArithmeticError, np.linalg.LinAlgError)


def merged(sensors: Sequence[Sensor], more: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Sensors with what others say of them, one table a channel."""
    results = {sensor.channel: sensor for sensor in sensors}
    for item in more:
        given = {key: getattr(item, key) for key in item.model_fields_set}
        old = results.get(item.channel)
        results[item.channel] = item if old is None else old.model_copy(update=given)
    return tuple(results.values())


@dataclass(frozen=True)
class Setup:
    """A fit to try: its rig, parameters and options, and the changes that made it."""

    rig: Rig
    parameters: tuple[str, ...]
    options: FitOptions
    changes: tuple[Hypothesis, ...] = ()

    def with_change(self, change: Hypothesis) -> Setup:
        """This with one change more.

        Raises:
            ValueError: there is no such rig."""
        upper = {**self.options.upper, **change.upper}
        sensors = merged(self.options.sensors, change.sensors)
        return Setup(
            change.altered(self.rig),
            (*self.parameters, *(n for n in change.parameters if n not in self.parameters)),
            replace(self.options, upper=upper, sensors=sensors),
            (*self.changes, change),
        )

    @property
    def freedom(self) -> int:
        """How many numbers its changes free."""
        return sum(change.freedom for change in self.changes)


@dataclass(frozen=True, eq=False)
class Tried:
    """A fit that was tried: what it leaves out [SI²], its numbers and costs by fold."""

    setup: Setup
    left: dict[tuple[str, int], dict[str, float]]
    numbers: tuple[dict[str, float], ...]
    costs: tuple[float, ...]


@dataclass(frozen=True)
class Suggestion:
    """A row of the table: ``changes`` in words, how many numbers they free, what is left out
    relative to the recipe's own fit (mean square, 1 for that), the standard error of its
    difference from the best, relative to the same, whether it is ``not_worse`` than that; the lines
    to write."""

    changes: tuple[str, ...]
    freedom: int
    misfit: float
    std: float
    not_worse: bool
    recipe_lines: tuple[str, ...]
    rig_lines: tuple[str, ...]

    @property
    def words(self) -> str:
        """Its changes in a sentence, the last first: terminals cut the end, which rows share."""
        return " and ".join(reversed(self.changes)) or "the recipe as it is"


@dataclass(frozen=True, eq=False)
class Suggestions:
    """The table, simplest that is not worse first; ``setups`` are the fits behind its rows;
    ``untried`` names what there was no time for on top of the best; ``compared`` is what all rows
    compare."""

    rows: tuple[Suggestion, ...]
    setups: tuple[Setup, ...]
    untried: tuple[str, ...]
    compared: Comparison = Comparison(())

    def answer(self, recipe: Path, written: Path | None = None) -> Answer:
        """What the command says: the rows by what they leave, the lines of the first as a step.

        Args:
            recipe: that the suggestions are for.
            written: the recipe that has the first suggestion, if it was written."""
        rows = []
        for row in self.rows:
            error = f" ± {100.0 * row.std:.2g}" if row.std else ""
            left = Cell(f"{100.0 * row.misfit:.3g}{error} %", "number")
            freedom = Cell(str(row.freedom), "number")
            rows.append([left, freedom, "" if row.not_worse else "yes", row.words])
        best = self.rows[0]
        lines = "\n".join([*self.compared.lines, *best.recipe_lines, *best.rig_lines])
        steps = [message("steps.write_lines", lines=lines)] if lines else []
        if lines and written is None:
            steps.append(message("steps.write_suggested", recipe=recipe))
        untried = ", ".join(self.untried)
        key = "guidance.best" if best.changes else "guidance.nothing_better"
        if len(self.rows) == 1 and self.untried:
            key = "guidance.nothing_tried"
        return Answer(
            message(key, left=f"{100.0 * best.misfit:.3g}"),
            [Grid(["left out", "numbers", "worse", "what"], rows)],
            steps,
            [
                *self.compared.steps,
                *([message("guidance.untried", names=untried)] if untried else []),
            ],
            written,
            {"rows": [asdict(row) for row in self.rows], "untried": self.untried},
            rows=SHOWN,
        )


def suggest(
    prepared: PreparedFit,
    records: Sequence[tuple[str, Record]],
    progress: Progress | None = None,
    seconds: float = SECONDS,
    rounds: int = ROUNDS,
) -> Suggestions:
    """Try what is likely on a fit.

    Args:
        prepared: the fit.
        records: its logs.
        progress: called with what is tried, and the share done.
        seconds: of processor time, the recipe's own fit among them, after which nothing more is
            begun.
        rounds: how many changes are tried on top of one another, at most.

    Raises:
        InsufficientData: the logs tell nothing about any parameter of the fit itself.
        InputError: the fit compares frequency responses."""
    if prepared.options.response is not None:
        raise InputError(message("guidance.no_windows"))
    begun, compared = time.process_time(), comparison_of(prepared)
    if compared.steps:
        records = compared.records(records)
        options = replace(prepared.options, channels=compared.channels)
        given = prepared.rig, records, prepared.parameters, options, prepared.flow_maps
        prepared = prepare_fit(*given)
    report = progress or (lambda text, share: None)
    result = _Trials(prepared, records, report, begun + seconds).run(rounds)
    return replace(result, compared=compared)


@dataclass(frozen=True, eq=False)
class _Fold:
    """A fit without some windows: its numbers, and what it leaves there [SI²] by channel."""

    cost: float
    numbers: dict[str, float]
    left: dict[tuple[str, int], dict[str, float]]


class _Trials:
    head = 10.0  # [s] of a log at least that is looked at
    steps = 25  # of a descent
    fine = 0.005  # share of a channel's spread below which an error does not matter
    quiet = 1.5  # times the noise that fits may leave, beyond which nothing is sought
    # share of what is left out, by which a change must lessen it to be worth its numbers
    worth = 0.05
    # what a change promises to leave to first order, as a power of the minimum that another was
    # seen to leave, beyond which it is not tried
    hope = 0.1
    # logarithm of a channel's mean square by which one fold may gain less than the other
    unequal = 0.1
    unsure = 1.0  # standard errors within which a fit is not worse than the best

    def __init__(
        self,
        prepared: PreparedFit,
        records: Sequence[tuple[str, Record]],
        report: Progress,
        until: float,
    ) -> None:
        options = replace(prepared.options, method="output_error", max_iterations=self.steps)
        self.base = Setup(prepared.rig, prepared.parameters, options)
        self.records, self.maps, self.report = records, prepared.flow_maps, report
        self.begun, self.until = time.process_time(), until
        self.tried: list[Tried] = []
        self.spread: dict[str, float] = {}
        self.noise: dict[str, float] = {}
        self.rows: list[Hypothesis] = []
        self.prepared: dict[tuple[Hypothesis, ...], PreparedFit] = {}  # of a round, by its changes

    def run(self, rounds: int) -> Suggestions:
        """All rounds, and the table."""
        self.report("suggest: fitting the recipe as it is", 0.0)
        now, untried = self._first(), list[str]()
        for _ in range(rounds):
            self.prepared.clear()
            levels = self._levels(now).items()
            noise = {c: self.noise[c] + (self.fine * self.spread[c]) ** 2 for c, _ in levels}
            if all(size <= self.quiet * noise[c] for c, size in levels):
                break  # it leaves little more than white noise, or than what does not matter
            # what promises most is tried first; what costs much, and on the recipe itself what
            # promises nothing, only where that did not help: a promise is to first order
            left = self._changes(now)
            promised, untried = self._promised(now, [c for c in left if not c.row.costly])
            reached = self._tries(now, promised, untried, self.hope)
            if not self._any_better(reached, now):
                costly, late = self._promised(now, [c for c in left if c.row.costly])
                untried += late
                reached += self._tries(now, costly, untried)
            if now is self.tried[0] and not self._any_better(reached, now):
                rest = [item for item in promised if item[0] > (1.0 - self.worth) ** self.hope]
                reached += self._tries(now, rest, untried)
            self.tried += reached
            better = [item for item in reached if self._better(item, now)]
            if not better:
                break
            best = min(better, key=lambda entry: self._misfit(entry, now))
            parts = [self._try(now, item) for item in best.setup.changes[-1].parts(self.rows)]
            results = [part for part in parts if part is not None]
            self.tried += results
            retained = [item for item in results if self._not_worse(item, best)]
            now = min(retained, key=lambda entry: self._misfit(entry, best), default=best)
        self.report("suggest: done", 1.0)
        return self._table(tuple(untried))

    def _tries(
        self,
        now: Tried,
        promised: Sequence[tuple[float, Hypothesis]],
        untried: list[str],
        hope: float = 0.0,
    ) -> list[Tried]:
        """Changes on top of a fit, one by one, to the first that promises too little beside the
        best: more than its misfit to the power of ``hope``. Those that there is no time for are
        added to ``untried``."""
        reached: list[Tried] = []
        best = 1.0 - self.worth
        for promise, change in promised:
            if promise > best**hope:
                break
            if time.process_time() > self.until:
                untried.append(change.name)
                continue
            self.report(f"suggest: {change.name}", self._spent)
            tried = self._try(now, change)
            if tried is not None:
                reached.append(tried)
                best = min(best, self._misfit(tried, now))
        return reached

    def _any_better(self, reached: Sequence[Tried], now: Tried) -> bool:
        return any(self._better(item, now) for item in reached)

    def _promised(
        self, now: Tried, left: Sequence[Hypothesis]
    ) -> tuple[list[tuple[float, Hypothesis]], list[str]]:
        """(by how much changes on top of a fit should lessen what it leaves, were all linear: mean
        square with the change relative to that without, the least first; the names of those that
        there was no time to look at)."""
        results: list[tuple[float, Hypothesis]] = []
        untried: list[str] = []
        _, base = self._prepared(now.setup, 0)
        without, state = foreseen(base, now.numbers[0])
        for change in left:
            if time.process_time() > self.until:
                untried.append(change.name)
                continue
            self.report(f"suggest: what {change.name} promises", self._spent)
            try:
                _, problem = self._prepared(now.setup.with_change(change), 0)
                starts = [{**now.numbers[0], **start} for start in change.starts]
                cost = min(foreseen(problem, start, (base, state))[0] for start in starts)
            except IMPOSSIBLE:
                continue
            rise = (cost - min(without, now.costs[0])) / len(self.channels)
            results.append((math.exp(rise) if rise < 0.0 else 1.0, change))
        return sorted(results, key=lambda item: item[0]), untried

    @property
    def _spent(self) -> float:
        return (time.process_time() - self.begun) / max(self.until - self.begun, 1e-9)

    def _first(self) -> Tried:
        """The fit as the recipe has it, from a look over the whole range of its parameters."""
        logs, problem = self._prepared(self.base, None)
        start = problem.by_name(nearest_basin(problem, initial(problem)).theta)
        self.spread = dict(problem.spread)
        for log in logs:
            for channel, y in zip(log.channels, log.recorded.T, strict=True):
                noise = white_noise(y, log.seen.apart(channel)) ** 2
                self.noise[channel] = max(noise, self.noise.get(channel, 0.0))
        folds = [self._fold(self.base, which, start) for which in range(2)]
        self.live = tuple(dict.fromkeys(name for log in logs for name in log.commanded))
        self.channels = tuple(dict.fromkeys(name for log in logs for name in log.channels))
        first = _tried(self.base, folds)
        self.tried.append(first)
        return first

    def _changes(self, now: Tried) -> list[Hypothesis]:
        """What may be tried on top of a fit."""
        records, setup = [record for _, record in self.records], now.setup
        result = now.numbers[int(np.argmin(now.costs))]
        fitted = setup.rig.with_values({name: result[name] for name in setup.parameters})
        estimated = {
            (sensor.channel, w) for sensor in setup.options.sensors for w in WORDS if sensor[w]
        }
        used = {change.name for change in setup.changes}
        astray = any(size > self.spread[c] ** 2 for c, size in self._levels(now).items())
        rows = hypotheses(fitted, self.live, self.channels, records, self.maps)
        rest = [item.without(setup.parameters, setup.options.upper) for item in rows]
        self.rows = list({(c.kind, c.parameters, c.sensors): c for c in rest if c.freedom}.values())
        return [
            change
            for change in self.rows
            if not change.alike
            and change.name not in used
            and not estimated & {(s.channel, w) for s in change.sensors for w in WORDS if s[w]}
            and (not change.kind.endswith("sign") or astray)
        ]

    def _try(self, now: Tried, change: Hypothesis) -> Tried | None:
        """A change on top of a fit; None where there is no such rig, or no such fit.

        A fold that gains much less than the other is begun again where that ended: it may have come
        to another minimum."""
        try:
            setup = now.setup.with_change(change)
            folds = []
            starts = change.starts
            for which, result in enumerate(now.numbers):
                each = [self._fold(setup, which, {**result, **s}) for s in starts]
                best = min(range(len(each)), key=lambda k: each[k].cost)
                folds.append(each[best])
                starts = starts[best : best + 1]
                # whether the first fold fits its own windows so much better than the fit before
                # that it may do so with those left out
                worthy = -math.log(1.0 - self.worth) * self.hope * len(self.channels)
                if not which and change.row.costly and now.costs[0] - folds[0].cost <= worthy:
                    return None
            gains = [old - fold.cost for old, fold in zip(now.costs, folds, strict=True)]
            less = int(np.argmin(gains))
            if max(gains) - min(gains) > self.unequal * len(self.channels):
                other = self._fold(setup, less, folds[1 - less].numbers)
                folds[less] = min(folds[less], other, key=attrgetter("cost"))
            tried = _tried(setup, folds)
            pairs = ((item, tried.left.get(at, {})) for at, item in now.left.items())
            return tried if all(item.keys() == other.keys() for item, other in pairs) else None
        except IMPOSSIBLE:
            return None

    def _prepared(self, setup: Setup, which: int | None) -> tuple[list[Log], Problem]:
        """(the logs, a problem over them with the windows of a fold left out)."""
        if (fit := self.prepared.get(setup.changes)) is None:
            fit = prepare_fit(setup.rig, self.records, setup.parameters, setup.options, self.maps)
            self.prepared[setup.changes] = fit
        logs = [log.head(self.head) for log in fit.logs]
        retained = logs
        if which is not None:
            retained = [
                replace(log, counts=log.counts & ~_out(log, k, which)[:, None])
                for k, log in enumerate(logs)
            ]
        return logs, problem_over(fit, retained)

    def _fold(self, setup: Setup, which: int, begin: Mapping[str, float]) -> _Fold:
        """A fit from some numbers on, with the windows of a fold left out."""
        logs, problem = self._prepared(setup, which)
        left: dict[tuple[str, int], dict[str, float]] = {}
        state, cost = descend(problem, begin)
        values = problem.values(state.theta)
        whole = problem.simulator.over(logs).simulate([values], None, state.shifts)[0]
        residuals = [problem.residual(*pair) for pair in zip(logs, whole, strict=True)]
        for k, (log, rest) in enumerate(zip(logs, residuals, strict=True)):
            windows = _windows(log)
            for w in range(int(windows[-1]) + 1):
                inside = (windows == w) & _out(log, k, which)
                if inside.any():
                    left[log.name, w] = {
                        channel: float(np.mean(rest[inside & log.counts[:, i], i] ** 2))
                        for i, channel in enumerate(log.channels)
                        if (inside & log.counts[:, i]).any()
                    }
        return _Fold(cost, problem.by_name(state.theta), left)

    def _levels(self, item: Tried) -> dict[str, float]:
        """Mean squares of what is left of each channel [SI²]."""
        results: dict[str, list[float]] = {}
        for entry in item.left.values():
            for channel, size in entry.items():
                results.setdefault(channel, []).append(size)
        return {
            c: max(float(np.mean(y)), (self.fine * self.spread[c]) ** 2) for c, y in results.items()
        }

    def _misfit(self, item: Tried, other: Tried) -> float:
        """Mean square of what is left, relative to another fit; geometric mean of the channels."""
        mine, theirs = self._levels(item), self._levels(other)
        return float(np.exp(np.mean([np.log(mine[c] / theirs[c]) for c in theirs])))

    def _difference(self, item: Tried, other: Tried) -> tuple[float, float]:
        """(by how much a fit leaves more than another, its standard error), as shares of what the
        other leaves: of each window, channels added up, each in units of what the other leaves of
        it in the mean."""
        level = self._levels(other)
        ours, theirs = (
            np.array([sum(y / level[c] for c, y in row.items()) for row in fit.left.values()])
            for fit in (item, other)
        )
        whole = float(np.mean(theirs)) or 1.0
        off = (ours - theirs) / whole
        return float(np.mean(off)), float(np.std(off, ddof=1)) / len(off) ** 0.5

    def _better(self, item: Tried, other: Tried) -> bool:
        """Whether it is worth while to go on from a fit: what is surely better, the table says."""
        return self._difference(item, other)[0] < -self.worth

    def _not_worse(self, item: Tried, best: Tried) -> bool:
        more, std = self._difference(item, best)
        return more <= max(self.unsure * std, self.worth)

    def _table(self, untried: tuple[str, ...]) -> Suggestions:
        first = self.tried[0]
        misfits = [self._misfit(item, first) for item in self.tried]
        best = self.tried[int(np.argmin(misfits))]
        fine = [self._not_worse(item, best) for item in self.tried]
        order = sorted(
            range(len(self.tried)),
            key=lambda i: (not fine[i], self.tried[i].setup.freedom if fine[i] else 0, misfits[i]),
        )
        rows = []
        for i in order:
            setup = self.tried[i].setup
            rows.append(
                Suggestion(
                    tuple(change.name for change in setup.changes),
                    setup.freedom,
                    misfits[i],
                    self._difference(self.tried[i], best)[1] * min(misfits),
                    fine[i],
                    tuple(line for c in setup.changes for line in c.recipe_lines(setup.rig)),
                    tuple(line for c in setup.changes for line in c.rig_lines(setup.rig)),
                )
            )
        best, *others = (self.tried[i] for i in order)
        setups = self._begun(best), *(item.setup for item in others)
        return Suggestions(tuple(rows), setups, untried)

    def _begun(self, item: Tried) -> Setup:
        """A fit that begins where it was tried; what logs do not excite stays as in the rig."""
        setup, result = item.setup, item.numbers[int(np.argmin(item.costs))]
        logs, problem = self._prepared(setup, None)
        state = evaluate(problem, at_values(problem, result))
        sizes = effects(problem, state, jacobian(problem, state, state.free))
        pairs = zip(state.free, sizes, strict=True)
        excited = {problem.search[i].name for i, size in pairs if size >= PROBLEM.faint}
        start = {name: result[name] for name in setup.parameters if name in excited}
        known = {}
        for term in logs[0].start.terms:
            value = term.value(result[term.name]) if term.name in result else 0.0
            if term.std > 0.0 and value != 0.0:
                row = reading_row(term.channel, term.word)
                value = value if term.word == "offset" else max(value, row.lower)
                known[term.channel, term.word] = Value(value, std=abs(term.per) * term.std)
        sensors = []
        for sensor in setup.options.sensors:
            words = (w for w in WORDS if sensor[w] == ESTIMATE and (sensor.channel, w) in known)
            given = {w: known[sensor.channel, w] for w in words}
            sensors.append(sensor.model_copy(update=given))
        return replace(setup, options=replace(setup.options, start=start, sensors=tuple(sensors)))


def _tried(setup: Setup, folds: Sequence[_Fold]) -> Tried:
    """A fit by its folds, what is left out by window in one order."""
    left = {key: item for fold in folds for key, item in fold.left.items()}
    result, costs = tuple(fold.numbers for fold in folds), tuple(fold.cost for fold in folds)
    return Tried(setup, dict(sorted(left.items())), result, costs)


def _windows(log: Log, long: float = 0.5, short: float = 0.02) -> np.ndarray:
    """The window of each sample: 4 to 16 of a log, ``long`` [s] if possible, at least ``short``."""
    size, tick = len(log.recorded), log.sample_time
    count = min(max(round(size * tick / long), 4), 16)
    count = max(1, min(count, int(size * tick / short)))
    return np.arange(size) * count // size


def _out(log: Log, index: int, which: int) -> np.ndarray:
    """Which samples of a log, by its index, a fold leaves out."""
    return (_windows(log) + index + which) % 2 == 0
