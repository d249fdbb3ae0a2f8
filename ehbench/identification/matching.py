"""The thesis's matching: bulk modulus from the frequency of ringing, dampings from its decay
(thesis 2.3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.identification.results import Estimate, HydraulicsFit, Match, finish, not_excited
from ehbench.identification.search import LEVEL, VAGUE, Coordinate
from ehbench.identification.simulator import Log, Simulator
from ehbench.preprocessing.observations import SETTINGS as OBSERVATION
from ehbench.preprocessing.observations import least_change, rings_clearly
from ehbench.signals.series import Ringing, ringing, ringing_like, rms, transients
from ehbench.vocabulary.errors import InputError, InsufficientData
from ehbench.vocabulary.progress import Progress

# rounds before the matching asks whether a parameter is told at all; of these so many may damp a
# silent simulation less, and after so many the slopes are kept, so that it can come to rest
ROUNDS, TAMING, FRESH_SLOPES = 12, 4, 8
# step of finite differences, in units of a parameter: frequency and decay are estimates themselves
NUDGE = 0.03
# the matching stands when no parameter moves by more, in its unit or in standard errors
STAND, LITTLE = 1.0e-3, 0.02


@dataclass(frozen=True)
class _Window:
    """A recorded transient: its log, samples, cylinder, joint, the columns of the log's channels,
    and how it rings.
    """

    log: int
    span: slice
    cylinder: str
    joint: str
    columns: tuple[int, ...]
    recorded: Ringing


def _counting(span: slice, counts: np.ndarray) -> slice:
    """The first run of samples of a window that count; empty if none does."""
    inside = np.flatnonzero(counts[span])
    if not inside.size:
        return slice(span.start, span.start)
    first = span.start + int(inside[0])
    void = np.flatnonzero(~counts[first : span.stop])
    return slice(first, first + int(void[0]) if void.size else span.stop)


def refuse_unmatched(search: Sequence[Coordinate]) -> None:
    """Refuse parameters that ringing does not tell.

    Raises:
        InputError: names the first.
    """
    for c in search:
        of_the_oil = c.row.mode_role == "frequency" and not c.owner
        if not of_the_oil and c.row.mode_role != "decay":
            raise InputError(
                f"method 'thesis' cannot fit {c.name}",
                hint="it takes bulk_modulus and joint dampings; use method 'output_error'",
            )


def find_windows(simulator: Simulator, tell: Progress) -> list[_Window]:
    """Every transient of a cylinder after a change of its own commands that rings.

    Raises:
        InsufficientData: none does; says why the first do not.
    """
    results: list[_Window] = []
    reasons: list[str] = []
    for k, log in enumerate(simulator.logs):
        valves = [
            (c.name, f"{c.name}.{v.name}.command", least_change(v))
            for c, v in simulator.rig.valves()
        ]
        cylinders, names, minimum = zip(
            *(valve for valve in valves if valve[1] in log.record), strict=True
        )
        commands = np.column_stack([log.record[name] for name in names])
        tell("thesis: looking for ringing", 0.2 * k / len(simulator.logs))
        for span in transients(log.record.t, commands, least=np.array(minimum)):
            before = max(0, span.start - 1 - round(OBSERVATION.together / log.record.sample_time))
            changed = np.abs(commands[before] - np.median(commands[span], axis=0)) > minimum
            moved = (c for c, moved in zip(cylinders, changed, strict=True) if moved)
            for cylinder in dict.fromkeys(moved):
                part, columns, ring = _ringing_of(log, span, cylinder)
                reason = ring.reason
                if ring.ok and not rings_clearly(ring.cycles, ring.damping_ratio):
                    reason = (
                        f"{ring.cycles:.1f} cycles at a damping ratio of {ring.damping_ratio:.2f} "
                        "are too little to match"
                    )
                if reason:
                    reasons.append(f"{log.name} at {log.record.t[span.start]:.6g} s: {reason}")
                else:
                    joint = simulator.rig.cylinder_named(cylinder).joint
                    results.append(_Window(k, part, cylinder, joint, columns, ring))
    if not results:
        raise InsufficientData(
            "no transient of these logs rings clearly, so there is no frequency to match",
            hint="; ".join(reasons[:3]) or None,
        )
    return results


def _ringing_of(log: Log, span: slice, cylinder: str) -> tuple[slice, tuple[int, ...], Ringing]:
    """(samples that count, columns of the cylinder's channels, how they ring)."""
    columns = tuple(
        i for i, channel in enumerate(log.channels) if channel.startswith(cylinder + ".")
    )
    part = _counting(span, np.all(log.counts[:, columns], axis=1))
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
    decay, and again.
    """

    def __init__(
        self, simulator: Simulator, search: list[Coordinate], tell: Progress, maximum: int
    ) -> None:
        self.simulator, self.search, self.tell, self.most = simulator, search, tell, maximum
        refuse_unmatched(search)
        self.windows = find_windows(simulator, tell)
        recorded = [window.recorded for window in self.windows]
        self.aim = [self._measure(i, recorded) for i in range(len(search))]
        self.theta = np.array([c.begin for c in search])
        self.live = [i for i in range(len(search)) if np.isfinite(self.aim[i]).any()]
        self.rounds = 0

    def _rings(self, theta: np.ndarray, before: Sequence[Ringing] | None) -> list[Ringing]:
        """How the simulation rings in each window, seen as the recording was; the search starts
        where it rang before.
        """
        values = [c.at(x) for c, x in zip(self.search, theta, strict=True)]
        row = self.simulator.simulate([values])[0]
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
        nan where there is none.
        """
        if self.search[i].row.mode_role == "frequency":
            return np.array(
                [math.log(ring.natural_frequency) if ring.ok else math.nan for ring in rings]
            )
        own = [window.joint == self.search[i].owner for window in self.windows]
        return np.array(
            [
                ring.damping_ratio if ring.ok and mine else math.nan
                for ring, mine in zip(rings, own, strict=True)
            ]
        )

    def fit(self) -> HydraulicsFit:
        stand, results, converged = None, {}, False
        while self.live and self.rounds < self.most:
            stand = self._stand(stand.rings if stand else None)
            converged = stand.converged
            results = {
                i: self._scatter(i, stand.error[i], stand.slope[b, b])
                for b, i in enumerate(self.live)
            }
            vague = [i for i in self.live if not results[i][0] < VAGUE[self.search[i].log]]
            self._drop(vague)
            if converged and not vague:
                break
        self.tell("thesis: done", 1.0)
        return self._result(stand, results, converged)

    def _drop(self, which: Sequence[int]) -> None:
        """Put parameters back to their start and leave them out."""
        for i in which:
            self.theta[i] = self.search[i].of(self.search[i].start)
        self.live = [i for i in self.live if i not in which]

    def _stand(self, rings: list[Ringing] | None) -> _Stand:
        """Some rounds of Newton's method on the medians of the windows, until no parameter moves
        any more.

        A simulation that does not ring at all is damped less first.
        """
        low, high = np.array([c.bounds for c in self.search]).T
        result = _Stand(False, np.zeros((0, 0)), {}, [], [])
        slope = result.slope
        for fresh in range(1, ROUNDS + 1):
            self.rounds += 1
            share = 0.2 + 0.8 * self.rounds / (self.rounds + 4.0)
            self.tell("thesis: matching frequency and decay", share)
            rings = self._rings(self.theta, rings)
            error = {i: self.aim[i] - self._measure(i, rings) for i in self.live}
            silent = [i for i in self.live if not np.isfinite(error[i]).any()]
            if silent and fresh <= TAMING and self._tame(low):
                result = replace(result, error=error, rings=rings)
                continue
            self._drop(silent)
            live = self.live
            if not live:
                return replace(result, error=error, rings=rings)
            miss = np.array([np.nanmedian(error[i]) for i in live])
            if silent or fresh <= FRESH_SLOPES:
                slope = self._slopes(self.theta, live, rings)
            pull = np.sign(np.diag(slope)) * miss
            at_bound = [
                i
                for b, i in enumerate(live)
                if (self.theta[i] <= low[i] and pull[b] < 0)
                or (self.theta[i] >= high[i] and pull[b] > 0)
            ]
            moves = self._moves(slope, miss, at_bound)
            stands = all(
                abs(moves[b]) < max(STAND, LITTLE * self._scatter(i, error[i], slope[b, b])[0])
                for b, i in enumerate(live)
            )
            result = _Stand(stands, slope, error, at_bound, rings)
            if stands:
                break
            self.theta[live] = np.clip(
                self.theta[live] + np.clip(moves, -0.7, 0.7), low[live], high[live]
            )
        return result

    def _tame(self, low: np.ndarray) -> bool:
        """Damp the simulation less; whether it can be."""
        tame = [
            i
            for i in self.live
            if self.search[i].row.mode_role == "decay" and self.theta[i] > low[i]
        ]
        if tame:
            less = 0.7 if self.search[tame[0]].log else 0.1
            self.theta[tame] = np.maximum(self.theta[tame] - less, low[tame])
        return bool(tame)

    def _moves(self, slope: np.ndarray, miss: np.ndarray, at_bound: Sequence[int]) -> np.ndarray:
        """Newton's step of the parameters alive that are not at a bound; zero for the others."""
        inside = [b for b, i in enumerate(self.live) if i not in at_bound]
        moves = np.zeros(len(self.live))
        moves[inside] = np.linalg.lstsq(slope[np.ix_(inside, inside)], miss[inside], rcond=1e-3)[0]
        return moves

    def _slopes(
        self, theta: np.ndarray, live: Sequence[int], rings: Sequence[Ringing]
    ) -> np.ndarray:
        """Median change over the windows of what each parameter is matched on (rows), per unit of
        each parameter (columns).
        """
        slope = np.zeros((len(live), len(live)))
        for b, k in enumerate(live):
            h = NUDGE if theta[k] + NUDGE <= self.search[k].bounds[1] else -NUDGE
            moved = self._rings(theta + h * np.eye(len(theta))[k], rings)
            for a, i in enumerate(live):
                change = (self._measure(i, moved) - self._measure(i, rings)) / h
                slope[a, b] = np.nanmedian(change) if np.isfinite(change).any() else 0.0
        return slope

    def _result(
        self, stand: _Stand | None, result: dict[int, tuple[float, float, int]], converged: bool
    ) -> HydraulicsFit:
        warnings = []
        if not converged:
            warnings.append(
                f"the matching stopped after {self.rounds} rounds without standing still; its "
                "numbers are not final"
            )
        fitted = []
        for i, c in enumerate(self.search):
            entry = not_excited(c, 0)
            if stand is not None and i in self.live:
                std, quantile, count = result[i]
                real, ends = c.spread(self.theta[i], std, quantile)
                entry = replace(
                    entry,
                    value=c.at(self.theta[i]),
                    std=real,
                    interval=ends,
                    status="at_bound" if i in stand.at_bound else "estimated",
                    samples=count,
                    error_from="windows",
                )
            fitted.append(entry)
        if stand is None or all(item.status == "not_excited" for item in fitted):
            names = ", ".join(c.name for c in self.search)
            raise InsufficientData(
                f"no transient that rings tells anything about {names}",
                hint="use steps of these joints' cylinders",
            )
        matches = []
        for w, ring in zip(self.windows, stand.rings, strict=True):
            log = self.simulator.logs[w.log]
            matches.append(
                Match(
                    log=log.name,
                    cylinder=w.cylinder,
                    channels=tuple(log.channels[i] for i in w.columns),
                    start=float(log.record.t[w.span.start]),
                    stop=w.recorded.stop,
                    recorded=w.recorded,
                    simulated=ring,
                )
            )
        lost = sum(not match.simulated.ok for match in matches)
        if lost:
            warnings.append(
                f"in {lost} of {len(matches)} transients the recording rings and the model does not"
            )
        built = Estimate("thesis", fitted, warnings, self.rounds, matches=matches)
        return finish(self.simulator, built)

    def _scatter(self, i: int, error: np.ndarray, slope: float) -> tuple[float, float, int]:
        """(standard error of theta, quantile of the 95 % interval, windows): the scatter of the
        windows about their median, or what the recorded rings' own errors make of it if that is
        more."""
        from scipy.special import stdtrit

        use = np.isfinite(error)
        count = int(use.sum())
        recorded = [w.recorded for w, used in zip(self.windows, use, strict=True) if used]
        own = [
            ring.natural_frequency_std / ring.natural_frequency
            if self.search[i].row.mode_role == "frequency"
            else ring.damping_ratio_std
            for ring in recorded
        ]
        scatter = float(np.std(error[use], ddof=1)) if count > 1 else 0.0
        # a median's standard error over a mean's
        median = math.sqrt(math.pi / 2.0) if count > 2 else 1.0
        std = median * max(scatter, rms(np.array(own))) / math.sqrt(count) / max(abs(slope), 1e-12)
        quantile = float(stdtrit(max(1, count - 1), 0.5 + 0.5 * LEVEL)) if count > 1 else 1.96
        return std, quantile, count
