"""The profile likelihood of a parameter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas, key, legend, shades
from ehbench.report.words import axis, shown

LEVEL = 3.841  # χ² of one degree of freedom at 95 %


def profile(path: Path, rig: Rig, result: Table) -> None:
    """Rise of −2 log likelihood over the parameter, with the 95 % level; below, the other
    parameters relative to their values at its best.
    """
    name, others = result["name"], result["followed"].plain()
    x = np.asarray(shown(rig, name, np.array(result["values"])), float)
    rise = np.array(result["rise"])
    best = float(shown(rig, name, result["best"]))
    rows = 2 if others else 1
    ratios = [2.2, 1][:rows]
    look = {"sharex": True, "squeeze": False, "gridspec_kw": {"height_ratios": ratios}}
    with canvas(path, rows, 1, (7.2, 3.2 + 1.6 * (rows - 1)), **look) as (figure, axes):
        main = axes[0, 0]
        main.axhline(LEVEL, color=ACCENT, linewidth=0.9, linestyle=(0, (4, 3)))
        main.plot(x, rise, "-o", color=RECORDED, linewidth=1.4, markersize=4)
        ends = result.get("interval")
        if ends:
            low, high = (float(shown(rig, name, end)) for end in ends)
            _parabola(main, x, best, low, high)
            main.plot([low, high], [0.0, 0.0], color=RECORDED, linewidth=5, alpha=0.35)
        top = min(max(float(np.max(rise)), 1.5 * LEVEL), 5.0 * LEVEL)
        main.set_ylim(-0.15 * LEVEL, 1.05 * top)
        main.set_ylabel("rise of −2 log likelihood")
        handles = [
            key("profile", color=RECORDED, marker="o", markersize=4),
            key("by the fit's interval", color=MUTED, linestyle=(0, (2, 2))),
            key("95 %", color=ACCENT, linestyle=(0, (4, 3))),
        ]
        if others:
            handles += _others(axes[1, 0], x, rise, others)
        axes[-1, 0].set_xlabel(axis(rig, name, name))
        legend(figure, handles)


def _parabola(ax, x: np.ndarray, best: float, low: float, high: float) -> None:
    """The rise that the interval stands for, by its half on either side."""
    fine = np.linspace(x[0], x[-1], 201)
    half = np.where(fine < best, best - low, high - best)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = LEVEL * ((fine - best) / half) ** 2
    ax.plot(fine, rise, color=MUTED, linewidth=1.0, linestyle=(0, (2, 2)))


def _others(ax, x: np.ndarray, rise: np.ndarray, others) -> list:
    """Changes of the other parameters [%]; legend handles."""
    k, handles = int(np.argmin(rise)), []
    for (name, values), colour in zip(others.items(), shades(len(others)), strict=True):
        y = np.array(values, float)
        size = abs(y[k]) or float(np.max(np.abs(y))) or 1.0
        ax.plot(x, 100.0 * (y - y[k]) / size, color=colour, linewidth=1.2)
        handles.append(key(name, color=colour))
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.set_ylabel("others [%]", fontsize=8)
    return handles
