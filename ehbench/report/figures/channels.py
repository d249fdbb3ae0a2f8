"""Channels of a log over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.style import ACCENT, BUCKETS, canvas, cycled, legend_right, thin
from ehbench.report.words import axis, shown, title_of
from ehbench.vocabulary.quantities import GAUGES

_PLAIN = {"p_head": "head end", "p_rod": "rod end", "p_supply": "supply"}


def live(rig: Rig, record: Record, travel: float = 0.01) -> dict[str, list[str]]:
    """Channels to draw by cylinder: those with a changing command or that travel a share of the
    stroke; all of them if none does.
    """
    groups: dict[str, list[str]] = {}
    for channel in record.channels:
        if "." in channel:
            groups.setdefault(channel.split(".")[0], []).append(channel)
    strokes = {cylinder.name: float(cylinder.stroke) for cylinder in rig.cylinder}

    def moves(name: str) -> bool:
        stroke = f"{name}.x"
        commanded = any(c.endswith(".command") and np.ptp(record[c]) > 0.0 for c in groups[name])
        return commanded or (
            stroke in record and np.ptp(record[stroke]) > travel * strokes.get(name, 0.0)
        )

    moved = [name for name in groups if moves(name)]
    return {name: channels for name, channels in groups.items() if name in (moved or groups)}


def trial(path: Path, rig: Rig, record: Record, cylinder: str, channels: Sequence[str]) -> None:
    """Commands, motion and pressures of one cylinder over one time axis."""
    panels = _panels(record, cylinder, channels)
    size = (7.4, 1.55 * len(panels) + 0.4)
    with canvas(path, len(panels), 1, size, sharex=True, squeeze=False) as (_, axes):
        for ax, (text, names) in zip(axes[:, 0], panels, strict=True):
            for index, name in enumerate(names):
                _line(ax, rig, record, name, index, channel_label(name, cylinder))
            ax.set_title(axis(rig, names[0], text))
            ax.margins(y=0.1)
            if len(names) > 1:
                legend_right(ax, 2.6)
        stop_line(axes[:, 0], record, offset=(3, -2), va="top")
        axes[-1, 0].set_xlabel("time [s]")


def _panels(record: Record, cylinder: str, channels: Sequence[str]) -> list[tuple[str, list[str]]]:
    """(title, channels) of the panels that have any."""
    changing = [c for c in channels if c.endswith(".command") and np.ptp(record[c]) > 0.0]
    panels = [("Commands", changing)]
    motion = ("q", "qd") if f"{cylinder}.q" in record else ("q", "qd", "x", "v")
    for word in motion:
        if (channel := f"{cylinder}.{word}") in record:
            panels.append((title_of(channel), [channel]))
    pressures = (f"{cylinder}.p_head", f"{cylinder}.p_rod", "p_supply")
    panels.append(("Pressures", [channel for channel in pressures if channel in record]))
    gauges = [channel for word in GAUGES if (channel := f"{cylinder}.{word}") in record]
    panels += [(title_of(channel), [channel]) for channel in gauges]
    return [(title, names) for title, names in panels if names]


def _line(ax, rig: Rig, record: Record, name: str, index: int, label: str) -> None:
    look = cycled(index, linewidth=1.2)
    if name.endswith(".command"):
        look["drawstyle"] = "steps-post"
    ax.plot(*thin(record.t, shown(rig, name, record[name]), 2 * BUCKETS), label=label, **look)


def stop_time(record: Record) -> float | None:
    """When the trial was stopped [s], as the log's own words end with."""
    try:
        return float(record.meta["stopped"].rsplit("t = ", 1)[1].split()[0])
    except (IndexError, ValueError):
        return None


def stop_line(axes: Sequence[Any], record: Record, offset: tuple[int, int], **look: Any) -> None:
    """Mark in every panel where a trial was stopped, with a word above the first."""
    if "stopped" in record.meta and (t := stop_time(record)) is not None:
        for ax in axes:
            ax.axvline(t, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
        where = ("data", "axes fraction")
        look = {"color": ACCENT, "fontsize": 8} | look
        axes[0].annotate("stopped", (t, 1.0), offset, where, "offset points", **look)


def channel_label(name: str, cylinder: str) -> str:
    """A channel within its cylinder: ``head end``, or the valve of a command."""
    rest = name.removeprefix(f"{cylinder}.").removesuffix(".command")
    return _PLAIN.get(rest, rest)
