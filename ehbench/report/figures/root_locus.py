"""Root loci."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, INK, MUTED, RECORDED, SIMULATED, Look, canvas, key, legend
from ehbench.report.words import load_name

_BEYOND = "#9db4cf"
_ZERO: Look = {
    "marker": "o",
    "markerfacecolor": "none",
    "color": MUTED,
    "markersize": 8,
    "markeredgewidth": 1.1,
}

Frame = Sequence[float]  # left, right, bottom, top [rad/s]


def loci(path: Path, loci: Sequence[Table], by_name: dict[str, Table]) -> None:
    """A root locus a payload, upper half plane, on a grid of damping ratios: choice and stability
    limit marked.

    Where the stability limit lies far out, what swings comes first, and the way to it below."""
    whole = tuple(pick(item["frame"][i] for item in loci) for i, pick in enumerate((min, max, max)))
    reach, frames = max(map(_swing, loci)), {"": whole}
    if whole[2] > 3.0 * 1.4 * reach:
        near = (-1.6 * reach, 0.4 * reach, 1.4 * reach)
        frames = {", what swings": near, ", as far as the stability limit": whole}
    panels = [(item, where) for where in frames for item in loci]
    columns = min(2, len(loci))
    rows = -(-len(panels) // columns)
    with canvas(path, rows, columns, (7.4, 3.7 * rows + 0.5), squeeze=False) as (figure, axes):
        for ax in axes.flat[len(panels) :]:
            ax.remove()
        for ax, (item, where) in zip(axes.flat, panels, strict=False):
            left, right, top = frames[where]
            _locus(ax, item, (left, right, -0.06 * top, top))
            ax.set_title(load_name(by_name[item["name"]]["point"]["payload"]) + where)
            ax.set_xlabel("real part [rad/s]")
        for ax in axes[:, 0]:
            ax.set_ylabel("imaginary part [rad/s]")
        symbol = "K_p" if loci[0]["parameter"] == "feedback_gain" else "ω_w"
        handles = [
            key(f"{symbol} up to the choice", color=RECORDED, linewidth=1.6),
            key("beyond", color=_BEYOND, linewidth=1.3),
            key(f"{symbol} = 0", marker="x", linestyle="", color=INK),
            key("chosen", marker="o", linestyle="", color=SIMULATED),
            key("zero, where a branch ends", **_ZERO, linestyle=""),
        ]
        if any(item.get("crossing") is not None for item in loci):
            look: Look = {"marker": "D", "markerfacecolor": "white", "color": ACCENT}
            handles.append(key("stability limit", linestyle="", **look))
        legend(figure, handles, handletextpad=0.5)


def _swing(item: Table) -> float:
    """Size [rad/s] of the least damped poles at a locus's start, or of its slowest."""
    start = np.array(item["real"][0], float) + 1j * np.array(item["imag"][0], float)
    start = start[np.abs(start) > 0.0]
    pairs = start[start.imag > 1e-3 * np.abs(start)]
    return float(
        np.abs(pairs[np.argmin(-pairs.real / np.abs(pairs))]) if pairs.size else np.abs(start).min()
    )


def _locus(ax, item: Table, frame: Frame) -> None:
    """One locus: its branches dark up to the choice and pale beyond, poles and zeros."""
    left, right, bottom, top = frame
    damping_grid(ax, left, top)
    ax.axvspan(0.0, right, color=ACCENT, alpha=0.06, linewidth=0)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    poles = np.array(item["real"], float) + 1j * np.array(item["imag"], float)
    values = np.array(item["values"], float)
    fine, branches = refined(values, poles, top)
    here = int(np.searchsorted(fine, item["chosen"]))
    parts = ((slice(here, None), _BEYOND, 1.3), (slice(None, here + 1), RECORDED, 1.6))
    for branch in branches.T:
        x, y = branch.real.copy(), branch.imag
        x[(x < 1.3 * left) | (x > 2.0 * right) | (y > 1.3 * top) | (y < 6.0 * bottom)] = np.nan
        for part, colour, width in parts:
            if np.isfinite(x[part]).sum() > 1:
                look: Look = {"color": colour, "linewidth": width, "solid_capstyle": "round"}
                ax.plot(x[part], y[part], zorder=3, **look)
    _poles(ax, [(z.real, z.imag) for z in zeros(values, poles)], frame, zorder=3.5, **_ZERO)
    start = zip(poles[0].real, poles[0].imag, strict=True)
    cross = {"marker": "x", "color": INK, "markersize": 5.5, "markeredgewidth": 1.3}
    _poles(ax, start, frame, zorder=4, **cross)
    if item.get("crossing") is not None:
        diamond = {"marker": "D", "color": ACCENT, "markersize": 6, "markeredgewidth": 1.4}
        limit = crossing(item["crossing_poles"], top)
        _poles(ax, limit, frame, markerfacecolor="white", zorder=6, **diamond)
    dot = {"marker": "o", "color": SIMULATED, "markersize": 5.5, "markeredgewidth": 0.6}
    _poles(ax, item["chosen_poles"], frame, markeredgecolor="white", zorder=5, **dot)
    ax.set(xlim=(left, right), ylim=(bottom, top))
    ax.grid(False)


def zeros(values: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """Where the branches of a root locus end as its parameter grows [rad/s]: the roots of what the
    parameter multiplies; none where the characteristic polynomial is not linear in it.

    Args:
        values: of the parameter, shape (n,), from the least to the largest.
        poles: at each of them [rad/s], shape (n, m)."""
    nothing = 1e-6  # share of the linear part that a polynomial may have besides it
    scale, maximum = float(np.median(np.abs(poles))) or 1.0, float(np.abs(values).max())
    if values.size < 3 or maximum == 0.0:
        return np.empty(0)
    polynomials = np.array([np.poly(row / scale).real for row in poles])
    parts = np.linalg.lstsq(np.vander(values / maximum, 3), polynomials, rcond=None)[0]
    square, linear, _ = (np.abs(part).max() for part in parts)
    if linear == 0.0 or square > nothing * linear:
        return np.empty(0)
    significant = np.abs(parts[1]) > nothing * linear
    return scale * np.roots(parts[1][int(np.argmax(significant)) :])


def refined(
    values: np.ndarray, poles: np.ndarray, top: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """(values, poles) of a root locus with 7 points more in every interval, each column one
    branch; 60 where a pole goes farther than a share of ``top`` [rad/s], as where two part.

    Between saved points the characteristic polynomial, at most of second degree in the parameter,
    goes through that of three neighbours; branches are told apart by the shortest way in all from
    one point to the next."""
    from scipy.interpolate import krogh_interpolate
    from scipy.optimize import linear_sum_assignment

    scale = float(np.median(np.abs(poles))) or 1.0
    polynomials = np.array([np.poly(row / scale).real for row in poles])
    fine, rows = [float(values[0])], [poles[0]]
    for i in range(values.size - 1):
        first = max(min(i, values.size - 3), 0)
        near = slice(first, first + 3)
        inside = (np.abs(poles[i : i + 2]) < 4.0 * top).all(axis=0)
        way = float(np.abs(np.diff(poles[i : i + 2], axis=0))[:, inside].max(initial=0.0))
        count = 7 if way < 0.02 * top else 60
        steps = np.linspace(values[i], values[i + 1], count + 2)[1:]
        through = krogh_interpolate(values[near], polynomials[near], steps[:-1])
        roots = [scale * np.roots(row) for row in through]
        for value, there in zip(steps, [*roots, poles[i + 1]], strict=True):
            _, order = linear_sum_assignment(np.abs(rows[-1][:, None] - there[None, :]))
            fine.append(float(value))
            rows.append(there[order])
    return np.array(fine), np.array(rows)


def crossing(poles: Sequence[Sequence[float]], top: float) -> list[Sequence[float]]:
    """Of the poles at the stability limit the pair with next to no damping."""
    near = [pole for pole in poles if abs(pole[0]) < 1e-3 * top]
    return [pole for pole in near if abs(pole[0]) < 1e-3 * abs(pole[1])] or near[-1:]


def _poles(ax, poles, frame: Frame, **look) -> None:
    left, right, bottom, top = frame
    inside = [(x, y) for x, y in poles if left <= x <= right and bottom <= y <= top]
    if inside:
        ax.plot(*np.array(inside).T, linestyle="", **look)


def damping_grid(ax, left: float, top: float) -> None:
    """Rays of equal damping ratio ζ = cos φ, φ from the negative real axis, with labels."""
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
    look: Look = {"fontsize": 6.5, "color": MUTED, "va": "center", "bbox": box, "zorder": 2}
    for ratio in np.arange(1, 10) / 10.0:
        slope = math.sqrt(1.0 - ratio**2) / ratio
        x = max(left, -top / slope)
        ax.plot([0.0, x], [0.0, -slope * x], color="#d1d5db", linewidth=0.7, zorder=1)
        side = "left" if x == left else "center"
        ax.text(0.98 * x, -0.965 * slope * x, f"{ratio:g}", ha=side, **look)
