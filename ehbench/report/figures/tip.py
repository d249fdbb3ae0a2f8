"""Where the tip of a mechanism went, how far from where it should, and what oil that took."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.figures.channels import mark_stop
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    MUTED,
    RECORDED,
    SIMULATED,
    Look,
    canvas,
    cycled,
    legend_right,
    thin,
)
from ehbench.report.words import axis, shown


def tip(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """The tip's way from above and from the side, its error and that of each cylinder, the oil
    demanded against the pump's limit.
    """

    def draw(ax, name: str, values: np.ndarray, label: str, **look) -> None:
        ax.plot(*thin(record.t, shown(rig, name, values)), label=label, **look)

    look: Look = {"height_ratios": [1.7, 1.0, 1.0, 1.0], "squeeze": False}
    with canvas(path, 4, 2, (7.4, 9.4), **look) as (figure, axes):
        _view(axes[0, 0], rig, record, "xy", "From above")
        _view(axes[0, 1], rig, record, "xz", "From the side")
        grid = axes[0, 0].get_gridspec()
        for ax in axes[1:].flat:
            ax.remove()
        error, cylinders, flow = below = [figure.add_subplot(grid[row, :]) for row in (1, 2, 3)]
        draw(error, "tip_error", record["tip_error"], "in all", color=RECORDED, linewidth=1.1)
        look = {"color": CYCLE[2], "linewidth": 0.9}
        draw(error, "tip_across", record["tip_across"], "across its way", **look)
        error.set_title(axis(rig, "tip_error", "Error of the tip"))
        error.set_ylim(bottom=0.0)
        names = [c.removesuffix(".x_desired") for c in record.channels if c.endswith(".x_desired")]
        for index, name in enumerate(names):
            off = record[f"{name}.x"] - record[f"{name}.x_desired"]
            draw(cylinders, "x", off, name, **cycled(index, linewidth=1.0))
        cylinders.axhline(0.0, color=MUTED, linewidth=0.7)
        cylinders.set_title(axis(rig, "x", "Error of each cylinder, actual minus desired"))
        look = {"color": SIMULATED, "linewidth": 1.6}
        draw(flow, "flow", record["flow_demand"], "of the motion", **look)
        if np.any(record["pace"] < 1.0):
            look = {"color": CYCLE[2], "linewidth": 1.6}
            draw(flow, "flow", record["flow_planned"], "planned", **look)
        if (requested := demanded(rig, record)) is not None:
            look = {"color": RECORDED, "linewidth": 0.8}
            draw(flow, "flow", requested, "asked for by controllers", **look)
        if (limit := case.row["sharing"].get("flow_limit")) is not None:
            look = {"color": ACCENT, "linewidth": 1.1, "linestyle": (0, (5, 3))}
            flow.axhline(shown(rig, "flow", limit), label="the pump's limit", **look)
        flow.set_title(axis(rig, "flow", "Flow from the supply"))
        flow.set_ylim(bottom=0.0)
        for ax in below:
            legend_right(ax)
            ax.set_xlim(record.t[0], record.t[-1])
        mark_stop(below, record, (0, 3), ha="center")
        flow.set_xlabel("time [s]")


def _view(ax, rig: Rig, record: Record, ways: str, text: str) -> None:
    """The desired and the travelled path in one plane, to scale, of 1500 points at most."""
    step = max(1, record.t.size // 1500)
    desired, travelled = (
        [shown(rig, f"tip_{way}{end}", record[f"tip_{way}{end}"]) for way in ways]
        for end in ("_desired", "")
    )
    look: Look = {"color": SIMULATED, "linewidth": 2.4, "label": "desired"}
    ax.plot(*(values[::step] for values in desired), **look)
    look = {"color": RECORDED, "linewidth": 1.0, "label": "travelled"}
    ax.plot(*(values[::step] for values in travelled), **look)
    look = {"color": ACCENT, "markersize": 4, "linestyle": "none", "label": "start"}
    ax.plot(*(values[0] for values in desired), marker="o", **look)
    words = {"x": "ahead", "y": "to the left", "z": "up"}
    across, up = (axis(rig, f"tip_{way}", words[way]) for way in ways)
    ax.set(title=text, xlabel=across, ylabel=up)
    ax.margins(0.08)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(loc="best")


def demanded(rig: Rig, record: Record) -> np.ndarray | None:
    """Flow [m³/s] that the controllers ask of the supply: of all edges from it; None where no
    controller says what it asks for.
    """
    names = [f"{c.name}.{v.edge_name(e)}" for c, v, e in rig.edges() if e.from_ == "supply"]
    flows = [record[f"{n}.flow_desired"] for n in names if f"{n}.flow_desired" in record]
    return np.sum([np.abs(flow) for flow in flows], axis=0) if flows else None
