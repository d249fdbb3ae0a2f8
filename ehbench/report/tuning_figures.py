"""Figures of a tuning: equivalent mass and gravity, root loci, step responses, damping over the
gain, draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.report.saved import Saved, Table
from ehbench.report.style import (
    ACCENT,
    CYCLE,
    INK,
    MARKS,
    MUTED,
    RECORDED,
    SIMULATED,
    canvas,
    legend,
)
from ehbench.report.telling import capital, span
from ehbench.report.words import axis, count, number, pretty, shown, unit_of, words
from ehbench.rig import Rig, Slide

if TYPE_CHECKING:
    from ehbench.report.figures import Album

RATIOS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)  # damping ratios of the grid
_ROOM = 0.06  # share of a root locus below the real axis
_FAR = 3.0  # a stability limit this many times as far out as what swings makes a second look worth while
_ON_AXIS = 1e-3  # share of a root locus's height that counts as on an axis, and damping ratio that counts as none
BETWEEN = 7  # points of a root locus drawn between two saved ones
_PALE, _BEYOND = "#d1d5db", "#9db4cf"


def load_name(payload: str) -> str:
    """A payload as people say it."""
    return "no load" if payload == "none" else payload


def measure(rig: Rig, name: str, value: float | None, digits: int = 3) -> str:
    """An SI value in the rig's unit, with the unit."""
    if value is None:
        return number(None)
    unit = pretty(unit_of(rig, name))
    return f"{number(float(shown(rig, name, value)), digits)}" + (
        f"{'' if unit == '°' else ' '}{unit}" if unit else ""
    )


def function_names(tuning: Table) -> list[str]:
    """Working functions of a tuning, in its order."""
    return list(dict.fromkeys(one["point"]["function"] for one in tuning["points"]))


def payloads_of(tuning: Table) -> list[str]:
    """Payloads of a tuning, in its order."""
    return [one["payload"] for one in tuning["equivalents"]]


def counted(tuning: Table) -> list[Table]:
    """The operating points that the gain was chosen on."""
    return [one for one in tuning["points"] if one["counts"]]


def draw_tuning(run: Saved, album: Album) -> None:
    """Every figure of a tune run."""
    rig, tuning = run.rig, run.json("tuning.json")
    cylinder = words(tuning["cylinder"])
    for key, name, quantity, text in (
        ("equivalent_mass", "mass", "mass", "Equivalent mass"),
        ("equivalent_gravity", "gravity_force", "force", "Equivalent gravity force"),
    ):
        unit = pretty(unit_of(rig, quantity))
        said = "; ".join(
            f"{load_name(one['payload'])}: {span([float(shown(rig, quantity, v)) for v in one[name]])} {unit}"
            for one in tuning["equivalents"]
        )
        caption = f"{text} of the {cylinder} at its cylinder over the stroke, other joints held; dots: operating points. "
        caption += f"{capital(said)}."
        equivalents(
            album.add(key, f"{text}: {cylinder}", caption, kind="equivalents"),
            rig,
            tuning,
            name,
            quantity,
            text,
        )
    path = album.add(
        "damping_over_gain",
        "Damping ratio over the feedback gain",
        _damping_said(rig, tuning),
        kind="damping",
    )
    damping_over_gain(path, rig, tuning)
    by_name = {one["name"]: one for one in tuning["points"]}
    for function in function_names(tuning):
        counts = (
            "yes" if any(one["point"]["function"] == function for one in counted(tuning)) else "no"
        )
        about = {"function": function, "counts": counts}
        for parameter, lead, text in (
            ("feedback_gain", "locus", "Root locus over the feedback gain"),
            ("washout", "locus_washout", "Root locus over the washout corner"),
        ):
            mine = [
                one
                for one in tuning["loci"]
                if one["parameter"] == parameter
                and by_name[one["name"]]["point"]["function"] == function
            ]
            if mine:
                caption = _locus_said(rig, mine, by_name, counts == "yes")
                path = album.add(
                    f"{lead}_{function}",
                    f"{text}: {cylinder}, {words(function)}",
                    caption,
                    kind="locus",
                    **about,
                )
                loci(path, rig, mine, by_name)
        mine = [
            one for one in tuning["steps"] if by_name[one["name"]]["point"]["function"] == function
        ]
        if mine:
            title = f"Step response: {cylinder}, {words(function)}"
            path = album.add(
                f"step_response_{function}",
                title,
                _steps_said(mine, by_name),
                kind="step_response",
                **about,
            )
            step_responses(path, mine, by_name)
    if tuning["robustness"]["draws"]:
        path = album.add(
            "draws",
            "Worst damping ratio over draws of the identified parameters",
            draws_said(tuning),
            kind="draws",
        )
        draws(path, tuning)


# --- sentences, computed from the run
# -------------------------------------------------------------------------------------


def _damping_said(rig: Rig, tuning: Table) -> str:
    gains = sorted(set(tuning["feedback_gain"].values()))
    chosen = (
        " and ".join(measure(rig, "feedback_gain", gain) for gain in gains)
        if len(gains) < 4
        else f"{len(gains)} gains"
    )
    points = counted(tuning)
    least = min(points, key=lambda one: one["damping_ratio_closed"])
    return (
        f"Least damping ratio of all poles, a line an operating point; black: the worst of the {len(points)} that count"
        + (
            "; dotted: points that no load calls for. "
            if len(points) < len(tuning["points"])
            else ". "
        )
        + f"At K_p = {chosen} the worst is {number(tuning['damping_ratio'], 2)} ({point_name(rig, least['point'])}); "
        "without feedback "
        f"{span([tuning['damping_ratio_open'], tuning['damping_ratio_open_most']], 2)}."
    )


def point_name(rig: Rig, point: Table) -> str:
    """An operating point in words: function, payload, stroke and speed in the rig's units."""
    v = float(shown(rig, "v", point["v"]))
    return (
        f"{words(point['function'])}, {load_name(point['payload'])}, x = {measure(rig, 'x', point['x'])}, "
        f"v = {'+' if v > 0 else ''}{number(v, 3)} {pretty(unit_of(rig, 'v'))}"
    )


def _locus_said(rig: Rig, mine: Sequence[Table], by_name: dict[str, Table], counts: bool) -> str:
    lead = "At the operating point of each payload that is least damped with feedback. Dark: up to the choice; pale: beyond; × at zero, ● at the choice. "
    if not counts:
        lead = "No load calls for this function here; shown, not counted. " + lead
    said = []
    for one in mine:
        result, load = by_name[one["name"]], load_name(by_name[one["name"]]["point"]["payload"])
        if one["parameter"] == "feedback_gain":
            text = (
                f"{load}: damping ratio {number(result['damping_ratio_open'], 2)} without feedback, "
                f"{number(result['damping_ratio_closed'], 2)} at K_p = {measure(rig, 'feedback_gain', one['chosen'])}"
            )
            if one.get("crossing") is not None:
                text += f", unstable above {number(one['crossing'] / one['chosen'], 3)} times that"
            else:
                text += ", stable over the whole range looked at"
        else:
            text = f"{load}: corner chosen at {measure(rig, 'washout', one['chosen'])}"
            text += f", damping ratio {number(result['damping_ratio_closed'], 2)}"
            plain = result.get("damping_ratio_plain")
            text += f" (without a washout {number(plain, 2)})" if plain is not None else ""
        said.append(text)
    return lead + capital("; ".join(said)) + "."


def overshoot_of(values: Sequence[float]) -> float | None:
    """Overshoot of a response over its last value, as a share of it; None where it ends at zero."""
    y = np.asarray(values, float)
    return None if y[-1] == 0.0 else max(0.0, float((y * np.sign(y[-1])).max() / abs(y[-1]) - 1.0))


def _steps_said(mine: Sequence[Table], by_name: dict[str, Table]) -> str:
    said = []
    for one in mine:
        result = by_name[one["name"]]
        ends = [overshoot_of(one[key]) for key in ("v_open", "v_closed")]
        shares = [number(None if end is None else 100.0 * end, 2) for end in ends]
        said.append(
            f"{load_name(result['point']['payload'])}: overshoot over the last value {shares[0]} % without feedback, "
            f"{shares[1]} % with; "
            f"damping ratio {number(result['damping_ratio_open'], 2)} and {number(result['damping_ratio_closed'], 2)}"
        )
    return (
        "Linear model at the operating point that is least damped with feedback: speed after a step of desired speed, as a share of it. "
        + capital("; ".join(said))
        + "."
    )


def draws_said(tuning: Table) -> str:
    """What the draws say of the choice."""
    found = tuning["robustness"]
    low, _, high = found["quantiles"]
    return (
        f"{number(100.0 * found['share'], 3)} % of {found['draws']} draws of "
        f"{count(len(found['parameters']), 'identified parameter')} reach a damping ratio of {number(tuning['target'], 2)} "
        f"at the {found['points']} least damped operating points; 90 % of them lie from "
        f"{number(low, 2)} to {number(high, 2)}."
    )


# --- drawing
# --------------------------------------------------------------------------------------------------------------


def equivalents(path: Path, rig: Rig, tuning: Table, name: str, quantity: str, text: str) -> None:
    """A curve a payload over the stroke, with dots at the operating points; the joint angle above
    (thesis B.1–B.4).
    """
    with canvas(path, size=(7.2, 3.4)) as (_, ax):
        for index, one in enumerate(tuning["equivalents"]):
            x, y = (np.array(one[key], float) for key in ("x", name))
            colour = CYCLE[index % len(CYCLE)]
            ax.plot(
                shown(rig, "x", x),
                shown(rig, quantity, y),
                color=colour,
                linestyle=MARKS[index % len(MARKS)],
                label=load_name(one["payload"]),
            )
            at = np.unique(
                [
                    p["point"]["x"]
                    for p in tuning["points"]
                    if p["point"]["payload"] == one["payload"]
                ]
            )
            ax.plot(
                shown(rig, "x", at),
                shown(rig, quantity, np.interp(at, x, y)),
                "o",
                markersize=4,
                color=colour,
            )
        ax.set_xlabel(axis(rig, "x", "stroke"))
        ax.set_ylabel(axis(rig, quantity, text.lower()))
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.legend()
        if not isinstance(rig.mechanism, Slide) and tuning["equivalents"]:
            x = np.asarray(shown(rig, "x", np.array(tuning["equivalents"][0]["x"], float)))
            q = np.asarray(shown(rig, "q", np.array(tuning["equivalents"][0]["q"], float)))
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
    from matplotlib.lines import Line2D

    gains = np.array(tuning["gains"], float)
    x = np.asarray(shown(rig, "feedback_gain", gains))
    names = function_names(tuning)
    colours = {name: CYCLE[i % len(CYCLE)] for i, name in enumerate(names)}
    chosen = tuning["feedback_gain"]
    points = tuning["points"]
    kept = gains > 0.0
    with canvas(path, size=(7.4, 4.6)) as (figure, ax):
        low = -0.08
        for one in points:
            y = np.array(one["curve"], float)
            y[1:][(y[1:] < low) & (y[:-1] < low)] = np.nan  # beyond the frame
            look = (
                {"linewidth": 0.7, "alpha": 0.55}
                if one["counts"]
                else {"linewidth": 0.8, "alpha": 0.5, "linestyle": (0, (1, 2))}
            )
            ax.plot(x[kept], y[kept], color=colours[one["point"]["function"]], **look)
        ax.plot(
            x[kept], np.array(tuning["worst_curve"], float)[kept], color="#111827", linewidth=2.0
        )
        ax.axhline(tuning["target"], color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
        ax.annotate(
            "target",
            (0.0, tuning["target"]),
            (4, 3),
            ("axes fraction", "data"),
            "offset points",
            color=MUTED,
            fontsize=8,
        )
        ax.axhspan(low, 0.0, color=ACCENT, alpha=0.07, linewidth=0)
        ax.annotate(
            "unstable",
            (0.0, low),
            (4, 3),
            ("axes fraction", "data"),
            "offset points",
            color=ACCENT,
            fontsize=8,
        )
        for gain in sorted(set(chosen.values())):
            mine = [
                one for one in points if one["counts"] and chosen[one["point"]["function"]] == gain
            ]
            at = float(shown(rig, "feedback_gain", gain))
            colour = (
                "#111827"
                if len(set(chosen.values())) == 1
                else colours[next(f for f in names if chosen[f] == gain)]
            )
            ax.axvline(at, color=colour, linewidth=0.9, linestyle=(0, (2, 2)))
            if mine:
                least = min(one["damping_ratio_closed"] for one in mine)
                ax.plot(
                    [at],
                    [least],
                    "o",
                    markersize=6.5,
                    markerfacecolor="white",
                    markeredgecolor=colour,
                    markeredgewidth=1.6,
                    zorder=6,
                )
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda tick, _: number(tick))
        ax.set_xlim(x[kept][0], x[kept][-1])
        ax.set_ylim(low, 1.02)
        ax.set_xlabel(axis(rig, "feedback_gain", "feedback gain K_p"))
        ax.set_ylabel("damping ratio of the least damped pole")
        handles = [Line2D([], [], color="#111827", linewidth=2.0, label="worst that counts")]
        handles.append(
            Line2D(
                [],
                [],
                color="#111827",
                marker="o",
                markersize=6,
                markerfacecolor="white",
                linestyle=(0, (2, 2)),
                linewidth=0.9,
                label="choice",
            )
        )
        shown_only = {
            name
            for name in names
            if not any(p["counts"] for p in points if p["point"]["function"] == name)
        }
        handles += [
            Line2D(
                [],
                [],
                color=colours[n],
                linestyle=(0, (1, 2)) if n in shown_only else "-",
                label=words(n) + (", shown only" if n in shown_only else ""),
            )
            for n in names
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)


def loci(path: Path, rig: Rig, mine: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A root locus a payload, upper half plane, on a grid of damping ratios: choice and stability
    limit marked.

    Where the stability limit lies far out, what swings is shown a second time, near the origin.
    """
    from matplotlib.lines import Line2D

    whole = tuple(pick(one["frame"][i] for one in mine) for i, pick in enumerate((min, max, max)))
    reach = max(_swing(one) for one in mine)
    frames = [
        whole,
        *([(-1.6 * reach, 0.4 * reach, 1.4 * reach)] if whole[2] > _FAR * 1.4 * reach else []),
    ]
    panels = [(one, frame) for frame in frames for one in mine]
    columns = min(2, len(mine))
    rows = -(-len(panels) // columns)
    with canvas(path, rows, columns, (7.4, 3.7 * rows + 0.5), squeeze=False) as (figure, axes):
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for ax, (one, frame) in zip(axes.flat, panels, strict=False):
            _locus(ax, one, frame)
            load = load_name(by_name[one["name"]]["point"]["payload"])
            ax.set_title(load if frame is whole else f"{load}, near the origin")
            ax.set_xlabel("real part [rad/s]")
        for ax in axes[:, 0]:
            ax.set_ylabel("imaginary part [rad/s]")
        symbol = "K_p" if mine[0]["parameter"] == "feedback_gain" else "ω_w"
        handles = [
            Line2D([], [], color=RECORDED, linewidth=1.6, label=f"{symbol} up to the choice"),
            Line2D([], [], color=_BEYOND, linewidth=1.3, label="beyond"),
            Line2D([], [], marker="x", linestyle="", color=INK, label=f"{symbol} = 0"),
            Line2D([], [], marker="o", linestyle="", color=SIMULATED, label="chosen"),
        ]
        if any(one.get("crossing") is not None for one in mine):
            handles.append(
                Line2D(
                    [],
                    [],
                    marker="D",
                    linestyle="",
                    markerfacecolor="white",
                    color=ACCENT,
                    label="stability limit",
                )
            )
        legend(figure, handles)


def _swing(one: Table) -> float:
    """Size [rad/s] of the least damped pair of poles at the start of a locus, or of the slowest
    pole where none swings.
    """
    start = np.array(one["real"][0], float) + 1j * np.array(one["imag"][0], float)
    start = start[np.abs(start) > 0.0]
    pairs = start[start.imag > _ON_AXIS * np.abs(start)]
    return float(
        np.abs(pairs[np.argmin(-pairs.real / np.abs(pairs))]) if pairs.size else np.abs(start).min()
    )


def _locus(ax, one: Table, frame: tuple[float, float, float]) -> None:
    left, right, top = frame
    values, chosen = np.array(one["values"], float), one["chosen"]
    bottom = -_ROOM * top
    _damping_grid(ax, left, top)
    ax.axvspan(0.0, right, color=ACCENT, alpha=0.06, linewidth=0)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    poles = np.array(one["real"], float) + 1j * np.array(one["imag"], float)
    fine, branches = refined(values, poles)
    here = int(np.searchsorted(fine, chosen))
    for branch in branches.T:
        x, y = branch.real.copy(), branch.imag.copy()
        away = (x < 1.3 * left) | (x > 2.0 * right) | (y > 1.3 * top) | (y < 6.0 * bottom)
        x[away] = np.nan
        for part, colour, width in (
            (slice(here, None), _BEYOND, 1.3),
            (slice(None, here + 1), RECORDED, 1.6),
        ):
            if np.isfinite(x[part]).sum() > 1:
                ax.plot(
                    x[part],
                    y[part],
                    color=colour,
                    linewidth=width,
                    zorder=3,
                    solid_capstyle="round",
                )
    _poles(
        ax,
        zip(poles[0].real, poles[0].imag, strict=True),
        frame,
        marker="x",
        color=INK,
        markersize=5.5,
        markeredgewidth=1.3,
        zorder=4,
    )
    if one.get("crossing") is not None:
        _poles(
            ax,
            _crossing(one["crossing_poles"], top),
            frame,
            marker="D",
            color=ACCENT,
            markerfacecolor="white",
            markersize=6,
            markeredgewidth=1.4,
            zorder=6,
        )
    _poles(
        ax,
        one["chosen_poles"],
        frame,
        marker="o",
        color=SIMULATED,
        markersize=5.5,
        markeredgecolor="white",
        markeredgewidth=0.6,
        zorder=5,
    )
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.grid(False)


def refined(values: np.ndarray, poles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(values, poles) of a root locus with BETWEEN more points in every interval, each column one
    branch.

    Between saved points the characteristic polynomial, at most of second degree in the parameter,
    goes through that of three neighbours; branches are told apart by the least way in all from one
    point to the next."""
    from scipy.optimize import linear_sum_assignment

    scale = float(np.median(np.abs(poles))) or 1.0
    polynomials = np.array([np.poly(row / scale).real for row in poles])
    fine, rows = [float(values[0])], [poles[0]]
    for i in range(values.size - 1):
        near = slice(max(min(i, values.size - 3), 0), max(min(i, values.size - 3), 0) + 3)
        for value in np.linspace(values[i], values[i + 1], BETWEEN + 2)[1:]:
            found = (
                poles[i + 1]
                if value == values[i + 1]
                else scale * np.roots(_through(values[near], polynomials[near], value))
            )
            _, order = linear_sum_assignment(np.abs(rows[-1][:, None] - found[None, :]))
            fine.append(float(value))
            rows.append(found[order])
    return np.array(fine), np.array(rows)


def _through(x: np.ndarray, y: np.ndarray, at: float) -> np.ndarray:
    """The polynomial of least degree through points, at a value: Lagrange's form."""
    others = [np.delete(x, j) for j in range(x.size)]
    return sum(
        row * np.prod((at - other) / (own - other))
        for own, other, row in zip(x, others, y, strict=True)
    )


def _crossing(poles: Sequence[Sequence[float]], top: float) -> list[Sequence[float]]:
    """Of the poles at the stability limit the pair without damping; slow ones may lie as near to
    the imaginary axis.
    """
    near = [pole for pole in poles if abs(pole[0]) < _ON_AXIS * top]
    return [pole for pole in near if abs(pole[0]) < _ON_AXIS * abs(pole[1])] or near[-1:]


def _poles(ax, poles, frame: Sequence[float], **look) -> None:
    left, right, top = frame
    inside = [(x, y) for x, y in poles if left <= x <= right and -_ROOM * top <= y <= top]
    if inside:
        ax.plot(*np.array(inside).T, linestyle="", **look)


def _damping_grid(ax, left: float, top: float) -> None:
    """Rays of equal damping ratio ζ = cos φ, φ from the negative real axis, each labelled where it
    leaves the frame.
    """
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
    for ratio in RATIOS:
        slope = math.sqrt(1.0 - ratio**2) / ratio
        x = max(left, -top / slope)
        ax.plot([0.0, x], [0.0, -slope * x], color=_PALE, linewidth=0.7, zorder=1)
        side = "left" if x == left else "center"
        ax.text(
            0.98 * x,
            -0.965 * slope * x,
            f"{ratio:g}",
            fontsize=6.5,
            color=MUTED,
            ha=side,
            va="center",
            bbox=box,
            zorder=2,
        )


def step_responses(path: Path, mine: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A panel a payload: speed over desired speed, without and with feedback."""
    from matplotlib.lines import Line2D

    with canvas(path, 1, len(mine), (7.4, 3.1), squeeze=False, sharey=True) as (figure, axes):
        for ax, one in zip(axes[0], mine, strict=True):
            t = np.array(one["t"], float)
            ax.axhline(1.0, color=MUTED, linewidth=0.8)
            ax.plot(t, one["v_open"], color=RECORDED, linewidth=1.0)
            ax.plot(t, one["v_closed"], color=SIMULATED, linewidth=1.8)
            ax.set_title(load_name(by_name[one["name"]]["point"]["payload"]))
            ax.set_xlabel("time [s]")
            ax.set_xlim(0.0, t[-1])
        axes[0, 0].set_ylabel("speed over desired speed [1]")
        axes[0, 0].set_ylim(bottom=min(0.0, axes[0, 0].get_ylim()[0]))
        handles = [
            Line2D([], [], color=RECORDED, linewidth=1.0, label="without pressure feedback"),
            Line2D([], [], color=SIMULATED, linewidth=1.8, label="with pressure feedback"),
        ]
        legend(figure, handles)


def draws(path: Path, tuning: Table) -> None:
    """A histogram of the worst damping ratio of each draw, with the target and the value at the
    identified parameters.
    """
    found = tuning["robustness"]
    values = np.array(found["damping_ratios"], float)
    with canvas(path, size=(7.2, 2.6)) as (_, ax):
        width = max(float(np.ptp(values)), 1e-3)
        ax.hist(
            values,
            bins=np.linspace(values.min() - 0.02 * width, values.max() + 0.02 * width, 25),
            color=RECORDED,
            alpha=0.75,
        )
        marks = sorted(
            [
                (tuning["target"], "target", ACCENT),
                (tuning["damping_ratio"], "as identified", SIMULATED),
            ]
        )
        for (value, text, colour), side in zip(
            marks, ("right", "left"), strict=True
        ):  # above, and away from one another
            ax.axvline(value, color=colour, linewidth=1.4)
            look = {"color": colour, "fontsize": 8, "ha": side, "va": "bottom"}
            ax.annotate(
                text,
                (value, 1.0),
                (-3 if side == "right" else 3, 1),
                ("data", "axes fraction"),
                "offset points",
                **look,
            )
        ax.set_xlabel("worst damping ratio over the operating points")
        ax.set_ylabel("draws")
        ax.margins(x=0.06)
