"""The figures of a study: how its measures are spread, what moves them, and maps over two keys."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, MUTED, RECORDED, SIMULATED, canvas, key, legend


def distribution(
    path: Path, name: str, y: np.ndarray, summary: Table, target: Table | None
) -> None:
    """A histogram, and the share of samples up to a value with its quantiles' intervals."""
    with canvas(path, 1, 2, (7.2, 2.8)) as (figure, (left, right)):
        left.hist(y, bins=min(40, max(8, round(y.size**0.5))), color=RECORDED, alpha=0.85)
        left.set_ylabel("samples")
        left.yaxis.get_major_locator().set_params(integer=True)
        ordered = np.sort(y)
        share = 100.0 * np.arange(1, y.size + 1) / y.size
        right.step(ordered, share, where="post", color=RECORDED, linewidth=1.3)
        for quantile in summary["quantiles"]:
            low, high = quantile.get("low"), quantile.get("high")
            low = float(ordered[0]) if low is None else low
            high = float(ordered[-1]) if high is None else high
            level = 100.0 * quantile["share"]
            right.plot([low, high], [level, level], color=SIMULATED, linewidth=3, alpha=0.6)
            right.plot([quantile["value"]], [level], "o", color=SIMULATED, markersize=4)
        right.set_ylabel("samples up to here [%]")
        for ax in (left, right):
            ax.set_xlabel(name)
            for end in ("at_most", "at_least"):
                if target is not None and target.get(end) is not None:
                    ax.axvline(target[end], color=ACCENT, linestyle=(0, (4, 3)), linewidth=1.0)
        figure.align_labels()


def scatter(
    path: Path,
    name: str,
    y: np.ndarray,
    inputs: Sequence[tuple[str, np.ndarray]],
    marks: np.ndarray,
    maximum: int = 3000,
) -> None:
    """A measure over each input; ``marks`` are samples to point out, ``maximum`` of the dots."""
    columns = min(3, len(inputs))
    rows = -(-len(inputs) // columns)
    size = (7.2, 2.4 * rows + 0.3)
    look = {"squeeze": False, "sharey": True}
    step = max(1, y.size // maximum)
    dot = 2.5 if y.size > 200 else 5.0
    with canvas(path, rows, columns, size, **look) as (figure, axes):
        for ax, (name_of, x) in zip(axes.flat, inputs, strict=False):
            ax.plot(x[::step], y[::step], ".", color=RECORDED, markersize=dot, alpha=0.5)
            ax.plot(x[marks], y[marks], "o", color=ACCENT, markersize=6, fillstyle="none")
            ax.margins(0.06)
            ax.set_xlabel(name_of, fontsize=8)
        for ax in axes.flat[len(inputs) :]:
            ax.set_visible(False)
        for row in axes:
            row[0].set_ylabel(name)
        handles = [
            key("sample", linestyle="", marker=".", color=RECORDED),
            key("retained as a run", linestyle="", marker="o", color=ACCENT, fillstyle="none"),
        ]
        legend(figure, handles)


def bars(path: Path, rows: Sequence[Table], way: str) -> None:
    """What moves a measure, largest first."""
    keys = [row["key"] for row in rows]
    places = np.arange(len(keys))[::-1]
    with canvas(path, 1, 1, (7.2, 0.7 + 0.32 * len(keys))) as (figure, ax):
        if way == "sobol":
            for shift, word, colour in ((0.18, "first", RECORDED), (-0.18, "total", SIMULATED)):
                ax.barh(
                    places + shift,
                    [row[word] for row in rows],
                    0.34,
                    color=colour,
                    xerr=[row[f"{word}_error"] for row in rows],
                    label=word,
                    error_kw={"ecolor": MUTED, "elinewidth": 1.0},
                )
            ax.set_xlabel("Sobol index")
            legend(figure, ax.get_legend_handles_labels()[0])
        else:
            ax.barh(places, [row.get("rank", 0.0) for row in rows], 0.6, color=RECORDED)
            ax.axvline(0.0, color=MUTED, linewidth=0.8)
            ax.set_xlabel("standardised coefficient of ranks")
        ax.set_yticks(places, keys, fontsize=8)


def field(
    path: Path,
    names: Sequence[str],
    ticks: Sequence[Sequence[str]],
    z: np.ndarray,
    label: str,
) -> None:
    """A map of a number over two keys, with the numbers in its cells; nan: none."""
    rows, columns = z.shape
    size = (min(7.2, 2.2 + 0.7 * columns), min(7.0, 1.4 + 0.42 * rows))
    with canvas(path, 1, 1, size) as (figure, ax):
        image = ax.imshow(z, aspect="auto", cmap="viridis_r", origin="lower")
        ax.grid(False)
        ax.set_xticks(range(columns), ticks[0], fontsize=8)
        ax.set_yticks(range(rows), ticks[1], fontsize=8)
        ax.set_xlabel(names[0])
        ax.set_ylabel(names[1])
        middle = np.nanmean([np.nanmin(z), np.nanmax(z)]) if np.isfinite(z).any() else 0.0
        if rows * columns <= 150:
            for (i, j), value in np.ndenumerate(z):
                text = "–" if np.isnan(value) else f"{value:.3g}"
                look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7}
                ax.text(j, i, text, color="white" if value > middle else "black", **look)
        figure.colorbar(image, ax=ax, label=label, fraction=0.05)
