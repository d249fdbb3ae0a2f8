"""What a model's residuals follow, and the cure: every likely fault is built into the model or into
the log, and what would explain the residuals is named with the line that cures it.

Residuals are simulated minus recorded, averaged over 5 ms, each channel in units of its noise. A
fault counts where it explains more than chance does of that many independent numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from ehbench.data.record import Record
from ehbench.diagnosis.cases import Case, total
from ehbench.diagnosis.cures import Cure, cures
from ehbench.diagnosis.follows import Follows, followed
from ehbench.diagnosis.pins import disagreements
from ehbench.plant.many import Replay, replay_many
from ehbench.preprocessing.observations import position_of
from ehbench.vocabulary.errors import EhbenchError

__all__ = ["Case", "Finding", "Follows", "Structure", "ask", "followed"]

CERTAIN = 30.0  # log-likelihood ratio that the best of all cures hardly reaches by chance
MATTERS = 0.1  # share of the residuals' sum of squares that a cure must explain
NEAR = 0.6  # share of what the best cure explains, from which another is told too
BESIDE = 0.3  # share of what the best leaves, that one beside it must explain
ALIKE = 0.97  # of two that explain this nearly alike, the plainer comes first
TRIED = 8  # cures that are simulated at the size that the slopes tell
REFINED = 6  # of these, the size is sought further
HALVINGS = 5  # of the steps in which it is
QUIET = 1.3  # mean square of residuals, in those of noise, up to which only slopes are asked
OF_A_KIND = 2  # findings of one kind that are told
MOST = 4  # findings told of a cylinder
DOMINANT = 0.5  # share of the residuals' squares from which a cause speaks against the model

Point = tuple[Cure, float]  # a cure and its size
Best = tuple[float, float, list[np.ndarray]]  # a size, sum of squares, what is left of each case


@dataclass(frozen=True)
class Finding:
    """One thing that the residuals say: its ``kind`` (``gain``, ``deadband``, ``lag``, …), what it
    is ``about`` (a part or a channel), a ``sentence``, the ``cure`` as a line of the recipe or the
    rig file, and the share of the residuals' squares that it ``explains``; ``size`` is the cure's
    own measure, such as a share of a gain. ``above_noise`` says whether the residuals exceed what
    the sensors' noise makes."""

    kind: str
    about: str
    sentence: str
    cure: str
    explains: float
    size: float
    above_noise: bool = False

    @property
    def dominant(self) -> bool:
        """Whether it explains most of a residual that is above the noise."""
        return self.above_noise and self.explains > DOMINANT


@dataclass(frozen=True)
class Structure:
    """What the residuals of some logs say: ``findings``, the likeliest first, and what each channel
    ``follows``.
    """

    findings: tuple[Finding, ...] = ()
    follows: tuple[Follows, ...] = ()


def ask(cases: Sequence[Case]) -> Structure:
    """What the residuals of these logs say of the model, the logs of each cylinder by themselves.

    A log that cannot be simulated says nothing. Sound models have no findings: noise, and what the
    start state owes to it, is no structure."""
    known: list[tuple[Case, np.ndarray]] = []
    follows: list[Follows] = []
    for case in cases:
        try:
            simulated = case.simulated(case.model, case.record)
        except EhbenchError:
            continue
        if not case.channels:
            continue
        known.append((case, case.left(simulated)))
        follows += followed(case, simulated)
    findings = [
        Finding("pins", about, sentence, cure, 1.0, size)
        for about, sentence, cure, size in disagreements([case for case, _ in known])
    ]
    groups: dict[tuple[str, ...], list[tuple[Case, np.ndarray]]] = {}
    for case, left in known:
        groups.setdefault(case.cylinders, []).append((case, left))
    requested = [_Search(group).findings()[:MOST] for group in groups.values()]
    unique: dict[tuple[str, str], Finding] = {}
    for row in zip_longest(*requested):  # the first of each cylinder before the second of any
        for item in filter(None, row):
            unique.setdefault((item.kind, item.about), item)
    return Structure((*findings, *unique.values()), tuple(follows))


class _Search:
    """The cures of some cases, each by its slope and then by its simulation."""

    def __init__(self, known: Sequence[tuple[Case, np.ndarray]]) -> None:
        self.cases = [case for case, _ in known]
        self.left = [left for _, left in known]
        self.now = total(self.left)
        self.count = sum(case.independent(left) for case, left in known)

    def findings(self) -> list[Finding]:
        """The cures that explain the residuals, the likeliest first."""
        slopes = self._slopes(self._cures())
        promises = {cure: self._promise(cure, slope) for cure, slope in slopes.items()}
        ranked = sorted(slopes, key=lambda cure: -promises[cure])
        quiet = not self._above_noise
        tried = [cure for cure in ranked[:TRIED] if promises[cure] > 0.0]
        if quiet and not any(self._counts(promises[cure], self.now) for cure in tried):
            return []
        tried += [cure for cure in ranked[TRIED:] if cure.trials]
        reached = self._best({cure: slopes[cure] for cure in tried})
        nearest = sorted(reached, key=lambda cure: reached[cure][1])[:REFINED]
        reached |= self._refined({cure: reached[cure] for cure in nearest})
        gains = {cure: self.now - cost for cure, (_, cost, _) in reached.items()}
        gains = {cure: gain for cure, gain in gains.items() if self._counts(gain, self.now)}
        if not gains:
            return []
        best = max(gains.values())
        shown = sorted(
            (cure for cure, gain in gains.items() if gain >= NEAR * best),
            key=lambda cure: (
                (0, cure.rank, -gains[cure])
                if gains[cure] >= ALIKE * best
                else (1, 0, -gains[cure])
            ),
        )
        results = [self._finding(cure, reached[cure][0], gains[cure]) for cure in shown]
        additional = self._beside(shown, reached[shown[0]][2], slopes)
        kinds = [item.kind for item in results]
        few = [item for i, item in enumerate(results) if kinds[:i].count(item.kind) < OF_A_KIND]
        return [*few[:2], *additional, *few[2:]]

    def _cures(self) -> list[Cure]:
        case = self.cases[0]
        cylinders = [name for item in self.cases for name in item.cylinders]
        channels = [
            name if name in item.record else position_of(name)
            for item in self.cases
            for name in item.channels
        ]
        played = all("p_supply" in item.record for item in self.cases)
        unique = list(dict.fromkeys(channels))
        return cures(case.model.rig, list(dict.fromkeys(cylinders)), unique, played)

    def _at(self, points: Sequence[Point]) -> list[list[np.ndarray] | None]:
        """What is left of each case with a cure of a size, for each of these; None where it cannot
        be simulated.
        """
        results: list[list[np.ndarray] | None] = [list(self.left) for _ in points]
        for k, case in enumerate(self.cases):
            runs: dict[int, Replay] = {}
            for i, (cure, delta) in enumerate(points):
                if cure.cylinder and cure.cylinder not in case.cylinders:
                    continue
                try:
                    runs[i] = case.run_of(*cure.vary(case, delta))
                except EhbenchError:
                    results[i] = None
            built = replay_many(list(runs.values()))
            for i, replayed in zip(runs, built, strict=True):
                left, own = self._left(case, points[i], replayed), results[i]
                if left is None or own is None:
                    results[i] = None
                else:
                    own[k] = left
        return results

    @staticmethod
    def _left(case: Case, point: Point, replayed: Record | None) -> np.ndarray | None:
        """What a replay with a cure leaves of a case; None if that is not finite."""
        if replayed is None:
            return None
        cure, delta = point
        try:
            left = case.left(cure.sense(case, case.seen(replayed), delta))
        except EhbenchError:
            return None
        return left if np.isfinite(left).all() else None

    def _slopes(self, every: Sequence[Cure]) -> dict[Cure, list[np.ndarray] | None]:
        """What is left over changes by, a unit of δ, of each cure."""
        steps = {
            cure: cure.step if cure.low <= cure.step <= cure.high else -cure.step
            for cure in every
            if cure.step != 0.0
        }
        moved = dict(zip(steps, self._at(list(steps.items())), strict=True))
        results: dict[Cure, list[np.ndarray] | None] = {}
        for cure in every:
            there = moved.get(cure)
            results[cure] = there and [
                (to - at) / steps[cure] for to, at in zip(there, self.left, strict=True)
            ]
        return results

    def _promise(self, cure: Cure, slope: list[np.ndarray] | None) -> float:
        """By how much a cure lowers the sum of squares, if what is left is linear in it."""
        delta = self._size(cure, slope, self.left)
        if slope is None or delta == 0.0:
            return 0.0
        after = [at + delta * by for at, by in zip(self.left, slope, strict=True)]
        return self.now - total(after)

    @staticmethod
    def _size(cure: Cure, slope: list[np.ndarray] | None, left: list[np.ndarray]) -> float:
        """The δ at which what is left is least by the slopes, within the bounds."""
        if slope is None or (steep := total(slope)) <= 0.0:
            return 0.0
        along = sum(float(by @ at) for by, at in zip(slope, left, strict=True))
        return min(max(-along / steep, cure.low), cure.high)

    def _best(self, slopes: Mapping[Cure, list[np.ndarray] | None]) -> dict[Cure, Best]:
        """The best of each cure that is simulated, by their slopes."""
        points: list[Point] = []
        for cure, slope in slopes.items():
            first = self._size(cure, slope, self.left)
            sizes = dict.fromkeys((*cure.trials, first, 0.5 * first))
            points += [(cure, delta) for delta in sizes if delta != 0.0]
        return self._bettered(dict.fromkeys(slopes, (0.0, self.now, self.left)), points)

    def _refined(self, reached: Mapping[Cure, Best]) -> dict[Cure, Best]:
        """As `_best`, with δ sought to both sides in halving steps."""
        now = dict(reached)
        reach = {cure: 0.5 * abs(best[0]) for cure, best in now.items()}
        for _ in range(HALVINGS):
            before = dict(now)
            for side in (-1.0, 1.0):
                points = [
                    (cure, best[0] + side * reach[cure])
                    for cure, best in before.items()
                    if reach[cure] > 0.0 and now[cure] is best
                ]
                inside = [(c, delta) for c, delta in points if c.low <= delta <= c.high]
                now = self._bettered(now, inside)
            reach = {cure: 0.5 * far for cure, far in reach.items()}
        return now

    def _bettered(self, reached: Mapping[Cure, Best], points: Sequence[Point]) -> dict[Cure, Best]:
        """The best of each cure, held against some more points."""
        now = dict(reached)
        for (cure, delta), left in zip(points, self._at(points), strict=True):
            if left is not None and total(left) < now[cure][1]:
                now[cure] = (delta, total(left), left)
        return now

    def _counts(self, gain: float, of: float) -> bool:
        """Whether so much less in a sum of squares is more than chance, and more than a trifle."""
        if gain < MATTERS * of:
            return False
        return self.count * math.log(of / max(of - gain, 1.0e-12 * of)) > CERTAIN

    def _beside(
        self,
        shown: Sequence[Cure],
        left: list[np.ndarray],
        slopes: dict[Cure, list[np.ndarray] | None],
    ) -> list[Finding]:
        """What explains most of what the best cure leaves, if something does."""
        now, best = total(left), (0.0, None, 0.0)
        for cure, slope in slopes.items():
            if cure in shown or slope is None:
                continue
            delta = self._size(cure, slope, left)
            after = total([at + delta * by for at, by in zip(left, slope, strict=True)])
            if now - after > best[0]:
                best = (now - after, cure, delta)
        gain, cure, delta = best
        if cure is None or gain < BESIDE * now or not self._counts(gain, now):
            return []
        return [self._finding(cure, delta, gain)]

    @property
    def _above_noise(self) -> bool:
        return self.now >= QUIET * sum(left.size for left in self.left)

    def _finding(self, cure: Cure, delta: float, gain: float) -> Finding:
        says, line = cure.says(delta), cure.line(delta)
        explains, above = float(gain / self.now), self._above_noise
        return Finding(cure.kind, cure.about, says, line, explains, float(delta), above)
