"""Tuning of adaptive robust control: the bandwidths, and the margins that they keep."""

from __future__ import annotations

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Cell, Fold, Grid, Part, Text
from ehbench.report.captions import load_name, measure
from ehbench.report.content import (
    Pictures,
    SectionContent,
    StageReport,
    num,
    quantity_cell,
)
from ehbench.report.figures import arc_tuning as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.tuning_words import supply_blocks
from ehbench.report.words import DASH, axis, count, number, pretty, unit_of, words

_MARGINS = ("gain_margin", "phase_margin", "delay_margin")


def draw(run: Saved, index: FigureIndex) -> None:
    """The figure of a tuning."""
    rig, tuning = run.rig, run.json("tuning.json")
    title = f"Margins over the bandwidths: {words(tuning['cylinder'])}"
    caption = (
        "Left: at the worst operating points, the delay margin as it is stated "
        f"(computed over {number(tuning['safety'])}; circles) and the gain margin (squares) over "
        "the sum of the bandwidths. "
        f"Right: characteristic loci of the loop at {tuning['worst']}, sensors late by "
        f"{measure(rig, 'delay', tuning['delay'])} and pressures behind a lag of "
        f"{measure(rig, 'lag', tuning['pressure_lag'])}."
    )
    figures.margins(index.add("margins", title, caption, FigureKey("margins")), rig, tuning)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The bandwidths, the margins at the worst points, every operating point."""
    rig, tuning = run.rig, run.json("tuning.json")
    met = tuning["met"]
    verdict = f"The demanded margins are {'kept' if met else 'not kept'} at every operating point."
    inside: list[Block] = [
        Text(verdict, "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(FigureKey("margins")),
        _margins(rig, tuning),
        _gains(rig, tuning),
    ]
    points = tuning["points"]
    every = Fold(f"All {count(len(points), 'operating point')}", [_points(rig, tuning)])
    parts = [Part("The bandwidths", inside), Part("Operating points", [every])]
    return SectionContent("met" if met else "missed", _sentence(rig, tuning), parts)


def _sentence(rig: Rig, tuning: Table) -> str:
    gains = tuning["gains"]
    names = ("position_bandwidth", "speed_bandwidth", "force_bandwidth")
    values = ", ".join(measure(rig, name, gains[name], 3) for name in names)
    points = count(len(tuning["points"]), "operating point")
    return (
        f"k₁, k₂, k₃ = {values}; at the worst of {points} of {words(tuning['cylinder'])}: "
        f"gain margin {number(tuning.get('gain_margin'), 3)}, phase "
        f"margin {measure(rig, 'phase_margin', tuning['phase_margin'], 2)}, stated delay margin "
        f"{measure(rig, 'delay_margin', tuning['delay_margin'], 2)}."
    )


def _margins(rig: Rig, tuning: Table) -> Grid:
    rows: list[list[Cell | str]] = [
        [
            words(name),
            pretty(unit_of(rig, name)),
            quantity_cell(rig, name, tuning["constraints"][name], 3),
            quantity_cell(rig, name, tuning.get(name), 3),
        ]
        for name in _MARGINS
    ]
    note = (
        f"The delay margin is the computed one over {number(tuning['safety'])}: a machine has "
        "hysteresis, noise and other oil than its model."
    )
    head = ["", "unit", "demanded at least", "reached at worst"]
    return Grid(head, rows, note, "margins", "Margins.")


def _gains(rig: Rig, tuning: Table) -> Grid:
    rows: list[list[Cell | str]] = [
        [words(name), quantity_cell(rig, name, value), pretty(unit_of(rig, name))]
        for name, value in tuning["gains"].items()
    ]
    return Grid(["gain", "value", "unit"], rows, "", "controller_parameters", "Gains.")


def _points(rig: Rig, tuning: Table) -> Grid:
    head = [
        "function",
        "payload",
        axis(rig, "x", "stroke"),
        axis(rig, "v", "speed"),
        *(axis(rig, name, words(name)) for name in _MARGINS),
        axis(rig, "natural_frequency", "would swing at"),
    ]
    rows: list[list[Cell | str]] = [
        [
            words(point["function"]),
            load_name(point["payload"]),
            quantity_cell(rig, "x", point["x"]),
            quantity_cell(rig, "v", point["v"], 3),
            *(_margin(rig, name, point.get(name)) for name in _MARGINS),
            quantity_cell(rig, "natural_frequency", point["frequency"], 3),
        ]
        for point in tuning["points"]
    ]
    return Grid(head, rows, f"{DASH}: nothing found that makes it swing.")


def _margin(rig: Rig, name: str, value: float | None) -> Cell:
    return num(DASH) if value is None else quantity_cell(rig, name, value, 3)


REPORT = StageReport(
    "tuning",
    section,
    draw,
    shows=("The bandwidths",),
    numbers=("tuning.json", ("met", "gains", *_MARGINS)),
)
