"""What identification and validation share: recorded against simulated, and ringing side by
side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Grid
from ehbench.report.figures.comparison import comparison
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Series, Table
from ehbench.report.template import Template
from ehbench.report.words import words

_TWINS = {"x": "q", "v": "qd"}  # a joint's angle and its cylinder's stroke say the same


def draw_comparisons(
    run: Saved, index: FigureIndex, log: str, kind: str, lead: str, off: float = 0.1
) -> None:
    """A figure for each cylinder of a log, recorded against simulated.

    Args:
        kind: of the figure: ``fit`` leaves a stroke out where its joint's angle is there.
        lead: what the title begins with.
        off: share of a channel's range that is far off.
    """
    series = run.series(log)
    if series is None:
        return
    page = Template("comparisons", run.rig)
    for cylinder, channels in series.cylinders().items():
        if kind == "fit":
            channels = [
                channel
                for channel in channels
                if f"{cylinder}.{_TWINS.get(channel.rpartition('.')[2])}" not in channels
            ]
        caption = page.text(
            "caption",
            simulated=any(channel in series.simulated for channel in channels),
            lasting=lasting(series, channels, off),
            off=off,
        )
        title = f"{lead}: {words(log)}" + (f", {cylinder}" if cylinder else "")
        about = FigureKey(kind, log=log, cylinder=cylinder)
        path = index.add(f"{kind}_{log}_{cylinder}", title, caption, about)
        comparison(path, run.rig, series, channels)


def lasting(
    series: Series, channels: Sequence[str], off: float = 0.1, long: float = 0.2
) -> list[tuple[str, float]]:
    """(channel, longest time [s]) of each whose simulation lies off to one side of the recording
    for a share ``long`` of the log.
    """
    lasting = []
    for channel in channels:
        if channel not in series.recorded or channel not in series.simulated:
            continue
        recorded = series.recorded[channel]
        error = series.simulated[channel] - recorded
        limit = off * float(np.ptp(recorded[np.isfinite(recorded)], axis=0))
        longest = max(_longest(series.t, side * error > limit) for side in (-1.0, 1.0))
        if limit > 0.0 and longest >= long * float(series.t[-1] - series.t[0]):
            lasting.append((channel, longest))
    return lasting


def _longest(t: np.ndarray, mask: np.ndarray) -> float:
    """The longest stretch of time [s] in which a mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    ends = np.minimum(edges[1::2], t.size - 1)
    return float(np.max(t[ends] - t[edges[::2]], initial=0.0))


def ringing_table(rig: Rig | None, matches: Sequence[Table], with_log: bool = False) -> Grid:
    """Ringing of recorded and simulated transients, a row each, perhaps with the log's name."""
    return Template("comparisons", rig).table("ringing", matches, with_log=with_log)
