"""Frequency response: the Bode figure, delay and corner frequencies with their intervals."""

import math
import re
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Bullets, Grid, Part
from ehbench.report.content import OFTEN, Findings, Headline, Pictures, SectionContent
from ehbench.report.saved import FigureIndex, Saved, Table, read_columns
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas, tag
from ehbench.report.template import Template
from ehbench.report.words import capital, number, pretty, shown, unit_of
from ehbench.vocabulary import message

# key of response.json, what it is called, its unit there and on the page, the factor between them
NUMBERS = (
    ("delay", "delay by the phase's slope", "ms", 1.0e3),
    ("bandwidth", "bandwidth at −3 dB", "Hz", 1.0),
    ("quadrature", "frequency at −90°", "Hz", 1.0),
)


def gain_unit(rig: Rig, table: Table) -> tuple[str, float]:
    """(unit in which this rig's people see the gain, what an SI gain is multiplied by)."""
    units, factors = [], []
    for side in ("output", "input"):
        name = table[side]
        unit = pretty(unit_of(rig, name))
        units.append(f"({unit})" if re.search("[/·]", unit) else unit)
        factors.append(shown(rig, name, 1.0) - shown(rig, name, 0.0))
    above, below = units
    return f"{above or '1'}/{below}" if below else above, factors[0] / factors[1]


def draw(run: Saved, index: FigureIndex) -> None:
    """The Bode figure."""
    table = run.json("response.json")
    title = f"{table['output']} over {table['input']}"
    caption = Template("response").text("caption")
    path = index.add("response", title, caption, "response")
    unit, factor = gain_unit(run.rig, table)
    columns = read_columns(run.folder / "response.csv")
    for name in ("gain", "gain_low", "gain_high"):
        columns[name] = columns[name] * factor
    bode(path, columns, table, unit)


def bode(path: Path, columns: dict[str, np.ndarray], table: Table, unit: str) -> None:
    """Gain [``unit``], phase and coherence over frequency, of ``response.csv`` and ``.json``."""
    frequency, coherent = columns["frequency"], columns["coherent"] > 0.5
    others = np.isfinite(columns["phase_low"]) & ~coherent
    with canvas(path, 3, 1, (7.2, 6.4), sharex=True, height_ratios=(3, 3, 1.6)) as (_, axes):
        gain, phase, coherence = axes
        for ax, name in ((gain, "gain"), (phase, "phase")):
            faint = np.where(others, columns[name], np.nan)
            ax.plot(frequency, faint, ".", color="#c4c9d1", markersize=2.5)
            band = [np.where(coherent, columns[f"{name}_{end}"], np.nan) for end in ("low", "high")]
            ax.fill_between(frequency, *band, color=RECORDED, alpha=0.25, linewidth=0)
            y = np.where(coherent, columns[name], np.nan)
            ax.plot(frequency, y, ".-", color=RECORDED, markersize=3.5)
        gain.set(xscale="log", yscale="log", title=f"Gain [{unit}]" if unit else "Gain")
        for way in (gain.xaxis, gain.yaxis):
            way.set_major_formatter(lambda tick, _: number(tick))
        known = columns["gain"][coherent]
        gain.set_ylim(known.min() / 3.0, known.max() * 3.0)
        known = columns["phase"][coherent]
        low = 90.0 * math.floor((known.min() - 20.0) / 90.0)
        high = 90.0 * math.ceil((known.max() + 20.0) / 90.0)
        step = 90.0 * max(1, math.ceil((high - low) / 90.0 / 6.0))
        phase.set(ylim=(low, high), yticks=np.arange(high, low - 1.0, -step), title="Phase [°]")
        coherence.plot(frequency, columns["coherence"], color=RECORDED)
        coherence.axhline(table["coherence_min"], color=MUTED, linewidth=1.0, linestyle="--")
        coherence.set(ylim=(0.0, 1.05), title="Coherence", xlabel="frequency [Hz]")
        for ax, name, text in ((gain, "bandwidth", "−3 dB"), (phase, "quadrature", "−90°")):
            if (result := table.get(name)) is not None:
                x = result["value"]
                ax.axvline(x, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
                text = f"{text}: {number(x, 3)} Hz"
                right = x < math.sqrt(math.prod(ax.get_xlim()))  # the half with room for the name
                side, off = ("left", 3) if right else ("right", -3)
                tag(ax, text, x, 1.0, (off, -2), "y", color=ACCENT, va="top", ha=side)


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """The figure, the numbers with their intervals, how it was averaged, warnings."""
    table, page = run.json("response.json"), Template("response")
    averaged = [
        ["logs", ", ".join(table["logs"])],
        ["segments", page.text("segments", table=table)],
        ["independent averages", number(table["averages"], 4)],
        ["coherent frequencies", page.text("coherent", table=table)],
        ["coherence of noise alone", page.text("noise", table=table)],
    ]
    forms = table.get("transfers", [])
    # forms were asked for, and a terminal shows one table: the sentence has the other's numbers
    tables = [page.table("forms", forms, logs=table["logs"])] if forms else []
    tables += [page.table("numbers", NUMBERS, table=table)]
    parts = [
        Part("Bode diagram", pictures(kind="response")),
        Part("Numbers", tables),
        Part("How it was averaged", [Grid(["", ""], averaged)]),
    ]
    if warnings := table["warnings"]:
        parts.append(Part("Warnings", [Bullets(warnings, "warn")]))
    form = next((item for item in forms if item["preferred"]), None)
    sentence = page.text("sentence", table=table, numbers=NUMBERS, form=form)
    return SectionContent("done", sentence, parts)


def findings(run: Saved) -> Findings:
    table, numbers = run.json("response.json"), []
    for key, label, unit, factor in NUMBERS:
        if (result := table.get(key)) is not None:
            ends = [None if end is None else factor * end for end in result["interval"]]
            about = Template("headlines").text("interval", ends=ends, unit=unit)
            value = f"{number(factor * result['value'], 3)} {unit}"
            numbers.append(Headline(OFTEN, capital(label), value, about))
    steps = [] if "transfers" in table else [message("steps.forms")]
    return Findings(numbers, [{"kind": "response"}], table["warnings"], steps)
