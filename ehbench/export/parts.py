"""What of a trial can be exported: its model, its controllers, and the inverse maps of valves."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ehbench.config.rig import Rig
from ehbench.control.functions import ALL_RULES
from ehbench.control.registry import tick
from ehbench.control.trajectory import SHAPING_NAMES
from ehbench.export.component import Component, Variable, identifier, members, numbers
from ehbench.machines.simulated import model_tick
from ehbench.parts.edge import edge_command
from ehbench.parts.sample import perfect_sample, sample_channels
from ehbench.parts.valve.delay import line_of
from ehbench.plant.model import Model
from ehbench.trial import Prepared, Session
from ehbench.trial.controllers import Compiled, Design
from ehbench.vocabulary import VOCABULARY, InputError, message, setting
from ehbench.vocabulary.codes import ESTIMATES, FUNCTIONS
from ehbench.vocabulary.errors import one_line
from ehbench.vocabulary.quantities import STROKES


@dataclass(frozen=True)
class ExportSettings:
    """Numbers of an export."""

    rows: int = setting(4000, "", "steps of a trial that a check holds at most", "a few MB")
    pairs: int = setting(500, "", "drops and flows that the check of valves holds", "a second")


EXPORT = ExportSettings()


def model_part(trial: Prepared, session: Session, about: Mapping[str, str]) -> Component:
    """The model of a trial, one tick a step.

    Args:
        trial: on the model, with steps of one length.
        session: of it, run to its end.
        about: where a parameter is from, by its name."""
    recipe, rate = trial.recipe, trial.machine.rate
    model = Model.of(trial.rig, trial.maps, recipe.payload)
    plant, channels = model.plant, sample_channels(model.layout.cylinders)
    y = model.trim(model.posture(trial.posture), trial.low_side)
    sample = np.empty(len(channels))
    perfect_sample(y, plant, sample)
    states = [name.replace(".rate", ".opening_rate") for name in model.layout.state_names]
    hidden = [i for i, name in enumerate(states) if name not in channels]
    rest, reach = trial.machine.commands.rest, (plant.valves.lowest, plant.valves.highest)
    variables = [
        Variable.of(
            f"{name}.command",
            "input",
            f"command[{i}]",
            rest[i],
            lower=float(reach[0][i]),
            upper=float(reach[1][i]),
        )  # fmt: skip
        for i, name in enumerate(model.layout.valves)
    ]
    variables += [
        _measured(trial.rig, name, "output", f"sample[{i}]", sample[i])
        for i, name in enumerate(channels)
    ]
    variables += [_measured(trial.rig, states[i], "output", f"y[{i}]", y[i]) for i in hidden]
    last = min(session.end, EXPORT.rows + 1)
    rows = session.rows
    part = Component(
        f"{identifier(trial.rig.name)}_model",
        message(
            "export.about_model", rig=trial.rig.name, payload=one_line(recipe.payload or "none")
        ),
        model_tick,
        {
            "y": y,
            "command": rest.astype(float),
            "plant": plant,
            "line": line_of(plant, 1.0 / rate),
            "steps": max(1, round(1.0 / (rate * float(recipe.step)))),
            "k": np.zeros((5, y.size)),
            "work": np.zeros(plant.at.work),
            "sample": sample,
        },
        tuple(variables),
        rate,
        np.column_stack(
            [rows.commands[: last - 1], rows.samples[1:last], rows.truth[1:last, hidden]]
        ),
    )
    more = _rig_parameters(trial, part, about)
    return replace(part, variables=(*part.variables, *more))


def _measured(rig: Rig, name: str, role: str, place: str, start: float) -> Variable:
    """A channel or state; a joint coordinate of a slide has unit and meaning of a stroke."""
    word = STROKES.get(name.rsplit(".", 1)[-1])
    if word is None or rig.mechanism.kind != "slide":
        return Variable.of(name, role, place, start)
    row = VOCABULARY[word]
    return Variable.of(name, role, place, start, unit=row.unit, about=row.meaning)


def _rig_parameters(
    trial: Prepared, part: Component, about: Mapping[str, str]
) -> Iterator[Variable]:
    """The parameters of a rig that the plant holds as they are: where such a one changes, numbers
    of the plant that were the old value are the new one, and no others change."""
    known, payload = trial.rig.parameters(), trial.recipe.payload

    def numbers_of(rig: Rig) -> dict[str, int]:
        plant = Model.of(rig, trial.maps, payload).plant
        like = replace(part, arguments={"plant": plant})
        return {name: bits for leaf in like.memory for name, bits in numbers(leaf).items()}

    before = numbers_of(trial.rig)

    def places_of(name: str, old: float, new: float) -> tuple[str, ...]:
        try:
            after = numbers_of(trial.rig.with_values({name: new}, known))
        except InputError:
            return ()
        places = [place for place, bits in after.items() if bits != before[place]]
        bits = [int(np.float64(number).view(np.int64)) for number in (old, new)]
        alike = all([before[place], after[place]] == bits for place in places)
        return tuple(places) if alike else ()

    for name, value in known.items():
        old = float(value)
        if places := places_of(name, old, 2.0 * old or 1.0) or places_of(name, old, 0.5 * old):
            bounds = {"lower": value.lower, "upper": value.upper}
            bounds = {key: bound for key, bound in bounds.items() if bound is not None}
            item = Variable.of(name, "parameter", "", old, **bounds)
            text = "; ".join(filter(None, (item.about, about.get(name, value.source))))
            yield item._replace(places=places, about=text)


def _references(design: Design, law: Compiled) -> Iterator[Variable]:
    """The desired motion, of a law that uses the others' that of all joints, and what of it lies
    ahead of a law that looks ahead."""
    row, first = VOCABULARY["v_desired"], law.references[0]
    preview = ("min_ahead", "max_ahead") if law.law.preview else ()
    inputs = [(f"{design.cylinder}.{key}_desired", {}) for key in "xvaj"]
    if first.size > len(inputs) + len(preview):  # as `coupling.among_others` has them
        for when, word in product(("desired", "ahead"), ("qd", "qdd")):
            fields = {"meaning": VOCABULARY[word].meaning, "seconds": law.law.ahead}
            more = {"about": message(f"export.joint_{when}", **fields)}
            inputs += [(f"{joint}.{when}.{word}", more) for joint in design.model.layout.joints]
    for key in preview:
        about = message(f"export.{key}", seconds=law.law.preview)
        more = dict(unit=row.unit, lower=row.lower, upper=row.upper, about=about)
        inputs.append((f"{design.cylinder}.v_{key}", more))
    for i, (name, more) in enumerate(inputs):
        yield Variable.of(name, "input", f"reference[{i}]", first[i], **more)


def controller_part(trial: Prepared, session: Session, law: Compiled, design: Design) -> Component:
    """A built-in controller of a trial, one tick a step, as it is on a machine whose valves may
    have hysteresis.

    Args:
        trial: in which it runs.
        session: of it, run to its end.
        law: with the references that it runs over.
        design: of its cylinder."""
    law, channels = law.afresh(), trial.machine.channels
    columns = len(law.channels)
    observed = np.flatnonzero(law.controller.observed)
    plant, edges = design.model.plant, design.circuit.edges[design.at_cylinder]
    valves = sorted({int(v) for v in edges["valve"]})
    samples, t = session.rows.samples, session.rows.t
    variables = [
        _measured(trial.rig, channels[i], "input", f"sample[{i}]", samples[0, i]) for i in observed
    ]
    variables += _references(design, law)
    variables += [
        Variable.of(f"{design.valves[i]}.command", "output", f"command[{i}]", 0.0,
                    lower=float(plant.valves.lowest[i]), upper=float(plant.valves.highest[i]))
        for i in valves
    ]  # fmt: skip
    variables += [
        Variable.of(f"telemetry.{name}", "output", f"telemetry[{i}]", 0.0)
        for i, name in enumerate(law.channels)
    ]
    arguments = {
        "t": 0.0,
        "sample": samples[0].copy(),
        "reference": law.references[0].copy(),
        "controller": law.controller,
        "command": np.zeros(len(design.valves)),
        "telemetry": np.zeros(columns),
    }
    part = Component(
        f"{identifier(design.cylinder)}_{law.law.name}",
        message("export.about_controller", law=law.law.name, cylinder=design.cylinder),
        tick,
        arguments,
        (*variables, *_gains(law)),
        trial.machine.rate,
        np.empty((0, 0)),
    )
    count = min(session.end, EXPORT.rows)
    command, telemetry = np.zeros((count, len(design.valves))), np.zeros((count, columns))
    run = law.afresh().controller
    for i in range(count):
        tick(float(t[i]), samples[i], law.references[i], run, command[i], telemetry[i])
    outputs = [law.references[:count], command[:, valves], telemetry]
    return replace(part, rows=np.column_stack([samples[:count, observed], *outputs]))


def _gains(law: Compiled) -> Iterator[Variable]:
    rows = {name: row or VOCABULARY.get(name) for name, row in law.law.gains.items()}
    rows |= {name: VOCABULARY[name] for name in (*SHAPING_NAMES, *ALL_RULES)}
    gains = law.controller.gains
    values = np.frombuffer(gains.tobytes(), float).tolist()
    for (place, kind), value in zip(members("controller_gains", gains.dtype), values, strict=True):
        name = place.removeprefix("controller_gains.")
        word, *at = re.findall(r"\w+", name.rsplit(".", 1)[-1])
        if kind != np.float64 or word == "tick":
            continue
        item, row = Variable(name, "parameter", (place,), value), rows.get(word)
        if at and row is None:  # a number of each estimate; a rate's unit is also of what it sees
            row = VOCABULARY[ESTIMATES[int(at[0])]]
            about = message(f"export.{word}", meaning=row.meaning)
            item = item._replace(unit="" if word == "rate" else row.unit, about=about)
        elif row is not None:
            item = item._replace(unit=row.unit, lower=row.lower, upper=row.upper, about=row.meaning)
            if at:
                item = item._replace(about=f"{row.meaning}: {FUNCTIONS[int(at[0])]}")
            if word in SHAPING_NAMES:
                about = message("export.shaping", meaning=row.meaning)
                item = item._replace(lower=0.0, about=about)
        yield item


def valves_part(trial: Prepared, design: Design) -> Component:
    """The inverse laws or flow maps of a cylinder's valves: the command of each edge at which it
    passes a flow at a pressure drop."""
    plant, layout = design.model.plant, design.model.layout
    at = [
        i
        for i in range(design.circuit.first, design.circuit.first + design.circuit.count)
        if plant.edges[i].valve >= 0 and not plant.edges[i].unmetered
    ]
    edges, names = plant.edges[at].copy(), [layout.edges[i] for i in at]
    valves = [int(edge.valve) for edge in edges]
    lowest, highest = plant.valves.lowest[valves], plant.valves.highest[valves]
    random = np.random.default_rng(0)
    drop, flow = (
        limit * random.uniform(-1.0, 1.0, (EXPORT.pairs, len(at)))
        for limit in (float(plant.supply.pressure), float(plant.supply.flow_limit))
    )
    command = np.zeros((EXPORT.pairs, len(at)))
    for i in range(EXPORT.pairs):
        inverse(drop[i], flow[i], edges, plant.maps, lowest, highest, command[i])
    zeros = np.zeros(len(at))
    variables = []
    for role, word, array in (
        ("input", "pressure_drop", "drop"),
        ("input", "flow", "flow"),
        ("output", "command", "command"),
    ):
        variables += [
            Variable.of(f"{name}.{word}", role, f"{array}[{i}]", 0.0)
            for i, name in enumerate(names)
        ]
    return Component(
        f"{identifier(design.cylinder)}_valves",
        message("export.about_valves", cylinder=design.cylinder),
        inverse,
        {
            "drop": zeros,
            "flow": zeros.copy(),
            "edges": edges,
            "maps": plant.maps,
            "lowest": lowest,
            "highest": highest,
            "command": zeros.copy(),
        },
        tuple(variables),
        trial.machine.rate,
        np.column_stack([drop, flow, command]),
    )


def inverse(drop, flow, edges, maps, lowest, highest, command):
    """Write the command [V] of each edge at which it passes ``flow`` [m³/s] at ``drop`` [Pa], both
    along it, within its range."""
    for i in range(edges.shape[0]):
        volts = edge_command(drop[i], flow[i], edges[i], maps)
        command[i] = min(max(volts, lowest[i]), highest[i])
