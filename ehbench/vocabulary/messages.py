"""Messages to people: templates in one catalogue, each by its key.

The catalogue is the folder `messages` beside this file, a TOML file for each part of the package.
The key ``data.no_time`` is the entry ``no_time`` of ``data.toml``: a template of `str.format` with
named fields, or a table with the template as ``text`` and what would be right as ``hint``. A
note of ``level = "warning"`` is shown without -v: what was taken in place of data that are missing,
what keeps a rig from moving, and what voids the promises of gains."""

from __future__ import annotations

import string
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

CATALOGUE = Path(__file__).with_name("messages")


class Message(str):
    """A message with its template's ``key`` and ``fields``, and a ``hint`` of what is right."""

    key: str
    fields: Mapping[str, Any]
    hint: str

    def __new__(
        cls, text: str, key: str = "", fields: Mapping[str, Any] | None = None, hint: str = ""
    ) -> Message:
        new = super().__new__(cls, text)
        new.key, new.fields, new.hint = key, dict(fields or {}), hint
        return new

    def __reduce__(self) -> tuple[Any, ...]:
        return Message, (str(self), self.key, dict(self.fields), self.hint)


class _Numbers(string.Formatter):
    """`str.format`, but numbers below a million without an exponent, 110 and never 1.1e+02, a
    space before %, as before other units, and counts with their word: ``{count:= row}`` is
    ``1 row`` or ``2 rows``, ``{count:= row is|rows are}`` has both."""

    # pyrefly: ignore[bad-override-param-name]
    def format_field(self, value: Any, spec: str) -> str:
        if spec.startswith("= "):
            first, _, others = spec[2:].partition("|")
            return f"{value} {first if value == 1 else others or first + 's'}"
        text = super().format_field(value, spec)
        if spec.endswith("%"):
            return f"{text[:-1]} %"
        usual = spec.endswith("g") and "e+0" in text and abs(value) < 1e6
        return f"{float(text):{'+' * ('+' in spec)}.0f}" if usual else text


_NUMBERS = _Numbers()


def digits(value: float, count: int) -> str:
    """A number to so many digits, as messages have it."""
    return _NUMBERS.format_field(value, f".{count}g")


@cache
def templates(part: str) -> Mapping[str, Mapping[str, str]]:
    """The entries of one file of the catalogue: by name, ``text`` and ``hint``."""
    with (CATALOGUE / f"{part}.toml").open("rb") as file:
        entries = tomllib.load(file)
    return {
        name: entry if isinstance(entry, dict) else {"text": entry}
        for name, entry in entries.items()
    }


def message(key: str, /, **fields: Any) -> Message:
    """The message of a key, such as ``message("data.no_time", column="t")``.

    Args:
        key: a file of the catalogue and an entry of it.
        fields: what the template names. Numbers are formatted by the template.

    Raises:
        KeyError: no such entry, or a field that it names is missing."""
    part, _, name = key.partition(".")
    entry = templates(part)[name]
    text, hint = (_NUMBERS.format(entry.get(name, ""), **fields) for name in ("text", "hint"))
    return Message(text, key, fields, hint)


def of_log(log: str, note: str) -> Message:
    """A note said of a log by its name, with its key and fields."""
    given = note if isinstance(note, Message) else Message(note)
    return Message(f"{log}: {note}", given.key, given.fields, given.hint)


def is_warning(note: str) -> bool:
    """Whether a note is shown without -v."""
    part, _, name = getattr(note, "key", "").partition(".")
    try:
        return templates(part)[name].get("level") == "warning"
    except (OSError, KeyError):  # plain text, or a key of another version
        return False


def ranked(messages: Iterable[Message]) -> list[Message]:
    """Messages of one file of the catalogue, each once, in the order of that file. An entry with
    ``as`` ranks with the entry that it names; messages of one rank keep their order."""

    def place(item: Message) -> int:
        part, _, name = item.key.partition(".")
        return list(templates(part)).index(templates(part)[name].get("as", name))

    return sorted({(item, item.hint): item for item in messages}.values(), key=place)
