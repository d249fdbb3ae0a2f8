"""Look at one file and say what it holds and whether it will do, without running anything.

A recipe is looked at through what its run begins with: its stage's ``prepare``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ehbench.config.recipe import Campaign, kind_of, load_columns, load_recipe, load_rig
from ehbench.config.rig import NODES, Rig
from ehbench.data.flowmeter import is_flowmeter, read_flowmeter
from ehbench.runtime.disk import impossible
from ehbench.stages.findings import counted, line_naming
from ehbench.stages.inputs import with_laws
from ehbench.stages.look import Look
from ehbench.stages.validation import in_rig_unit
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.text import shortened_path
from ehbench.vocabulary.units import from_si
from ehbench.workflow import ROOT


@dataclass(frozen=True)
class Inspection:
    """What was found: lines to read, mistakes, and the exit code: that of the first mistake, else 3
    with data loss, else 0.
    """

    lines: tuple[str, ...]
    code: int = 0
    errors: tuple[EhbenchError, ...] = ()


def check(path: Path, look: Look | None = None) -> Inspection:
    """Inspect a rig, recipe or map (TOML), a flowmeter CSV, or a log of any format read.

    Args:
        path: of the file.
        look: the walk over recipes to go on with: what it has looked at is not looked at again;
            a new one by default.

    Raises:
        InputError: the file cannot be taken for what it is; says what, where and what would be
            right. Mistakes in what a recipe asks for are collected in ``errors``.
    """
    if reason := impossible(path):
        raise InputError(f"can be no file: {reason}", file=shortened_path(path))
    if not path.exists():
        raise InputError("no such file", file=path)
    if path.suffix == ".toml":
        kind = kind_of(path)
        if kind == "recipe":
            return _recipe(path, look or Look(ROOT))
        return _rig(path) if kind == "rig" else _map(path)
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError("is a folder", file=path, hint="name a file in it")
    if path.suffix == ".csv" and is_flowmeter(path):
        return _flowmeter(path)
    return _log(path)


def _recipe(path: Path, look: Look) -> Inspection:
    result = look.at(load_recipe(path))
    recipe = result.recipe
    stage, what = recipe.kind()
    what = f"{stage} {what.replace('_', ' ')}" if what else stage
    lines = [f"recipe '{recipe.name}': {what}" + (f", '{recipe.title}'" if recipe.title else "")]
    lines += [f"  it {result.does}"] if result.does else []
    for word, texts in (
        ("runs" if isinstance(recipe, Campaign) else "reads", result.reads),
        ("runs first", [", ".join(result.first)]),
        ("writes", [result.writes]),
        ("note", [*result.losses, *result.notes]),
        ("not checked", result.open),
    ):
        lines += [f"  {word}: {text}" for text in texts if text]
    if result.errors:
        lines.append(counted(result.errors, "mistake"))
        return Inspection(tuple(lines), result.errors[0].exit_code, tuple(result.errors))
    return Inspection((*lines, "ok"), 3 if result.losses else 0)


def _rig(path: Path) -> Inspection:
    from ehbench.plant.model import Model
    from ehbench.plant.rest import CREEPS, LOW_SIDE

    rig = load_rig(path)
    whole, _ = with_laws(rig, None)
    supply = float(rig.supply.pressure)
    parts = {
        "joint": rig.joint_names,
        "cylinder": rig.cylinder,
        "valve": [*rig.valves()],
        "metering edge": [*rig.edges()],
    }
    if fixed := [*rig.fixed_edges()]:
        parts["fixed edge"] = fixed
    maximum = in_rig_unit(rig, "flow_limit", float(rig.supply.flow_limit))
    lines = [f"rig '{rig.name}'" + (f": {rig.title}" if rig.title else "")]
    counts = ", ".join(counted(items, word) for word, items in parts.items())
    kind = "" if rig.supply.constant else f", {rig.supply.kind}"
    lines.append(f"  {counts}, supply {in_rig_unit(rig, 'pressure', supply)} up to {maximum}{kind}")
    notes = _cut_off(rig)
    loads: list[str | None] = [None, *rig.payload]
    for load in loads:
        try:
            model = Model.of(whole, payload=load)
            state = model.trim(model.posture({}))
            alone = model.trim(model.posture({}), LOW_SIDE * supply)  # what the load asks for
        except EhbenchError as error:
            raise type(error)(
                error.message, file=path, line=line_naming(path, error.message), hint=error.hint
            ) from None
        for index, cylinder in enumerate(rig.cylinder):
            ends = model.stroke_range(index)
            word, decimals = ("x", 0) if rig.mechanism.kind == "slide" else ("q", 1)
            first, last = (rig.told(word, value, decimals) for value in ends)
            span = f"{first.partition(' ')[0]} to {last}"
            at = [model.layout.state(name, index) for name in ("p_head", "p_rod")]
            lines.append(
                f"  {load or 'no payload'}: {cylinder.name} moves {span}; "
                f"at mid-stroke it rests at {in_rig_unit(rig, 'p_head', state[at[0]])} head, "
                f"{in_rig_unit(rig, 'p_rod', state[at[1]])} rod"
            )
            if abs(speed := model.creep(index, state)) > CREEPS:
                way = "out" if speed > 0.0 else "in"
                lines[-1] += f", creeping {way} at {rig.shown('v', abs(speed), 2)}"
            if alone[at].max() > supply and cylinder.pump is None:
                notes.append(
                    f"{load or 'no payload'}: the supply cannot carry the load of "
                    f"'{cylinder.name}' at mid-stroke"
                )
    lines += [f"  note: {text}" for text in notes]
    sure: dict[str, int] = {}
    for value in rig.parameters().values():
        if value.source:
            sure[value.sure] = sure.get(value.sure, 0) + 1
    bare = sum(not value.source and value.text is not None for value in rig.parameters().values())
    words = [f"{n} {word}" for word, n in sorted(sure.items())]
    message = ", ".join(words + [f"{bare} without a source"] * (bare > 0)) or "no sources given"
    lines.append(f"  how sure the numbers are: {message}")
    return Inspection((*lines, "ok"))


def _map(path: Path) -> Inspection:
    """A map of columns: what it says of each."""
    columns = load_columns(path).columns
    lines = [f"map of {counted(columns.names, 'column')}"]
    for name, column in columns.names.items():
        how = f" [{column.unit}]" if column.unit else ""
        how = f" {column.from_} → {column.to}" if column.from_ else how
        lines.append(f"  {name}: {column.channel}{how}")
    if not any(column.channel != "t" for column in columns.names.values()):
        raise InputError("maps no column to a channel", file=path)
    return Inspection((*lines, "ok"))


def _cut_off(rig: Rig) -> list[str]:
    """A sentence for each node that the edges of a cylinder leave out: odd, but at times meant"""
    sentences = []
    for cylinder in rig.cylinder:
        own = [*(edge for valve in cylinder.valve for edge in valve.edge), *cylinder.edge]
        joined = {end for edge in own for end in (edge.from_, edge.to)}
        for node in NODES:
            if node not in joined and (node != "tank" or cylinder.pump is None):
                what = f"the {node} end" if node in ("head", "rod") else f"the {node}"
                sentences.append(
                    f"no metering edge of '{cylinder.name}' touches {what}: is one missing?"
                )
    return sentences


def _flowmeter(path: Path) -> Inspection:
    data = read_flowmeter(path)
    lines = [f"flowmeter readings: {data.flow.size} rows"]
    for valve, direction in data.groups():
        rows = data.select(valve, direction)
        result = rows.pressure_drop[np.isfinite(rows.pressure_drop)]
        drops = "no pressures"
        if result.size:
            minimum, maximum = (
                rows.shown("pressure_drop", drop) for drop in (result.min(), result.max())
            )
            drops = f"drops {minimum} to {maximum}"
        lines.append(
            f"  {valve} {direction}: {counted(rows.flow, 'reading')} "
            f"at {counted(set(rows.command.tolist()), 'command')}, "
            f"{drops}, flow up to {rows.shown('flow', abs(rows.flow).max())}"
        )
    return Inspection((*lines, "ok"))


def _log(path: Path) -> Inspection:
    from ehbench.data import read
    from ehbench.preprocessing.plausibility import LEAST_SAMPLES
    from ehbench.preprocessing.time_base import evened, parts_of

    record = read(path)
    lines = [
        f"log: {record.t.size} samples of {len(record.channels)} channels, "
        f"{record.t[0]:g} to {record.t[-1]:g} s, every {record.sample_time * 1e3:.4g} ms"
    ]
    lines += [f"  {key}: {value}" for key, value in record.meta.items() if len(value) < 200]
    for name, values in record.channels.items():
        row = quantity(name)
        low, high = (from_si(float(v), row.display, row) for v in (values.min(), values.max()))
        lines.append(f"  {name}: {low:.4g} to {high:.4g} {row.display}")
    lines += [f"  lost: {loss}" for loss in record.losses]
    if record.t.size < LEAST_SAMPLES:
        lines.append(
            "  unfit for identification: "
            f"it has only {record.t.size} sample{'s' * (record.t.size != 1)}"
        )
        return Inspection((*lines, "ok, with losses"), 3)
    parts, gaps = parts_of(path.name, record)
    lines += [f"  {gap}" for gap in gaps]
    try:
        for part in parts:
            lines += [f"  {message}" for message in evened(part.name, part.record)[1]]
    except LogError as error:
        lines.append(f"  unfit for identification: {error}")
        return Inspection((*lines, "ok, with losses"), 3)
    return Inspection(
        (*lines, "ok, with losses" if record.losses or gaps else "ok"),
        3 if record.losses or gaps else 0,
    )
