"""A frame of a live view as text for a terminal."""

from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from ehbench.live.board import VIEW, Facts
from ehbench.vocabulary import message


def screen(facts: Facts, frame: dict[str, Any]) -> Group:
    """A frame as lines of a terminal."""
    units = {word: unit for word, (unit, _) in facts.units.items()}
    ticks = max(frame["t"] * facts.rate, 1.0)
    state = frame["state"] if frame["state"] != "stopping" else f"stopping: {frame['stop']}"
    state += {None: "", True: ", operator", False: ", dead-man switch open"}[frame["held"]]
    fields = {name: getattr(facts, name) for name in ("title", "machine", "duration")}
    fields |= {"t": frame["t"], "late": frame["late"], "share": frame["late"] / ticks}
    head = Text(message("live.head", state=state, **fields))
    cylinders = Table(box=None, pad_edge=False)
    heads = ("x", "x_desired", "v", "v_desired", "p_head", "p_rod")
    cylinders.add_column("")
    cylinders.add_column("stroke", min_width=VIEW.width)
    for name in heads:
        label = f"{name} [{units[name]}]" if name in units else "desired"
        cylinders.add_column(Text(label), justify="right")
    cylinders.add_column("function")
    for row in frame["cylinders"]:
        share = 0.0 if row["x"] is None else row["x"] / row["stroke"]
        numbers = (_rounded(row[name]) for name in heads)
        cylinders.add_row(row["name"], _bar(share), *numbers, row["function"] or "")
    limits = Table(box=None, pad_edge=False)
    for name in ("limit", "", "nearest", "value", "margin", ""):
        limits.add_column(name, justify="right" if name in ("value", "margin") else "left")
    for row in frame["margins"]:
        style = "bold red" if (row["used"] or 0.0) > VIEW.near else ""
        cells = row["limit"], _bar(row["used"] or 0.0), row["channel"]
        shown = _rounded(row["value"]), _rounded(row["margin"]), row["unit"]
        limits.add_row(*cells, *shown, style=style)
    return Group(head, Text(), cylinders, Text(), limits)


def _bar(share: float) -> str:
    full = round(VIEW.width * min(max(share, 0.0), 1.0))
    return "█" * full + "░" * (VIEW.width - full)


def _rounded(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
