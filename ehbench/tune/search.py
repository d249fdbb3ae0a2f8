"""The search for a law, its washouts and off-side gain, and for the gain of its feedback."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.recipe import TuneRecipe
from ehbench.control.functions import HEAD, METERED
from ehbench.parts.oil import bulk_of
from ehbench.tune.linear import faster
from ehbench.tune.loop import Law, Loop, margins, violations
from ehbench.tune.results import Alternative
from ehbench.tune.study import SteadyMotion
from ehbench.vocabulary import message, setting
from ehbench.vocabulary.codes import FUNCTIONS


@dataclass(frozen=True)
class SearchSettings:
    """Numbers of the search for the gains of pressure feedback."""

    gain_span: float = setting(100.0, "", "range of gains about the natural one", "both limits")
    gain_points: int = setting(81, "", "gains to try", "12 % steps")
    corners: tuple = setting((2.5, 0.02, 22), "", "washouts to try, of the frequency", "a decade")
    offs: tuple = setting((0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0), "", "off-side gains", "range")
    margin: float = setting(1.1, "", "damping to reach, of the target", "uncertain parameters")
    bisections: int = setting(4, "", "refinements of the washout", "1/16 of a step")
    pair: float = setting(0.25, "", "slowest double washout, of the single one", "chosen")
    nearly: float = setting(0.95, "", "damping that a fast washout keeps", "chosen")
    draw_points: int = setting(24, "", "least damped points for draws", "time")
    locus_points: int = setting(240, "", "points of a root locus", "smooth curve")
    step_samples: int = setting(201, "", "samples of a step response", "smooth curve")


SEARCH = SearchSettings()


def swing(motion: SteadyMotion) -> float:
    """Natural frequency [rad/s] between two shut chambers: ω² = (β1 A1²/V1 + β2 A2²/V2)/m_eq."""
    (head, rod), point = _stiffness(motion), motion.point
    spring = motion.circuit.area_head**2 / point.volume_head
    spring += rod / head * (motion.circuit.area_rod**2 / point.volume_rod)
    return math.sqrt(head * spring / point.mass)


def _stiffness(motion: SteadyMotion) -> tuple[float, float]:
    """Bulk moduli [Pa] of the oil in the head and in the rod end."""
    row, point = motion.model.plant.cylinders[motion.circuit.cylinder], motion.point
    return bulk_of(row, point.p_head), bulk_of(row, point.p_rod)


def worst_damping(motions: Sequence[SteadyMotion], law: Law, gains: np.ndarray) -> np.ndarray:
    """Least damping ratio over the points at each gain."""
    worst = np.ones(gains.size)
    for motion in motions:
        worst = np.minimum(worst, motion.loop(law).damping_ratio(gains))
    return worst


def best_gain(motions: Sequence[SteadyMotion], law: Law, gains: np.ndarray) -> tuple[float, float]:
    """(largest worst damping ratio, its gain)."""
    loops = [motion.loop(law) for motion in motions]
    worst = np.minimum(loops[0].damping_ratio(gains), 1.0)
    # gains that give less than the best one of the first point are left out
    likely = float(gains[worst.argmax()])
    minimum = min(float(loop.damping_ratio(likely)) for loop in loops) - 1e-9
    remaining, worst = gains[worst >= minimum], worst[worst >= minimum]
    for loop in loops[1:]:
        worst = np.minimum(worst, loop.damping_ratio(remaining))
        remaining, worst = remaining[worst >= minimum], worst[worst >= minimum]
    return float(worst.max()), float(remaining[worst.argmax()])


class LawSearch:
    """The search for washouts and off-side gain over operating points.

    Args:
        motions: that count.
        recipe: what is given and demanded.
        demands: margins and bandwidth that a gain has to keep, by name.

    Attributes:
        grid: gains to try [m³/(s·Pa)], about the one that makes a chamber as fast as its load
            swings; the search for a law tries half of them."""

    def __init__(
        self, motions: Sequence[SteadyMotion], recipe: TuneRecipe, demands: dict[str, float]
    ) -> None:
        logs = []  # ω_n V/β_e [m³/(s·Pa)]: the gain by which a chamber is as fast as its load
        for motion in motions:
            head = METERED[FUNCTIONS.index(motion.point.function)] == HEAD
            volume = motion.point.volume_head if head else motion.point.volume_rod
            logs.append(math.log(swing(motion) * volume / _stiffness(motion)[0 if head else 1]))
        scale, span = math.exp(float(np.mean(logs))), SEARCH.gain_span
        trial = np.geomspace(scale / span, scale * span, SEARCH.gain_points)
        self.grid = np.concatenate([[0.0], trial])
        self.motions, self.gains, self.delay = motions, self.grid[::2], float(recipe.delay)
        self.demands = demands
        self.minimum = SEARCH.margin * float(recipe.damping_ratio)
        self.free = recipe.washout is None
        slowest = min(swing(motion) for motion in motions)
        self.corners = [slowest * share for share in np.geomspace(*SEARCH.corners).tolist()]
        if recipe.washout is not None:
            self.corners = [float(recipe.washout)]
        self.single = recipe.ramp_washout is not None
        self.ramp = 0.0 if recipe.ramp_washout is None else float(recipe.ramp_washout)
        # one command for both ends: nothing to hold
        fixed = Law(self.corners[0], scale, self.delay)
        self.shared = not any(motion.loop(fixed).off.any() for motion in motions)
        self.offs = [scale * share for share in SEARCH.offs]
        if recipe.off_gain is not None:
            self.offs = [float(recipe.off_gain)]
        elif self.shared:
            self.offs = [0.0]
        self._queue = list(motions)  # those that refused a law lately go first
        self._known: dict[Law, tuple[float, float]] = {}  # `best_of` each law that was looked at

    def law(self) -> Law:
        """The law with washouts and off-side gain as given, or found.

        Two washouts of one corner, or a single one where they would be slower than ``pair`` of
        it: the fastest with which some off-side gain and K_p reach ``margin`` of the target and
        keep the demands: the faster they forget, the less a load that changes slows the
        motion."""
        law = self._fastest([(c, self.ramp) for c in self.corners]) if self.free else None
        if law is not None and not self.single:
            slowest = SEARCH.pair * law.washout
            law = self._fastest([(c, c) for c in self.corners if c >= slowest]) or law
        if law is not None:
            return law
        # nothing reaches the target: in turns the off-side gain with the best worst case, and the
        # fastest single washout that keeps ``nearly`` of the best one's
        law = Law(self.corners[-1], self.offs[0], self.delay, self.ramp)
        for _ in range(2 if len(self.corners) > 1 and len(self.offs) > 1 else 1):
            law = self._best([replace(law, off_gain=off) for off in self.offs])
            worst = {c: self.best_of(replace(law, washout=c))[0] for c in self.corners}
            enough = SEARCH.nearly * max(worst.values())
            law = replace(law, washout=max(c for c, value in worst.items() if value >= enough))
        return law

    def best_of(self, law: Law) -> tuple[float, float]:
        """(largest worst damping ratio of a law, its gain)."""
        if law not in self._known:
            self._known[law] = best_gain(self.motions, law, self.gains)
        return self._known[law]

    def _best(self, laws: Sequence[Law]) -> Law:
        return max(laws, key=lambda law: self.best_of(law)[0]) if len(laws) > 1 else laws[0]

    def _reaching(self, corner: float, ramp: float) -> Law | None:
        """The best law with these washouts that reaches the target and keeps the demands; None
        where none does."""
        able = []
        for law in (Law(corner, off, self.delay, ramp) for off in self.offs):
            remaining = self.gains  # that give every point so far the damping ratio
            for i, motion in enumerate(self._queue):
                remaining = remaining[motion.loop(law).damping_ratio(remaining) >= self.minimum]
                if not remaining.size:
                    self._queue.insert(0, self._queue.pop(i))  # the likeliest to refuse the next
                    break
            else:
                loops = [motion.loop(law) for motion in self.motions]
                if any(_keeps_demands(loops, gain, self.demands) for gain in remaining):
                    able.append(law)
        return self._best(able) if able else None

    def _fastest(self, washouts: Sequence[tuple[float, float]]) -> Law | None:
        """Of washouts that get slower, the first that reaches the target, refined by bisection."""
        faster_corner = 0.0
        for corner, ramp in washouts:
            law = self._reaching(corner, ramp)
            if law is None:
                faster_corner = corner
                continue
            for _ in range(SEARCH.bisections if faster_corner > 0.0 else 0):
                middle = math.sqrt(law.washout * faster_corner)
                closer = self._reaching(middle, middle if ramp == corner else ramp)
                if closer is None:
                    faster_corner = middle
                else:
                    law = closer
            return law
        return None

    def alternatives(self, law: Law) -> tuple[Alternative, ...]:
        """Other laws, each at its best gain; the law itself first."""
        washout, ramp, off = law.washout, law.ramp_washout, law.off_gain
        others = {"chosen law": law}
        if washout > 0.0:
            others["no washout"] = replace(law, washout=0.0, ramp_washout=0.0)
        if ramp != 0.0:
            others["one washout"] = replace(law, ramp_washout=0.0)
        elif washout > 0.0:
            others["two washouts"] = replace(law, ramp_washout=washout)
        if washout > 0.0:
            quicker = replace(law, washout=4 * washout, ramp_washout=4 * ramp)
            others["faster washout (× 4)"] = quicker
        others["load force feedback"] = replace(law, feedback="load")
        if not self.shared:
            others["softer off-side (× 0.2)"] = replace(law, off_gain=0.2 * off)
            others["stiffer off-side (× 5)"] = replace(law, off_gain=5 * off)
        others["no delay"] = replace(law, delay=0.0)
        tried = {what: (self.best_of(other), other) for what, other in others.items()}
        quick = [replace(motion, linear=faster(motion.linear, 10.0)) for motion in self.motions]
        tried["faster valves (× 10)"] = best_gain(quick, law, self.gains), law
        return tuple(
            Alternative(what, o.washout, o.ramp_washout, o.off_gain, o.feedback, gain, value)
            for what, ((value, gain), o) in tried.items()
        )


def choose_gain(
    motions: Sequence[SteadyMotion],
    law: Law,
    gains: np.ndarray,
    demands: dict[str, float],
    notes: list[str],
) -> float:
    """The gain with the best worst case of those that keep the demands everywhere, else of all.
    What the demands cost goes to ``notes``."""
    from scipy.optimize import minimize_scalar

    worst = worst_damping(motions, law, gains)
    order = np.argsort(-worst, kind="stable")
    loops = [motion.loop(law) for motion in motions]
    best = int(order[0])
    ends = gains[[max(best - 1, 1), min(max(best + 1, 2), gains.size - 1)]]
    between: Any = minimize_scalar(
        lambda z: -float(worst_damping(motions, law, np.array([math.exp(z)]))[0]),
        bounds=tuple(np.log(ends)),
        method="bounded",
        options={"xatol": 1e-3},
    )
    fine, damping = float(math.exp(between.x)), float(-between.fun)
    candidates = [fine, *(float(gains[i]) for i in order if worst[i] > worst[0])]
    chosen = next((gain for gain in candidates if _keeps_demands(loops, gain, demands)), None)
    if chosen == fine:
        return fine
    broken = ", ".join(
        sorted({v for loop in loops for v in violations(margins(loop, fine), demands)})
    )
    if chosen is None:
        notes.append(message("tune.no_gain", margins=broken))
        return fine
    share = chosen / fine
    notes.append(message("tune.limited_gain", margins=broken, share=share, damping=damping))
    return chosen


def _keeps_demands(loops: list[Loop], gain: float, demands: dict[str, float]) -> bool:
    """Whether every loop keeps the demands at a gain. A loop that refuses goes to the front."""
    for i, loop in enumerate(loops):
        if violations(margins(loop, gain), demands):
            loops.insert(0, loops.pop(i))
            return False
    return True
