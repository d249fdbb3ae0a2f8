"""TOML in, with errors that name file, line, key, value and the nearest valid key."""

import os
import re
import tomllib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

from pydantic import BeforeValidator, TypeAdapter, ValidationError

from ehbench.runtime.disk import read_bytes
from ehbench.vocabulary import InputError, Message, message, shortened
from ehbench.vocabulary.errors import nearest, raise_all
from ehbench.vocabulary.fields import FROM_FILE, FileModel

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(
    r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*="""
)


_QUOTED = re.compile(r"""["']([^"'\n]*[\udc80-\udcff][^"'\n]*)["']""")
_LONE = re.compile("[\udc80-\udcff]")
_WRITTEN = 'a line is like key = "1.5 mm", a table begins with [name]'
_NO_RECIPE = "recipes and rig files end in .toml; ehbench check FILE says what is in a log"
_REMEDIES = {
    "string": "close the quotes that were opened",
    "Invalid value": 'a value with a unit is in quotes, like "1.5 mm"',
    "Cannot overwrite": "give each key once",
    "Cannot declare": "give each table once",
    "array": "close the list with ]",
    "inline table": "close the table with }",
}


def line_of(text: str, location: tuple[Any, ...]) -> int | None:
    """The line of the key at ``location``, else the first below it, else its nearest parent."""
    flat, required = _flat_lines(text), _pieces(location)
    for size in range(len(required), 0, -1):
        head = required[:size]
        below = (number for known, number in flat.items() if known[:size] == head)
        if (number := flat.get(head) or next(below, None)) is not None:
            return number
    return None


@lru_cache(maxsize=32)
def _flat_lines(text: str) -> dict[tuple[Any, ...], int]:
    """`lines_of` with dotted names taken apart; a check asks for the places of all keys."""
    flat: dict[tuple[Any, ...], int] = {}
    for known, number in lines_of(text).items():
        flat.setdefault(_pieces(known), number)
    return flat


def lines_of(text: str) -> dict[tuple[Any, ...], int]:
    """The line of every header and key of a TOML text, by location."""
    lines: dict[tuple[Any, ...], int] = {}
    counts: dict[tuple[Any, ...], int] = {}
    prefix: tuple[Any, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            parts = _key_parts(header[2])
            is_entry = header[1] == "[["
            prefix = ()
            for index, part in enumerate(parts):
                prefix += (part,)
                if is_entry and index == len(parts) - 1:
                    counts[prefix] = counts.get(prefix, -1) + 1
                if prefix in counts:
                    prefix += (counts[prefix],)
            for known in [known for known in counts if known[: len(prefix)] == prefix]:
                del counts[known]
            lines.setdefault(prefix, number)
            if isinstance(prefix[-1], int):
                lines.setdefault(prefix[:-1], number)
        elif key := _KEY.match(line):
            lines.setdefault(prefix + tuple(_key_parts(key[1])), number)
    return lines


def _key_parts(dotted: str) -> list[str]:
    return [
        part[1:-1] if part[:1] in "\"'" else part
        for part in re.findall(r'"[^"]*"|\'[^\']*\'|[A-Za-z0-9_-]+', dotted)
    ]


def _pieces(location: tuple[Any, ...]) -> tuple[Any, ...]:
    """A key's parts, dotted names taken apart, so that quoted and unquoted keys are the same."""
    return tuple(
        piece
        for part in location
        for piece in (part.split(".") if isinstance(part, str) else (part,))
    )


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """The table and the text of a TOML file.

    Raises:
        InputError: no such file, not UTF-8, or not TOML, with the line."""
    text = read_text(path)
    return table_of(text, path), text


def read_text(path: Path) -> str:
    """The text of a TOML file.

    Raises:
        InputError: no such file, not UTF-8, or empty."""
    try:
        data = read_bytes(path)
    except FileNotFoundError:
        siblings = path.parent.glob("*.toml") if path.parent.is_dir() else ()
        hint = nearest(path.name, (file.name for file in siblings))
        raise InputError("no such file", file=path, hint=hint) from None
    # a file's name may be of any bytes; what is no such name, and no UTF-8, is an error
    text = data.decode("utf-8-sig", "surrogateescape")
    rest = _QUOTED.sub(lambda name: "" if os.path.exists(path.parent / name[1]) else name[0], text)
    if lone := _LONE.search(rest):
        line = rest.count("\n", 0, lone.start()) + 1
        raise InputError(message("config.not_utf8"), file=path, line=line)
    if not text.strip():
        raise InputError(message("config.file_empty"), file=path)
    return text


def table_of(text: str, path: Path) -> dict[str, Any]:
    """The table of a TOML file's text.

    Raises:
        InputError: it is not TOML, with the line."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        result = re.search(r"\(at line (\d+)", str(error))
        reason = str(error).split(" (at ")[0]
        line = int(result[1]) if result else text.rstrip().count("\n") + 1
        hint = next((remedy for word, remedy in _REMEDIES.items() if word in reason), _WRITTEN)
        hint = hint if path.suffix.lower() == ".toml" else _NO_RECIPE
        text = message("config.not_toml", reason=reason)
        raise InputError(text, file=path, line=line, hint=hint) from None
    except RecursionError:
        raise InputError(message("config.toml_nested"), file=path) from None
    except ValueError:  # more digits than Python turns into a number
        result = re.search(r"\d[\d_]{4000}", text)
        line = text.count("\n", 0, result.start()) + 1 if result else None
        raise InputError(message("config.toml_long_number"), file=path, line=line) from None


def as_list(raw: Any) -> Any:
    """One text, or one table, as a list of one."""
    return [raw] if isinstance(raw, str | dict) else raw


def as_table(key: str) -> BeforeValidator:
    """Takes a text in place of a table for the table with that text as its ``key``."""
    return BeforeValidator(lambda raw: {key: raw} if isinstance(raw, str) else raw)


def validated(model: Any, table: dict[str, Any], text: str, path: Path) -> Any:
    """A table of a file as the model it has to be.

    Raises:
        InputError: with file, line, key, value and the nearest valid key; an unknown key first, and
            the other mistakes with it."""
    errors: dict[Any, InputError] = {}  # by place: each kind that a table may be has its own
    try:
        try:
            return TypeAdapter(model).validate_python(table, context=FROM_FILE)
        except ValidationError as error:
            mistakes = _causes(error.errors())
        for mistake in mistakes:
            explained, location, hint = _explained(model, table, dict(mistake))
            line = line_of(text, location)
            place = (*location, explained if mistake["type"] == "missing" else "")
            errors.setdefault(place, InputError(explained, file=path, line=line, hint=hint))
    except RecursionError:
        raise InputError(message("config.table_nested"), file=path) from None
    raise_all([*errors.values()])


def _causes(mistakes: Sequence[Any]) -> list[Any]:
    """Those of pydantic's errors that follow from no other, unknown keys first: a list whose
    entries are wrong is also too short, a key that is misspelt is missing."""
    unknown = [item for item in mistakes if item["type"] == "extra_forbidden"]
    follow = {item["loc"][:size] for item in mistakes for size in range(1, len(item["loc"]))}
    tables = {item["loc"][:-1] for item in unknown}
    others = [
        item
        for item in mistakes
        if item["loc"] not in follow
        and not (item["type"] == "missing" and item["loc"][:-1] in tables)
    ]
    return [*unknown, *(item for item in others if item not in unknown)]


def _explained(
    model: Any, table: dict[str, Any], first: dict[str, Any]
) -> tuple[str, tuple[Any, ...], str | None]:
    """(message, location, hint) of one of pydantic's errors."""
    reason = first.get("ctx", {}).get("error")
    location = _untagged(table, first["loc"], first["type"] == "missing") + getattr(
        reason, "where", ()
    )
    kind, hint, given = first["type"], None, first["input"]
    expected = first.get("ctx", {}).get("expected", "")
    if kind.startswith("union_tag"):
        word = first["ctx"]["discriminator"].strip("'")
        given = given.get(word) if isinstance(given, dict) else given
        location = (*location, word)
        kind = "missing" if kind == "union_tag_not_found" else "literal_error"
        expected = first["ctx"].get("expected_tags", "")
    place, key = _place_in(table, location)
    fields: dict[str, Any] = {"key": key, "value": shortened(given, 60)}
    if kind == "extra_forbidden":
        text = message("config.unknown_key", **fields)
        hint = _valid_hint(model, table, location, first["loc"])
    elif kind == "missing":
        text, location = message("config.missing", **fields), location[:-1] or location
    elif kind == "value_error":
        text = reason.args[0] if reason.args else str(reason)
        if key and not text.startswith(key):
            text = _with(f"{key}: {text}", text)
    elif kind == "literal_error":
        name = "config.not_one_of" if key else "config.entry_not_one_of"
        text = message(name, **fields, words=expected.replace(" or ", ", "))
        hint = nearest(str(given), re.findall(r"'([^']*)'", expected))
    elif kind == "tuple_type":
        text = message("config.no_list", **fields)
        if isinstance(given, dict):
            hint = f"write [[{_header(location)}]] for each entry"
    elif kind in ("model_type", "model_attributes_type", "dict_type", "dataclass_type"):
        text = message("config.no_table", **fields)
        named = () if kind == "dict_type" else _valid_keys(model, location)
        keys = [name for name in named if name not in ("note", "title")]
        some = [f"{name} = …" for name in keys[:3]] + ["…"] * (len(keys) > 3 or not keys)
        hint = f"write {location[-1]} = {{ {', '.join(some)} }}"
    else:
        reason = first["msg"][0].lower() + first["msg"][1:]
        text = message("config.invalid", **fields, reason=reason)
    return _with(": ".join(part for part in (place, text) if part), text), location, hint


def _with(text: str, original: str) -> Message:
    """A longer text of the same message."""
    fields, hint = getattr(original, "fields", {}), getattr(original, "hint", "")
    return Message(text, getattr(original, "key", ""), fields, hint)


def _untagged(table: Any, location: tuple[Any, ...], missing: bool) -> tuple[Any, ...]:
    """A location without the names by which pydantic tells the kinds of a table apart."""
    retained: list[Any] = []
    for place, part in enumerate(location, 1):
        names = part == "[key]" or isinstance(table, dict) and str(part).split(".")[0] not in table
        if not names or (missing and place == len(location)):
            retained.append(part)
            try:
                table = table[part]
            except (KeyError, IndexError, TypeError):
                table = None
    return tuple(retained)


def _field(model: Any, key: Any) -> Any:
    fields = getattr(model, "model_fields", {}).items()
    return next((field for name, field in fields if key in (name, field.alias)), None)


def _models(annotation: Any) -> list[Any]:
    if isinstance(annotation, type) and issubclass(annotation, FileModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _valid_hint(
    model: Any, table: dict[str, Any], location: tuple[Any, ...], within: tuple[Any, ...]
) -> str | None:
    """What to write for an unknown key: the nearest, its table, or the valid keys."""
    valid = _valid_keys(model, within[:-1])
    if hint := nearest(str((location or within)[-1]), valid):
        return hint
    ends = range(len(location) - 2, 0, -1)
    above = next((at for at in ends if location[-1] in _valid_keys(model, location[:at])), None)
    if above is not None:
        owner = _place_in(table, location[:above])[0]
        return f"a key of {owner}: put it above the table [{_header(location[:-1])}]"
    # not of its own table, but of one in it
    owners = [
        name
        for name in valid
        if not isinstance(within[-1], int)
        and within[-1] in _valid_keys(model, (*within[:-1], name))
    ]
    if len(owners) == 1:
        return f"a key of '{owners[0]}': write it there"
    return "valid keys: " + ", ".join(valid) if valid else None


def _place_in(table: Any, location: tuple[Any, ...]) -> tuple[str, str]:
    """(the entries of lists that a location lies in, by name or number; the key below them)."""
    places, words = [], []
    for part in location:
        try:
            table = table[part]
        except (KeyError, IndexError, TypeError):
            table = None
        if not isinstance(part, int):
            words.append(str(part))
            continue
        name = table.get("name") if isinstance(table, dict) else None
        places.append(".".join(words) + (f" '{name}'" if isinstance(name, str) else f" {part + 1}"))
        words = []
    return ", ".join(places), ".".join(words)


def _header(location: tuple[Any, ...]) -> str:
    return ".".join(part for part in location if isinstance(part, str))


def _valid_keys(model: Any, location: tuple[Any, ...]) -> list[str]:
    """Keys that the model at ``location`` takes, as the file spells them."""
    here = [model]
    for part in (part for part in location if isinstance(part, str)):
        fields = [_field(candidate, part) for candidate in here]
        here = [inner for field in fields if field for inner in _models(field.annotation)] or here
    every = [item for candidate in here for item in candidate.model_fields.items()]
    return sorted({field.alias or name for name, field in every if not field.exclude})
