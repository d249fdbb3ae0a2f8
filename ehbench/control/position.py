"""Position control as machine builders use it: the desired speed, corrected by the stroke error.

``v_c = v_d − k_1 z − k_1 ω_i ∫ z dt`` with ``z = x − x_d``, within ±``speed_correction`` of v_d,
through the working functions and inverse valve maps, and if it is given a gain the damping, of
pressure feedback. It reads the cylinder's stroke and what pressure feedback reads."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control import pressure_feedback
from ehbench.control.axis import Axis, hydraulic_frequency, reference_load
from ehbench.control.law import DesignPoint, Law, Packed
from ehbench.control.measured import pressures, write
from ehbench.control.pressure_feedback import move
from ehbench.control.records import blank, constants, numbers, reals
from ehbench.control.trajectory import reference_of
from ehbench.parts.sample import OF, entry
from ehbench.runtime.compiled import kernel, record
from ehbench.vocabulary import VOCABULARY, InputError, message, setting
from ehbench.vocabulary.codes import HOLD, SATURATED


@dataclass(frozen=True)
class PositionSettings:
    """Numbers of the default gains."""

    lag_budget: float = setting(0.2, "rad", "phase of valves and sampling at k_1", "chosen")
    damping_ratio: float = setting(0.02, "", "smallest damping of a cylinder on oil", "its seals")


POSITION = constants(PositionSettings())
OWN_GAINS = ("position_bandwidth", "integral_bandwidth", "speed_correction")
GAINS = record(*reals(OWN_GAINS), ("flow", pressure_feedback.GAINS))
# the integral's part of the speed [m/s], whether it stands still, and the memory of `move`
MEMORY = record(("integral", "f8"), ("frozen", "i8"), ("flow", pressure_feedback.MEMORY))


class Correction(NamedTuple):
    """Stroke error z [m], and the speeds [m/s]: the integral's part, and the required one."""

    x_error: float
    v_integral: float
    v_asked: float


TELEMETRY = (
    *("x_desired", "v_desired", "a_desired", "j_desired"),
    *Correction._fields,
    *pressure_feedback.Moved._fields,
)
COLUMNS = len(TELEMETRY)


@kernel
def correct(x, desired, gains, memory):
    """The `Correction` at stroke x; moves the integral one tick.

    The integral stands while it is frozen, or where the correction is at its limit and z would
    increase it."""
    z = x - desired.x
    maximum, k = gains.speed_correction, gains.position_bandwidth
    growth = -k * gains.integral_bandwidth * gains.flow.tick * z
    requested = -k * z + memory.integral + growth
    if memory.frozen == 0 and (abs(requested) <= maximum or requested * growth < 0.0):
        memory.integral += growth
    correction = memory.integral - k * z
    if abs(correction) > maximum:
        correction = math.copysign(maximum, correction)
    return Correction(z, memory.integral, desired.v + correction)


@kernel
def step(t, sample, reference, axis, gains, memory, command, telemetry):
    """One tick, see `Law`: correct the stroke error, write commands and telemetry; read are stroke
    and pressures, of the reference act x_d and v_d."""
    circuit, desired = axis.circuit, reference_of(reference)
    x, p = sample[entry(circuit.cylinder, OF.x)], pressures(sample, circuit.cylinder)
    required = correct(x, desired, gains, memory)
    moved = move(
        required.v_asked, p, circuit, gains.flow, memory.flow, command, telemetry[COLUMNS:]
    )
    memory.frozen = 1 if moved.function == HOLD or int(moved.limits) & SATURATED != 0 else 0
    write(desired, telemetry)
    write(required, telemetry[len(desired) :])
    write(moved, telemetry[len(desired) + len(required) :])


def default_bandwidth(point: DesignPoint) -> float:
    """k_1 [rad/s] by default: what the oil's spring and the lag of valves and sampling allow.

    An integrator and an oscillator in a loop are stable below ``2 ζ_h ω_h`` (Merritt, Hydraulic
    Control Systems, 6-5); half of that, for the bare rig in its posture, is a gain margin of 2."""
    load, _ = reference_load(point.axis)
    frequency = hydraulic_frequency(point.axis)
    decay = 0.5 * (load.damping + point.axis.cylinder.friction_viscous) / load.mass
    lag = point.valve_lag + point.tick
    return min(max(decay, POSITION.damping_ratio * frequency), POSITION.lag_budget / lag)


def pack(
    point: DesignPoint, gains: Mapping[str, Any], rules: np.record, shaping: np.record
) -> Packed:
    """The gains at a design point.

    By default k_1 is `default_bandwidth`, there is no integral, and a stroke error is
    corrected at most with the speed that the supply can make.

    Raises:
        InputError: a gain that is negative, not finite or 0 where it must act, or an integral whose
            corner lies above k_1.
    """
    chosen = {
        "position_bandwidth": gains.get("position_bandwidth", default_bandwidth(point)),
        "integral_bandwidth": gains.get("integral_bandwidth", 0.0),
        "speed_correction": gains.get(
            "speed_correction", point.flow_limit / point.axis.circuit.area_head
        ),
    }
    bandwidth, corner, _ = chosen.values()
    if not all(0.0 <= value < math.inf for value in chosen.values()) or bandwidth == 0.0:
        raise InputError(message("control.position_gain_range"))
    if corner > bandwidth:
        raise InputError(
            message("control.integral_above_bandwidth", corner=corner, bandwidth=bandwidth)
        )
    other = {name: value for name, value in gains.items() if name not in OWN_GAINS}
    flow = pressure_feedback.pack(point, other, rules, shaping)
    packed = blank(GAINS)
    for name, value in chosen.items():
        packed[name] = value
    packed.flow = flow.gains
    return Packed(packed, {"gains": numbers(packed, OWN_GAINS) | flow.used["gains"]})


def observed(axis: Axis, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the controller is given, shape (channels,)."""
    mask = pressure_feedback.observed(axis.circuit, channels)
    mask[entry(axis.circuit.cylinder, OF.x)] = True
    return mask


LAW = Law(
    name="position",
    record=GAINS,
    step=step,
    gains={name: VOCABULARY[name] for name in OWN_GAINS} | dict(pressure_feedback.LAW.gains),
    pack=pack,
    memory=lambda axis: blank(MEMORY),
    observed=observed,
    telemetry=TELEMETRY,
    warns_saturated=True,
)
