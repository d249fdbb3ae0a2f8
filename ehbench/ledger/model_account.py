"""The ledger of a trial on the model, from what the model logs."""

from dataclasses import replace

import numpy as np

from ehbench.data.record import Record
from ehbench.ledger.loads import Loads
from ehbench.ledger.quadrature import Integrated, integrate
from ehbench.ledger.readings import ROUNDING
from ehbench.ledger.sheet import Ledger, Sheet, must_have_samples, oil_drawn, payload_of
from ehbench.parts.valve.delay import line_of
from ehbench.physics.arm import SLIDE
from ehbench.plant.integrate import STEP
from ehbench.plant.layout import SIDES
from ehbench.plant.model import Model
from ehbench.plant.valves import follow_valves
from ehbench.vocabulary import LogError, message

FOLLOWS = 1.0e-2  # share of a state's range that a tick of the model may miss the next sample by


def states_of(model: Model, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """(states, shape (samples, states); commands [V], shape (samples, valves)) of a model's record.

    The rates of the openings, which a record has not where a valve has one element, follow from the
    openings and the commands.

    Raises:
        LogError: a channel of the model is missing."""
    names, plant = model.layout, model.plant
    samples, n = record.t.size, plant.at.rates
    states = np.zeros((samples, names.states))
    driven = {int(j): names.cylinders[i] for i, j in enumerate(plant.cylinders.joint)}
    for j, joint in enumerate(names.joints):
        owner = driven.get(j, joint)
        position, rate = ("x", "v") if plant.kind == SLIDE else ("q", "qd")
        states[:, j], states[:, n + j] = record[f"{owner}.{position}"], record[f"{owner}.{rate}"]
    for i, name in enumerate(names.cylinders):
        for key in ("p_head", "p_rod"):
            states[:, names.state(key, i)] = record[f"{name}.{key}"]
    channels = [*(f"{name}.command" for name in names.valves), *names.played]
    commands = np.stack([record[channel] for channel in channels], axis=1)
    commands = model.played(np.ascontiguousarray(commands, dtype=float))
    for name, valve in zip(names.valves, plant.valves, strict=True):
        if valve.output >= 0:
            states[:, valve.output] = record[f"{name}.opening"]
    follow_valves(np.ascontiguousarray(record.t), commands, plant, True, states)
    for channel, at in names.inner_states:
        states[:, at] = record[channel]
    for index, key in names.part_states:
        states[:, names.state(key, index)] = record[f"{names.cylinders[index]}.{key}"]
    states[:, plant.at.supply] = record["p_supply"]
    return states, commands


def ledger_of_model(model: Model, record: Record, step: float = STEP) -> Ledger:
    """The ledger of a trial on the model: every tick is integrated anew from its logged state, and
    the powers with it.

    Args:
        model: with the rig, payload and maps that made the record.
        record: as `Model.record` gives it: states, commands, openings, at any rate that has every
            change of the commands.
        step: longest integration step [s].

    Raises:
        LogError: a channel is missing, or its flows are not those of this model."""
    must_have_samples(record)
    t = np.ascontiguousarray(record.t, dtype=float)
    states, commands = states_of(model, record)
    plant = model.plant.at_pressures(tank=record["p_tank"][0] if "p_tank" in record else None)
    first = [float(record[f"{name}.opening"][0]) for name in model.layout.valves]
    plant = plant.commanded_before(
        np.where(model.plant.valves.delay > 0.0, first, model.plant.valves.before)
    )
    loads = Loads.of(record)
    sheet = Sheet(model, "residual", bool(loads.changes))
    flows = np.empty((t.size, len(model.layout.edges) + 1))
    spent = np.zeros((t.size, sheet.powers))
    ticks, ends = np.empty((t.size - 1, sheet.powers)), np.empty((t.size - 1, states.shape[1]))
    line, fixed = line_of(plant, t[1] - t[0]), replace(model, plant=plant)
    for rows, loaded in loads.spans(fixed, t):
        out = Integrated(
            flows[rows], ticks[rows.start : rows.stop - 1], ends[rows.start : rows.stop - 1]
        )
        integrate(t[rows], states[rows], commands[rows], loaded, line, sheet.owner, step, out)
    np.cumsum(ticks, axis=0, out=spent[1:])
    channels = [*(f"{name}.flow" for name in model.layout.edges), "flow_supply"]
    for i, channel in enumerate(channels):  # are they those at the record's states?
        if channel in record:
            scale = max(np.abs(record[channel]).max(), np.abs(flows[:, i]).max(), ROUNDING)
            if np.abs(record[channel] - flows[:, i]).max() > FOLLOWS * scale:
                raise LogError(message("ledger.other_flows", channel=channel))
    stored = loads.stored(fixed, t, states, sheet.stores)
    table = sheet.expand(np.concatenate([spent, stored], axis=1))
    facts = {"functions": sheet.functions(record, table), "oil_drawn": oil_drawn(model, t, flows)}
    notes = tuple(_missed(model, states, ends))
    return sheet.ledger(model, record, payload_of(record), table[-1], None, notes=notes, **facts)


def _missed(model: Model, states: np.ndarray, ends: np.ndarray) -> list[str]:
    """A sentence where a tick of the model does not lead from one sample to the next."""
    names = model.layout
    joints, cylinders = range(len(names.joints)), range(len(names.cylinders))
    kinds = (
        ("joint angle", [names.state("q", i) for i in joints]),
        ("joint rate", [names.state("qd", i) for i in joints]),
        ("pressure", [names.state(f"p_{side}", i) for i in cylinders for side in SIDES]),
    )
    for what, at in kinds:
        known = states[:, at]
        scale = np.abs(known).max() if what == "pressure" else np.ptp(known, axis=0).max()
        gap = np.abs(ends[:, at] - known[1:]).max()
        if gap > FOLLOWS * max(scale, ROUNDING):
            share = 100 * gap / max(scale, ROUNDING)
            return [message("ledger.missed_sample", what=what, share=share)]
    return []
