"""What a controller learns of its flow maps while it moves: a gain and a shift of the deadband for
each edge, within bounds; derivation in docs/explanation/arc.md.

A map says ``Q(Δp, u)``; the valve is taken to pass ``gain·Q(Δp, u − shift)``. Both chambers show
what really passed, by their pressure and the piston's speed."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control.functions import (
    HEAD_ROD,
    HEAD_TANK,
    ROD_HEAD,
    ROD_TANK,
    SUPPLY_HEAD,
    SUPPLY_ROD,
    Circuit,
)
from ehbench.control.measured import Pressures
from ehbench.control.records import constants
from ehbench.runtime.compiled import kernel
from ehbench.vocabulary import setting
from ehbench.vocabulary.codes import AGAINST, FAINT, REVERSED, SATURATED

GAIN, SHIFT = 0, 1
# columns of an edge: (co)variances of its gain and shift, flow [m³/s] and slope [m³/(s·V)] behind
# the valve's lag, then behind the low-pass as well; opening [V] behind its hysteresis; gain and
# shift [V] as they are estimated
VAR_GAIN, COVARIANCE, VAR_SHIFT, LATE_FLOW, LATE_SLOPE, SLOW_FLOW, SLOW_SLOPE, SPOOL = range(8)
BEST_GAIN, BEST_SHIFT, EDGE_COLUMNS = 8, 9, 10
FLOW, PRESSURE = 0, 1  # columns of a chamber: what passes [m³/s] and its pressure, low-passed


@dataclass(frozen=True)
class MapLearningSettings:
    """Numbers of the estimator of flow maps; "largest" is the flow at the largest speed."""

    corner: float = setting(2.0, "k1", "low-pass behind which flows are compared", "chosen")
    quiet: float = setting(2.0, "1/corner", "time after a change of function", "low-pass settles")
    scatter: float = setting(0.003, "", "error of a comparison, of the largest", "chosen")
    least: float = setting(0.015, "", "flow that is compared, of the largest", "five times scatter")
    squeezed: float = setting(0.1, "", "error of the oil's compression", "its bulk modulus")
    unsteady: float = setting(0.05, "", "error of what the low-pass delays", "unknown lags")
    apart: float = setting(0.05, "", "flows with independent errors, of the largest", "chosen")
    steady: float = setting(0.04, "corner", "weight of a steady flow", "docs arc.md")
    narrow: float = setting(0.15, "V", "opening from which a slope is known", "chosen")
    first: float = setting(0.4, "", "standard errors at the start, of the bounds", "chosen")
    known: float = setting(0.1, "", "the same of a deadband of the map", "below a gain's, in flow")


MAP_LEARNING = constants(MapLearningSettings())


class MapMemory(NamedTuple):
    """``trim``, (gain, shift [V]) of each edge, shape (edges, 2); ``edges`` and ``chambers``,
    columns above; ``into``, +1 where an edge's flow enters the head or rod end, −1 where it leaves;
    ``clock`` [s] of quiet flow; ``added``, by the last correction, to the flows into both ends
    [m³/s]."""

    trim: np.ndarray
    edges: np.ndarray
    chambers: np.ndarray
    into: np.ndarray
    clock: np.ndarray
    added: np.ndarray


def map_memory(circuit: Circuit) -> MapMemory:
    """The memory before the first tick; what is learnt is the circuit's ``trim``."""
    into = np.zeros((circuit.count, 2))
    enters = {
        SUPPLY_HEAD: (1, 0),
        HEAD_TANK: (-1, 0),
        SUPPLY_ROD: (0, 1),
        ROD_TANK: (0, -1),
        HEAD_ROD: (-1, 1),
        ROD_HEAD: (1, -1),
    }
    for path, ends in enters.items():
        if circuit.paths[path] >= 0:
            into[circuit.paths[path] - circuit.first] = circuit.along[path] * np.array(ends)
    edges = np.zeros((circuit.count, EDGE_COLUMNS))
    return MapMemory(circuit.trim, edges, np.zeros((2, 2)), into, np.zeros(1), np.zeros(2))


class Seen(NamedTuple):
    """Of one tick: speed ``v`` [m/s], pressures ``p``, and the ``oil`` in the chambers."""

    v: float
    p: Pressures
    oil: Any


@kernel
def begin(p, onset, gains, maps):
    """Write the memory of the first tick; ``onset`` [V] of each edge, 0 where it is not known."""
    maps.chambers[0, PRESSURE], maps.chambers[1, PRESSURE] = p.head, p.rod
    maps.chambers[0, FLOW] = maps.chambers[1, FLOW] = 0.0
    for i in range(maps.edges.shape[0]):
        maps.trim[i, GAIN], maps.trim[i, SHIFT] = 1.0, 0.0
        maps.edges[i, BEST_GAIN], maps.edges[i, BEST_SHIFT] = 1.0, 0.0
        maps.edges[i, VAR_GAIN] = (MAP_LEARNING.first * gains.map_error) ** 2
        first = MAP_LEARNING.known if onset[i] != 0.0 else MAP_LEARNING.first
        maps.edges[i, VAR_SHIFT] = (first * gains.deadband_error) ** 2


@kernel
def follow(quiet, allocated, command, axis, gains, maps):
    """Let flows and slopes of the edges pass the valve's lag and the low-pass; whether they are
    quiet for long enough to be compared. ``allocated`` are the desired flows, then the limits, of
    all edges. What an edge was to pass is taken where its hysteresis, as far as its map has one,
    holds it."""
    circuit, tick = axis.circuit, gains.tick
    late = tick / (tick + gains.valve_lead)
    slow = tick * MAP_LEARNING.corner * gains.position_bandwidth
    slow /= 1.0 + slow
    for i in range(circuit.count):
        edge, flow, slope = circuit.edges[circuit.first + i], allocated[i], 0.0
        bits = int(allocated[circuit.count + i])
        if bits & (SATURATED | AGAINST | REVERSED | FAINT) != 0:
            quiet = False
        if bits & (AGAINST | REVERSED) != 0:
            flow = 0.0
        row, half = maps.edges[i], 0.5 * circuit.play[i]
        reach = edge.sign * command[edge.valve]
        row[SPOOL] = min(max(row[SPOOL], reach - half), reach + half)
        if flow != 0.0:
            wide = edge.sign * (command[edge.valve] - axis.onset[i]) - maps.trim[i, SHIFT]
            slope = flow / max(wide, MAP_LEARNING.narrow)
            flow -= slope * (reach - row[SPOOL])
        row[LATE_FLOW] += late * (flow - row[LATE_FLOW])
        row[LATE_SLOPE] += late * (slope - row[LATE_SLOPE])
        row[SLOW_FLOW] += slow * (row[LATE_FLOW] - row[SLOW_FLOW])
        row[SLOW_SLOPE] += slow * (row[LATE_SLOPE] - row[SLOW_SLOPE])
    maps.clock[0] = maps.clock[0] + tick if quiet else 0.0
    return maps.clock[0] > MAP_LEARNING.quiet / (MAP_LEARNING.corner * gains.position_bandwidth)


@kernel
def learn_maps(quiet, resting, seen, allocated, command, axis, gains, maps):
    """Estimate corrections by what has passed both chambers, and move those in force towards
    them; ``allocated`` as in `follow`.

    Least squares in which a comparison counts by how far the flow has gone since the last, not by
    the time that it took: an error at one opening stays while the opening stays, and where speeding
    up counts like slowing down, what is late in both, such as hysteresis, cancels. In motion
    corrections go at ``map_bandwidth`` at most, at standstill, where no valve moves the load, at
    k1."""
    ready = follow(quiet, allocated, command, axis, gains, maps)
    maps.added[0] = maps.added[1] = 0.0
    v, p, oil = seen.v, seen.p, seen.oil
    corner = MAP_LEARNING.corner * gains.position_bandwidth
    slow = gains.tick * corner
    slow /= 1.0 + slow
    circuit = axis.circuit
    for side in range(2):
        chamber = maps.chambers[side]
        area = circuit.area_head if side == 0 else circuit.area_rod
        rate = oil.bulk * (oil.head if side == 0 else oil.rod)
        passed = area * v + oil.lost_head if side == 0 else -(area * v + oil.lost_rod)
        pressure = p.head if side == 0 else p.rod
        chamber[FLOW] += slow * (passed - chamber[FLOW])
        chamber[PRESSURE] += slow * (pressure - chamber[PRESSURE])
        pressed = area / rate * corner * (pressure - chamber[PRESSURE])
        if not ready:
            continue
        maximum = area * gains.speed_correction
        variance = (MAP_LEARNING.scatter * maximum) ** 2 + (MAP_LEARNING.squeezed * pressed) ** 2
        variance += (MAP_LEARNING.unsteady * (passed - chamber[FLOW])) ** 2
        weight = MAP_LEARNING.steady + abs(changed(side, maps)) / (MAP_LEARNING.apart * maximum)
        variance /= corner * gains.tick * min(weight, 1.0)
        correct(side, chamber[FLOW] + pressed, variance, MAP_LEARNING.least * maximum, maps)
    approach(ready, gains.position_bandwidth if resting else gains.map_bandwidth, gains, maps)


@kernel
def changed(side, maps):
    """Change of the flow [m³/s] into a chamber within the time of the low-pass."""
    flow = 0.0
    for i in range(maps.edges.shape[0]):
        row = maps.edges[i]
        flow += maps.into[i, side] * (row[LATE_FLOW] - row[SLOW_FLOW])
    return flow


@kernel
def by_correction(row, trim):
    """What 1 of gain and 1 V of shift add to the flow [m³/s] that was to pass an edge."""
    return row[SLOW_FLOW] / trim[GAIN], -row[SLOW_SLOPE]


@kernel
def correct(side, passed, variance, minimum, maps):
    """Correct the edges at a chamber by the flow [m³/s] that ``passed`` into it; an edge must pass
    ``minimum`` to be corrected."""
    error, spread = passed, 0.0
    for i in range(maps.edges.shape[0]):
        row, way = maps.edges[i], maps.into[i, side]
        per_gain, per_shift = by_correction(row, maps.trim[i])
        more = per_gain * (row[BEST_GAIN] - maps.trim[i, GAIN])
        more += per_shift * (row[BEST_SHIFT] - maps.trim[i, SHIFT])
        error -= way * (row[SLOW_FLOW] + more)
        if way != 0.0 and abs(row[SLOW_FLOW]) > minimum:
            spread += row[VAR_GAIN] * per_gain * per_gain + row[VAR_SHIFT] * per_shift * per_shift
            spread += 2.0 * row[COVARIANCE] * per_gain * per_shift
    whole = variance + spread
    for i in range(maps.edges.shape[0]):
        row, way = maps.edges[i], maps.into[i, side]
        if way == 0.0 or abs(row[SLOW_FLOW]) <= minimum:
            continue
        per_gain, per_shift = by_correction(row, maps.trim[i])
        by_gain = row[VAR_GAIN] * per_gain + row[COVARIANCE] * per_shift
        by_shift = row[COVARIANCE] * per_gain + row[VAR_SHIFT] * per_shift
        row[VAR_GAIN] -= by_gain * by_gain / whole
        row[COVARIANCE] -= by_gain * by_shift / whole
        row[VAR_SHIFT] -= by_shift * by_shift / whole
        row[BEST_GAIN] += way * by_gain / whole * error
        row[BEST_SHIFT] += way * by_shift / whole * error


@kernel
def within(row, gains):
    """(gain, shift [V]) of an edge within ``map_error`` and ``deadband_error``: what one may not
    take the other does, as far as they correlate."""
    widest, maximum = 1.0 + gains.map_error, gains.deadband_error
    gain = min(max(row[BEST_GAIN], 1.0 / widest), widest)
    shift = row[BEST_SHIFT]
    if row[VAR_GAIN] > 0.0:
        shift += row[COVARIANCE] / row[VAR_GAIN] * (gain - row[BEST_GAIN])
    bounded = min(max(shift, -maximum), maximum)
    if row[VAR_SHIFT] > 0.0:
        gain += row[COVARIANCE] / row[VAR_SHIFT] * (bounded - shift)
    return min(max(gain, 1.0 / widest), widest), bounded


@kernel
def approach(ready, rate, gains, maps):
    """Let the corrections in force follow the estimates at a ``rate`` [rad/s]; what they ``added``
    counts where flows are compared."""
    share = min(rate * gains.tick, 1.0)
    for i in range(maps.edges.shape[0]):
        row, trim = maps.edges[i], maps.trim[i]
        gain, shift = within(row, gains)
        gain, shift = share * (gain - trim[GAIN]), share * (shift - trim[SHIFT])
        per_gain, per_shift = by_correction(row, trim)
        added = gain * per_gain + shift * per_shift if ready else 0.0
        maps.added[0] += maps.into[i, 0] * added
        maps.added[1] += maps.into[i, 1] * added
        trim[GAIN] += gain
        trim[SHIFT] += shift
