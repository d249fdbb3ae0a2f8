"""Which valve of a cylinder does not follow its command, from what passes both chambers.

The piston and the pressures say what flowed, ``A v + leakage + (V/β) ṗ``; commands and drops say
what each edge was to pass. The difference r of both chambers is compared with what each valve would
make of it: a valve that stays shut lacks its flow, one that stays open passes more. With d the
direction of a valve's flow in the plane of both chambers, ``r∥ = r·d`` and r⊥ what it leaves
unexplained, its score sums ``(r∥² − κ r⊥²)/2σ² − drift`` over the correlation time of r, from 0
up (Page 1954). A score beyond h is a fault: one of noise that has the deviation σ and this
correlation time gets there more rarely than once in ``e^(h/2)`` correlation times, for the moments
of its growth are finite up to ``E[e^(score/2)]``."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.control.axis import Axis
from ehbench.control.functions import able_functions
from ehbench.control.measured import pressure_entries, pressures
from ehbench.control.records import constants
from ehbench.control.sensor_checks import SCORES, SENSORS, Sensors, sensors_of, wrong_sensor
from ehbench.parts.cylinder import chamber_oil
from ehbench.parts.edge import edge_flow
from ehbench.parts.nodes import SUPPLY
from ehbench.parts.sample import OF, entry
from ehbench.parts.supply import rail_pressure
from ehbench.runtime.compiled import kernel
from ehbench.vocabulary import setting
from ehbench.vocabulary.codes import HOLD


@dataclass(frozen=True)
class MonitorSettings:
    """Numbers of the monitor of valves."""

    speed: float = setting(5.0e-3, "m/s", "deviation of a low-passed speed", "a 1 ms difference")
    model: float = setting(0.15, "", "deviation of a flow by its map, of the flow", "chosen")
    opening: float = setting(0.03, "", "deviation of a deadband, of the range", "0.3 V of 10 V")
    share: float = setting(0.33, "", "bound of what a shut valve lacks beside its flow", "chosen")
    excess: float = setting(2.0, "", "least flow of an open valve, of its command's", "chosen")
    unexplained: float = setting(16.0, "", "weight κ of what a valve leaves unexplained", "chosen")


MONITOR = constants(MonitorSettings())
SHUT, OPEN = 0, 1
# columns of a valve: its command behind the lag [V], then low-passed what it passes into the head
# and the rod end [m³/s], what an opening by ``opening`` more adds, and what it passes wide open
LATE, HEAD, ROD, MORE_HEAD, MORE_ROD, WIDE_HEAD, WIDE_ROD, COLUMNS = range(8)
PASSED, PRESSURE = 0, 1  # columns of a chamber: flow into it [m³/s] and pressure [Pa], low-passed


class Monitor(NamedTuple):
    """The memory of the monitor of one cylinder.

    ``valves``, shape (n,), are numbers of the plant's valves; ``without``, shape (n, functions),
    what the circuit can do when one of them is out of service. ``rows``, shape (n, COLUMNS),
    ``chambers``, shape (2, 2), and ``scores``, shape (n, 2), of a valve that stays shut and open;
    ``fault``, shape (1,), the code of `valve_fault`; ``alarm``, shape (1,), what stops the trial:
    the entry of a wrong sensor in the sample, from 1 on, or the number of a valve that stays open,
    from −1 down. ``tick`` and ``lag`` [s]."""

    valves: np.ndarray
    without: np.ndarray
    rows: np.ndarray
    chambers: np.ndarray
    scores: np.ndarray
    fault: np.ndarray
    alarm: np.ndarray
    tick: float
    lag: float
    sensors: Sensors


def monitor_of(
    axis: Axis, tick: float, lag: float, tank: float, payload: float, steady: bool
) -> Monitor:
    """The monitor of a cylinder before the first tick.

    Args:
        axis: of the cylinder.
        tick: between samples [s].
        lag: of the slowest valve [s].
        tank: pressure of the tank [Pa].
        payload: the heaviest that the rig may carry, at the tip [kg].
        steady: whether no payload is taken up or let go.
    """
    circuit = axis.circuit
    valves = np.unique(circuit.edges.valve[circuit.first : circuit.first + circuit.count])
    return Monitor(
        valves,
        np.array([able_functions(circuit, valve) for valve in valves], np.int64),
        np.zeros((valves.size, COLUMNS)),
        np.full((2, 2), math.nan),
        np.zeros((valves.size, 2)),
        np.zeros(1),
        np.zeros(1),
        float(tick),
        float(lag),
        sensors_of(axis, tank, payload, steady, tick),
    )


def watched(axis: Axis, channels: int) -> np.ndarray:
    """True for the channels of a rig's sample that the monitor reads, shape (channels,)."""
    cylinder, mask = axis.circuit.cylinder, np.zeros(channels, bool)
    mask[pressure_entries(cylinder, channels)] = True
    mask[[entry(cylinder, OF.x), entry(cylinder, OF.v)]] = True
    return mask


@kernel
def _expected(valve, opening, p, circuit):
    """Flow [m³/s] of a valve at an opening [V] (into the head end, into the rod end)."""
    head = rod = 0.0
    end = 2 + 2 * circuit.cylinder
    for i in range(circuit.first, circuit.first + circuit.count):
        edge = circuit.edges[i]
        if edge.valve != valve or edge.from_node == edge.to_node:
            continue
        at = (p.supply, p.tank, p.head, p.rod)
        start = at[edge.from_node - end + 2 if edge.from_node >= end else edge.from_node]
        stop = at[edge.to_node - end + 2 if edge.to_node >= end else edge.to_node]
        if edge.from_node == SUPPLY:
            start = rail_pressure(start, stop, circuit.supply[0])
        flow = edge_flow(start - stop, opening, edge, circuit.maps)
        head += flow if edge.to_node == end else (-flow if edge.from_node == end else 0.0)
        rod += flow if edge.to_node == end + 1 else (-flow if edge.from_node == end + 1 else 0.0)
    return head, rod


@kernel
def _follow(p, command, circuit, monitor):
    """Let the valves' flows pass their lag and the low-pass."""
    late = monitor.tick / (monitor.tick + monitor.lag)
    slow = SCORES.corner * monitor.tick / (1.0 + SCORES.corner * monitor.tick)
    for i in range(monitor.valves.shape[0]):
        valve, row = monitor.valves[i], monitor.rows[i]
        row[LATE] += late * (command[valve] - row[LATE])
        head, rod = _expected(valve, row[LATE], p, circuit)
        shift = MONITOR.opening * (circuit.highest[valve] - circuit.lowest[valve])
        more = row[LATE] + (shift if row[LATE] >= 0.0 else -shift)
        more_head, more_rod = _expected(valve, more, p, circuit)
        wide = circuit.lowest[valve] if row[LATE] < 0.0 else circuit.highest[valve]
        row[WIDE_HEAD], row[WIDE_ROD] = _expected(valve, wide, p, circuit)
        row[HEAD] += slow * (head - row[HEAD])
        row[ROD] += slow * (rod - row[ROD])
        row[MORE_HEAD] += slow * (more_head - head - row[MORE_HEAD])
        row[MORE_ROD] += slow * (more_rod - rod - row[MORE_ROD])


@kernel
def _chamber(side, flow, p, v, x, axis, monitor):
    """(what passed into a chamber beyond the expected ``flow`` [m³/s], its variance)."""
    row, chamber = axis.cylinder, monitor.chambers[side]
    area = row.area_head if side == 0 else row.area_rod
    across = row.leakage_internal * (p.head - p.rod)
    if side == 0:
        pressure = p.head
        passed = area * v + across + row.leakage_head * (pressure - p.tank)
    else:
        pressure = p.rod
        passed = row.leakage_rod * (pressure - p.tank) - area * v - across
    if math.isnan(chamber[PASSED]):
        chamber[PASSED], chamber[PRESSURE] = passed, pressure
    slow = SCORES.corner * monitor.tick / (1.0 + SCORES.corner * monitor.tick)
    unsteady = passed - chamber[PASSED]
    chamber[PASSED] += slow * unsteady
    chamber[PRESSURE] += slow * (pressure - chamber[PRESSURE])
    pressed = chamber_oil(row, side, x) / row.bulk_modulus
    pressed *= SCORES.corner * (pressure - chamber[PRESSURE])
    variance = (MONITOR.speed * area) ** 2 + 0.25 * (unsteady * unsteady + pressed * pressed)
    column = HEAD if side == 0 else ROD
    for i in range(monitor.rows.shape[0]):
        variance += (MONITOR.model * monitor.rows[i, column]) ** 2
        variance += monitor.rows[i, column + MORE_HEAD - HEAD] ** 2
    return chamber[PASSED] + pressed - flow, variance


@kernel
def _gain(kind, row, r_head, r_rod, variance):
    """What a correlation time adds to the score of a valve that stays shut or open."""
    head, rod = row[HEAD], row[ROD]
    if kind == OPEN:
        head, rod = row[WIDE_HEAD], row[WIDE_ROD]
    size = math.hypot(head, rod)
    if size == 0.0:
        return -SCORES.drift
    along = (r_head * head + r_rod * rod) / size
    across = (r_head * rod - r_rod * head) / size
    commanded = math.hypot(row[HEAD], row[ROD])
    if kind == SHUT:
        fits = abs(along + commanded) < MONITOR.share * commanded
    else:
        fits = along > (MONITOR.excess - 1.0) * commanded
    explained = along * along if fits else 0.0
    return 0.5 * (explained - MONITOR.unexplained * across * across) / variance - SCORES.drift


@kernel
def watch(sample, command, axis, monitor):
    """One tick of the monitor; returns the code of `valve_fault`: 0 for none, the place of the
    valve among the cylinder's from 1 on, negative where it stays open.

    At a fault the circuit loses what a shut valve takes from it, so that the controller moves the
    load by the other valves; where one stays open, or a sensor is wrong, the ``alarm`` stops the
    trial.

    Args:
        sample: what the machine measured, [SI]; read are the cylinder's stroke, speed and pressures
            and those of supply and tank.
        command: [V] of every valve of the rig, as they are sent now.
        axis: of the cylinder; its circuit's ``able`` is written.
        monitor: of `monitor_of`.
    """
    circuit = axis.circuit
    p = pressures(sample, circuit.cylinder)
    x, v = sample[entry(circuit.cylinder, OF.x)], sample[entry(circuit.cylinder, OF.v)]
    head = rod = drawn = 0.0
    for i in range(monitor.rows.shape[0]):
        head += monitor.rows[i, HEAD]
        rod += monitor.rows[i, ROD]
        drawn += max(monitor.rows[i, HEAD], 0.0) + max(monitor.rows[i, ROD], 0.0)
    r_head, by_head = _chamber(0, head, p, v, x, axis, monitor)
    r_rod, by_rod = _chamber(1, rod, p, v, x, axis, monitor)
    share, shut = SCORES.corner * monitor.tick, False
    doubted = monitor.sensors.scores.any()  # what a sensor says wrongly is no valve's fault
    for kind in (SHUT, OPEN):
        for i in range(monitor.valves.shape[0]):
            gain = _gain(kind, monitor.rows[i], r_head, r_rod, by_head + by_rod)
            if kind == OPEN and shut:  # what a shut valve lacks, another may drain by chance only
                gain = min(gain, -SCORES.drift)
            if kind == SHUT:
                shut = shut or gain > 0.0
                gain = min(gain, 0.0) if doubted else gain
            score = monitor.scores[i, kind] = max(monitor.scores[i, kind] + share * gain, 0.0)
            known = monitor.fault[0]  # an open valve may look like another that is shut, at first
            if score > SCORES.alarm and (known == 0.0 or (known > 0.0 and kind == OPEN)):
                monitor.fault[0] = i + 1.0 if kind == SHUT else -i - 1.0
                for f in range(circuit.able.shape[0]):
                    circuit.able[f] = monitor.without[i, f] if kind == SHUT else f == HOLD
                if kind == OPEN:
                    monitor.alarm[0] = -1.0 - monitor.valves[i]
    calm = drawn < SENSORS.drawn * circuit.supply[0].flow_limit and not monitor.scores.any()
    wrong = wrong_sensor(sample, r_head, r_rod, calm, axis, monitor.sensors)
    if wrong >= 0 and monitor.alarm[0] == 0.0:
        monitor.alarm[0] = 1.0 + wrong
    _follow(p, command, circuit, monitor)
    return monitor.fault[0]
