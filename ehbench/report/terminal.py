"""What a run found, as lines for a terminal and as plain values for scripts: the first part of its
section of the report, from the run's saved files only.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ehbench.report.blocks import Block, Bullets, Cell, Grid
from ehbench.report.content import SectionContent
from ehbench.report.saved import Saved
from ehbench.report.stages import report_of
from ehbench.report.words import words
from ehbench.runs.rundir import read_json

GAP = "  "
QUIET = ("done", "partly_estimated")  # statuses that are no verdict


def found(folder: Path) -> tuple[Saved, SectionContent]:
    """A run and what its section of the report says, without figures.

    Raises:
        InputError: a file of the run is missing or damaged.
    """
    run = Saved(folder)
    return run, report_of(run).section(run, lambda key: [])


def lines(folder: Path, width: int = 100, whole: bool = False) -> list[str]:
    """What a run found: a status where there is a verdict, one sentence, what speaks against it,
    and its table.

    Args:
        folder: of the run.
        width: of the terminal, in characters; columns that do not fit are left out, the last
            first.
        whole: show all tables of that part, with all their columns.

    Raises:
        InputError: as `found`.
    """
    run, content = found(folder)
    blocks = _shown(run, content)
    out = textwrap.wrap(_headline(content), width)
    for block in blocks:
        if isinstance(block, Bullets):
            out += _bullets(block, width)
    tables = [block for block in blocks if isinstance(block, Grid) and block.rows]
    for item in tables if whole else tables[:1]:
        columns = () if whole else report_of(run).columns
        out += ["", *table(item, columns, sys.maxsize if whole else width), ""]
    return out


def values(folder: Path) -> dict[str, Any]:
    """The same as plain values: ``status``, ``sentence``, ``results`` (the rows of the tables by
    their head, as text in the rig file's units), ``numbers`` [SI] and the ``files`` of the run.

    Raises:
        InputError: as `found`.
    """
    run, content = found(folder)
    tables = [block for block in _shown(run, content) if isinstance(block, Grid)]
    return {
        "status": content.status,
        "sentence": content.sentence,
        "results": [row for item in tables for row in _rows(item)],
        "numbers": _numbers(run),
        "files": sorted(run.facts.get("outputs", {})),
    }


def _headline(content: SectionContent) -> str:
    """The sentence, a verdict before it in capitals."""
    status, sentence = words(content.status), content.sentence
    if content.status in QUIET:
        return sentence
    if sentence.lower().startswith(status):
        return status.upper() + sentence[len(status) :]
    return f"{status.upper()}: {sentence}"


def _rows(grid: Grid) -> list[dict[str, str]]:
    """The rows of a table by its head; one table of names and values where it has no head."""
    rows = [[_text(cell) for cell in row] for row in grid.rows]
    if not any(grid.head):
        return [{row[0]: row[1] for row in rows}]
    return [dict(zip(grid.head, row, strict=True)) for row in rows]


def _numbers(run: Saved) -> Any:
    """What the run's own file has of it [SI]."""
    file, keys = report_of(run).numbers
    if not file:
        return None
    table = read_json(run.folder / file)
    return {key: table[key] for key in keys if key in table} if keys else table


def _shown(run: Saved, content: SectionContent) -> Sequence[Block]:
    parts = {part.title: part.inside for part in content.parts}
    return next((parts[title] for title in report_of(run).shows if title in parts), ())


def _bullets(block: Bullets, width: int) -> Iterator[str]:
    for item in block.items:
        yield from textwrap.wrap(item, width, initial_indent="- ", subsequent_indent="  ")


def table(grid: Grid, columns: Sequence[str] = (), width: int = 100) -> Iterator[str]:
    """A table in columns of one width each: those that are named (none: all), as many as fit."""
    at = [grid.head.index(name) for name in columns if name in grid.head] or range(len(grid.head))
    cells = [[grid.head[i] for i in at], *([_text(row[i]) for i in at] for row in grid.rows)]
    digits = [all(_is_number(row[i]) for row in grid.rows) for i in at]
    wide = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    while sum(wide) + len(GAP) * (len(wide) - 1) > width and len(wide) > 2:
        wide.pop()
    for number, row in enumerate(cells):
        placed = (
            text.rjust(size) if right else text.ljust(size)
            for text, size, right in zip(row, wide, digits, strict=False)
        )
        yield GAP.join(placed).rstrip()
        if number == 0:
            yield GAP.join("─" * size for size in wide)


def _is_number(cell: Cell | str) -> bool:
    return isinstance(cell, Cell) and cell.look == "number"


def _text(cell: Cell | str) -> str:
    return cell.text if isinstance(cell, Cell) else cell
