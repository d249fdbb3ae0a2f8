"""Recorded against simulated, over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import Series
from ehbench.report.style import MUTED, RECORDED, SIMULATED, Look, canvas, key, legend, thin
from ehbench.report.words import axis, shown, title_of

_RECORDED: Look = {"color": RECORDED, "linewidth": 0.9}
_SIMULATED: Look = {"color": SIMULATED, "linewidth": 1.7, "linestyle": (0, (4, 1.6))}


def comparison(path: Path, rig: Rig, series: Series, channels: Sequence[str]) -> None:
    """A panel a channel, two in a row: recorded solid and thin, simulated dashed; below each the
    error (thesis Fig. 2.12).
    """
    both = {c for c in channels if c in series.recorded and c in series.simulated}
    columns = min(2, len(channels))
    rows = -(-len(channels) // columns)
    deep = 2 if both else 1
    size = (7.4, (2.7 if both else 2.0) * rows + 0.3)
    ratios = [3.4, 1] * rows if both else [1] * rows
    look = {"sharex": True, "squeeze": False, "height_ratios": ratios}
    with canvas(path, deep * rows, columns, size, **look) as (figure, axes):
        for place in range(rows * columns):
            top = deep * (place // columns)
            cells = axes[top : top + deep, place % columns]
            if place >= len(channels):
                for ax in cells:
                    ax.remove()
            else:
                last = place + columns >= len(channels)
                _panel(cells, rig, series, channels[place], last)
        handles = [key("recorded", **_RECORDED | {"linewidth": 1.0})] if series.recorded else []
        handles += [key("simulated", **_SIMULATED)] if series.simulated else []
        legend(figure, handles)


def _panel(cells: np.ndarray, rig: Rig, series: Series, channel: str, last: bool) -> None:
    """One channel, above its error if it has one; the last of a column names the time axis."""
    recorded, simulated = (
        shown(rig, channel, side.get(channel)) for side in (series.recorded, series.simulated)
    )
    main = bottom = cells[0]
    if recorded is not None:
        main.plot(*thin(series.t, recorded), **_RECORDED)
    if simulated is not None:
        main.plot(*thin(series.t, simulated), alpha=0.95, **_SIMULATED)
    main.set_title(axis(rig, channel, title_of(channel)))
    main.margins(y=0.08)
    if recorded is not None and simulated is not None:
        bottom, error = cells[1], simulated - recorded
        bottom.plot(*thin(series.t, error), color=MUTED, linewidth=0.8)
        bottom.axhline(0.0, color="#111827", linewidth=0.6)
        maximum = 1.1 * float(np.nanmax(np.abs(error), initial=1e-12))
        bottom.set_ylim(-maximum, maximum)
        bottom.set_ylabel("error", fontsize=8)
        bottom.locator_params(axis="y", nbins=3)
    elif len(cells) == 2:
        cells[1].remove()
    bottom.tick_params(labelbottom=last)
    if last:
        bottom.set_xlabel("time [s]")
