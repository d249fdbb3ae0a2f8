"""Flowmeter readings: which column of a foreign table is the command, the drop, the flow."""

import numpy as np

from ehbench.app.mapping.guesses import (
    CERTAIN,
    CURRENTS,
    DIFFERENTIAL,
    UNDECIDED,
    WORDS,
    Guess,
    command_guess,
    reading_of,
    words_of,
)
from ehbench.config.recipe.columns import READING_WORDS
from ehbench.config.rig import Rig
from ehbench.data.readers import Source, SourceColumn
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import is_of


def holds_readings(source: Source) -> bool:
    """Whether a file is of a flowmeter: a column of flow, none of how a cylinder moves, and not the
    pressures of both its chambers, unless it has no time: then two pressures are of two sides.
    """
    columns = [column for table in source.tables for column in table.columns]

    def has(row: str) -> bool:
        return any(item.known_unit and is_of(item.known_unit, VOCABULARY[row]) for item in columns)

    ends = {reading_of(item.known_unit, words_of(item.name))[0] for item in columns}
    timed = has("t") or any(table.t is not None for table in source.tables)
    log = ({"p_head", "p_rod"} <= ends and timed) or bool(ends & {"x", "v", "q", "qd"})
    return len(source.tables) == 1 and has("flow") and not log


def reading_guesses(source: Source, rig: Rig | None) -> dict[str, Guess]:
    """A guess for each column of numbers, and for each of words whose name says what it is; by
    name. What several columns may be is none of them for sure.
    """
    table, results = source.tables[0], {}
    for name, (_, j) in source.names().items():
        results[name] = _guess(name, table.columns[j], rig)
    given = [guess.channel for guess in results.values() if guess.sure]
    if given.count("pressure_drop") == 0:
        results = {name: _drop_of(guess, given) for name, guess in results.items()}
        given = [guess.channel for guess in results.values() if guess.sure]
    for name, guess in results.items():
        if guess.sure and given.count(guess.channel) > 1:
            results[name] = Guess(
                guess.channel, guess.unit, UNDECIDED, message("app.or_another"), guess.ends
            )
    for name in table.words:
        what = next((item for item in READING_WORDS if words_of(name) & WORDS[item]), "")
        results[name] = Guess(what, "", CERTAIN if what else UNDECIDED, "words")
    return results


def _drop_of(guess: Guess, given: list[str]) -> Guess:
    """A pressure that stands alone is the drop; one of two sides without the other is open."""
    sides = ("upstream_pressure", "downstream_pressure")
    if guess.channel == "pressure":
        alone = not any(side in given for side in sides)
        if not alone:
            return Guess("pressure_drop", guess.unit, UNDECIDED, message("app.which_side"))
        return Guess("pressure_drop", guess.unit, CERTAIN)
    if guess.channel in sides and not all(side in given for side in sides):
        return Guess(guess.channel, guess.unit, UNDECIDED, message("app.needs_both_sides"))
    return guess


def _guess(name: str, column: SourceColumn, rig: Rig | None) -> Guess:
    unit, words = column.known_unit, words_of(name)
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return Guess(remark=message("app.no_number_held"))
    if unit and is_of(unit, VOCABULARY["flow"]):
        return Guess("flow", unit, CERTAIN)
    if unit and is_of(unit, VOCABULARY["pressure_drop"]):
        if words & WORDS["drop"] or column.unit.strip("()[]").lower() in DIFFERENTIAL:
            return Guess("pressure_drop", unit, CERTAIN)
        if words & WORDS["upstream"]:
            return Guess("upstream_pressure", unit, CERTAIN)
        if words & WORDS["downstream"]:
            return Guess("downstream_pressure", unit, CERTAIN)
        return Guess("pressure", unit, UNDECIDED)
    if unit and is_of(unit, VOCABULARY["temperature"]):
        return Guess("temperature", unit, CERTAIN)
    if words & WORDS["trial"] and np.all(known == np.round(known)) and known.min() > 0.0:
        return Guess("trial", "", CERTAIN)
    driven = unit in (*CURRENTS, "V", "%")
    if words & (WORDS["command"] | WORDS["command_port"]) or driven:
        guess = command_guess(unit, words, known, rig)
        certainty = CERTAIN if driven else guess.certainty
        return Guess("command", guess.unit, certainty, guess.remark, guess.ends)
    return Guess(remark="")
