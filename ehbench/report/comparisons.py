"""What identification and validation share: recorded against simulated, over time and frequency,
and ringing side by side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Grid
from ehbench.report.figures.comparison import comparison
from ehbench.report.figures.sweeps import sweeps
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
            twins = {name: _TWINS.get(name.rpartition(".")[2]) for name in channels}
            channels = [name for name in channels if f"{cylinder}.{twins[name]}" not in channels]
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


def draw_responses(
    run: Saved,
    index: FigureIndex,
    about: FigureKey,
    key: str,
    result: Sequence[Table],
    limit: float,
) -> None:
    """Frequency responses of a log to one command, where the coherence reaches a limit."""
    command = result[0]["input"].removesuffix(".command")
    caption = Template("comparisons").text("responses")
    title = f"Response to {command} in {words(about.log or '')}"
    sweeps(index.add(key, title, caption, about), run.rig, result, limit)


def lasting(
    series: Series, channels: Sequence[str], off: float = 0.1, long: float = 0.2
) -> list[tuple[str, float]]:
    """(channel, longest time [s]) of each whose simulation lies off to one side of the recording
    for a share ``long`` of the log.
    """
    lasting, t = [], series.t
    for channel in channels:
        if channel not in series.recorded or channel not in series.simulated:
            continue
        recorded = series.recorded[channel]
        error = series.simulated[channel] - recorded
        limit = off * float(np.ptp(recorded[np.isfinite(recorded)], axis=0))
        longest = 0.0
        for beyond in (error > limit, -error > limit):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], beyond, [False]]).astype(int)))
            spans = t[np.minimum(edges[1::2], t.size - 1)] - t[edges[::2]]
            longest = max(longest, float(np.max(spans, initial=0.0)))
        if limit > 0.0 and longest >= long * float(t[-1] - t[0]):
            lasting.append((channel, longest))
    return lasting


def ringing_table(rig: Rig | None, matches: Sequence[Table], with_log: bool = False) -> Grid:
    """Ringing of recorded and simulated transients, a row each, perhaps with the log's name."""
    return Template("comparisons", rig).table("ringing", matches, with_log=with_log)
