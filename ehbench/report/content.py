"""What a stage gives to the report: its figures, its section, and the cells that sections are
made of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Part, Picture
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved
from ehbench.report.words import count, number, shown, words

Pictures = Callable[[FigureKey], list[Picture]]  # the run's figures that answer a question
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
    "accepted_with_reservation": "warn",
    "estimated, doubtful": "warn",
    "at_bound": "warn",
    "not_excited": "warn",
    "correlated": "warn",
    "fitted": "warn",
    "still": "warn",
    "partly_estimated": "warn",
}


@dataclass(frozen=True)
class SectionContent:
    """What a stage tells of a run: a status word, one sentence, the parts of the section, and
    more sentences, each of one controller.
    """

    status: str
    sentence: str
    parts: Sequence[Part]
    more: Sequence[str] = ()


@dataclass(frozen=True)
class StageReport:
    """How runs of one kind are called in the glance, drawn and told.

    ``standing`` says how far a run brings its rig: 0 as given, 1 identified, 2 judged. A terminal
    shows the first part that ``shows`` names, of its table the ``columns`` (none: all); scripts
    get ``numbers``: a JSON file of the run, and keys of it (none: all).
    """

    label: str
    section: Callable[[Saved, Pictures], SectionContent]
    draw: Callable[[Saved, FigureIndex], None]
    standing: int = 0
    shows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    numbers: tuple[str, tuple[str, ...]] = ("", ())


def look_of(status: str) -> str:
    """How a status word looks as a chip."""
    return _LOOKS.get(status, "plain")


def chip(status: str) -> Cell:
    """A status word as a chip."""
    return Cell(words(status), look_of(status))


def num(text: str) -> Cell:
    """A cell of digits."""
    return Cell(text, "number")


def quantity_cell(rig: Rig, name: str, value: float | None, digits: int = 4) -> Cell:
    """An SI number in the rig's unit, as a cell."""
    return num(number(None if value is None else float(shown(rig, name, value)), digits))


def folded(figures: Sequence[Picture], what: str) -> list[Block]:
    """Figures that open on a click, under their count; nothing where there are none."""
    return [Fold(f"{count(len(figures), 'figure')}: {what}", figures)] if figures else []


def stopped_status(stopped: object) -> str:
    """The status word of a trial or a set of them."""
    return "stopped" if stopped else "done"
