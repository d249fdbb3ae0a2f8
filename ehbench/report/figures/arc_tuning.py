"""Figures of a tuning of adaptive robust control: margins over the bandwidths, characteristic loci
of the worst point.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, CYCLE, MUTED, canvas
from ehbench.report.words import axis, shown


def margins(path: Path, rig: Rig, tuning: Table) -> None:
    """The stated delay margin and the gain margin at the worst points over the sum of bandwidths,
    with what is demanded and the choice; beside them the characteristic loci of the worst point.
    """
    with canvas(path, size=(9.0, 3.9)) as (figure, ax):
        ax.remove()
        left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
        _over_sum(left, rig, tuning)
        _loci(right, tuning)


def _over_sum(ax, rig: Rig, tuning: Table) -> None:
    """Margins over the sum of bandwidths."""
    tried = tuning["candidates"]
    x = np.asarray(shown(rig, "position_bandwidth", np.array([item["sum"] for item in tried])))
    gains = np.array([item.get("gain_margin") or np.nan for item in tried], float)
    bandwidths = (tuning["gains"][f"{name}_bandwidth"] for name in ("position", "speed", "force"))
    chosen = float(shown(rig, "position_bandwidth", sum(bandwidths)))
    delays = np.array([item.get("delay_margin", np.inf) for item in tried], float)
    y = np.asarray(shown(rig, "delay_margin", delays))
    minimum = float(shown(rig, "delay_margin", tuning["constraints"]["delay_margin"]))
    ax.plot(x, y, "o-", color=CYCLE[0], markersize=3.5, label="delay margin, stated")
    ax.axhline(minimum, color=CYCLE[0], linewidth=1.0, linestyle=(0, (5, 3)))
    ax.annotate("demanded", (x[-1], minimum), (-46, 3), textcoords="offset points", fontsize=8)
    ax.axvline(chosen, color=MUTED, linewidth=1.0, linestyle=(0, (2, 2)))
    ax.annotate("chosen", (chosen, 0.0), (3, 4), textcoords="offset points", fontsize=8)
    ax.set_xlim(0.0, x[-1])
    ax.set_ylim(0.0, 6.0 * minimum)
    ax.set_xlabel(axis(rig, "position_bandwidth", "k₁ + k₂ + k₃"))
    ax.set_ylabel(axis(rig, "delay_margin", "delay margin"), color=CYCLE[0])
    other = ax.twinx()
    other.plot(x, gains, "s--", color=CYCLE[1], markersize=3.0)
    other.set_ylabel("gain margin [–]", color=CYCLE[1])
    other.set_ylim(0.0, 6.0 * tuning["constraints"]["gain_margin"])


def _loci(ax, tuning: Table) -> None:
    """The characteristic loci of the worst point, the unit circle and the critical point."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    ax.plot(np.cos(turn), np.sin(turn), color=MUTED, linewidth=0.8, linestyle=(0, (2, 2)))
    for index, (real, imag) in enumerate(tuning["locus"]):
        ax.plot(real, imag, color=CYCLE[index % len(CYCLE)], linewidth=1.2)
    ax.plot([-1.0], [0.0], "x", color=ACCENT, markersize=7)
    ax.annotate("swings", (-1.0, 0.0), (-4, 6), textcoords="offset points", fontsize=8, ha="right")
    ax.set_xlim(-2.2, 2.2)
    ax.set_ylim(-2.2, 2.2)
    ax.set_aspect("equal")
    ax.set_xlabel("real part")
    ax.set_ylabel("imaginary part")
