"""Frequency responses of recording and model, one over the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import Table
from ehbench.report.style import MUTED, RECORDED, SIMULATED, canvas, key, legend
from ehbench.report.words import number, pretty, shown, title_of, unit_of

_LOOKS = {
    "recorded": {"color": RECORDED, "linestyle": "-", "marker": "o", "markersize": 2.2},
    "simulated": {"color": SIMULATED, "linestyle": (0, (4, 1.6)), "marker": "", "linewidth": 1.7},
}


def sweeps(path: Path, rig: Rig, result: Sequence[Table], minimum: float) -> None:
    """A column a channel: gain and phase where the recording's coherence reaches ``minimum``, and
    the coherence.
    """
    from matplotlib.ticker import LogLocator

    rows = ("gain", "phase", "coherence")
    shape = {"sharex": True, "squeeze": False, "height_ratios": (3, 3, 1.6)}
    with canvas(path, 3, len(result), (7.4, 5.4), **shape) as (figure, axes):
        for column, sweep in enumerate(result):
            for side, look in _LOOKS.items():
                if sweep.get(side) is not None:
                    _draw_side(axes[:, column], rig, sweep, side, look)
            top, middle, bottom = axes[:, column]
            unit = pretty(unit_of(rig, sweep["channel"]))
            title = title_of(sweep["channel"])
            top.set_title(f"{title} [{unit}/V]" if unit else title, fontsize=8.5)
            top.set(xscale="log", yscale="log")
            for way, marks in (
                (top.xaxis, (1.0, 2.0, 5.0)),
                (top.yaxis, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)),
            ):
                way.set_major_locator(LogLocator(subs=marks, numticks=9))
                way.set_major_formatter(lambda tick, _: number(tick))
                way.set_minor_formatter(lambda tick, _: "")
            middle.locator_params(axis="y", nbins=6)
            bottom.axhline(minimum, color=MUTED, linewidth=0.8, linestyle="--")
            bottom.set_ylim(0.0, 1.05)
            bottom.set_xlabel("frequency [Hz]")
        for ax, row in zip(axes[:, 0], rows, strict=True):
            ax.set_ylabel("phase [°]" if row == "phase" else row)
        legend(figure, [key(side, **look) for side, look in _LOOKS.items()])


def _draw_side(axes: np.ndarray, rig: Rig, sweep: Table, side: str, look: dict) -> None:
    curve, channel = sweep[side], sweep["channel"]
    frequency = np.array(curve["frequency"], float)
    coherent = np.array(sweep["recorded"]["coherent"], bool)
    scale = shown(rig, channel, 1.0) - shown(rig, channel, 0.0)
    gain, phase, coherence = (np.array(curve[row], float) for row in ("gain", "phase", "coherence"))
    if side == "simulated":
        recorded = np.array(sweep["recorded"]["phase"], float)
        phase = phase + 360.0 * np.round((recorded - phase) / 360.0)  # on the nearest turn
    axes[0].plot(frequency[coherent], scale * gain[coherent], **look)
    axes[1].plot(frequency[coherent], phase[coherent], **look)
    axes[2].plot(frequency, coherence, **look | {"marker": ""})
