"""Messages to people: templates in one catalogue, each by its key.

The catalogue is the folder `messages` beside this file, a TOML file for each part of the package.
The key ``data.no_time`` is the entry ``no_time`` of ``data.toml``: a template of `str.format` with
named fields, or a table with the template as ``text`` and what would be right as ``hint``.
"""

from __future__ import annotations

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


def prefixed(about: str, note: str) -> Message:
    """A note with what it is about before it, and its key; its numbers stand where it came from."""
    return Message(f"{about}: {note}", getattr(note, "key", ""))


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
        KeyError: no such entry, or a field that it names is missing.
    """
    part, _, name = key.partition(".")
    entry = templates(part)[name]
    hint = entry.get("hint", "").format(**fields)
    return Message(entry["text"].format(**fields), key, fields, hint)


def ranked(messages: Iterable[Message]) -> list[Message]:
    """Messages of one file of the catalogue, each once, in the order of that file. An entry with
    ``as`` ranks with the entry that it names; messages of one rank keep their order.
    """

    def place(item: Message) -> int:
        part, _, name = item.key.partition(".")
        return list(templates(part)).index(templates(part)[name].get("as", name))

    return sorted(dict.fromkeys(messages), key=place)
