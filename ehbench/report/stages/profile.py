"""The profile likelihood of a parameter: its picture, where it crosses the 95 % level, and what the
other parameters do along it."""

from __future__ import annotations

from ehbench.report.blocks import Part
from ehbench.report.captions import range_of
from ehbench.report.content import Pictures, SectionContent, StageReport
from ehbench.report.figures import profile as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved
from ehbench.report.template import Template
from ehbench.report.words import estimate, number, shown


def draw(run: Saved, index: FigureIndex) -> None:
    """The profile."""
    result = run.json("profile.json")
    caption = Template("profile").text("caption")
    path = index.add("profile", f"Profile of {result['name']}", caption, FigureKey("profile"))
    figures.profile_curve(path, run.rig, result)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """Picture, ends and the others' values."""
    rig, result, page = run.rig, run.json("profile.json"), Template("profile", run.rig)
    name, limits = result["name"], result["ends"]
    best, *ends = (shown(rig, name, v) for v in (result["best"], *limits))
    texts = ["open" if end is None else number(end) for end in ends]
    by_fit = range_of(rig, name, result.get("interval"))
    rows = [("by the profile", " … ".join(texts)), ("by the fit", by_fit)]
    value = number(best) if None in ends else estimate(best, *ends)
    shape = page.text(result["shape"].replace(" ", "_"))
    inside = [page.table("ends", rows, name=name), *pictures(FigureKey("profile"))]
    sentence = page.text("sentence", result=result, value=value, shape=shape)
    return SectionContent("done", sentence, [Part("Profile", inside)])


REPORT = StageReport(
    "profile likelihood",
    section,
    draw,
    standing=0,
    shows=("Profile",),
    numbers=("profile.json", ()),
)
