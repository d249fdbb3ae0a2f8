"""The thesis's matching: bulk modulus from the frequency of ringing, dampings from its decay
(thesis 2.3)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from ehbench.identification.results import Estimate, HydraulicsFit, Match, finish, not_excited
from ehbench.identification.search import LEVEL, VAGUE, Coordinate
from ehbench.identification.simulator import Log, Simulator
from ehbench.preprocessing.observations import SETTINGS as OBSERVATION
from ehbench.preprocessing.observations import least_change, rings_clearly
from ehbench.signals.series import Ringing, ringing, ringing_like, rms, transients
from ehbench.vocabulary import Z95, InputError, InsufficientData, Progress, message, setting


@dataclass(frozen=True)
class MatchingSettings:
    """Numbers of the matching of ringing."""

    rounds: int = setting(12, "", "rounds before asking what a parameter is known to", "few needed")
    taming: int = setting(4, "", "of these rounds, those that may damp a silent simulation", "few")
    fresh_slopes: int = setting(8, "", "rounds after which slopes are retained", "it must rest")
    nudge: float = setting(
        0.03, "", "step of finite differences, in units of a parameter", "ringing is estimated"
    )
    longest: float = setting(0.7, "", "longest step of a round, in units of a parameter", "half")
    stand: float = setting(1.0e-3, "", "largest step that is none, in such units", "chosen")
    little: float = setting(0.02, "", "the same in standard errors", "does not show")


SETTINGS = MatchingSettings()


@dataclass(frozen=True)
class _Window:
    """A recorded transient: its log, samples, cylinder, joint, the columns of the log's channels,
    and how it rings."""

    log: int
    span: slice
    cylinder: str
    joint: str
    columns: tuple[int, ...]
    recorded: Ringing


def refuse_unmatched(search: Sequence[Coordinate]) -> None:
    """Refuse parameters that ringing does not tell.

    Raises:
        InputError: names the first."""
    for c in search:
        of_the_oil = c.row.mode_role == "frequency" and not c.owner
        if not of_the_oil and c.row.mode_role != "decay":
            raise InputError(message("identification.thesis_parameter", name=c.name))


def find_windows(simulator: Simulator, progress: Progress) -> list[_Window]:
    """Every transient of a cylinder after a change of its own commands that rings.

    Raises:
        InsufficientData: none does; says why the first do not."""
    results, reasons, rig = [], [], simulator.rig
    for k, log in enumerate(simulator.logs):
        valves = [(c, f"{c.name}.{v.name}.command", least_change(v)) for c, v in rig.valves()]
        cylinders, names, minimum = zip(*(v for v in valves if v[1] in log.record), strict=True)
        commands = np.column_stack([log.record[name] for name in names])
        progress("thesis: looking for ringing", 0.2 * k / len(simulator.logs))
        for span in transients(log.record.t, commands, minimum=np.array(minimum)):
            before = max(0, span.start - 1 - round(OBSERVATION.together / log.record.sample_time))
            changed = np.abs(commands[before] - np.median(commands[span], axis=0)) > minimum
            moved = {c.name: c for c, moved in zip(cylinders, changed, strict=True) if moved}
            for name, cylinder in moved.items():
                part, columns, ring = _ringing_of(log, span, name)
                reason: str = ring.reason
                if ring.ok and not rings_clearly(ring.cycles, ring.damping_ratio):
                    fields = {"cycles": ring.cycles, "damping": ring.damping_ratio}
                    reason = message("identification.little_ringing", **fields)
                if reason:
                    reasons.append(f"{log.name} at {log.record.t[span.start]:.6g} s: {reason}")
                else:
                    results.append(_Window(k, part, name, cylinder.joint, columns, ring))
    if not results:
        hint = "; ".join(reasons[:3]) or None
        raise InsufficientData(message("identification.no_ringing"), hint=hint)
    return results


def _ringing_of(log: Log, span: slice, cylinder: str) -> tuple[slice, tuple[int, ...], Ringing]:
    """(the first run of samples of a window that count, columns of the cylinder's channels, how
    they ring)."""
    columns = tuple(i for i, name in enumerate(log.channels) if name.startswith(cylinder + "."))
    counts = np.all(log.counts[span][:, columns], axis=1)
    first = int(np.argmax(counts))
    length = int(np.argmin(counts[first:])) if not counts[first:].all() else counts.size - first
    part = slice(span.start + first, span.start + first + length)
    if not columns:
        return part, columns, Ringing(reason="nothing recorded")
    return part, columns, ringing(log.record.t[part], log.recorded[part][:, columns])


@dataclass(frozen=True, eq=False)
class _Stand:
    """Where some rounds of the matching ended: whether it stands still, the slopes (rows: what is
    matched, columns: parameters alive), what is missed by window and which parameters are at a
    bound, by index, and how the simulation rings."""

    converged: bool
    slope: np.ndarray
    error: dict[int, np.ndarray]
    at_bound: list[int]
    rings: list[Ringing]


class Matching:
    """The thesis's way (2.3): bulk modulus from the frequency of the ringing, then damping from its
    decay, and again; with other values of some ``fixed`` numbers, which are no parameters."""

    fixed: Mapping[str, float] = MappingProxyType({})

    def __init__(
        self, simulator: Simulator, search: list[Coordinate], progress: Progress, maximum: int
    ) -> None:
        self.simulator, self.search = simulator, search
        self.progress, self.maximum = progress, maximum
        refuse_unmatched(search)
        self.windows = find_windows(simulator, progress)
        recorded = [window.recorded for window in self.windows]
        self.aim = [self._measure(i, recorded) for i in range(len(search))]
        self.theta = np.array([c.begin for c in search])
        self.live = [i for i in range(len(search)) if np.isfinite(self.aim[i]).any()]
        self.rounds = 0

    def _rings(self, theta: np.ndarray, before: Sequence[Ringing] | None) -> list[Ringing]:
        """How the simulation rings in each window, seen as the recording was; the search starts
        where it rang before."""
        values = [c.at(x) for c, x in zip(self.search, theta, strict=True)]
        given = [*values, *self.fixed.values()]
        (row,) = self.simulator.beside(self.fixed).simulate([given])
        result = []
        for k, window in enumerate(self.windows):
            simulated = row[window.log]
            if simulated is None:
                result.append(Ringing(reason="the simulation failed"))
                continue
            t = self.simulator.logs[window.log].record.t[window.span]
            last = before[k] if before is not None else Ringing()
            guess = (last.natural_frequency, last.damping_ratio) if last.ok else None
            y = simulated[window.span][:, window.columns]
            result.append(ringing_like(t, y, window.recorded, guess))
        return result

    def _measure(self, i: int, rings: Sequence[Ringing]) -> np.ndarray:
        """What parameter i is matched on, by window: ln ω_n for the bulk modulus, ζ for a damping;
        nan where there is none."""
        c = self.search[i]
        if c.row.mode_role == "frequency":
            return np.array([math.log(r.natural_frequency) if r.ok else math.nan for r in rings])
        pairs = zip(rings, self.windows, strict=True)
        damping = [r.damping_ratio if r.ok and w.joint == c.owner else math.nan for r, w in pairs]
        return np.array(damping)

    def fit(self) -> HydraulicsFit:
        """The fit.

        Raises:
            InsufficientData: no transient that rings tells anything about any parameter."""
        stand, results, converged = None, {}, False
        while self.live and self.rounds < self.maximum:
            stand = self._stand(stand.rings if stand else None)
            converged = stand.converged
            pairs = [(i, stand.error[i], stand.slope[b, b]) for b, i in enumerate(self.live)]
            results = {i: self._scatter(i, error, slope) for i, error, slope in pairs}
            vague = [i for i in self.live if not results[i][0] < VAGUE[self.search[i].log]]
            self._drop(vague)
            if converged and not vague:
                break
        self.progress("thesis: done", 1.0)
        return self._result(stand, results, converged)

    def _drop(self, which: Sequence[int]) -> None:
        """Put parameters back to their start and leave them out."""
        for i in which:
            self.theta[i] = self.search[i].of(self.search[i].start)
        self.live = [i for i in self.live if i not in which]

    def _stand(self, rings: list[Ringing] | None) -> _Stand:
        """Some rounds of Newton's method on the medians of the windows, until no parameter moves
        any more.

        A simulation that does not ring at all is damped less first."""
        low, high = np.array([c.bounds for c in self.search]).T
        result = _Stand(False, np.zeros((0, 0)), {}, [], [])
        slope = result.slope
        for fresh in range(1, SETTINGS.rounds + 1):
            self.rounds += 1
            left = self.rounds + 4.0
            self.progress("thesis: matching frequency and decay", 1.0 - 3.2 / left)
            rings = self._rings(self.theta, rings)
            error = {i: self.aim[i] - self._measure(i, rings) for i in self.live}
            silent = [i for i in self.live if not np.isfinite(error[i]).any()]
            decays = [i for i in self.live if self.search[i].row.mode_role == "decay"]
            tame = [i for i in decays if self.theta[i] > low[i]]
            if silent and fresh <= SETTINGS.taming and tame:
                less = SETTINGS.longest if self.search[tame[0]].log else 0.1
                self.theta[tame] = np.maximum(self.theta[tame] - less, low[tame])
                result = replace(result, error=error, rings=rings)
                continue
            self._drop(silent)
            live = self.live
            if not live:
                return replace(result, error=error, rings=rings)
            miss = np.array([np.nanmedian(error[i]) for i in live])
            if silent or fresh <= SETTINGS.fresh_slopes:
                slope = self._slopes(self.theta, live, rings)
            pull, theta = np.sign(np.diag(slope)) * miss, self.theta[live]
            fixed = (theta <= low[live]) & (pull < 0) | (theta >= high[live]) & (pull > 0)
            inside, moves = np.flatnonzero(~fixed), np.zeros(len(live))
            square = slope[np.ix_(inside, inside)]
            moves[inside] = np.linalg.lstsq(square, miss[inside], rcond=1e-3)[0]
            stds = [self._scatter(i, error[i], slope[b, b])[0] for b, i in enumerate(live)]
            pairs = zip(moves, stds, strict=True)
            stands = all(abs(m) < max(SETTINGS.stand, SETTINGS.little * s) for m, s in pairs)
            at_bound = [i for i, is_fixed in zip(live, fixed, strict=True) if is_fixed]
            result = _Stand(stands, slope, error, at_bound, rings)
            if stands:
                break
            moves = np.clip(moves, -SETTINGS.longest, SETTINGS.longest)
            self.theta[live] = np.clip(theta + moves, low[live], high[live])
        return result

    def _slopes(
        self, theta: np.ndarray, live: Sequence[int], rings: Sequence[Ringing]
    ) -> np.ndarray:
        """Median change over the windows of what each parameter is matched on (rows), per unit of
        each parameter (columns)."""
        slope = np.zeros((len(live), len(live)))
        for b, k in enumerate(live):
            inside = theta[k] + SETTINGS.nudge <= self.search[k].bounds[1]
            h = SETTINGS.nudge if inside else -SETTINGS.nudge
            moved = self._rings(theta + h * np.eye(len(theta))[k], rings)
            for a, i in enumerate(live):
                change = (self._measure(i, moved) - self._measure(i, rings)) / h
                slope[a, b] = np.nanmedian(change) if np.isfinite(change).any() else 0.0
        return slope

    def _fixed(self, stand: _Stand) -> np.ndarray:
        """The standard error of each theta that those of fixed numbers and maps cause: half of what
        the matching moves from one end of each to the other."""
        theta, live, rounds, moves = self.theta.copy(), self.live, self.rounds, []
        for name, (value, std) in self.simulator.fixed_errors().items():
            ends = []
            for self.fixed in ({name: value + std}, {name: value - std}):
                self._stand(stand.rings)
                ends.append(self.theta)
                self.theta, self.live, self.rounds = theta.copy(), live, rounds
            moves.append(0.5 * (ends[0] - ends[1]))
        self.fixed = {}
        return np.linalg.norm([np.zeros(theta.size), *moves], axis=0)

    def _result(
        self, stand: _Stand | None, result: dict[int, tuple[float, float, int]], converged: bool
    ) -> HydraulicsFit:
        warnings, fitted, matches = [], [], []
        off = self._fixed(stand) if stand is not None else self.theta
        if not converged:
            warnings.append(message("identification.still_moving", rounds=self.rounds))
        for i, c in enumerate(self.search):
            entry = not_excited(c, 0)
            if stand is not None and i in self.live:
                scatter, quantile, count = result[i]
                std = math.hypot(scatter, off[i])
                # few windows say little of their scatter, and nothing of the other error
                wide = math.hypot(quantile * scatter, Z95 * off[i]) / std if std > 0.0 else quantile
                real, ends = c.spread(self.theta[i], std, wide)
                status = "at_bound" if i in stand.at_bound else "estimated"
                entry = replace(entry, value=c.at(self.theta[i]), std=real, interval=ends)
                entry = replace(entry, status=status, samples=count, error_from="windows")
                entry = replace(entry, from_fixed=(off[i] / std) ** 2 if std > 0.0 else 0.0)
            fitted.append(entry)
        if stand is None or all(item.status == "not_excited" for item in fitted):
            names = ", ".join(c.name for c in self.search)
            raise InsufficientData(message("identification.no_ringing_tells", names=names))
        for w, ring in zip(self.windows, stand.rings, strict=True):
            log, stop = self.simulator.logs[w.log], w.recorded.stop
            channels = tuple(log.channels[i] for i in w.columns)
            start = float(log.record.t[w.span.start])
            match = Match(log.name, w.cylinder, channels, start, stop, w.recorded, ring)
            matches.append(match)
        lost = sum(not match.simulated.ok for match in matches)
        if lost:
            fields = {"count": lost, "all": len(matches)}
            warnings.append(message("identification.model_is_silent", **fields))
        built = Estimate("thesis", fitted, warnings, self.rounds, matches=matches)
        return finish(self.simulator, built)

    def _scatter(self, i: int, error: np.ndarray, slope: float) -> tuple[float, float, int]:
        """(standard error of theta, quantile of the 95 % interval, windows): the scatter of the
        windows about their median, or what the recorded rings' own errors make of it if that is
        more."""
        from scipy.special import stdtrit

        use = np.isfinite(error)
        count, frequency = int(use.sum()), self.search[i].row.mode_role == "frequency"
        rings = [w.recorded for w, used in zip(self.windows, use, strict=True) if used]
        relative = [r.natural_frequency_std / r.natural_frequency for r in rings]
        errors = relative if frequency else [r.damping_ratio_std for r in rings]
        scatter = float(np.std(error[use], ddof=1)) if count > 1 else 0.0
        # a median's standard error over a mean's
        median = math.sqrt(math.pi / 2.0) if count > 2 else 1.0
        std = median * max(scatter, rms(np.array(errors))) / math.sqrt(count)
        # a single window's error is that of its recording
        quantile = float(stdtrit(count - 1 or math.inf, 0.5 + 0.5 * LEVEL))
        return std / max(abs(slope), 1e-12), quantile, count
