"""Look at one file and say what it holds and whether it will do, without running anything."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ehbench.errors import EhbenchError, InputError, LogError
from ehbench.quantities import quantity
from ehbench.recipe import Campaign, Recipe, kind_of, load_recipe, load_rig
from ehbench.rig import Rig
from ehbench.units import from_si


@dataclass(frozen=True)
class Inspection:
    """What was found: lines to read, and the exit code (0 fine, 3 with data loss)."""

    lines: tuple[str, ...]
    code: int = 0


def check(path: Path) -> Inspection:
    """Inspect a rig or recipe (TOML), a flowmeter CSV, or a log (MCAP or CSV).

    Raises:
        InputError: the file is not right; says what, where and what would be right.
    """
    if not path.exists():
        raise InputError("no such file", file=path)
    if path.suffix == ".toml":
        return _rig(path) if kind_of(path) == "rig" else _recipe(path)
    if path.suffix == ".csv" and _is_flowmeter(path):
        return _flowmeter(path)
    if path.suffix in (".csv", ".mcap"):
        return _log(path)
    raise InputError(f"ehbench does not know '{path.suffix or path.name}' files", file=path, hint="it reads .toml, .csv and .mcap")


def _shown(rig: Rig, name: str, value: float) -> str:
    unit = rig.unit_of(name)
    return f"{from_si(value, unit, quantity(name)):.4g} {unit}"


def _rig(path: Path) -> Inspection:
    from ehbench.simulation import Model

    rig = load_rig(path)
    measured = all(edge.law != "map" for _, _, edge in rig.edges())
    lines = [f"rig '{rig.name}': {rig.title or 'no title'}"]
    lines.append(f"  {len(rig.joint_names)} joint(s), {len(rig.cylinder)} cylinder(s), {sum(1 for _ in rig.valves())} valve(s), "
                 f"{sum(1 for _ in rig.edges())} metering edge(s), supply {_shown(rig, 'pressure', float(rig.supply.pressure))}")  # fmt: skip
    loads: list[str | None] = [None, *rig.payload]
    for load in loads:
        if not measured:
            break
        model = Model.of(rig, payload=load)
        state = model.trim(model.posture({}))
        for index, cylinder in enumerate(rig.cylinder):
            ends = model.stroke_range(index)
            slide = rig.mechanism.kind == "slide"
            span = " to ".join(f"{v * 1e3:.0f}" if slide else f"{math.degrees(v):.1f}" for v in ends) + (" mm" if slide else " deg")
            head, rod = (state[model.layout.state(p, index)] for p in ("p_head", "p_rod"))
            lines.append(f"  {load or 'no payload'}: {cylinder.name} moves {span}; at mid-stroke it rests at "
                         f"{_shown(rig, 'p_head', head)} head, {_shown(rig, 'p_rod', rod)} rod")  # fmt: skip
    sure: dict[str, int] = {}
    for value in rig.parameters().values():
        if value.source:
            sure[value.sure] = sure.get(value.sure, 0) + 1
    lines.append("  how sure the numbers are: " + (", ".join(f"{n} {word}" for word, n in sorted(sure.items())) or "no sources given"))
    return Inspection((*lines, "ok"))


def _recipe(path: Path) -> Inspection:
    recipe: Recipe = load_recipe(path)
    lines = [f"recipe '{recipe.name}': stage {recipe.stage}" + (f", what {recipe.what}" if hasattr(recipe, "what") else "")]
    names = list(recipe.recipes) if isinstance(recipe, Campaign) else []
    names += [name for key in ("rig", "flow_maps", "bench") if (name := getattr(recipe, key, None))]
    names += [item if isinstance(item, str) else item.path for item in getattr(recipe, "data", ())]
    losses = []
    for name in names:
        file = recipe.file(name)
        if not file.exists():
            raise InputError(f"names '{name}', which is not there", file=path)
        if file.is_file():
            try:
                found = check(file)
            except EhbenchError as error:
                raise type(error)(error.message, file=error.file or file, line=error.line, hint=error.hint) from None
            lines.append(f"  {name}: {found.lines[0]}")
            losses += found.lines if found.code else ()
    _parameters(recipe)
    return Inspection((*lines, *losses, "ok"), 3 if losses else 0)


def _parameters(recipe: Recipe) -> None:
    """Refuse parameters that the recipe's rig file does not have."""
    wanted = getattr(recipe, "parameters", ())
    path = recipe.file(getattr(recipe, "rig", "."))
    if wanted and path.is_file() and kind_of(path) == "rig":
        load_rig(path).with_values(dict.fromkeys(wanted, 1.0))


def _is_flowmeter(path: Path) -> bool:
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        if line.strip() and not line.startswith("#"):
            names = [cell.split("[")[0].strip().lower() for cell in line.replace(";", ",").replace("\t", ",").split(",")]
            return "valve" in names or ("flow" in names and "t" not in names)
    return False


def _flowmeter(path: Path) -> Inspection:
    from ehbench.readers import read_flowmeter

    data = read_flowmeter(path)
    lines = [f"flowmeter readings: {data.flow.size} rows"]
    for valve, direction in data.groups():
        rows = data.select(valve, direction)
        lines.append(f"  {valve} {direction}: {rows.flow.size} readings at {len(set(rows.command.tolist()))} commands, "
                     f"drops {rows.pressure_drop.min() / 1e3:.0f} to {rows.pressure_drop.max() / 1e3:.0f} kPa, "
                     f"flow up to {abs(rows.flow).max() * 6e4:.3g} L/min")  # fmt: skip
    return Inspection((*lines, "ok"))


def _log(path: Path) -> Inspection:
    from ehbench.intake import LEAST_SAMPLES, evened
    from ehbench.logs import read_record

    record = read_record(path)
    lines = [f"log: {record.t.size} samples of {len(record.channels)} channels, {record.t[0]:g} to {record.t[-1]:g} s, "
             f"every {record.sample_time * 1e3:.4g} ms"]  # fmt: skip
    lines += [f"  {key}: {value}" for key, value in record.meta.items() if len(value) < 200]
    for name, values in record.channels.items():
        row = quantity(name)
        low, high = (from_si(float(v), row.display, row) for v in (values.min(), values.max()))
        lines.append(f"  {name}: {low:.4g} to {high:.4g} {row.display}")
    lines += [f"  lost: {loss}" for loss in record.losses]
    if record.t.size < LEAST_SAMPLES:
        lines.append(f"  unfit for identification: it has only {record.t.size} sample{'s' * (record.t.size != 1)}")
        return Inspection((*lines, "ok, with losses"), 3)
    try:
        lines += [f"  {said}" for said in evened(path.name, record)[1]]
    except LogError as error:
        lines.append(f"  unfit for identification: {error}")
        return Inspection((*lines, "ok, with losses"), 3)
    return Inspection((*lines, "ok, with losses" if record.losses else "ok"), 3 if record.losses else 0)
