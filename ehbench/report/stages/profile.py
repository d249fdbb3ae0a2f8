"""The profile likelihood of a parameter: its picture, where it crosses the 95 % level, and what the
other parameters do along it."""

from __future__ import annotations

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Grid, Part
from ehbench.report.captions import range_of
from ehbench.report.content import Pictures, SectionContent, StageReport, num
from ehbench.report.figures import profile as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table
from ehbench.report.words import axis, estimate, number, pretty, shown, unit_of

_CAPTION = (
    "Rise of −2 log likelihood when the parameter is held and all others and the logs' starts are "
    "fitted again. Dashed: the parabola that the interval stands for. The profile's own 95 % "
    "interval lies where it crosses the level; bar: the fit's. Below, what the others do meanwhile."
)
_SHAPES = {
    "parabola": "it is a parabola: the interval means what it says",
    "lopsided": "it is lopsided: take its own interval",
    "open": "it does not reach the 95 % level on both sides: the logs set no end there",
    "two valleys": "it has two valleys: another value follows the logs nearly as well",
}


def draw(run: Saved, index: FigureIndex) -> None:
    """The profile."""
    result = run.json("profile.json")
    path = index.add("profile", f"Profile of {result['name']}", _CAPTION, FigureKey("profile"))
    figures.profile(path, run.rig, result)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Picture, ends and the others' values."""
    rig, result = run.rig, run.json("profile.json")
    parts = [Part("Profile", [_ends(rig, result), *pictures(FigureKey("profile"))])]
    return SectionContent("done", _sentence(rig, result), parts)


def _sentence(rig: Rig, result: Table) -> str:
    name, unit = result["name"], pretty(unit_of(rig, result["name"]))
    low, high = result["ends"]
    value = float(shown(rig, name, result["best"]))
    if low is None or high is None:
        text = number(value)
    else:
        text = estimate(value, *(float(shown(rig, name, end)) for end in (low, high)))
    return f"Profile of {name}, {text} {unit}".rstrip() + f": {_SHAPES[result['shape']]}."


def _ends(rig: Rig, result: Table) -> Block:
    name = result["name"]
    low, high = result["ends"]
    ends = ["open" if end is None else number(float(shown(rig, name, end))) for end in (low, high)]
    rows = [
        ["by the profile", num(f"{ends[0]} … {ends[1]}")],
        ["by the fit", num(range_of(rig, name, result.get("interval")))],
    ]
    return Grid(["95 % interval", axis(rig, name, name)], rows)


REPORT = StageReport(
    "profile likelihood",
    section,
    draw,
    standing=0,
    shows=("Profile",),
    numbers=("profile.json", ()),
)
