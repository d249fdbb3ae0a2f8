"""Frequency response: the Bode figure, delay and corner frequencies with their intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Bullets, Grid, Part
from ehbench.report.captions import capital
from ehbench.report.content import OFTEN, Findings, Headline, Pictures, SectionContent, StageReport
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table, read_columns
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas
from ehbench.report.template import Template
from ehbench.report.words import (
    interval,
    number,
    pretty,
    shown,
    unit_of,
    with_error,
)
from ehbench.vocabulary.terms import Z95

# key of response.json, what it is called, its unit there and on the page, the factor between them
NUMBERS = (
    ("delay", "delay by the phase's slope", "ms", 1.0e3),
    ("bandwidth", "gain 3 dB below its first", "Hz", 1.0),
    ("quadrature", "phase passes −90°", "Hz", 1.0),
)


def gain_unit(rig: Rig, table: Table) -> tuple[str, float]:
    """(unit in which this rig's people see the gain, what an SI gain is multiplied by)."""
    units, factors = [], []
    for side in ("output", "input"):
        name = table[side]
        unit = pretty(unit_of(rig, name))
        units.append(f"({unit})" if re.search("[/·]", unit) else unit)
        factors.append(float(shown(rig, name, 1.0)) - float(shown(rig, name, 0.0)))
    above, below = units
    return f"{above or '1'}/{below}" if below else above, factors[0] / factors[1]


def draw(run: Saved, index: FigureIndex) -> None:
    """The Bode figure."""
    table = run.json("response.json")
    title = f"{table['output']} over {table['input']}"
    caption = Template("response").text("caption")
    path = index.add("response", title, caption, FigureKey("response"))
    unit, factor = gain_unit(run.rig, table)
    columns = read_columns(run.folder / "response.csv")
    for name in ("gain", "gain_low", "gain_high"):
        columns[name] = columns[name] * factor
    bode(path, columns, table, unit)


def bode(path: Path, columns: dict[str, np.ndarray], table: Table, unit: str) -> None:
    """Gain, phase and coherence over frequency.

    Args:
        columns: of ``response.csv``, the gain in ``unit``.
        table: of ``response.json``.
    """
    frequency, coherent = columns["frequency"], columns["coherent"] > 0.5
    with canvas(path, 3, 1, (7.2, 6.4), sharex=True, height_ratios=(3, 3, 1.6)) as (_, axes):
        for ax, name in zip(axes[:2], ("gain", "phase"), strict=True):
            shown_at = np.where(coherent, columns[name], np.nan)
            known = np.isfinite(columns["phase_low"])
            rest = np.where(known & ~coherent, columns[name], np.nan)
            ax.plot(frequency, rest, ".", color="#c4c9d1", markersize=2.5)
            band = [np.where(coherent, columns[f"{name}_{end}"], np.nan) for end in ("low", "high")]
            ax.fill_between(frequency, *band, color=RECORDED, alpha=0.25, linewidth=0)
            ax.plot(frequency, shown_at, ".-", color=RECORDED, markersize=3.5)
        _frame_gain(axes[0], columns, coherent, f"Gain [{unit}]" if unit else "Gain")
        _frame_phase(axes[1], columns, coherent)
        axes[2].plot(frequency, columns["coherence"], color=RECORDED)
        axes[2].axhline(table["coherence_min"], color=MUTED, linewidth=1.0, linestyle="--")
        axes[2].set_ylim(0.0, 1.05)
        axes[2].set_title("Coherence")
        axes[2].set_xlabel("frequency [Hz]")
        for ax, key, text in ((axes[0], "bandwidth", "−3 dB"), (axes[1], "quadrature", "−90°")):
            if (result := table.get(key)) is not None:
                _mark(ax, result["value"], text)


def _frame_gain(ax, columns: dict[str, np.ndarray], coherent: np.ndarray, title: str) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
    ax.yaxis.set_major_formatter(lambda tick, _: number(tick))
    known = columns["gain"][coherent]
    ax.set_ylim(known.min() / 3.0, known.max() * 3.0)
    ax.set_title(title)


def _frame_phase(ax, columns: dict[str, np.ndarray], coherent: np.ndarray) -> None:
    known = columns["phase"][coherent]
    low = 90.0 * math.floor((known.min() - 20.0) / 90.0)
    high = 90.0 * math.ceil((known.max() + 20.0) / 90.0)
    step = 90.0 * max(1, math.ceil((high - low) / 90.0 / 6.0))
    ax.set_ylim(low, high)
    ax.set_yticks(np.arange(high, low - 1.0, -step))
    ax.set_title("Phase [°]")


def _mark(ax, frequency: float, text: str) -> None:
    """A line at a frequency with its name above the panel."""
    ax.axvline(frequency, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
    where = ("data", "axes fraction")
    right = frequency < math.sqrt(math.prod(ax.get_xlim()))  # the half with room for the name
    look = {"color": ACCENT, "fontsize": 8, "va": "top", "ha": "left" if right else "right"}
    text = f"{text}: {number(frequency, 3)} Hz"
    ax.annotate(text, (frequency, 1.0), (3 if right else -3, -2), where, "offset points", **look)


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
    uses = {"poles": _poles, "delay": _delay}
    tables = [page.table("numbers", NUMBERS, table=table, ends=_ends)]
    tables += [page.table("forms", forms, logs=table["logs"], **uses)] if forms else []
    parts = [
        Part("Bode diagram", pictures(FigureKey("response"))),
        Part("Numbers", tables),
        Part("How it was averaged", [Grid(["", ""], averaged)]),
    ]
    if warnings := table["warnings"]:
        parts.append(Part("Warnings", [Bullets(warnings, "warn")]))
    form = next((form for form in forms if form["preferred"]), None)
    sentence = page.text("sentence", table=table, numbers=NUMBERS, form=form, **uses)
    return SectionContent("done", sentence, parts)


def _poles(form: Table) -> str:
    """Poles [rad/s] of a form, each with half its 95 % interval."""
    pairs = zip(form["poles"], form["pole_stds"], strict=True)
    return ", ".join(with_error(pole, Z95 * std) for pole, std in pairs)


def _delay(form: Table) -> str:
    """Delay [ms] of a form with half its 95 % interval."""
    return with_error(1e3 * form["delay"], 1e3 * Z95 * form["delay_std"])


def _ends(ends: Sequence[float | None], factor: float) -> str:
    low, high = (None if end is None else factor * end for end in ends)
    return f"below {number(high, 3)}" if low is None else interval(low, high)


def findings(run: Saved) -> Findings:
    table, numbers = run.json("response.json"), []
    for key, label, unit, factor in NUMBERS:
        if (result := table.get(key)) is not None:
            ends = [None if end is None else factor * end for end in result["interval"]]
            about = Template("headlines").text("interval", ends=ends, unit=unit)
            value = f"{number(factor * result['value'], 3)} {unit}"
            numbers.append(Headline(OFTEN, capital(label), value, about))
    return Findings(numbers, [FigureKey("response")], table["warnings"])


REPORT = StageReport(
    "frequency response", section, draw, findings, shows=("Numbers",), numbers=("response.json", ())
)
