"""What a stage gives to the report: its figures, its section, and cells of tables."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ehbench.report.blocks import Block, Cell, Fold, Part, Picture
from ehbench.report.saved import FigureIndex, Saved
from ehbench.report.words import words
from ehbench.vocabulary import Message, message, plural

Pictures = Callable[..., list[Picture]]  # the run's figures that show something
# how status words look as a chip; all others are plain
_LOOKS = {
    "good": ("accepted", "met", "estimated", "checks passed", "passed", "done"),
    "bad": ("rejected", "missed", "checks failed", "failed", "stopped"),
    "warn": (
        *("undecided", "not_measured", "accepted_with_reservation", "estimated, doubtful"),
        *("at_bound", "not_excited", "correlated", "fitted", "still", "partly_estimated"),
    ),
}


@dataclass(frozen=True)
class Headline:
    """A number that people ask for. ``rank``: its place among those of a report, which shows one
    of each rank below `OFTEN`; ``on_model``: of the model, so that a machine's wins."""

    rank: int
    label: str
    value: str
    about: str = ""
    on_model: bool = False


OFTEN = 6  # the first rank of which a report may show several
PARAMETER, FIT, DAMPING, TRACKING, SAVED, STEPS = range(6)


@dataclass(frozen=True)
class Findings:
    """What the first screen takes: numbers, figures to choose from, doubts, next steps."""

    numbers: Sequence[Headline] = ()
    figures: Sequence[Mapping[str, str]] = ()
    against: Sequence[str] = ()
    next: Sequence[Message] = ()


@dataclass(frozen=True)
class SectionContent:
    """A status word, a sentence, the parts of the section, and a sentence a controller."""

    status: str
    sentence: str
    parts: Sequence[Part]
    more: Sequence[str] = ()


@dataclass(frozen=True)
class StageReport:
    """How runs of one kind are called in the glance, drawn and told.

    ``standing`` says how far a run brings its rig: 0 as given, 1 identified, 2 judged. A terminal
    shows the first part that ``shows`` names, of its table the ``columns`` (none: all); scripts
    get ``numbers``: a JSON file of the run, and keys of it (none: all)."""

    label: str
    section: Callable[[Saved, Pictures], SectionContent]
    draw: Callable[[Saved, FigureIndex], None] = lambda run, index: None
    findings: Callable[[Saved], Findings] = lambda run: Findings()
    standing: int = 0
    shows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    numbers: tuple[str, tuple[str, ...]] = ("", ())


def names(run: Saved) -> dict[str, str]:
    """What steps call a run: its folder ``run``, its ``recipe``, and the run's ``name``."""
    recipe = run.facts["recipe"]["path"]
    return {"run": run.folder.name, "recipe": recipe, "name": recipe}


def remedy_step(remedy: str) -> Message:
    """The step that a remedy asks for, with the lines to paste where it names some."""
    if block := getattr(remedy, "fields", {}).get("block"):
        return message("steps.rig", line=block)
    if freed := re.match(r'add ("[^\[\]]+") to parameters', remedy):
        return message("steps.free", line=freed[1])
    if getattr(remedy, "key", "") == "faults.fitted":
        return message("steps.fit_again", names=getattr(remedy, "fields", {})["names"])
    if sensed := re.match(r"add \[\[sensor\]\] (.+?)( to the recipe|$)", remedy):
        return message("steps.sense", line=re.sub("[,;] |(?<=]) ", "\n", sensed[1]))
    if written := re.match(r'(\w+ = "[^"]+") (.+)', remedy):
        return message("steps.write", line=written[1], where=written[2])
    if exchanged := re.match(r"exchange (\S+ and \S+) in the map of columns", remedy):
        return message("steps.exchange", channels=exchanged[1])
    return message("steps.remedy", remedy=remedy)


def weight(fields: Mapping[str, Any]) -> float:
    """How much speaks for what somebody is to write, to a tenth: the share of the residual that it
    explains, or what stands for it."""
    return round(fields.get("weight", fields.get("share", math.inf)), 1)


def written_step(fields: Mapping[str, Any]) -> Message:
    """The step of a note that gives a line and where to write it, or a remedy."""
    if "remedy" in fields:
        return remedy_step(fields["remedy"])
    return message("steps.write", line=fields["line"], where=fields["where"])


def look_of(status: str) -> str:
    """How a status word looks as a chip."""
    return next((look for look, words in _LOOKS.items() if status in words), "plain")


def chip(status: str) -> Cell:
    """A status word as a chip."""
    return Cell(words(status), look_of(status))


def num(text: str) -> Cell:
    """A cell of digits."""
    return Cell(text, "number")


def folded(figures: Sequence[Picture], what: str) -> list[Block]:
    """Figures that open on a click, under their count; nothing where there are none."""
    return [Fold(f"{plural(len(figures), 'figure')}: {what}", figures)] if figures else []
