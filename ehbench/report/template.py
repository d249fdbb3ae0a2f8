"""Texts and tables of a section, from its file in ``templates``.

A text is a jinja template; white space in it is a single space. A table is a TOML table with
``columns`` and perhaps ``note``, ``key``, ``title`` (`Grid`). A column is a list of head, format
and value; head and value see the fields of the call, the value also ``r``, the row. A fourth entry
says when the column is there; of a list it stands once for each ``each``. A string names a list of
columns of the same file. Formats: ``""`` text, ``code``, ``name``, ``chip``, ``digits`` (a number
as text), ``number:3``, ``percent:3`` (of a share), or a quantity and its digits, ``v:3``, whose
unit joins the head. A text where a number would stand is taken as digits. A value is an expression,
or a template of a text."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

from ehbench.config.rig import Rig
from ehbench.report import words
from ehbench.report.blocks import Cell, Grid
from ehbench.report.content import chip, num
from ehbench.vocabulary import VOCABULARY, Z95, plural

if TYPE_CHECKING:
    import jinja2


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


# what templates may use; the second kind takes the rig first
_FILTERS: dict[str, Any] = {
    "number": words.number,
    "count": plural,
    "words": words.words,
    "interval": lambda ends: words.interval(*(ends or (None, None))),
    "pretty": words.pretty,
    "within": lambda value, std: words.with_error(value, Z95 * std),
    "estimate": lambda value, ends: words.estimate(value, *ends),
    "title": words.title_of,
    "percent": words.percent,
    "percents": lambda share, sign=1: 100.0 * sign * share,
    "span": words.span,
    "capital": words.capital,
    "load": words.load_name,
    "code": lambda text, hint="": Cell(text, "code", hint=hint),
    "hint": lambda text, hint: Cell(text, "number", hint=hint),
    "chip": chip,
    "text": Cell,
    "digits": num,
    "name": lambda text: Cell(text, "name"),
    "times": _scaled,
}
_RIG_FILTERS: dict[str, Any] = {
    "measure": lambda rig, value, name, digits=3: words.measure(rig, name, value, digits),
    "in_unit": lambda rig, value, name, digits=4: words.number(
        words.shown(rig, name, value), digits
    ),
    "spanned": lambda rig, values, name, digits=3: words.span(
        [words.shown(rig, name, value) for value in values], digits
    ),
    "unit": lambda rig, name: words.pretty(words.unit_of(rig, name)),
    "axis": words.axis,
    "fitted": lambda rig, item, name: words.as_fitted(rig, name, item),
    "ends": lambda rig, ends, name: words.range_of(rig, name, ends),
    "error": words.error_of,
    "ranged": words.ranged_in,
    # a number of a decay with its 95 % interval; why there is none, as a hint
    "ring": lambda rig, ring, key: Cell(
        words.plus(rig, key, ring.get(key), _scaled(ring.get(f"{key}_std"), Z95)),
        "number",
        hint=ring.get("reason", ""),
    ),
    "plus": lambda rig, value, name: words.plus(rig, name, value, None),
}


class _Column(NamedTuple):
    head: str
    kind: str
    digits: int
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
        cells = [[self._cell(column, row) for column in columns] for row in rows]
        texts = (self._filled(table.get(k, ""), fields) for k in ("note", "key", "title"))
        return Grid([column.head for column in columns], cells, *texts)

    def _columns(self, listed: Iterable[Any], fields: Mapping[str, Any]) -> Iterator[_Column]:
        for column in listed:
            if isinstance(column, str):
                yield from self._columns(_entries(self.part)[column], fields)
                continue
            text, kind, value, *when = column
            there = _compiled(when[0], False)(rig=self.rig, **fields) if when else True
            for each in there if isinstance(there, list | tuple | dict) else [None] * bool(there):
                seen = {**fields, "each": each}
                name, _, digits = self._filled(kind, seen).partition(":")
                head = self._filled(text, seen)
                if self.rig is not None and name in VOCABULARY:
                    head = words.axis(self.rig, name, head)
                yield _Column(head, name, int(digits or 4), value, seen)

    def _cell(self, column: _Column, row: Any) -> Cell | str:
        fields, kind = {**column.fields, "r": row}, column.kind
        if "{{" in column.value:
            value = self._filled(column.value, fields)
        else:
            value = _compiled(column.value, False)(rig=self.rig, **fields)
        if isinstance(value, Cell):
            return value
        if kind in ("", "code", "name"):
            return Cell(str(value), kind) if kind else str(value)
        if kind == "chip":
            return chip(value)
        if kind == "digits" or isinstance(value, str):
            return num(words.DASH if value is None else str(value))
        if kind == "percent":
            value = _scaled(value, 100.0)
        elif kind in VOCABULARY and self.rig is not None:
            value = words.shown(self.rig, kind, value)
        return num(words.number(value, column.digits))

    def _filled(self, source: str, fields: Mapping[str, Any]) -> str:
        text = source
        if "{" in source:
            source = _entries(self.part).get("macros", "") + source
            text = _compiled(source, True)(rig=self.rig, **fields)
        return re.sub(r"[ \n]+", " ", text).strip()


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
def _compiled(source: str, is_text: bool) -> Callable[..., Any]:
    """A template, or an expression, as a function of its fields."""
    if is_text:
        return _environment().from_string(source).render
    return _environment().compile_expression(source, undefined_to_none=False)
