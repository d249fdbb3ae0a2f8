"""Tuning of adaptive robust control: the bandwidths, and the margins that they keep."""

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Fold, Part, Text
from ehbench.report.content import OFTEN, Findings, Headline, Pictures, SectionContent
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.stages.tuning import reached_demands, supply_blocks
from ehbench.report.style import ACCENT, CYCLE, MUTED, canvas, tag
from ehbench.report.template import Template
from ehbench.report.words import axis, measure, shown, words
from ehbench.vocabulary import message, plural

MARGINS = ("gain_margin", "phase_margin", "delay_margin")


def draw(run: Saved, index: FigureIndex) -> None:
    """The figure of a tuning."""
    rig, tuning = run.rig, run.json("tuning.json")
    title = f"Margins over the bandwidths: {words(tuning['cylinder'])}"
    caption = Template("arc_tuning", rig).text("caption", tuning=tuning)
    draw_margins(index.add("margins", title, caption, "margins"), rig, tuning)


def draw_margins(path: Path, rig: Rig, tuning: Table) -> None:
    """The stated delay margin and the gain margin at the worst points over the sum of bandwidths,
    with what is demanded and the choice; right of them the characteristic loci of the worst point,
    the unit circle and the critical point."""
    tried = tuning["candidates"]
    x = shown(rig, "position_bandwidth", np.array([item["sum"] for item in tried]))
    gains = np.array([item.get("gain_margin") or np.nan for item in tried], float)
    bandwidths = (tuning["gains"][f"{name}_bandwidth"] for name in ("position", "speed", "force"))
    chosen = shown(rig, "position_bandwidth", sum(bandwidths))
    delays = np.array([item.get("delay_margin", np.inf) for item in tried], float)
    minimum = shown(rig, "delay_margin", tuning["constraints"]["delay_margin"])
    with canvas(path, 1, 2, (9.0, 3.9), width_ratios=(1.25, 1.0)) as (_, (left, right)):
        y = shown(rig, "delay_margin", delays)
        left.plot(x, y, "o-", color=CYCLE[0], markersize=3.5, label="delay margin, stated")
        left.axhline(minimum, color=CYCLE[0], linewidth=1.0, linestyle=(0, (5, 3)))
        tag(left, "demanded", x[-1], minimum, (-46, 3))
        left.axvline(chosen, color=MUTED, linewidth=1.0, linestyle=(0, (2, 2)))
        tag(left, "chosen", chosen, 0.0, (3, 4))
        left.set_xlim(0.0, x[-1])
        left.set_ylim(0.0, 6.0 * minimum)
        left.set_xlabel(axis(rig, "position_bandwidth", "k₁ + k₂ + k₃"))
        left.set_ylabel(axis(rig, "delay_margin", "delay margin"), color=CYCLE[0])
        other = left.twinx()
        other.plot(x, gains, "s--", color=CYCLE[1], markersize=3.0)
        other.set_ylabel("gain margin [–]", color=CYCLE[1])
        other.set_ylim(0.0, 6.0 * tuning["constraints"]["gain_margin"])
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        look = {"color": MUTED, "linewidth": 0.8, "linestyle": (0, (2, 2))}
        right.plot(np.cos(turn), np.sin(turn), **look)
        for index, (real, imag) in enumerate(tuning["locus"]):
            right.plot(real, imag, color=CYCLE[index % len(CYCLE)], linewidth=1.2)
        right.plot([-1.0], [0.0], "x", color=ACCENT, markersize=7)
        tag(right, "swings", -1.0, 0.0, (-4, 6), ha="right")
        right.set(xlim=(-2.2, 2.2), ylim=(-2.2, 2.2), aspect="equal")
        right.set(xlabel="real part", ylabel="imaginary part")


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The bandwidths, the margins at the worst points, every operating point."""
    rig, tuning = run.rig, run.json("tuning.json")
    page, met, points = Template("arc_tuning", rig), tuning["met"], tuning["points"]
    inside: list[Block] = [
        Text(page.text("verdict", tuning=tuning), "good" if met else "bad"),
        *supply_blocks(rig, tuning),
        *pictures(kind="margins"),
        page.table("margins", MARGINS, tuning=tuning),
        page.table("gains", tuning["gains"].items()),
    ]
    every = Fold(f"All {plural(len(points), 'operating point')}", [page.table("points", points)])
    parts = [Part("The bandwidths", inside), Part("Operating points", [every])]
    sentence = page.text("sentence", tuning=tuning)
    return SectionContent("met" if met else "missed", sentence, parts)


def findings(run: Saved) -> Findings:
    page, tuning = Template("headlines", run.rig), run.json("tuning.json")
    label = f"Delay margin, stated, {words(tuning['cylinder'])}"
    value = measure(run.rig, "delay_margin", tuning["delay_margin"], 2)
    numbers = [Headline(OFTEN, label, value, page.text("margins", tuning=tuning))]
    against = [] if tuning["met"] else [page.text("margins_missed")]
    keys = reached_demands(run.rig, tuning["constraints"], tuning)
    steps = [message("steps.smaller_margins", keys=keys)] if against else []
    return Findings(numbers, [{"kind": "margins"}], against, steps)
