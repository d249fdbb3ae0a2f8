"""Which column of a foreign file is which channel, and how its numbers become SI.

A map stands in a recipe under ``[columns]`` or in a file of its own that many recipes name."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, field_validator, model_validator

from ehbench.config.recipe.toml import as_table, lines_of, read_toml, validated
from ehbench.vocabulary import VOCABULARY, Quantity, message, quantity, to_si
from ehbench.vocabulary.errors import EhbenchError, InputError, UnitError
from ehbench.vocabulary.fields import FileModel, Q, Value
from ehbench.vocabulary.quantities import meant
from ehbench.vocabulary.units import factor, product, split_number, zero_of

LEAVE_OUT = "leave out"
READING_WORDS = ("valve", "direction", "trial", "method", "note")  # of flowmeter readings
ENDING = ".map.toml"
_SEPARATORS = {"pipe": "|", "tab": "\t", "space": " "}


class MappedColumn(FileModel):
    """One column of a foreign file as a channel: ``(value − neutral)·scale·sign + offset``, or the
    straight line through two points, ``from`` and ``to``. ``command`` and ``pressure_drop`` are
    those at which all flows of a flowmeter's column were read.

    As a text, ``"boom.p_head [bar]"``, it is the channel and the unit of the file's numbers."""

    channel: str
    unit: str | None = None
    scale: float | str = 1.0
    offset: float | str = 0.0
    neutral: float | str = 0.0
    sign: Literal[1, -1] = 1
    from_: tuple[str, str] | None = Field(default=None, alias="from")
    to: tuple[str, str] | None = None
    filter: Annotated[Value, Q("frequency")] | None = None
    late: Annotated[Value, Q("start")] | None = None
    bad_samples: Literal["refuse", "leave out"] | None = None
    command: Annotated[Value, Q("command")] | None = None
    pressure_drop: Annotated[Value, Q("pressure_drop")] | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        word = self.channel.rpartition(".")[2]
        if word not in VOCABULARY and word not in READING_WORDS:
            near = meant(self.channel, READING_WORDS)
            raise ValueError(message("config.unknown_channel", channel=self.channel, near=near))
        if word != "flow" and (self.command is not None or self.pressure_drop is not None):
            raise ValueError(message("config.read_at", channel=self.channel))
        if (self.from_ is None) != (self.to is None):
            raise ValueError(message("config.from_and_to"))
        others = (self.scale, self.offset, self.neutral, self.sign) != (1.0, 0.0, 0.0, 1)
        if self.from_ is not None and others:
            raise ValueError(message("config.from_and_to_alone"))
        if word in VOCABULARY and (self.unit is not None or self.from_ is not None):
            try:
                self.line("")
            except EhbenchError as error:
                raise ValueError(str(error)) from None
        return self

    def line(self, file_unit: str) -> tuple[float, float]:
        """(gain, zero) with SI = gain·reading + zero; ``file_unit`` is the unit that the file says.

        Raises:
            UnitError: no unit, or one that does not become the channel's."""
        row = quantity(self.channel)
        if self.from_ is not None and self.to is not None:
            return _through(self.from_, self.to, self.unit or file_unit, row)
        unit = self.unit if self.unit is not None else file_unit
        scale, by = _split(self.scale)
        if by:
            slope, zero = product(by, unit, row.unit), 0.0
        elif not unit.strip() and row.unit != "dimensionless":
            raise UnitError(message("config.no_unit", name=row.name, display=row.display))
        else:
            try:
                zero, item = (float(to_si(number, unit, row)) for number in (0.0, 1.0))
            except UnitError as error:
                hint = message("config.at_the_valve") if row.name == "command" else error.hint
                raise UnitError(error.message, hint=hint) from None
            slope = item - zero
        gain = self.sign * scale * slope
        neutral, of = _split(self.neutral)
        neutral *= factor(of, unit) if of and of != unit else 1.0
        offset, of = _split(self.offset)
        if of:
            offset = float(to_si(offset, of, row)) - zero_of(f"0 {of}", row)
        elif by and offset:
            raise UnitError(message("config.offset_unit", number=offset, display=row.display))
        else:
            offset *= slope
        return gain, zero - gain * neutral + offset

    def overrules(self, file_unit: str) -> bool:
        """Whether its unit gives other numbers than that of the file, which would do as well."""
        if self.unit is None or not file_unit:
            return False
        try:
            other = self.model_copy(update={"unit": file_unit}).line("")
            return not all(map(partial(math.isclose, abs_tol=1e-12), other, self.line("")))
        except EhbenchError:
            return False


def _split(given: float | str) -> tuple[float, str]:
    return split_number(given) if isinstance(given, str) else (float(given), "")


def _through(
    first: tuple[str, str], second: tuple[str, str], unit: str, row: Quantity
) -> tuple[float, float]:
    """(gain, zero) of the line through two pairs of readings and what they mean."""
    readings = []
    for text in first:
        number, of = split_number(text)
        unit = unit or of
        readings.append(number * (factor(of, unit) if of and of != unit else 1.0))
    means = []
    for text in second:
        number, of = split_number(text)
        if not of and row.unit != "dimensionless":
            raise UnitError(message("config.to_unit", text=text, display=row.display))
        means.append(float(to_si(number, of, row)))
    if readings[0] == readings[1]:
        raise UnitError(message("config.one_point", points=list(first)))
    gain = (means[1] - means[0]) / (readings[1] - readings[0])
    return gain, means[0] - gain * readings[0]


def _column(raw: Any) -> Any:
    if not isinstance(raw, str):
        return raw
    channel, bracket, unit = raw.partition("[")
    results = {"channel": channel.strip()}
    return results | ({"unit": unit.strip().rstrip("]").strip()} if bracket else {})


class Columns(FileModel):
    """How a foreign file is read. What is not said is looked for in the file.

    A text in place of the table names a file with these keys at its top level; ``file`` beside
    other keys takes those of that file first."""

    file: str | None = None
    table: str | None = None
    separator: Literal[",", ";", "pipe", "tab", "space"] | None = None
    decimal: Literal[".", ","] | None = None
    skip: int | None = Field(default=None, ge=0, le=10**6)
    unit_row: bool | None = None
    encoding: str | None = None
    day_first: bool | None = None
    rate: Annotated[Value, Q("rate")] | None = None
    bad_samples: Literal["refuse", "leave out"] = "refuse"
    names: dict[str, Annotated[MappedColumn, BeforeValidator(_column)]] = {}

    @field_validator("names")
    @classmethod
    def _each_once(cls, names: dict[str, MappedColumn]) -> dict[str, MappedColumn]:
        places = [
            (column.channel, *(at and at.value for at in (column.command, column.pressure_drop)))
            for column in names.values()
            if column.channel != "t"
        ]
        if twice := [place for place in places if places.count(place) > 1]:
            raise ValueError(message("config.two_columns", channel=twice[0][0]))
        return names


AnyColumns = Annotated[Columns | None, as_table("file")]


@dataclass(frozen=True)
class ColumnMap:
    """A map with all its keys, and where they stand: (file, table in it), the outermost first.

    ``travels`` [SI] is how far positions can move, by channel, where the rig is known."""

    columns: Columns
    places: tuple[tuple[Path, tuple[str | int, ...]], ...] = ()
    travels: Mapping[str, float] = field(default_factory=dict)

    def at(self, *location: str) -> dict[str, Any]:
        """``file`` and ``line`` of a key, as the errors take them."""
        for path, table in self.places:
            lines = lines_of(path.read_text(encoding="utf-8-sig", errors="surrogateescape"))
            if (line := lines.get((*table, *location))) is not None:
                return {"file": path, "line": line}
        return {"file": self.places[0][0]} if self.places else {}

    @property
    def files(self) -> tuple[Path, ...]:
        """The map files that it took keys from."""
        return tuple(path for path, table in self.places if not table)

    @property
    def marks(self) -> tuple[str | None, str | None]:
        """(separator, decimal sign) as characters."""
        separator = self.columns.separator
        return _SEPARATORS.get(separator or "", separator), self.columns.decimal


def load_columns(path: str | Path) -> ColumnMap:
    """The map of a file, with what it takes from others.

    Raises:
        InputError: with file, line, key, value and the nearest valid key."""
    path = Path(path)
    table, text = read_toml(path)
    return whole_map(validated(Columns, table, text, path), path)


def whole_map(
    given: Columns, path: Path, table: tuple[str | int, ...] = (), above: tuple[Path, ...] = ()
) -> ColumnMap:
    """A map with what it takes from the file that it names.

    Args:
        path: the file it stands in, and ``table`` where in it.
        above: the files that took it, which it must not take in turn.

    Raises:
        InputError: the file it names is wrong, or names this one."""
    place = (path, table)
    if given.file is None:
        return ColumnMap(given, (place,))
    base, above = (path.parent / given.file).resolve(), (*above, path.resolve())
    if base in above:
        raise InputError(message("config.map_circle", name=given.file), file=path)
    keys, text = read_toml(base)
    first = whole_map(validated(Columns, keys, text, base), base, (), above)
    keys = {key: getattr(given, key) for key in given.model_fields_set - {"file"}}
    keys["names"] = {**first.columns.names, **given.names}
    merged = first.columns.model_copy(update=keys)
    return ColumnMap(merged, (place, *first.places))
