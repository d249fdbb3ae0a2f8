"""Tuning of adaptive robust control: the bandwidths, and the margins that they keep."""

from __future__ import annotations

from ehbench.report.blocks import Block, Fold, Part, Text
from ehbench.report.captions import measure
from ehbench.report.content import OFTEN, Findings, Headline, Pictures, SectionContent, StageReport
from ehbench.report.figures import arc_tuning as figures
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved
from ehbench.report.stages.tuning import supply_blocks
from ehbench.report.template import Template
from ehbench.report.words import count, words
from ehbench.vocabulary.messages import message

_MARGINS = ("gain_margin", "phase_margin", "delay_margin")


def draw(run: Saved, index: FigureIndex) -> None:
    """The figure of a tuning."""
    rig, tuning = run.rig, run.json("tuning.json")
    title = f"Margins over the bandwidths: {words(tuning['cylinder'])}"
    caption = Template("arc_tuning", rig).text("caption", tuning=tuning)
    figures.margins(index.add("margins", title, caption, FigureKey("margins")), rig, tuning)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The bandwidths, the margins at the worst points, every operating point."""
    rig, tuning = run.rig, run.json("tuning.json")
    page, met, points = Template("arc_tuning", rig), tuning["met"], tuning["points"]
    inside: list[Block] = [
        Text(page.text("verdict", tuning=tuning), "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(FigureKey("margins")),
        page.table("margins", _MARGINS, tuning=tuning),
        page.table("gains", tuning["gains"].items()),
    ]
    every = Fold(f"All {count(len(points), 'operating point')}", [page.table("points", points)])
    parts = [Part("The bandwidths", inside), Part("Operating points", [every])]
    sentence = page.text("sentence", tuning=tuning)
    return SectionContent("met" if met else "missed", sentence, parts)


def findings(run: Saved) -> Findings:
    page, tuning = Template("headlines", run.rig), run.json("tuning.json")
    label = f"Delay margin, stated, {words(tuning['cylinder'])}"
    value = measure(run.rig, "delay_margin", tuning["delay_margin"], 2)
    numbers = [Headline(OFTEN, label, value, page.text("margins", tuning=tuning))]
    against = [] if tuning["met"] else [page.text("margins_missed")]
    steps = [message("steps.smaller_margins", reached=value)] if against else []
    return Findings(numbers, [FigureKey("margins")], against, steps)


REPORT = StageReport(
    "tuning",
    section,
    draw,
    findings,
    shows=("The bandwidths",),
    numbers=("tuning.json", ("met", "gains", *_MARGINS)),
)
