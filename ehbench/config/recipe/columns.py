"""Which column of a foreign file is which channel, and how its numbers become SI.

A map stands in a recipe under ``[columns]`` or in a file of its own that many recipes name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from ehbench.config.recipe.toml import lines_of, read_toml, validated
from ehbench.vocabulary.errors import EhbenchError, InputError, UnitError
from ehbench.vocabulary.fields import FileModel, Q, Value
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY, Quantity, meant, quantity
from ehbench.vocabulary.units import factor, product, split_number, to_si, zero_of

LEAVE_OUT = "leave out"
READING_WORDS = ("valve", "direction", "trial", "method", "note")  # of flowmeter readings
ENDING = ".map.toml"
_MARKS = {"tab": "\t", "space": " "}


class MappedColumn(FileModel):
    """One column of a foreign file as a channel: ``(value − neutral)·scale·sign + offset``, or the
    straight line through two points, ``from`` and ``to``.

    As a text, ``"boom.p_head [bar]"``, it is the channel and the unit of the file's numbers."""

    channel: str = Field(description="what it is: `boom.p_head`, `boom.hect.command`, or `t`")
    unit: str | None = Field(
        default=None, description="of the file's numbers, such as `bar` or `mA`; none: as it says"
    )
    scale: float | str = Field(
        default=1.0, description='a factor: 10, or with units, `"0.625 V/mA"`'
    )
    offset: float | str = Field(
        default=0.0, description='added at last, with the unit of the channel: `"-0.4 bar"`'
    )
    neutral: float | str = Field(
        default=0.0,
        description='the reading that means zero: `"12 mA"`, or in the unit of the file',
    )
    sign: Literal[1, -1] = Field(default=1, description="-1 turns it round")
    from_: tuple[str, str] | None = Field(
        default=None, alias="from", description='two readings, `["4 mA", "20 mA"]`'
    )
    to: tuple[str, str] | None = Field(
        default=None, description='what they mean on the rig, `["-10 V", "10 V"]`'
    )
    filter: Annotated[Value, Q("frequency")] | None = Field(
        default=None, description="low-pass, run forwards and backwards: it makes no lag"
    )
    late: Annotated[Value, Q("start")] | None = Field(
        default=None,
        description="by how much later than its time a value was written: it is put back by that",
    )
    bad_samples: Literal["refuse", "leave out"] | None = Field(
        default=None, description="as for the whole file, for this column alone"
    )

    @model_validator(mode="after")
    def _whole(self) -> MappedColumn:
        word = self.channel.rpartition(".")[2]
        if word not in VOCABULARY and word not in READING_WORDS:
            near = meant(self.channel, READING_WORDS)
            raise ValueError(message("config.unknown_channel", channel=self.channel, near=near))
        if (self.from_ is None) != (self.to is None):
            raise ValueError(message("config.from_and_to"))
        others = (self.scale, self.offset, self.neutral, self.sign) != (1.0, 0.0, 0.0, 1)
        if self.from_ is not None and others:
            raise ValueError(message("config.from_and_to_alone"))
        if word in VOCABULARY and (self.unit is not None or self.from_ is not None):
            try:
                self.line("")
            except EhbenchError as error:
                raise ValueError(
                    f"{error.message}{error.hint and f' ({error.hint})' or ''}"
                ) from None
        return self

    def line(self, file_unit: str) -> tuple[float, float]:
        """(gain, zero) with SI = gain·reading + zero; ``file_unit`` is the unit that the file says.

        Raises:
            UnitError: no unit, or one that does not become the channel's.
        """
        row = quantity(self.channel)
        if self.from_ is not None and self.to is not None:
            return _through(self.from_, self.to, self.unit or file_unit, row)
        unit = self.unit if self.unit is not None else file_unit
        scale, by = _split(self.scale)
        if by:
            slope, zero = product(by, unit, row.unit), 0.0
        else:
            slope, zero = _slope(unit, row)
        gain = self.sign * scale * slope
        neutral, of = _split(self.neutral)
        neutral *= factor(of, unit) if of and of != unit else 1.0
        return gain, zero - gain * neutral + _offset(self.offset, by, slope, row)


def _split(given: float | str) -> tuple[float, str]:
    return split_number(given) if isinstance(given, str) else (float(given), "")


def _slope(unit: str, row: Quantity) -> tuple[float, float]:
    """(factor, zero) of a unit into SI of a row."""
    if not unit.strip() and row.unit != "dimensionless":
        raise UnitError(message("config.no_unit", name=row.name, display=row.display))
    try:
        zero, item = (float(to_si(number, unit, row)) for number in (0.0, 1.0))
    except UnitError as error:
        hint = message("config.at_the_valve") if row.name == "command" else error.hint
        raise UnitError(error.message, hint=hint) from None
    return item - zero, zero


def _offset(given: float | str, by: str, slope: float, row: Quantity) -> float:
    number, unit = _split(given)
    if number == 0.0:
        return 0.0
    if unit:
        return float(to_si(number, unit, row)) - zero_of(f"0 {unit}", row)
    if by:
        raise UnitError(message("config.offset_unit", number=number, display=row.display))
    return slope * number


def _through(
    first: tuple[str, str], second: tuple[str, str], unit: str, row: Quantity
) -> tuple[float, float]:
    """(gain, zero) of the line through two pairs of readings and what they mean."""
    readings = []
    for text in first:
        number, own = split_number(text)
        unit = unit or own
        readings.append(number * (factor(own, unit) if own and own != unit else 1.0))
    means = []
    for text in second:
        number, own = split_number(text)
        if not own and row.unit != "dimensionless":
            raise UnitError(message("config.to_unit", text=text, display=row.display))
        means.append(float(to_si(number, own, row)))
    if readings[0] == readings[1]:
        raise UnitError(message("config.one_point", points=list(first)))
    gain = (means[1] - means[0]) / (readings[1] - readings[0])
    return gain, means[0] - gain * readings[0]


def _column(raw: Any) -> Any:
    """``boom.p_head [bar]`` as a table."""
    if not isinstance(raw, str):
        return raw
    channel, bracket, unit = raw.partition("[")
    results = {"channel": channel.strip()}
    return results | ({"unit": unit.strip().rstrip("]").strip()} if bracket else {})


class Columns(FileModel):
    """How a foreign file is read. What is not said is looked for in the file.

    A text in place of the table names a file with these keys at its top level; ``file`` beside
    other keys takes those of that file first."""

    file: str | None = Field(default=None, description="another map, whose keys come before these")
    table: str | None = Field(
        default=None, description="sheet, group or topic to take alone, by name"
    )
    separator: Literal[",", ";", "tab", "space"] | None = Field(
        default=None, description="of a text file; none: looked for"
    )
    decimal: Literal[".", ","] | None = Field(
        default=None, description="decimal sign of a text file; none: looked for"
    )
    skip: int | None = Field(
        default=None, ge=0, le=10**6, description="lines above the header; none: looked for"
    )
    unit_row: bool | None = Field(
        default=None, description="whether a row of units stands below it; none: looked for"
    )
    encoding: str | None = Field(
        default=None, description="of a text file, such as `cp1252`; none: looked for"
    )
    day_first: bool | None = Field(
        default=None, description="whether 05/11/2026 is in November; none: where a date says so"
    )
    rate: Annotated[Value, Q("rate")] | None = Field(
        default=None, description="samples per second, in place of a column of time"
    )
    bad_samples: Literal["refuse", "leave out"] = Field(
        default="refuse",
        description="blank cells, NaN, words, values no rig can have: `refuse`, or `leave out` and "
        "say where",
    )
    names: dict[str, Annotated[MappedColumn, BeforeValidator(_column)]] = Field(
        default={}, description="by name in the file, what it is"
    )

    @field_validator("names")
    @classmethod
    def _each_once(cls, names: dict[str, MappedColumn]) -> dict[str, MappedColumn]:
        channels = [column.channel for column in names.values() if column.channel != "t"]
        if twice := [channel for channel in channels if channels.count(channel) > 1]:
            raise ValueError(message("config.two_columns", channel=twice[0]))
        return names


def columns_of(raw: Any) -> Any:
    """A map named by its file alone, as a table."""
    return {"file": raw} if isinstance(raw, str) else raw


AnyColumns = Annotated[Columns | None, BeforeValidator(columns_of)]


@dataclass(frozen=True)
class ColumnMap:
    """A map with all its keys, and where they stand: (file, table in it), the outermost first."""

    columns: Columns
    places: tuple[tuple[Path, tuple[str | int, ...]], ...] = ()

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
        return _MARKS.get(separator or "", separator), self.columns.decimal


def load_columns(path: str | Path) -> ColumnMap:
    """The map of a file, with what it takes from others.

    Raises:
        InputError: with file, line, key, value and the nearest valid key.
    """
    path = Path(path)
    table, text = read_toml(path)
    return whole_map(validated(Columns, table, text, path), path)


def whole_map(
    own: Columns, path: Path, table: tuple[str | int, ...] = (), above: tuple[Path, ...] = ()
) -> ColumnMap:
    """A map with what it takes from the file that it names.

    Args:
        path: the file it stands in, and ``table`` where in it.
        above: the files that took it, which it must not take in turn.

    Raises:
        InputError: the file it names is wrong, or names this one.
    """
    place = (path, table)
    if own.file is None:
        return ColumnMap(own, (place,))
    behind, above = (path.parent / own.file).resolve(), (*above, path.resolve())
    if behind in above:
        raise InputError(message("config.map_circle", name=own.file), file=path)
    keys, text = read_toml(behind)
    first = whole_map(validated(Columns, keys, text, behind), behind, (), above)
    given = {key: getattr(own, key) for key in own.model_fields_set - {"names", "file"}}
    names = {**first.columns.names, **own.names}
    merged = first.columns.model_copy(update={**given, "names": names})
    return ColumnMap(merged, (place, *first.places))
