"""A compiled controller on the model or on the virtual bench, tick by tick."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehbench.control import arc
from ehbench.control.arc_gains import Adaptation, pack_arc
from ehbench.control.axis import Axis, Mechanism
from ehbench.control.axis import axis_of as make_axis
from ehbench.control.functions import circuit, pack_rules
from ehbench.control.law import DesignPoint
from ehbench.machines.simulated import model_tick
from ehbench.parts.sample import perfect_sample, sample_size
from ehbench.parts.valve import valve_lag as lag_of
from ehbench.parts.valve.delay import line_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import STEP
from ehbench.runtime.compiled import allocating_kernel

TICK = 1.0e-3


class Law(NamedTuple):
    """Arguments of `arc.step`; a channel with ``mask`` False is NaN in what the controller gets."""

    mask: np.ndarray
    design: Axis
    gains: Any
    memory: Any
    command: np.ndarray


class Trace(NamedTuple):
    """What is kept of each tick, a row each."""

    log: np.ndarray
    telemetry: np.ndarray
    commands: np.ndarray


@allocating_kernel
def control(t, sample, reference, law, telemetry):
    """One tick of a controller, which sees the channels of its mask."""
    given = np.empty(sample.shape[0])
    for c in range(sample.shape[0]):
        given[c] = sample[c] if law.mask[c] else np.nan
    arc.step(t, given, reference, law.design, law.gains, law.memory, law.command, telemetry)


@allocating_kernel
def on_model(y, reference, law, plant, line, steps, trace, flows):
    """Run a controller on the model."""
    k = np.empty((5, y.shape[0]))
    work = np.empty(plant.at.work)
    sample = np.empty(trace.log.shape[1])
    perfect_sample(y, plant, sample)
    for i in range(reference.shape[0]):
        control(i * line.tick, sample, reference[i], law, trace.telemetry[i])
        trace.log[i], trace.commands[i] = sample, law.command
        derivatives(y, law.command, plant, k[0], work)
        flows[i] = work[plant.at.flow :]
        model_tick(y, law.command, plant, line, steps, k, work, sample)


@dataclass
class Run:
    """What came of a trial. ``log`` has the sample's columns (on the bench, then its states),
    ``flows`` edges then pump.
    """

    reference: np.ndarray
    log: np.ndarray
    telemetry: dict[str, np.ndarray]
    commands: np.ndarray
    flows: np.ndarray | None
    memory: np.ndarray
    t: np.ndarray


def circuit_of(model, number, measured=None):
    """The circuit of a cylinder of a model."""
    plant = model.plant
    row = plant.cylinders[number]
    ranges = np.column_stack([plant.valves.lowest, plant.valves.highest])
    areas = row.area_head, row.area_rod
    return circuit(number, *areas, plant.edges, plant.maps, ranges, measured)


def axis_of(model, number, posture, measured=None):
    """The axis of a cylinder of a model, its design posture as `Model.posture` reads it."""
    plant = model.plant
    mechanism = Mechanism(
        plant.kind, plant.gravity, plant.links, plant.cylinders.joint, model.posture(posture)
    )
    return make_axis(
        circuit_of(model, number, measured), mechanism, plant.cylinders[number], plant.forces
    )


def valve_lag(model, number):
    """Lag 2ζ/ω_n [s] of the slowest valve of a cylinder."""
    name = model.layout.cylinders[number]
    valves = zip(model.plant.valves, model.layout.valves, strict=True)
    return max(lag_of(row, model.plant) for row, valve in valves if valve.startswith(name + "."))


def gains_of(model, ax, seventh=False, rules=None, gains=None, **options):
    """Gains with defaults for a model; ``options`` of its site and of what it does not know."""
    supply = model.plant.supply
    packed = pack_rules(
        ax.circuit.area_rod, supply.pressure, allow_seventh=seventh, **(rules or {})
    )
    site = {"tick": TICK, "supply_pressure": supply.pressure, "flow_limit": supply.flow_limit}
    site |= {"valve_lag": valve_lag(model, ax.circuit.cylinder)}
    site |= {name: options.pop(name) for name in site if name in options}
    return pack_arc(DesignPoint(ax, **site), packed, Adaptation(**options), gains or {})[0]


def _arrays(model, ax, gains, mask, memory, ticks, channels):
    """(the law before its first tick, an empty trace, names of its telemetry)."""
    layout = model.layout
    names = arc.LAW.channels("c", tuple(f"e{i}" for i in range(ax.circuit.count)))
    trace = Trace(*(np.zeros((ticks, n)) for n in (channels, len(names), len(layout.valves))))
    return Law(mask, ax, gains, memory, model.rest_commands(1)[0]), trace, names


def _run(reference, law, trace, names, tick, flows=None):
    telemetry = {name.removeprefix("c."): trace.telemetry[:, i] for i, name in enumerate(names)}
    t = np.arange(len(reference)) * tick
    return Run(reference, trace.log, telemetry, trace.commands, flows, law.memory, t)


def run_model(model, ax, gains, reference, posture=None, mask=None, memory=None):
    """A trial on a model from rest in a posture; ``memory`` is that before the first tick."""
    y, count = model.trim(model.posture(posture)), len(reference)
    channels, tick = sample_size(len(model.layout.cylinders)), float(gains.tick)
    memory = arc.memory_of(ax) if memory is None else memory
    mask = arc.observed(ax, channels) if mask is None else mask
    law, trace, names = _arrays(model, ax, gains, mask, memory, count, channels)
    flows = np.zeros((count, len(model.layout.edges) + 1))
    line, steps = line_of(model.plant, tick), max(1, round(tick / STEP))
    on_model(y, reference, law, model.plant, line, steps, trace, flows)
    return _run(reference, law, trace, names, tick, flows)
