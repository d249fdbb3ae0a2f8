"""Text as files and messages take it."""

import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Any, TypeVar

from ehbench.vocabulary.messages import Message

Item = TypeVar("Item")
Key = TypeVar("Key")


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Items by their key, both in their order."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def quoted(text: str) -> str:
    """A text as a cell of a CSV file: in quotes where it must be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text


def unlike(word: str, taken: Collection[str], joint: str = "_") -> str:
    """A word that is none of those taken: itself, else with the first number from 2 on."""
    count, result = 1, word
    while result in taken:
        count += 1
        result = f"{word}{joint}{count}"
    return result


def listed(items: Iterable[Any], maximum: int = 4, kind: str = "") -> str:
    """The first of some items, and ``…`` where there are more: with a ``kind``, how many."""
    texts = [str(item) for item in items]
    more = ", …" + f" ({len(texts)} {kind})" * bool(kind)
    return ", ".join(texts[:maximum]) + more * (len(texts) > maximum)


def numbered(names: Iterable[str], joint: str = "_") -> list[str]:
    """The names, those that come again numbered from 2 on."""
    results: dict[str, None] = {}
    last: dict[str, int] = {}  # by name, so that as many as a file may have take no squared time
    for name in names:
        count = last.get(name, 0) + 1
        while (word := f"{name}{joint}{count}" if count > 1 else name) in results:
            count += 1
        results[word], last[name] = None, count
    return list(results)


def shortened(value: Any, maximum: int) -> str:
    """A value as Python writes it, cut at ``maximum`` characters, or its type."""
    try:
        text = repr(value)
    except Exception:
        text = f"<{type(value).__name__}>"
    return text if len(text) < maximum else text[: maximum - 3] + "…"


def shortened_path(path: Path | str) -> str:
    """A path on one line, cut where it would take 200 characters."""
    text = str(path)
    text = text if text.isprintable() else repr(text)[1:-1]
    return text if len(text) < 200 else text[:197] + "…"


def folded(notes: Iterable[str]) -> list[str]:
    """Notes; those (``name: what``) that differ in numbers alone as one with all names."""
    alike: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        name, colon, what = note.partition(": ")
        key = re.sub(r"\d+(\.\d+)?", "0", what) if colon and " " not in name else note
        if any(item.startswith(f"{name}:") for item in alike.get(key, ())):
            key = note
        alike.setdefault(key, []).append(note)
    results: list[str] = []
    for first, *others in alike.values():
        names = ", ".join(other.partition(": ")[0] for other in others)
        key = getattr(first, "key", "")
        results.append(Message(f"{first} (the like of {names})", key) if others else first)
    return results
