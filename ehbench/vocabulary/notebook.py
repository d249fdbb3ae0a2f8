"""Words and tables with which a rig, a record and the outcome of a run show themselves."""

from collections.abc import Iterable, Sequence
from html import escape

from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.units import from_si


def plural(count: int, word: str) -> str:
    """``1 joint``, ``2 joints``."""
    return f"{count} {word}" + ("" if count == 1 else "s")


def shown(value: float | None, name: str, unit: str) -> str:
    """A number of a quantity [SI] in a unit, four digits; nothing where there is none."""
    return "" if value is None else f"{from_si(value, unit, quantity(name)):.4g}"


def label(unit: str) -> str:
    """A unit as a table has it: nothing for a number without one."""
    return "" if unit == "dimensionless" else unit


def table(header: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """An HTML table; the cells are plain text."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
