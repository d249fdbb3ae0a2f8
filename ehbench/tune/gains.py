"""The gain of the pressure feedback: root locus, margins, the best worst case over operating
points, its share over draws.

Gains are chosen on `ehbench.tune.linear` models: the gain with the largest least damping ratio over
all operating points, of those that keep the stated gain margin, phase margin and bandwidth at every
one of them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np

from ehbench.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.control.functions import HEAD, METERED, Circuit
from ehbench.errors import InputError, InsufficientData, ModelRejected
from ehbench.parts.oil import bulk_of
from ehbench.plant.build import Maps
from ehbench.plant.model import Model
from ehbench.quantities import VOCABULARY
from ehbench.recipe import TuneRecipe
from ehbench.rig import Rig, read_value
from ehbench.tune.linear import (
    AT_ZERO,
    Law,
    LinearModel,
    Loop,
    OperatingPoint,
    circuit_of,
    close,
    damping_ratio,
    development_model,
    dominant,
    equivalent,
    faster,
    operating_point,
)

NONE = "none"  # the payload's name where there is none
GAIN_SPAN = 100.0  # gains looked at: this factor below and above the one that makes a chamber as fast as its load swings
GAIN_POINTS = 81
CORNER_SHARES = tuple(
    np.geomspace(2.5, 0.02, 22).tolist()
)  # washout corners tried, of the slowest natural frequency, the fastest first
OFF_SHARES = (
    0.1,
    0.2,
    0.4,
    0.7,
    1.0,
    1.5,
    2.5,
    5.0,
)  # off-side gains tried, of the gain that makes a chamber as fast as its load
HEADROOM = 1.1  # what is found shall reach this much of the target, so that parameters a little off reach it as well
BISECTIONS = 4  # between the fastest washout corner that reaches the target and the next faster one
PAIR_SHARE = 0.25  # two washouts forget a load that ramps sooner than a single one, unless they are slower than this share of its corner
NEARLY = 0.95  # where nothing does, a faster washout may cost this share of the damping ratio that a slower one gives
WORST_POINTS = 24  # draws are judged at this many operating points, the least damped ones
POSTURES = 41  # of the curves of equivalent mass and gravity
LOCUS_POINTS = 240
STEP_SAMPLES = 201
DIGITS = 9  # of the numbers in the file
Progress = Callable[[str, float], None]


class Machine(Protocol):
    """What tuning needs of a validated rig."""

    @property
    def rig(self) -> Rig: ...

    @property
    def flow_maps(self) -> Maps | None: ...


@dataclass(frozen=True)
class Margins:
    """``gain_margin`` (factor), ``phase_margin`` [rad], the least of the feedback loop and the
    off-side's, each with the other closed; ``bandwidth`` [rad/s] of speed over desired speed, −3
    dB."""

    gain_margin: float
    phase_margin: float
    bandwidth: float


@dataclass(frozen=True)
class PointResult:
    """One operating point. Poles [rad/s] as (real, imaginary); ``curve`` is the least damping ratio
    over ``Tuning.gains``.

    ``counts``: the gain was chosen on it. Others are shown only: no load makes the controller use
    that function there. ``open``: no pressure feedback, off-side held. ``natural_frequency_*``
    [rad/s] and ``damping_ratio_*`` of the least damped pair. ``gain_limit`` [m³/(s·Pa)]: where the
    loop becomes unstable, inf if not in the range looked at. ``bias`` [m/s]: what feedback without
    a washout would take from the steady speed, and ``damping_ratio_plain`` what it would reach."""

    name: str
    point: OperatingPoint
    counts: bool
    open_poles: tuple[tuple[float, float], ...]
    closed_poles: tuple[tuple[float, float], ...]
    natural_frequency_open: float
    natural_frequency_closed: float
    damping_ratio_open: float
    damping_ratio_closed: float
    damping_ratio_plain: float
    bias: float
    gain_limit: float
    margins: Margins
    curve: tuple[float, ...]


@dataclass(frozen=True)
class Locus:
    """A root locus at one operating point: poles [rad/s], shape (parameters, poles), over
    ``parameter``, ``feedback_gain`` or ``washout``.

    ``chosen`` the parameter used and its poles; ``crossing`` the parameter at the stability limit
    and its poles there, None where it has none; ``frame`` (least real, most real, most imaginary
    part) that shows the poles that matter."""

    name: str
    parameter: str
    values: tuple[float, ...]
    real: tuple[tuple[float, ...], ...]
    imag: tuple[tuple[float, ...], ...]
    chosen: float
    chosen_poles: tuple[tuple[float, float], ...]
    crossing: float | None
    crossing_poles: tuple[tuple[float, float], ...]
    frame: tuple[float, float, float]


@dataclass(frozen=True)
class StepResponse:
    """Speed [m/s] after a step of 1 m/s in desired speed, without and with pressure feedback, over
    ``t`` [s].
    """

    name: str
    t: tuple[float, ...]
    v_open: tuple[float, ...]
    v_closed: tuple[float, ...]


@dataclass(frozen=True)
class Alternative:
    """Another law at its own best gain: its least damping ratio over the operating points that
    count.
    """

    what: str
    washout: float
    ramp_washout: float
    off_gain: float
    feedback: str
    feedback_gain: float
    damping_ratio: float


@dataclass(frozen=True)
class Curves:
    """Equivalent mass, gravity force and damping over the stroke, for one payload (thesis B.1–B.4)."""

    payload: str
    x: tuple[float, ...]
    q: tuple[float, ...]
    mass: tuple[float, ...]
    gravity_force: tuple[float, ...]
    damping: tuple[float, ...]


@dataclass(frozen=True)
class Robustness:
    """Draws of the identified parameters: the share that reaches the target, and the range of the
    worst damping ratio (5, 50, 95 %).

    ``points``: how many operating points, the least damped ones, each draw was judged at.
    """

    draws: int
    parameters: tuple[str, ...]
    points: int
    share: float | None
    quantiles: tuple[float, ...]
    damping_ratios: tuple[float, ...]


@dataclass(frozen=True)
class Tuning:
    """Gains of the pressure feedback and what they rest on; all SI.

    ``feedback_gain`` K_p [m³/(s·Pa)] by working function, ``washout`` ω_w and ``ramp_washout`` ω_r
    [rad/s] (0 for none), ``off_gain`` [m³/(s·Pa)], ``low_pressure`` and ``cross_drop`` [Pa],
    ``tick`` and ``delay`` [s]. ``damping_ratio`` the least over the operating points that count,
    ``damping_ratio_open`` without feedback. ``met``: target and constraints hold at each of them.
    ``gains`` the abscissa of the curves."""

    rig: str
    cylinder: str
    feedback_gain: dict[str, float]
    washout: float
    ramp_washout: float
    off_gain: float
    low_pressure: float
    cross_drop: float
    tick: float
    delay: float
    target: float
    damping_ratio: float
    damping_ratio_open: float
    damping_ratio_open_most: float
    met: bool
    constraints: dict[str, float]
    gains: tuple[float, ...]
    worst_curve: tuple[float, ...]
    points: tuple[PointResult, ...]
    equivalents: tuple[Curves, ...]
    loci: tuple[Locus, ...]
    steps: tuple[StepResponse, ...]
    alternatives: tuple[Alternative, ...]
    robustness: Robustness
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain numbers, texts and lists, for `rundir.write_json`; numbers to DIGITS digits."""
        return _rounded(asdict(self))

    def controller(self) -> dict[str, Any]:
        """Keywords for `ehbench.control.pressure_feedback.pack_pressure_feedback`."""
        return {
            "tick": self.tick,
            "feedback_gain": self.feedback_gain,
            "washout": self.washout,
            "ramp_washout": self.ramp_washout,
            "off_gain": self.off_gain,
            "low_pressure": self.low_pressure,
        }


@dataclass(frozen=True)
class _Site:
    """An operating point with what is needed to close loops about it."""

    model: Model
    circuit: Circuit
    point: OperatingPoint
    linear: LinearModel
    counts: bool

    def loop(self, law: Law) -> Loop:
        return close(self.linear, self.point, self.circuit, law)


def tune_pressure_feedback(
    machine: Machine,
    recipe: TuneRecipe,
    *,
    validated: type | None = None,
    correlation: tuple[Sequence[str], Any] | None = None,
    progress: Progress | None = None,
) -> Tuning:
    """Choose the gains of the pressure feedback of one cylinder on a validated rig.

    Args:
        machine: the validated rig, with ``rig`` and ``flow_maps``.
        recipe: what to look at and what to demand.
        validated: the type that only validation makes; None where the user said that an unvalidated
            rig will do.
        correlation: (names, matrix) of the identified parameters; those not named are drawn
            independently.
        progress: told what is at work and the share done.

    Raises:
        ModelRejected: the machine is not ``validated``.
        InputError: no such cylinder, payload, function or posture.
        InsufficientData: no operating point at which a function can work.
    """
    if progress is not None:
        progress("operating points", 0.0)
    study = prepare_tuning(machine, recipe, validated=validated)
    return tune_prepared(study, correlation=correlation, progress=progress)


@dataclass(frozen=True)
class Study:
    """What is tuned on: every operating point, linearised, with what is known without a search.

    ``low`` and ``cross`` [Pa] as in `Tuning`, ``notes`` what is odd about the points."""

    rig: Rig
    maps: Maps | None
    recipe: TuneRecipe
    cylinder: str
    low: float
    cross: float
    sites: tuple[_Site, ...]
    curves: tuple[Curves, ...]
    notes: tuple[str, ...]


def prepare_tuning(machine: Machine, recipe: TuneRecipe, *, validated: type | None = None) -> Study:
    """Find the operating points; arguments and errors as in `tune_pressure_feedback`."""
    if validated is not None and not isinstance(machine, validated):
        raise ModelRejected(
            f"rig '{machine.rig.name}' was not validated, and gains are tuned on validated rigs only",
            hint="run a validate recipe on it first",
        )
    rig, maps = machine.rig, machine.flow_maps
    name = recipe.cylinder or rig.cylinder[0].name
    if recipe.cylinder is None and len(rig.cylinder) > 1:
        raise InputError(
            "the rig has several cylinders",
            hint="name one with cylinder = " + ", ".join(f'"{c.name}"' for c in rig.cylinder),
        )
    rig.cylinder_named(name)
    supply = float(rig.supply.pressure)
    low = supply / 20.0 if recipe.low_pressure is None else float(recipe.low_pressure)
    cross = supply / 20.0 if recipe.cross_drop is None else float(recipe.cross_drop)
    notes: list[str] = []
    sites, curves = _sites(rig, maps, recipe, name, low, cross, notes)
    return Study(rig, maps, recipe, name, low, cross, tuple(sites), curves, tuple(notes))


def tune_prepared(
    study: Study,
    *,
    correlation: tuple[Sequence[str], Any] | None = None,
    progress: Progress | None = None,
) -> Tuning:
    """Search the gains over what `prepare_tuning` found; as in `tune_pressure_feedback`."""
    tell = progress or (lambda what, share: None)
    rig, maps, recipe, name = study.rig, study.maps, study.recipe, study.cylinder
    low, cross, sites, curves = study.low, study.cross, study.sites, study.curves
    notes = list(study.notes)
    counted = [site for site in sites if site.counts]
    scale = _natural_gain(counted)
    gains = np.concatenate([[0.0], np.geomspace(scale / GAIN_SPAN, scale * GAIN_SPAN, GAIN_POINTS)])
    tell("washout and off-side gain", 0.1)
    law, tried = _law(counted, recipe, gains, scale)
    tell("gain", 0.35)
    groups = {"": counted} if recipe.one_gain else _by_function(counted)
    demands = {key: float(getattr(recipe, key)) for key in ("gain_margin", "phase_margin")}
    demands["bandwidth"] = 2.0 * math.pi * float(recipe.bandwidth)
    chosen = {key: _choose(group, law, gains, demands, notes) for key, group in groups.items()}
    worst_case = min(chosen.values())
    by_function = {
        f: chosen.get(f, chosen.get("", worst_case))
        for f in dict.fromkeys(s.point.function for s in sites)
    }
    tell("margins", 0.5)
    results = tuple(_result(site, law, by_function[site.point.function], gains) for site in sites)
    counting = [r for r in results if r.counts]
    damping = min(r.damping_ratio_closed for r in counting)
    target = float(recipe.damping_ratio)
    if damping < target:
        worst = min(counting, key=lambda r: r.damping_ratio_closed)
        notes.append(
            f"the worst damping ratio is {damping:.2f}, below the target {target:.2f}: {worst.name}"
        )
    met = damping >= target and not any(_violations(r.margins, demands) for r in counting)
    tell("root loci", 0.65)
    shown = _shown(results)
    loci = tuple(
        locus(
            sites[i].loop(law),
            sites[i],
            law,
            by_function[sites[i].point.function],
            parameter,
            results[i].gain_limit,
        )
        for i in shown
        for parameter in (("feedback_gain", "washout") if law.washout > 0 else ("feedback_gain",))
    )
    steps = tuple(
        _step(sites[i].loop(law), results[i], by_function[sites[i].point.function]) for i in shown
    )
    tell("draws", 0.75)
    robustness = _robustness(
        rig,
        maps,
        recipe,
        sites,
        results,
        law,
        by_function,
        (low, cross),
        correlation,
        target,
        notes,
        tell,
    )
    return Tuning(
        rig=rig.name,
        cylinder=name,
        feedback_gain=by_function,
        washout=law.washout,
        ramp_washout=law.ramp_washout,
        off_gain=law.off_gain,
        low_pressure=low,
        cross_drop=cross,
        tick=1.0 / float(recipe.rate),
        delay=law.delay,
        target=target,
        damping_ratio=damping,
        damping_ratio_open=min(r.damping_ratio_open for r in counting),
        damping_ratio_open_most=max(r.damping_ratio_open for r in counting),
        met=met,
        constraints=demands,
        gains=tuple(gains.tolist()),
        worst_curve=tuple(np.min([r.curve for r in counting], axis=0).tolist()),
        points=results,
        equivalents=curves,
        loci=loci,
        steps=steps,
        alternatives=tuple(tried),
        robustness=robustness,
        warnings=tuple(dict.fromkeys(notes)),
    )


def _sites(
    rig: Rig,
    maps: Maps | None,
    recipe: TuneRecipe,
    name: str,
    low: float,
    cross: float,
    notes: list[str],
):
    """Every operating point that is possible, and the curves of equivalent mass and gravity of
    every payload.
    """
    for function in recipe.functions:
        if function not in FUNCTIONS[1:]:
            raise InputError(
                f"no working function '{function}'", hint="there are " + ", ".join(FUNCTIONS[1:])
            )
    payloads = recipe.payloads or (NONE, *rig.payload)
    wanted = [FUNCTIONS.index(f) for f in recipe.functions] or range(
        1, EXTEND_RESISTIVE_REGENERATION
    )
    sites, curves = [], []
    for payload in payloads:
        model = Model.of(rig, maps, None if payload == NONE else payload)
        cylinder = model.layout.cylinders.index(name)
        stroke = model.plant.cylinders[cylinder].stroke
        shown = equivalent(model, cylinder, np.linspace(0.0, stroke, POSTURES), recipe.posture)
        curves.append(
            Curves(
                payload,
                *(
                    tuple(a.tolist())
                    for a in (shown.x, shown.q, shown.mass, shown.gravity_force, shown.damping)
                ),
            )
        )
        here = equivalent(model, cylinder, _strokes(recipe, stroke), recipe.posture)
        circuit = circuit_of(model, cylinder, maps)
        for function in wanted:
            if circuit.able[function] == 0:
                if recipe.functions:
                    raise InputError(
                        f"the valves of cylinder '{name}' are not able of '{FUNCTIONS[function]}'"
                    )
                continue
            for index in range(here.x.size):
                for share in recipe.speed_shares:
                    point = operating_point(
                        model,
                        circuit,
                        function,
                        here,
                        index,
                        share=share,
                        low_pressure=low,
                        cross_drop=cross,
                        payload=payload,
                        held=recipe.posture,
                    )
                    if point.possible and point.v != 0.0:
                        sites.append(
                            _Site(
                                model, circuit, point, development_model(model, point), point.fits
                            )
                        )
    # a function that no load calls for is shown, but no gain is chosen on it
    fitting = {site.point.function for site in sites if site.counts}
    lost = [
        FUNCTIONS[f]
        for f in wanted
        if recipe.functions and FUNCTIONS[f] not in {s.point.function for s in sites}
    ]
    notes += [f"{function} is possible at no operating point" for function in lost]
    sites = [site for site in sites if site.counts or site.point.function not in fitting]
    if not fitting:
        raise InsufficientData(
            f"no operating point of cylinder '{name}' calls for any of the functions asked for",
            hint="choose other functions, payloads or postures",
        )
    study = sorted({site.point.function for site in sites} - fitting)
    notes += [
        f"{function} is shown only: at no operating point does the load call for it"
        for function in study
    ]
    return sites, tuple(curves)


def _strokes(recipe: TuneRecipe, stroke: float) -> np.ndarray:
    if not recipe.strokes:
        return (
            np.linspace(0.1, 0.9, recipe.postures) * stroke
            if recipe.postures > 1
            else np.array([0.5 * stroke])
        )
    x = np.array([float(read_value(text, VOCABULARY["x"])) for text in recipe.strokes])
    if x.min() < 0 or x.max() > stroke:
        raise InputError(
            "a stroke to tune at lies outside the cylinder's", hint=f"0 to {stroke * 1e3:.1f} mm"
        )
    return x


def _by_function(sites: Sequence[_Site]) -> dict[str, list[_Site]]:
    groups: dict[str, list[_Site]] = {}
    for site in sites:
        groups.setdefault(site.point.function, []).append(site)
    return groups


def _natural_gain(sites: Sequence[_Site]) -> float:
    """Geometric mean over the points of ω_n V/β_e [m³/(s·Pa)]: the gain that makes the metered
    chamber as fast as the load swings."""
    logs = []
    for site in sites:
        head = METERED[FUNCTIONS.index(site.point.function)] == HEAD
        volume = site.point.volume_head if head else site.point.volume_rod
        logs.append(math.log(_swing(site) * volume / _stiffness(site)[0 if head else 1]))
    return math.exp(float(np.mean(logs)))


def _swing(site: _Site) -> float:
    """Natural frequency [rad/s] of the mass between two shut chambers: (β1 A1²/V1 + β2 A2²/V2)/m_eq."""
    (head, rod), point = _stiffness(site), site.point
    spring = site.circuit.area_head**2 / point.volume_head
    spring += rod / head * (site.circuit.area_rod**2 / point.volume_rod)
    return math.sqrt(head * spring / point.mass)


def _stiffness(site: _Site) -> tuple[float, float]:
    """Bulk moduli [Pa] of the oil in the head and in the rod end."""
    row, point = site.model.plant.cylinders[site.circuit.cylinder], site.point
    return bulk_of(row, point.p_head), bulk_of(row, point.p_rod)


def _worst(sites: Sequence[_Site], law: Law, gains: np.ndarray) -> np.ndarray:
    """Least damping ratio over the points at each gain."""
    worst = np.ones(gains.size)
    for site in sites:
        worst = np.minimum(worst, site.loop(law).damping_ratio(gains))
    return worst


def _best(sites: Sequence[_Site], law: Law, gains: np.ndarray) -> tuple[float, float]:
    """(largest worst damping ratio, its gain)."""
    worst = _worst(sites, law, gains)
    return float(worst.max()), float(gains[worst.argmax()])


def _reaches(sites: list[_Site], law: Law, gains: np.ndarray, least: float) -> bool:
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


def _law(
    sites: Sequence[_Site], recipe: TuneRecipe, gains: np.ndarray, scale: float
) -> tuple[Law, list[Alternative]]:
    """The law with washouts and off-side gain as given, or found; and what else was tried, each at
    its best gain.

    Two washouts of one corner, or a single one where they would be slower than PAIR_SHARE of it:
    the fastest with which some off-side gain and K_p reach HEADROOM of the target: the faster they
    forget, the less a load that changes slows the motion. Where none does, in turns the off-side
    gain with the best worst case, and the fastest single washout that keeps NEARLY of the best
    one's."""
    coarse, delay = gains[::2], float(recipe.delay)
    slowest = min(_swing(site) for site in sites)
    found = recipe.washout is None
    corners = [slowest * share for share in CORNER_SHARES] if found else [float(recipe.washout)]
    ramp = 0.0 if recipe.ramp_washout is None else float(recipe.ramp_washout)
    offs = (
        [scale * share for share in OFF_SHARES]
        if recipe.off_gain is None
        else [float(recipe.off_gain)]
    )
    # one command for both ends: nothing to hold
    shared = not any(site.loop(Law(corners[0], scale, delay)).off.any() for site in sites)
    if shared and recipe.off_gain is None:
        offs = [0.0]

    def best(laws: Sequence[Law]) -> Law:
        return max(laws, key=lambda law: _best(sites, law, coarse)[0]) if len(laws) > 1 else laws[0]

    queue = list(sites)

    def reached(corner: float, ramp: float) -> Law | None:
        laws = [Law(corner, off, delay, ramp) for off in offs]
        able = [
            law
            for law in laws
            if _reaches(queue, law, coarse, HEADROOM * float(recipe.damping_ratio))
        ]
        return best(able) if able else None

    def fastest(pairs: Sequence[tuple[float, float]]) -> Law | None:
        """Of corners that get slower, the first that reaches it, then closer in by bisection."""
        faster = None
        for corner, ramp in pairs:
            law = reached(corner, ramp)
            if law is None:
                faster = corner
                continue
            for _ in range(BISECTIONS if faster else 0):
                middle = math.sqrt(law.washout * faster)
                closer = reached(middle, middle if ramp == corner else ramp)
                law, faster = (closer, faster) if closer else (law, middle)
            return law
        return None

    law = fastest([(c, ramp) for c in corners]) if found else None
    if law is not None and recipe.ramp_washout is None:
        law = fastest([(c, c) for c in corners if c >= PAIR_SHARE * law.washout]) or law
    if law is None:
        law = Law(corners[-1], offs[0], delay, ramp)
        for _ in range(2 if len(corners) > 1 and len(offs) > 1 else 1):
            law = best([replace(law, off_gain=off) for off in offs])
            reached = {
                corner: _best(sites, replace(law, washout=corner), coarse)[0] for corner in corners
            }
            law = replace(
                law,
                washout=max(
                    c for c, value in reached.items() if value >= NEARLY * max(reached.values())
                ),
            )
    washout, off = law.washout, law.off_gain
    others = {
        "chosen law": law,
        "no washout": replace(law, washout=0.0, ramp_washout=0.0),
        "one washout": replace(law, ramp_washout=0.0),
        "two washouts": replace(law, ramp_washout=washout),
        "washout four times as fast": replace(
            law, washout=4 * washout, ramp_washout=4 * law.ramp_washout
        ),
        "load force fed back": replace(law, feedback="load"),
        "off-side a fifth as stiff": replace(law, off_gain=0.2 * off),
        "off-side five times as stiff": replace(law, off_gain=5 * off),
        "no delay": replace(law, delay=0.0),
    }
    del others["one washout" if law.ramp_washout == 0.0 else "two washouts"]
    if washout == 0.0:
        del others["no washout"], others["two washouts"], others["washout four times as fast"]
    if shared:
        del others["off-side a fifth as stiff"], others["off-side five times as stiff"]
    tried = {what: (_best(sites, other, coarse), other) for what, other in others.items()}
    quick = [replace(site, linear=faster(site.linear, 10.0)) for site in sites]
    tried["valves ten times as fast"] = _best(quick, law, coarse), law
    return law, [
        Alternative(what, o.washout, o.ramp_washout, o.off_gain, o.feedback, gain, value)
        for what, ((value, gain), o) in tried.items()
    ]


def _choose(
    sites: Sequence[_Site], law: Law, gains: np.ndarray, demands: dict[str, float], notes: list[str]
) -> float:
    """The gain with the best worst case among those that keep the demands at every point; the best
    of all where none does.
    """
    from scipy.optimize import minimize_scalar

    worst = _worst(sites, law, gains)
    order = np.argsort(-worst, kind="stable")
    at = int(order[0])
    loops = [site.loop(law) for site in sites]

    def kept(gain: float) -> bool:
        for i, loop in enumerate(loops):
            if _violations(margins(loop, gain), demands):
                loops.insert(
                    0, loops.pop(i)
                )  # the loop that refused one gain is the likeliest to refuse the next
                return False
        return True

    fine = minimize_scalar(
        lambda z: -float(_worst(sites, law, np.array([math.exp(z)]))[0]),
        bounds=tuple(np.log(gains[[max(at - 1, 1), min(max(at + 1, 2), gains.size - 1)]])),
        method="bounded",
        options={"xatol": 1e-3},
    )
    candidates = [float(math.exp(fine.x)), *(float(gains[i]) for i in order if worst[i] > worst[0])]
    for gain in candidates:
        if kept(gain):
            if gain != candidates[0]:
                broken = sorted(
                    {
                        v
                        for loop in loops
                        for v in _violations(margins(loop, candidates[0]), demands)
                    }
                )
                notes.append(
                    f"the demanded {', '.join(broken)} holds the gain at {gain / candidates[0]:.0%} of the best damped one, "
                    f"which would give a worst damping ratio of {-fine.fun:.2f}"
                )
            return gain
    broken = sorted(
        {v for loop in loops for v in _violations(margins(loop, candidates[0]), demands)}
    )
    notes.append(
        f"no gain keeps the demanded {', '.join(broken)} at every operating point and adds damping; the best damped gain is taken"
    )
    return candidates[0]


def _violations(found: Margins, demands: dict[str, float]) -> list[str]:
    return [key.replace("_", " ") for key, least in demands.items() if getattr(found, key) < least]


def margins(loop: Loop, gain: float) -> Margins:
    """Margins of the feedback loop and of the off-side loop, each with the other closed, and
    bandwidth at a gain [m³/(s·Pa)].
    """
    least_gain, least_phase = math.inf, math.inf
    for system in _open_loops(loop, gain):
        g, p = _stability(system)
        least_gain, least_phase = min(least_gain, g), min(least_phase, p)
    return Margins(least_gain, least_phase, bandwidth(loop, gain))


def _system(a: np.ndarray, b: np.ndarray, c: np.ndarray):
    import control

    return control.ss(a, b[:, None], c[None, :], 0.0)


def _speed(loop: Loop, gain: float):
    """Speed over desired speed."""
    return _system(loop.closed(gain), loop.d, np.eye(loop.a.shape[0])[0])


def _open_loops(loop: Loop, gain: float) -> list:
    """Loop transfer functions of the feedback, and of the off-side pressure control if there is
    one.
    """
    systems = [_system(loop.a, gain * loop.b, -loop.c)] if gain > 0 else []
    u, s, v = np.linalg.svd(loop.off)
    if s[0] > 0:
        systems.append(_system(loop.closed(gain) - loop.off, s[0] * u[:, 0], -v[0]))
    return systems


def _stability(system) -> tuple[float, float]:
    """(gain margin as a factor, phase margin [rad]); inf where there is none, 0 where the closed
    loop is unstable.
    """
    import control

    closed = np.linalg.eigvals(system.A - system.B @ system.C)
    if damping_ratio(closed) < 0.0:
        return 0.0, 0.0
    with warnings.catch_warnings():
        # python-control looks for roots of polynomials of widely spread coefficients, and says so
        warnings.filterwarnings(
            "ignore",
            message=".*(ill-conditioned|badly conditioned|overflow|divide by zero|invalid value).*",
        )
        gains, phases, _, crossings, _, _ = control.stability_margins(system, returnall=True)
    up = [g for g in np.atleast_1d(gains) if g > 1.0]
    return min(up, default=math.inf), math.radians(
        min(np.abs(np.atleast_1d(phases)), default=math.inf)
    )


def bandwidth(loop: Loop, gain: float) -> float:
    """First frequency [rad/s] at which speed over desired speed falls 3 dB below its value at
    standstill; inf if it does not.

    On a grid of 200 frequencies a decade pair, between them by interpolation; python-control does
    the same one by one."""
    a, n = loop.closed(gain), loop.a.shape[0]
    size = np.abs(np.linalg.eigvals(a))
    omega = np.geomspace(1e-2, 10.0, 400) * np.abs(
        dominant(np.linalg.eigvals(loop.a), loop.fastest)
    )
    grid = np.concatenate([[1e-3 * min(omega[0], size[size > 0].min())], omega])
    reply = np.linalg.solve(
        1j * grid[:, None, None] * np.eye(n) - a, np.broadcast_to(loop.d, (grid.size, n))[..., None]
    )[:, 0, 0]
    level = np.log(np.abs(reply) / np.abs(reply[0])) + 0.5 * math.log(2.0)
    below = np.flatnonzero(level < 0)
    if not below.size:
        return math.inf
    k = int(below[0])
    part = level[k - 1] / (level[k - 1] - level[k])
    return float(np.exp((1 - part) * np.log(grid[k - 1]) + part * np.log(grid[k])))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _pairs(poles: np.ndarray) -> tuple[tuple[float, float], ...]:
    order = np.lexsort((poles.imag, poles.real))
    return tuple((float(p.real), float(p.imag)) for p in poles[order])


def _result(site: _Site, law: Law, gain: float, gains: np.ndarray) -> PointResult:
    loop, point = site.loop(law), site.point
    opened, closed = np.linalg.eigvals(loop.a), np.linalg.eigvals(loop.closed(gain))
    plain = close(site.linear, point, site.circuit, replace(law, washout=0.0, ramp_washout=0.0))
    return PointResult(
        point.name,
        point,
        site.counts,
        _pairs(opened),
        _pairs(closed),
        abs(dominant(opened, loop.fastest)),
        abs(dominant(closed, loop.fastest)),
        float(loop.damping_ratio(0.0)),
        float(loop.damping_ratio(gain)),
        float(plain.damping_ratio(gain)),
        _bias(plain, point, gain),
        gain_limit(loop, gains),
        margins(loop, gain),
        tuple(loop.damping_ratio(gains).tolist()),
    )


def _bias(plain: Loop, point: OperatingPoint, gain: float) -> float:
    """What the static pressure does to the steady speed [m/s] where it is fed back without a
    washout; NaN where nothing is steady."""
    pressure = point.p_head if METERED[FUNCTIONS.index(point.function)] == HEAD else point.p_rod
    poles = np.linalg.eigvals(plain.closed(gain))
    if (poles.real > -AT_ZERO * np.abs(poles).max()).any():
        return math.nan
    return float(np.linalg.solve(-plain.closed(gain), plain.b)[0] * gain * pressure)


def gain_limit(loop: Loop, gains: np.ndarray) -> float:
    """The gain [m³/(s·Pa)] above which the closed loop is unstable; inf if not within ``gains``, 0
    if it is never stable.
    """
    from scipy.optimize import brentq

    def rightmost(gain):
        return np.linalg.eigvals(loop.closed(gain)).real.max(axis=-1)

    growth = rightmost(gains)
    calm = (
        1e-9 * np.abs(loop.a).max()
    )  # a pole at zero, such as that of a chamber which nothing holds, is stable
    stable = growth < calm
    if not stable.any():
        return 0.0
    first = int(stable.argmax())
    after = np.flatnonzero(~stable[first:])
    if not after.size:
        return math.inf
    at = first + int(after[0])
    return float(
        brentq(
            lambda g: rightmost(g) - calm,
            gains[at - 1],
            gains[at],
            rtol=1e-9,
            xtol=1e-9 * gains[at],
        )
    )


def locus(loop: Loop, site: _Site, law: Law, gain: float, parameter: str, limit: float) -> Locus:
    """Root locus of one operating point over the gain, or over the washout corner at the chosen
    gain, by python-control.

    Values lie densely about the choice and the stability limit. Over the corner: ``1 +
    ω_w·S(s)/s``, S the loop without washout."""
    import control

    if parameter == "feedback_gain":
        system, chosen = _system(loop.a, loop.b, -loop.c), gain
        crossing = limit if 0 < limit < math.inf else None
    else:
        plain = close(site.linear, site.point, site.circuit, replace(law, washout=0.0))
        n = plain.a.shape[0]
        # sensitivity 1 + K c (s − a − K b c)⁻¹ b of the loop without washout, then an integrator
        a = np.zeros((n + 1, n + 1))
        a[:n, :n] = plain.closed(gain)
        a[n, :n] = gain * plain.c
        system = _system(a, np.append(plain.b, 1.0), np.eye(n + 1)[n])
        chosen, crossing = law.washout, None
    top = 10.0 * max(chosen, crossing or 0.0)
    if parameter == "washout":
        top = max(top, 2.0 * abs(dominant(np.linalg.eigvals(loop.a), loop.fastest)))
    centre = [chosen] + ([crossing] if crossing else [])
    values = np.unique(
        np.concatenate(
            [
                [0.0],
                np.geomspace(chosen / 1e3, top, LOCUS_POINTS // 2),
                *(c * np.linspace(0.8, 1.2, LOCUS_POINTS // 4) for c in centre),
                centre,
            ]
        )
    )
    poles = np.asarray(control.root_locus_map(system, gains=values).loci)
    at = poles[int(np.searchsorted(values, chosen))]
    cross = poles[int(np.searchsorted(values, crossing))] if crossing else np.zeros(0, complex)
    # what matters: the pole pair that swings, from no gain to the choice, and the crossing
    reach = max(
        abs(dominant(p, loop.fastest)) for p in (poles[0], at, *([cross] if crossing else []))
    )
    frame = (-1.6 * reach, 0.4 * reach, 1.4 * reach)
    return Locus(
        site.point.name,
        parameter,
        tuple(values.tolist()),
        tuple(map(tuple, poles.real.tolist())),
        tuple(map(tuple, poles.imag.tolist())),
        float(chosen),
        _pairs(at),
        None if crossing is None else float(crossing),
        _pairs(cross),
        tuple(map(float, frame)),
    )


def _shown(results: Sequence[PointResult]) -> list[int]:
    """The least damped operating point of each function and payload, in their order."""
    worst: dict[tuple[str, str], int] = {}
    for i, r in enumerate(results):
        key = (r.point.function, r.point.payload)
        if key not in worst or r.damping_ratio_closed < results[worst[key]].damping_ratio_closed:
            worst[key] = i
    return list(worst.values())


def _step(loop: Loop, result: PointResult, gain: float) -> StepResponse:
    import control

    t = np.linspace(0.0, 20.0 * math.pi / max(result.natural_frequency_open, 1e-3), STEP_SAMPLES)
    speeds = [np.asarray(control.step_response(_speed(loop, g), t).outputs) for g in (0.0, gain)]
    return StepResponse(result.name, *(tuple(a.tolist()) for a in (t, *speeds)))


def _robustness(
    rig, maps, recipe, sites, results, law, gains, pressures, correlation, target, notes, tell
) -> Robustness:
    """The worst damping ratio over the least damped points for draws from the identified
    covariance.
    """
    known = {
        n: v
        for n, v in rig.parameters().items()
        if v.sure == "identified" and v.std is not None and math.isfinite(v.std) and v.std > 0
    }
    if not known:
        notes.append(
            "no parameter of the rig is identified with a standard error, so no draws were made"
        )
    if not known or recipe.draws == 0:
        return Robustness(0, tuple(known), 0, None, (), ())
    rng = np.random.default_rng(recipe.seed)
    names = tuple(known)
    table = draw_parameters(rig, names, correlation, recipe.draws, rng)
    order = sorted(
        (i for i, r in enumerate(results) if r.counts),
        key=lambda i: results[i].damping_ratio_closed,
    )[:WORST_POINTS]
    low, cross = pressures
    worst = np.ones(len(table))
    for k, row in enumerate(table):
        tell("draws", 0.75 + 0.25 * k / len(table))
        drawn = rig.with_values(dict(zip(names, map(float, row), strict=True)))
        at: dict[str, tuple[Model, Circuit]] = {}
        for i in order:
            point = sites[i].point
            if point.payload not in at:
                model = Model.of(drawn, maps, None if point.payload == NONE else point.payload)
                at[point.payload] = (
                    model,
                    circuit_of(model, model.layout.cylinders.index(point.cylinder), maps),
                )
            model, circuit = at[point.payload]
            here = equivalent(model, circuit.cylinder, np.array([point.x]), recipe.posture)
            moved = operating_point(
                model,
                circuit,
                FUNCTIONS.index(point.function),
                here,
                0,
                speed=abs(point.v),
                low_pressure=low,
                cross_drop=cross,
                payload=point.payload,
                held=recipe.posture,
            )
            if moved.possible:
                loop = close(development_model(model, moved), moved, circuit, law)
                worst[k] = min(worst[k], float(loop.damping_ratio(gains[point.function])))
    quantiles = tuple(np.quantile(worst, (0.05, 0.5, 0.95)).tolist())
    return Robustness(
        len(table),
        names,
        len(order),
        float(np.mean(worst >= target)),
        quantiles,
        tuple(worst.tolist()),
    )


def draw_parameters(
    rig: Rig,
    names: Sequence[str],
    correlation: tuple[Sequence[str], Any] | None,
    count: int,
    rng: np.random.Generator,
):
    """Draws [SI], shape (count, names), of parameters from their standard errors and correlation,
    clipped to their bounds.

    Raises:
        InputError: a correlation matrix that is none.
    """
    known = rig.parameters()
    values = [known[n] for n in names]
    matrix = np.eye(len(names))
    if correlation is not None:
        given, block = list(correlation[0]), np.asarray(correlation[1], float)
        if (
            block.shape != (len(given), len(given))
            or not np.allclose(block, block.T, atol=1e-6)
            or (np.abs(block) > 1 + 1e-6).any()
        ):
            raise InputError(
                "the correlation of the identified parameters is no correlation matrix"
            )
        both = [n for n in names if n in given]
        rows = [list(names).index(n) for n in both]
        matrix[np.ix_(rows, rows)] = block[
            np.ix_([given.index(n) for n in both], [given.index(n) for n in both])
        ]
        np.fill_diagonal(matrix, 1.0)
    level, axes = np.linalg.eigh(matrix)
    root = axes * np.sqrt(np.maximum(level, 0.0))
    draws = rng.standard_normal((count, len(names))) @ root.T
    draws = np.array([float(v) for v in values]) + draws * [v.std for v in values]
    lower = [-math.inf if v.lower is None else v.lower for v in values]
    upper = [math.inf if v.upper is None else v.upper for v in values]
    return np.clip(draws, lower, upper)
