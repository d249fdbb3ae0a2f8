"""A draft of a map of columns: what a foreign file holds, and what each column may be.

A guess goes by the unit that the file says, the words in the column's name and the names in the
rig. What is not sure stands in the draft as a remark, for the user to decide."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ehbench.app.mapping.guesses import (
    CYLINDER,
    LIMITS,
    VALVE,
    Guess,
    guessed,
    holds_readings,
    reading_guesses,
)
from ehbench.app.mapping.written import drafted, draw, own_rows, range_of, remark
from ehbench.config.recipe.columns import ENDING, load_columns
from ehbench.config.rig import Rig
from ehbench.data import read
from ehbench.data.channels import DAYS
from ehbench.data.flowmeter import alike, read_flowmeter
from ehbench.data.readers import Source, SourceColumn, SourceTable, open_source, reader_of
from ehbench.data.readers.clock import since_1970
from ehbench.preprocessing.plausibility import outside_stroke
from ehbench.report.blocks import Grid
from ehbench.report.terminal import Answer
from ehbench.runtime.disk import replacing, write_text
from ehbench.signals.oddities import oddities
from ehbench.signals.timestamps import resolution, unrounded, unwrapped
from ehbench.vocabulary import VOCABULARY, EhbenchError, InputError, message, to_si

_SEPARATOR_WORDS = {
    ",": "commas",
    ";": "semicolons",
    "|": "pipes",
    "\t": "tabs",
    " ": "white space",
}

__all__ = ["Guess", "draft", "drafted", "guessed"]


def draft(path: Path, out: Path | None = None, rig: Rig | None = None) -> Answer:
    """Look at a file and write a map of its columns, by default ``<name>.map.toml`` here, with a
    picture of each; they may be of the cylinders and valves of a rig. What there is to say of it: a
    row a column, what the file holds as notes.

    Raises:
        InputError: something stands there already.
        LogError: the file cannot be read."""
    stem = path.name.partition(".")[0] or path.name
    out = out or Path(stem + ENDING)
    picture = out.with_name(out.name.removesuffix(".toml").removesuffix(".map") + ".map.svg")
    for item in (out, picture):
        if item.exists() or item.is_symlink():
            raise InputError(message("app.stands_already"), file=item)
    source = open_source(path)
    sheets = alike(source)
    first = replace(source, tables=source.tables[:1])
    many = len(sheets) > 1 and len(sheets) == len(source.tables) and holds_readings(first)
    source = first if many else source
    readings = many or holds_readings(source)
    guesses = reading_guesses(source, rig) if readings else guessed(source, rig)
    text = drafted(path, source, guesses)
    try:
        with replacing(out) as map_part, replacing(picture) as picture_part:
            write_text(map_part, text)
            draw(picture_part, source, guesses)
    except OSError as error:
        raise InputError(message("app.unwritable", reason=error.strerror), file=out) from None
    lines, rows = _overview(path, source, guesses)
    others = ", ".join(f"'{table.name}'" for table in sheets[1:])
    lines += [message("app.same_columns", tables=others)] if many else []
    lines += _tried(path, out, guesses, rig, readings)
    sure = sum(guess.sure and bool(guess.channel) for guess in guesses.values())
    step = message("steps.name_map", map=out.name)
    undecided = [name for name, guess in guesses.items() if not guess.sure]
    if undecided and not any(guess.sure and guess.channel != "t" for guess in guesses.values()):
        column = max(undecided, key=lambda name: bool(guesses[name].channel))
        step = message("steps.complete_map", map=out, column=column)
    return Answer(
        message("app.drafted", map=out, sure=sure, count=len(rows)),
        [Grid(["column", "range", "channel"], rows)],
        [step],
        lines,
        out,
        {"columns": rows, "picture": picture},
    )


def _overview(
    path: Path, source: Source, guesses: dict[str, Guess]
) -> tuple[list[str], list[tuple[str, str, str]]]:
    """(what the file holds, (name, range, guess) of each column)."""
    names, dialect = source.names(), source.dialect
    lines = [f"{path.name}: {reader_of(path).name}"]
    if dialect.separator is not None:
        lines[0] += message(
            "app.dialect",
            encoding=dialect.encoding,
            mark=_SEPARATOR_WORDS[dialect.separator],
            sign="comma" if dialect.decimal == "," else "point",
            line=(dialect.skip or 0) + 1,
            units=message("app.units_below") if dialect.unit_row else "",
        )
    rows, columns = own_rows(source, guesses), []
    for index, table in enumerate(source.tables):
        title = f"table '{table.name}'" if table.name else "table"
        span = _span(table, index, names, guesses)
        lines.append(message("app.table_span", table=title, count=table.size, span=span))
        for name in (name for name, at in names.items() if at[0] == index):
            column, guess = table.columns[names[name][1]], guesses[name]
            own = rows[name]
            bad = np.flatnonzero(~np.isfinite(column.values) & own)
            text = message("app.bad_in_column", count=bad.size) if bad.size else ""
            if (row := next((int(at) for at in bad if column.odd.get(int(at))), None)) is not None:
                first = {"cell": remark(column.odd[row]), "where": _where(table, row)}
                text += message("app.first_bad", **first)
            if not own.all():
                text = message("app.rows_of_a_rate", count=int(own.sum()), bad=text)
            text = range_of(column) + text
            still = guess.channel == "t" or guess.channel.endswith(".command")
            seen = [] if still else oddities(column.values)
            odd = [item._asdict() | {"where": _where(table, item.first)} for item in seen]
            text += "".join(message("app.odd_samples", **fields) for fields in odd)
            columns.append((name, text, _guess_text(guess)))
            notes = (message(f"app.odd_{fields['kind']}", **fields) for fields in odd)
            lines += [f"{name}: {note}" for note in notes]
        for name, cells in table.words.items():
            row = next((row for row, cell in enumerate(cells) if cell), 0)
            fields = {"cell": remark(cells[row] if cells else ""), "where": _where(table, row)}
            text = message("app.no_numbers" if any(cells) else "app.no_number_held", **fields)
            guess = Guess() if name in names else guesses.get(name, Guess())
            columns.append((name, text, _guess_text(guess)))
    return [*lines, *source.losses], columns


def _guess_text(guess: Guess) -> str:
    """What a column may be, how certain that is, and why."""
    unit = f" [{guess.unit}]" if guess.unit and guess.channel and not guess.ends else ""
    reasons = ", ".join(filter(None, (guess.remark, *guess.why)))
    return f"{guess.channel or '?'}{unit}  {guess.certainty}{reasons and ': ' + reasons}"


def _where(table: SourceTable, row: int) -> str:
    """Where a row stands in its file."""
    return f"line {table.lines[row]}" if table.lines is not None else f"row {row + 1}"


def _span(
    table: SourceTable, index: int, names: dict[str, tuple[int, int]], guesses: dict[str, Guess]
) -> str:
    """How long a table is, how often it was sampled and when it began, as far as is known."""
    t, began, written = table.t, table.began, table.t
    for name, (i, j) in names.items():
        if i == index and guesses[name].channel == "t" and t is None:
            unit = guesses[name].unit or "s"
            written = unwrapped(table.columns[j].values)
            t = to_si(written, unit, VOCABULARY["t"])
            first = float(np.nanmin(t)) if np.isfinite(t).any() else 0.0
            began = since_1970(first, unit in DAYS) if began is None else began
    t = np.zeros(0) if t is None else t[np.isfinite(t)]
    if t.size < 2 or written is None:
        return ""
    span = float(np.ptp(t))
    scale = span / float(np.ptp(written[np.isfinite(written)])) if span > 0.0 else 1.0
    step = float(np.median(np.diff(unrounded(t, scale * max(resolution(written))))))
    even = span / (t.size - 1)  # which tells a rate better than steps that the recorder rounded
    step = even if abs(even - step) < LIMITS.even * step else step
    rate = f", {1 / step:.5g} Hz" if step > 0.0 else ""
    first, form = (began, "%Y-%m-%d ") if began is not None else (table.daytime, "")
    since = ""
    if first is not None:
        since = f", from {datetime.fromtimestamp(first, UTC):{form}%H:%M:%S.%f}"[:-3]
    return f", {span:.5g} s{rate}{since}"


def _tried(
    path: Path, out: Path, guesses: dict[str, Guess], rig: Rig | None, readings: bool
) -> list[str]:
    """Whether the draft takes the file as it stands."""
    lines: list[str] = []
    if readings:
        try:
            data = read_flowmeter(path, load_columns(out))
        except EhbenchError as error:
            return [message("app.not_yet", error=error)]
        each = (f"{len(data.select(*group))} of {' '.join(group)}" for group in data.groups())
        return [message("app.readings_taken", groups=", ".join(each))]
    if rig is None and any(CYLINDER in guess.channel for guess in guesses.values()):
        lines.append(message("app.no_rig_given", cylinder=CYLINDER, valve=VALVE))
    if not any(guess.sure and guess.channel != "t" for guess in guesses.values()):
        return lines
    try:
        record = read(path, out)
    except EhbenchError as error:
        return [*lines, message("app.not_yet", error=error)]
    undecided = [name for name, guess in guesses.items() if not guess.sure]
    fields = {"record": repr(record), "count": len(guesses) - len(undecided)}
    if undecided:
        names = ", ".join(f"'{remark(name)}'" for name in undecided)
        fields |= {"columns": len(guesses), "undecided": names}
    lines.append(message("app.taken_in_part" if undecided else "app.taken", **fields))
    lines += [f"  {note}" for note in record.losses]
    lines += [f"  {doubt}" for doubt in ([] if rig is None else outside_stroke(record, rig))]
    return lines
