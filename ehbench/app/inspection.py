"""What a file holds, and whether it is valid; a recipe by a dry run of its stage."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.recipe import Campaign, kind_of, load_columns, load_recipe, load_rig
from ehbench.config.rig import NODES, Rig, Slide
from ehbench.data.flowmeter import is_flowmeter, read_flowmeter
from ehbench.report.blocks import Grid
from ehbench.report.content import written_step
from ehbench.report.terminal import Answer
from ehbench.runtime.disk import impossible
from ehbench.signals.oddities import oddities
from ehbench.stages import stage_of
from ehbench.stages.dry_run import DryRun
from ehbench.stages.inputs import refuse_fmu, with_orifices
from ehbench.stages.notes import Notes, line_naming
from ehbench.vocabulary import Message, Quantity, from_si, message, plural, quantity
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError
from ehbench.vocabulary.messages import ranked
from ehbench.vocabulary.text import shortened_path
from ehbench.vocabulary.units import fitting
from ehbench.workflow import ROOT

if TYPE_CHECKING:
    from ehbench.plant.model import Model


Rows = list[tuple[str, str]]
_NOTES = ("note", "not checked")


@dataclass(frozen=True)
class Inspection:
    """What a file is, and what it holds as rows (what, text), notes among them; its errors and exit
    code (3: data loss); what preparing a recipe found."""

    head: str
    rows: Rows
    code: int = 0
    errors: tuple[EhbenchError, ...] = ()
    notes: Notes | None = None

    @property
    def lines(self) -> list[str]:
        """All of it, the verdict last."""
        rows = [": ".join(filter(None, row)) for row in self.rows]
        return [self.head, *(f"  {row}" for row in rows), self.state]

    @property
    def state(self) -> str:
        """Whether it is valid."""
        state = plural(len(self.errors), "error") if self.errors else "ok"
        return state + (", with losses" if self.code == 3 else "")

    def answer(self, path: Path) -> Answer:
        """What the command says of a file: a row for each thing it holds, and how to run it."""
        steps = []
        if self.notes is not None and not self.errors and not self.notes.refused:
            if command := stage_of(self.notes.recipe).command:
                options = "".join(f" {option}" for option in sorted(self.notes.options))
                fields = {"command": command, "recipe": path, "options": options}
                odd = [getattr(note, "fields", {}) for note in self.notes.remarks]
                steps += ranked(written_step(each) for each in odd if "where" in each)[:2]
                steps.append(message("steps.run_recipe", **fields))
        return Answer(
            f"{self.state}: {self.head}",
            [Grid(["", ""], [row for row in self.rows if row[0] not in _NOTES])],
            steps,
            [text for word, text in self.rows if word in _NOTES],
            values={"code": self.code, "lines": self.lines, "errors": list(map(str, self.errors))},
        )


def check(path: Path, dry_run: DryRun | None = None, verbose: bool = False) -> Inspection:
    """Inspect a rig, recipe or map (TOML), a flowmeter CSV, or a log of any format read, of which
    ``verbose`` lists each gap and each bad sample. What a ``dry_run`` has prepared is not prepared
    again.

    Raises:
        InputError: the file is none of these. Errors in what a recipe requests are collected in
            ``errors``."""
    if reason := impossible(path):
        raise InputError(message("app.no_path", reason=reason), file=shortened_path(path))
    if not path.exists():
        raise InputError("no such file", file=path)
    if path.suffix == ".toml":
        kind = kind_of(path)
        if kind == "recipe":
            return _recipe(path, dry_run or DryRun(ROOT))
        return _rig(path) if kind == "rig" else _map(path)
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError(message("app.is_folder"), file=path)
    if path.suffix == ".csv" and is_flowmeter(path):
        data = read_flowmeter(path)
        readings: Rows = []
        for valve, direction in data.groups():
            rows = data.select(valve, direction)
            drop = rows.pressure_drop[np.isfinite(rows.pressure_drop)]
            drops = "no pressures"
            if drop.size:
                ends = (rows.shown("pressure_drop", value) for value in (drop.min(), drop.max()))
                drops = f"drops {' to '.join(ends)}"
            text = message(
                "app.readings",
                readings=plural(len(rows.flow), "reading"),
                commands=plural(len(set(rows.command.tolist())), "command"),
                drops=drops,
                flow=rows.shown("flow", abs(rows.flow).max()),
            )
            readings.append((f"{valve} {direction}", text))
        return Inspection(f"flowmeter readings: {data.flow.size} rows", readings)
    return _log(path, verbose)


def _recipe(path: Path, dry_run: DryRun) -> Inspection:
    notes = dry_run.check(load_recipe(path))
    recipe = notes.recipe
    kind = " ".join(word.replace("_", " ") for word in recipe.kind() if word)
    head = f"recipe '{recipe.name}': {kind}" + (f", '{recipe.title}'" if recipe.title else "")
    rows = [("", f"it {notes.does}")] if notes.does else []
    for word, texts in (
        ("runs" if isinstance(recipe, Campaign) else "reads", notes.reads),
        ("runs first", [", ".join(notes.required)]),
        ("writes", [notes.writes]),
        ("note", [*notes.losses, *notes.remarks]),
        ("not checked", notes.undecided),
    ):
        rows += [(word, text) for text in texts if text]
    code = notes.errors[0].exit_code if notes.errors else 3 * bool(notes.losses)
    return Inspection(head, rows, code, tuple(notes.errors), notes)


def _rig(path: Path) -> Inspection:
    rig = load_rig(path)
    refuse_fmu(rig, True)
    counts = {
        "joint": len(rig.joint_names),
        "cylinder": len(rig.cylinder),
        "valve": len([*rig.valves()]),
        "metering edge": len([*rig.edges()]),
    }
    if fixed := len([*rig.fixed_edges()]):
        counts["fixed edge"] = fixed
    parts = ", ".join(plural(count, word) for word, count in counts.items())
    pressure = rig.shown("pressure", float(rig.supply.pressure))
    maximum = rig.shown("flow_limit", float(rig.supply.flow_limit))
    kind = "" if rig.supply.constant else f", {rig.supply.kind}"
    head = f"rig '{rig.name}'" + (f": {rig.title}" if rig.title else "")
    rows = [("", f"{parts}, supply {pressure} up to {maximum}{kind}")]
    notes: list[str] = []
    if rig.model is not None:
        notes.append(message("stages.fmu_is_code", fmu=rig.model.fmu))
    for name, value in rig.parameters().items():
        row = quantity(name)
        if value.text is not None and not row.ordinary(float(value)):
            shown = dict(zip(("low", "value", "high"), (row.usual[0], float(value), row.usual[1])))
            fields = {key: value.like(row.name, number) for key, number in shown.items()}
            fits = fitting(float(value), value.unit or row.unit, row)
            notes.append(message("app.unusual", name=name, fits=fits, **fields))
    for cylinder in rig.cylinder:  # unusual, but at times meant
        edges = [*(edge for valve in cylinder.valve for edge in valve.edge), *cylinder.edge]
        connected = {end for edge in edges for end in (edge.from_, edge.to)}
        for node in NODES:
            if node not in connected and (node != "tank" or cylinder.pump is None):
                name = f"{node} end" if node in ("head", "rod") else node
                notes.append(message("app.unconnected", cylinder=cylinder.name, node=name))
    for load in (None, *rig.payload):
        try:
            texts, remarks = _standstill(rig, load)
        except EhbenchError as error:
            text, line = error.message, line_naming(path, error.message)
            raise type(error)(text, file=path, line=line, hint=error.hint) from None
        rows += [(load or "no payload", text) for text in texts]
        notes += remarks
    rows += [("note", text) for text in notes]
    values = rig.parameters().values()
    sources = Counter(value.sure for value in values if value.source)
    words = [f"{count} {word}" for word, count in sorted(sources.items())]
    if bare := sum(not value.source and value.text is not None for value in values):
        words.append(f"{bare} without a source")
    rows.append(("sources of the numbers", ", ".join(words) or "no sources given"))
    return Inspection(head, rows)


def _standstill(rig: Rig, load: str | None) -> tuple[list[str], list[Message]]:
    """(a line for each cylinder: its range, its pressures at mid-stroke; remarks)."""
    from ehbench.plant.model import Model
    from ehbench.plant.rest import CREEPS

    whole, _ = with_orifices(rig, None)
    model = Model.of(whole, payload=load)
    state = model.trim(model.posture({}))
    lines, notes = [], list[Message]()
    for index, cylinder in enumerate(rig.cylinder):
        word, decimals = ("x", 0) if rig.mechanism.kind == "slide" else ("q", 1)
        first, last = (rig.text(word, value, decimals) for value in model.stroke_range(index))
        places = [model.layout.state(name, index) for name in ("p_head", "p_rod")]
        head, rod = (rig.shown("p_head", state[place]) for place in places)
        ends = {"first": first.partition(" ")[0], "last": last}
        text = message("app.standstill", cylinder=cylinder.name, **ends, head=head, rod=rod)
        if abs(speed := model.creep(index, state)) > CREEPS:
            direction = "out" if speed > 0.0 else "in"
            text += f", creeping {direction} at {rig.shown('v', abs(speed), 2)}"
        for what, row, value in abilities(model, index):
            text += f"; {what} {rig.shown(row.name, value)}"
            if not row.ordinary(value):
                fields = {"cylinder": cylinder.name, "load": load or "no payload", "what": what}
                low, high = (rig.shown(row.name, end) for end in row.usual)
                fields |= {"value": rig.shown(row.name, value), "low": low, "high": high}
                notes.append(message("app.improbable", **fields))
        lines.append(text)
    each = min(9, max(2, int(200 ** (1 / len(rig.cylinder)))))  # some 200 postures of all together
    ends = [np.linspace(*model.stroke_range(index), each) for index in range(len(rig.cylinder))]
    postures = np.tile(model.posture({}), (each ** len(ends), 1))
    postures[:, model.plant.cylinders.joint] = list(product(*ends))
    notes += model.weak_supply(load, postures)
    chain = whole.loaded(load)
    links = () if isinstance(chain, Slide) else chain.joint
    reach = sum(math.hypot(link.dh_a, link.dh_d, *link.com.value) for link in links)
    for link in links:
        mass, widest = link.mass, max(link.inertia.parts[:3], key=float)
        if float(widest) > float(mass) * reach**2:  # its mass beyond where the machine reaches
            fields = {"link": link.name, "mass": mass.like("mass", float(mass))}
            fields |= {"inertia": widest.like("inertia", float(widest))}
            fields |= {"load": load or "no payload", "reach": rig.shown("dh_a", reach, 3)}
            notes.append(message("app.wide_body", **fields))
    return lines, notes


def abilities(model: Model, cylinder: int) -> Iterator[tuple[str, Quantity, float]]:
    """What the oil and the valves of a cylinder make of it at mid-stroke, as far as a controller
    could: (what, its quantity, value [SI])."""
    from ehbench.control.axis import hydraulic_frequency
    from ehbench.plant.design_point import circuit_of, design_point_of
    from ehbench.trial.controllers import Design
    from ehbench.trial.motion import open_speed

    name, q = model.rig.cylinder[cylinder].name, model.posture({})
    with suppress(InputError):  # a pump moves it, or it has no lever there
        circuit = circuit_of(model, cylinder)
        frequency = hydraulic_frequency(design_point_of(model, circuit, q, 1.0).axis)
        yield "natural frequency", quantity("natural_frequency"), frequency
        design = Design(model.rig, None, model, name, cylinder, q, circuit)
        for way, what in ((1, "full speed out"), (-1, "full speed in")):
            if (speed := open_speed(design, way)) > 0.0:
                yield what, quantity("speed"), speed


def _map(path: Path) -> Inspection:
    columns, rows = load_columns(path).columns, []
    for name, column in columns.names.items():
        unit = f" [{column.unit}]" if column.unit else ""
        unit = f" {column.from_} → {column.to}" if column.from_ else unit
        rows.append((name, f"{column.channel}{unit}"))
    if not any(column.channel != "t" for column in columns.names.values()):
        raise InputError(message("app.maps_nothing"), file=path)
    return Inspection(f"map of {plural(len(rows), 'column')}", rows)


def _log(path: Path, verbose: bool) -> Inspection:
    from ehbench.data import read
    from ehbench.data.record import lost, recovered
    from ehbench.preprocessing.plausibility import LEAST_SAMPLES
    from ehbench.preprocessing.time_base import evened, parts_of

    record = read(path)
    head = message(
        "app.log",
        samples=record.t.size,
        channels=len(record.channels),
        first=float(record.t[0]),
        last=float(record.t[-1]),
        step=record.sample_time * 1e3,
    )
    rows = [(key, text) for key, text in record.meta.items() if len(text) < 200]
    for name, values in record.channels.items():
        row = quantity(name)
        low, high = (from_si(float(v), row.display, row) for v in (values.min(), values.max()))
        text = f"{low:.4g} to {high:.4g} {row.display}"
        odd = [] if name.endswith(".command") else oddities(from_si(values, row.display, row))
        for kind, count, first, value in odd:
            fields = {"count": count, "value": value, "where": f"t = {record.t[first]:.6g} s"}
            text += "; " + message(f"app.odd_{kind}", **fields)
        rows.append((name, text))
    unfit, gaps, more = "", [], []
    if record.t.size < LEAST_SAMPLES:
        unfit = message("app.few_samples", samples=plural(record.t.size, "sample"))
    else:
        parts, gaps = parts_of(path.name, record)
        try:
            for part in parts:
                more += evened(part.name, part.record)[1]
        except LogError as error:
            unfit = str(error)
    notes = [*record.losses, *gaps]
    rows += [("lost", note) for note in lost(notes)]
    each = [note for note in notes if verbose and note not in lost(notes)]
    rows += [("", note) for note in (*recovered(path.name, notes), *each, *more)]
    rows += [("unfit for identification", unfit)] if unfit else []
    return Inspection(head, rows, 3 * bool(lost(notes) or unfit))
