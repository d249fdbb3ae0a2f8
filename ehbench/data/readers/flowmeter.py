"""Flowmeter readings in CSV as arrays in SI."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.runtime.disk import DATA, read_bytes
from ehbench.vocabulary.errors import InputError, UnitError
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si, plausible, to_si

_NUMBERS = (
    "command",
    "pressure_drop",
    "upstream_pressure",
    "downstream_pressure",
    "flow",
    "temperature",
)
_WORDS = ("valve", "direction", "trial", "method", "note")
_METHODS = ("flowmeter", "cylinder")
_OPPOSITE = {"forward": "reverse", "reverse": "forward"}
_EXAMPLE = "valve,direction,command [V],pressure_drop [kPa],flow [gpm],trial,method"
_HEADER = re.compile(r"\s*([^\[\]]*?)\s*(?:\[\s*([^\[\]]*?)\s*\])?\s*")
# a meter at rest scatters about zero: up to this share of a valve's largest reading the sign says
# nothing
_ZERO_SHARE = 0.02
_SUPPLY_MARGIN = 1.5
# share of a valve's readings beyond which what is wrong with them is no slip
MOST_LEFT = 1.0 / 3.0
# readings both of whose signs are turned are a map's other direction from 4 on, else slips
_LEAST_REVERSE = 4
_NAMED, _LISTED = 4, 12  # readings left out that are told with their reason, with their line
LEAVING = 'bad_samples = "leave out" in the map of columns, or under [columns]'


@dataclass(frozen=True, eq=False)
class FlowmeterData:
    """Flowmeter readings, one array entry a row, in the order of the file. SI.

    ``valve``, ``direction`` (``forward``, ``reverse`` or ``from->to``) and ``method``
    (``flowmeter``, ``cylinder``) are arrays of text; ``command`` [V]; ``pressure_drop`` [Pa], NaN
    where a cylinder's speed was taken without, and ``flow`` [m³/s] along the direction, so positive
    up to the scatter about zero; ``trial`` counts;
    ``temperature`` [K], NaN where not given; ``line`` is the line in ``file``. ``warnings`` are
    sentences on what looks odd and was kept, ``losses`` on what was left out; ``units`` those in
    which the file, the first of several, has its columns."""

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
            InputError: there are none; names the valves and directions there are.
        """
        at = (self.valve == valve) & (self.direction == direction)
        if not at.any():
            there = ", ".join(f"{name} {way}" for name, way in self.groups())
            raise InputError(
                f"there are no readings of '{valve}' in direction {direction}",
                hint=f"there are {there}",
            )
        return self.at(at)

    def at(self, rows: np.ndarray) -> FlowmeterData:
        """These readings alone, by number or by a mask."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _ARRAYS})


_ARRAYS = tuple(f.name for f in fields(FlowmeterData) if f.type == "np.ndarray")


class LeftOut:
    """Readings that cannot be right: the first stops the reading of a file, or each is ``allowed``
    to be left out and told, as long as they are few.
    """

    def __init__(self, allowed: bool) -> None:
        self.allowed = allowed
        self.errors: list[tuple[str, InputError]] = []

    def take(self, valve: str, error: InputError) -> None:
        """Keep what is wrong with a reading of a valve.

        Raises:
            InputError: where nothing may be left out.
        """
        if not self.allowed:
            cure = f"or leave such readings out: {LEAVING}"
            hint = cure if error.hint is None else f"{error.hint}; {cure}"
            raise type(error)(error.message, file=error.file, line=error.line, hint=hint)
        self.errors.append((valve, error))

    def sentences(self, kept: Sequence[str]) -> tuple[str, ...]:
        """A sentence for each file on the readings of it that are left out.

        Args:
            kept: the valve of each reading that is not.

        Raises:
            InputError: they are too many of a valve's readings to be slips.
        """
        stay, gone = Counter(kept), Counter(valve for valve, _ in self.errors)
        files: dict[str, list[InputError]] = {}
        for valve, error in self.errors:
            every = gone[valve] + stay[valve]
            if gone[valve] > max(1, MOST_LEFT * every):
                hint = "sign = -1 in a map of columns turns a column round"
                raise type(error)(
                    f"{error.message}; so it is with {gone[valve]} of {every} readings of {valve}, "
                    "too many to leave out",
                    file=error.file,
                    line=error.line,
                    hint=hint if error.hint is None else f"{error.hint}; {hint}",
                )
            files.setdefault(Path(str(error.file)).name, []).append(error)
        return tuple(_told(*pair) for pair in files.items())


def _told(name: str, errors: Sequence[InputError]) -> str:
    """How many readings of a file are left out, and of the first of them why."""
    are = "readings are" if len(errors) > 1 else "reading is"
    first = "; ".join(f"line {error.line}: {error.message}" for error in errors[:_NAMED])
    rest = ", ".join(str(error.line) for error in errors[_NAMED:][:_LISTED])
    more = f"; lines {rest}{', …' * (len(errors) > _NAMED + _LISTED)}" if rest else ""
    return f"{name}: {len(errors)} {are} left out: {first}{more}"


def read_flowmeter(
    path: str | Path,
    *,
    supply_pressure: float | None = None,
    lines: list[tuple[int, str]] | None = None,
    leave_out: bool = False,
) -> FlowmeterData:
    """Flowmeter readings from a CSV file.

    The first line that is no comment (``#``) names the columns, in any order, with any unit of the
    right kind: ``valve, command [V], pressure_drop [kPa], flow [gpm]``, or ``upstream_pressure``
    and ``downstream_pressure`` in place of ``pressure_drop``; neither where all rows are of the
    method ``cylinder``; optional ``direction`` (``forward``,
    ``reverse``, or nodes as ``head->rod``), ``trial``, ``method`` (``flowmeter`` or ``cylinder``),
    ``temperature [degC]``, ``note``. Columns are separated by commas, or by semicolons or tabs,
    where decimal commas are understood. A row without direction whose drop and flow are both
    negative is a reading in the reverse direction.

    Args:
        supply_pressure: [Pa]; a drop above 1.5 times as much is refused as a slip of unit.
        lines: what to read in place of the file's own text: (line, text) of header and rows.
        leave_out: leave out a row that cannot be right, and say so in ``losses``; more than a third
            of a valve's rows are refused nevertheless.

    Raises:
        InputError, UnitError: with file, line and what would be right.
    """
    path = Path(path)
    lines = _lines(path) if lines is None else lines
    if not lines:
        raise InputError(
            "holds no readings", file=path, hint=f"the first line names the columns: {_EXAMPLE}"
        )
    first, header = lines[0]
    delimiter = max(",;\t", key=lambda mark: (header.count(mark), mark == ","))
    columns, units = _columns(path, first, _cells(path, first, header, delimiter))
    rows, left_out = [], LeftOut(leave_out)
    for number, text in lines[1:]:
        named = _named(path, number, columns, _cells(path, number, text, delimiter), delimiter)
        try:
            rows.append(_row(path, number, named, units, delimiter != ","))
        except InputError as error:
            left_out.take(named["valve"], error)
    if not rows and not left_out.errors:
        raise InputError("has a header but no readings", file=path, line=first)
    rows = _within_supply(path, rows, supply_pressure, units, left_out)
    rows = _signs(path, rows, left_out)
    losses = left_out.sentences([row["valve"] for row in rows])
    return replace(_data(path, rows, supply_pressure, units), losses=losses)


def _lines(path: Path) -> list[tuple[int, str]]:
    """(line number, text) of all lines that are neither empty nor a comment."""
    try:
        raw = read_bytes(path, DATA)
    except FileNotFoundError:
        raise InputError("there is no such file", file=path) from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise InputError(
            "is not UTF-8 text", file=path, line=line, hint="save it as CSV (UTF-8)"
        ) from None
    if "\0" in text:
        raise InputError("is not a text file", file=path, hint="save it as CSV (UTF-8)")
    numbered = enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1)
    return [
        (number, line)
        for number, line in numbered
        if line.strip(" ,;\t") and not line.lstrip(' "').startswith("#")
    ]


def _cells(path: Path, number: int, text: str, delimiter: str) -> list[str]:
    try:
        return [
            cell.strip()
            for cell in next(
                csv.reader([text], delimiter=delimiter, strict=True, skipinitialspace=True)
            )
        ]
    except csv.Error as error:
        raise InputError(f"is no row of a CSV file: {error}", file=path, line=number) from None


def _named(
    path: Path, number: int, columns: list[str], cells: list[str], delimiter: str
) -> dict[str, str]:
    """The cells of a row by column."""
    if len(cells) == len(columns):
        return dict(zip(columns, cells, strict=True))
    hint = "a decimal comma? write numbers with a point, or separate columns by semicolons"
    raise InputError(
        f"has {len(cells)} columns, the header has {len(columns)}",
        file=path,
        line=number,
        hint=hint if delimiter == "," else None,
    )


def _columns(path: Path, line: int, cells: list[str]) -> tuple[list[str], dict[str, str]]:
    """Column names in the order of the file, and the unit of each column of numbers."""
    names, units = [], {}
    known = _NUMBERS + _WORDS
    for cell in cells:
        match = _HEADER.fullmatch(cell)
        message, unit = (match[1], match[2]) if match else (cell, None)
        name = message.lower().replace(" ", "_")
        if name not in known:
            near = get_close_matches(re.split(r"[\s(\[{]", cell.lower())[0], known, 1, 0.5)
            hint = f"nearest is '{near[0]}'" if near else f"the columns are like {_EXAMPLE}"
            if near and near[0] in _NUMBERS:
                hint += f', written with its unit: "{near[0]} [{VOCABULARY[near[0]].display}]"'
            raise InputError(f"unknown column '{cell}'", file=path, line=line, hint=hint)
        if name in names:
            raise InputError(f"column '{name}' comes twice", file=path, line=line)
        names.append(name)
        if name in _NUMBERS:
            row = VOCABULARY[name]
            if not unit:
                raise UnitError(
                    f"column '{name}' has no unit",
                    file=path,
                    line=line,
                    hint=f'write it like "{name} [{row.display}]"',
                )
            try:
                to_si(1.0, unit, row)
            except UnitError as error:
                raise UnitError(
                    f"column '{name}': {error.message}", file=path, line=line, hint=error.hint
                ) from None
            units[name] = unit
        elif unit not in (None, "", "-", "1"):
            raise UnitError(f"column '{name}' has no unit, not '{unit}'", file=path, line=line)
    both = {"upstream_pressure", "downstream_pressure"}
    if "pressure_drop" in names and both & set(names):
        raise InputError(
            "give pressure_drop or upstream_pressure and downstream_pressure, not both",
            file=path,
            line=line,
        )
    needed = [
        "valve",
        "command",
        "flow",
        *(sorted(both, reverse=True) if both & set(names) else ["pressure_drop"]),
    ]
    if "method" in names and not both & set(names):
        needed.remove("pressure_drop")  # a cylinder's speed may stand alone, row by row
    missing = [name for name in needed if name not in names]
    if missing:
        shown = [f'"{n} [{VOCABULARY[n].display}]"' if n in _NUMBERS else f'"{n}"' for n in missing]
        raise InputError(
            f"misses the column {' and '.join(missing)}",
            file=path,
            line=line,
            hint=f"add {' and '.join(shown)}",
        )
    return names, units


def _number(path: Path, line: int, name: str, text: str, decimal_comma: bool) -> float:
    plain = (
        text.replace(",", ".")
        if decimal_comma and text.count(",") == 1 and "." not in text
        else text
    )
    try:
        value = float(plain)
    except ValueError:
        value = math.nan
    if not text:
        raise InputError(
            f"{name} is blank", file=path, line=line, hint="fill it in, or take the row out"
        )
    if not math.isfinite(value) or "_" in plain or not plain.isascii():
        raise InputError(
            f"{name} is '{text}', which is no number",
            file=path,
            line=line,
            hint="write it like 1234.5, without a unit",
        )
    return value


def _row(
    path: Path, line: int, cells: dict[str, str], units: dict[str, str], decimal_comma: bool
) -> dict:
    """One reading in SI, its drop signed along the direction as the file has it."""
    row: dict = {"file": str(path), "line": line, "valve": cells["valve"], "temperature": math.nan}
    if not row["valve"]:
        raise InputError(
            "valve is blank", file=path, line=line, hint="name the valve as in the rig file"
        )
    for name, unit in units.items():
        if name == "temperature" and not cells[name]:
            continue
        number = _number(path, line, name, cells[name], decimal_comma)
        row[name] = float(to_si(number, unit, VOCABULARY[name]))
        try:
            plausible(row[name], VOCABULARY[name], f"{cells[name]} {unit}")
        except UnitError as error:
            raise UnitError(error.message, file=path, line=line, hint=error.hint) from None
    if "upstream_pressure" in row:
        row["pressure_drop"] = row["upstream_pressure"] - row["downstream_pressure"]
    row.setdefault("pressure_drop", math.nan)
    row["direction"] = re.sub(r"\s*(->|→)\s*", "->", cells.get("direction", "").lower())
    if row["direction"] not in ("", *_OPPOSITE) and not re.fullmatch(r"\w+->\w+", row["direction"]):
        raise InputError(
            f"direction is '{cells['direction']}'",
            file=path,
            line=line,
            hint="write forward, reverse, or the nodes like head->rod",
        )
    row["method"] = cells.get("method", "").lower() or _METHODS[0]
    if row["method"] not in _METHODS:
        raise InputError(
            f"method is '{cells['method']}'",
            file=path,
            line=line,
            hint="write flowmeter or cylinder",
        )
    if row["method"] != "cylinder" and math.isnan(row["pressure_drop"]):
        raise InputError(
            "a flowmeter's reading without a pressure drop",
            file=path,
            line=line,
            hint="add the column pressure_drop; only method cylinder may go without",
        )
    trial = cells.get("trial", "") or "1"
    if not re.fullmatch(r"\d{1,9}", trial):
        raise InputError(
            f"trial is '{trial}', which does not count trials",
            file=path,
            line=line,
            hint="write 1, 2, 3, …",
        )
    row["trial"] = int(trial)
    return row


def _signs(path: Path, rows: list[dict], left_out: LeftOut) -> list[dict]:
    """The rows but for those whose flow runs against its drop; those with both negative and no
    direction are turned into reverse ones.
    """
    largest: dict[str, tuple[float, float]] = {}
    for row in rows:
        flow, drop = largest.get(row["valve"], (0.0, 0.0))
        largest[row["valve"]] = max(flow, abs(row["flow"])), max(drop, abs(row["pressure_drop"]))
    retained, turned = [], Counter()
    for row in rows:
        zeros = tuple(_ZERO_SHARE * value for value in largest[row["valve"]])
        try:
            turned[row["valve"]] += _turned(path, row, *zeros)
        except InputError as error:
            left_out.take(row["valve"], error)
        else:
            retained.append(row)
    return [row for row in retained if not _strays(path, row, turned, left_out)]


def _turned(path: Path, row: dict, flow_zero: float, drop_zero: float) -> bool:
    """Whether a row is of the reverse direction though it does not say so: it is turned round.

    Raises:
        InputError: flow against the drop, or a drop against the direction that the row says.
    """
    flow, drop = row["flow"], row["pressure_drop"]
    if flow * drop < 0 and abs(flow) > flow_zero and abs(drop) > drop_zero:
        raise InputError(
            f"the flow of {row['valve']} runs against its drop: one is negative, the other "
            "positive",
            file=path,
            line=row["line"],
            hint="oil flows down the pressure: both carry the sign of the direction",
        )
    turns = drop < -drop_zero
    if turns and row["direction"]:
        raise InputError(
            f"the drop is negative along the direction {row['direction']}",
            file=path,
            line=row["line"],
            hint="count drop and flow positive along the direction, or leave the direction out",
        )
    if turns:
        row.update(direction="reverse", flow=-flow, pressure_drop=-drop)
    row["direction"] = row["direction"] or "forward"
    return turns


def _strays(path: Path, row: dict, turned: Counter[str], left_out: LeftOut) -> bool:
    """Whether a row is one of a few that were turned round: where rows may be left out, too few
    for a map are slips.
    """
    few = 0 < turned[row["valve"]] < _LEAST_REVERSE
    if not (left_out.allowed and few and row["direction"] == "reverse"):
        return False
    message = f"drop and flow of {row['valve']} are negative, as in few of its readings"
    left_out.take(row["valve"], InputError(message, file=path, line=row["line"]))
    return True


def _within_supply(
    path: Path,
    rows: list[dict],
    supply: float | None,
    units: dict[str, str],
    left_out: LeftOut,
) -> list[dict]:
    """The rows but for those whose drop lies far above the supply pressure [Pa]."""
    if supply is None:
        return rows
    unit, retained = _drop_unit(units), []
    for row in rows:
        if abs(row["pressure_drop"]) > _SUPPLY_MARGIN * supply:
            shown, limit = (
                f"{from_si(value, unit, VOCABULARY['pressure_drop']):g} {unit}"
                for value in (abs(row["pressure_drop"]), supply)
            )
            error = UnitError(
                f"a drop of {shown} is {abs(row['pressure_drop']) / supply:.3g} times the supply "
                f"pressure of {limit}",
                file=path,
                line=row["line"],
                hint=f"check the unit in the header: is it really {unit}?",
            )
            left_out.take(row["valve"], error)
        else:
            retained.append(row)
    return retained


def _drop_unit(units: Mapping[str, str]) -> str:
    """The unit in which a file has its drops."""
    display = VOCABULARY["pressure_drop"].display
    return units.get("pressure_drop") or units.get("upstream_pressure", display)


def _data(
    path: Path, rows: list[dict], supply: float | None, units: dict[str, str]
) -> FlowmeterData:
    warnings, unit = [], _drop_unit(units)
    if supply is not None:
        maximum = max(row["pressure_drop"] for row in rows)
        if maximum < 0.005 * supply:
            warnings.append(
                f"{path}: the largest drop is "
                f"{from_si(maximum, unit, VOCABULARY['pressure_drop']):g} {unit}, under 0.5 "
                "% of the supply pressure: "
                f"is it really {unit}?"
            )
    arrays: dict[str, Any] = {
        name: np.array([row[name] for row in rows])
        for name in ("valve", "direction", "method", "trial", "file", "line")
    }
    numbers: dict[str, Any] = {
        name: np.array([row[name] for row in rows], float)
        for name in ("command", "pressure_drop", "flow", "temperature")
    }
    return FlowmeterData(warnings=tuple(warnings), units=units, **arrays, **numbers)


def merge_flowmeter(parts: Sequence[FlowmeterData]) -> FlowmeterData:
    """The readings of several files one after the other; each keeps its file and line."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS
    }
    return FlowmeterData(
        warnings=tuple(text for part in parts for text in part.warnings),
        losses=tuple(text for part in parts for text in part.losses),
        units=parts[0].units,
        **arrays,
    )
