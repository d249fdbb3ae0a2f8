"""What a model's residuals follow, and the cure: every likely fault is built into the model or into
the log, and what would explain the residuals is named with the line that cures it.

Residuals are simulated minus recorded, averaged over 5 ms, each channel in units of its noise. A
fault counts where it explains more than chance does of that many independent numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np

from ehbench.errors import EhbenchError
from ehbench.observations import position_of
from ehbench.structure.cases import Case, commanded, total
from ehbench.structure.cures import Cure, cures
from ehbench.structure.follows import Follows, followed
from ehbench.structure.pins import disagreements

__all__ = ["Case", "Finding", "Follows", "Structure", "ask", "commanded", "followed"]

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


@dataclass(frozen=True)
class Finding:
    """One thing that the residuals say: its ``kind`` (``gain``, ``deadband``, ``lag``, …), what it
    is ``about`` (a part or a channel), a ``sentence``, the ``cure`` as a line of the recipe or the
    rig file, and the share of the residuals' squares that it ``explains``; ``size`` is the cure's
    own measure, such as a share of a gain."""

    kind: str
    about: str
    sentence: str
    cure: str
    explains: float
    size: float


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
    asked = [_Search(group).findings()[:MOST] for group in groups.values()]
    unique: dict[tuple[str, str], Finding] = {}
    for row in zip_longest(*asked):  # the first of each cylinder before the second of any
        for one in filter(None, row):
            unique.setdefault((one.kind, one.about), one)
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
        slopes = {cure: self._slope(cure) for cure in self._cures()}
        promises = {cure: self._promise(cure, slope) for cure, slope in slopes.items()}
        ranked = sorted(slopes, key=lambda cure: -promises[cure])
        quiet = self.now < QUIET * sum(left.size for left in self.left)
        tried = [cure for cure in ranked[:TRIED] if promises[cure] > 0.0]
        if quiet and not any(self._counts(promises[cure], self.now) for cure in tried):
            return []
        tried += [cure for cure in ranked[TRIED:] if cure.trials]
        reached = {cure: self._best(cure, slopes[cure]) for cure in tried}
        for cure in sorted(reached, key=lambda cure: reached[cure][1])[:REFINED]:
            reached[cure] = self._refined(cure, reached[cure])
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
        found = [_finding(cure, reached[cure][0], gains[cure] / self.now) for cure in shown]
        beside = self._beside(shown, reached[shown[0]][2], slopes)
        kinds = [one.kind for one in found]
        few = [one for i, one in enumerate(found) if kinds[:i].count(one.kind) < OF_A_KIND]
        return [*few[:2], *beside, *few[2:]]

    def _cures(self) -> list[Cure]:
        case = self.cases[0]
        cylinders = [name for one in self.cases for name in one.cylinders]
        channels = [
            name if name in one.record else position_of(name)
            for one in self.cases
            for name in one.channels
        ]
        played = all("p_supply" in one.record for one in self.cases)
        unique = list(dict.fromkeys(channels))
        return cures(case.model.rig, list(dict.fromkeys(cylinders)), unique, played)

    def _at(self, cure: Cure, delta: float) -> list[np.ndarray] | None:
        """What is left of each case with a cure of this size; None if it cannot be simulated."""
        found = []
        for case, now in zip(self.cases, self.left, strict=True):
            if cure.cylinder and cure.cylinder not in case.cylinders:
                found.append(now)
                continue
            try:
                model, record = cure.vary(case, delta)
                simulated = cure.sense(case, case.simulated(model, record), delta)
                left = case.left(simulated)
            except EhbenchError:
                return None
            if not np.isfinite(left).all():
                return None
            found.append(left)
        return found

    def _slope(self, cure: Cure) -> list[np.ndarray] | None:
        """What is left over changes by, a unit of δ."""
        if cure.step == 0.0:
            return None
        step = cure.step if cure.low <= cure.step <= cure.high else -cure.step
        moved = self._at(cure, step)
        if moved is None:
            return None
        return [(to - at) / step for to, at in zip(moved, self.left, strict=True)]

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

    def _best(
        self, cure: Cure, slope: list[np.ndarray] | None
    ) -> tuple[float, float, list[np.ndarray]]:
        """(δ, sum of squares, what is left) of the best of a cure that is simulated."""
        best = (0.0, self.now, self.left)
        first = self._size(cure, slope, self.left)
        for delta in dict.fromkeys((*cure.trials, first, 0.5 * first)):
            if delta == 0.0:
                continue
            left = self._at(cure, delta)
            if left is not None and total(left) < best[1]:
                best = (delta, total(left), left)
        return best

    def _refined(
        self, cure: Cure, best: tuple[float, float, list[np.ndarray]]
    ) -> tuple[float, float, list[np.ndarray]]:
        """As `_best`, with δ sought to both sides in halving steps."""
        reach = 0.5 * abs(best[0])
        for _ in range(HALVINGS):
            for delta in (best[0] - reach, best[0] + reach):
                if reach == 0.0 or not cure.low <= delta <= cure.high:
                    continue
                left = self._at(cure, delta)
                if left is not None and total(left) < best[1]:
                    best = (delta, total(left), left)
                    break
            reach *= 0.5
        return best

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
        return [_finding(cure, delta, gain / self.now)]


def _finding(cure: Cure, delta: float, explains: float) -> Finding:
    says, line = cure.says(delta), cure.line(delta)
    return Finding(cure.kind, cure.about, says, line, float(explains), float(delta))
