"""What a model's residuals follow: every row of the fault table is built into the model or into the
log, and what would explain the residuals is named with the line that frees it.

Residuals are simulated minus recorded, averaged over 5 ms, each channel in units of its noise. A
fault counts where it explains more than chance does of that many independent numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis.cases import DOMINANT, MATTERS, QUIET, Case, counts, total
from ehbench.diagnosis.faults import Hypothesis, hypotheses
from ehbench.diagnosis.recordings import Follows, disagreements, followed, is_astray, misread
from ehbench.plant.build import Maps
from ehbench.plant.foreign import model_of
from ehbench.plant.many import Replay, replay_many
from ehbench.plant.paced import AUTO
from ehbench.preprocessing.observations import commanded, payload_of
from ehbench.preprocessing.time_base import evened
from ehbench.vocabulary import EhbenchError, grouped, message
from ehbench.vocabulary.terms import BEYOND

__all__ = [
    "DOMINANT",
    "Case",
    "Finding",
    "Follows",
    "Structure",
    "ask",
    "followed",
    "likely_cause",
    "misread",
]

NEAR = 0.6  # share of what the best fault explains, from which another is told too
BESIDE = 0.3  # share of what the best leaves, that one beside it must explain
TRIED = 8  # faults that are simulated at the size that the slopes tell
REFINED = 6  # of these, the size is sought further
HALVINGS = 5  # of the steps in which it is
OF_A_KIND = 2  # findings of one kind that are told
MOST = 4  # findings told of a cylinder

Point = tuple[Hypothesis, float]  # a fault and its size δ
Best = tuple[float, float, list[np.ndarray]]  # a size, sum of squares, what is left of each case


@dataclass(frozen=True)
class Finding:
    """One thing that the residuals say: its ``kind`` (``gain``, ``deadband``, ``lag``, …), what it
    is ``about`` (a part or a channel), a ``sentence``, the ``remedy`` as a line of recipe or rig
    file, and the share that it ``explains`` of the residuals' squares beyond those of the sensors'
    noise; ``size`` is the fault's δ, such as a share of a gain; ``beyond`` by how many half-widths
    of its interval an identified number would be off; ``jointly`` the share that it and what stands
    beside it explain, 0 for nothing beside it; ``alike`` what these logs do not tell from it."""

    kind: str
    about: str
    sentence: str
    remedy: str
    explains: float
    size: float
    beyond: float = 0.0
    jointly: float = 0.0
    alike: tuple[str, ...] = ()

    @property
    def within(self) -> bool:
        """Whether the interval of an identified number holds it, and nothing else is left."""
        return 0.0 < self.beyond <= BEYOND and self.explains > 1.0 - MATTERS

    @property
    def cause(self) -> str:
        """Its sentence, with what is as likely."""
        if not self.alike:
            return self.sentence
        return message("faults.alike", sentence=self.sentence, others=", ".join(self.alike))


@dataclass(frozen=True)
class Structure:
    """What the residuals of some logs say: ``findings``, the likeliest first, and what each channel
    ``follows``.
    """

    findings: tuple[Finding, ...] = ()
    follows: tuple[Follows, ...] = ()

    @property
    def causes(self) -> tuple[Finding, ...]:
        """The likeliest that explains most of what is above the noise, or the two that do so only
        together.
        """
        alone = tuple(item for item in self.findings if item.explains > DOMINANT)
        return alone[:1] or tuple(item for item in self.findings if item.jointly > DOMINANT)[:2]


def ask(cases: Sequence[Case]) -> Structure:
    """What the residuals of these logs say of the model, the logs of each cylinder by themselves.

    A log that cannot be simulated says nothing. Sound models have no findings: noise, and what the
    start state owes to it, is no structure."""
    known: list[tuple[Case, np.ndarray]] = []
    follows: list[Follows] = []
    for case in cases:
        try:
            simulated = case.simulated()
        except EhbenchError:
            continue
        if not case.channels:
            continue
        known.append((case, case.left(simulated)))
        follows += followed(case, simulated)
    findings = [
        Finding("pins", about, sentence, fault, 1.0, size)
        for about, sentence, fault, size in disagreements([case for case, _ in known])
    ]
    groups = grouped(known, lambda pair: pair[0].cylinders)
    requested = [_Search(group).findings()[:MOST] for group in groups.values()]
    unique: dict[tuple[str, str], Finding] = {}
    for row in zip_longest(*requested):  # the first of each cylinder before the second of any
        for item in filter(None, row):
            unique.setdefault((item.kind, item.about), item)
    return Structure((*findings, *unique.values()), tuple(follows))


def likely_cause(name: str, record: Record, rig: Rig, maps: Maps | None) -> str:
    """Why a log goes so far astray from its rig's model, in words: exchanged channels or another
    payload, else what explains most of the residual. Empty where it does not, or nothing does.
    """
    try:
        even, _ = evened(name, record)
        model = model_of(rig, maps, payload_of(record))
        case = Case(name, even, model, commanded(model, even), maps)
        for note in misread(case):
            return note.fields["cause"]
        if not case.channels or not is_astray(case, case.left(case.simulated())):
            return ""
    except EhbenchError:  # too short, or it cannot be simulated
        return ""
    return next((item.sentence for item in ask([case]).causes), "")


class _Search:
    """The faults of some cases, each by its slope and then by its simulation."""

    def __init__(self, known: Sequence[tuple[Case, np.ndarray]]) -> None:
        self.cases = [case for case, _ in known]
        self.left = [left for _, left in known]
        self.now = total(self.left)
        self.noise = sum(case.noise_squares for case in self.cases)
        self.count = sum(case.independent(left) for case, left in known)

    def findings(self) -> list[Finding]:
        """The faults that explain the residuals, the likeliest first."""
        slopes = self._slopes(self._faults())
        promises = {fault: self._promise(fault, by, self.left)[0] for fault, by in slopes.items()}
        ranked = sorted(slopes, key=lambda fault: -promises[fault])
        quiet = self.now < QUIET * sum(left.size for left in self.left)
        if quiet and not self._counts(max(promises.values(), default=0.0), self.now):
            return []
        tried = [*ranked[:TRIED], *(fault for fault in ranked[TRIED:] if fault.row.trials)]
        reached = self._best({fault: slopes[fault] for fault in tried})
        nearest = sorted(reached, key=lambda fault: reached[fault][1])[:REFINED]
        reached |= self._refined({fault: reached[fault] for fault in nearest})
        gains = {fault: self.now - cost for fault, (_, cost, _) in reached.items()}
        gains = {fault: gain for fault, gain in gains.items() if self._counts(gain, self.now)}
        if not gains:
            return []
        best = max(gains.values())

        def place(fault: Hypothesis) -> tuple[float, ...]:
            """Those that explain as much as the best by their rank, then the others."""
            gain = gains[fault]
            if self._counts(best - gain, self.now - gain):
                return True, -gain
            return False, *fault.rank, -gain

        shown = sorted((f for f, gain in gains.items() if gain >= NEAR * best), key=place)
        beside = self._additional(shown[:1], reached[shown[0]][2], slopes)
        shown, additional = [f for f in shown if f not in beside], [*beside.values()]
        results = [self._finding(fault, reached[fault][0], gains[fault]) for fault in shown]
        alike = tuple(fault.name for fault in shown[1:MOST] if not place(fault)[0])
        results[0] = replace(results[0], alike=alike)
        if additional:
            pair = (results[0], *additional)
            both = sum(item.explains for item in pair)
            results[0], *additional = (replace(item, jointly=both) for item in pair)
        kinds = [item.kind for item in results]
        few = [item for i, item in enumerate(results) if kinds[:i].count(item.kind) < OF_A_KIND]
        return [*few[:2], *additional, *few[2:]]

    def _faults(self) -> list[Hypothesis]:
        case = self.cases[0]
        cylinders = dict.fromkeys(name for item in self.cases for name in item.cylinders)
        channels = dict.fromkeys(name for item in self.cases for name in item.channels)
        records = [item.record for item in self.cases]
        rows = hypotheses(case.model.rig, [*cylinders], [*channels], records, case.maps)
        rows = [
            item for item in rows if not item.kind.startswith("payload")
        ]  # see load: the model carries it
        return [item for item in rows if item.row.step != 0.0 or item.row.trials]

    def _at(self, points: Sequence[Point]) -> list[list[np.ndarray] | None]:
        """What is left of each case with a fault of a size, for each of these; None where it cannot
        be simulated.
        """
        results: list[list[np.ndarray] | None] = [list(self.left) for _ in points]
        for k, case in enumerate(self.cases):
            runs: dict[int, Replay] = {}
            for i, (fault, delta) in enumerate(points):
                if fault.cylinder and fault.cylinder not in case.cylinders:
                    continue
                try:
                    runs[i] = case.run_of(fault, delta)
                except (EhbenchError, ValueError):
                    results[i] = None
            built = replay_many(list(runs.values()), AUTO)
            for i, replayed in zip(runs, built, strict=True):
                left, residuals = self._left(case, points[i], replayed), results[i]
                if left is None or residuals is None:
                    results[i] = None
                else:
                    residuals[k] = left
        return results

    @staticmethod
    def _left(case: Case, point: Point, replayed: Record | None) -> np.ndarray | None:
        """What a replay with a fault leaves of a case; None if that is not finite."""
        if replayed is None:
            return None
        fault, delta = point
        try:
            left = case.left(case.seen(replayed, fault, delta))
        except EhbenchError:
            return None
        return left if np.isfinite(left).all() else None

    def _slopes(self, every: Sequence[Hypothesis]) -> dict[Hypothesis, list[np.ndarray] | None]:
        """What is left over changes by, a unit of δ, of each fault."""
        steps = {fault: fault.inside for fault in every if fault.row.step != 0.0}
        moved = dict(zip(steps, self._at(list(steps.items())), strict=True))
        results: dict[Hypothesis, list[np.ndarray] | None] = {}
        for fault in every:
            there = moved.get(fault)
            results[fault] = there and [
                (to - at) / steps[fault] for to, at in zip(there, self.left, strict=True)
            ]
        return results

    def _promise(
        self, fault: Hypothesis, slope: list[np.ndarray] | None, left: list[np.ndarray]
    ) -> tuple[float, float]:
        """(by how much a fault lowers the sum of squares of what is left, if that is linear in it;
        its size δ).
        """
        if slope is None:
            return 0.0, 0.0
        delta = self._size(fault, slope, left)
        after = [at + delta * by for at, by in zip(left, slope, strict=True)]
        return total(left) - total(after), delta

    @staticmethod
    def _size(fault: Hypothesis, slope: list[np.ndarray] | None, left: list[np.ndarray]) -> float:
        """The δ at which what is left is least by the slopes, within the bounds."""
        if slope is None or (steep := total(slope)) <= 0.0:
            return 0.0
        along = sum(float(by @ at) for by, at in zip(slope, left, strict=True))
        low, high = fault.bounds
        return min(max(-along / steep, low), high)

    def _best(self, slopes: Mapping[Hypothesis, list[np.ndarray] | None]) -> dict[Hypothesis, Best]:
        """The best of each fault that is simulated, by their slopes."""
        points: list[Point] = []
        for fault, slope in slopes.items():
            first = self._size(fault, slope, self.left)
            sizes = dict.fromkeys((*fault.row.trials, first, 0.5 * first))
            points += [(fault, delta) for delta in sizes if delta != 0.0]
        return self._bettered(dict.fromkeys(slopes, (0.0, self.now, self.left)), points)

    def _refined(self, reached: Mapping[Hypothesis, Best]) -> dict[Hypothesis, Best]:
        """As `_best`, with δ sought to both sides in steps that grow as far as it goes, and halve.

        The first size is that of a slope: oil leaks to an end by less than in proportion."""
        now = dict(reached)
        reach = {fault: 0.5 * abs(best[0]) for fault, best in now.items() if fault.row.step}
        least = {fault: far * 0.5**HALVINGS for fault, far in reach.items()}
        while sought := [fault for fault, far in reach.items() if far > least[fault]]:
            before = dict(now)
            for side in (-1.0, 1.0):
                points = [
                    (fault, before[fault][0] + side * reach[fault])
                    for fault in sought
                    if now[fault] is before[fault]
                ]
                inside = [(c, delta) for c, delta in points if c.bounds[0] <= delta <= c.bounds[1]]
                now = self._bettered(now, inside)
            for fault in reach:
                reach[fault] *= 0.5 if now[fault] is before[fault] else 2.0
        return now

    def _bettered(
        self, reached: Mapping[Hypothesis, Best], points: Sequence[Point]
    ) -> dict[Hypothesis, Best]:
        """The best of each fault, held against some more points."""
        now = dict(reached)
        for (fault, delta), left in zip(points, self._at(points), strict=True):
            if left is not None and total(left) < now[fault][1]:
                now[fault] = (delta, total(left), left)
        return now

    def _counts(self, gain: float, of: float) -> bool:
        return counts(gain, of, self.noise, self.count)

    def _additional(
        self,
        taken: Sequence[Hypothesis],
        left: list[np.ndarray],
        slopes: dict[Hypothesis, list[np.ndarray] | None],
    ) -> dict[Hypothesis, Finding]:
        """What explains most of what the best fault, taken, leaves, if something does."""
        now, rest = total(left), [fault for fault in slopes if fault not in taken]
        promises = {fault: self._promise(fault, slopes[fault], left) for fault in rest}
        best = max(promises, key=lambda fault: promises[fault][0], default=None)
        if best is None:
            return {}
        gain, delta = promises[best]
        counts = gain > BESIDE * now and self._counts(gain, now)
        return {best: self._finding(best, delta, gain)} if counts else {}

    def _finding(self, fault: Hypothesis, delta: float, gain: float) -> Finding:
        rig = self.cases[0].model.rig
        explains = float(gain / max(self.now - self.noise, gain))
        says, line = fault.sentence(rig, delta), fault.remedy(rig, delta)
        size, beyond = float(delta), fault.beyond(delta)
        return Finding(fault.kind, fault.about, says, line, explains, size, beyond)
