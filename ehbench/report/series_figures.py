"""Figures over time and over lags: recorded against simulated, residual correlations, trials; and
the interval picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.record import Record
from ehbench.report.saved import Series, Table
from ehbench.report.style import (
    ACCENT,
    BUCKETS,
    CYCLE,
    MARKS,
    MUTED,
    RECORDED,
    SIMULATED,
    canvas,
    legend,
    thin,
)
from ehbench.report.words import axis, number, pretty, row_of, shown, unit_of, with_error
from ehbench.rig import Rig

_TITLES = {
    "q": "Joint angle",
    "qd": "Joint velocity",
    "x": "Stroke",
    "v": "Cylinder speed",
    "p_head": "Head-end pressure",
    "p_rod": "Rod-end pressure",
    "command": "Commands",
}
_STILL = 0.01  # share of the stroke that a cylinder without commands must travel to be drawn


def title_of(channel: str) -> str:
    """A channel's quantity as a panel title."""
    word = channel.rsplit(".", 1)[-1]
    return (
        _TITLES.get(word)
        or row_of(channel).meaning.split(",")[0].split("(")[0].strip().capitalize()
    )


def comparison(path: Path, rig: Rig, series: Series, channels: Sequence[str]) -> None:
    """A panel a channel, two in a row: recorded solid and thin, simulated dashed; below each the
    error (thesis Fig. 2.12).
    """
    from matplotlib.lines import Line2D

    both = [c for c in channels if c in series.recorded and c in series.simulated]
    columns = min(2, len(channels))
    rows = -(-len(channels) // columns)
    ratios = [3.4, 1] * rows if both else [1] * rows
    deep = 2 if both else 1
    with canvas(
        path,
        deep * rows,
        columns,
        (7.4, (2.7 if both else 2.0) * rows + 0.3),
        sharex=True,
        squeeze=False,
        height_ratios=ratios,
    ) as (
        figure,
        axes,
    ):
        for place in range(rows * columns):
            cells = axes[
                deep * (place // columns) : deep * (place // columns) + deep, place % columns
            ]
            if place >= len(channels):
                for ax in cells:
                    ax.remove()
                continue
            channel = channels[place]
            _overlay(cells[0], rig, series, channel)
            if channel in both:
                error = shown(rig, channel, series.simulated[channel]) - shown(
                    rig, channel, series.recorded[channel]
                )
                cells[1].plot(*thin(series.t, error), color=MUTED, linewidth=0.8)
                cells[1].axhline(0.0, color="#111827", linewidth=0.6)
                most = 1.1 * float(np.nanmax(np.abs(error), initial=1e-12))
                cells[1].set_ylim(-most, most)
                cells[1].set_ylabel("error", fontsize=8)
                cells[1].locator_params(axis="y", nbins=3)
            elif deep == 2:
                cells[1].remove()
            bottom = cells[1] if channel in both else cells[0]
            last = place + columns >= len(channels)
            bottom.tick_params(labelbottom=last)
            if last:
                bottom.set_xlabel("time [s]")
        handles = (
            [Line2D([], [], color=RECORDED, linewidth=1.0, label="recorded")]
            if series.recorded
            else []
        )
        handles += (
            [
                Line2D(
                    [],
                    [],
                    color=SIMULATED,
                    linewidth=1.7,
                    linestyle=(0, (4, 1.6)),
                    label="simulated",
                )
            ]
            if series.simulated
            else []
        )
        legend(figure, handles)


def _overlay(ax, rig: Rig, series: Series, channel: str) -> None:
    if channel in series.recorded:
        ax.plot(
            *thin(series.t, shown(rig, channel, series.recorded[channel])),
            color=RECORDED,
            linewidth=0.9,
        )
    if channel in series.simulated:
        ax.plot(
            *thin(series.t, shown(rig, channel, series.simulated[channel])),
            color=SIMULATED,
            linewidth=1.7,
            linestyle=(0, (4, 1.6)),
            alpha=0.95,
        )
    ax.set_title(axis(rig, channel, title_of(channel)))
    ax.margins(y=0.08)


def correlations(path: Path, channels: Sequence[Table]) -> None:
    """A column a channel: the residual's autocorrelation, and below its correlation with each
    earlier command, with bands.
    """
    cross = any(channel.get("cross_correlation") for channel in channels)
    rows = 2 if cross else 1
    commands = list(
        dict.fromkeys(
            one["of"] for channel in channels for one in channel.get("cross_correlation", [])
        )
    )
    looks = {
        name: (CYCLE[i % len(CYCLE)], MARKS[i % len(MARKS)]) for i, name in enumerate(commands)
    }
    with canvas(
        path, rows, len(channels), (7.4, 1.75 * rows + 0.5), sharex=True, sharey=True, squeeze=False
    ) as (figure, axes):
        for column, channel in enumerate(channels):
            top = axes[0, column]
            _banded(
                top,
                [channel["autocorrelation"]],
                {channel["autocorrelation"]["of"]: (RECORDED, "-")},
            )
            top.set_title(title_of(channel["channel"]), fontsize=8.5)
            if cross:
                _banded(axes[1, column], channel.get("cross_correlation", []), looks)
            axes[-1, column].set_xlabel("lag [s]")
        axes[0, 0].set_ylim(-1.05, 1.05)
        axes[0, 0].set_ylabel("with itself [1]")
        if cross:
            axes[1, 0].set_ylabel("with commands [1]")
            from matplotlib.lines import Line2D

            legend(
                figure,
                [
                    Line2D(
                        [], [], color=colour, linestyle=mark, label=name.removesuffix(".command")
                    )
                    for name, (colour, mark) in looks.items()
                ],
            )


def _banded(ax, found: Sequence[Table], looks: dict) -> None:
    for one in found:
        lag, value, band = (np.array(one[key], float) for key in ("lag", "value", "band"))
        ax.fill_between(lag, -band, band, color=MUTED, alpha=0.22 / len(found) ** 0.5, linewidth=0)
        colour, mark = looks[one["of"]]
        ax.plot(lag, value, color=colour, linestyle=mark, linewidth=1.1)
    ax.axhline(0.0, color=MUTED, linewidth=0.6)


def live(rig: Rig, record: Record) -> dict[str, list[str]]:
    """Channels to draw by cylinder: those with a changing command or some travel; all of them if
    none has.
    """
    groups: dict[str, list[str]] = {}
    for channel in record.channels:
        if "." in channel:
            groups.setdefault(channel.split(".")[0], []).append(channel)
    strokes = {cylinder.name: float(cylinder.stroke) for cylinder in rig.cylinder}

    def moves(name: str) -> bool:
        stroke = f"{name}.x"
        commanded = any(c.endswith(".command") and np.ptp(record[c]) > 0.0 for c in groups[name])
        return commanded or (
            stroke in record and np.ptp(record[stroke]) > _STILL * strokes.get(name, 0.0)
        )

    moved = [name for name in groups if moves(name)]
    return {name: channels for name, channels in groups.items() if name in (moved or groups)}


def trial(path: Path, rig: Rig, record: Record, cylinder: str, channels: Sequence[str]) -> None:
    """Commands, motion and pressures of one cylinder over one time axis."""
    commands = [c for c in channels if c.endswith(".command")]
    changing = [c for c in commands if np.ptp(record[c]) > 0.0]
    panels = [("Commands", changing)] if changing else []
    panels += [(title_of(c), [c]) for word in ("q", "qd") if (c := f"{cylinder}.{word}") in record]
    if f"{cylinder}.q" not in record:
        panels += [
            (title_of(c), [c]) for word in ("x", "v") if (c := f"{cylinder}.{word}") in record
        ]
    pressures = [c for c in (f"{cylinder}.p_head", f"{cylinder}.p_rod", "p_supply") if c in record]
    panels = [(text, names) for text, names in [*panels, ("Pressures", pressures)] if names]
    with canvas(
        path, len(panels), 1, (7.4, 1.55 * len(panels) + 0.4), sharex=True, squeeze=False
    ) as (figure, axes):
        for ax, (text, names) in zip(axes[:, 0], panels, strict=True):
            for index, name in enumerate(names):
                line = {
                    "color": CYCLE[index % len(CYCLE)],
                    "linestyle": MARKS[index % len(MARKS)],
                    "linewidth": 1.2,
                }
                where = {"drawstyle": "steps-post"} if name.endswith(".command") else {}
                ax.plot(
                    *thin(record.t, shown(rig, name, record[name]), 2 * BUCKETS),
                    label=_short(name, cylinder),
                    **line,
                    **where,
                )
            ax.set_title(axis(rig, names[0], text))
            ax.margins(y=0.1)
            if len(names) > 1:
                ax.legend(loc="center left", bbox_to_anchor=(1.005, 0.5), borderaxespad=0.0)
        if "stopped" in record.meta:
            t = stop_time(record)
            if t is not None:
                for ax in axes[:, 0]:
                    ax.axvline(t, color=ACCENT, linewidth=1.1, linestyle=(0, (2, 2)))
                axes[0, 0].annotate(
                    "stopped",
                    (t, 1.0),
                    (3, -2),
                    ("data", "axes fraction"),
                    "offset points",
                    color=ACCENT,
                    fontsize=8,
                    va="top",
                )
        axes[-1, 0].set_xlabel("time [s]")


def stop_time(record: Record) -> float | None:
    """When the trial was stopped [s], as the log's own words end with."""
    try:
        return float(record.meta["stopped"].rsplit("t = ", 1)[1].split()[0])
    except (IndexError, ValueError):
        return None


def _short(name: str, cylinder: str) -> str:
    words = {"p_head": "head end", "p_rod": "rod end", "p_supply": "supply"}
    rest = name.removeprefix(f"{cylinder}.").removesuffix(".command")
    return words.get(rest, rest)


def parameters(path: Path, rig: Rig, fitted: Sequence[Table]) -> None:
    """A strip a parameter, each in its unit: value with 95 % interval on the bounds of the search,
    and its start.
    """
    with canvas(path, len(fitted), 1, (7.2, 0.72 * len(fitted) + 0.3), squeeze=False) as (
        figure,
        axes,
    ):
        for ax, one in zip(axes[:, 0], fitted, strict=True):
            name = one["name"]
            value, start, low, high = (
                _in(rig, name, one.number(key)) for key in ("value", "start", "lower", "upper")
            )
            ends = one.get("interval") or (None, None)
            ends = [_in(rig, name, end) for end in ends]
            known = [v for v in (value, start, low, high, *ends) if v is not None]
            least, most = min(known), max(known)
            if least > 0.0 and most / least > 30.0:
                ax.set_xscale("log")
                ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
                ax.set_xlim(least / (most / least) ** 0.03, most * (most / least) ** 0.03)
            else:
                pad = 0.03 * ((most - least) or abs(most) or 1.0)
                ax.set_xlim(least - pad, most + pad)
            left, right = ax.get_xlim()
            ax.plot(
                [left if low is None else low, right if high is None else high],
                [0, 0],
                color="#d1d5db",
                linewidth=7,
                solid_capstyle="butt",
            )
            if None not in ends:
                ax.plot(ends, [0, 0], color=RECORDED, linewidth=3, solid_capstyle="butt")
            ax.plot(
                [start],
                [0],
                "o",
                markersize=6,
                markerfacecolor="white",
                markeredgecolor=MUTED,
                markeredgewidth=1.2,
            )
            colour = RECORDED if one["status"] == "estimated" else ACCENT
            ax.plot([value], [0], "o", markersize=5.5, color=colour)
            ax.set_yticks([])
            ax.set_ylim(-1, 1)
            ax.spines["left"].set_visible(False)
            ax.tick_params(axis="x", labelsize=7.5, pad=1)
            text = f"{with_error(value, _in(rig, name, one.number('std')))} {pretty(unit_of(rig, name))}".rstrip()
            ax.set_title(f"{name}   {text}", fontsize=8.5, pad=2)
            ax.set_title(
                one["status"].replace("_", " "),
                loc="right",
                fontsize=8,
                pad=2,
                color=colour,
                fontweight="normal",
            )


def _in(rig: Rig, name: str, value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(shown(rig, name, value))
