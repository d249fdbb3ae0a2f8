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
            name = item["name"]
            known = [item.number(key) for key in ("value", "start", "lower", "upper")]
            value, start, low, high, *ends = (
                None if v is None or not np.isfinite(v) else shown(rig, name, v)
                for v in (*known, *(item.get("interval") or (None, None)))
            )
            known = [v for v in (value, start, low, high, *ends) if v is not None]
            left, right = min(known), max(known)
            if left > 0.0 and right / left > 30.0:
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
                room = (right / left) ** 0.03
                left, right = left / room, right * room
            else:
                room = 0.03 * ((right - left) or abs(right) or 1.0)
                left, right = left - room, right + room
            ax.set(xlim=(left, right), ylim=(-1, 1), yticks=[])
            bounds = [left if low is None else low, right if high is None else high]
            ax.plot(bounds, [0, 0], color="#d1d5db", linewidth=7, solid_capstyle="butt")
            if None not in ends:
                ax.plot(ends, [0, 0], color=RECORDED, linewidth=3, solid_capstyle="butt")
            hollow = {"markerfacecolor": "white", "markeredgecolor": MUTED, "markeredgewidth": 1.2}
            ax.plot([start], [0], "o", markersize=6, **hollow)
            colour = RECORDED if item["status"] == "estimated" else ACCENT
            ax.plot([value], [0], "o", markersize=5.5, color=colour)
            ax.spines["left"].set_visible(False)
            ax.tick_params(axis="x", labelsize=7.5, pad=1)
            text = f"{as_fitted(rig, name, item)} {pretty(unit_of(rig, name))}".rstrip()
            ax.set_title(f"{name}   {text}", fontsize=8.5, pad=2)
            status = {"fontsize": 8, "pad": 2, "color": colour, "fontweight": "normal"}
            ax.set_title(words(item["status"]), loc="right", **status)
