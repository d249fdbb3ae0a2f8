"""The rows of the vocabulary that a word leads to."""

from dataclasses import asdict

from ehbench.report.blocks import Grid
from ehbench.report.terminal import Answer
from ehbench.report.words import pretty
from ehbench.vocabulary import VOCABULARY, InputError, message
from ehbench.vocabulary.quantities import meant


def look_up(text: str = "") -> Answer:
    """Names for recipes, rig files and maps of columns: those whose name or meaning holds
    ``text``, in any case; all by default.

    Raises:
        InputError: none does; the message names the nearest."""
    word = text.casefold()
    rows = [
        row
        for row in VOCABULARY.values()
        if word in row.name.casefold() or word in row.meaning.casefold()
    ]
    if not rows:
        raise InputError(message("vocabulary.no_quantity", word=text, meant=meant(text)))
    table = Grid(
        ["name", "meaning", "shown in", "inside"],
        [[row.name, row.meaning, pretty(row.display), pretty(row.unit)] for row in rows],
    )
    values = {"quantities": [asdict(row) for row in rows]}
    return Answer(message("app.quantities", count=len(rows)), [table], values=values)
