"""Flowmeter readings as arrays in SI, by the header of a CSV or by a map of columns."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe.columns import READING_WORDS, ColumnMap, MappedColumn
from ehbench.data.channels import dialect_of, overruled, si_of
from ehbench.data.logs.checks import TIME_NAMES, check_unit
from ehbench.data.readers import Source, SourceTable, open_source
from ehbench.data.text import head_of, is_hole, text_table
from ehbench.vocabulary import VOCABULARY, Message, from_si, listed, message, plural, setting, to_si
from ehbench.vocabulary.errors import InputError, LogError, UnitError, placed
from ehbench.vocabulary.units import plausible

_PRESSURES = ("upstream_pressure", "downstream_pressure")
_NUMBERS = ("command", "pressure_drop", *_PRESSURES, "flow", "temperature")
_METHODS = ("flowmeter", "cylinder")
_EXAMPLE = "valve,direction,command [V],pressure_drop [kPa],flow [gpm],trial,method"


@dataclass(frozen=True)
class FlowmeterSettings:
    """Limits of what a reading of a flowmeter can be."""

    zero_share: float = setting(
        0.02, "", "share of the largest reading below which a sign says nothing", "scatter at rest"
    )
    supply_margin: float = setting(
        1.5, "", "drop in supply pressures from which its unit is wrong", "units differ by 7"
    )
    supply_share: float = setting(
        0.005, "", "largest drop, in supply pressures, below which its unit is doubted", "as above"
    )
    most_left_out: float = setting(
        1.0 / 3.0, "", "share of a valve's readings that may be left out as slips", "a majority is"
    )
    fewest_reverse: int = setting(
        4, "", "readings with both signs turned that are a map's other direction", "a fit"
    )


SETTINGS = FlowmeterSettings()


@dataclass(frozen=True, eq=False)
class FlowmeterData:
    """Flowmeter readings, one array entry a row, in the order of the file. SI.

    ``valve``, ``direction`` (``forward``, ``reverse`` or ``from->to``) and ``method``
    (``flowmeter``, ``cylinder``) are arrays of text; ``command`` [V]; ``pressure_drop`` [Pa], NaN
    where a cylinder's speed was taken without, and ``flow`` [m³/s] along the direction, so positive
    up to the scatter about zero; ``trial`` counts;
    ``temperature`` [K], NaN where not given; ``line`` is the line in ``file``. ``warnings`` are
    notes on what looks odd and was retained, ``losses`` on what was left out, ``details`` each of
    it; ``units`` those in which the file, the first of several, has its columns."""

    valve: np.ndarray
    direction: np.ndarray
    command: np.ndarray
    pressure_drop: np.ndarray
    flow: np.ndarray
    trial: np.ndarray
    method: np.ndarray
    temperature: np.ndarray
    file: np.ndarray
    line: np.ndarray
    warnings: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.line.size

    def shown(self, word: str, value: float) -> str:
        """A value [SI] of ``pressure_drop`` or ``flow`` in the unit that the file has it in."""
        row = VOCABULARY[word]
        unit = _drop_unit(self.units) if word == "pressure_drop" else self.units.get(word)
        return f"{float(from_si(value, unit or row.display, row)):.3g} {unit or row.display}"

    def groups(self) -> list[tuple[str, str]]:
        """(valve, direction) pairs there are readings of, sorted."""
        return sorted(set(zip(self.valve.tolist(), self.direction.tolist(), strict=True)))

    def select(self, valve: str, direction: str = "forward") -> FlowmeterData:
        """The readings of one valve in one direction.

        Raises:
            InputError: there are none; names the valves and directions there are."""
        rows = (self.valve == valve) & (self.direction == direction)
        if not rows.any():
            fields = {"there": ", ".join(" ".join(group) for group in self.groups())}
            fields |= {"valve": valve, "direction": direction}
            raise InputError(message("data.no_readings_of", **fields))
        return self.at(rows)

    def at(self, rows: np.ndarray) -> FlowmeterData:
        """These readings alone, by number or by a mask."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _ARRAYS})


_ARRAYS = tuple(f.name for f in fields(FlowmeterData) if f.type == "np.ndarray")


class LeftOut:
    """Readings that cannot be right: the first stops the reading, or those of files whose name is
    ``allowed`` are left out and reported, as long as they are few."""

    def __init__(self, allowed: Collection[str]) -> None:
        self.allowed = allowed
        self.errors: list[tuple[str, InputError]] = []

    def take(self, valve: str, error: InputError) -> None:
        """Note what is wrong with a reading of a valve.

        Raises:
            InputError: where nothing of its file may be left out."""
        if Path(str(error.file)).name not in self.allowed:
            cure = message("data.leave_readings_out")
            hint = cure if error.hint is None else f"{error.hint}; {cure}"
            raise type(error)(error.message, file=error.file, line=error.line, hint=hint)
        self.errors.append((valve, error))

    @property
    def details(self) -> tuple[str, ...]:
        """A note on each reading that is left out."""
        places = (f"{Path(str(error.file)).name}:{error.line}" for _, error in self.errors)
        return tuple(f"{at}: {error.message}" for at, (_, error) in zip(places, self.errors))

    def sentences(self, retained: Sequence[str]) -> tuple[str, ...]:
        """A note for each file on the readings of it that are left out; ``retained`` has the valve
        of each reading that is not.

        Raises:
            InputError: they are too many of a valve's readings to be slips."""
        stay, gone = Counter(retained), Counter(valve for valve, _ in self.errors)
        files: dict[str, list[InputError]] = {}
        for valve, error in self.errors:
            count, every = gone[valve], gone[valve] + stay[valve]
            if count > max(1, SETTINGS.most_left_out * every):
                fields = {"count": count, "every": every, "valve": valve}
                text = message("data.too_many_left_out", error=error.message, **fields)
                hint = "; ".join(filter(None, (error.hint, text.hint)))
                raise type(error)(text, file=error.file, line=error.line, hint=hint)
            files.setdefault(Path(str(error.file)).name, []).append(error)
        notes = []
        for name, errors in files.items():
            first = "; ".join(f"line {error.line}: {error.message}" for error in errors[:4])
            others = listed((error.line for error in errors[4:]), 12)
            more = f"; lines {others}" if others else ""
            fields = {"readings": plural(len(errors), "reading"), "first": first, "more": more}
            notes.append(message("data.readings_left_out", name=name, **fields))
        return tuple(notes)


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Columns of readings: ``numbers`` in SI with the text of what is none, by row (``odd``), the
    ``units`` that they were written in, ``words``, the line of each row, and ``notes`` on all."""

    path: Path
    lines: Sequence[int]
    numbers: Mapping[str, np.ndarray]
    odd: Mapping[str, Mapping[int, str]]
    words: Mapping[str, Sequence[str]]
    units: Mapping[str, str]
    notes: Sequence[Message] = ()


def read_flowmeter(
    path: str | Path,
    columns: ColumnMap | None = None,
    *,
    supply_pressure: float | None = None,
    leave_out: bool = False,
) -> FlowmeterData:
    """Flowmeter readings from a CSV file, or from any file by a map of its columns.

    The first line that is no comment (``#``) names the columns, in any order, with any unit of the
    right kind: ``valve, command [V], pressure_drop [kPa], flow [gpm]``, or ``upstream_pressure``
    and ``downstream_pressure`` in place of ``pressure_drop``; neither where all rows are of the
    method ``cylinder``; optional ``direction`` (``forward``,
    ``reverse``, or nodes as ``head->rod``), ``trial``, ``method`` (``flowmeter`` or ``cylinder``),
    ``temperature [degC]``, ``note``. Columns are separated by commas, or by semicolons or tabs,
    where decimal commas are understood. A row without direction whose drop and flow are both
    negative is a reading in the reverse direction. By a map without a column of valves a file is of
    the valve that its name says, and so is each of several tables that have all columns of the map.

    Args:
        columns: the map; one that names no column leaves the names to the file.
        supply_pressure: [Pa]; a drop above 1.5 times as much is refused as a slip of unit.
        leave_out: leave out a row that cannot be right, and say so in ``losses``; more than a third
            of a valve's rows are refused nevertheless.

    Raises:
        InputError, UnitError: with file, line and what would be right."""
    path = Path(path)
    sheets = []
    if columns is not None and columns.columns.names:
        source = open_source(path, dialect_of(columns))
        tables = alike(source, list(columns.columns.names))
        each = [(replace(source, tables=(table,)), table.name) for table in tables]
        if len(tables) < 2:  # where no column names the valve, the file does
            each = [(source, Path(path.name.removesuffix(".gz")).stem)]
        sheets += [sheet for item in each for sheet in _mapped_table(path, *item, columns)]
    else:
        sheets.append(_named(path))
    left_out = LeftOut([path.name] if leave_out else [])
    rows: list[dict[str, Any]] = []
    for sheet in sheets:
        for index, valve in enumerate(sheet.words["valve"]):
            try:
                rows.append(_row(sheet, index))
            except InputError as error:
                left_out.take(valve, error)
    if not rows and not left_out.errors:
        raise InputError(message("data.no_readings", example=_EXAMPLE), file=path)
    units = sheets[0].units
    warnings: list[str] = [note for sheet in sheets for note in sheet.notes]
    if supply_pressure is not None:
        rows, small = _within_supply(rows, supply_pressure, units, left_out)
        warnings += small
    rows = _signs(rows, left_out)
    losses = left_out.sentences([row["valve"] for row in rows])
    arrays: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in _ARRAYS}
    arrays |= {"warnings": tuple(warnings), "losses": losses, "details": left_out.details}
    return FlowmeterData(**arrays, units=units)


def is_flowmeter(path: Path) -> bool:
    """Whether the header of a CSV is one of flowmeter readings."""
    try:
        header = text_table(path, _EXAMPLE).header
    except InputError:
        return False
    names = {head_of(cell)[0].lower() for cell in header}
    return bool(names & {"valve", "flow"}) and not names & {*TIME_NAMES}


def _named(path: Path) -> _Sheet:
    """The columns of a CSV whose header names them."""
    try:
        table = text_table(path, _EXAMPLE)
    except LogError as error:
        if error.key != "data.no_text":
            raise
        raise LogError(message("data.readings_no_text"), file=path) from None
    where: dict[str, Any] = {"file": path, "line": table.head}
    places: dict[str, int] = {}
    units: dict[str, str] = {}
    for place, cell in enumerate(table.header):
        text, unit = head_of(cell)
        name = text.lower().replace(" ", "_")
        if name not in (*_NUMBERS, *READING_WORDS):
            known = (*_NUMBERS, *READING_WORDS)
            near = get_close_matches(re.split(r"[\s(\[{]", cell.lower())[0], known, 1, cutoff=0.5)
            key = "data.unknown_column_near" if near else "data.unknown_column"
            unit = f" [{VOCABULARY[near[0]].display}]" if near and near[0] in _NUMBERS else ""
            fields = {"cell": cell, "example": _EXAMPLE, "near": "".join(near), "unit": unit}
            raise InputError(message(key, **fields), **where)
        if name in places:
            raise InputError(message("data.column_twice", name=name), **where)
        places[name] = place
        if name in _NUMBERS:
            check_unit(cell, name, unit, **where)
            units[name] = unit
        elif unit not in ("", "-", "1"):
            raise UnitError(message("data.unit_of_words", name=name, unit=unit), **where)
    _check_columns(places, where, "data.missing_column")
    values, odd = table.numbers([places[name] for name in units])
    numbers = {
        name: to_si(values[:, at], unit, VOCABULARY[name])
        for at, (name, unit) in enumerate(units.items())
    }
    words = {name: table.cells(places[name]) for name in READING_WORDS if name in places}
    return _Sheet(path, table.lines, numbers, dict(zip(units, odd, strict=True)), words, units)


def _check_columns(names: Collection[str], where: Mapping[str, Any], lacks: str) -> None:
    """Refuse a header or map that ``lacks`` a column, or says the drop twice."""
    sides = any(name in names for name in _PRESSURES)
    if "pressure_drop" in names and sides:
        raise InputError(message("data.drop_and_pressures"), **where)
    needed = ["valve", "command", "flow"]
    if sides:
        needed += _PRESSURES
    elif "method" not in names:  # a cylinder's speed may stand alone, row by row
        needed.append("pressure_drop")
    if missing := [name for name in needed if name not in names]:
        shown = [f"{n} [{VOCABULARY[n].display}]" if n in _NUMBERS else n for n in missing]
        columns, cells = " and ".join(missing), " and ".join(f'"{text}"' for text in shown)
        raise InputError(message(lacks, columns=columns, cells=cells), **where)


def _mapped_table(path: Path, source: Source, valve: str, columns: ColumnMap) -> list[_Sheet]:
    """The readings of the first table of a source by each of its columns of flow, those of a valve
    where neither a column nor a channel names it."""
    table, numbers, odd, words, notes = source.tables[0], {}, {}, {}, []
    lines = table.lines or range(2, table.size + 2)
    flows: list[tuple[MappedColumn, np.ndarray, Mapping[int, str]]] = []
    for name, mapped in columns.columns.names.items():
        of, _, what = mapped.channel.rpartition(".")
        valve = of if of and what in ("command", "flow") else valve
        if what in READING_WORDS and name in table.words:
            words[what] = table.words[name]
            continue
        index, place = source.place(name, path)
        if index:
            other = source.tables[index].name
            raise InputError(message("data.other_table", name=name, table=other), file=path)
        column = table.columns[place]
        if what in READING_WORDS:
            words[what] = [f"{value:g}" for value in column.values]
        elif what != "t":
            values = si_of(name, mapped, column, columns, path, lines)
            if what == "flow":
                flows.append((mapped, values, column.odd))
            else:
                numbers[what], odd[what] = values, column.odd
            notes += overruled(name, mapped, column, path)
    words.setdefault("valve", [valve] * table.size)
    sheets, where = [], columns.at("names")
    for mapped, values, cells in flows or [(None, np.empty(0), {})]:
        at = {"command": mapped.command, "pressure_drop": mapped.pressure_drop} if mapped else {}
        said = {
            what: np.full(table.size, float(value))
            for what, value in at.items()
            if value is not None
        }
        if twice := [what for what in said if what in numbers]:
            raise InputError(message("data.column_twice", name=twice[0]), **where)
        here = numbers | said | ({"flow": values} if mapped else {})
        _check_columns([*here, *words], where, "data.missing_in_map")
        units = {what: VOCABULARY[what].unit for what in here}
        sheet = _Sheet(path, lines, here, {**odd, "flow": cells}, words, units, notes)
        sheets.append(_read_alone(sheet) if said else sheet)
        notes = []
    return sheets


def _read_alone(sheet: _Sheet) -> _Sheet:
    """The rows of one of several columns of flow that were read: the others are blank."""
    flow, cells = sheet.numbers["flow"], sheet.odd["flow"]
    rows = [k for k in range(flow.size) if math.isfinite(flow[k]) or not is_hole(cells.get(k, ""))]
    return replace(
        sheet,
        lines=[sheet.lines[k] for k in rows],
        numbers={what: values[rows] for what, values in sheet.numbers.items()},
        odd={
            what: {at: texts[k] for at, k in enumerate(rows) if k in texts}
            for what, texts in sheet.odd.items()
        },
        words={what: [texts[k] for k in rows] for what, texts in sheet.words.items()},
    )


def alike(source: Source, names: Sequence[str] | None = None) -> list[SourceTable]:
    """The tables of a workbook that have all columns of some names; without names those of the
    first. A sheet for each valve, with the same columns, is one workbook of readings."""
    has = [{*(column.name for column in item.columns), *item.words} for item in source.tables]
    required = set(names) if names is not None else has[0] if has else set()
    return [table for table, there in zip(source.tables, has, strict=True) if required <= there]


def _row(sheet: _Sheet, index: int) -> dict[str, Any]:
    """One reading in SI, its drop signed along the direction as the file has it.

    Raises:
        InputError: a cell that is blank, no number or no word that is known."""
    where: dict[str, Any] = {"file": sheet.path, "line": sheet.lines[index]}
    words = {name: cells[index] for name, cells in sheet.words.items()}
    row: dict[str, Any] = {
        "file": str(sheet.path),
        "line": sheet.lines[index],
        "valve": words["valve"],
        "temperature": math.nan,
        "pressure_drop": math.nan,
    }
    if not row["valve"]:
        raise InputError(message("data.blank_valve"), **where)
    for name, values in sheet.numbers.items():
        quantity, number = VOCABULARY[name], float(values[index])
        if not math.isfinite(number):
            cell = sheet.odd[name].get(index, f"{number:g}")
            if name == "temperature" and is_hole(cell):
                continue
            key = "data.no_number" if cell else "data.blank"
            raise InputError(message(key, name=name, cell=cell), **where)
        row[name] = number
        unit = sheet.units[name]
        with placed(where):
            plausible(number, quantity, f"{from_si(number, unit, quantity):.6g} {unit}", unit)
    if _PRESSURES[0] in row:
        row["pressure_drop"] = row.pop(_PRESSURES[0]) - row.pop(_PRESSURES[1])
    row["direction"] = re.sub(r"\s*(->|→)\s*", "->", words.get("direction", "").lower())
    row["method"] = words.get("method", "").lower() or _METHODS[0]
    trial = words.get("trial", "") or "1"
    if not re.fullmatch(r"(forward|reverse|\w+->\w+)?", row["direction"]):
        raise InputError(message("data.bad_direction", text=words["direction"]), **where)
    if row["method"] not in _METHODS:
        raise InputError(message("data.bad_method", text=words["method"]), **where)
    if row["method"] != "cylinder" and math.isnan(row["pressure_drop"]):
        raise InputError(message("data.reading_without_drop"), **where)
    if not re.fullmatch(r"\d{1,9}", trial):
        raise InputError(message("data.bad_trial", text=trial), **where)
    return row | {"trial": int(trial)}


def _within_supply(
    rows: Sequence[dict[str, Any]], supply: float, units: Mapping[str, str], left_out: LeftOut
) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
    """(the rows but for drops far above the supply pressure [Pa]; a warning where all are far
    below it)."""
    unit, row_of = _drop_unit(units), VOCABULARY["pressure_drop"]
    retained = []
    for row in rows:
        times = abs(row["pressure_drop"]) / supply
        if times > SETTINGS.supply_margin:
            shown, limit = (from_si(x, unit, row_of) for x in (times * supply, supply))
            fields = {"drop": shown, "unit": unit, "times": times, "supply": limit}
            text = message("data.drop_beyond_supply", **fields)
            left_out.take(row["valve"], UnitError(text, file=row["file"], line=row["line"]))
        else:
            retained.append(row)
    largest = max((row["pressure_drop"] for row in retained), default=np.inf)
    if not largest < SETTINGS.supply_share * supply:
        return retained, ()
    fields = {"drop": from_si(largest, unit, row_of), "unit": unit}
    return retained, (message("data.small_drops", file=retained[0]["file"], **fields),)


def _signs(rows: list[dict[str, Any]], left_out: LeftOut) -> list[dict[str, Any]]:
    """The rows but for those whose flow runs against its drop, or the drop against the direction;
    those with both negative and no direction are turned into reverse ones. Where rows may be left
    out, too few turned ones for a map are slips."""
    zeros: dict[str, tuple[float, float]] = {}
    for row in rows:
        flow, drop = zeros.get(row["valve"], (0.0, 0.0))
        share = SETTINGS.zero_share
        flow = max(flow, share * abs(row["flow"]))
        zeros[row["valve"]] = flow, max(drop, share * abs(row["pressure_drop"]))
    retained, turned = [], Counter()
    for row in rows:
        valve, flow, drop = row["valve"], row["flow"], row["pressure_drop"]
        flow_zero, drop_zero = zeros[valve]
        where: dict[str, Any] = {"file": row["file"], "line": row["line"]}
        if flow * drop < 0 and abs(flow) > flow_zero and abs(drop) > drop_zero:
            half = row["command"] < 0.0 and flow < 0.0  # a spool swept to both sides
            key = "data.flow_of_other_half" if half else "data.flow_against_drop"
            text = message(key, valve=valve)
        elif drop < -drop_zero and row["direction"]:
            text = message("data.drop_against_direction", direction=row["direction"])
        else:
            if drop < -drop_zero:
                row |= {"flow": -flow, "pressure_drop": -drop, "direction": "reverse"}
                turned[valve] += 1
            row["direction"] = row["direction"] or "forward"
            retained.append(row)
            continue
        left_out.take(valve, InputError(text, **where))
    few = {valve for valve, count in turned.items() if count < SETTINGS.fewest_reverse}
    slips = [row for row in retained if row["valve"] in few and row["direction"] == "reverse"]
    for row in slips if left_out.allowed else ():
        text = message("data.few_reverse", valve=row["valve"])
        left_out.take(row["valve"], InputError(text, file=row["file"], line=row["line"]))
        retained.remove(row)
    return retained


def _drop_unit(units: Mapping[str, str]) -> str:
    display = VOCABULARY["pressure_drop"].display
    return units.get("pressure_drop") or units.get("upstream_pressure", display)


def merge_flowmeter(parts: Sequence[FlowmeterData]) -> FlowmeterData:
    """The readings of several files one after the other; each keeps its file and line."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS
    }
    for name in ("warnings", "losses", "details"):
        arrays[name] = tuple(text for part in parts for text in getattr(part, name))
    return FlowmeterData(**arrays, units=parts[0].units)
