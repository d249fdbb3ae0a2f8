"""One trial under a controller in all its channels, and its estimates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.captions import capital
from ehbench.report.cases import Case, payloads_carried
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
    legend,
    legend_right,
    swatch,
    tag,
    thin,
)
from ehbench.report.trial_captions import ESTIMATES
from ehbench.report.words import axis, number, shown, words
from ehbench.vocabulary.codes import FUNCTIONS, LIMITS

FUNCTION_SHADES = (
    *("#e5e7eb", "#1f3f66", "#5b8fb9", "#a9c8e0", "#8a4b08", "#e08214", "#f3c583", "#2e7d5b"),
    *("#b5543c", "#7fb069"),
)
LIMIT_SHADES = {1: ACCENT, 2: "#8e4585", 4: "#7a6a4f", 8: "#9ca3af", 16: "#d4a017"}


def plot_channel(ax, rig: Rig, record: Record, name: str, **look: Any) -> None:
    """A channel over time, in the rig's unit; nothing where the log has none."""
    if name in record:
        ax.plot(*thin(record.t, shown(rig, name, record[name])), **look)


def stretches(t: np.ndarray, mask: np.ndarray, runs: int = 700) -> list[tuple[float, float]]:
    """(start, length) of the stretches where ``mask`` holds; gaps too short to be seen in a figure
    that can show so many ``runs`` are closed.
    """
    shortest = float(t[-1] - t[0]) / runs
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    spans: list[list[float]] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        first, last = float(t[start]), float(t[min(stop, t.size - 1)])
        if spans and first - spans[-1][1] < shortest:
            spans[-1][1] = last
        else:
            spans.append([first, last])
    return [(first, max(last - first, shortest)) for first, last in spans]


def flags_of(record: Record, cylinder: str, word: str) -> np.ndarray:
    """A whole-numbered channel of a cylinder; zeros where the log has none."""
    values = record.channels.get(f"{cylinder}.{word}", np.zeros(record.t.size))
    return values.round().astype(int)


def function_bars(ax, cases: Sequence[tuple[str, Case, Record]], limits: bool) -> list:
    """Bars over time: the working function of each case, and below one row a limit that was met;
    legend handles.
    """
    rows: list[str] = []
    seen: set[int] = set()

    def bar(t: np.ndarray, mask: np.ndarray, height: float, colour: str) -> None:
        where = (len(rows) - 0.5 * height, height)
        ax.broken_barh(stretches(t, mask), where, facecolors=colour, linewidth=0)

    for name, case, record in cases:
        if f"{case.cylinder}.function" not in record:
            continue
        functions = flags_of(record, case.cylinder, "function")
        for function in map(int, np.unique(functions)):
            seen.add(function)
            bar(record.t, functions == function, 0.8, FUNCTION_SHADES[function])
        rows.append(name)
        met = flags_of(record, case.cylinder, "limits")
        for bit, word in LIMITS.items() if limits else ():
            if (met & bit).any():
                bar(record.t, met & bit > 0, 0.6, LIMIT_SHADES[bit])
                rows.append(word)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_yticks(range(len(rows)), rows, fontsize=7.5)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    return [swatch(words(FUNCTIONS[item]), FUNCTION_SHADES[item]) for item in sorted(seen)]


def plot_commands(ax, rig: Rig, record: Record, cylinder: str) -> bool:
    """The commands of a cylinder's valves that change, shaded where an edge is saturated; whether
    one ever is.
    """
    names = [c for c in record.channels if c.startswith(f"{cylinder}.") and c.endswith(".command")]
    for index, name in enumerate(names):
        if np.ptp(record[name]) > 0.0:
            valve = name.removeprefix(f"{cylinder}.").removesuffix(".command")
            plot_channel(ax, rig, record, name, **cycled(index, linewidth=1.1, label=valve))
    ax.margins(y=0.08)
    mask = flags_of(record, cylinder, "limits") & 1 > 0
    if mask.any():
        look: Look = {"facecolors": ACCENT, "alpha": 0.13, "linewidth": 0, "zorder": 0}
        across = ax.get_xaxis_transform()
        ax.broken_barh(stretches(record.t, mask), (0, 1), transform=across, **look)
    return bool(mask.any())


def controlled(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """One trial: desired and actual motion, pressures, commands with saturation shaded, working
    function and limits over time.
    """
    cylinder = case.cylinder
    strip = ["strip"] if f"{cylinder}.function" in record else []
    motion = ["v", "x"] if case.steps else ["x", "error", "v"]
    panels = [*motion, "pressure", "command", *strip]
    met = int(np.bitwise_or.reduce(flags_of(record, cylinder, "limits")))
    bars = 1 + sum(met & bit > 0 for bit in LIMITS)
    heights = [0.16 * bars + 0.12 if panel == "strip" else 1.0 for panel in panels]
    size = (7.4, 1.25 * sum(heights) + 0.28 * len(panels) + 0.5)
    look: Look = {"sharex": True, "squeeze": False, "height_ratios": heights}
    with canvas(path, len(panels), 1, size, **look) as (figure, axes):
        places = dict(zip(panels, axes[:, 0], strict=True))
        for word, text in (("x", "Stroke"), ("v", "Cylinder speed")):
            _actual_and_desired(
                places[word], rig, record, f"{cylinder}.{word}", axis(rig, word, text)
            )
        if "error" in places:
            ax, error = places["error"], tracking_error(rig, record, cylinder)
            ax.plot(*thin(record.t, error), color=RECORDED, linewidth=1.0)
            ax.axhline(0.0, color=MUTED, linewidth=0.7)
            ax.set_title(axis(rig, "x", "Tracking error, actual minus desired"))
        _pressures(places["pressure"], rig, case, record)
        saturated = plot_commands(places["command"], rig, record, cylinder)
        places["command"].set_title(axis(rig, "command", "Commands"))
        legend_right(places["command"])
        named = [("function", case, record)]
        handles = function_bars(places["strip"], named, True) if strip else []
        if saturated:
            handles.append(swatch("an edge is saturated", ACCENT, alpha=0.2))
        mark_stop(axes[:, 0], record, (0, 3), ha="center")
        axes[-1, 0].set_xlabel("time [s]")
        axes[-1, 0].set_xlim(record.t[0], record.t[-1])
        legend(figure, handles, 3)


def _actual_and_desired(ax, rig: Rig, record: Record, name: str, title: str) -> None:
    """Actual and desired, and shaped where the shaping changed it."""
    desired, shaped = f"{name}_desired", f"{name}_shaped"
    plot_channel(ax, rig, record, name, color=RECORDED, linewidth=1.2, label="actual")
    dashed: Look = {"color": SIMULATED, "linewidth": 1.5, "linestyle": (0, (4, 1.6))}
    plot_channel(ax, rig, record, desired, label="desired", **dashed)
    if shaped in record and not np.array_equal(record[shaped], record[desired]):
        dotted: Look = {"color": MUTED, "linewidth": 1.0, "linestyle": ":"}
        plot_channel(ax, rig, record, shaped, label="shaped", **dotted)
    ax.set_title(title)
    ax.margins(y=0.08)
    legend_right(ax)


def tracking_error(rig: Rig, record: Record, cylinder: str) -> np.ndarray:
    """Actual minus desired stroke, in the rig's unit."""
    return shown(rig, "x", record[f"{cylinder}.x"] - record[f"{cylinder}.x_desired"])


def _pressures(ax, rig: Rig, case: Case, record: Record) -> None:
    """Of the chambers; of the supply as well where it follows the load."""
    if case.row.get("energy", {}).get("supply") == "load sensing":
        look: Look = {"color": MUTED, "linewidth": 0.9, "label": "supply"}
        plot_channel(ax, rig, record, "p_supply", **look)
    planned: Look = {"color": MUTED, "linestyle": (0, (3, 2)), "linewidth": 1.0}
    for word, text, look in (
        ("p_head", "head end", {"color": CYCLE[0], "linewidth": 1.1}),
        ("p_rod", "rod end", {"color": CYCLE[1], "linewidth": 1.1}),
        ("pressure_set", "set-point", planned),
    ):
        plot_channel(ax, rig, record, f"{case.cylinder}.{word}", label=text, **look)
    ax.set_title(axis(rig, "p_head", "Chamber pressures"))
    ax.margins(y=0.08)
    legend_right(ax)


def estimates(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """What a controller has learnt over time, each within its bounds, the payload with the true one
    and the oil with what pressures and flows show of it.
    """
    learnt = [word for word in ESTIMATES if f"{case.cylinder}.{word}" in record]
    bounds = case.row.get("estimate_bounds", {})
    rows = -(-len(learnt) // 2)
    with canvas(path, rows, 2, (7.4, 1.95 * rows + 0.4), sharex=True, squeeze=False) as (_, axes):
        for ax in axes.flat[len(learnt) :]:
            ax.remove()
        for place, (ax, word) in enumerate(zip(axes.flat, learnt, strict=False)):
            name, height = f"{case.cylinder}.{word}", 0.24
            if word == "payload_estimate":
                _measured_payload(ax, rig, record, case.cylinder)
                height = 0.68  # clear of the lines
            oil = record.channels.get(f"{case.cylinder}.bulk_measured", np.zeros(1))
            if word == "inverse_bulk" and np.ptp(oil) > 0.0:
                look: Look = {"color": SIMULATED, "linewidth": 1.0}
                share = oil[0] / oil  # at the first tick it is the design's
                ax.plot(*thin(record.t, share), label="by pressures and flows", **look)
            plot_channel(ax, rig, record, name, color=RECORDED, linewidth=1.4, label="of the law")
            if ax.get_legend_handles_labels()[1][1:]:
                ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(0.0, height))
            carried = payloads_carried(rig, case.row) if word == "payload_estimate" else None
            if carried:
                times = [*(time for time, _ in carried), float(record.t[-1])]
                levels = [shown(rig, "payload_estimate", mass) for _, mass in carried]
                look = {"color": CYCLE[2], "linewidth": 1.1, "linestyle": (0, (5, 3))}
                ax.stairs(levels, times, baseline=None, **look)
                look = {"color": CYCLE[2], "ha": "left", "va": "bottom", "fontsize": 7.5}
                tag(ax, "truth, from the rig file", 0.0, levels[0], (3, 2), "x", **look)
            for which, end in zip(("lower", "upper"), bounds.get(word, ()), strict=False):
                if end is not None:  # named outside of it, at the right
                    y, below = shown(rig, word, end), which == "lower"
                    ax.axhline(y, color=ACCENT, linewidth=1.1, linestyle=(0, (5, 3)))
                    offset, text = (-3, -2 if below else 2), f"{which} bound {number(y, 3)}"
                    look = {"color": ACCENT, "ha": "right", "va": "top" if below else "bottom"}
                    tag(ax, text, 1.0, y, offset, "x", fontsize=7.5, **look)
            ax.margins(y=0.2)
            ax.set_title(axis(rig, word, capital(words(word))), fontsize=8.5)
            if place + 2 >= len(learnt):
                ax.tick_params(labelbottom=True)
                ax.set_xlabel("time [s]")


def _measured_payload(ax, rig: Rig, record: Record, cylinder: str) -> None:
    """The payload that pressures and motion show, in its interval, where the log has it."""
    names = [f"{cylinder}.payload_{word}" for word in ("low", "high", "measured")]
    if not all(name in record for name in names):
        return
    ends = (thin(record.t, shown(rig, name, record[name])) for name in names[:2])
    (low_t, low), (high_t, high) = ends
    t = np.union1d(low_t, high_t)
    band: Look = {"color": SIMULATED, "alpha": 0.2, "linewidth": 0, "label": "its interval"}
    ax.fill_between(t, np.interp(t, low_t, low), np.interp(t, high_t, high), **band)
    look: Look = {"color": SIMULATED, "linewidth": 1.0, "label": "by pressures and motion"}
    plot_channel(ax, rig, record, names[2], **look)
