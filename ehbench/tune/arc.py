"""The bandwidths of the adaptive robust controller: the fastest that keep margins at every
operating point of the whole sampled loop (`ehbench.tune.arc_loop`)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ehbench.config.recipe import ArcTuneRecipe
from ehbench.control.arc_gains import ARC_GAINS, named_gains, pack_arc
from ehbench.control.functions import pack_rules
from ehbench.control.law import DesignPoint
from ehbench.plant.design_point import circuit_of, design_point_of
from ehbench.plant.model import Model
from ehbench.tune.arc_loop import ARC_LOOP, ArcLoop, LoopMargins, SampledPlant, Sensing
from ehbench.tune.study import Study, rail_notes
from ehbench.vocabulary import InsufficientData, Message, Progress, message, setting


@dataclass(frozen=True)
class ArcSearchSettings:
    """Numbers of the search for bandwidths; a budget is a phase over the loop's lag."""

    budgets: tuple = setting((0.08, 1.2, 12), "rad", "smallest, largest and count", "a decade")
    refinements: int = setting(3, "", "bisections of the best budget", "an eighth of a step")


ARC_SEARCH = ArcSearchSettings()
# gains that a trial takes from a tuning
CHOSEN = (
    *("position_bandwidth", "speed_bandwidth", "force_bandwidth", "observer_bandwidth"),
    *("pressure_bandwidth", "robust_limit", "adaptation", "low_pressure", "stroke_resolution"),
)


@dataclass(frozen=True)
class ArcPoint:
    """An operating point and its margins; ``delay_margin`` [s] as stated, ``frequency`` [rad/s] of
    its swing."""

    name: str
    function: str
    payload: str
    x: float
    v: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    frequency: float


@dataclass(frozen=True)
class ArcCandidate:
    """Margins at the worst points for a ``sum`` of bandwidths [rad/s]; ``met``: all demands
    hold."""

    sum: float
    gain_margin: float
    phase_margin: float
    delay_margin: float
    met: bool


@dataclass(frozen=True)
class ArcTuning:
    """Gains of the adaptive robust controller, SI, and what they rest on; ``tick``, ``delay`` and
    ``pressure_lag`` [s], ``supply`` by `ehbench.config.rig.Supply.facts`.

    ``constraints`` are demanded, ``gain_margin``, ``phase_margin`` [rad] and ``delay_margin`` [s],
    stated, reached at the worst points. ``locus`` of the worst point by delay: the characteristic
    loci as (real, imaginary) lists, each ending the loop's stability where it passes −1."""

    rig: str
    supply: dict[str, Any]
    cylinder: str
    gains: dict[str, float]
    tick: float
    delay: float
    pressure_lag: float
    safety: float
    constraints: dict[str, float]
    gain_margin: float
    phase_margin: float
    delay_margin: float
    met: bool
    candidates: tuple[ArcCandidate, ...]
    points: tuple[ArcPoint, ...]
    worst: str
    locus: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
    warnings: tuple[Message, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values; the gains stand at the top, where trials look for them."""
        return {"what": "arc", **self.gains, **asdict(self)}


class Search:
    """The loop over operating points, for any sum of bandwidths; ``plants`` are the steady motions
    in whose working function the controller stays.

    Raises:
        InsufficientData: there is none."""

    def __init__(self, study: Study[ArcTuneRecipe]) -> None:
        recipe = study.recipe
        self.sensing = Sensing(float(recipe.delay), float(recipe.pressure_lag))
        self.demands = {
            name: float(getattr(recipe, name))
            for name in ("gain_margin", "phase_margin", "delay_margin")
        }
        design = Model.of(study.rig, study.maps)
        circuit = circuit_of(design, design.layout.cylinders.index(study.cylinder), study.maps)
        posture = design.posture(recipe.posture)
        self.design_point: DesignPoint = design_point_of(
            design, circuit, posture, 1.0 / float(recipe.rate)
        )
        self.rules = pack_rules(circuit.area_rod, self.design_point.supply_pressure)
        self.sensor = {"stroke_resolution": float(recipe.stroke_resolution)}
        usual = self.gains(ARC_GAINS.budget)[0]
        result = (
            SampledPlant.of(motion.model, motion.point, self.design_point.tick)
            for motion in study.motions
            if motion.counts
        )
        self.plants = [item for item in result if item.stays(self.design_point, usual)]
        if not self.plants:
            raise InsufficientData(message("tune.other_function", cylinder=study.cylinder))

    @property
    def lag(self) -> float:
        """What a budget is over [s]: the slowest valve's lag and a tick."""
        return self.design_point.valve_lag + self.design_point.tick

    def gains(self, budget: float) -> tuple[np.record, np.ndarray]:
        """The gains for a phase budget [rad], and the rates of adaptation at 1 rad/s."""
        return pack_arc(self.design_point, self.rules, {"lag_budget": budget} | self.sensor)

    def loops(self, budget: float) -> list[ArcLoop]:
        """The loop at every operating point."""
        gains, _ = self.gains(budget)
        return [plant.loop(self.design_point, gains) for plant in self.plants]

    def candidate(self, budget: float) -> ArcCandidate:
        """The margins at the worst points."""
        results = [loop.margins(self.sensing) for loop in self.loops(budget)]
        return self.judged(budget, results)

    def judged(self, budget: float, result: Sequence[LoopMargins]) -> ArcCandidate:
        """A candidate, from its margins at all points."""
        worst = {
            "gain_margin": min(item.stated_gain for item in result),
            "phase_margin": min(item.phase for item in result),
            "delay_margin": min(item.stated for item in result),
        }
        return ArcCandidate(sum=budget / self.lag, met=self.share(worst) >= 1.0, **worst)

    def share(self, margins: Mapping[str, float]) -> float:
        """The smallest margin as a share of its demand; 1 keeps them all."""
        return min(margins[name] / demand for name, demand in self.demands.items() if demand > 0.0)


def tune_arc(study: Study[ArcTuneRecipe], progress: Progress | None = None) -> ArcTuning:
    """Choose the bandwidths over the operating points of a study.

    The largest sum of bandwidths that keeps the demands at every point; where none does, the one
    that comes closest, by the margin that is the smallest share of its demand.

    Args:
        study: of `ehbench.tune.study.prepare_tuning`.
        progress: called with the step at work and the share done.

    Raises:
        InsufficientData: no operating point in whose working function the controller stays."""
    report = progress or (lambda what, share: None)
    search = Search(study)
    tried: dict[float, ArcCandidate] = {}
    budgets = np.geomspace(*ARC_SEARCH.budgets).tolist()
    for i, budget in enumerate(budgets):
        report("margins", 0.9 * i / len(budgets))
        tried[budget] = search.candidate(budget)
    passing = [budget for budget, item in tried.items() if item.met]
    budget = max(passing or tried, key=lambda b: b if passing else search.share(vars(tried[b])))
    beyond = min((other for other in tried if other > budget), default=budget)
    for _ in range(ARC_SEARCH.refinements if passing and beyond > budget else 0):
        middle = math.sqrt(budget * beyond)
        tried[middle] = search.candidate(middle)
        budget, beyond = (middle, beyond) if tried[middle].met else (budget, middle)
    report("margins chosen", 0.9)
    return _result(study, search, budget, tried)


def _result(
    study: Study, search: Search, budget: float, tried: dict[float, ArcCandidate]
) -> ArcTuning:
    loops = search.loops(budget)
    results = [loop.margins(search.sensing) for loop in loops]
    worst = min(range(len(results)), key=lambda i: results[i].delay)
    named = named_gains(*search.gains(budget))["gains"]
    chosen, points = search.judged(budget, results), [plant.point for plant in search.plants]
    warnings = rail_notes(study.rig, points)
    if not chosen.met:
        missed = [k for k, demand in search.demands.items() if getattr(chosen, k) < demand]
        words = " and ".join(name.replace("_", " ") for name in missed)
        shares = [search.share(vars(search.judged(budget, [item]))) for item in results]
        point = points[shares.index(min(shares))].name
        warnings.append(message("tune.missed_margins", margins=words, point=point))
    _, loci = loops[worst].loci(search.sensing)
    return ArcTuning(
        rig=study.rig.name,
        supply=study.rig.supply.facts(),
        cylinder=study.cylinder,
        gains={name: float(named[name]) for name in CHOSEN},
        delay=search.sensing.delay,
        tick=search.design_point.tick,
        pressure_lag=search.sensing.lag,
        safety=ARC_LOOP.safety,
        constraints=search.demands,
        gain_margin=chosen.gain_margin,
        phase_margin=chosen.phase_margin,
        delay_margin=chosen.delay_margin,
        met=chosen.met,
        candidates=tuple(tried[key] for key in sorted(tried)),
        points=tuple(
            ArcPoint(
                *(p.name, p.function, p.payload, p.x, p.v),
                *(m.stated_gain, m.phase, m.stated, m.frequency),
            )
            for p, m in zip(points, results, strict=True)
        ),
        worst=points[worst].name,
        locus=tuple(
            (tuple((-item.real).tolist()), tuple((-item.imag).tolist())) for item in loci.T
        ),
        warnings=tuple(warnings),
    )
