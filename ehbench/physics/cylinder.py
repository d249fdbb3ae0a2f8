"""A hydraulic cylinder: where its pins put it, and what its chambers do; compiled.

Scalars in, scalars out; SI, gauge pressures, extension positive. ``flow_head`` goes into the head
end, ``flow_rod`` out of the rod end (thesis 2.4, 2.5)."""

import math

import numpy as np

from ehbench.runtime.compiled import kernel
from ehbench.vocabulary import InputError

PINS, DIRECT, RACK = 0, 1, 2

ATMOSPHERE = 101325.0  # [Pa], absolute
CAVITATION_BAND = 0.9e5  # [Pa] above the floor, over which a chamber stops yielding to outflow
RELIEF_GAIN = 1.0e-9  # [m³/(s·Pa)] of a relief valve: 30 L/min over 5 bar


@kernel
def linkage(kind, l_a, l_b, sign, phase, retracted, q):
    """(x [m], lever ∂x/∂q [m/rad], ∂lever/∂q [m/rad²]) of a cylinder at joint angle q.

    ``c² = l_A² + l_B² − 2 l_A l_B cos θ``, ``θ = sign·q + phase``, ``x = c − retracted``, ``lever =
    sign·l_A l_B sin θ / c`` and ``∂lever/∂q = (l_A l_B cos θ − lever²)/c`` (SPEC 1, thesis Table
    2.1). A rack: ``x = lever·(q − retracted)``, ``lever = sign·l_A`` of its pinion's radius l_A and
    the angle at x = 0. The cylinder's force F drives the joint with lever·F, and ``v = lever·q̇``,
    ``a = lever·q̈ + ∂lever/∂q·q̇²``.

    Args:
        kind: PINS, RACK, or DIRECT for a slide, where x = q and the lever is 1 whatever the other
        arguments. l_a, l_b: distances of the pins from the joint [m].
        sign: ±1.
        phase: φ [rad].
        retracted: length from pin to pin at x = 0 [m]; of a rack the joint's angle there [rad].
        q: joint angle [rad], or the slide's position [m].
    """
    if kind == DIRECT:
        return q, 1.0, 0.0
    if kind == RACK:
        return sign * l_a * (q - retracted), sign * l_a, 0.0
    half = 0.5 * (sign * q + phase)
    sine, cosine = math.sin(half), math.cos(half)
    product, versine = l_a * l_b, 2.0 * sine * sine
    # (l_A − l_B)² + 2 l_A l_B (1 − cos θ) keeps its digits where the pins nearly meet
    c = math.sqrt((l_a - l_b) * (l_a - l_b) + 2.0 * product * versine)
    lever = 2.0 * sign * product * sine * cosine / c
    return c - retracted, lever, (product - product * versine - lever * lever) / c


def joint_angle(kind, l_a, l_b, sign, phase, retracted, x):
    """Joint angle q [rad] at stroke x [m], the inverse of `linkage` for 0 ≤ θ ≤ π; x scalar or
    array.

    There the lever has the sign ``sign``. A machine that works with θ in −π…0 has −sign and −phase
    in this form.

    Raises:
        InputError: the pins cannot be that far apart, or that near.
    """
    x = np.asarray(x, dtype=float)
    if kind == DIRECT:
        return x[()]
    if kind == RACK:
        return (retracted + sign * x / l_a)[()]
    c = x + retracted
    low, high = abs(l_a - l_b), l_a + l_b
    beyond = c[~((low <= c) & (c <= high))]  # ~ so that nan is refused too
    if beyond.size:
        raise InputError(
            f"a cylinder {float(beyond.flat[0]) * 1e3:.1f} mm long from pin to pin does not fit "
            "its linkage",
            hint=f"l_a {l_a * 1e3:g} mm and l_b {l_b * 1e3:g} mm allow "
            f"{low * 1e3:g} to {high * 1e3:g} mm; check l_a, l_b, retracted_length and stroke",
        )
    theta = 2.0 * np.arctan2(np.sqrt(c * c - low * low), np.sqrt(high * high - c * c))
    return (sign * (theta - phase))[()]


def joint_range(kind, l_a, l_b, sign, phase, retracted, stroke) -> tuple[float, float]:
    """(q at x = 0, q at full stroke) [rad], or [m] of a slide.

    Raises:
        InputError: part of the stroke does not fit the linkage.
    """
    retracted_q, extended_q = joint_angle(
        kind, l_a, l_b, sign, phase, retracted, np.array([0.0, stroke])
    )
    return float(retracted_q), float(extended_q)


@kernel
def chamber_rate(inflow, pressure, volume, bulk_modulus, floor):
    """Rate of pressure [Pa/s] of one chamber: ``β_e/V · inflow``, held above the cavitation floor.

    While more oil leaves than comes (inflow < 0), the rate is scaled by (p − floor)/CAVITATION_BAND
    where that is below 1: pressure nears the floor exponentially, comes back to it from below, and
    rises at full stiffness at once when inflow turns positive. Oil is conserved above the band. In
    it, oil is supplied as by an anti-cavitation valve (`makeup_flow` says how much): the void
    leaves no memory, so a cavity needs no time to be refilled. The fastest rate it adds is
    β_e·|inflow|/(V·CAVITATION_BAND) [1/s].

    Args:
        inflow: oil that comes in plus volume that is taken away by the piston [m³/s].
        pressure: of the chamber [Pa].
        volume: [m³].
        bulk_modulus: β_e [Pa].
        floor: cavitation pressure [Pa]; −inf switches the floor off.
    """
    return bulk_modulus / volume * (inflow + makeup_flow(inflow, pressure, floor))


@kernel
def makeup_flow(inflow, pressure, floor):
    """Oil [m³/s], ≥ 0, that the cavitation floor adds to a chamber; it closes the oil balance."""
    if inflow >= 0.0 or pressure >= floor + CAVITATION_BAND:
        return 0.0
    return -inflow * (1.0 - (pressure - floor) / CAVITATION_BAND)


@kernel
def relief_flow(pressure, relief_pressure):
    """Flow [m³/s] out of a relief valve: ``RELIEF_GAIN·max(0, p − p_relief)``, with a rate of
    RELIEF_GAIN·β_e/V [1/s] of the chamber.

    Args:
        pressure: upstream of the valve [Pa].
        relief_pressure: where it opens [Pa]; inf for none.
    """
    return RELIEF_GAIN * (pressure - relief_pressure) if pressure > relief_pressure else 0.0
