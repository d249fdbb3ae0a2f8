"""Frequency response: the Bode figure, delay and corner frequencies with their intervals."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Bullets, Cell, Grid, Part
from ehbench.report.content import Pictures, SectionContent, StageReport, num
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Table, read_columns
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas
from ehbench.report.words import (
    count,
    interval,
    number,
    pretty,
    shown,
    unit_of,
    with_error,
)
from ehbench.vocabulary.terms import Z95

_CAPTION = (
    "Gain, phase and coherence by Welch averaging, with 95 % intervals. "
    "Grey: frequencies below the coherence asked for (dashed); they do not count."
)
# key of response.json, what it is called, its unit there and on the page, the factor between them
_NUMBERS = (
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
    path = index.add("response", title, _CAPTION, FigureKey("response"))
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
    """The figure, the numbers with their intervals, how it was averaged, what is to be said."""
    table = run.json("response.json")
    rows = [_number_row(table, *item) for item in _NUMBERS]
    low, high = table["coherent_range"]
    averaged = [
        ["logs", ", ".join(table["logs"])],
        ["segments", f"{number(table['segment'], 4)} s, window {table['window']}"],
        ["independent averages", number(table["averages"], 4)],
        [
            "coherent frequencies",
            f"{table['coherent']} of {table['frequencies']}, {number(low)} … {number(high)} Hz",
        ],
        ["coherence of noise alone", f"below {number(table['coherence_noise'], 2)} in 95 %"],
    ]
    forms = [_forms(table["logs"], transfers)] if (transfers := table.get("transfers", [])) else []
    parts = [
        Part("Bode diagram", pictures(FigureKey("response"))),
        Part("Numbers", [Grid(["", "value", "95 % interval", "unit"], rows), *forms]),
        Part("How it was averaged", [Grid(["", ""], averaged)]),
    ]
    if warnings := table["warnings"]:
        parts.append(Part("What is to be said", [Bullets(warnings, "warn")]))
    return SectionContent("done", _sentence(table), parts)


def _forms(logs: Sequence[str], forms: Sequence[Table]) -> Grid:
    """Transfer functions fitted in time, the preferred first."""
    head = ["form", "poles [rad/s]", "delay [ms]", *(f"fit of {log} [%]" for log in logs), ""]
    rows: list[list[Cell | str]] = []
    for form in forms:
        poles, delay = _poles_and_delay(form)
        fits = [num(number(fit, 4)) for fit in form["fit_percent"]]
        words = "preferred" if form["preferred"] else ""
        rows.append([form["form"], num(poles), num(delay), *fits, words])
    note = (
        "Fitted to the logs in time, each with an offset of its own; ± is half the width of the "
        "95 % interval. Preferred: of the forms within 1 % of the best fit those with the fewest "
        "numbers, and of them the best."
    )
    return Grid(head, rows, note)


def _poles_and_delay(form: Table) -> tuple[str, str]:
    """Poles [rad/s] and delay [ms] of a form, each with half its 95 % interval; – for no delay."""
    poles = ", ".join(
        with_error(w, Z95 * std) for w, std in zip(form["poles"], form["pole_stds"], strict=True)
    )
    if form.get("delay") is None:
        return poles, "–"
    return poles, with_error(1e3 * form["delay"], 1e3 * Z95 * form["delay_std"])


def _preferred(forms: Sequence[Table]) -> str:
    """The form that is preferred, in words."""
    item = next(form for form in forms if form["preferred"])
    poles, delay = _poles_and_delay(item)
    late = "" if delay == "–" else f" and {delay} ms"
    fits = ", ".join(number(fit, 3) for fit in item["fit_percent"])
    return f" Of the plain forms {item['form']} is preferred, {poles} rad/s{late}: fit {fits} %."


def _number_row(table: Table, key: str, text: str, unit: str, factor: float) -> list[Cell | str]:
    result = table.get(key)
    if result is None:
        return [text, num("–"), num("the data do not show it"), unit]
    ends = [None if end is None else factor * end for end in result["interval"]]
    return [text, num(number(factor * result["value"], 4)), num(_span(ends)), unit]


def _span(ends: list[float | None]) -> str:
    low, high = ends
    return f"below {number(high, 3)}" if low is None else interval(low, high)


def _sentence(table: Table) -> str:
    low, high = table["coherent_range"]
    parts = [
        f"{text} {number(factor * result['value'], 3)} {unit}"
        for key, text, unit, factor in _NUMBERS
        if (result := table.get(key)) is not None
    ]
    lead = (
        f"{table['output']} over {table['input']} from {count(len(table['logs']), 'log')}, "
        f"coherent from {number(low, 3)} to {number(high, 3)} Hz"
    )
    message = f"{lead}: {', '.join(parts)}." if parts else f"{lead}."
    return message + (_preferred(forms) if (forms := table.get("transfers")) else "")


REPORT = StageReport(
    "frequency response", section, draw, shows=("Numbers",), numbers=("response.json", ())
)
