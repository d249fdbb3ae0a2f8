"""Several controllers on one motion, and what they took from the pump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.figures.trial import (
    function_bars,
    plot_channel,
    plot_commands,
    shade_saturation,
    tracking_error,
)
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    INK,
    MUTED,
    canvas,
    cycled,
    key,
    legend,
    swatch,
    thin,
)
from ehbench.report.words import axis, number, shown, title_of, words

Named = tuple[str, Case, Record]  # (controller, its trial, the log)
_DESIRED = {"color": INK, "linewidth": 0.9, "linestyle": (0, (1, 1.2)), "zorder": 6}


@dataclass(frozen=True)
class _Grid:
    """The rows of a comparison: panels over the whole width, then a panel of commands a
    controller.
    """

    panels: Sequence[str]
    heights: Sequence[float]
    columns: int
    commands: bool

    @property
    def tall(self) -> float:
        return 1.15 * sum(self.heights) + 0.3 * len(self.heights) + 0.6


def _grid(cases: Sequence[Named], far_apart: float = 8.0, commands_of: int = 3) -> _Grid:
    """The rows: each controller has a strip for its error where the largest errors are
    ``far_apart`` by ratio; commands of so many controllers at most.
    """
    case = cases[0][1]
    if case.steps:
        panels, heights = ["v", "x"], [1.7, 1.0]
    else:
        errors = [case.row["tracking"]["max_error"] for _, case, _ in cases]
        if max(errors) > far_apart * max(min(errors), 1e-12):
            panels = ["x", *(f"error {i}" for i in range(len(cases))), "v"]
            heights = [1.0, *[0.62] * len(cases), 1.0]
        else:
            panels, heights = ["x", "error", "v"], [1.0, 1.7, 1.0]
    panels += ["p_head", "p_rod"]
    heights += [1.0, 1.0]
    if any(f"{case.cylinder}.function" in record for _, _, record in cases):
        panels.append("strip")
        heights.append(0.2 * len(cases) + 0.12)
    commands = len(cases) <= commands_of
    return _Grid(panels, heights + [1.1] * commands, len(cases) if commands else 1, commands)


def compare(path: Path, rig: Rig, cases: Sequence[Named]) -> None:
    """Several controllers on one motion: stroke, speed and tracking error, both pressures,
    functions, and their commands.
    """
    # the first line is the widest, so that those below are seen
    widths = np.linspace(2.6, 1.0, len(cases)) if len(cases) > 1 else [2.6]
    looks = [cycled(i, linewidth=float(width)) for i, width in enumerate(widths)]
    grid = _grid(cases)
    shape = {"squeeze": False, "height_ratios": grid.heights}
    with canvas(path, len(grid.heights), grid.columns, (7.4, grid.tall), **shape) as (figure, axes):
        places = _wide_panels(figure, axes, grid.panels)
        for word, ax in places.items():
            if word.startswith("error "):
                at = int(word.removeprefix("error "))
                _errors(ax, rig, cases[at : at + 1], looks[at : at + 1])
            elif word == "error":
                _errors(ax, rig, cases, looks)
            elif word != "strip":
                _overlay(ax, rig, cases, looks, word)
        handles = function_bars(places["strip"], cases, False) if "strip" in places else []
        bottom = places[grid.panels[-1]]
        bottom.set_xlabel("time [s]")
        bottom.set_xlim(min(r.t[0] for *_, r in cases), max(r.t[-1] for *_, r in cases))
        if grid.commands and _commands_row(axes[-1], rig, cases):
            handles.append(swatch("an edge is saturated", ACCENT, alpha=0.2))
        lines = [key(words(c[0]), **look) for c, look in zip(cases, looks, strict=True)]
        lines.append(key("desired", **_DESIRED))
        figure.legend(handles=lines, loc="outside upper center", ncols=min(len(lines), 4))
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _wide_panels(figure, axes: np.ndarray, panels: Sequence[str]) -> dict[str, Any]:
    """One panel over all columns of a row each, with one time axis, named in the last."""
    grid = axes[0, 0].get_gridspec()
    places: dict[str, Any] = {}
    for row, panel in enumerate(panels):
        for ax in axes[row]:
            ax.remove()
        first = next(iter(places.values()), None)
        places[panel] = figure.add_subplot(grid[row, :], sharex=first)
    for panel in panels[:-1]:
        places[panel].tick_params(labelbottom=False)
    return places


def _overlay(
    ax, rig: Rig, cases: Sequence[Named], looks: Sequence[dict[str, Any]], word: str
) -> None:
    """A channel of every controller, and what was desired."""
    name = f"{cases[0][1].cylinder}.{word}"
    for (_, _, record), look in zip(cases, looks, strict=True):
        plot_channel(ax, rig, record, name, **look)
    if f"{name}_desired" in cases[0][2]:
        plot_channel(ax, rig, cases[0][2], f"{name}_desired", **_DESIRED)
    ax.set_title(axis(rig, word, title_of(word)))
    ax.margins(y=0.06)


def _commands_row(axes: Sequence[Any], rig: Rig, cases: Sequence[Named]) -> bool:
    """A panel of commands a controller, on one axis; one legend at the right. Whether an edge was
    ever saturated, which is shaded.
    """
    saturated = False
    for index, (ax, (name, _, record)) in enumerate(zip(axes, cases, strict=True)):
        cylinder = cases[0][1].cylinder
        plot_commands(ax, rig, record, cylinder)
        saturated |= shade_saturation(ax, record, cylinder)
        ax.set_title(words(name), fontsize=8.5)
        ax.set_xlabel("time [s]")
        if index:
            ax.sharey(axes[0])
            ax.tick_params(labelleft=False)
    axes[0].set_ylabel(axis(rig, "command", "commands"))
    labelled = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    if labelled:
        where = {"loc": "center left", "bbox_to_anchor": (1.01, 0.5), "handlelength": 1.8}
        axes[-1].legend(labelled.values(), labelled.keys(), **where)
    return saturated


def _errors(ax, rig: Rig, cases: Sequence[Named], looks: Sequence[dict[str, Any]]) -> None:
    """Tracking errors over time, actual minus desired; a single one is named with its largest."""
    errors = [(record.t, tracking_error(rig, record, case.cylinder)) for _, case, record in cases]
    for (t, error), look in zip(errors, looks, strict=True):
        ax.plot(*thin(t, error), **(look | {"linestyle": "-", "linewidth": 1.0}))
    ax.axhline(0.0, color=MUTED, linewidth=0.7)
    if len(cases) == 1:
        maximum = number(float(np.abs(errors[0][1]).max()), 2)
        title = f"Error, {words(cases[0][0])}: at most {maximum}"
        ax.locator_params(axis="y", nbins=3)
    else:
        title = "Tracking error, actual minus desired"
    ax.set_title(axis(rig, "x", title), fontsize=8.5 if len(cases) == 1 else None)


def trajectories(path: Path, rig: Rig, motions: Sequence[Named]) -> None:
    """Desired stroke, speed and acceleration of some motions over time."""
    rows = [("x", "stroke"), ("v", "speed"), ("a", "acceleration")]
    with canvas(path, len(rows), 1, (7.2, 5.0), sharex=True) as (figure, axes):
        handles = []
        for (name, case, record), colour in zip(motions, CYCLE, strict=False):
            handles.append(key(words(name), color=colour))
            for ax, (word, _) in zip(axes, rows, strict=True):
                channel = f"{case.cylinder}.{word}_desired"
                if channel in record:
                    y = np.asarray(shown(rig, word, record[channel]), float)
                    ax.plot(*thin(record.t, y), color=colour)
        for ax, (word, label) in zip(axes, rows, strict=True):
            ax.set_ylabel(axis(rig, word, label))
        axes[-1].set_xlabel("time [s]")
        legend(figure, handles)


def pump_energies(path: Path, rig: Rig, cases: Sequence[Case], names: Sequence[str]) -> None:
    """A bar a trial: what it took from the pump."""
    values = [float(shown(rig, "energy", case.row["energy"]["pump"])) for case in cases]
    controllers = list(dict.fromkeys(case.row["controller"] for case in cases))
    with canvas(path, size=(7.4, 0.3 * len(cases) + 0.9)) as (_, ax):
        colours = [CYCLE[controllers.index(case.row["controller"]) % len(CYCLE)] for case in cases]
        ax.barh(range(len(cases)), values, height=0.66, color=colours, zorder=2)
        for place, value in enumerate(values):
            ax.annotate(
                number(value, 4),
                (max(value, 0.0), place),
                (4, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
            )
        ax.set_yticks(range(len(cases)), [words(name) for name in names])
        ax.set_ylim(len(cases) - 0.4, -0.6)
        ax.set_xlim(min(0.0, *values), 1.12 * max(*values, 1e-12))
        ax.grid(False, axis="y")
        ax.set_xlabel(axis(rig, "energy", "energy from the pump"))
