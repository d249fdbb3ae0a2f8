"""Which sensor of a cylinder says what the other sensors and the identified model deny.

Residuals are low-passed and compared with the deviation σ that a sound machine of this model may
have: the stroke against that of the joint's angle; the load force against what the mechanism asks
for, with any payload that the rig may carry, and with the payload that it carried until now; the
pressures of supply and tank against the rig file; a pressure that stays at one number against what
has changed since; one that jumps against what the flows can do in a tick. Each has a score that
sums ``e²/2σ² − drift`` over the correlation time, from 0 up, as those of `ehbench.control.monitor`.
A wrong force is the fault of the pressure that the flows of its chamber contradict the more; a
stroke and an angle that differ are named by the stroke."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.control.axis import Axis, inertias, load_at
from ehbench.control.measured import load_force, place_joints, pressures
from ehbench.control.records import constants
from ehbench.parts.cylinder import chamber_oil, linkage_of
from ehbench.parts.sample import LINE, OF, cylinders_in, entry, line_entry
from ehbench.physics.arm import work_size
from ehbench.runtime.compiled import kernel
from ehbench.vocabulary import setting


@dataclass(frozen=True)
class ScoreSettings:
    """Numbers of all scores of the monitor."""

    corner: float = setting(60.0, "rad/s", "low-pass of what is compared", "chosen")
    drift: float = setting(4.0, "", "taken off a score in each correlation time", "chosen")
    alarm: float = setting(30.0, "", "score h of a fault", "e^26 correlation times")


@dataclass(frozen=True)
class SensorSettings:
    """Deviations of a sound machine from its model, by which sensors are judged."""

    stroke: float = setting(0.004, "", "of a stroke from the angle's, of the stroke", "pins to 1 %")
    force: float = setting(0.03, "", "of the load force, of supply pressure times area", "chosen")
    unsure: float = setting(0.3, "", "of inertial and damping forces, of themselves", "chosen")
    payload: float = setting(0.2, "", "by which a payload passes those of the rig file", "chosen")
    line: float = setting(
        0.08, "", "of supply and tank, of the supply pressure", "it droops by 3 %"
    )
    moving: float = setting(0.02, "m/s", "speed of others that stops load and supply", "chosen")
    drawn: float = setting(
        0.7, "", "of the supply's flow, beyond which its pressure may fall", "chosen"
    )
    ends: float = setting(0.01, "", "of the stroke, where no load is weighed", "end stops")
    jump: float = setting(3.0, "", "of a pressure in a tick, by twice the supply's flow", "chosen")
    still: float = setting(0.05, "s", "after which a pressure that stays is doubted", "it is noisy")
    usual: float = setting(5.0, "", "by which it stays for longer than ever before", "chosen")
    memory: float = setting(3.0, "rad/s", "decay of what tells two pressures apart", "chosen")
    carried: float = setting(0.1, "rad/s", "low-pass of the carried payload", "a drift shows")


SCORES, SENSORS = constants(ScoreSettings()), constants(SensorSettings())
STROKE, LOAD, CHANGED, SUPPLY, TANK = range(5)
STUCK_HEAD, STUCK_ROD, JUMP_HEAD, JUMP_ROD, RESIDUALS = range(5, 10)
HEAD, ROD = 0, 1  # chambers


class Sensors(NamedTuple):
    """The memory of the checks of one cylinder's sensors.

    ``angles`` and ``work`` are scratch; ``low``, shape (RESIDUALS,), low-passed residuals,
    ``scores``, shape (RESIDUALS,), theirs; ``speed``, shape (2,), the speed [m/s] low-passed once
    and twice; ``carried``, shape (1,), the payload [kg]; ``doubts``, shape (2,), what the flows say
    against each chamber's pressure [m²/s²]; ``still``, shape (2, 5), of each chamber the pressure
    that stays [Pa], with the demanded force and the other chamber's force [N] when it came, for how
    long [s], and for how long one stayed at most before; ``jumped``, shape (2,), by how much each
    pressure jumped [Pa]. ``lines`` are the pressures [Pa] of supply and tank, nan where they follow
    the load; ``payload`` [kg] at the tip is the heaviest, ``steady`` whether it stays the same;
    ``tick`` [s]."""

    angles: np.ndarray
    work: np.ndarray
    low: np.ndarray
    speed: np.ndarray
    carried: np.ndarray
    scores: np.ndarray
    doubts: np.ndarray
    still: np.ndarray
    jumped: np.ndarray
    lines: np.ndarray
    payload: float
    steady: bool
    tick: float


def sensors_of(axis: Axis, tank: float, payload: float, steady: bool, tick: float) -> Sensors:
    """The checks of a cylinder's sensors before the first tick.

    Args:
        axis: of the cylinder.
        tank: pressure of the tank [Pa].
        payload: the heaviest that the rig may carry, at the tip [kg].
        steady: whether no payload is taken up or let go.
        tick: between samples [s].
    """
    supply, joints = axis.circuit.supply[0], axis.mechanism.links.shape[0]
    fixed = supply.margin == supply.gas_volume == 0.0
    return Sensors(
        np.zeros(joints),
        np.zeros(work_size(joints) + joints),
        np.full(RESIDUALS, math.nan),
        np.full(2, math.nan),
        np.full(1, math.nan),
        np.zeros(RESIDUALS),
        np.zeros(2),
        np.zeros((2, 5)),
        np.zeros(2),
        np.array([supply.pressure if fixed else math.nan, tank]),
        float(payload),
        steady,
        float(tick),
    )


@kernel
def _low_pass(value, which, sensors):
    """(a residual behind the low-pass, what that took off it)."""
    if math.isnan(sensors.low[which]):
        sensors.low[which] = value
    off = value - sensors.low[which]
    if math.isfinite(off):
        sensors.low[which] += (
            SCORES.corner * sensors.tick / (1.0 + SCORES.corner * sensors.tick) * off
        )
    return sensors.low[which], off


@kernel
def _load(sample, v, axis, sensors):
    """(what the load force is beyond all payloads [N], beyond the payload that was carried [N], the
    variance of both, the demanded force [N])."""
    cylinder, number = axis.cylinder, axis.circuit.cylinder
    place_joints(sample, axis, sensors.angles)
    inertia, tip = inertias(axis, sensors.angles, sensors.work)
    load = load_at(axis, sample[entry(number, OF.q)], inertia, sensors.work)
    measured = load_force(pressures(sample, number), cylinder.area_head, cylinder.area_rod)
    damped = (load.damping + cylinder.friction_viscous) * v
    curved = load.mass * load.curve * v * v
    low, unsteady = _low_pass(measured - load.gravity - damped + curved, LOAD, sensors)
    low, _ = _low_pass(low, CHANGED, sensors)  # twice, as the speed for its acceleration
    a = SCORES.corner * (sensors.speed[0] - sensors.speed[1])
    pushed = load.mass * a
    pressed = SENSORS.force * axis.circuit.supply[0].pressure * cylinder.area_head
    heavy = load.pull * sensors.payload
    spare = SENSORS.payload * abs(heavy)
    e = low - pushed
    e -= min(max(e, min(heavy, 0.0) - spare), max(heavy, 0.0) + spare)
    each = load.pull + tip / (load.lever * load.lever) * a  # what a kilogram adds
    least = pressed / max(sensors.payload, 1.0)  # where a kilogram adds less, no payload is seen
    share = SENSORS.carried * sensors.tick
    if math.isnan(sensors.carried[0]):
        sensors.carried[0], share = 0.0, 1.0
    changed = low - pushed - sensors.carried[0] * each
    inertial = pushed + sensors.carried[0] * (each - load.pull)
    if math.isfinite(changed):
        sensors.carried[0] += share * changed * each / (each * each + least * least)
    unsure = SENSORS.unsure**2 * (inertial * inertial + damped * damped)
    unsure += pressed**2 + cylinder.friction_coulomb**2 + 0.25 * unsteady * unsteady
    return e, changed, unsure, load.gravity + damped - curved + pushed


@kernel
def _still(side, p, x, demand, axis, sensors):
    """What has changed [N] since a chamber's pressure has come to the number that it stays at; how
    far it jumped is remembered.
    """
    cylinder, row = axis.cylinder, sensors.still[side]
    pressure = p.head if side == HEAD else p.rod
    other = p.rod * cylinder.area_rod if side == HEAD else p.head * cylinder.area_head
    flow = 2.0 * SENSORS.jump * axis.circuit.supply[0].flow_limit
    most = flow * sensors.tick * cylinder.bulk_modulus / chamber_oil(cylinder, side, x)
    rise = pressure - row[0] if row[3] > 0.0 else 0.0
    sensors.jumped[side] *= 1.0 - SENSORS.memory * sensors.tick
    sensors.jumped[side] += rise - min(max(rise, -most), most)
    if pressure != row[0]:
        row[4] = max(row[4], row[3])  # a coarse sensor stays for long
        row[0], row[1], row[2], row[3] = pressure, demand, other, 0.0
    row[3] += sensors.tick
    least = SENSORS.force * axis.circuit.supply[0].pressure  # a sensor may end at zero
    sound = pressure < least or row[3] < max(SENSORS.still, SENSORS.usual * row[4])
    return 0.0 if sound else abs(demand - row[1]) + abs(other - row[2])


@kernel
def _doubt(r_head, r_rod, axis, sensors):
    """Remember what the flows of a chamber say against its pressure."""
    head, rod = r_head / axis.cylinder.area_head, r_rod / axis.cylinder.area_rod
    fade, doubts = 1.0 - SENSORS.memory * sensors.tick, sensors.doubts
    doubts[HEAD] = max(doubts[HEAD] * fade, head * head)
    doubts[ROD] = max(doubts[ROD] * fade, rod * rod)


@kernel
def _score(which, e, variance, sensors):
    """Add a residual of this tick to its score; one that is not finite says nothing."""
    gain = 0.5 * e * e / variance - SCORES.drift
    if math.isfinite(gain):
        score = sensors.scores[which] + SCORES.corner * sensors.tick * gain
        sensors.scores[which] = max(score, 0.0)


@kernel
def wrong_sensor(sample, r_head, r_rod, calm, axis, sensors):
    """One tick of the checks: the entry of the sample that is wrong, −1 for none.

    Args:
        sample: what the machine measured [SI].
        r_head, r_rod: what passed the chambers beyond the expected, low-passed [m³/s].
        calm: whether the supply gives what is drawn, as far as this cylinder knows.
        axis: of the cylinder.
        sensors: of `sensors_of`.
    """
    number, cylinder = axis.circuit.cylinder, axis.cylinder
    cylinders = cylinders_in(sample.shape[0])
    x, v = sample[entry(number, OF.x)], sample[entry(number, OF.v)]
    at, lever, _ = linkage_of(cylinder, sample[entry(number, OF.q)])
    if math.isnan(sensors.speed[0]):
        sensors.speed[:] = v
    share = SCORES.corner * sensors.tick / (1.0 + SCORES.corner * sensors.tick)
    sensors.speed[0] += share * (v - sensors.speed[0])
    sensors.speed[1] += share * (sensors.speed[0] - sensors.speed[1])
    _doubt(r_head, r_rod, axis, sensors)
    ends = SENSORS.ends * cylinder.stroke  # where a stop carries load
    alone = ends < x < cylinder.stroke - ends
    for c in range(cylinders):
        alone = alone and (c == number or abs(sample[entry(c, OF.v)]) < SENSORS.moving)
    e, _ = _low_pass(x - at, STROKE, sensors)
    _score(STROKE, e, (SENSORS.stroke * cylinder.stroke) ** 2, sensors)
    e, changed, variance, demand = _load(sample, v, axis, sensors)
    _score(LOAD, e if alone else 0.0, variance, sensors)
    _score(CHANGED, changed if alone and sensors.steady else 0.0, variance, sensors)
    variance = (SENSORS.force * axis.circuit.supply[0].pressure * cylinder.area_head) ** 2
    for side in range(2):
        e = _still(side, pressures(sample, number), x, demand, axis, sensors)
        _score(STUCK_HEAD + side, e, variance, sensors)
        _score(JUMP_HEAD + side, sensors.jumped[side] * cylinder.area_head, variance, sensors)
    variance = (SENSORS.line * axis.circuit.supply[0].pressure) ** 2
    for line in range(2):
        p = sample[line_entry(cylinders, LINE.p_supply if line == 0 else LINE.p_tank)]
        e, _ = _low_pass(p - sensors.lines[line], SUPPLY + line, sensors)
        low = line == 0 and not (calm and alone)  # it may fall where much is drawn
        _score(SUPPLY + line, max(e, 0.0) if low else e, variance, sensors)
    moved = abs(lever * sample[entry(number, OF.qd)] - v) < SENSORS.moving
    return _blamed(number, cylinders, moved, sensors)


@kernel
def _blamed(number, cylinders, moved, sensors):
    """The entry of the sample whose score is a fault, −1 for none; ``moved`` where stroke and angle
    say one speed, so that a wrong load force is a pressure's fault."""
    doubts, alarm = sensors.doubts, SCORES.alarm
    if sensors.scores[STROKE] > alarm:
        return entry(number, OF.x)
    for side in range(2):
        if max(sensors.scores[STUCK_HEAD + side], sensors.scores[JUMP_HEAD + side]) > alarm:
            return entry(number, OF.p_head if side == HEAD else OF.p_rod)
    if sensors.scores[LOAD] > alarm or sensors.scores[CHANGED] > alarm:
        if not moved:
            return entry(number, OF.x)
        return entry(number, OF.p_head if doubts[HEAD] >= doubts[ROD] else OF.p_rod)
    if sensors.scores[SUPPLY] > alarm:
        return line_entry(cylinders, LINE.p_supply)
    return line_entry(cylinders, LINE.p_tank) if sensors.scores[TANK] > alarm else -1
