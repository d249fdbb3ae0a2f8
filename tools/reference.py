"""The key tables of docs/reference/, made from the models they are of.

``python -m tools.reference`` writes them anew, ``--check`` only says whether they are so already.
A table stands under a comment that names its model, ``<!-- Limits -->``, or another set of keys,
``<!-- gains of arc -->``. What a key is for is its field's ``description``; where it has none, the
words of the page stay, and a new key gets those of the vocabulary."""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

import ehbench
from ehbench.config.rig import Rig
from ehbench.vocabulary import settings
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Q, Value
from ehbench.vocabulary.quantities import VOCABULARY, Quantity
from ehbench.vocabulary.units import from_si

DOCS = Path(__file__).resolve().parents[1] / "docs"
HEADER = ("key", "symbol", "unit", "range", "default", "what for")
_BLOCK = re.compile(r"<!-- (\w[\w ]*) -->\n((?:\|.*\n)*)")


@dataclass(frozen=True)
class Key:
    """One row of a table, in the order of its columns. An empty ``default`` or ``words`` is taken
    from the page; a law that says no default derives it."""

    name: str
    symbol: str
    unit: str
    range: str
    default: str
    words: str


# --- what an annotation says


def parts(annotation: Any) -> list[Any]:
    """An annotation and all that it is made of."""
    return [annotation, *(result for part in get_args(annotation) for result in parts(part))]


def marks(field: FieldInfo) -> Iterator[Any]:
    """What a field's annotation carries beside its type."""
    yield from field.metadata
    for part in parts(field.annotation):
        for mark in getattr(part, "__metadata__", ()):
            yield from mark.metadata if isinstance(mark, FieldInfo) else (mark,)


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models that an annotation holds."""
    return [
        part
        for part in parts(annotation)
        if isinstance(part, type) and issubclass(part, BaseModel) and part.model_fields
    ]


def models(roots: Iterable[type[BaseModel]]) -> list[type[BaseModel]]:
    """The models of files that ``roots`` are, with those they inherit from and hold, each once."""
    results: list[type[BaseModel]] = []

    def add(model: type[BaseModel]) -> None:
        if model in results or model is BaseModel or not model.model_fields:
            return
        for base in model.__bases__:
            if issubclass(base, BaseModel):
                add(base)
        results.append(model)
        for field in model.model_fields.values():
            for inner in () if field.exclude else models_in(field.annotation):
                add(inner)

    for root in roots:
        add(root)
    return [model for model in results if own_fields(model)]


def own_fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields that a file may have and that a model does not inherit, or says anew."""
    inherited = {name for base in model.__bases__ for name in getattr(base, "model_fields", {})}
    message = inherited - set(model.__annotations__)
    return {
        name: field
        for name, field in model.model_fields.items()
        if not field.exclude and name not in message
    }


# --- the cells of a table


def _unit(row: Quantity) -> str:
    return "–" if row.display == "dimensionless" else row.display


def _number(value: float, row: Quantity) -> str:
    return f"{from_si(value, row.display, row):.4g}".replace("inf", "∞")


def _span(row: Quantity) -> str:
    """The range of a quantity outside of which a number is surely a slip."""
    return f"{_number(row.lower, row)} … {_number(row.upper, row)}"


def _bounds(field: FieldInfo) -> str:
    """The range of a plain number."""
    ends = {
        end: getattr(mark, end)
        for mark in marks(field)
        for end in ("gt", "ge", "lt", "le")
        if getattr(mark, end, None) is not None
    }
    words = {"gt": "above", "ge": "from", "lt": "below", "le": "at most"}
    if {"ge", "le"} <= set(ends):
        return f"{ends['ge']:g} … {ends['le']:g}"
    return ", ".join(f"{words[end]} {ends[end]:g}" for end in words if end in ends)


def _kind(annotation: Any) -> str:
    """What an annotation takes, where that is no quantity with a unit."""
    kinds = [part for part in get_args(annotation) if part is not type(None)]
    origin = get_origin(annotation)
    if models_in(annotation):
        within = {dict: "tables by name", tuple: "list of tables"}
        origins = map(get_origin, parts(annotation))
        return next((within[o] for o in origins if o in within), "table")
    if origin is Literal:
        return "choice"
    if origin is dict:
        return {str: "texts by name", float: "numbers by name"}.get(kinds[1], "table")
    if origin is tuple:
        inner = _kind(kinds[0])
        return "list of pairs" if inner.startswith("list") else f"list of {inner}s"
    if origin is not None and hasattr(annotation, "__metadata__"):
        return _kind(kinds[0])
    if kinds:
        return " or ".join(_kind(kind) for kind in kinds)
    plain = {str: "text", bool: "true or false", int: "whole number", float: "number"}
    return plain.get(annotation, "value")


def _toml(value: Any) -> str:
    """A plain default as a file would have it."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _default(field: FieldInfo, row: Quantity | None) -> str:
    if field.is_required():
        return "needed"
    value = field.default
    if row is not None and isinstance(value, Value):
        return _number(float(value), row)
    if value is None or isinstance(value, BaseModel) or value in ("", (), {}):
        return "none"
    choice = isinstance(value, str | int) and not isinstance(value, bool)
    return f"`{value if choice else _toml(value)}`"


def key_of(name: str, field: FieldInfo) -> Key:
    """A field of a model as a row."""
    number = next((mark for mark in marks(field) if isinstance(mark, Q)), None)
    given, words = f"`{field.alias or name}`", field.description or ""
    default = _default(field, number.row if number else None)
    if number is not None:
        row = number.row
        many = any(get_origin(part) is tuple for part in parts(field.annotation))
        count = f"{len(number.axes.split())} × " if number.axes else ""
        unit = ("list of " if many else count) + _unit(row)
        return Key(given, row.symbol, unit, _span(row), default, words)
    kind = _kind(field.annotation)
    choices = next(
        (get_args(part) for part in parts(field.annotation) if get_origin(part) is Literal), ()
    )
    inside = (
        ", ".join(f"`{choice}`" for choice in choices) if not models_in(field.annotation) else ""
    )
    if choices and not inside:
        choices = ()
    return Key(given, "", "choice" if choices else kind, inside or _bounds(field), default, words)


def gain_key(name: str, row: Quantity | None, pair: bool = False) -> Key:
    """A gain or rule of a controller as a row; ``row`` is None for a switch."""
    if row is None:
        return Key(f"`{name}`", "", "true or false", "", "", "")
    words = row.meaning if row.name == name and not pair else ""
    return Key(
        f"`{name}`", row.symbol, ("2 × " if pair else "") + _unit(row), _span(row), "", words
    )


# --- what each page has to hold


def recipe_models() -> list[type[BaseModel]]:
    """The package's models of recipes, one a stage, all of which the workflow knows."""
    from ehbench import workflow  # noqa: F401
    from ehbench.config.recipe import recipe_kinds

    return [kind for kind in recipe_kinds().values() if kind.__module__.startswith("ehbench.")]


def gain_tables() -> dict[str, list[Key]]:
    """The gains of each built-in controller, the rules and the shaping."""
    from ehbench.control.functions import CHOICES, RULE_NAMES
    from ehbench.control.registry import LAWS
    from ehbench.control.trajectory import SHAPING_NAMES

    tables = {
        f"gains of {law.name}": [
            gain_key(*item, item[0] in law.bounds) for item in law.gains.items()
        ]
        for law in LAWS.values()
    }
    rules = {name: VOCABULARY[name] for name in RULE_NAMES}
    for title, rows in (
        ("rules", {**rules, "allow_seventh": None}),
        ("shaping", {name: VOCABULARY[name] for name in SHAPING_NAMES}),
    ):
        tables[title] = [gain_key(*item) for item in rows.items()]
    choices = ", ".join(f"`{choice}`" for choice in CHOICES)
    tables["rules"].insert(-1, Key("`choice`", "", "choice", choices, "", ""))
    return tables


def pages() -> dict[str, dict[str, list[Key]]]:
    """The tables of each page by their name, where their comments stand. A table that stands on no
    page yet is the last page's."""

    def tables(roots: Iterable[type[BaseModel]]) -> dict[str, list[Key]]:
        return {
            model.__name__: [key_of(*item) for item in own_fields(model).items()]
            for model in models(roots)
        }

    every = tables([Rig]) | tables(recipe_models()) | gain_tables()
    results: dict[str, dict[str, list[Key]]] = {}
    for path in sorted((DOCS / "reference").glob("*.md")):
        if path.relative_to(DOCS).as_posix() in WHOLE_PAGES:
            continue
        names = [match[1] for match in _BLOCK.finditer(path.read_text(encoding="utf-8"))]
        if names:
            name = path.relative_to(DOCS).as_posix()
            results[name] = {table: every[table] for table in names if table in every}
    placed = {table for page in results.values() for table in page}
    results[name] |= {table: keys for table, keys in every.items() if table not in placed}
    return results


# --- a page made anew


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1])]


def read_table(text: str) -> dict[str, dict[str, str]]:
    """The rows of a table in a page by their first cell, each a dict by the header."""
    lines = text.splitlines()
    if len(lines) < 3:
        return {}
    header = _cells(lines[0])
    rows = (dict(zip(header, _cells(line), strict=True)) for line in lines[2:])
    return {row["key"]: row for row in rows}


def write_table(keys: Iterable[Key], place: str, page: Mapping[str, Mapping[str, str]]) -> str:
    """A table with what the page says of each key where the model does not say it; columns with
    nothing in them are left out.

    Raises:
        InputError: there are no words for a key.
    """
    rows = []
    for key in keys:
        old = page.get(key.name, {})
        word = key.name.strip("`")
        row = VOCABULARY.get(word)
        known = replace(
            key,
            default=key.default or old.get("default", "") or "the law's",
            words=key.words or old.get("what for", "") or (row.meaning if row else ""),
        )
        if not known.words:
            raise InputError(
                f"{place}: nothing says what {key.name} is for",
                hint="write it into the table's last cell, or give the field a description",
            )
        rows.append(astuple(known))
    used = [i for i in range(len(HEADER)) if any(row[i] for row in rows)]
    lines = [[HEADER[i] for i in used], ["---"] * len(used)]
    lines += [[row[i] for i in used] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def made(text: str, tables: Mapping[str, list[Key]], name: str) -> str:
    """A page's text with its tables made anew; a table that it lacks comes at its end.

    Raises:
        InputError: a table of the page is of nothing that there is, or a key has no words.
    """
    seen = {result[1] for result in _BLOCK.finditer(text)}
    if gone := sorted(seen - set(tables)):
        raise InputError(f"{name}: there is nothing called '{gone[0]}' any more")
    for missing in tables:
        if missing not in seen:
            text += f"\n## {missing}\n\n<!-- {missing} -->\n"

    def table(match: re.Match[str]) -> str:
        place = f"{name}, {match[1]}"
        return f"<!-- {match[1]} -->\n" + write_table(tables[match[1]], place, read_table(match[2]))

    return _BLOCK.sub(table, text)


# --- pages that are made as a whole


def _rows(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(header)
    lines = [head, ["---"] * len(head), *rows]
    return "".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines
    )


def quantities_page() -> str:
    """All words of the vocabulary."""
    rows = (
        (f"`{row.name}`", row.symbol, row.unit, _unit(row), _span(row), row.meaning)
        for row in VOCABULARY.values()
    )
    header = ("name", "symbol", "SI", "shown in", "range", "meaning")
    return f"""# Quantities

Every word that a file, a channel or a parameter may use, with its SI unit and the unit and range in
which people see it. Made by `make reference` from `ehbench/vocabulary/quantities.csv`.

<!-- quantities -->
{_rows(header, rows)}"""


def settings_classes() -> Iterator[type]:
    """The dataclasses of settings, in the order of their modules."""
    for module in pkgutil.walk_packages(ehbench.__path__, "ehbench."):
        if module.name != "ehbench.__main__":
            for item in vars(importlib.import_module(module.name)).values():
                if isinstance(item, type) and item.__module__ == module.name:
                    if is_dataclass(item) and any("origin" in f.metadata for f in fields(item)):
                        yield item


def settings_page() -> str:
    """The numbers of all methods."""
    text = """# Settings

The numbers of the methods, SI. They are no keys of a recipe; each has a reason or a source. Made by
`make reference` from the code.
"""
    for item in settings_classes():
        title = item.__module__.removeprefix("ehbench.")
        meaning = " ".join((item.__doc__ or "").split("\n\n")[0].split())
        rows = (
            (f"`{name}`", f"{value:g}" if isinstance(value, float) else str(value), unit, what, why)
            for name, value, unit, what, why in settings.rows(item())
        )
        text += f"\n## {title}\n\n{meaning}\n\n<!-- {item.__name__} -->\n"
        text += _rows(("name", "value", "unit", "meaning", "origin"), rows)
    return text


WHOLE_PAGES = {"reference/quantities.md": quantities_page, "reference/settings.md": settings_page}


def main(arguments: list[str]) -> int:
    """Write the pages, or with ``--check`` say which are not as they would be."""
    stale = []
    for name, tables in pages().items():
        path = DOCS / name
        old = path.read_text(encoding="utf-8")
        try:
            new = made(old, tables, f"docs/{name}")
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        if new != old:
            stale.append(name)
            if "--check" not in arguments:
                path.write_text(new, encoding="utf-8")
    for name, page in WHOLE_PAGES.items():
        path, new = DOCS / name, page()
        if not path.exists() or path.read_text(encoding="utf-8") != new:
            stale.append(name)
            if "--check" not in arguments:
                path.write_text(new, encoding="utf-8")
    if stale and "--check" in arguments:
        print(f"docs/{', docs/'.join(stale)}: make reference writes them anew", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
