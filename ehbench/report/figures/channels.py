"""Channels of a log over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.style import ACCENT, canvas, cycled, legend_right, tag, thin
from ehbench.report.words import axis, shown, title_of
from ehbench.vocabulary.quantities import GAUGES

_PLAIN = {"p_head": "head end", "p_rod": "rod end", "p_supply": "supply"}


def live(rig: Rig, record: Record) -> dict[str, list[str]]:
    """Channels by cylinder that is commanded or travels 1 % of its stroke, else all."""
    groups: dict[str, list[str]] = {}
    for channel in record.channels:
        if "." in channel:
            groups.setdefault(channel.split(".")[0], []).append(channel)
    strokes = {cylinder.name: float(cylinder.stroke) for cylinder in rig.cylinder}

    def moves(name: str) -> bool:
        stroke = f"{name}.x"
        commanded = any(c.endswith(".command") and np.ptp(record[c]) > 0.0 for c in groups[name])
        return commanded or (
            stroke in record and np.ptp(record[stroke]) > 0.01 * strokes.get(name, 0.0)
        )

    moved = [name for name in groups if moves(name)]
    return {name: channels for name, channels in groups.items() if name in (moved or groups)}


def trial(path: Path, rig: Rig, record: Record, cylinder: str, channels: Sequence[str]) -> None:
    """Commands, motion, pressures and gauges of one cylinder over one time axis."""
    motion = ("q", "qd") if f"{cylinder}.q" in record else ("q", "qd", "x", "v")
    pressures = (f"{cylinder}.p_head", f"{cylinder}.p_rod", "p_supply")
    changing = [c for c in channels if c.endswith(".command") and np.ptp(record[c]) > 0.0]
    panels = [("Commands", changing)]
    panels += [(title_of(word), [f"{cylinder}.{word}"]) for word in motion]
    panels.append(("Pressures", [*pressures]))
    panels += [(title_of(word), [f"{cylinder}.{word}"]) for word in GAUGES]
    panels = [(text, [name for name in names if name in record]) for text, names in panels]
    panels = [(text, names) for text, names in panels if names]
    size = (7.4, 1.55 * len(panels) + 0.4)
    with canvas(path, len(panels), 1, size, sharex=True, squeeze=False) as (_, axes):
        for ax, (text, names) in zip(axes[:, 0], panels, strict=True):
            for index, name in enumerate(names):
                label = name.removeprefix(f"{cylinder}.").removesuffix(".command")
                look = cycled(index, linewidth=1.2, label=_PLAIN.get(label, label))
                if name.endswith(".command"):
                    look["drawstyle"] = "steps-post"
                ax.plot(*thin(record.t, shown(rig, name, record[name]), 640), **look)
            ax.set_title(axis(rig, names[0], text))
            ax.margins(y=0.1)
            if len(names) > 1:
                legend_right(ax, handlelength=2.6)
        mark_stop(axes[:, 0], record, (3, -2), va="top")
        axes[-1, 0].set_xlabel("time [s]")


def mark_stop(axes: Sequence[Any], record: Record, offset: tuple[int, int], **look: Any) -> None:
    """Mark in every panel where a trial was stopped, if its log says when."""
    try:
        t = float(record.meta["stopped"].rsplit("t = ", 1)[1].split()[0])
    except (KeyError, IndexError, ValueError):
        return
    for ax in axes:
        ax.axvline(t, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
    tag(axes[0], "stopped", t, 1.0, offset, "y", color=ACCENT, **look)
