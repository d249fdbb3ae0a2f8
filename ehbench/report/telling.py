"""How a section tells of a run: what its renderer gives, and the cells, chips and spans that all of
them use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ehbench.report.blocks import Cell, Part, Picture
from ehbench.report.words import interval, number, shown, with_error, words
from ehbench.rig import Rig

Pictures = Callable[
    [str, str, str], list[Picture]
]  # (kind, key of about, its value) → the run's figures of that kind
_LOOKS = {
    "accepted": "good",
    "met": "good",
    "estimated": "good",
    "passed": "good",
    "done": "good",
    "rejected": "bad",
    "missed": "bad",
    "failed": "bad",
    "stopped": "bad",
    "undecided": "warn",
    "not_measured": "warn",
    "at_bound": "warn",
    "not_excited": "warn",
    "correlated": "warn",
    "fitted": "warn",
    "still": "warn",
    "partly_estimated": "warn",
}


@dataclass(frozen=True)
class Told:
    """What a stage's renderer gives: a status word, one sentence for the glance, and the parts of
    the section.
    """

    status: str
    sentence: str
    parts: Sequence[Part]


def look_of(status: str) -> str:
    """How a status word looks as a chip."""
    return _LOOKS.get(status, "plain")


def chip(status: str) -> Cell:
    """A status word as a chip."""
    return Cell(words(status), look_of(status))


def num(text: str) -> Cell:
    """A cell of digits."""
    return Cell(text, "number")


def plus(rig: Rig, name: str, value: float | None, std: float | None) -> str:
    """An SI value with its standard error, in the rig's unit of the quantity."""
    return with_error(*(None if v is None else float(shown(rig, name, v)) for v in (value, std)))


def range_of(rig: Rig, name: str, ends: Sequence[float | None] | None) -> str:
    """An SI interval in the rig's unit of the quantity."""
    return interval(
        *(None if v is None else float(shown(rig, name, v)) for v in (ends or (None, None)))
    )


def capital(text: str) -> str:
    """A text that begins a sentence."""
    return text[:1].upper() + text[1:]


def span(values: Sequence[float], digits: int = 3) -> str:
    """``0.45 to 0.71``: from the least to the largest of some values."""
    low, high = number(min(values), digits), number(max(values), digits)
    return low if low == high else f"{low} to {high}"
