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
    for function in tuning.get("functions", []):
        title = f"{capital(words(function['name']))}: {words(cylinder)}"
        about = FigureKey("function", function=function["name"], cylinder=cylinder)
        path = index.add(f"function_{function['name']}", title, function_caption(function), about)
        circuit(path, function)


def function_caption(item: Table) -> str:
    """What is open, what meters, what is shut."""
    opened = [edge["name"] for edge in item["edges"] if edge["way"]]
    shut = [edge["name"] for edge in item["edges"] if not edge["way"]]
    text = f"Open: {', '.join(opened)}; {_metering(item)['name']} (red) sets the motion"
    return text + (f"; shut, dashed: {', '.join(shut)}." if shut else ".")


def _metering(item: Table) -> Table:
    return next(edge for edge in item["edges"] if edge["meters"])


def function_tables(rig: Rig, tuning: Table) -> list[Block]:
    """Which working function is chosen when, and what each does."""
    functions = tuning.get("functions", [])
    if not functions:
        return []
    return [_selection(rig, functions), _cylinder_functions(functions)]


def _selection(rig: Rig, functions: Sequence[Table]) -> Grid:
    rows: list[list[Cell | str]] = [["hold", "none", "any", "", num("0")]]
    for function in sorted(functions, key=lambda item: (-item["direction"], item["along"])):
        rows.append(
            [
                words(function["name"]),
                "extend" if function["direction"] > 0 else "retract",
                "along the motion" if function["along"] else "against the motion",
                _condition(function),
                num(number(float(shown(rig, "area_head", function["draws"])), 4)),
            ]
        )
    drawn = axis(rig, "area_head", "oil from the supply for a way made")
    head = ["function", "desired motion", "load", "only where", drawn]
    note = (
        "Of those that suit, the one that draws least from the supply; the margins are rules of "
        "the recipe."
    )
    if any(function["name"] == _SEVENTH for function in functions):
        note += f" {capital(words(_SEVENTH))} is chosen only where they allow it."
    return Grid(head, rows, note, "function_selection", "Function selection.")


def _condition(item: Table) -> str:
    """What beside motion and load a working function needs."""
    if item["name"] == _SEVENTH:
        return "the supply carries the load on A₁ − A₂, with a margin; allowed"
    if not item["cross"]:
        return "" if item["along"] else "the supply carries the load"
    start, stop = item["cross"].split("_")
    return f"p_{start} > p_{stop} + margin, and the edge between them carries A₂ |v|"


def _cylinder_functions(functions: Sequence[Table]) -> Grid:
    rows: list[list[Cell | str]] = []
    for function in functions:
        opened = [edge for edge in function["edges"] if edge["way"]]
        meters = _metering(function)
        rows.append(
            [
                words(function["name"]),
                ", ".join(edge["name"] for edge in opened),
                f"{meters['name']} ({function['metered']} end), {flow_words(meters)}",
                "; ".join(f"{e['name']}, {flow_words(e)}" for e in opened if not e["meters"]),
            ]
        )
    head = ["function", "open", "sets the motion", "the other chamber"]
    note = "Steady flows; A₁ head area, A₂ rod area, v speed."
    return Grid(head, rows, note, "cylinder_functions", "Cylinder functions.")
