"""Figures of a tuning: equivalent mass and gravity, damping over the gain, step responses,
draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig, Slide
from ehbench.report.captions import load_name
from ehbench.report.saved import Table
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    MUTED,
    RECORDED,
    SIMULATED,
    canvas,
    cycled,
    key,
    legend,
)
from ehbench.report.words import axis, number, shown, words

_BLACK = "#111827"
_LOW = -0.08  # lower end of the axis of damping ratios
_SIDES = (("right", -3), ("left", 3))  # how a label lies at its line, and how far off


@dataclass(frozen=True)
class Equivalent:
    """A quantity of the arm as its cylinder feels it: key in the file, vocabulary row, title."""

    key: str
    quantity: str
    title: str


def function_names(tuning: Table) -> list[str]:
    """Working functions of a tuning, in its order."""
    return list(dict.fromkeys(point["point"]["function"] for point in tuning["points"]))


def equivalents(path: Path, rig: Rig, tuning: Table, what: Equivalent) -> None:
    """A curve a payload over the stroke, with dots at the operating points; the joint angle above
    (thesis B.1–B.4).
    """
    with canvas(path, size=(7.2, 3.4)) as (_, ax):
        for index, equivalent in enumerate(tuning["equivalents"]):
            x, y = (np.array(equivalent[name], float) for name in ("x", what.key))
            look = cycled(index, label=load_name(equivalent["payload"]))
            ax.plot(shown(rig, "x", x), shown(rig, what.quantity, y), **look)
            points = [p["point"] for p in tuning["points"]]
            at = np.unique([p["x"] for p in points if p["payload"] == equivalent["payload"]])
            there = shown(rig, what.quantity, np.interp(at, x, y))
            ax.plot(shown(rig, "x", at), there, "o", markersize=4, color=look["color"])
        ax.set_xlabel(axis(rig, "x", "stroke"))
        ax.set_ylabel(axis(rig, what.quantity, what.title.lower()))
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.legend()
        if not isinstance(rig.mechanism, Slide) and tuning["equivalents"]:
            first = tuning["equivalents"][0]
            x, q = (np.asarray(shown(rig, n, np.array(first[n], float))) for n in ("x", "q"))
            up = np.argsort(q)
            above = ax.secondary_xaxis("top", functions=(_straight(x, q), _straight(q[up], x[up])))
            above.set_xlabel(axis(rig, "q", "joint angle"))
            above.spines["top"].set_visible(False)


def _straight(x: np.ndarray, y: np.ndarray) -> Callable[[Any], np.ndarray]:
    """Interpolation that goes on straight beyond the ends, as an axis needs it."""

    def at(value: Any) -> np.ndarray:
        value = np.asarray(value, float)
        inside = np.interp(value, x, y)
        low, high = (y[1] - y[0]) / (x[1] - x[0]), (y[-1] - y[-2]) / (x[-1] - x[-2])
        return inside + low * np.minimum(value - x[0], 0.0) + high * np.maximum(value - x[-1], 0.0)

    return at


def damping_over_gain(path: Path, rig: Rig, tuning: Table) -> None:
    """Least damping ratio over K_p for every operating point, the worst of those that count, target
    and choice.
    """
    gains = np.array(tuning["gains"], float)
    retained = gains > 0.0
    x = np.asarray(shown(rig, "feedback_gain", gains))[retained]
    names = function_names(tuning)
    colours = {name: CYCLE[i % len(CYCLE)] for i, name in enumerate(names)}
    with canvas(path, size=(7.4, 4.6)) as (figure, ax):
        for point in tuning["points"]:
            _damping_curve(ax, x, retained, point, colours[point["point"]["function"]])
        ax.plot(x, np.array(tuning["worst_curve"], float)[retained], color=_BLACK, linewidth=2.0)
        ax.axhline(tuning["target"], color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
        _at_left(ax, "target", tuning["target"], MUTED)
        ax.axhspan(_LOW, 0.0, color=ACCENT, alpha=0.07, linewidth=0)
        _at_left(ax, "unstable", _LOW, ACCENT)
        _choices(ax, rig, tuning, colours)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
        ax.set_xlim(x[0], x[-1])
        ax.set_ylim(_LOW, 1.02)
        ax.set_xlabel(axis(rig, "feedback_gain", "feedback gain K_p"))
        ax.set_ylabel("damping ratio of the least damped pole")
        handles = _damping_handles(tuning, colours)
        figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _damping_curve(ax, x: np.ndarray, shown_at: np.ndarray, item: Table, colour: str) -> None:
    """The curve of an operating point; thin and dotted where it does not count."""
    y = np.array(item["curve"], float)
    y[1:][(y[1:] < _LOW) & (y[:-1] < _LOW)] = np.nan  # beyond the frame
    look: dict[str, Any] = {"linewidth": 0.7, "alpha": 0.55}
    if not item["counts"]:
        look = {"linewidth": 0.8, "alpha": 0.5, "linestyle": (0, (1, 2))}
    ax.plot(x, y[shown_at], color=colour, **look)


def _at_left(ax, text: str, y: float, colour: str) -> None:
    """A word at the left end of a horizontal line."""
    where = ("axes fraction", "data")
    ax.annotate(text, (0.0, y), (4, 3), where, "offset points", color=colour, fontsize=8)


def _choices(ax, rig: Rig, tuning: Table, colours: Mapping[str, str]) -> None:
    """A line a chosen gain, with a ring at the least damping that it gives."""
    chosen = tuning["feedback_gain"]
    gains = sorted(set(chosen.values()))
    for gain in gains:
        colour = (
            _BLACK if len(gains) == 1 else next(c for f, c in colours.items() if chosen[f] == gain)
        )
        at = float(shown(rig, "feedback_gain", gain))
        ax.axvline(at, color=colour, linewidth=0.9, linestyle=(0, (2, 2)))
        reached = [
            point["damping_ratio_closed"]
            for point in tuning["points"]
            if point["counts"] and chosen[point["point"]["function"]] == gain
        ]
        if reached:
            look = {"markerfacecolor": "white", "markeredgecolor": colour, "markeredgewidth": 1.6}
            ax.plot([at], [min(reached)], "o", markersize=6.5, zorder=6, **look)


def _damping_handles(tuning: Table, colours: Mapping[str, str]) -> list:
    counting = {point["point"]["function"] for point in tuning["points"] if point["counts"]}
    choice = {"color": _BLACK, "linestyle": (0, (2, 2)), "linewidth": 0.9}
    ring = {"marker": "o", "markersize": 6, "markerfacecolor": "white"}
    handles = [
        key("worst that counts", color=_BLACK, linewidth=2.0),
        key("choice", **choice, **ring),
    ]
    for name, colour in colours.items():
        mark = "-" if name in counting else (0, (1, 2))
        label = words(name) + ("" if name in counting else ", shown only")
        handles.append(key(label, color=colour, linestyle=mark))
    return handles


def step_responses(path: Path, steps: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A panel a payload: speed over desired speed, without any feedback and with it."""
    with canvas(path, 1, len(steps), (7.4, 3.1), squeeze=False, sharey=True) as (figure, axes):
        for ax, step in zip(axes[0], steps, strict=True):
            t = np.array(step["t"], float)
            ax.axhline(1.0, color=MUTED, linewidth=0.8)
            ax.plot(t, step["v_open"], color=RECORDED, linewidth=1.0)
            ax.plot(t, step["v_closed"], color=SIMULATED, linewidth=1.8)
            ax.set_title(load_name(by_name[step["name"]]["point"]["payload"]))
            ax.set_xlabel("time [s]")
            ax.set_xlim(0.0, t[-1])
        axes[0, 0].set_ylabel("speed over desired speed [1]")
        axes[0, 0].set_ylim(bottom=min(0.0, axes[0, 0].get_ylim()[0]))
        handles = [
            key("without any feedback", color=RECORDED, linewidth=1.0),
            key("with pressure feedback", color=SIMULATED, linewidth=1.8),
        ]
        legend(figure, handles)


def draws(path: Path, tuning: Table) -> None:
    """A histogram of the worst damping ratio of each draw, with the target and the value at the
    identified parameters.
    """
    robustness = tuning["robustness"]
    values = np.array(robustness["damping_ratios"], float)
    with canvas(path, size=(7.2, 2.6)) as (_, ax):
        width = max(float(np.ptp(values)), 1e-3)
        ax.hist(
            values,
            bins=np.linspace(values.min() - 0.02 * width, values.max() + 0.02 * width, 25),
            color=RECORDED,
            alpha=0.75,
        )
        marks = [(tuning["target"], "target", ACCENT)]
        marks.append((tuning["damping_ratio"], "as identified", SIMULATED))
        where = ("data", "axes fraction")  # above, and away from one another
        for (value, text, colour), (side, off) in zip(sorted(marks), _SIDES, strict=True):
            ax.axvline(value, color=colour, linewidth=1.4)
            look = {"color": colour, "fontsize": 8, "ha": side, "va": "bottom"}
            ax.annotate(text, (value, 1.0), (off, 1), where, "offset points", **look)
        ax.set_xlabel("worst damping ratio over the operating points")
        ax.set_ylabel("draws")
        ax.margins(x=0.06)
