"""Figures of a tuning: equivalent mass and gravity, damping over the gain, step responses,
draws.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

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
    Look,
    canvas,
    cycled,
    key,
    legend,
    tag,
)
from ehbench.report.words import axis, number, shown, words

_BLACK = "#111827"
_UNCOUNTED: Look = {"linestyle": (0, (1, 2))}  # how points look that no load calls for


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
    from scipy.interpolate import make_interp_spline

    with canvas(path, size=(7.2, 3.4)) as (_, ax):
        for index, equivalent in enumerate(tuning["equivalents"]):
            x, y = (np.array(equivalent[name], float) for name in ("x", what.key))
            look = cycled(index, label=load_name(equivalent["payload"]))
            ax.plot(shown(rig, "x", x), shown(rig, what.quantity, y), **look)
            points = [p["point"] for p in tuning["points"]]
            places = np.unique([p["x"] for p in points if p["payload"] == equivalent["payload"]])
            there = shown(rig, what.quantity, np.interp(places, x, y))
            ax.plot(shown(rig, "x", places), there, "o", markersize=4, color=look["color"])
        ax.set_xlabel(axis(rig, "x", "stroke"))
        ax.set_ylabel(axis(rig, what.quantity, what.title.lower()))
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.legend()
        if not isinstance(rig.mechanism, Slide) and tuning["equivalents"]:
            first = tuning["equivalents"][0]
            x, q = (shown(rig, n, np.array(first[n], float)) for n in ("x", "q"))
            up = np.argsort(q)
            # lines that go on straight beyond their ends, as an axis needs them
            ways = make_interp_spline(x, q, 1), make_interp_spline(q[up], x[up], 1)
            above = ax.secondary_xaxis("top", functions=ways)
            above.set_xlabel(axis(rig, "q", "joint angle"))
            above.spines["top"].set_visible(False)


def damping_over_gain(path: Path, rig: Rig, tuning: Table, low: float = -0.08) -> None:
    """Minimum damping ratio over K_p for every operating point, the worst of those that count,
    target and choice, down to ``low``.
    """
    gains = np.array(tuning["gains"], float)
    positive = gains > 0.0
    x = shown(rig, "feedback_gain", gains)[positive]
    names = function_names(tuning)
    colours = {name: CYCLE[i % len(CYCLE)] for i, name in enumerate(names)}
    with canvas(path, size=(7.4, 4.6)) as (figure, ax):
        for point in tuning["points"]:
            y = np.array(point["curve"], float)
            y[1:][(y[1:] < low) & (y[:-1] < low)] = np.nan  # beyond the frame
            look: Look = {"linewidth": 0.7, "alpha": 0.55}
            if not point["counts"]:
                look = {"linewidth": 0.8, "alpha": 0.5} | _UNCOUNTED
            ax.plot(x, y[positive], color=colours[point["point"]["function"]], **look)
        ax.plot(x, np.array(tuning["worst_curve"], float)[positive], color=_BLACK, linewidth=2.0)
        ax.axhline(tuning["target"], color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
        tag(ax, "target", 0.0, tuning["target"], (4, 3), "x", color=MUTED)
        ax.axhspan(low, 0.0, color=ACCENT, alpha=0.07, linewidth=0)
        tag(ax, "unstable", 0.0, low, (4, 3), "x", color=ACCENT)
        _choices(ax, rig, tuning, colours)
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
        ax.set(xlim=(x[0], x[-1]), ylim=(low, 1.02))
        ax.set_xlabel(axis(rig, "feedback_gain", "feedback gain K_p"))
        ax.set_ylabel("damping ratio of the least damped pole")
        counting = {point["point"]["function"] for point in tuning["points"] if point["counts"]}
        choice: Look = {"color": _BLACK, "linestyle": (0, (2, 2)), "linewidth": 0.9}
        ring: Look = {"marker": "o", "markersize": 6, "markerfacecolor": "white"}
        handles = [key("worst that counts", color=_BLACK, linewidth=2.0)]
        handles.append(key("choice", **choice, **ring))
        for name, colour in colours.items():
            text, look = (", shown only", _UNCOUNTED) if name not in counting else ("", {})
            handles.append(key(words(name) + text, color=colour, **look))
        legend(figure, handles, 3)


def _choices(ax, rig: Rig, tuning: Table, colours: Mapping[str, str]) -> None:
    """A line a chosen gain, with a ring at the minimum damping that it gives."""
    chosen = tuning["feedback_gain"]
    gains = sorted(set(chosen.values()))
    for gain in gains:
        functions = [name for name in colours if chosen[name] == gain]
        colour = _BLACK if len(gains) == 1 else colours[functions[0]]
        x = shown(rig, "feedback_gain", gain)
        ax.axvline(x, color=colour, linewidth=0.9, linestyle=(0, (2, 2)))
        reached = [
            point["damping_ratio_closed"]
            for point in tuning["points"]
            if point["counts"] and point["point"]["function"] in functions
        ]
        if reached:
            look: Look = {"markerfacecolor": "white", "markeredgecolor": colour, "zorder": 6}
            ax.plot([x], [min(reached)], "o", markersize=6.5, markeredgewidth=1.6, **look)


def step_responses(path: Path, steps: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A panel a payload: speed over desired speed, without any feedback and with it."""
    looks = {
        "v_open": ("without any feedback", {"color": RECORDED, "linewidth": 1.0}),
        "v_closed": ("with pressure feedback", {"color": SIMULATED, "linewidth": 1.8}),
    }
    with canvas(path, 1, len(steps), (7.4, 3.1), squeeze=False, sharey=True) as (figure, axes):
        for ax, step in zip(axes[0], steps, strict=True):
            t = np.array(step["t"], float)
            ax.axhline(1.0, color=MUTED, linewidth=0.8)
            for name, (_, look) in looks.items():
                ax.plot(t, step[name], **look)
            ax.set_title(load_name(by_name[step["name"]]["point"]["payload"]))
            ax.set_xlabel("time [s]")
            ax.set_xlim(0.0, t[-1])
        axes[0, 0].set_ylabel("speed over desired speed [1]")
        axes[0, 0].set_ylim(bottom=min(0.0, axes[0, 0].get_ylim()[0]))
        legend(figure, [key(text, **look) for text, look in looks.values()])


def draws(path: Path, tuning: Table) -> None:
    """A histogram of the worst damping ratio of each draw, with the target and the value at the
    identified parameters.
    """
    values = np.array(tuning["robustness"]["damping_ratios"], float)
    room = 0.02 * max(float(np.ptp(values)), 1e-3)
    with canvas(path, size=(7.2, 2.6)) as (_, ax):
        bins = np.linspace(values.min() - room, values.max() + room, 25)
        ax.hist(values, bins=bins, color=RECORDED, alpha=0.75)
        marks = [(tuning["target"], "target", ACCENT)]
        marks.append((tuning["damping_ratio"], "as identified", SIMULATED))
        sides = (("right", -3), ("left", 3))  # away from one another
        for (value, text, colour), (side, off) in zip(sorted(marks), sides, strict=True):
            ax.axvline(value, color=colour, linewidth=1.4)
            tag(ax, text, value, 1.0, (off, 1), "y", color=colour, ha=side, va="bottom")
        ax.set_xlabel("worst damping ratio over the operating points")
        ax.set_ylabel("draws")
        ax.margins(x=0.06)
