"""The search for a law, its washouts and off-side gain, and for the gain of its feedback."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ehbench.config.recipe import TuneRecipe
from ehbench.control.functions import HEAD, METERED
from ehbench.parts.oil import bulk_of
from ehbench.tune.linear import faster
from ehbench.tune.loop import Law, Loop
from ehbench.tune.margins import margins, violations
from ehbench.tune.results import Alternative
from ehbench.tune.study import Site
from ehbench.vocabulary.codes import FUNCTIONS

# gains looked at: this factor below and above the one that makes a chamber as fast as its load
# swings
GAIN_SPAN = 100.0
GAIN_POINTS = 81
# washout corners tried, of the slowest natural frequency, the fastest first
CORNER_SHARES = tuple(np.geomspace(2.5, 0.02, 22).tolist())
# off-side gains tried, of the gain that makes a chamber as fast as its load
OFF_SHARES = (0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0)
# what is found shall reach this much of the target, so that parameters a little off reach it too
HEADROOM = 1.1
BISECTIONS = 4  # between the fastest washout corner that reaches the target and the next faster one
# two washouts forget a load that ramps sooner than a single one, unless they are slower than this
# share of its corner
PAIR_SHARE = 0.25
# where nothing does, a faster washout may cost this share of the damping ratio that a slower one
# gives
NEARLY = 0.95


def natural_gain(sites: Sequence[Site]) -> float:
    """Geometric mean over the points of ω_n V/β_e [m³/(s·Pa)]: the gain that makes the metered
    chamber as fast as the load swings."""
    logs = []
    for site in sites:
        head = METERED[FUNCTIONS.index(site.point.function)] == HEAD
        volume = site.point.volume_head if head else site.point.volume_rod
        logs.append(math.log(swing(site) * volume / _stiffness(site)[0 if head else 1]))
    return math.exp(float(np.mean(logs)))


def swing(site: Site) -> float:
    """Natural frequency [rad/s] between two shut chambers: ω² = (β1 A1²/V1 + β2 A2²/V2)/m_eq."""
    (head, rod), point = _stiffness(site), site.point
    spring = site.circuit.area_head**2 / point.volume_head
    spring += rod / head * (site.circuit.area_rod**2 / point.volume_rod)
    return math.sqrt(head * spring / point.mass)


def _stiffness(site: Site) -> tuple[float, float]:
    """Bulk moduli [Pa] of the oil in the head and in the rod end."""
    row, point = site.model.plant.cylinders[site.circuit.cylinder], site.point
    return bulk_of(row, point.p_head), bulk_of(row, point.p_rod)


def worst_damping(sites: Sequence[Site], law: Law, gains: np.ndarray) -> np.ndarray:
    """Least damping ratio over the points at each gain."""
    worst = np.ones(gains.size)
    for site in sites:
        worst = np.minimum(worst, site.loop(law).damping_ratio(gains))
    return worst


def best_gain(sites: Sequence[Site], law: Law, gains: np.ndarray) -> tuple[float, float]:
    """(largest worst damping ratio, its gain)."""
    loops = [site.loop(law) for site in sites]
    worst = np.minimum(loops[0].damping_ratio(gains), 1.0)
    # what the best gain at the first point gives at all of them: those that give less are left out
    likely = float(gains[worst.argmax()])
    minimum = min(float(loop.damping_ratio(likely)) for loop in loops) - 1e-9
    left, worst = gains[worst >= minimum], worst[worst >= minimum]
    for loop in loops[1:]:
        worst = np.minimum(worst, loop.damping_ratio(left))
        left, worst = left[worst >= minimum], worst[worst >= minimum]
    return float(worst.max()), float(left[worst.argmax()])


def _reaches(sites: list[Site], law: Law, gains: np.ndarray, least: float) -> bool:
    """Whether some gain gives every point at least this damping ratio. Moves a point that refuses
    all gains to the front.
    """
    left = gains
    for i, site in enumerate(sites):
        left = left[site.loop(law).damping_ratio(left) >= least]
        if not left.size:
            sites.insert(0, sites.pop(i))  # the likeliest to refuse the next law
            return False
    return True


class LawSearch:
    """The search for washouts and off-side gain over operating points.

    Args:
        sites: that count.
        recipe: what is given and demanded.
        gains: that are looked at [m³/(s·Pa)], half of them here.
        scale: the gain that makes a chamber as fast as its load swings.
    """

    def __init__(
        self, sites: Sequence[Site], recipe: TuneRecipe, gains: np.ndarray, scale: float
    ) -> None:
        self.sites, self.gains, self.delay = sites, gains[::2], float(recipe.delay)
        self.least = HEADROOM * float(recipe.damping_ratio)
        self.free = recipe.washout is None
        slowest = min(swing(site) for site in sites)
        self.corners = [slowest * share for share in CORNER_SHARES]
        if recipe.washout is not None:
            self.corners = [float(recipe.washout)]
        self.single = recipe.ramp_washout is not None
        self.ramp = 0.0 if recipe.ramp_washout is None else float(recipe.ramp_washout)
        # one command for both ends: nothing to hold
        fixed = Law(self.corners[0], scale, self.delay)
        self.shared = not any(site.loop(fixed).off.any() for site in sites)
        self.offs = [scale * share for share in OFF_SHARES]
        if recipe.off_gain is not None:
            self.offs = [float(recipe.off_gain)]
        elif self.shared:
            self.offs = [0.0]
        self._queue = list(sites)  # those that refused a law lately go first
        self._known: dict[Law, tuple[float, float]] = {}  # `best_of` each law that was looked at

    def law(self) -> Law:
        """The law with washouts and off-side gain as given, or found.

        Two washouts of one corner, or a single one where they would be slower than PAIR_SHARE of
        it: the fastest with which some off-side gain and K_p reach HEADROOM of the target: the
        faster they forget, the less a load that changes slows the motion."""
        law = self._fastest([(c, self.ramp) for c in self.corners]) if self.free else None
        if law is not None and not self.single:
            slowest = PAIR_SHARE * law.washout
            law = self._fastest([(c, c) for c in self.corners if c >= slowest]) or law
        return law or self._compromise()

    def best_of(self, law: Law) -> tuple[float, float]:
        """(largest worst damping ratio of a law, its gain)."""
        if law not in self._known:
            self._known[law] = best_gain(self.sites, law, self.gains)
        return self._known[law]

    def _best(self, laws: Sequence[Law]) -> Law:
        return max(laws, key=lambda law: self.best_of(law)[0]) if len(laws) > 1 else laws[0]

    def _reaching(self, corner: float, ramp: float) -> Law | None:
        """The best law with these washouts that reaches the target; None where none does."""
        laws = [Law(corner, off, self.delay, ramp) for off in self.offs]
        able = [law for law in laws if _reaches(self._queue, law, self.gains, self.least)]
        return self._best(able) if able else None

    def _fastest(self, washouts: Sequence[tuple[float, float]]) -> Law | None:
        """Of washouts that get slower, the first that reaches the target, then closer in by
        bisection.
        """
        faster_corner = 0.0
        for corner, ramp in washouts:
            law = self._reaching(corner, ramp)
            if law is None:
                faster_corner = corner
                continue
            for _ in range(BISECTIONS if faster_corner > 0.0 else 0):
                middle = math.sqrt(law.washout * faster_corner)
                closer = self._reaching(middle, middle if ramp == corner else ramp)
                if closer is None:
                    faster_corner = middle
                else:
                    law = closer
            return law
        return None

    def _compromise(self) -> Law:
        """Where nothing reaches the target: in turns the off-side gain with the best worst case,
        and the fastest single washout that keeps NEARLY of the best one's.
        """
        law = Law(self.corners[-1], self.offs[0], self.delay, self.ramp)
        for _ in range(2 if len(self.corners) > 1 and len(self.offs) > 1 else 1):
            law = self._best([replace(law, off_gain=off) for off in self.offs])
            worst = {c: self.best_of(replace(law, washout=c))[0] for c in self.corners}
            enough = NEARLY * max(worst.values())
            law = replace(law, washout=max(c for c, value in worst.items() if value >= enough))
        return law

    def alternatives(self, law: Law) -> tuple[Alternative, ...]:
        """What a law was weighed against, each at its own best gain; the law itself first."""
        tried = {what: (self.best_of(other), other) for what, other in self._others(law).items()}
        quick = [replace(site, linear=faster(site.linear, 10.0)) for site in self.sites]
        tried["valves ten times as fast"] = best_gain(quick, law, self.gains), law
        return tuple(
            Alternative(what, o.washout, o.ramp_washout, o.off_gain, o.feedback, gain, value)
            for what, ((value, gain), o) in tried.items()
        )

    def _others(self, law: Law) -> dict[str, Law]:
        washout, ramp, off = law.washout, law.ramp_washout, law.off_gain
        others = {"chosen law": law}
        if washout > 0.0:
            others["no washout"] = replace(law, washout=0.0, ramp_washout=0.0)
        if ramp != 0.0:
            others["one washout"] = replace(law, ramp_washout=0.0)
        elif washout > 0.0:
            others["two washouts"] = replace(law, ramp_washout=washout)
        if washout > 0.0:
            others["washout four times as fast"] = replace(
                law, washout=4 * washout, ramp_washout=4 * ramp
            )
        others["load force fed back"] = replace(law, feedback="load")
        if not self.shared:
            others["off-side a fifth as stiff"] = replace(law, off_gain=0.2 * off)
            others["off-side five times as stiff"] = replace(law, off_gain=5 * off)
        others["no delay"] = replace(law, delay=0.0)
        return others


def choose_gain(
    sites: Sequence[Site], law: Law, gains: np.ndarray, demands: dict[str, float], notes: list[str]
) -> float:
    """The gain with the best worst case among those that keep the demands at every point; the best
    of all where none does. What the demands cost goes to ``notes``.
    """
    worst = worst_damping(sites, law, gains)
    order = np.argsort(-worst, kind="stable")
    loops = [site.loop(law) for site in sites]
    fine, damping = _between(sites, law, gains, int(order[0]))
    candidates = [fine, *(float(gains[i]) for i in order if worst[i] > worst[0])]
    chosen = next((gain for gain in candidates if _kept(loops, gain, demands)), None)
    if chosen == fine:
        return fine
    broken = ", ".join(
        sorted({v for loop in loops for v in violations(margins(loop, fine), demands)})
    )
    if chosen is None:
        notes.append(
            f"no gain keeps the demanded {broken} at every operating point and adds damping; the "
            "best damped gain is taken"
        )
        return fine
    notes.append(
        f"the demanded {broken} holds the gain at {chosen / fine:.0%} of the best damped one, "
        f"which would give a worst damping ratio of {damping:.2f}"
    )
    return chosen


def _between(sites: Sequence[Site], law: Law, gains: np.ndarray, best: int) -> tuple[float, float]:
    """(best damped gain, its worst damping ratio) between the neighbours of the best of a grid."""
    from scipy.optimize import minimize_scalar

    ends = gains[[max(best - 1, 1), min(max(best + 1, 2), gains.size - 1)]]
    fine = minimize_scalar(
        lambda z: -float(worst_damping(sites, law, np.array([math.exp(z)]))[0]),
        bounds=tuple(np.log(ends)),
        method="bounded",
        options={"xatol": 1e-3},
    )
    return float(math.exp(fine.x)), float(-fine.fun)


def _kept(loops: list[Loop], gain: float, demands: dict[str, float]) -> bool:
    """Whether every loop keeps the demands at a gain. Moves one that does not to the front: it is
    the likeliest to refuse the next.
    """
    for i, loop in enumerate(loops):
        if violations(margins(loop, gain), demands):
            loops.insert(0, loops.pop(i))
            return False
    return True
