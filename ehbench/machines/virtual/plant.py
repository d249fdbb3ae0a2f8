"""The virtual bench as flat tables: what a row of each holds, and where things stand in its state.

State, one flat array: the states of the model's plant, the pump's flow; then memory: hysteresis per
valve, sensor lags per raw channel, speed filter (3) per cylinder, delay line, its position. Raw
channels: ``q, x, p_head, p_rod`` of each cylinder, then ``p_supply, p_tank``."""

from typing import NamedTuple

import numpy as np

from ehbench.parts.edge import check, pump
from ehbench.parts.sample import DERIVED, LINE, OF
from ehbench.parts.valve import VALVE_COLUMNS
from ehbench.parts.valve.delay import Line, line_of
from ehbench.plant.layout import Layout, Offsets
from ehbench.runtime.compiled import record

RAW = tuple(channel for channel in OF if channel not in DERIVED)  # a cylinder's raw channels
A_CYLINDER, LINES = len(RAW), len(LINE)  # raw channels of a cylinder, of the supply lines
FILTER = 3  # numbers of a speed filter
STROKE = RAW.index(OF.x)

# Wider rows begin with the columns of their own: numba would else take one for the other.
# A valve: ``gain`` and ``offset`` [V] of its driver, its ``hysteresis`` [V], the model's columns.
BENCH_VALVE = record(("gain", "f8"), ("offset", "f8"), ("hysteresis", "f8"), *VALVE_COLUMNS)
# An edge: its nodes, its valve and sign, its law, its leakage at null [m³/(s·Pa)] over
# ``null_width`` [V], ``blocked`` 1 where nothing passes in reverse, and its two curves; a pump or a
# check valve, ``unmetered`` 1, has the model's columns with numbers of its own instead.
BENCH_EDGE = record(
    *((name, "i8") for name in ("from_node", "to_node", "valve", "blocked", "forward", "reverse")),
    *((name, "f8") for name in ("sign", "null", "null_width")),
    *(("law", "i8"), ("unmetered", "i8")),
    *pump.LAW.columns,
    *check.LAW.columns,
)
# A curve, see `curve_flow`: ``onset, softness, saturation`` and ``wide_open`` [V], ``gain``
# [m³/(s·V·√Pa)], ``setting`` of the compensator [Pa], 0 for none, its ``flow_force`` [1/V].
CURVE = record(
    *((name, "f8") for name in ("onset", "softness", "saturation", "gain")),
    *((name, "f8") for name in ("setting", "wide_open", "flow_force")),
)
# A sensor: ``lag`` [s]; standard deviation of its ``noise``, ``resolution`` and ``zero`` offset in
# its channel's unit.
SENSOR = record(*((name, "f8") for name in ("lag", "noise", "resolution", "zero")))
# Fluid and pump: share of free ``air``, ``polytropic`` exponent; ``droop`` [Pa], ``pump_lag`` [s],
# ``supply_relief`` of the supply line [Pa].
FLUID = record(
    *((name, "f8") for name in ("air", "polytropic", "droop", "pump_lag", "supply_relief"))
)


class BenchOffsets(NamedTuple):
    """Where things begin.

    In the state: as `ehbench.plant.layout.Offsets`, then the ``pump``'s flow and the pressure it is
    to hold, ``sensed``; ``states`` that are integrated; then memory: ``hysteresis``, ``lags``,
    ``filters``, ``ring`` of the delay line, ``depth`` rows of it, its ``place``; ``size`` in all.
    ``channels`` raw ones. In the workspace: as there."""

    joints: int
    rates: int
    supply: int
    pump: int
    sensed: int
    states: int
    hysteresis: int
    lags: int
    filters: int
    ring: int
    depth: int
    place: int
    size: int
    channels: int
    torque: int
    inertia: int
    net: int
    slope: int
    opening: int
    flow: int
    work: int


def offsets_of(names: Layout, depth: int) -> BenchOffsets:
    at: Offsets = names.offsets()
    nc, nv = len(names.cylinders), len(names.valves)
    channels = A_CYLINDER * nc + LINES
    states = at.states + 2
    lags = states + nv
    filters = lags + channels
    ring = filters + FILTER * nc
    place = ring + depth * channels
    bench = {"pump": at.states, "sensed": at.states + 1, "states": states, "hysteresis": states}
    bench |= {"lags": lags, "filters": filters, "ring": ring, "depth": depth, "place": place}
    bench |= {"size": place + 1, "channels": channels, "work": at.pump}
    shared = {name: value for name, value in at._asdict().items() if name in BenchOffsets._fields}
    return BenchOffsets(**(shared | bench))


class VirtualPlant(NamedTuple):
    """A bench as flat tables. ``delay`` of sensors in whole ticks, ``share`` of a tick; ``speed``
    filter."""

    kind: int
    gravity: np.ndarray
    links: np.recarray
    cylinders: np.recarray
    nodes: np.recarray
    valves: np.recarray
    elements: np.recarray
    edges: np.recarray
    curves: np.recarray
    supply: np.record
    forces: np.recarray
    lines: np.recarray
    fluid: np.record
    sensors: np.recarray
    delay: int
    share: float
    speed: np.ndarray
    at: BenchOffsets


class Scratch(NamedTuple):
    """Room of a tick: ``k`` (5, states), ``work``, ``target`` [V] (valves,), ``raw`` channels,
    ``line`` of past targets."""

    k: np.ndarray
    work: np.ndarray
    target: np.ndarray
    raw: np.ndarray
    line: Line


def scratch_of(bench: VirtualPlant, tick: float) -> Scratch:
    """A scratch for a bench."""
    at = bench.at
    return Scratch(
        np.zeros((5, at.states)),
        np.zeros(at.work),
        np.zeros(bench.valves.shape[0]),
        np.zeros(at.channels),
        line_of(bench, tick),
    )
