"""Identified parameters within their bounds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.captions import as_fitted
from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, canvas
from ehbench.report.words import number, pretty, shown, unit_of, words


def parameters(path: Path, rig: Rig, result: Sequence[Table]) -> None:
    """A strip a parameter, each in its unit: value with 95 % interval on the bounds of the search,
    and its start.
    """
    size = (7.2, 0.72 * len(result) + 0.3)
    with canvas(path, len(result), 1, size, squeeze=False) as (_, axes):
        for ax, item in zip(axes[:, 0], result, strict=True):
            _strip(ax, rig, item)


def _strip(ax, rig: Rig, item: Table) -> None:
    name = item["name"]
    value, start, low, high = (
        _finite(rig, name, item.number(key)) for key in ("value", "start", "lower", "upper")
    )
    ends = [_finite(rig, name, end) for end in item.get("interval") or (None, None)]
    _frame(ax, [v for v in (value, start, low, high, *ends) if v is not None])
    left, right = ax.get_xlim()
    bounds = [left if low is None else low, right if high is None else high]
    ax.plot(bounds, [0, 0], color="#d1d5db", linewidth=7, solid_capstyle="butt")
    if None not in ends:
        ax.plot(ends, [0, 0], color=RECORDED, linewidth=3, solid_capstyle="butt")
    hollow = {"markerfacecolor": "white", "markeredgecolor": MUTED, "markeredgewidth": 1.2}
    ax.plot([start], [0], "o", markersize=6, **hollow)
    colour = RECORDED if item["status"] == "estimated" else ACCENT
    ax.plot([value], [0], "o", markersize=5.5, color=colour)
    ax.set_yticks([])
    ax.set_ylim(-1, 1)
    ax.spines["left"].set_visible(False)
    ax.tick_params(axis="x", labelsize=7.5, pad=1)
    text = f"{as_fitted(rig, name, item)} {pretty(unit_of(rig, name))}".rstrip()
    ax.set_title(f"{name}   {text}", fontsize=8.5, pad=2)
    status = {"fontsize": 8, "pad": 2, "color": colour, "fontweight": "normal"}
    ax.set_title(words(item["status"]), loc="right", **status)


def _frame(ax, known: Sequence[float]) -> None:
    """Limits with a little room; a logarithmic axis where the numbers lie a factor 30 apart."""
    minimum, maximum = min(known), max(known)
    if minimum > 0.0 and maximum / minimum > 30.0:
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
        room = (maximum / minimum) ** 0.03
        ax.set_xlim(minimum / room, maximum * room)
    else:
        room = 0.03 * ((maximum - minimum) or abs(maximum) or 1.0)
        ax.set_xlim(minimum - room, maximum + room)


def _finite(rig: Rig, name: str, value: float | None) -> float | None:
    """An SI number in the rig's unit; None where it is not finite."""
    return None if value is None or not np.isfinite(value) else float(shown(rig, name, value))
