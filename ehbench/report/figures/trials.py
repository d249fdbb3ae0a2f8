"""Several controllers on one motion, and what they took from the pump."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.figures.trial import function_bars, plot_channel, plot_commands, tracking_error
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    INK,
    MUTED,
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
from ehbench.report.words import axis, number, shown, title_of, words

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


def pump_energies(path: Path, rig: Rig, cases: Sequence[Case], names: Sequence[str]) -> None:
    """A bar a trial: what it took from the pump."""
    values = [shown(rig, "energy", case.row["energy"]["pump"]) for case in cases]
    controllers = list(dict.fromkeys(case.row["controller"] for case in cases))
    with canvas(path, size=(7.4, 0.3 * len(cases) + 0.9)) as (_, ax):
        colours = [CYCLE[controllers.index(case.row["controller"]) % len(CYCLE)] for case in cases]
        ax.barh(range(len(cases)), values, height=0.66, color=colours, zorder=2)
        for place, value in enumerate(values):
            tag(ax, number(value, 4), max(value, 0.0), place, (4, 0), va="center")
        ax.set_yticks(range(len(cases)), [words(name) for name in names])
        ax.set_ylim(len(cases) - 0.4, -0.6)
        ax.set_xlim(min(0.0, *values), 1.12 * max(*values, 1e-12))
        ax.grid(False, axis="y")
        ax.set_xlabel(axis(rig, "energy", "energy from the pump"))


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
