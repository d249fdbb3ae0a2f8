"""The working functions of a cylinder's circuit: which is chosen when, what each opens, a figure of
each (thesis Tables 3.1, 3.2, Figs. 4.1 to 4.6).
"""

from __future__ import annotations

from collections.abc import Sequence

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Grid
from ehbench.report.captions import capital
from ehbench.report.content import num
from ehbench.report.figures.circuit import circuit, flow_words
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Table
from ehbench.report.words import axis, number, shown, words
from ehbench.vocabulary.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS

_SEVENTH = FUNCTIONS[EXTEND_RESISTIVE_REGENERATION]


def draw_functions(tuning: Table, index: FigureIndex) -> None:
    """A figure of each working function that the cylinder's circuit can do."""
    cylinder = tuning["cylinder"]
    for one in tuning.get("functions", []):
        title = f"{capital(words(one['name']))}: {words(cylinder)}"
        about = FigureKey("function", function=one["name"], cylinder=cylinder)
        path = index.add(f"function_{one['name']}", title, function_caption(one), about)
        circuit(path, one)


def function_caption(one: Table) -> str:
    """What is open, what meters, what is shut."""
    opened = [edge["name"] for edge in one["edges"] if edge["way"]]
    shut = [edge["name"] for edge in one["edges"] if not edge["way"]]
    text = f"Open: {', '.join(opened)}; {_metering(one)['name']} (red) sets the motion"
    return text + (f"; shut, dashed: {', '.join(shut)}." if shut else ".")


def _metering(one: Table) -> Table:
    return next(edge for edge in one["edges"] if edge["meters"])


def function_tables(rig: Rig, tuning: Table) -> list[Block]:
    """Which working function is chosen when, and what each does."""
    functions = tuning.get("functions", [])
    if not functions:
        return []
    return [_selection(rig, functions), _cylinder_functions(functions)]


def _selection(rig: Rig, functions: Sequence[Table]) -> Grid:
    rows: list[list[Cell | str]] = [["hold", "none", "any", "", num("0")]]
    for one in sorted(functions, key=lambda one: (-one["direction"], one["along"])):
        rows.append(
            [
                words(one["name"]),
                "extend" if one["direction"] > 0 else "retract",
                "along the motion" if one["along"] else "against the motion",
                _condition(one),
                num(number(float(shown(rig, "area_head", one["draws"])), 4)),
            ]
        )
    drawn = axis(rig, "area_head", "oil from the supply for a way made")
    head = ["function", "desired motion", "load", "only where", drawn]
    note = (
        "Of those that suit, the one that draws least from the supply; the margins are rules of "
        "the recipe."
    )
    if any(one["name"] == _SEVENTH for one in functions):
        note += f" {capital(words(_SEVENTH))} is chosen only where they allow it."
    return Grid(head, rows, note, "function_selection", "Function selection.")


def _condition(one: Table) -> str:
    """What beside motion and load a working function needs."""
    if one["name"] == _SEVENTH:
        return "the supply carries the load on A₁ − A₂, with a margin; allowed"
    if not one["cross"]:
        return "" if one["along"] else "the supply carries the load"
    start, stop = one["cross"].split("_")
    return f"p_{start} > p_{stop} + margin, and the edge between them carries A₂ |v|"


def _cylinder_functions(functions: Sequence[Table]) -> Grid:
    rows: list[list[Cell | str]] = []
    for one in functions:
        opened = [edge for edge in one["edges"] if edge["way"]]
        meters = _metering(one)
        rows.append(
            [
                words(one["name"]),
                ", ".join(edge["name"] for edge in opened),
                f"{meters['name']} ({one['metered']} end), {flow_words(meters)}",
                "; ".join(f"{e['name']}, {flow_words(e)}" for e in opened if not e["meters"]),
            ]
        )
    head = ["function", "open", "sets the motion", "the other chamber"]
    note = "Steady flows; A₁ head area, A₂ rod area, v speed."
    return Grid(head, rows, note, "cylinder_functions", "Cylinder functions.")
