"""What a command says, as lines for a terminal and as plain values for scripts. What a run says is
the first part of its section of the report, from the run's saved files only."""

import json
import os
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ehbench.report.blocks import Block, Bullets, Cell, Grid
from ehbench.report.content import names
from ehbench.report.first_screen import Chapter, chapters_of, next_steps, summary
from ehbench.report.provenance import TracedRun
from ehbench.report.saved import Saved
from ehbench.report.words import capital, words
from ehbench.runs.rundir import plain, read_json
from ehbench.vocabulary import Message, message, plural
from ehbench.vocabulary.messages import is_warning, ranked
from ehbench.vocabulary.text import folded

GAP = "  "
SETTLED = ("done", "partly_estimated")  # statuses that are no verdict
MOST_STEPS, MOST_WORDS = 3, 60  # of an answer; words besides tables


@dataclass(frozen=True)
class Answer:
    """What a command says.

    ``tables``: the most telling first, of it the ``columns`` (none: all) and the first ``rows``
    (None: all). ``steps``: what to do next, the most valuable first. ``notes``: all else worth
    knowing, and ``details`` of it. ``place``: what was written. ``values``: the same for scripts.
    """

    verdict: str
    tables: Sequence[Grid] = ()
    steps: Sequence[Message] = ()
    notes: Sequence[str] = ()
    place: Path | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    columns: Sequence[str] = ()
    notes_in: str = "with -v"
    details: Sequence[str] = ()
    rows: int | None = None

    def lines(self, width: int = 100, whole: bool = False) -> list[str]:
        """Verdict, table, numbered next steps, the number of notes, and the place.

        Args:
            width: of the terminal, in characters; columns that do not fit are left out, the last
                first.
            whole: all tables with all their columns, all steps and notes."""
        verdict, short = self.verdict, self.verdict.split()[: MOST_WORDS // 2]
        if not whole and len(short) < len(verdict.split()):
            cut = " ".join(short)
            clauses = re.match(r".{60,}[,;](?= )", cut)
            verdict = f"{clauses[0] if clauses else cut} …"
        out = textwrap.wrap(verdict, width)
        warnings = [note for note in self.notes if is_warning(note)]
        for note in (*self.notes, *self.details) if whole else folded(warnings):
            out += textwrap.wrap(note, width, initial_indent="- ", subsequent_indent="  ")
        for item in self.tables if whole else self.tables[:1]:
            columns = () if whole else self.columns
            shown = item if whole else replace(item, rows=item.rows[: self.rows])
            out += ["", *table_lines(shown, columns, sys.maxsize if whole else width)]
            rest = len(item.rows) - len(shown.rows)
            out += [f"… {plural(rest, 'more row')} with -v", ""] if rest else [""]
        rest = len(self.notes) - len(warnings)
        last = [plural(rest, "note") + f" {self.notes_in}"] if rest else []
        last = [] if whole else last
        last += [] if self.place is None else [str(self.place)]
        count = len(" ".join([verdict, *last]).split())
        for number, step in enumerate((s for s in self.steps if whole or s.hint), 1):
            # the line to paste is not broken
            indent = " " * len(f"{number}. ")
            text = f"{number}. {capital(step)}" + (":" if step.hint else "")
            lines = textwrap.wrap(text, width, subsequent_indent=indent, break_on_hyphens=False)
            lines += [f"{indent}{line}" for line in step.hint.splitlines()]
            count += len(" ".join(lines).split())
            if not whole and number > 1 and (number > MOST_STEPS or count > MOST_WORDS):
                break
            out += lines
        return [*out, *last]

    def as_json(self) -> str:
        """The values with verdict, steps and notes; messages with their keys."""
        steps = [{"key": step.key, "text": step, "line": step.hint} for step in self.steps]
        steps = [item | {"text": str(item["text"])} for item in steps]
        notes = [{"key": getattr(note, "key", ""), "text": str(note)} for note in self.notes]
        about = {"verdict": self.verdict, "steps": steps, "notes": notes}
        if self.place is not None:
            about["folder"] = str(self.place)
        return json.dumps(plain({**about, **self.values}), ensure_ascii=False, indent=1)


def reported(folder: Path) -> tuple[Chapter, Sequence[Block]]:
    """A run as a chapter of the report without figures, and the part of it that a terminal shows.

    Raises:
        InputError: a file of the run is missing or damaged."""
    (chapter,) = chapters_of([Saved(folder)], [lambda **shows: []])
    parts = {part.title: part.inside for part in chapter.content.parts}
    shown = (parts[title] for title in chapter.stage.shows if title in parts)
    return chapter, next(shown, ())


def answer(folder: Path, notes: Sequence[str] = (), code: int = 0, losses: bool = False) -> Answer:
    """What a run says: its verdict, its table, what to do next, and what speaks against it; for
    scripts ``status``, ``sentence``, ``results`` (the rows of the tables by their head, as text in
    the rig file's units), ``numbers`` [SI] and the ``files`` of the run.

    Raises:
        InputError: as `reported`."""
    chapter, blocks = reported(folder)
    run, status, sentence = chapter.run, chapter.content.status, chapter.content.sentence
    bullets = [item for block in blocks if isinstance(block, Bullets) for item in block.items]
    steps = [message("steps.lost", **names(run))] if losses else []
    steps += next_steps([chapter])
    tables = [block for block in blocks if isinstance(block, Grid)]
    verdict = sentence
    if status not in SETTLED:  # in capitals before the sentence
        word = words(status)
        begins = sentence.lower().startswith(word)
        verdict = word.upper() + (sentence[len(word) :] if begins else f": {sentence}")
    file, keys = chapter.stage.numbers
    numbers: Any = read_json(run.folder / file) if file else None
    values = {
        "code": code,
        "status": status,
        "sentence": sentence,
        "results": [row for item in tables for row in _rows(item)],
        "numbers": {key: numbers[key] for key in keys if key in numbers} if keys else numbers,
        "files": sorted(run.facts.get("outputs", {})),
    }
    return Answer(
        verdict,
        [table for table in tables if table.rows],
        _placed(ranked(steps), [folder]),
        list(dict.fromkeys([*bullets, *folded(notes)])),
        folder,
        values,
        chapter.stage.columns,
        details=[str(text) for text in run.facts.get("details", [])],
    )


def report_answer(folder: Path, notes: Sequence[str] = (), code: int = 0) -> Answer:
    """What a report says: the verdict over its runs, their main numbers, and what to do next.

    Raises:
        InputError: as `reported`."""
    places = [item.place for item in TracedRun(folder).sources if item.role == "run"]
    runs = [place for place in places if place is not None]
    chapters = chapters_of([Saved(run) for run in runs], [lambda **shows: []] * len(runs))
    verdict, grid, steps = summary(chapters)
    return Answer(
        verdict,
        [grid],
        _placed(steps, runs),
        list(dict.fromkeys(notes)),
        folder / "report.html",
        {"code": code, "folder": str(folder), "numbers": _rows(grid)},
        notes_in="in the report",
    )


def _placed(steps: Sequence[Message], folders: Sequence[Path]) -> list[Message]:
    """Steps whose lines name a run and its recipe by where they are from here."""
    places = {}
    for folder in folders:
        recipe = TracedRun(folder).recipe
        where = recipe.name if recipe.place is None else os.path.relpath(recipe.place)
        places[folder.name] = {"run": os.path.relpath(folder), "recipe": where}
    return [
        message(step.key, **{**step.fields, **places.get(step.fields.get("run", ""), {})})
        for step in steps
    ]


def _rows(grid: Grid) -> list[dict[str, str]]:
    """The rows of a table by its head; one table of names and values where it has no head."""
    rows = [[_cell_text(cell) for cell in row] for row in grid.rows]
    if not any(grid.head):
        return [{row[0]: row[1] for row in rows}]
    return [dict(zip(grid.head, row, strict=True)) for row in rows]


def table_lines(grid: Grid, columns: Sequence[str], width: int) -> list[str]:
    """A table in columns, named ones or all, as many as fit; words may be cut to 20 letters, or go
    on below where no head names them."""
    places = [grid.head.index(name) for name in columns if name in grid.head]
    places = places or list(range(len(grid.head)))
    cells = [[grid.head[i] for i in places]] if any(grid.head) else []
    cells += [[_cell_text(row[i]) for i in places] for row in grid.rows]
    looks = [{getattr(row[i], "look", "") for row in grid.rows} for i in places]
    digits = [look <= {"number"} for look in looks]
    wide = [max(map(len, column)) for column in zip(*cells, strict=True)]
    while (over := sum(wide) + len(GAP) * (len(wide) - 1) - width) > 0 and len(wide) > 1:
        if not digits[len(wide) - 1] and wide[-1] - over >= 20:
            wide[-1] -= over
        elif len(wide) == 2:
            break
        else:
            wide.pop()
    rule = GAP.join("─" * size for size in wide)
    lines = []
    for row in cells:
        texts, below = [], []
        for text, size, right in zip(row, wide, digits, strict=False):
            if len(text) > size and any(grid.head):
                text = text[: size - 1] + "…"
            elif len(text) > size:
                text, *below = textwrap.wrap(text, size)
            texts.append(text.rjust(size) if right else text.ljust(size))
        indent = " " * len(GAP.join([*texts[:-1], ""]))
        lines += [GAP.join(texts).rstrip(), *(indent + text for text in below)]
    lines.insert(1 if any(grid.head) else 0, rule)
    return lines


def _cell_text(cell: Cell | str) -> str:
    return cell.text if isinstance(cell, Cell) else cell
