"""Recorded against simulated, over time and frequency, and ringing side by side."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import FigureIndex, Saved, Series, Table
from ehbench.report.style import MUTED, RECORDED, SIMULATED, Look, canvas, key, legend, thin
from ehbench.report.template import Template
from ehbench.report.words import axis, number, pretty, shown, title_of, unit_of, words
from ehbench.signals.series import stretches_of

_FAR_OFF = 0.1  # share of a channel's range
_TWINS = {"x": "q", "v": "qd"}  # a joint's angle and its cylinder's stroke say the same


def draw_comparisons(run: Saved, index: FigureIndex, log: str, kind: str, lead: str) -> None:
    """A figure for each cylinder of a log, recorded against simulated.

    Args:
        kind: of the figure: ``fit`` leaves a stroke out where its joint's angle is there.
        lead: what the title begins with."""
    series = run.series(log)
    if series is None:
        return
    page = Template("comparisons", run.rig)
    for cylinder, channels in series.cylinders().items():
        if kind == "fit":
            twins = {name: _TWINS.get(name.rpartition(".")[2]) for name in channels}
            channels = [name for name in channels if f"{cylinder}.{twins[name]}" not in channels]
        caption = page.text(
            "caption",
            simulated=any(channel in series.simulated for channel in channels),
            lasting=lasting(series, channels),
            off=_FAR_OFF,
        )
        title = f"{lead}: {words(log)}" + (f", {cylinder}" if cylinder else "")
        about = {"log": log, "cylinder": cylinder}
        path = index.add(f"{kind}_{log}_{cylinder}", title, caption, kind, **about)
        draw_panels(path, run.rig, series, channels)


def draw_responses(
    run: Saved,
    index: FigureIndex,
    kind: str,
    log: str,
    key: str,
    result: Sequence[Table],
    limit: float,
) -> None:
    """Frequency responses of a log to one command, where the coherence reaches a limit."""
    command = result[0]["input"].removesuffix(".command")
    caption = Template("comparisons").text("responses")
    title = f"Response to {command} in {words(log)}"
    draw_sweeps(index.add(key, title, caption, kind, log=log), run.rig, result, limit)


def lasting(series: Series, channels: Sequence[str]) -> list[tuple[str, float]]:
    """(channel, time [s]) where a simulation is far off to one side for a fifth of the log."""
    lasting, t = [], series.t
    for channel in channels:
        if channel not in series.recorded or channel not in series.simulated:
            continue
        recorded = series.recorded[channel]
        error = series.simulated[channel] - recorded
        limit = _FAR_OFF * float(np.ptp(recorded[np.isfinite(recorded)], axis=0))
        longest = 0.0
        for beyond in (error > limit, -error > limit):
            starts, ends = stretches_of(beyond).T
            spans = t[np.minimum(ends, t.size - 1)] - t[starts]
            longest = max(longest, float(np.max(spans, initial=0.0)))
        if limit > 0.0 and longest >= 0.2 * float(t[-1] - t[0]):
            lasting.append((channel, longest))
    return lasting


_RECORDED: Look = {"color": RECORDED, "linewidth": 0.9}
_SIMULATED: Look = {"color": SIMULATED, "linewidth": 1.7, "linestyle": (0, (4, 1.6))}


def draw_panels(path: Path, rig: Rig, series: Series, channels: Sequence[str]) -> None:
    """Recorded solid, simulated dashed, below each the error (thesis Fig. 2.12)."""
    both = {c for c in channels if c in series.recorded and c in series.simulated}
    columns = min(2, len(channels))
    rows = -(-len(channels) // columns)
    deep = 2 if both else 1
    size = (7.4, (2.7 if both else 2.0) * rows + 0.3)
    ratios = [3.4, 1] * rows if both else [1] * rows
    look = {"sharex": True, "squeeze": False, "height_ratios": ratios}
    with canvas(path, deep * rows, columns, size, **look) as (figure, axes):
        for place in range(rows * columns):
            top = deep * (place // columns)
            cells = axes[top : top + deep, place % columns]
            if place >= len(channels):
                for ax in cells:
                    ax.remove()
            else:
                last = place + columns >= len(channels)
                recorded, simulated = (
                    shown(rig, channels[place], side.get(channels[place]))
                    for side in (series.recorded, series.simulated)
                )
                main = bottom = cells[0]
                if recorded is not None:
                    main.plot(*thin(series.t, recorded), **_RECORDED)
                if simulated is not None:
                    main.plot(*thin(series.t, simulated), alpha=0.95, **_SIMULATED)
                main.set_title(axis(rig, channels[place], title_of(channels[place])))
                main.margins(y=0.08)
                if recorded is not None and simulated is not None:
                    bottom, error = cells[1], simulated - recorded
                    bottom.plot(*thin(series.t, error), color=MUTED, linewidth=0.8)
                    bottom.axhline(0.0, color="#111827", linewidth=0.6)
                    maximum = 1.1 * float(np.nanmax(np.abs(error), initial=1e-12))
                    bottom.set_ylim(-maximum, maximum)
                    bottom.set_ylabel("error", fontsize=8)
                    bottom.locator_params(axis="y", nbins=3)
                elif len(cells) == 2:
                    cells[1].remove()
                bottom.tick_params(labelbottom=last)
                if last:
                    bottom.set_xlabel("time [s]")
        handles = [key("recorded", **_RECORDED | {"linewidth": 1.0})] if series.recorded else []
        handles += [key("simulated", **_SIMULATED)] if series.simulated else []
        legend(figure, handles)


_LOOKS = {
    "recorded": {"color": RECORDED, "linestyle": "-", "marker": "o", "markersize": 2.2},
    "simulated": {"color": SIMULATED, "linestyle": (0, (4, 1.6)), "marker": "", "linewidth": 1.7},
}


def draw_sweeps(path: Path, rig: Rig, result: Sequence[Table], minimum: float) -> None:
    """A column a channel: coherence; gain and phase where it reaches ``minimum``."""
    from matplotlib.ticker import LogLocator

    rows = ("gain", "phase", "coherence")
    shape = {"sharex": True, "squeeze": False, "height_ratios": (3, 3, 1.6)}
    with canvas(path, 3, len(result), (7.4, 5.4), **shape) as (figure, axes):
        for column, sweep in enumerate(result):
            top, middle, bottom = axes[:, column]
            coherent = np.array(sweep["recorded"]["coherent"], bool)
            scale = shown(rig, sweep["channel"], 1.0) - shown(rig, sweep["channel"], 0.0)
            for side, look in _LOOKS.items():
                if sweep.get(side) is None:
                    continue
                frequency, gain, phase, coherence = (
                    np.array(sweep[side][row], float) for row in ("frequency", *rows)
                )
                if side == "simulated":  # on the nearest turn
                    recorded = np.array(sweep["recorded"]["phase"], float)
                    phase = phase + 360.0 * np.round((recorded - phase) / 360.0)
                top.plot(frequency[coherent], scale * gain[coherent], **look)
                middle.plot(frequency[coherent], phase[coherent], **look)
                bottom.plot(frequency, coherence, **look | {"marker": ""})
            unit = pretty(unit_of(rig, sweep["channel"]))
            title = title_of(sweep["channel"])
            top.set_title(f"{title} [{unit}/V]" if unit else title, fontsize=8.5)
            top.set(xscale="log", yscale="log")
            for way, marks in (
                (top.xaxis, (1.0, 2.0, 5.0)),
                (top.yaxis, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)),
            ):
                way.set_major_locator(LogLocator(subs=marks, numticks=9))
                way.set_major_formatter(lambda tick, _: number(tick))
                way.set_minor_formatter(lambda tick, _: "")
            middle.locator_params(axis="y", nbins=6)
            bottom.axhline(minimum, color=MUTED, linewidth=0.8, linestyle="--")
            bottom.set_ylim(0.0, 1.05)
            bottom.set_xlabel("frequency [Hz]")
        for ax, row in zip(axes[:, 0], rows, strict=True):
            ax.set_ylabel("phase [°]" if row == "phase" else row)
        legend(figure, [key(side, **look) for side, look in _LOOKS.items()])
