"""The profile likelihood of a parameter: picture, ends, the other parameters along it."""

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Part
from ehbench.report.content import Pictures, SectionContent
from ehbench.report.saved import FigureIndex, Saved, Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas, key, legend, shades
from ehbench.report.template import Template
from ehbench.report.words import axis, estimate, number, range_of, shown
from ehbench.vocabulary import Z95


def draw(run: Saved, index: FigureIndex) -> None:
    """The profile."""
    result = run.json("profile.json")
    caption = Template("profile").text("caption")
    path = index.add("profile", f"Profile of {result['name']}", caption, "profile")
    draw_curve(path, run.rig, result)


def draw_curve(path: Path, rig: Rig, result: Table) -> None:
    """Rise of −2 log likelihood with the 95 % level; below, the other parameters."""
    name, others = result["name"], result["followed"]
    x, rise = shown(rig, name, np.array(result["values"])), np.array(result["rise"])
    rows, level = (2 if others else 1), Z95**2
    dotted, dashed = (0, (2, 2)), (0, (4, 3))
    look = {"sharex": True, "squeeze": False, "height_ratios": [2.2, 1][:rows]}
    with canvas(path, rows, 1, (7.2, 3.2 + 1.6 * (rows - 1)), **look) as (figure, axes):
        main = axes[0, 0]
        main.axhline(level, color=ACCENT, linewidth=0.9, linestyle=dashed)
        main.plot(x, rise, "-o", color=RECORDED, linewidth=1.4, markersize=4)
        if ends := result.get("interval"):
            best, low, high = (shown(rig, name, v) for v in (result["best"], *ends))
            fine = np.linspace(x[0], x[-1], 201)
            half = np.where(fine < best, best - low, high - best)
            with np.errstate(divide="ignore", invalid="ignore"):
                meant = level * ((fine - best) / half) ** 2  # what the interval stands for
            main.plot(fine, meant, color=MUTED, linewidth=1.0, linestyle=dotted)
            main.plot([low, high], [0.0, 0.0], color=RECORDED, linewidth=5, alpha=0.35)
        top = min(max(float(np.max(rise)), 1.5 * level), 5.0 * level)
        main.set_ylim(-0.15 * level, 1.05 * top)
        main.set_ylabel("rise of −2 log likelihood")
        handles = [
            key("profile", color=RECORDED, marker="o", markersize=4),
            key("by the fit's interval", color=MUTED, linestyle=dotted),
            key("95 %", color=ACCENT, linestyle=dashed),
        ]
        if others:
            below, k = axes[1, 0], int(np.argmin(rise))
            for (other, values), colour in zip(others.items(), shades(len(others)), strict=True):
                y = np.array(values, float)
                size = abs(y[k]) or float(np.max(np.abs(y))) or 1.0
                below.plot(x, 100.0 * (y - y[k]) / size, color=colour, linewidth=1.2)
                handles.append(key(other, color=colour))
            below.axhline(0.0, color=MUTED, linewidth=0.8)
            below.set_ylabel("others [%]", fontsize=8)
        axes[-1, 0].set_xlabel(axis(rig, name, name))
        legend(figure, handles)


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
    inside = [page.table("ends", rows, name=name), *pictures(kind="profile")]
    sentence = page.text("sentence", result=result, value=value, shape=shape)
    return SectionContent("done", sentence, [Part("Profile", inside)])
