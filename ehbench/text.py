"""Text as files and messages take it."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def quoted(text: str) -> str:
    """A text as a cell of a CSV file: in quotes where it must be."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text


def shortened(value: Any, most: int) -> str:
    """A value as Python writes it, cut where it would take ``most`` characters; only its type where
    that fails.
    """
    try:
        text = repr(value)
    except Exception:
        text = f"<{type(value).__name__}>"
    return text if len(text) < most else text[: most - 3] + "…"


def shortened_path(path: Path | str) -> str:
    """A path on one line, cut where it would take 200 characters."""
    text = str(path)
    text = text if text.isprintable() else repr(text)[1:-1]
    return text if len(text) < 200 else text[:197] + "…"
