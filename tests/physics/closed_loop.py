"""A closed loop for tests: a compiled controller on the model or on the virtual bench, tick by
tick.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ehbench.control import arc
from ehbench.control.arc_gains import Adaptation, pack_arc
from ehbench.control.axis import Mechanism
from ehbench.control.axis import axis_of as make_axis
from ehbench.control.functions import circuit, pack_rules
from ehbench.control.law import Site
from ehbench.machines.simulated import model_sample, model_tick
from ehbench.machines.virtual import bench_tick
from ehbench.parts.sample import sample_size
from ehbench.parts.valve import valve_lag as lag_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import STEP

TICK = 1.0e-3


@njit(cache=True, nogil=True)
def on_model(
    y,
    reference,
    mask,
    design,
    gains,
    memory,
    command,
    plant,
    tick,
    steps,
    log,
    telemetry,
    commands,
    flows,
):
    """Run a controller on the model; a channel with ``mask`` False is NaN in what the controller
    gets.
    """
    k = np.empty((5, y.shape[0]))
    work = np.empty(plant.at.work)
    sample, given = np.empty(log.shape[1]), np.empty(log.shape[1])
    model_sample(y, plant, sample)
    for i in range(reference.shape[0]):
        for c in range(sample.shape[0]):
            given[c] = sample[c] if mask[c] else np.nan
        arc.step(i * tick, given, reference[i], design, gains, memory, command, telemetry[i])
        log[i], commands[i] = sample, command
        derivatives(y, command, plant, k[0], work)
        flows[i] = work[plant.at.flow :]
        model_tick(y, command, plant, tick, steps, k, work, sample)


@njit(cache=True, nogil=True)
def on_bench(
    state,
    sample,
    reference,
    mask,
    design,
    gains,
    memory,
    command,
    bench,
    tick,
    steps,
    scratch,
    noise,
    log,
    telemetry,
    commands,
):
    """Run a controller on the virtual bench; the log is what it measured, the truth follows in its
    last columns.
    """
    channels = sample.shape[0]
    given = np.empty(channels)
    for i in range(reference.shape[0]):
        for c in range(channels):
            given[c] = sample[c] if mask[c] else np.nan
        arc.step(i * tick, given, reference[i], design, gains, memory, command, telemetry[i])
        log[i, :channels], log[i, channels:], commands[i] = (
            sample,
            state[: log.shape[1] - channels],
            command,
        )
        bench_tick(state, command, bench, tick, steps, scratch, noise[i], sample)


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
    return circuit(
        number,
        row.area_head,
        row.area_rod,
        plant.edges,
        plant.maps,
        np.column_stack([plant.valves.lowest, plant.valves.highest]),
        measured,
    )


def axis_of(model, number, posture, measured=None):
    """The axis of a cylinder of a model, its design posture as `Model.posture` reads it."""
    plant = model.plant
    mechanism = Mechanism(
        plant.kind, plant.gravity, plant.links, plant.cylinders.joint, model.posture(posture)
    )
    return make_axis(circuit_of(model, number, measured), mechanism, plant.cylinders[number])


def valve_lag(model, number):
    """Lag 2ζ/ω_n [s] of the slowest valve of a cylinder."""
    name = model.layout.cylinders[number]
    rows = [
        row
        for row, valve in zip(model.plant.valves, model.layout.valves, strict=True)
        if valve.startswith(name + ".")
    ]
    return max(lag_of(row, model.plant) for row in rows)


def gains_of(model, ax, seventh=False, rules=None, gains=None, **options):
    """Gains of the controller with defaults for a model; ``options`` are of its site and of what it
    does not know.
    """
    supply = model.plant.supply
    packed = pack_rules(
        ax.circuit.area_rod, supply.pressure, allow_seventh=seventh, **(rules or {})
    )
    site = {
        "tick": TICK,
        "supply_pressure": supply.pressure,
        "flow_limit": supply.flow_limit,
        "valve_lag": valve_lag(model, ax.circuit.cylinder),
    }
    site |= {name: options.pop(name) for name in site if name in options}
    return pack_arc(Site(ax, **site), packed, Adaptation(**options), gains)


def _arrays(model, ax, reference):
    layout = model.layout
    names = arc.LAW.channels("c", tuple(f"e{i}" for i in range(ax.circuit.count)))
    return (
        np.zeros((len(reference), len(names))),
        names,
        np.zeros((len(reference), len(layout.valves))),
        model.rest_commands(1)[0],
    )


def _by_name(telemetry, names):
    return {name.removeprefix("c."): telemetry[:, i] for i, name in enumerate(names)}


def run_model(model, ax, gains, reference, posture=None, mask=None, memory=None):
    """A trial of the controller on a model that starts at rest in a posture; ``memory`` is that
    before the first tick unless given.
    """
    y = model.trim(model.posture(posture))
    telemetry, names, commands, command = _arrays(model, ax, reference)
    channels = sample_size(len(model.layout.cylinders))
    log = np.zeros((len(reference), channels))
    memory = arc.memory_of(ax) if memory is None else memory
    flows, tick = np.zeros((len(reference), len(model.layout.edges) + 1)), float(gains.tick)
    mask = arc.observed(ax, channels) if mask is None else mask
    steps = max(1, round(tick / STEP))
    on_model(
        y,
        reference,
        mask,
        ax,
        gains,
        memory,
        command,
        model.plant,
        tick,
        steps,
        log,
        telemetry,
        commands,
        flows,
    )
    return Run(
        reference,
        log,
        _by_name(telemetry, names),
        commands,
        flows,
        memory,
        np.arange(len(reference)) * tick,
    )


def run_bench(rig, model, ax, gains, reference, posture=None):
    """A trial of the controller, designed on ``model``, on a virtual bench."""
    sample = rig.start(posture)
    telemetry, names, commands, command = _arrays(model, ax, reference)
    log, memory = np.zeros((len(reference), sample.size + rig.size)), arc.memory_of(ax)
    on_bench(
        rig.state,
        sample,
        reference,
        arc.observed(ax, sample.size),
        ax,
        gains,
        memory,
        command,
        rig.bench,
        TICK,
        rig.steps,
        rig._own.scratch,
        rig.noise(len(reference)),
        log,
        telemetry,
        commands,
    )
    return Run(
        reference,
        log,
        _by_name(telemetry, names),
        commands,
        None,
        memory,
        np.arange(len(reference)) * TICK,
    )
