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
    swatch,
    thin,
)
from ehbench.report.trial_captions import ESTIMATES
from ehbench.report.words import axis, number, shown, words
from ehbench.vocabulary.codes import FUNCTIONS, LIMITS

_SHADES = (
    *("#e5e7eb", "#1f3f66", "#5b8fb9", "#a9c8e0", "#8a4b08", "#e08214", "#f3c583", "#2e7d5b"),
    *("#b5543c", "#7fb069"),
)
_LIMIT_SHADES = {1: ACCENT, 2: "#8e4585", 4: "#7a6a4f", 8: "#9ca3af", 16: "#d4a017"}


def plot_channel(ax, rig: Rig, record: Record, name: str, **look: Any) -> None:
    """A channel over time, in the rig's unit."""
    ax.plot(*thin(record.t, np.asarray(shown(rig, name, record[name]))), **look)


def stretches(t: np.ndarray, mask: np.ndarray, shortest: float) -> list[tuple[float, float]]:
    """(start, length) of the stretches where ``mask`` holds; gaps below ``shortest`` [s], which
    nobody could see, are closed.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    spans: list[list[float]] = []
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        first, last = float(t[start]), float(t[min(stop, t.size - 1)])
        if spans and first - spans[-1][1] < shortest:
            spans[-1][1] = last
        else:
            spans.append([first, last])
    return [(first, max(last - first, shortest)) for first, last in spans]


def flags_of(record: Record, cylinder: str, word: str) -> np.ndarray | None:
    """A whole-numbered channel of a cylinder; None where the log has none."""
    name = f"{cylinder}.{word}"
    return record[name].round().astype(int) if name in record else None


def visible(record: Record, runs: int = 700) -> float:
    """The shortest stretch of time [s] of which a figure can show so many."""
    return float(record.t[-1] - record.t[0]) / runs


def function_bars(ax, cases: Sequence[tuple[str, Case, Record]], limits: bool) -> list:
    """Bars over time: the working function of each case, and below one row a limit that was met;
    legend handles.
    """
    rows: list[str] = []
    seen: set[int] = set()

    def bar(t: np.ndarray, mask: np.ndarray, shortest: float, height: float, colour: str) -> None:
        where = (len(rows) - 0.5 * height, height)
        ax.broken_barh(stretches(t, mask, shortest), where, facecolors=colour, linewidth=0)

    for name, case, record in cases:
        functions = flags_of(record, case.cylinder, "function")
        if functions is None:
            continue
        shortest = visible(record)
        for function in map(int, np.unique(functions)):
            seen.add(function)
            bar(record.t, functions == function, shortest, 0.8, _SHADES[function])
        rows.append(name)
        met = flags_of(record, case.cylinder, "limits") if limits else None
        for bit, word in LIMITS.items():
            if met is not None and (met & bit).any():
                bar(record.t, met & bit > 0, shortest, 0.6, _LIMIT_SHADES[bit])
                rows.append(word)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_yticks(range(len(rows)), rows, fontsize=7.5)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    return [swatch(words(FUNCTIONS[item]), _SHADES[item]) for item in sorted(seen)]


def _limits_met(record: Record, cylinder: str) -> int:
    """How many limits a case met."""
    flags = flags_of(record, cylinder, "limits")
    met = 0 if flags is None else int(np.bitwise_or.reduce(flags))
    return sum(met & bit > 0 for bit in LIMITS)


def shade_saturation(ax, record: Record, cylinder: str) -> bool:
    """Shade a panel where an edge is saturated; whether one ever is."""
    flags = flags_of(record, cylinder, "limits")
    if flags is None:
        return False
    mask = flags & 1 > 0
    if mask.any():
        across = ax.get_xaxis_transform()
        look = {"facecolors": ACCENT, "alpha": 0.13, "linewidth": 0, "zorder": 0}
        ax.broken_barh(stretches(record.t, mask, visible(record)), (0, 1), transform=across, **look)
    return bool(mask.any())


def plot_commands(ax, rig: Rig, record: Record, cylinder: str) -> None:
    """The commands of a cylinder's valves that change."""
    names = [c for c in record.channels if c.startswith(f"{cylinder}.") and c.endswith(".command")]
    for index, name in enumerate(names):
        if np.ptp(record[name]) > 0.0:
            valve = name.removeprefix(f"{cylinder}.").removesuffix(".command")
            plot_channel(ax, rig, record, name, **cycled(index, linewidth=1.1, label=valve))
    ax.margins(y=0.08)


def controlled(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """One trial: desired and actual motion, pressures, commands with saturation shaded, working
    function and limits over time.
    """
    cylinder = case.cylinder
    strip = ["strip"] if f"{cylinder}.function" in record else []
    motion = ["v", "x"] if case.steps else ["x", "error", "v"]
    panels = [*motion, "pressure", "command", *strip]
    bars = 1 + _limits_met(record, cylinder)
    heights = [0.16 * bars + 0.12 if panel == "strip" else 1.0 for panel in panels]
    size = (7.4, 1.25 * sum(heights) + 0.28 * len(panels) + 0.5)
    look = {"sharex": True, "squeeze": False, "height_ratios": heights}
    with canvas(path, len(panels), 1, size, **look) as (figure, axes):
        places = dict(zip(panels, axes[:, 0], strict=True))
        for word, text in (("x", "Stroke"), ("v", "Cylinder speed")):
            _motion(places[word], rig, record, f"{cylinder}.{word}", axis(rig, word, text))
        if "error" in places:
            ax = places["error"]
            ax.plot(
                *thin(record.t, tracking_error(rig, record, cylinder)),
                color=RECORDED,
                linewidth=1.0,
            )
            ax.axhline(0.0, color=MUTED, linewidth=0.7)
            ax.set_title(axis(rig, "x", "Tracking error, actual minus desired"))
        _pressures(places["pressure"], rig, case, record)
        saturated = _commands_panel(places["command"], rig, record, cylinder)
        handles = (
            function_bars(places["strip"], [("function", case, record)], True) if strip else []
        )
        if saturated:
            handles.append(swatch("an edge is saturated", ACCENT, alpha=0.2))
        stop_line(axes[:, 0], record, offset=(0, 3), ha="center")
        axes[-1, 0].set_xlabel("time [s]")
        axes[-1, 0].set_xlim(record.t[0], record.t[-1])
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _motion(ax, rig: Rig, record: Record, name: str, title: str) -> None:
    """Actual and desired, and shaped where the shaping changed it."""
    desired, shaped = f"{name}_desired", f"{name}_shaped"
    plot_channel(ax, rig, record, name, color=RECORDED, linewidth=1.2, label="actual")
    dashed = {"color": SIMULATED, "linewidth": 1.5, "linestyle": (0, (4, 1.6))}
    plot_channel(ax, rig, record, desired, label="desired", **dashed)
    if shaped in record and not np.array_equal(record[shaped], record[desired]):
        dotted = {"color": MUTED, "linewidth": 1.0, "linestyle": ":"}
        plot_channel(ax, rig, record, shaped, label="shaped", **dotted)
    ax.set_title(title)
    ax.margins(y=0.08)
    legend_right(ax)


def tracking_error(rig: Rig, record: Record, cylinder: str) -> np.ndarray:
    """Actual minus desired stroke, in the rig's unit."""
    error = record[f"{cylinder}.x"] - record[f"{cylinder}.x_desired"]
    return np.asarray(shown(rig, "x", error))


def _pressures(ax, rig: Rig, case: Case, record: Record) -> None:
    """Of the chambers; of the supply as well where it follows the load."""
    cylinder, follows = case.cylinder, case.row.get("energy", {}).get("supply") == "load sensing"
    if follows and "p_supply" in record:
        look = {"color": MUTED, "linewidth": 0.9, "label": "supply"}
        plot_channel(ax, rig, record, "p_supply", **look)
    planned = {"color": MUTED, "linestyle": (0, (3, 2)), "linewidth": 1.0}
    for word, text, look in (
        ("p_head", "head end", {"color": CYCLE[0], "linewidth": 1.1}),
        ("p_rod", "rod end", {"color": CYCLE[1], "linewidth": 1.1}),
        ("pressure_set", "set-point", planned),
    ):
        if f"{cylinder}.{word}" in record:
            plot_channel(ax, rig, record, f"{cylinder}.{word}", label=text, **look)
    ax.set_title(axis(rig, "p_head", "Chamber pressures"))
    ax.margins(y=0.08)
    legend_right(ax)


def _commands_panel(ax, rig: Rig, record: Record, cylinder: str) -> bool:
    """Commands, shaded where an edge is saturated; whether one ever is."""
    plot_commands(ax, rig, record, cylinder)
    saturated = shade_saturation(ax, record, cylinder)
    ax.set_title(axis(rig, "command", "Commands"))
    if ax.get_legend_handles_labels()[0]:
        legend_right(ax)
    return saturated


def estimates(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """What a controller has learnt over time, each within its bounds, the payload beside the true
    one and the oil beside what pressures and flows tell of it.
    """
    learnt = [word for word in ESTIMATES if f"{case.cylinder}.{word}" in record]
    bounds = case.row.get("estimate_bounds", {})
    rows = -(-len(learnt) // 2)
    with canvas(path, rows, 2, (7.4, 1.95 * rows + 0.4), sharex=True, squeeze=False) as (_, axes):
        for ax in axes.flat[len(learnt) :]:
            ax.remove()
        for place, (ax, word) in enumerate(zip(axes.flat, learnt, strict=False)):
            name = f"{case.cylinder}.{word}"
            if word == "payload_estimate":
                _weighed(ax, rig, record, case.cylinder)
            if word == "inverse_bulk":
                _felt(ax, record, case.cylinder)
            plot_channel(ax, rig, record, name, color=RECORDED, linewidth=1.4, label="of the law")
            if ax.get_legend_handles_labels()[1][1:]:
                height = 0.68 if word == "payload_estimate" else 0.24  # clear of the lines
                ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(0.0, height))
            if word == "payload_estimate":
                _truth(ax, rig, payloads_carried(rig, case.row), float(record.t[-1]))
            for text, end in zip(("lower", "upper"), bounds.get(word, ()), strict=False):
                _bound(ax, rig, word, text, end)
            ax.margins(y=0.2)
            ax.set_title(axis(rig, word, capital(words(word))), fontsize=8.5)
            if place + 2 >= len(learnt):
                ax.tick_params(labelbottom=True)
                ax.set_xlabel("time [s]")


def _weighed(ax, rig: Rig, record: Record, cylinder: str) -> None:
    """The payload that pressures and motion tell, in its interval, where the law says it."""
    names = [f"{cylinder}.payload_{word}" for word in ("low", "high", "measured")]
    if not all(name in record for name in names):
        return
    ends = (thin(record.t, np.asarray(shown(rig, name, record[name]))) for name in names[:2])
    (low_t, low), (high_t, high) = ends
    t = np.union1d(low_t, high_t)
    band = {"color": SIMULATED, "alpha": 0.2, "linewidth": 0, "label": "its interval"}
    ax.fill_between(t, np.interp(t, low_t, low), np.interp(t, high_t, high), **band)
    look = {"color": SIMULATED, "linewidth": 1.0, "label": "by pressures and motion"}
    plot_channel(ax, rig, record, names[2], **look)


def _felt(ax, record: Record, cylinder: str) -> None:
    """The oil that pressures and flows tell, as the design's bulk modulus over it [1]; nothing
    where they tell nothing.
    """
    name = f"{cylinder}.bulk_measured"
    if name in record and np.ptp(record[name]) > 0.0:
        share = record[name][0] / record[name]  # at the first tick it is the design's
        look = {"color": SIMULATED, "linewidth": 1.0, "label": "by pressures and flows"}
        ax.plot(*thin(record.t, share), **look)


def _truth(ax, rig: Rig, payloads: list[tuple[float, float]] | None, end: float) -> None:
    """The true payload [kg] over time, up to ``end`` [s], named at the left."""
    if payloads is None:
        return
    times = [*(at for at, _ in payloads), end]
    levels = [float(shown(rig, "payload_estimate", mass)) for _, mass in payloads]
    look = {"color": CYCLE[2], "linewidth": 1.1, "linestyle": (0, (5, 3))}
    ax.stairs(levels, times, baseline=None, **look)
    at, where = (0.0, levels[0]), ("axes fraction", "data")
    look = {"color": CYCLE[2], "ha": "left", "va": "bottom", "fontsize": 7.5}
    ax.annotate("truth, from the rig file", at, (3, 2), where, "offset points", **look)


def _bound(ax, rig: Rig, word: str, which: str, value: float | None) -> None:
    """A bound of an estimate, named outside of it, at the right."""
    if value is not None:
        y = float(shown(rig, word, value))
        below = which == "lower"
        look = {"color": ACCENT, "ha": "right", "va": "top" if below else "bottom"}
        ax.axhline(y, color=ACCENT, linewidth=1.1, linestyle=(0, (5, 3)))
        where, offset = ("axes fraction", "data"), (-3, -2 if below else 2)
        text = f"{which} bound {number(y, 3)}"
        ax.annotate(text, (1.0, y), offset, where, "offset points", fontsize=7.5, **look)
