"""The vocabulary: one row per name, read by log schemas, plot labels, docs and reports.

The rows stand in ``quantities.csv`` beside this file; to add a quantity, add a row there. SI
inside. A channel is named ``<cylinder>.<quantity>`` or ``<cylinder>.<valve>.<quantity>``; its row
is that of the last word. A float field of a rig or recipe has the row of its own name."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from ehbench.vocabulary.messages import message

if TYPE_CHECKING:
    import numpy as np

# readings of a cylinder that its pressures and speed imply, where a log has them in place of these
GAUGES = ("load_pressure", "load_force", "rod_force")
_ALIKE = 0.75  # likeness from which a word is surely a slip of another


@dataclass(frozen=True)
class Quantity:
    """One name of the vocabulary.

    ``unit`` is the SI unit used inside, ``display`` the unit people see unless their rig file says
    otherwise, ``lower`` and ``upper`` [SI] the range outside of which a value is surely a slip of
    unit or sign, ``usual`` [SI] that of ordinary rigs. ``mode_role`` says what a parameter decides
    of a cylinder's oscillation: its ``frequency`` or its ``decay``. ``sensor`` says of a channel
    that every machine measures whether it is one of a ``cylinder`` or of the ``supply``; a sample
    has them in the order of the table."""

    name: str
    symbol: str
    unit: str
    display: str
    meaning: str
    lower: float = float("-inf")
    upper: float = float("inf")
    mode_role: str = ""
    sensor: str = ""
    usual: tuple[float, float] = (float("-inf"), float("inf"))

    def holds(self, values: np.ndarray) -> np.ndarray:
        """Which values [SI] lie in the range; what is not a number does not."""
        return (self.lower <= values) & (values <= self.upper)

    def ordinary(self, value: float) -> bool:
        """Whether an ordinary rig has a value [SI]; 0 of what is never less says it has none."""
        return value == self.lower == 0.0 or self.usual[0] <= value <= self.usual[1]


def _rows() -> Iterator[Quantity]:
    """The rows of ``quantities.csv``; without ``display`` the unit, without bound none."""
    text = Path(__file__).with_name("quantities.csv").read_text(encoding="utf-8")
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    for row in csv.DictReader(lines, delimiter=";"):
        keys = ("lower", "upper", "usual_low", "usual_high")
        low, high, *ends = (float(row.pop(k) or ("inf", "-inf")["low" in k]) for k in keys)
        row["display"] = row["display"] or row["unit"]
        yield Quantity(**row, lower=low, upper=high, usual=(ends[0], ends[1]))


VOCABULARY: dict[str, Quantity] = {row.name: row for row in _rows()}
STROKES = {"q": "x", "qd": "v"}  # what a joint coordinate and its rate are on a slide


def quantity(channel: str) -> Quantity:
    """The row of a channel or field name: that of its last dotted word.

    Raises:
        KeyError: no such row; the message says what may be meant."""
    word = channel.rsplit(".", 1)[-1]
    if word not in VOCABULARY:
        raise KeyError(message("vocabulary.no_quantity", word=word, meant=meant(channel)))
    return VOCABULARY[word]


def meant(channel: str, more: Sequence[str] = ()) -> str:
    """What an unknown channel may mean, as the end of a sentence; '' if nothing is near."""
    head, _, word = channel.rpartition(".")
    # behind a dot a word that is hardly alike is rather the name of a valve
    near = get_close_matches(word, [*VOCABULARY, *more], 1, _ALIKE if head else 0.6)
    if near:
        return message("vocabulary.nearest", near=f"{head}.{near[0]}" if head else near[0])
    return message("vocabulary.if_valve", word=word, channel=channel) if head else ""


def like_channel(name: str, channels: Sequence[str]) -> str:
    """Which of a log's channels may be meant by a name, and else all of them, as a hint."""
    longer = [
        channel
        for channel in channels
        if channel.startswith(f"{name}.") or channel.endswith(f".{name}")
    ]
    inside = [channel for channel in channels if f".{name}." in channel]
    near = longer or inside or get_close_matches(name, channels, 1, _ALIKE)
    first = f"did you mean '{near[0]}'? " if len(near) == 1 else ""
    return f"{first}it has {', '.join(channels)}"
