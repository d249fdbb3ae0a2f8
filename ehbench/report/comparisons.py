"""What identification and validation share: recorded against simulated, and ringing side by
side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.blocks import Cell, Grid
from ehbench.report.captions import capital, percent, plus
from ehbench.report.content import num
from ehbench.report.figures.channels import title_of
from ehbench.report.figures.comparison import comparison
from ehbench.report.index import FigureIndex, FigureKey
from ehbench.report.saved import Saved, Series, Table
from ehbench.report.words import interval, number, pretty, unit_of, words
from ehbench.vocabulary.terms import Z95

OFF = 0.1  # share of a channel's range that is far off
LONG = 0.2  # share of a log that is long
_TWINS = {"x": "q", "v": "qd"}  # a joint's angle and its cylinder's stroke say the same


def draw_comparisons(run: Saved, index: FigureIndex, log: str, kind: str, lead: str) -> None:
    """A figure a cylinder of a log, recorded against simulated.

    Args:
        kind: of the figure: ``fit`` leaves a stroke out where its joint's angle is there.
        lead: what the title begins with.
    """
    series = run.series(log)
    if series is None:
        return
    for cylinder, channels in series.cylinders().items():
        if kind == "fit":
            channels = [
                channel
                for channel in channels
                if f"{cylinder}.{_TWINS.get(channel.rpartition('.')[2])}" not in channels
            ]
        caption = (
            "Solid: recorded. Dashed: simulated. The narrow strips show simulated minus recorded."
        )
        if not any(channel in series.simulated for channel in channels):
            caption = "Recorded only: this log could not be simulated."
        caption += "".join(f" {text}" for text in lasting(series, channels))
        title = f"{lead}: {words(log)}" + (f", {cylinder}" if cylinder else "")
        about = FigureKey(kind, log=log, cylinder=cylinder)
        path = index.add(f"{kind}_{log}_{cylinder}", title, caption, about)
        comparison(path, run.rig, series, channels)


def lasting(series: Series, channels: Sequence[str]) -> list[str]:
    """A sentence for each channel whose simulation lies on one side of the recording for long."""
    lasts = []
    for channel in channels:
        if channel not in series.recorded or channel not in series.simulated:
            continue
        recorded = series.recorded[channel]
        error = series.simulated[channel] - recorded
        off = OFF * float(np.ptp(recorded[np.isfinite(recorded)], axis=0))
        longest = max(_longest(series.t, side * error > off) for side in (-1.0, 1.0))
        if off > 0.0 and longest >= LONG * float(series.t[-1] - series.t[0]):
            lasts.append(
                f"{capital(title_of(channel).lower())}: off to one side by more than "
                f"{percent(OFF)} of its range for {number(longest, 2)} s."
            )
    return lasts


def _longest(t: np.ndarray, mask: np.ndarray) -> float:
    """The longest stretch of time [s] in which a mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    ends = np.minimum(edges[1::2], t.size - 1)
    return float(np.max(t[ends] - t[edges[::2]], initial=0.0))


def log_cell(log: Table) -> Cell:
    """A log's name."""
    return Cell(words(log["name"]), "name")


def ringing_table(
    rig: Rig, matches: Sequence[Table], caption: str = "", with_log: bool = False
) -> Grid:
    """Ringing of recorded and simulated transients, a row each, with the log's name if asked."""
    unit = pretty(unit_of(rig, "natural_frequency"))
    omega = "fₙ" + (f" [{unit}]" if unit else "")
    head = [
        *(["log"] if with_log else []),
        "cylinder",
        "window [s]",
        f"{omega} recorded",
        f"{omega} simulated",
        "ζ recorded",
        "ζ simulated",
    ]
    rows = []
    for match in matches:
        row = _ringing_row(rig, match)
        rows.append([Cell(words(match.get("log", "")), "name"), *row] if with_log else row)
    return Grid(head, rows, caption)


def _ringing_row(rig: Rig, item: Table) -> list[Cell | str]:
    cells: list[Cell | str] = [item["cylinder"], num(interval(item["start"], item["stop"]))]
    for key in ("natural_frequency", "damping_ratio"):
        for side in ("recorded", "simulated"):
            ring = item[side]
            value = ring.get(key)
            std = ring.get(f"{key}_std")
            half = None if std is None else Z95 * std
            text = plus(rig, key, value, half) if value is not None else "–"
            cells.append(Cell(text, "number", hint=ring.get("reason", "")))
    return cells
