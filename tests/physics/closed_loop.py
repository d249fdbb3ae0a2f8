"""A compiled controller on the model, tick by tick."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.control import arc
from ehbench.control.arc_gains import pack_arc
from ehbench.control.axis import Mechanism
from ehbench.control.axis import axis_of as make_axis
from ehbench.control.functions import pack_rules
from ehbench.control.law import Controller, DesignPoint, late_of
from ehbench.control.registry import tick as law_tick
from ehbench.machines.simulated import model_tick
from ehbench.parts.sample import perfect_sample, sample_size
from ehbench.parts.valve import valve_lag as lag_of
from ehbench.parts.valve.delay import line_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.design_point import circuit_of
from ehbench.plant.integrate import STEP
from ehbench.runtime.compiled import allocating_kernel

TICK = 1.0e-3
LONG = {  # most of the stroke, fast: cylinder, from, to [m], speed [m/s], payload
    "thesis_arm": ("boom", 0.05, 0.2, 0.06, "50 lb"),
    "boom_four_valve": ("boom", 0.1, 0.35, 0.06, "bucket"),
    "crane_proportional": ("lift", 0.1, 0.4, 0.03, "200 kg"),
    "slide_servo": ("press", 0.1, 0.3, 0.15, "100 kg"),
}


class Trace(NamedTuple):
    """What is kept of each tick, a row each."""

    log: np.ndarray
    telemetry: np.ndarray
    commands: np.ndarray
    flows: np.ndarray


class Seen(NamedTuple):
    """What the controller sees: past samples, the newest first, of which it gets the mean of the
    last two, the last by its ``share``."""

    past: np.ndarray
    share: float


class Drive(NamedTuple):
    """What the controller commands, what of that some ``valves`` get ``louder`` about ``steady``,
    and integration steps in a tick."""

    command: np.ndarray
    steady: np.ndarray
    valves: np.ndarray
    louder: float
    steps: int


@allocating_kernel
def on_model(y, reference, law, seen, drive, plant, line, trace):
    """Run a controller on the model. All that is run on one is run by this: to compile it takes
    longer than most of the tests."""
    past, share, last = seen.past, seen.share, seen.past.shape[0] - 1
    k, work = np.empty((5, y.shape[0])), np.empty(plant.at.work)
    given = drive.command.copy()
    perfect_sample(y, plant, past[0])
    for i in range(reference.shape[0]):
        late = (1.0 - share) * past[last - 1] + share * past[last]
        law_tick(i * line.tick, late, reference[i], law, drive.command, trace.telemetry[i])
        trace.log[i], trace.commands[i] = past[0], drive.command
        derivatives(y, drive.command, plant, k[0], work)
        trace.flows[i] = work[plant.at.flow :]
        given[:] = drive.command
        for valve in drive.valves:
            given[valve] += (drive.louder - 1.0) * (drive.command[valve] - drive.steady[valve])
        for row in range(last, 0, -1):
            past[row] = past[row - 1]
        model_tick(y, given, plant, line, drive.steps, k, work, past[0])


def trace_of(model, names, count):
    """Room for a trace of so many ticks; ``names`` are those of the law's telemetry."""
    layout = model.layout
    widths = sample_size(len(layout.cylinders)), len(names), len(layout.valves)
    return Trace(*(np.zeros((count, n)) for n in (*widths, len(layout.edges) + 1)))


@dataclass
class Run:
    """What came of a trial. ``log`` has the sample's columns, ``flows`` edges then pump."""

    reference: np.ndarray
    log: np.ndarray
    telemetry: dict[str, np.ndarray]
    commands: np.ndarray
    flows: np.ndarray
    t: np.ndarray


def axis_of(model, number, posture):
    """The axis of a cylinder of a model, its design posture as `Model.posture` reads it."""
    plant = model.plant
    mechanism = Mechanism(
        plant.kind, plant.gravity, plant.links, plant.cylinders.joint, model.posture(posture)
    )
    return make_axis(circuit_of(model, number), mechanism, plant.cylinders[number], plant.forces)


def valve_lag(model, number):
    """Lag 2ζ/ω_n [s] of the slowest valve of a cylinder."""
    name = model.layout.cylinders[number]
    valves = zip(model.plant.valves, model.layout.valves, strict=True)
    return max(lag_of(row, model.plant) for row, valve in valves if valve.startswith(name + "."))


def gains_of(model, ax, seventh=False, gains=None, **options):
    """Gains with defaults for a model; ``options`` of its site and of what it does not know."""
    supply = model.plant.supply
    packed = pack_rules(ax.circuit.area_rod, supply.pressure, allow_seventh=seventh)
    site = {"tick": TICK, "supply_pressure": supply.pressure, "flow_limit": supply.flow_limit}
    site |= {"valve_lag": valve_lag(model, ax.circuit.cylinder)}
    site |= {name: options.pop(name) for name in site if name in options}
    return pack_arc(DesignPoint(ax, **site), packed, options | (gains or {}))[0]


def run_model(model, ax, gains, reference, posture=None, mask=None, memory=None):
    """A trial of the adaptive robust controller on a model from rest in a posture."""
    start = model.trim(model.posture(posture))
    return run_from(start, model, ax, gains, reference, arc.LAW, mask, memory)


def run_from(y, model, ax, gains, reference, law, mask=None, memory=None):
    """A trial of a law from a state; ``memory`` is that before the first tick, a channel with
    ``mask`` False is NaN in what the controller gets."""
    count, tick = len(reference), float(gains.tick)
    names = law.channels("c", tuple(f"e{i}" for i in range(ax.circuit.count)))
    trace = trace_of(model, names, count)
    channels = trace.log.shape[1]
    memory = law.memory(ax) if memory is None else memory
    mask = law.observed(ax, channels) if mask is None else mask
    controller = Controller(ax, gains, memory, mask, np.zeros(channels), late_of())
    command, none = model.rest_commands(1)[0], np.zeros(0, int)
    drive = Drive(command, command.copy(), none, 1.0, max(1, round(tick / STEP)))
    seen = Seen(np.zeros((2, channels)), 0.0)
    line = line_of(model.plant, tick)
    on_model(y, reference, controller, seen, drive, model.plant, line, trace)
    columns = zip(names, trace.telemetry.T, strict=True)
    told = {name.removeprefix("c."): column for name, column in columns}
    return Run(reference, trace.log, told, trace.commands, trace.flows, np.arange(count) * tick)
