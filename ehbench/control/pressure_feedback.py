"""Pressure feedback for machines without position or velocity sensors (thesis 3); with zero gain,
the open loop.

``Q = A v_d − K_p F(s) P`` into the chamber that sets the motion, F(s) a washout ``s/(s + ω_w)``,
two of them, or 1; the other chamber is held at a set pressure. It reads the cylinder's two
pressures, the supply's and the tank's, and nothing else."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control.functions import (
    HEAD,
    METERED,
    RAISED,
    ROD,
    RULES,
    Circuit,
    select,
    steady_reference,
)
from ehbench.control.law import DesignPoint, Law, Packed, Required
from ehbench.control.measured import load_force, pressure_entries, pressures, write
from ehbench.control.records import blank, constants, numbers, reals
from ehbench.control.trajectory import (
    SHAPED,
    SHAPING,
    SHAPING_NAMES,
    pack_shaping,
    reference_of,
    shape_speed,
)
from ehbench.control.valve_level import Flows, allocate, shut
from ehbench.parts.cylinder import chamber_oil
from ehbench.runtime.compiled import kernel, record
from ehbench.vocabulary import VOCABULARY, InputError, message, setting
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS, HOLD


@dataclass(frozen=True)
class PressureFeedbackSettings:
    """Defaults of the gains."""

    off_rate: float = setting(10.0, "rad/s", "bandwidth of the off-side pressure", "chosen")
    drop_floor: float = setting(2.0e4, "Pa", "smallest drop of the inverse maps", "sensor noise")
    load_corner: float = setting(2.0 * math.pi, "rad/s", "low-pass of the load force", "1 Hz")


DEFAULTS = constants(PressureFeedbackSettings())
SCALARS = (
    "tick",
    "off_gain",
    "low_pressure",
    "drop_floor",
    "load_corner",
    "washout",
    "ramp_washout",
)
GAINS = record(
    *reals(SCALARS),
    ("feedback_gain", "f8", (len(FUNCTIONS),)),
    ("shaping", SHAPING),
    ("rules", RULES),
)
# a chamber's pressure as measured, behind one washout, behind both [Pa]
END = record(*reals(("pressure", "washed", "ramp_washed")))
MEMORY = record(
    ("started", "i8"),
    ("function", "i8"),
    ("age", "f8"),
    ("slow_load", "f8"),
    ("slow_reference", "f8"),
    ("ends", END, (2,)),
    ("shaped", SHAPED),
)


class Moved(NamedTuple):
    """What `move` did, as columns of telemetry."""

    function: float
    function_status: float
    load_force: float
    feedback_flow: float
    flow_head_desired: float
    flow_rod_desired: float
    limits: float


TELEMETRY = ("x_desired", "v_desired", "a_desired", "j_desired", "v_shaped", *Moved._fields)
COLUMNS = len(TELEMETRY)


@kernel
def wash(corner, tick, x, last, passed):
    """What a washout ``s/(s + corner)`` [rad/s] lets through of ``x``, after ``last`` and
    ``passed`` a tick ago; x where it is 0.

    Bilinear, so that it turns the phase as s/(s + corner) does up to the second order of
    corner·tick."""
    if corner == 0.0:
        return x
    retained = math.exp(-corner * tick)
    return retained * passed + 0.5 * (1.0 + retained) * (x - last)


@kernel
def wash_pressures(p, load, gains, memory):
    """Move both ends' washouts in ``memory`` one tick; the first tick starts them at rest."""
    starting = memory.started == 0
    if starting:
        memory.started, memory.function, memory.slow_load = 1, HOLD, load
    for i in range(2):
        end = memory.ends[i]
        pressure = p.head if i == 0 else p.rod
        if starting:
            end.pressure = pressure
            end.washed = 0.0 if gains.washout > 0.0 else pressure
        washed = wash(gains.washout, gains.tick, pressure, end.pressure, end.washed)
        end.ramp_washed = wash(gains.ramp_washout, gains.tick, washed, end.washed, end.ramp_washed)
        end.pressure, end.washed = pressure, washed


@kernel
def choose(v_d, load, p, circuit, gains, memory):
    """(working function, status, slow load force [N]) of this tick.

    The swing of an undamped load changes the sign of its force, and choosing by it would feed the
    swing: the function is chosen by the load behind a low-pass."""
    slow = -math.expm1(-gains.load_corner * gains.tick) if gains.load_corner > 0.0 else 1.0
    memory.slow_load += slow * (load - memory.slow_load)
    memory.slow_reference = steady = steady_reference(
        v_d, memory.slow_reference, gains.tick, gains.rules
    )
    function, status = select(
        memory.function, memory.age, steady, memory.slow_load, p, circuit, gains.rules
    )
    if function != memory.function:
        memory.age = 0.0
    memory.age += gains.tick
    memory.function = function
    return function, status, memory.slow_load


@kernel
def feed_back(function, v_d, p, circuit, gains, memory):
    """(`Flows` of the chambers, what the feedback takes from them [m³/s]).

    The metered chamber gets ``A v_d − K_p F(s) P``, the other what holds it at its set-point."""
    gain, off = gains.feedback_gain[function], gains.off_gain
    flow_head, flow_rod, back = circuit.area_head * v_d, circuit.area_rod * v_d, 0.0
    if METERED[function] == HEAD:
        back = gain * memory.ends[0].ramp_washed
        low = p.head + gains.rules.cross_drop if RAISED[function] else p.tank + gains.low_pressure
        flow_head -= back
        flow_rod += off * (p.rod - low)
    elif METERED[function] == ROD:
        back = gain * memory.ends[1].ramp_washed
        flow_rod += back
        flow_head -= off * (p.head - (p.tank + gains.low_pressure))
    return Flows(flow_head, flow_rod), back


@kernel
def move(v_d, p, circuit, gains, memory, command, edge_row):
    """Write the commands that make a speed; what was done, a `Moved`.

    Args:
        v_d: desired speed [m/s], extension positive.
        p: `Pressures` of the cylinder [Pa].
        circuit: of the cylinder, a `Circuit`.
        gains: of `pack_pressure_feedback`.
        memory: a record of type MEMORY, zeros before the first tick.
        command: out, [V], one per valve of the rig; only this cylinder's are written.
        edge_row: out, desired flow [m³/s] and limits of each of the cylinder's edges, shape
            (2·edges,).
    """
    load = load_force(p, circuit.area_head, circuit.area_rod)
    wash_pressures(p, load, gains, memory)
    function, status, slow = choose(v_d, load, p, circuit, gains, memory)
    flows, back = feed_back(function, v_d, p, circuit, gains, memory)
    edge_flows, edge_limits = edge_row[: circuit.count], edge_row[circuit.count :]
    limits = 0
    if function == HOLD:
        flows = Flows(0.0, 0.0)
        shut(circuit, command, edge_flows, edge_limits)
    else:
        limits = allocate(
            function, flows, p, gains.drop_floor, circuit, command, edge_flows, edge_limits
        )
    return Moved(float(function), float(status), slow, back, flows.head, flows.rod, float(limits))


@kernel
def step(t, sample, reference, circuit, gains, memory, command, telemetry):
    """One tick, see `Law`, by the cylinder's `Circuit`: read the four pressures, choose the
    function, write commands and telemetry; of the reference only v_d acts."""
    desired = reference_of(reference)
    p = pressures(sample, circuit.cylinder)
    v_d = shape_speed(desired.v, gains.tick, gains.shaping, memory.shaped)
    moved = move(v_d, p, circuit, gains, memory, command, telemetry[COLUMNS:])
    write(desired, telemetry)
    telemetry[len(desired)] = v_d
    write(moved, telemetry[len(desired) + 1 :])


@kernel
def _axis_step(t, sample, reference, axis, gains, memory, command, telemetry):
    step(t, sample, reference, axis.circuit, gains, memory, command, telemetry)


def pack_pressure_feedback(
    *,
    rules: np.record,
    feedback_gain: float | Mapping[str, float] = 0.0,
    shaping: np.record | None = None,
    **gains: float,
) -> np.record:
    """The gains of `step`, a record of type GAINS.

    Args:
        rules: of function selection, `ehbench.control.functions.pack_rules`.
        feedback_gain: K_p [m³/(s·Pa)], one number or one for each working function by name (others
            0); 0 is open loop.
        shaping: of the commanded speed, `ehbench.control.trajectory.pack_shaping`; none by default.
        gains: SCALARS by name [SI]; `VOCABULARY` says what they are. ``off_gain`` makes the
            off-side's pressure follow with about off_gain·β_e/V [rad/s]; without ``washout``, as by
            default, F(s) is 1; with ``ramp_washout`` it forgets a load that ramps as well.

    Raises:
        InputError: a gain that is missing, unknown, negative or not finite, an unknown function.
    """
    packed = blank(GAINS)
    scalars = {
        "washout": 0.0,
        "ramp_washout": 0.0,
        "drop_floor": DEFAULTS.drop_floor,
        "load_corner": DEFAULTS.load_corner,
    } | gains
    if set(scalars) != set(SCALARS):
        names, known = ", ".join(sorted(set(scalars) ^ set(SCALARS))), ", ".join(SCALARS)
        raise InputError(message("control.feedback_gain_names", names=names, known=known))
    for name, value in scalars.items():
        packed[name] = value
    if isinstance(feedback_gain, Mapping):
        for name, value in feedback_gain.items():
            if name not in FUNCTIONS[1:]:
                known = ", ".join(FUNCTIONS[1:])
                raise InputError(message("control.unknown_function", name=name, known=known))
            packed.feedback_gain[FUNCTIONS.index(name)] = value
    else:
        packed.feedback_gain[:] = feedback_gain
    packed.shaping = pack_shaping() if shaping is None else shaping
    packed.rules = rules
    every = [*numbers(packed, SCALARS).values(), *packed.feedback_gain.tolist()]
    if not (
        all(0.0 <= value < math.inf for value in every)
        and packed.tick > 0.0
        and packed.drop_floor > 0.0
    ):
        raise InputError(message("control.feedback_gain_range"))
    return packed


def pack(
    point: DesignPoint, gains: Mapping[str, Any], rules: np.record, shaping: np.record
) -> Packed:
    """The gains at a design point; the off-side follows with ``off_rate`` by default."""
    cylinder = point.axis.cylinder
    volume = max(chamber_oil(cylinder, side, point.stroke) for side in range(2))
    defaults = {
        "off_gain": DEFAULTS.off_rate * volume / cylinder.bulk_modulus,
        "low_pressure": point.low_pressure,
    }
    packed = pack_pressure_feedback(
        tick=point.tick, rules=rules, shaping=shaping, **{**defaults, **gains}
    )
    return Packed(packed, {"gains": named_gains(packed, point.axis.circuit)})


def named_gains(packed: np.record, circuit: Circuit) -> dict[str, float]:
    """Gains by name [SI].

    The feedback gain is one number, or ``<working function>.feedback_gain`` of each that may be
    chosen where they differ. Shaping is named where there is some."""
    may = [
        f
        for f in range(1, len(FUNCTIONS))
        if circuit.able[f] and (packed.rules.allow_seventh or f != EXTEND_RESISTIVE_REGENERATION)
    ]
    by_function = {f"{FUNCTIONS[f]}.feedback_gain": float(packed.feedback_gain[f]) for f in may}
    item = set(by_function.values())
    feedback = {"feedback_gain": item.pop()} if len(item) == 1 else by_function
    shaping = numbers(packed.shaping, SHAPING_NAMES)
    return (
        numbers(packed, SCALARS)
        | feedback
        | {name: value for name, value in shaping.items() if value > 0.0}
    )


def observed(circuit: Circuit, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the controller is given, shape (channels,)."""
    mask = np.zeros(channels, bool)
    mask[pressure_entries(circuit.cylinder, channels)] = True
    return mask


LAW = Law(
    name="pressure_feedback",
    record=GAINS,
    step=_axis_step,
    gains={name: VOCABULARY[name] for name in (*SCALARS[1:5], "feedback_gain", *SCALARS[5:])},
    pack=pack,
    memory=lambda axis: blank(MEMORY),
    observed=lambda axis, channels: observed(axis.circuit, channels),
    telemetry=TELEMETRY,
    required=Required("feedback_gain", message("control.feedback_gain_missing")),
    shaped=True,
)
