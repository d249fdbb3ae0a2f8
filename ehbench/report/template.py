"""Texts and tables of a section, from its file in ``templates``.

A text is a jinja template; white space in it is a single space. A table is a TOML table with
``columns`` and perhaps ``note``, ``key``, ``title`` (`Grid`). A column is a list of head, format
and value; head and value see the fields of the call, the value also ``r``, the row. A fourth entry
says when the column is there; of a list it stands once for each ``each``. A string names a list of
columns of the same file. Formats: ``""`` text, ``code``, ``name``, ``chip``, ``digits`` (a number
as text), ``number:3``, ``percent:3`` (of a share), or a quantity and its digits, ``v:3``, whose
unit joins the head. A text where a number would stand is taken as digits.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

from ehbench.config.rig import Rig
from ehbench.report import captions, words
from ehbench.report.blocks import Cell, Grid
from ehbench.report.content import chip, num
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.terms import Z95

if TYPE_CHECKING:
    import jinja2.environment


def _ring(rig: Rig, ring: Any, key: str) -> Cell:
    """A number of a decay with its 95 % interval; why there is none, as a hint."""
    std = ring.get(f"{key}_std")
    text = captions.plus(rig, key, ring.get(key), None if std is None else Z95 * std)
    return Cell(text, "number", hint=ring.get("reason", ""))


# what templates may use; the second kind takes the rig first
_FILTERS: dict[str, Any] = {
    "number": words.number,
    "count": words.count,
    "words": words.words,
    "interval": lambda ends: words.interval(*(ends or (None, None))),
    "pretty": words.pretty,
    "estimate": lambda value, ends: words.estimate(value, *ends),
    "title": words.title_of,
    "percent": captions.percent,
    "percents": lambda share, sign=1: 100.0 * sign * share,
    "span": captions.span,
    "capital": captions.capital,
    "load": captions.load_name,
    "code": lambda text, hint="": Cell(text, "code", hint=hint),
    "hint": lambda text, hint: Cell(text, "number", hint=hint),
    "chip": chip,
    "text": Cell,
    "digits": num,
    "name": lambda text: Cell(text, "name"),
    "times": lambda value, factor: None if value is None else factor * value,
    "meaning": lambda name: words.row_of(name).meaning,
}
_RIG_FILTERS: dict[str, Any] = {
    "measure": lambda rig, value, name, digits=3: captions.measure(rig, name, value, digits),
    "in_unit": lambda rig, value, name, digits=4: words.number(
        None if value is None else float(words.shown(rig, name, value)), digits
    ),
    "spanned": lambda rig, values, name, digits=3: captions.span(
        [float(words.shown(rig, name, value)) for value in values], digits
    ),
    "unit": lambda rig, name: words.pretty(words.unit_of(rig, name)),
    "axis": lambda rig, name, text="": words.axis(rig, name, text),
    "fitted": lambda rig, item, name: captions.as_fitted(rig, name, item),
    "ends": lambda rig, ends, name: captions.range_of(rig, name, ends),
    "error": lambda rig, row, which, key: captions.error_of(rig, row, which, key),
    "ranged": captions.ranged_in,
    "ring": _ring,
    "plus": lambda rig, value, name: captions.plus(rig, name, value, None),
}


class _Column(NamedTuple):
    head: str
    kind: str
    digits: str
    value: str
    fields: Mapping[str, Any]


@dataclass(frozen=True)
class Template:
    """The texts and tables of ``templates/<part>.toml``, in the units of a rig."""

    part: str
    rig: Rig | None = None

    def text(self, name: str, /, **fields: Any) -> str:
        """A text, filled."""
        return self._filled(_entries(self.part)[name], fields)

    def table(self, name: str, rows: Iterable[Any], /, **fields: Any) -> Grid:
        """A table, a row for each of ``rows``."""
        table = _entries(self.part)[name]
        columns = list(self._columns(table["columns"], fields))
        cells = [
            [
                self._cell(column, self._value(column.value, column.fields, r=row))
                for column in columns
            ]
            for row in rows
        ]
        note, key, title = (
            self._filled(table.get(k, ""), fields) for k in ("note", "key", "title")
        )
        return Grid([column.head for column in columns], cells, note, key, title)

    def _columns(self, listed: Iterable[Any], fields: Mapping[str, Any]) -> Iterator[_Column]:
        for column in listed:
            if isinstance(column, str):
                yield from self._columns(_entries(self.part)[column], fields)
                continue
            text, kind, value, *when = column
            there = self._value(when[0], fields) if when else True
            for each in there if isinstance(there, list | tuple | dict) else [None] * bool(there):
                seen = {**fields, "each": each}
                name, _, digits = self._filled(kind, seen).partition(":")
                head = self._filled(text, seen)
                if self.rig is not None and name in VOCABULARY:
                    head = words.axis(self.rig, name, head)
                yield _Column(head, name, digits, value, seen)

    def _cell(self, column: _Column, value: Any) -> Cell | str:
        digits = int(column.digits or 4)
        if isinstance(value, Cell):
            return value
        if column.kind in ("", "code", "name"):
            return Cell(str(value), column.kind) if column.kind else str(value)
        if column.kind == "chip":
            return chip(value)
        if column.kind == "digits" or isinstance(value, str):
            return num(words.DASH if value is None else str(value))
        if column.kind == "percent" and value is not None:
            value = 100.0 * value
        elif column.kind in VOCABULARY and value is not None and self.rig is not None:
            value = float(words.shown(self.rig, column.kind, value))
        return num(words.number(value, digits))

    def _filled(self, source: str, fields: Mapping[str, Any]) -> str:
        text = source
        if "{" in source:
            source = _entries(self.part).get("macros", "") + source
            text = _compiled(source).render(rig=self.rig, **fields)
        return re.sub(r"[ \n]+", " ", text).strip()

    def _value(self, source: str, fields: Mapping[str, Any], **more: Any) -> Any:
        return _expression(source)(rig=self.rig, **{**fields, **more})


@cache
def _entries(part: str) -> Mapping[str, Any]:
    text = resources.files("ehbench.report").joinpath("templates", f"{part}.toml")
    return tomllib.loads(text.read_text(encoding="utf-8"))


@cache
def _environment() -> jinja2.Environment:
    from jinja2 import Environment, StrictUndefined, pass_context

    environment = Environment(undefined=StrictUndefined)
    environment.filters |= _FILTERS
    for name, function in _RIG_FILTERS.items():
        environment.filters[name] = pass_context(
            lambda context, *values, _f=function: _f(context["rig"], *values)
        )
    return environment


@cache
def _compiled(source: str) -> jinja2.Template:
    return _environment().from_string(source)


@cache
def _expression(source: str) -> jinja2.environment.TemplateExpression:
    return _environment().compile_expression(source, undefined_to_none=False)
