"""Typed fields of files: a number with unit, source, bounds and standard error.

    mass: Annotated[Value, Q("mass")]
    com: Annotated[Vector, Q("com", "x y z")]

reads ``"12 kg"`` or ``{ value = "12 kg", source = "datasheet", std = "0.1 kg" }`` by the vocabulary
row of its name, and a vector as a list of such; and writes it back as it was read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar, Union

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationInfo,
)
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from ehbench.vocabulary import units
from ehbench.vocabulary.errors import InputError, UnitError
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY, Quantity
from ehbench.vocabulary.text import shortened

Model = TypeVar("Model", bound=BaseModel)
SURENESS = "printed restored companion assumed datasheet measured weighed identified".split()


class FileModel(BaseModel):
    """Base of all file-backed models: frozen, no unknown keys."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", arbitrary_types_allowed=True, populate_by_name=True
    )


FROM_FILE = {"from_file": True}  # the context in which a file's tables are read


def _unknown_in_files(raw: Any, info: ValidationInfo) -> Any:
    if info.context == FROM_FILE:
        raise PydanticKnownError("extra_forbidden")
    return raw


Internal = BeforeValidator(_unknown_in_files)  # a field that the program sets, and no file


@dataclass(frozen=True)
class Value:
    """A number in SI with where it came from.

    ``sure`` is one of ``SURENESS``; ``source`` the words of the file; ``lower``, ``upper`` bounds
    and ``std`` the standard error, all SI; ``text`` what the file said, kept so that a rig can be
    written back as it was read; ``unit`` that in which people see it, empty where any will do."""

    value: float
    sure: str = "assumed"
    source: str = ""
    lower: float | None = None
    upper: float | None = None
    std: float | None = None
    text: Any = None
    unit: str = ""

    def like(self, word: str, number: float) -> str:
        """A number [SI] of a quantity as text in this value's unit, else the vocabulary's."""
        row = VOCABULARY[word]
        unit = self.unit or row.display
        return f"{float(units.from_si(number, unit, row)):.6g} {unit}"

    def __float__(self) -> float:
        return float(self.value)


@dataclass(frozen=True)
class Vector:
    """Numbers of one quantity along ``axes``, each with where it came from."""

    axes: tuple[str, ...]
    parts: tuple[Value, ...]

    @property
    def value(self) -> tuple[float, ...]:
        """The numbers [SI]."""
        return tuple(float(part) for part in self.parts)

    def with_part(self, axis: str, part: Value) -> Vector:
        """It with another number along an axis."""
        pairs = zip(self.axes, self.parts, strict=True)
        return replace(self, parts=tuple(part if name == axis else old for name, old in pairs))


def scalars(model: BaseModel) -> Iterator[tuple[str, Value]]:
    """The numbers of a table by their keys; those of a vector by key and axis, ``com_x``."""
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, Value):
            yield name, value
        elif isinstance(value, Vector):
            yield from zip((f"{name}_{axis}" for axis in value.axes), value.parts, strict=True)


def with_scalars(model: Model, new: Mapping[str, Value]) -> Model:
    """A table with others of its `scalars`; names that it does not have are passed over."""
    update: dict[str, Any] = {}
    for key, value in new.items():
        name, _, axis = key.rpartition("_")
        # pyrefly: ignore[missing-attribute]
        if key in type(model).model_fields:
            update[key] = value
        elif isinstance(vector := update.get(name, getattr(model, name, None)), Vector):
            update[name] = vector.with_part(axis, value)
    return model.model_copy(update=update) if update else model


def one_of(models: Sequence[type[BaseModel]], key: str) -> Any:
    """The type of a table that is of one of several kinds, told apart by what its ``key`` says."""
    if len(models) == 1:
        return models[0]
    # pyrefly: ignore[invalid-annotation]
    return Annotated[Union[tuple(models)], Field(discriminator=key)]  # noqa: UP007


def read_value(raw: Any, row: Quantity) -> Value:
    """A TOML value as a ``Value``: ``"1000 psi"``, or ``{ value, source, sure, lower, upper, std,
    unit }``.

    Raises:
        UnitError: no unit, wrong unit, implausible value, bounds that do not hold it, a negative
            standard error.
        InputError: a key that does not belong there.
    """
    if isinstance(raw, Value):
        return raw
    table = dict(raw) if isinstance(raw, Mapping) else {"value": raw}
    unknown = set(table) - {"value", "source", "sure", "lower", "upper", "std", "unit", "note"}
    if unknown:
        key = min(map(str, unknown))
        raise InputError(message("vocabulary.unknown_value_key", name=row.name, given=key))
    if "value" not in table:
        raise InputError(message("vocabulary.no_value", name=row.name))

    value = _scalar(table["value"], row, "the value")
    limits = _limits(table, row)
    if not limits.get("lower", -math.inf) <= value <= limits.get("upper", math.inf):
        bounds = " and ".join(f"{key} = {table[key]}" for key in ("lower", "upper") if key in table)
        fields = {"name": row.name, "value": table["value"], "bounds": bounds}
        raise UnitError(message("vocabulary.outside_bounds", **fields))
    source = str(table.get("source", ""))
    first = source.replace(":", " ").replace(",", " ").split(" ")[0]
    sure = table.get("sure", first if first in SURENESS else "assumed")
    if sure not in SURENESS:
        given, known = shortened(sure, 40), ", ".join(SURENESS)
        fields = {"name": row.name, "given": given, "known": known}
        raise InputError(message("vocabulary.unknown_sureness", **fields))
    return Value(value, sure, source, text=raw, unit=_unit(table, row), **limits)


def read_vector(raw: Any, row: Quantity, axes: Sequence[str]) -> Vector:
    """A list of TOML values as a ``Vector``, or a table whose ``value`` is such a list.

    Raises:
        UnitError, InputError: as `read_value` of each, or another count of them.
    """
    if isinstance(raw, Vector):
        return raw
    table = dict(raw) if isinstance(raw, Mapping) else {}
    items = table.get("value", raw)
    if not isinstance(items, list | tuple) or len(items) != len(axes):
        given = shortened(items, 60)
        raise InputError(
            message("vocabulary.takes_list", name=row.name, count=len(axes), given=given)
        )
    each = [{**table, "value": item} if table else item for item in items]
    return Vector(tuple(axes), tuple(read_value(item, row) for item in each))


def _unit(table: Mapping[str, Any], row: Quantity) -> str:
    """The unit in which people see a value: what ``unit`` says, else that of its own text, if it is
    another than SI."""
    unit = str(table.get("unit", units.unit_of(table["value"])))
    if unit:
        units.to_si(0.0, unit, row)
    return "" if unit == row.unit else unit


def _scalar(item: Any, row: Quantity, what: str, check: bool = True) -> float:
    """A number of a file in SI; ``check`` holds it against the row's plausible range."""
    if isinstance(item, bool) or not isinstance(item, (str, int, float)):
        fields = {"what": what, "name": row.name, "display": row.display}
        raise UnitError(message("vocabulary.not_a_number", given=shortened(item, 60), **fields))
    shown = shortened(item, 40) if not isinstance(item, str) else item[:40]
    if isinstance(item, str):
        bare = Quantity(row.name, row.symbol, row.unit, row.display, row.meaning)
        result = units.parse(item, row if check else bare)
    elif row.unit != "dimensionless":
        fields = {"name": row.name, "shown": shown, "display": row.display}
        raise UnitError(message("vocabulary.number_without_unit", **fields))
    else:
        try:
            result = float(item)
        except OverflowError:
            result = math.inf
        if check:
            units.plausible(result, row, shown)
    if not math.isfinite(result):
        raise UnitError(message("vocabulary.value_not_finite", name=row.name, shown=shown))
    return result


def _limits(table: Mapping[str, Any], row: Quantity) -> dict[str, float]:
    """The bounds and the standard error of a value, as far as they are given."""
    keys = [key for key in ("lower", "upper", "std") if key in table]
    results = {key: _scalar(table[key], row, f"the {key}", check=False) for key in keys}
    if "std" in table:
        if isinstance(table["std"], str):
            results["std"] -= units.zero_of(table["std"], row)
        if results["std"] < 0.0:
            raise UnitError(message("vocabulary.negative_error", name=row.name, given=table["std"]))
    return results


def write_value(value: Value, row: Quantity) -> Any:
    """A ``Value`` for TOML: its text if read from a file, else SI with all digits."""
    if value.text is not None:
        return dict(value.text) if isinstance(value.text, Mapping) else value.text
    unit = "" if row.unit == "dimensionless" else f" {row.unit}"

    def show(number: float) -> str:
        return f"{float(number)!r}{unit}"

    table: dict[str, Any] = {"value": show(float(value)), "sure": value.sure}
    if value.source:
        table["source"] = value.source
    for key in ("lower", "upper", "std"):
        number = getattr(value, key)
        if number is not None and math.isfinite(number):
            table[key] = show(number)
    if value.unit:
        table["unit"] = value.unit
    return table


def write_vector(vector: Vector, row: Quantity) -> Any:
    """A ``Vector`` for TOML: a list, in one table where all its numbers say the same but for their
    values.
    """
    items = [write_value(part, row) for part in vector.parts]
    if not all(isinstance(item, dict) for item in items):
        return items
    about = [{key: word for key, word in item.items() if key != "value"} for item in items]
    if about.count(about[0]) < len(about):
        return items
    return {**items[0], "value": [item["value"] for item in items]}


@dataclass(frozen=True)
class Q:
    """A ``Value`` of one quantity, or a ``Vector`` of it along ``axes``; ``word`` may stand in its
    place.
    """

    name: str
    axes: str = ""
    word: str = ""

    @property
    def row(self) -> Quantity:
        """The vocabulary's row: symbol, unit, range, meaning."""
        return VOCABULARY[self.name]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_before_validator_function(
            self._read,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(self._write),
        )

    def _read(self, raw: Any) -> Value | Vector | str:
        if self.word and raw == self.word:
            return self.word
        try:
            if self.axes:
                return read_vector(raw, self.row, self.axes.split())
            return read_value(raw, self.row)
        except InputError as error:
            raise ValueError(f'{error}; or "{self.word}"' if self.word else str(error)) from None

    def _write(self, value: Value | Vector | str) -> Any:
        if isinstance(value, Vector):
            return write_vector(value, self.row)
        return value if isinstance(value, str) else write_value(value, self.row)
