"""Where the tip of a mechanism went, how far from where it should, and what oil that took."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.figures.channels import stop_line
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    MUTED,
    RECORDED,
    SIMULATED,
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
    size = (7.4, 9.4)
    look = {"height_ratios": [1.7, 1.0, 1.0, 1.0], "squeeze": False}
    with canvas(path, 4, 2, size, **look) as (figure, axes):
        for ax, across, up, text in (
            (axes[0, 0], "x", "y", "From above"),
            (axes[0, 1], "x", "z", "From the side"),
        ):
            _view(ax, rig, record, (across, up), text)
        grid = axes[0, 0].get_gridspec()
        for ax in axes[1:].flat:
            ax.remove()
        below = [figure.add_subplot(grid[row, :]) for row in (1, 2, 3)]
        _errors(below[0], rig, record)
        _cylinders(below[1], rig, record)
        _flow(below[2], rig, case, record)
        stop_line(below, record, offset=(0, 3), ha="center")
        for ax in below:
            ax.set_xlim(record.t[0], record.t[-1])
        below[-1].set_xlabel("time [s]")


def _view(ax, rig: Rig, record: Record, ways: tuple[str, str], text: str) -> None:
    """The desired and the travelled path in one plane, to scale, of 1500 points at most."""
    step = max(1, record.t.size // 1500)
    for name, look in (
        ("_desired", {"color": SIMULATED, "linewidth": 2.4, "label": "desired"}),
        ("", {"color": RECORDED, "linewidth": 1.0, "label": "travelled"}),
    ):
        channels = [f"tip_{way}{name}" for way in ways]
        ax.plot(*(np.asarray(shown(rig, c, record[c]))[::step] for c in channels), **look)
    first = [float(shown(rig, c, record[c][0])) for c in (f"tip_{way}_desired" for way in ways)]
    ax.plot(*first, marker="o", color=ACCENT, markersize=4, linestyle="none", label="start")
    words = {"x": "ahead", "y": "to the left", "z": "up"}
    ax.set_title(text)
    ax.set_xlabel(axis(rig, f"tip_{ways[0]}", words[ways[0]]))
    ax.set_ylabel(axis(rig, f"tip_{ways[1]}", words[ways[1]]))
    ax.margins(0.08)
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(loc="best")


def _errors(ax, rig: Rig, record: Record) -> None:
    for name, text, look in (
        ("tip_error", "in all", {"color": RECORDED, "linewidth": 1.1}),
        ("tip_across", "across its way", {"color": CYCLE[2], "linewidth": 0.9}),
    ):
        ax.plot(*thin(record.t, np.asarray(shown(rig, name, record[name]))), label=text, **look)
    ax.set_title(axis(rig, "tip_error", "Error of the tip"))
    ax.set_ylim(bottom=0.0)
    legend_right(ax)


def _cylinders(ax, rig: Rig, record: Record) -> None:
    names = [c.removesuffix(".x_desired") for c in record.channels if c.endswith(".x_desired")]
    for index, name in enumerate(names):
        error = np.asarray(shown(rig, "x", record[f"{name}.x"] - record[f"{name}.x_desired"]))
        ax.plot(*thin(record.t, error), **cycled(index, linewidth=1.0, label=name))
    ax.axhline(0.0, color=MUTED, linewidth=0.7)
    ax.set_title(axis(rig, "x", "Error of each cylinder, actual minus desired"))
    legend_right(ax)


def demanded(rig: Rig, record: Record) -> np.ndarray | None:
    """Flow [m³/s] that the controllers ask of the supply: of all edges from it; None where no
    controller says what it asks for.
    """
    names = [f"{c.name}.{v.edge_name(e)}" for c, v, e in rig.edges() if e.from_ == "supply"]
    flows = [record[f"{n}.flow_desired"] for n in names if f"{n}.flow_desired" in record]
    return np.sum([np.abs(flow) for flow in flows], axis=0) if flows else None


def _flow(ax, rig: Rig, case: Case, record: Record) -> None:
    lines = [("of the motion", record["flow_demand"], {"color": SIMULATED, "linewidth": 1.6})]
    if np.any(record["pace"] < 1.0):
        lines.append(("planned", record["flow_planned"], {"color": CYCLE[2], "linewidth": 1.6}))
    requested = demanded(rig, record)
    if requested is not None:
        lines.append(("asked for by controllers", requested, {"color": RECORDED, "linewidth": 0.8}))
    for text, flow, look in lines:
        ax.plot(*thin(record.t, np.asarray(shown(rig, "flow", flow))), label=text, **look)
    limit = case.row["sharing"].get("flow_limit")
    if limit is not None:
        look = {"color": ACCENT, "linewidth": 1.1, "linestyle": (0, (5, 3))}
        ax.axhline(float(shown(rig, "flow", limit)), label="the pump's limit", **look)
    ax.set_title(axis(rig, "flow", "Flow from the supply"))
    ax.set_ylim(bottom=0.0)
    legend_right(ax)
