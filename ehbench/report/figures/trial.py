"""One trial in all its channels: cylinders without a controller, under one, estimates, load; then
several controllers on one motion, and what they took from the pump."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case, payloads_carried
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    INK,
    MUTED,
    RECORDED,
    SIMULATED,
    Look,
    canvas,
    cycled,
    key,
    legend,
    legend_right,
    swatch,
    tag,
    thin,
)
from ehbench.report.trial_captions import ESTIMATES
from ehbench.report.words import axis, capital, number, shown, title_of, words
from ehbench.signals.series import stretches_of
from ehbench.vocabulary import grouped
from ehbench.vocabulary.codes import FUNCTIONS, LIMITS
from ehbench.vocabulary.quantities import GAUGES

FUNCTION_SHADES = (
    *("#e5e7eb", "#1f3f66", "#5b8fb9", "#a9c8e0", "#8a4b08", "#e08214", "#f3c583", "#2e7d5b"),
    *("#b5543c", "#7fb069", "#c2a5cf", "#80cdc1"),
)
_PLAIN = {"p_head": "head end", "p_rod": "rod end", "p_supply": "supply"}
LIMIT_SHADES = {1: ACCENT, 2: "#8e4585", 4: "#7a6a4f", 8: "#9ca3af", 16: "#d4a017"}


def moving(rig: Rig, record: Record) -> dict[str, list[str]]:
    """Channels by cylinder that is commanded or travels 1 % of its stroke, else all."""
    owned = (channel for channel in record.channels if "." in channel)
    groups = grouped(owned, lambda channel: channel.split(".")[0])
    strokes = {cylinder.name: float(cylinder.stroke) for cylinder in rig.cylinder}

    def moves(name: str) -> bool:
        stroke = f"{name}.x"
        commanded = any(c.endswith(".command") and np.ptp(record[c]) > 0.0 for c in groups[name])
        return commanded or (
            stroke in record and np.ptp(record[stroke]) > 0.01 * strokes.get(name, 0.0)
        )

    moved = [name for name in groups if moves(name)]
    return {name: channels for name, channels in groups.items() if name in (moved or groups)}


def uncontrolled(
    path: Path, rig: Rig, record: Record, cylinder: str, channels: Sequence[str]
) -> None:
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


def plot_channel(ax, rig: Rig, record: Record, name: str, **look: Any) -> None:
    """A channel over time, in the rig's unit; nothing where the log has none."""
    if name in record:
        ax.plot(*thin(record.t, shown(rig, name, record[name])), **look)


def stretches(t: np.ndarray, mask: np.ndarray, runs: int = 700) -> list[tuple[float, float]]:
    """(start, length) where ``mask`` holds; gaps shorter than 1/``runs`` are closed."""
    shortest = float(t[-1] - t[0]) / runs
    spans: list[list[float]] = []
    for start, stop in stretches_of(mask):
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
    """Bars over time: each case's working function, and the limits it met; legend handles."""
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
    """Draw the changing commands of a cylinder, saturation shaded; whether there is any."""
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
    """One trial: motion, pressures, commands, working function and limits over time."""
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
            name = f"{cylinder}.{word}"
            desired, shaped = f"{name}_desired", f"{name}_shaped"
            plot_channel(
                places[word], rig, record, name, color=RECORDED, linewidth=1.2, label="actual"
            )
            dashed: Look = {"color": SIMULATED, "linewidth": 1.5, "linestyle": (0, (4, 1.6))}
            plot_channel(places[word], rig, record, desired, label="desired", **dashed)
            if shaped in record and not np.array_equal(record[shaped], record[desired]):
                dotted: Look = {"color": MUTED, "linewidth": 1.0, "linestyle": ":"}
                plot_channel(places[word], rig, record, shaped, label="shaped", **dotted)
            places[word].set_title(axis(rig, word, text))
            places[word].margins(y=0.08)
            legend_right(places[word])
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
    """Estimates over time within their bounds, beside the true payload and measured oil."""
    learnt = [word for word in ESTIMATES if f"{case.cylinder}.{word}" in record]
    bounds = case.row.get("estimate_bounds", {})
    rows = -(-len(learnt) // 2)
    with canvas(path, rows, 2, (7.4, 1.95 * rows + 0.4), sharex=True, squeeze=False) as (_, axes):
        for ax in axes.flat[len(learnt) :]:
            ax.remove()
        for place, (ax, word) in enumerate(zip(axes.flat, learnt, strict=False)):
            name, height = f"{case.cylinder}.{word}", 0.24
            if word == "payload_estimate":
                height = 0.68  # clear of the lines
                seen = [f"{case.cylinder}.payload_{end}" for end in ("low", "high", "measured")]
                if all(channel in record for channel in seen):  # its interval, and itself
                    ends = (thin(record.t, shown(rig, name, record[name])) for name in seen[:2])
                    (low_t, low), (high_t, high) = ends
                    t = np.union1d(low_t, high_t)
                    low, high = np.interp(t, low_t, low), np.interp(t, high_t, high)
                    band: Look = {"color": SIMULATED, "alpha": 0.2, "linewidth": 0}
                    ax.fill_between(t, low, high, label="its interval", **band)
                    look: Look = {"color": SIMULATED, "linewidth": 1.0}
                    look["label"] = "by pressures and motion"
                    plot_channel(ax, rig, record, seen[2], **look)
            oil = record.channels.get(f"{case.cylinder}.bulk_measured", np.zeros(1))
            if word == "inverse_bulk" and np.ptp(oil) > 0.0:
                look = {"color": SIMULATED, "linewidth": 1.0}
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


def tip(path: Path, rig: Rig, case: Case, record: Record) -> None:
    """The tip's way, its error and that of each cylinder, flow against the pump's limit."""

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
    """Flow [m³/s] that controllers ask of the supply; None where none says so."""
    names = [f"{c.name}.{v.edge_name(e)}" for c, v, e in rig.edges() if e.from_ == "supply"]
    flows = [record[f"{n}.flow_desired"] for n in names if f"{n}.flow_desired" in record]
    return np.sum([np.abs(flow) for flow in flows], axis=0) if flows else None


def load_plane(path: Path, rig: Rig, record: Record, cylinder: str) -> None:
    """``load_force`` over ``v``, a colour for each working function; dashed what the supply's
    pressure can push and pull with nothing against it. Force and speed of one sign: the load
    resists; of two signs: it drives."""
    areas = next(item for item in rig.cylinder if item.name == cylinder).areas()
    pressures = (record[f"{cylinder}.p_head"], record[f"{cylinder}.p_rod"])
    force = areas[0] * pressures[0] - areas[1] * pressures[1]
    v, functions = record[f"{cylinder}.v"], flags_of(record, cylinder, "function")
    with canvas(path, 1, 1, (5.2, 4.2)) as (figure, ax):
        used = sorted(set(functions.tolist()))
        for function in used:
            there = np.where(functions == function, shown(rig, "v", v), np.nan)
            ax.plot(there, shown(rig, "load_force", force), color=FUNCTION_SHADES[function])
        supply = float(rig.supply.pressure)
        for limit in (areas[0] * supply, -areas[1] * supply):
            ax.axhline(shown(rig, "load_force", limit), color=ACCENT, linestyle=(0, (5, 3)))
        ax.axhline(0.0, color=MUTED, linewidth=0.7)
        ax.axvline(0.0, color=MUTED, linewidth=0.7)
        ax.set(xlabel=axis(rig, "v", "Speed"), ylabel=axis(rig, "load_force", "Load"))
        legend(figure, [swatch(words(FUNCTIONS[item]), FUNCTION_SHADES[item]) for item in used], 3)


Named = tuple[str, Case, Record]  # (controller, its trial, the log)
_DESIRED: Look = {"color": INK, "linewidth": 0.9, "linestyle": (0, (1, 1.2)), "zorder": 6}


def wide_panels(cases: Sequence[Named]) -> dict[str, float]:
    """Panels and their heights; errors of which one is 8 times another have a strip each."""
    errors = [case.row["tracking"]["max_error"] for _, case, _ in cases]
    if cases[0][1].steps:
        panels = {"v": 1.7, "x": 1.0}
    elif max(errors) > 8.0 * max(min(errors), 1e-12):
        panels = {"x": 1.0, **{f"error {i}": 0.62 for i in range(len(cases))}, "v": 1.0}
    else:
        panels = {"x": 1.0, "error": 1.7, "v": 1.0}
    panels |= {"p_head": 1.0, "p_rod": 1.0}
    if any(f"{case.cylinder}.function" in record for _, case, record in cases):
        panels["strip"] = 0.2 * len(cases) + 0.12
    return panels


def compare_controllers(path: Path, rig: Rig, cases: Sequence[Named]) -> None:
    """Several controllers on one motion: motion, pressures, functions, commands of up to three."""
    # the first line is the widest, so that those below are seen
    widths = np.linspace(2.6, 1.0, len(cases)) if len(cases) > 1 else [2.6]
    looks = [cycled(i, linewidth=float(width)) for i, width in enumerate(widths)]
    panels, commands = wide_panels(cases), len(cases) <= 3
    heights = [*panels.values(), *[1.1] * commands]
    size = (7.4, 1.15 * sum(heights) + 0.3 * len(heights) + 0.6)
    columns = len(cases) if commands else 1
    look: Look = {"squeeze": False, "height_ratios": heights}
    with canvas(path, len(heights), columns, size, **look) as (figure, axes):
        grid, handles, ax = axes[0, 0].get_gridspec(), [], None
        for row, word in enumerate(panels):
            for cell in axes[row]:
                cell.remove()
            ax = figure.add_subplot(grid[row, :], sharex=ax)
            ax.tick_params(labelbottom=row + 1 == len(panels))
            if word.startswith("error "):
                place = int(word.removeprefix("error "))
                plot_errors(ax, rig, cases[place : place + 1], looks[place : place + 1])
            elif word == "error":
                plot_errors(ax, rig, cases, looks)
            elif word == "strip":
                handles = function_bars(ax, cases, False)
            else:
                name = f"{cases[0][1].cylinder}.{word}"
                for (_, _, record), line in zip(cases, looks, strict=True):
                    plot_channel(ax, rig, record, name, **line)
                plot_channel(ax, rig, cases[0][2], f"{name}_desired", **_DESIRED)
                ax.set_title(axis(rig, word, title_of(word)))
                ax.margins(y=0.06)
        assert ax is not None
        ax.set_xlabel("time [s]")
        ax.set_xlim(min(r.t[0] for *_, r in cases), max(r.t[-1] for *_, r in cases))
        if commands and _commands_row(axes[-1], rig, cases):
            handles.append(swatch("an edge is saturated", ACCENT, alpha=0.2))
        lines = [key(words(c[0]), **line) for c, line in zip(cases, looks, strict=True)]
        lines.append(key("desired", **_DESIRED))
        figure.legend(handles=lines, loc="outside upper center", ncols=min(len(lines), 4))
        legend(figure, handles, 3)


def _commands_row(axes: Sequence[Any], rig: Rig, cases: Sequence[Named]) -> bool:
    """A panel of commands a controller, one axis and legend; whether an edge was saturated."""
    saturated = False
    labelled: dict[str, Any] = {}
    for ax, (name, _, record) in zip(axes, cases, strict=True):
        saturated |= plot_commands(ax, rig, record, cases[0][1].cylinder)
        ax.set_title(words(name), fontsize=8.5)
        ax.set_xlabel("time [s]")
        if ax is not axes[0]:
            ax.sharey(axes[0])
            ax.tick_params(labelleft=False)
        handles, labels = ax.get_legend_handles_labels()
        labelled |= zip(labels, handles, strict=True)
    axes[0].set_ylabel(axis(rig, "command", "commands"))
    if labelled:
        legend_right(axes[-1], [*labelled.values()], [*labelled])
    return saturated


def plot_errors(ax, rig: Rig, cases: Sequence[Named], looks: Sequence[Look]) -> None:
    """Tracking errors over time, actual minus desired; a single one is named with its largest."""
    errors = [(record.t, tracking_error(rig, record, case.cylinder)) for _, case, record in cases]
    for (t, error), look in zip(errors, looks, strict=True):
        ax.plot(*thin(t, error), **(look | {"linestyle": "-", "linewidth": 1.0}))
    ax.axhline(0.0, color=MUTED, linewidth=0.7)
    title, size = "Tracking error, actual minus desired", None
    if len(cases) == 1:
        maximum = number(float(np.abs(errors[0][1]).max()), 2)
        title, size = f"Error, {words(cases[0][0])}: at most {maximum}", 8.5
        ax.locator_params(axis="y", nbins=3)
    ax.set_title(axis(rig, "x", title), fontsize=size)


def trajectories(path: Path, rig: Rig, motions: Sequence[Named]) -> None:
    """Desired stroke, speed and acceleration of some motions over time."""
    rows = {"x": "stroke", "v": "speed", "a": "acceleration"}
    with canvas(path, len(rows), 1, (7.2, 5.0), sharex=True) as (figure, axes):
        for ax, (word, label) in zip(axes, rows.items(), strict=True):
            for (_, case, record), colour in zip(motions, CYCLE, strict=False):
                name = f"{case.cylinder}.{word}_desired"
                plot_channel(ax, rig, record, name, color=colour)
            ax.set_ylabel(axis(rig, word, label))
        axes[-1].set_xlabel("time [s]")
        named = zip(motions, CYCLE, strict=False)
        legend(figure, [key(words(name), color=colour) for (name, *_), colour in named])


def energy_map(
    path: Path,
    panels: Sequence[tuple[str, np.ndarray]],
    loads: Sequence[str],
    speeds: Sequence[str],
    unit: str,
) -> None:
    """For each controller its energies as shown, shape (loads, speeds), NaN where there is none:
    in per cent how far each lies above the least that any takes there, which is its shade."""
    minimum = np.fmin.reduce([energies for _, energies in panels])
    rows, darkest = math.ceil(len(panels) / 2), 1.0  # the share above the least that is darkest
    size = (7.4, rows * (0.42 * len(loads) + 0.75) + 0.5)
    shape = {"sharex": True, "sharey": True, "squeeze": False}
    with canvas(path, rows, 2, size, **shape) as (_, axes):
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
        for ax, (title, energies) in zip(axes.flat, panels, strict=False):
            above = energies / minimum - 1.0
            ax.pcolormesh(
                np.arange(len(speeds) + 1) - 0.5,
                np.arange(len(loads) + 1) - 0.5,
                np.minimum(above, darkest),
                cmap="Oranges",
                vmin=0.0,
                vmax=2.0 * darkest,  # so that numbers stay readable
                edgecolor="white",
            )
            for (row, column), energy in np.ndenumerate(energies):
                if np.isfinite(energy):
                    more = 100.0 * above[row, column]
                    text = f"{number(energy, 3)}\n" + (f"+{more:.0f} %" if more >= 0.5 else "least")
                    look = {"ha": "center", "va": "center", "fontsize": 7.5, "color": INK}
                    ax.text(column, row, text, **look)
            ax.set_title(title)
            ax.set_xticks(range(len(speeds)), speeds)
            ax.set_yticks(range(len(loads)), loads)
            ax.grid(False)
        axes[0, 0].set_ylabel(f"load; energy [{unit}]")
