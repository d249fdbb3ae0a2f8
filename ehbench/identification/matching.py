"""The thesis's way (2.3): turn the bulk modulus until the simulation rings at the recorded
frequency, then the damping until it decays alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.errors import InputError, InsufficientData
from ehbench.identification.steps import (
    LEVEL,
    VAGUE,
    Bench,
    Coordinate,
    FittedParameter,
    HydraulicsFit,
    Match,
    Progress,
    finish,
    least_change,
)
from ehbench.rig import parameter_row
from ehbench.signals import Ringing, ringing, ringing_like, rms, transients

# rounds before the matching asks whether a parameter is told at all; of these so many may damp a
# silent simulation less,
# and after so many the slopes are kept, so that it can come to rest
ROUNDS, TAMING, FRESH_SLOPES = 12, 4, 8
NUDGE = 0.03  # step of finite differences, in units of a parameter: frequency and decay are estimates themselves
STAND, LITTLE = (
    1.0e-3,
    0.02,
)  # the matching stands when no parameter moves by more, in its unit or in standard errors
TOGETHER = 0.02  # [s]: commands that change within this before a transient have begun it with it
# a transient is matched if it shows so many cycles and is not damped more: the rest is told by
# drift as well as by ringing
MATCH_CYCLES, MATCH_DAMPING = 1.5, 0.35


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
        if c.name != "bulk_modulus" and c.name.rsplit(".", 1)[-1] not in (
            "joint_damping",
            "damping",
        ):
            raise InputError(
                f"method 'thesis' cannot fit {c.name}",
                hint="it takes bulk_modulus and joint dampings; use method 'output_error'",
            )


class Matching:
    """The thesis's way (2.3): bulk modulus from the frequency of the ringing, then damping from its
    decay, and again.
    """

    def __init__(self, bench: Bench, search: list[Coordinate], tell: Progress, most: int) -> None:
        self.bench, self.search, self.tell, self.most = bench, search, tell, most
        refuse_unmatched(search)
        self.windows = self._windows()

    def _windows(self) -> list[_Window]:
        """Every transient of a cylinder after a change of its own commands that rings.

        Raises:
            InsufficientData: none does; says why the first do not.
        """
        found, reasons = [], []
        for k, log in enumerate(self.bench.logs):
            valves = [
                (c.name, f"{c.name}.{v.name}.command", least_change(v))
                for c, v in self.bench.rig.valves()
            ]
            cylinders, names, least = zip(
                *(valve for valve in valves if valve[1] in log.record), strict=True
            )
            commands = np.column_stack([log.record[name] for name in names])
            self.tell("thesis: looking for ringing", 0.2 * k / len(self.bench.logs))
            for span in transients(log.record.t, commands, least=np.array(least)):
                before = max(0, span.start - 1 - round(TOGETHER / log.record.sample_time))
                changed = np.abs(commands[before] - np.median(commands[span], axis=0)) > least
                for cylinder in dict.fromkeys(
                    c for c, moved in zip(cylinders, changed, strict=True) if moved
                ):
                    columns = tuple(
                        i
                        for i, channel in enumerate(log.channels)
                        if channel.startswith(cylinder + ".")
                    )
                    part = _counting(span, log.counts[:, columns].all(axis=1))
                    ring = (
                        ringing(log.record.t[part], log.recorded[part][:, columns])
                        if columns
                        else Ringing(reason="nothing recorded")
                    )
                    reason = ring.reason
                    if ring.ok and (
                        ring.damping_ratio > MATCH_DAMPING or ring.cycles < MATCH_CYCLES
                    ):
                        reason = f"{ring.cycles:.1f} cycles at a damping ratio of {ring.damping_ratio:.2f} are too little to match"
                    if reason:
                        reasons.append(f"{log.name} at {log.record.t[span.start]:.3g} s: {reason}")
                    else:
                        found.append(
                            _Window(
                                k,
                                part,
                                cylinder,
                                self.bench.rig.cylinder_named(cylinder).joint,
                                columns,
                                ring,
                            )
                        )
        if not found:
            raise InsufficientData(
                "no transient of these logs rings clearly, so there is no frequency to match",
                hint="; ".join(reasons[:3]) or None,
            )
        return found

    def _rings(self, theta: np.ndarray, before: Sequence[Ringing] | None) -> list[Ringing]:
        """How the simulation rings in each window, seen as the recording was; the search starts
        where it rang before.
        """
        row = self.bench.simulate([[c.at(x) for c, x in zip(self.search, theta, strict=True)]])[0]
        result = []
        for k, window in enumerate(self.windows):
            if row[window.log] is None:
                result.append(Ringing(reason="the simulation failed"))
                continue
            t, y = (
                self.bench.logs[window.log].record.t[window.span],
                row[window.log][window.span][:, window.columns],
            )
            guess = (
                (before[k].natural_frequency, before[k].damping_ratio)
                if before is not None and before[k].ok
                else None
            )
            result.append(ringing_like(t, y, window.recorded, guess))
        return result

    def _measure(self, i: int, rings: Sequence[Ringing]) -> np.ndarray:
        """What parameter i is matched on, by window: ln ω_n for the bulk modulus, ζ for a damping;
        nan where there is none.
        """
        if self.search[i].name == "bulk_modulus":
            return np.array(
                [math.log(ring.natural_frequency) if ring.ok else math.nan for ring in rings]
            )
        joint = self.search[i].name.rsplit(".", 1)[0]
        own = [window.joint == joint for window in self.windows]
        return np.array(
            [
                ring.damping_ratio if ring.ok and mine else math.nan
                for ring, mine in zip(rings, own, strict=True)
            ]
        )

    def fit(self) -> HydraulicsFit:
        recorded = [window.recorded for window in self.windows]
        self.aim = [self._measure(i, recorded) for i in range(len(self.search))]
        self.theta = np.array([c.begin for c in self.search])
        self.live = [i for i in range(len(self.search)) if np.isfinite(self.aim[i]).any()]
        self.rings: list[Ringing] | None = None
        self.rounds, converged = 0, False
        while self.live and self.rounds < self.most:
            converged = self._stand()
            self.found = {i: self._scatter(i, self.slope[b, b]) for b, i in enumerate(self.live)}
            vague = [i for i in self.live if not self.found[i][0] < VAGUE[self.search[i].log]]
            self._drop(vague)
            if converged and not vague:
                break
        self.tell("thesis: done", 1.0)
        return self._result(converged)

    def _drop(self, which: Sequence[int]) -> None:
        """Put parameters back to their start and leave them out."""
        for i in which:
            self.theta[i] = self.search[i].of(self.search[i].start)
        self.live = [i for i in self.live if i not in which]

    def _stand(self) -> bool:
        """Some rounds of Newton's method on the medians of the windows; whether no parameter moves
        any more.

        A simulation that does not ring at all is damped less first.
        """
        low, high = np.array([c.bounds for c in self.search]).T
        for fresh in range(1, ROUNDS + 1):
            self.rounds += 1
            self.tell(
                "thesis: matching frequency and decay",
                0.2 + 0.8 * self.rounds / (self.rounds + 4.0),
            )
            self.rings = self._rings(self.theta, self.rings)
            self.error = {i: self.aim[i] - self._measure(i, self.rings) for i in self.live}
            silent = [i for i in self.live if not np.isfinite(self.error[i]).any()]
            tame = [
                i
                for i in self.live
                if self.search[i].name != "bulk_modulus" and self.theta[i] > low[i]
            ]
            if silent and tame and fresh <= TAMING:
                self.theta[tame] = np.maximum(
                    self.theta[tame] - (0.7 if self.search[tame[0]].log else 0.1), low[tame]
                )
                continue
            self._drop(silent)
            live = self.live
            if not live:
                return False
            miss = np.array([np.nanmedian(self.error[i]) for i in live])
            if silent or fresh <= FRESH_SLOPES:
                self.slope = self._slopes(self.theta, live, self.rings)
            pull = np.sign(np.diag(self.slope)) * miss
            self.at_bound = [
                i
                for b, i in enumerate(live)
                if (self.theta[i] <= low[i] and pull[b] < 0)
                or (self.theta[i] >= high[i] and pull[b] > 0)
            ]
            inside = [b for b, i in enumerate(live) if i not in self.at_bound]
            moves = np.zeros(len(live))
            moves[inside] = np.linalg.lstsq(
                self.slope[np.ix_(inside, inside)], miss[inside], rcond=1e-3
            )[0]
            if all(
                abs(moves[b]) < max(STAND, LITTLE * self._scatter(i, self.slope[b, b])[0])
                for b, i in enumerate(live)
            ):
                return True
            self.theta[live] = np.clip(
                self.theta[live] + np.clip(moves, -0.7, 0.7), low[live], high[live]
            )
        return False

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

    def _result(self, converged: bool) -> HydraulicsFit:
        warnings = []
        if not converged:
            warnings.append(
                f"the matching stopped after {self.rounds} rounds without standing still; its numbers are not final"
            )
        fitted = []
        for i, c in enumerate(self.search):
            one = FittedParameter(
                c.name,
                parameter_row(c.name).unit,
                c.start,
                None,
                None,
                c.lower,
                c.upper,
                c.start,
                "not_excited",
                0,
            )
            if i in self.live:
                std, quantile, count = self.found[i]
                real, ends = c.spread(self.theta[i], std, quantile)
                status = "at_bound" if i in self.at_bound else "estimated"
                one = replace(
                    one,
                    value=c.at(self.theta[i]),
                    std=real,
                    interval=ends,
                    status=status,
                    samples=count,
                    error_from="windows",
                )
            fitted.append(one)
        if all(one.status == "not_excited" for one in fitted):
            names = ", ".join(c.name for c in self.search)
            raise InsufficientData(
                f"no transient that rings tells anything about {names}",
                hint="use steps of these joints' cylinders",
            )
        matches = [
            Match(
                self.bench.logs[w.log].name,
                w.cylinder,
                tuple(self.bench.logs[w.log].channels[i] for i in w.columns),
                float(self.bench.logs[w.log].record.t[w.span.start]),
                w.recorded.stop,
                w.recorded,
                ring,
            )
            for w, ring in zip(self.windows, self.rings, strict=True)
        ]
        lost = sum(not match.simulated.ok for match in matches)
        if lost:
            warnings.append(
                f"in {lost} of {len(matches)} transients the recording rings and the model does not"
            )
        return finish(
            self.bench, "thesis", fitted, warnings, (), np.zeros((0, 0)), matches, {}, self.rounds
        )

    def _scatter(self, i: int, slope: float) -> tuple[float, float, int]:
        """(standard error of theta, quantile of the 95 % interval, windows): the scatter of the
        windows about their median, or what the recorded rings' own errors make of it if that is
        more."""
        from scipy.stats import t

        error = self.error[i]
        use = np.isfinite(error)
        count = int(use.sum())
        bulk = self.search[i].name == "bulk_modulus"
        own = [
            w.recorded.natural_frequency_std / w.recorded.natural_frequency
            if bulk
            else w.recorded.damping_ratio_std
            for w, used in zip(self.windows, use, strict=True)
            if used
        ]
        scatter = float(np.std(error[use], ddof=1)) if count > 1 else 0.0
        median = (
            math.sqrt(math.pi / 2.0) if count > 2 else 1.0
        )  # a median's standard error over a mean's
        std = median * max(scatter, rms(np.array(own))) / math.sqrt(count) / max(abs(slope), 1e-12)
        return std, float(t.ppf(0.5 + 0.5 * LEVEL, max(1, count - 1))) if count > 1 else 1.96, count
