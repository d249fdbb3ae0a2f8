"""Pressure feedback for machines without position or velocity sensors (thesis 3); with zero gain,
the open loop.

``Q = A v_d − K_p F(s) P`` into the chamber that sets the motion, F(s) a washout ``s/(s + ω_w)``,
two of them, or 1; the other chamber is held at a set pressure. It reads the cylinder's two
pressures, the supply's and the tank's, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ehbench.compiled import kernel
from ehbench.control.functions import (
    CROSS_DROP,
    EXTEND_RESISTIVE_REGENERATION,
    FUNCTIONS,
    HEAD,
    HOLD,
    METERED,
    ROD,
    RULES,
    Circuit,
    select,
)
from ehbench.control.trajectory import SHAPED, SHAPING, A, J, V, X, pack_shaping, shape_speed
from ehbench.control.valve_level import give, rest
from ehbench.errors import InputError

# a sample of a rig: this many channels a cylinder, its pressures at these places, then p_supply and
# p_tank
PER_CYLINDER, P_HEAD, P_ROD = 6, 4, 5
# gains
TICK, WASHOUT, RAMP_WASHOUT, OFF_GAIN, LOW_PRESSURE, DROP_FLOOR, LOAD_CORNER, FEEDBACK_GAIN = range(
    8
)
AT_SHAPING = FEEDBACK_GAIN + len(FUNCTIONS)
AT_RULES = AT_SHAPING + SHAPING
GAINS = AT_RULES + RULES
# memory
STARTED, FUNCTION, AGE, SLOW_LOAD = range(4)
AT_PRESSURE, AT_WASHED, AT_RAMP_WASHED, AT_SHAPED = (
    4,
    6,
    8,
    10,
)  # of (head, rod): measured, behind one washout, behind both
MEMORY = AT_SHAPED + SHAPED
# note: these, then (flow, limits) of each of the cylinder's edges
NOTE = (
    "x_desired",
    "v_desired",
    "a_desired",
    "j_desired",
    "v_shaped",
    "function",
    "function_status",
    "load_force",
    "feedback_flow",
    "flow_head_desired",
    "flow_rod_desired",
    "limits",
)
NOTES = len(NOTE)


@kernel
def wash(corner, tick, x, last, passed):
    """What a washout ``s/(s + corner)`` [rad/s] lets through of ``x``, after ``last`` and
    ``passed`` a tick ago; x where it is 0.

    Bilinear, so that it turns the phase as s/(s + corner) does up to the second order of
    corner·tick."""
    if corner == 0.0:
        return x
    kept = math.exp(-corner * tick)
    return kept * passed + 0.5 * (1.0 + kept) * (x - last)


@kernel
def step(t, sample, wish, circuit, gains, memory, command, note):
    """One tick: read the pressures, choose the function, write commands and note.

    Args:
        t: time [s], unused.
        sample: what the rig measured, shape (6·cylinders + 2,); only the four pressures are read.
        wish: x_d, v_d, a_d, j_d of the cylinder; only v_d acts.
        circuit: of the cylinder, a `Circuit`.
        gains: of `pack_pressure_feedback`.
        memory: state of the controller, shape (MEMORY,), zeros before the first tick.
        command: out, [V], one per valve of the rig; only this cylinder's are written.
        note: out, shape (NOTES + 2·edges of the cylinder,), columns as `note_channels`.
    """
    at = PER_CYLINDER * circuit.cylinder
    p_head, p_rod = sample[at + P_HEAD], sample[at + P_ROD]
    p_supply, p_tank = sample[sample.shape[0] - 2], sample[sample.shape[0] - 1]
    tick, washout, ramp_washout = gains[TICK], gains[WASHOUT], gains[RAMP_WASHOUT]
    load = p_head * circuit.area_head - p_rod * circuit.area_rod
    if memory[STARTED] == 0.0:
        memory[STARTED], memory[FUNCTION], memory[SLOW_LOAD] = 1.0, HOLD, load
        for side in range(2):
            memory[AT_PRESSURE + side] = p_head if side == 0 else p_rod
            memory[AT_WASHED + side] = 0.0 if washout > 0.0 else memory[AT_PRESSURE + side]
    for side in range(2):
        p = p_head if side == 0 else p_rod
        washed = wash(washout, tick, p, memory[AT_PRESSURE + side], memory[AT_WASHED + side])
        memory[AT_RAMP_WASHED + side] = wash(
            ramp_washout, tick, washed, memory[AT_WASHED + side], memory[AT_RAMP_WASHED + side]
        )
        memory[AT_PRESSURE + side], memory[AT_WASHED + side] = p, washed
    v_d = shape_speed(wish[V], tick, gains[AT_SHAPING:AT_RULES], memory[AT_SHAPED:MEMORY])
    # the swing of an undamped load changes the sign of its force, and choosing by it would feed the
    # swing
    slow = -math.expm1(-gains[LOAD_CORNER] * tick) if gains[LOAD_CORNER] > 0.0 else 1.0
    memory[SLOW_LOAD] += slow * (load - memory[SLOW_LOAD])
    load = memory[SLOW_LOAD]
    rules = gains[AT_RULES:]
    now = int(memory[FUNCTION])
    function, status = select(
        now, memory[AGE], v_d, load, p_head, p_rod, p_supply, p_tank, circuit, rules
    )
    if function != now:
        memory[AGE] = 0.0
    memory[AGE] += tick
    memory[FUNCTION] = function

    gain, off = gains[FEEDBACK_GAIN + function], gains[OFF_GAIN]
    flow_head, flow_rod, back = circuit.area_head * v_d, circuit.area_rod * v_d, 0.0
    if METERED[function] == HEAD:
        back = gain * memory[AT_RAMP_WASHED]
        low = (
            p_head + rules[CROSS_DROP]
            if function == EXTEND_RESISTIVE_REGENERATION
            else p_tank + gains[LOW_PRESSURE]
        )
        flow_head -= back
        flow_rod += off * (p_rod - low)
    elif METERED[function] == ROD:
        back = gain * memory[AT_RAMP_WASHED + 1]
        flow_rod += back
        flow_head -= off * (p_head - (p_tank + gains[LOW_PRESSURE]))

    edges = NOTES + circuit.count
    if function == HOLD:
        flow_head = flow_rod = 0.0
        rest(circuit, command, note[NOTES:edges], note[edges:])
        limits = 0
    else:
        limits = give(
            function,
            flow_head,
            flow_rod,
            p_head,
            p_rod,
            p_supply,
            p_tank,
            gains[DROP_FLOOR],
            circuit,
            command,
            note[NOTES:edges],
            note[edges:],
        )
    note[0], note[1], note[2], note[3] = wish[X], wish[V], wish[A], wish[J]
    note[4], note[5], note[6], note[7] = v_d, function, status, load
    note[8], note[9], note[10], note[11] = back, flow_head, flow_rod, limits


def pack_pressure_feedback(
    *,
    tick: float,
    rules: np.ndarray,
    off_gain: float,
    low_pressure: float,
    feedback_gain: float | Mapping[str, float] = 0.0,
    washout: float = 0.0,
    ramp_washout: float = 0.0,
    drop_floor: float = 2.0e4,
    load_corner: float = 2.0 * math.pi,
    shaping: np.ndarray | None = None,
) -> np.ndarray:
    """The gains of `step`, shape (GAINS,).

    Args:
        tick: between samples [s].
        rules: of function selection, `ehbench.control.functions.pack_rules`.
        off_gain: inflow of the off-side chamber per pressure below its set-point [m³/(s·Pa)]; its
            pressure then follows with about off_gain·β_e/V [rad/s].
        low_pressure: set-point of the off-side chamber above tank [Pa].
        feedback_gain: K_p [m³/(s·Pa)], one number or one for each working function by name (others
            0); 0 is open loop.
        washout: corner ω_w [rad/s]; 0 for none, F(s) = 1.
        ramp_washout: corner ω_r [rad/s] of a second washout, ``F(s) = s/(s + ω_w)·s/(s + ω_r)``,
            which forgets a load that ramps along the stroke as well; 0 for none.
        drop_floor: least drop at which the inverse of a valve is taken [Pa].
        load_corner: of the low-pass through which the load force chooses the function [rad/s]; 0
            for none.
        shaping: of the commanded speed, `ehbench.control.trajectory.pack_shaping`; none by default.

    Raises:
        InputError: a number that is negative or not finite, an unknown function.
    """
    gains = np.zeros(GAINS)
    gains[[TICK, WASHOUT, RAMP_WASHOUT, OFF_GAIN, LOW_PRESSURE]] = (
        tick,
        washout,
        ramp_washout,
        off_gain,
        low_pressure,
    )
    gains[[DROP_FLOOR, LOAD_CORNER]] = drop_floor, load_corner
    if isinstance(feedback_gain, Mapping):
        for name, value in feedback_gain.items():
            if name not in FUNCTIONS[1:]:
                raise InputError(
                    f"no working function '{name}'", hint="there are " + ", ".join(FUNCTIONS[1:])
                )
            gains[FEEDBACK_GAIN + FUNCTIONS.index(name)] = value
    else:
        gains[FEEDBACK_GAIN:AT_SHAPING] = feedback_gain
    gains[AT_SHAPING:AT_RULES] = pack_shaping() if shaping is None else shaping
    gains[AT_RULES:] = rules
    if not (np.isfinite(gains).all() and (gains >= 0.0).all() and tick > 0 and drop_floor > 0):
        raise InputError(
            "a gain of the pressure feedback is negative or not finite",
            hint="tick and drop_floor are above 0, the rest 0 or more",
        )
    return gains


def note_channels(cylinder: str, edges: Sequence[str]) -> tuple[str, ...]:
    """Channel names of the note: ``<cylinder>.<name>``, then ``<edge>.flow_desired`` and
    ``<edge>.limits`` of each edge.

    Args:
        cylinder: its name.
        edges: names of the cylinder's edges as ``<cylinder>.<edge>``, in the rig file's order.
    """
    return (
        *(f"{cylinder}.{name}" for name in NOTE),
        *(f"{edge}.flow_desired" for edge in edges),
        *(f"{edge}.limits" for edge in edges),
    )


def entitled(circuit: Circuit, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the controller is given, shape (channels,)."""
    mask = np.zeros(channels, bool)
    at = PER_CYLINDER * circuit.cylinder
    mask[[at + P_HEAD, at + P_ROD, channels - 2, channels - 1]] = True
    return mask
