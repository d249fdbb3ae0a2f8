"""Gains of the energy-saving adaptive robust controller: their names, defaults and bounds;
derivation in docs/explanation/arc.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from ehbench.control.axis import Axis, Load, hydraulic_frequency, reference_load
from ehbench.control.functions import RULES
from ehbench.control.law import DesignPoint, Packed
from ehbench.control.pressure_feedback import DEFAULTS
from ehbench.control.records import blank, numbers, reals
from ehbench.parts.cylinder import joint_of
from ehbench.runtime.compiled import record
from ehbench.vocabulary import VOCABULARY, InputError, message, setting
from ehbench.vocabulary.codes import ESTIMATES, INVERSE_BULK, INVERSE_INERTIA

GAIN_NAMES = (
    *("tick", "adapt"),
    *("position_bandwidth", "speed_bandwidth", "force_bandwidth", "bandwidth_limit"),
    *("coupling_frequency", "speed_tolerance", "force_tolerance", "robust_limit"),
    *("pressure_bandwidth", "low_pressure", "pressure_rate"),
    *("observer_bandwidth", "speed_correction", "speed_nudge", "stroke_resolution"),
    *("load_corner", "standby", "flow_reserve", "valve_lead", "drop_floor", "drop_corner"),
    *("weighing_time", "reference_mass"),
    *("adapt_oil", "adapt_maps", "map_bandwidth", "map_error", "deadband_error"),
)
MAY_BE_ZERO = {
    *("adapt", "bandwidth_limit", "coupling_frequency", "robust_limit", "low_pressure"),
    *("observer_bandwidth", "speed_nudge", "stroke_resolution", "standby", "flow_reserve"),
    *("valve_lead", "drop_corner", "weighing_time"),
    *("adapt_oil", "adapt_maps", "map_error", "deadband_error"),
}
SWITCHES = ("adapt", "adapt_oil", "adapt_maps")  # yes or no
COUNT = len(ESTIMATES)
# lower, upper: bounds of the estimates; rate: gains of their adaptation; start: the design model's
GAINS = record(
    *reals(GAIN_NAMES),
    *((name, "f8", (COUNT,)) for name in ("lower", "upper", "rate", "start")),
    ("rules", RULES),
)
# what a recipe may say, see `pack_arc`
VOCABULARY_OF_GAINS = {
    **{name: VOCABULARY[name] for name in GAIN_NAMES if name not in ("tick", *SWITCHES)},
    **{name: VOCABULARY[name] for name in ("adaptation", "adaptation_bulk", "lag_budget")},
    **dict.fromkeys(SWITCHES),
    "disturbance": VOCABULARY["force"],
    "payload": VOCABULARY["mass"],
    "bulk_modulus": VOCABULARY["bulk_modulus"],
}


@dataclass(frozen=True)
class ArcGainSettings:
    """Numbers of the default gains; "sum" is k1 + k2 + k3."""

    shares: tuple = setting((0.3, 1.0, 0.2), "", "bounds that scale adaptation", "payload first")
    spare: float = setting(1.15, "", "largest payload, of the rig file's heaviest", "chosen")
    link: float = setting(1.5, "", "largest payload, of the last link's mass", "chosen")
    inertia: float = setting(0.1, "", "margin of the inertia's bounds", "chosen")
    disturbance: float = setting(0.03, "", "disturbance, of supply pressure on the head", "seals")
    bulk: float = setting(1.4, "", "factor of the bulk modulus to its bounds", "air in the oil")
    budget: float = setting(0.42, "rad", "phase of valves and a tick at the sum", "docs arc.md")
    reserve: float = setting(7.0e-3, "s", "sensor lag that must not swing", "2 ms lag, 5 ms delay")
    damping: float = setting(2.0, "", "share of a load's damping to take", "docs arc.md")
    undamped: float = setting(0.26, "", "budget of a load without damping", "docs arc.md")
    faster: float = setting(3.9, "", "largest sum over the loaded frequency", "docs arc.md")
    parts: tuple = setting((0.20, 0.18, 0.62), "", "k1, k2, k3 of the sum", "docs arc.md")
    overlap: float = setting(0.03, "", "unknown overlap, of the largest command", "data sheets")
    onset: float = setting(0.25, "", "error of a known deadband", "chosen")
    adaptation: float = setting(0.2, "k1", "rate of adaptation", "docs arc.md")
    adaptation_bulk: float = setting(0.02, "", "the same of the bulk modulus, of it", "slow")
    maps: float = setting(0.12, "k1", "rate of the map corrections", "slow against the loop")
    observer: float = setting(6.0, "sum", "bandwidth of the observer", "fast against the loop")
    fastest_observer: float = setting(500.0, "rad/s", "its largest bandwidth", "noise at 1 kHz")
    count: float = setting(0.08, "", "observed speed of a count, of the largest", "docs arc.md")
    slowest_observer: float = setting(2.0, "k1", "its smallest bandwidth", "faster than the loop")
    pressure: float = setting(0.6, "sum", "bandwidth of the off-side pressure", "chosen")
    pressure_rate: float = setting(3.0, "1/s", "set-point's rate over supply pressure", "chosen")
    nudge: float = setting(0.01, "", "speed at standstill, of the largest", "chosen")
    resolution: float = setting(2.5e-5, "m", "resolution of the stroke", "usual encoder")
    standby: float = setting(0.8, "", "share of the deadband while shut", "tolerance of a deadband")
    flow_reserve: float = setting(0.06, "", "flow to spare at the supply's edge", "docs arc.md")
    robust: float = setting(0.05, "", "robust share of k2 and k3", "docs arc.md")
    map_error: float = setting(0.25, "", "error of a flow map", "data sheets")
    corner: float = setting(0.15, "", "corner of a swing over its frequency", "docs arc.md")
    strokes: tuple = setting((0.1, 0.3, 0.5, 0.7, 0.9), "", "strokes that are checked", "its range")


ARC_GAINS = ArcGainSettings()


@dataclass(frozen=True)
class _Bounds:
    """Bounds of the estimates, shape (COUNT,), and ``span`` [kg] of the payload."""

    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray
    span: float

    @classmethod
    def of(cls, point: DesignPoint, given: Mapping[str, Any], place: _Place) -> Self:
        """Bounds of the estimates; a payload's are those of inertia and gravity that it makes.

        ``payload`` [kg] at the end of the last link: 0 to 1.5 times that link's mass by default,
        or to ``spare`` times the rig file's heaviest payload where that is more; ``disturbance``
        ± [N]: 3 % of supply pressure on the head end; ``bulk_modulus`` [Pa]: the design's through
        and times 1.4."""
        axis, ratio = point.axis, place.ratio
        beta = axis.cylinder.bulk_modulus
        last = float(axis.mechanism.links[-1].mass)
        heaviest = max(ARC_GAINS.link * last, ARC_GAINS.spare * point.payload)
        low, high = given.get("payload", (0.0, heaviest))
        usual = ARC_GAINS.disturbance * point.supply_pressure * axis.circuit.area_head
        worst = given.get("disturbance", usual)
        usual = (beta / ARC_GAINS.bulk, ARC_GAINS.bulk * beta)
        softest, hardest = given.get("bulk_modulus", usual)
        return cls(
            np.array(
                [(1.0 - ARC_GAINS.inertia) / (1.0 + high * ratio), low, -worst, beta / hardest]
            ),
            np.array(
                [(1.0 + ARC_GAINS.inertia) / (1.0 + low * ratio), high, worst, beta / softest]
            ),
            np.array([1.0, low, 0.0, 1.0]),
            high - low,
        )

    @property
    def contain_design(self) -> bool:
        """Whether the design model lies within."""
        return bool(
            self.start[1] >= 0.0
            and np.isfinite([self.lower, self.upper]).all()
            and ((self.lower <= self.start) & (self.start <= self.upper)).all()
        )


def pack_arc(
    point: DesignPoint, rules: np.record, given: Mapping[str, Any]
) -> tuple[np.record, np.ndarray]:
    """(the gains of `ehbench.control.arc.step`, a record of type GAINS, with defaults from what the
    valves and the supply allow; the rates of adaptation that a bandwidth of 1 rad/s makes).

    The valves are asked for phase up to the sum of the bandwidths k1 + k2 + k3 [rad/s]. By default
    that sum times the loop's lag is ``lag_budget``, shared out by ``parts``; margins and the other
    defaults are derived in ``docs/explanation/arc.md``.

    Args:
        point, rules: what it is designed for, and how functions are chosen.
        given: any of VOCABULARY_OF_GAINS [SI] instead of its default; `VOCABULARY`,
            `_Bounds.of`, `_total` and `_Learning.of` say what they are.

    Raises:
        InputError: an unknown gain, a number out of its range, bounds that do not hold the design
            model."""
    _check(given, point.tick)
    places = _places(point.axis)
    bounds, total = _Bounds.of(point, given, places[0]), _total(point, given, places)
    chosen = {
        name: given.get(name, total * part)
        for name, part in zip(GAIN_NAMES[2:5], ARC_GAINS.parts, strict=True)
    }
    learning = _Learning.of(point, given, bounds, chosen, places)
    chosen |= _defaults(point, places[0].load, chosen, total, learning) | dict(given)
    if "observer_bandwidth" not in given and chosen["stroke_resolution"] > 0.0:
        quietest = ARC_GAINS.count * chosen["speed_correction"] / chosen["stroke_resolution"]
        bandwidth = max(quietest, ARC_GAINS.slowest_observer * chosen["position_bandwidth"])
        chosen["observer_bandwidth"] = min(chosen["observer_bandwidth"], bandwidth)
    chosen |= {"tick": given.get("tick", point.tick), "adapt": given.get("adapt", True)}
    chosen["adapt_oil"] = given.get("adapt_oil", 1.0)
    chosen["adapt_maps"] = given.get("adapt_maps", 0.0)
    # well below the swing of the load where drops are small: on a load-sensing pump, on two rails
    supply = point.axis.circuit.supply[0]
    small_drops = float(supply.margin) != 0.0 or float(supply.rail) != 0.0
    corner = ARC_GAINS.corner * min(place.swing for place in places) if small_drops else 0.0
    chosen["drop_corner"] = given.get("drop_corner", corner)
    if not {"lag_budget", *GAIN_NAMES[2:5]} & set(given):
        softest = ARC_GAINS.faster * min(place.swing for place in places)
        chosen["bandwidth_limit"] = given.get("bandwidth_limit", softest)
    if chosen["standby"] >= 1.0:
        raise InputError(message("control.standby_range", value=chosen["standby"]))
    if not bounds.contain_design or not (learning.rate >= 0.0).all():
        raise InputError(message("control.bounds_miss_design"))
    packed = blank(GAINS)
    for name in GAIN_NAMES:
        packed[name] = chosen[name]
    packed.lower[:], packed.upper[:], packed.start[:] = bounds.lower, bounds.upper, bounds.start
    packed.rate[:] = learning.rate
    packed.rules = rules
    return packed, learning.per_bandwidth


def _check(given: Mapping[str, Any], tick: float) -> None:
    for name in given:
        if name not in ("tick", *VOCABULARY_OF_GAINS):
            known = ", ".join(VOCABULARY_OF_GAINS)
            raise InputError(message("control.unknown_arc_gain", name=name, known=known))
    for name, value in {"tick": tick, **given}.items():
        if name not in (*GAIN_NAMES, "lag_budget"):
            continue  # wrong bounds do not hold the design
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name not in MAY_BE_ZERO):
            raise InputError(message("control.arc_gain_range", name=name, value=value))


class _Place(NamedTuple):
    """A posture: ``load``, share ``ratio`` [1/kg] of its inertia that 1 kg at the tip adds,
    ``swing`` [rad/s] of the bare rig on its oil, damping b/m [1/s]."""

    load: Load
    ratio: float
    swing: float
    damping: float


def _places(axis: Axis) -> list[_Place]:
    """The axis's posture, then those along its stroke, the other joints as they are."""
    results, cylinder, axes = [], axis.cylinder, [axis]
    for share in ARC_GAINS.strokes:
        posture = axis.mechanism.posture.copy()
        posture[int(cylinder.joint)] = joint_of(cylinder, share * float(cylinder.stroke))
        axes.append(axis._replace(mechanism=axis.mechanism._replace(posture=posture)))
    for item in axes:
        load, ratio = reference_load(item)
        damping = load.damping + float(axis.cylinder.friction_viscous)
        swing = hydraulic_frequency(item, load)
        results.append(_Place(load, ratio, swing, damping / load.mass))
    return results


def _total(point: DesignPoint, given: Mapping[str, Any], places: Sequence[_Place]) -> float:
    """k1 + k2 + k3 [rad/s] by default; ``lag_budget`` [rad] is the phase that the loop's lag may
    take there.

    Without it: where a load swings so fast that lag and ``reserve`` turn the feedback by more than
    a quarter of a turn, it takes damping away: at most ``damping`` of what the load has by itself.
    """
    lag = point.valve_lag + point.tick
    if "lag_budget" in given:
        return given["lag_budget"] / lag
    total = maximum = ARC_GAINS.budget / lag
    for place in places:
        taken = -math.cos(min(place.swing * (lag + ARC_GAINS.reserve), math.pi))
        if taken > 0.0:
            damped = ARC_GAINS.damping * place.damping / taken
            total = min(total, max(damped, ARC_GAINS.undamped * maximum))
    return total


class _Learning(NamedTuple):
    """``rate`` of each estimate, the same at a bandwidth of 1 rad/s; the loop's ``answer`` [s] to
    an error of acceleration, the ``unknown`` acceleration [m/s²]."""

    rate: np.ndarray
    per_bandwidth: np.ndarray
    answer: float
    unknown: float

    @classmethod
    def of(
        cls,
        point: DesignPoint,
        given: Mapping[str, Any],
        bounds: _Bounds,
        bandwidths: Mapping[str, float],
        places: Sequence[_Place],
    ) -> Self:
        """``adaptation`` [rad/s], at which the mechanical estimates together follow: k1/5 by
        default, and less on a load that swings fast; ``adaptation_bulk``, of the bulk modulus: a
        fiftieth of it."""
        coupling = given.get("coupling_frequency") or 0.0
        k1, _, k3 = bandwidths.values()
        each = [_sensitivity(place, bounds.span, bandwidths, coupling) for place in places]
        phi, answer, omega = each[0]
        width = (bounds.upper - bounds.lower)[:3]
        variance = (width * np.array(ARC_GAINS.shares)) ** 2
        # where along the stroke an error shows most, so that nowhere they learn faster than stated
        shown = max(shows * float(at**2 @ variance) for at, shows, _ in each)
        late = point.valve_lag + point.tick + ARC_GAINS.reserve
        turned = late * max(place.swing for place in places)
        gamma = ARC_GAINS.adaptation * k1 * min(1.0, 0.5 * math.pi / turned)
        gamma = given.get("adaptation", gamma)
        # 10 m/s³ times the reference mass stands for the force rates that show the bulk modulus
        slow = given.get("adaptation_bulk", ARC_GAINS.adaptation_bulk * gamma)
        rate, per = (
            np.array([*(item * variance / shown), bulk * k3 * (omega / 10.0) ** 2])
            for item, bulk in ((gamma, slow), (1.0, 1.0))
        )
        return cls(rate, per, answer, float(np.abs(phi) @ width))


def _regressors(load: Load, span: float) -> np.ndarray:
    """Regressors of the mechanical estimates at a middling payload and 1 m/s²."""
    return np.array(
        [1.0 + 0.5 * abs(load.pull) * span / load.mass, load.pull / load.mass, 1.0 / load.mass]
    )


def _sensitivity(
    place: _Place, span: float, bandwidths: Mapping[str, float], coupling: float
) -> tuple[np.ndarray, float, float]:
    """(regressors φ at a middling payload, answer [s] of the loop to an error of acceleration,
    frequency [rad/s] of the coupling).

    An acceleration error Δ shows as mixed = −answer·Δ, so θ̂' = Γ φ mixed makes Δ' =
    −adaptation·Δ."""
    load = place.load
    k1, k2, k3 = bandwidths.values()
    omega = coupling or place.swing
    phi = _regressors(load, span)
    at_speed = (1.0 + (k1 + k2) / k3) / (k2 + omega**2 / k3)
    answer = max(at_speed + (k1 + k2) / omega**2 * (k2 * at_speed - 1.0), 0.2 * at_speed)
    return phi, answer, omega


def _defaults(
    point: DesignPoint,
    load: Load,
    bandwidths: Mapping[str, float],
    total: float,
    learning: _Learning,
) -> dict[str, float]:
    """Defaults of all gains but the bandwidths k1, k2, k3, whose sum by default is ``total``."""
    unknown = learning.unknown
    k1, k2, k3 = bandwidths.values()
    circuit, mass = point.axis.circuit, load.mass
    area, valves = circuit.area_head, circuit.edges.valve[circuit.first :][: circuit.count]
    widest = np.maximum(np.abs(circuit.lowest[valves]), np.abs(circuit.highest[valves])).max()
    # a share of the largest deadband that is known, or of the command where a spool has an overlap
    # that its rig file lacks
    onset = ARC_GAINS.onset * np.abs(point.axis.onset).max(initial=0.0)
    return {
        "bandwidth_limit": 0.0,
        "coupling_frequency": 0.0,
        "speed_tolerance": unknown / (1.1 * k2),
        "force_tolerance": mass * (k1 + k2) * unknown / (1.1 * k3),
        "robust_limit": ARC_GAINS.robust,
        "pressure_bandwidth": ARC_GAINS.pressure * total,
        "low_pressure": point.low_pressure,
        "pressure_rate": ARC_GAINS.pressure_rate * point.supply_pressure,
        "observer_bandwidth": min(ARC_GAINS.observer * total, ARC_GAINS.fastest_observer),
        "speed_correction": point.flow_limit / area,
        "speed_nudge": ARC_GAINS.nudge * point.flow_limit / area,
        "stroke_resolution": ARC_GAINS.resolution,
        "load_corner": DEFAULTS.load_corner,
        "standby": ARC_GAINS.standby,
        "flow_reserve": ARC_GAINS.flow_reserve,
        "valve_lead": point.valve_lag + 0.5 * point.tick,
        "drop_floor": DEFAULTS.drop_floor,
        "weighing_time": learning.answer,
        "reference_mass": mass,
        "map_bandwidth": ARC_GAINS.maps * k1,
        "map_error": ARC_GAINS.map_error,
        "deadband_error": float(max(onset, ARC_GAINS.overlap * widest)),
    }


def check_modelled(unmodelled: Sequence[str], **where: Any) -> None:
    """Refuse an axis with a part that the law's model of a cylinder lacks; ``where`` a file names
    the law.

    Raises:
        InputError: names the part."""
    if unmodelled:
        raise InputError(message("control.arc_lacks_part", part=unmodelled[0]), **where)


def pack(
    point: DesignPoint, gains: Mapping[str, Any], rules: np.record, shaping: np.record
) -> Packed:
    """The gains on a site, and what is known of them: see `named_gains`.

    Raises:
        InputError: the rig has a part that the law's model of the cylinder lacks."""
    check_modelled(point.unmodelled)
    packed, per_bandwidth = pack_arc(point, rules, gains)
    named = named_gains(packed, per_bandwidth) | {"guaranteed": guaranteed(point, packed)}
    return Packed(packed, named)


def guaranteed(point: DesignPoint, packed: np.record) -> dict[str, float]:
    """What the law guarantees of its errors in the axis's posture, whatever the estimates do inside
    of their bounds: ``acceleration`` h_2 [m/s²] that they leave open, and the ends of ``speed`` z_2
    [m/s] and ``stroke`` z_1 [m] after the transient.

    ``V̇_z ≤ −K V_z + h_2²/(2 K_2) + w h_3²/(2 K_3)`` with K_i = k_i and their robust shares, K the
    lesser (docs/explanation/arc.md)."""
    load, _ = reference_load(point.axis)
    width = (packed.upper - packed.lower)[:3]
    span = float(packed.upper[1] - packed.lower[1])
    k1, k2, k3 = (float(packed[name]) for name in GAIN_NAMES[2:5])
    phi = _regressors(load, span)
    unsure = float(np.abs(phi) @ width)
    force = load.mass * (k1 + k2) * unsure
    omega = float(packed.coupling_frequency) or hydraulic_frequency(point.axis, load)
    whole = []
    for gain, left, tolerance in (
        (k2, unsure, float(packed.speed_tolerance)),
        (k3, force, float(packed.force_tolerance)),
    ):
        share = min(left**2 / (4.0 * gain * tolerance**2), float(packed.robust_limit) * gain)
        whole.append(gain + share)
    level = unsure**2 / (2.0 * whole[0]) + (force / (load.mass * omega)) ** 2 / (2.0 * whole[1])
    speed = math.sqrt(2.0 * level / min(whole))
    return {"acceleration": unsure, "speed": speed, "stroke": speed / k1}


def named_gains(packed: np.record, per_bandwidth: np.ndarray) -> dict[str, Any]:
    """``gains`` by name [SI] and ``estimate_bounds``, (lower, upper) [SI] of each estimate.

    ``per_bandwidth`` are the rates of adaptation that a bandwidth of 1 rad/s makes.
    Projected are the estimates of the law; ``payload_estimate`` is payload_share/inverse_inertia,
    so its bounds are those of the quotient."""
    gains = numbers(packed, GAIN_NAMES)
    for name, which in (("adaptation", INVERSE_INERTIA), ("adaptation_bulk", INVERSE_BULK)):
        gains[name] = float(packed.rate[which] / per_bandwidth[which])
    bounds = {
        name: [low, high]
        for name, low, high in zip(
            ESTIMATES, packed.lower.tolist(), packed.upper.tolist(), strict=True
        )
    }
    share, inverse = bounds["payload_share"], bounds["inverse_inertia"]
    bounds["payload_estimate"] = [share[0] / inverse[1], share[1] / inverse[0]]
    return {"gains": gains, "estimate_bounds": bounds}
