"""How figures look, and how they become bytes that are the same every time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ehbench.report.svg import shrink
from ehbench.runtime.disk import write_text

if TYPE_CHECKING:
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

RECORDED, SIMULATED, ACCENT, MUTED = "#1f3f66", "#e08214", "#b3261e", "#6b7280"
INK = "#1f2937"
CYCLE = ("#1f3f66", "#e08214", "#2e7d5b", "#8e4585", "#7a6a4f", "#b3261e")
MARKS: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
Look = dict[str, Any]  # how a line or a text is drawn, by matplotlib's words
BUCKETS = 320  # half a figure is about as many pixels wide

_RC = {
    "svg.hashsalt": "ehbench",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.7,
    "axes.edgecolor": "#9ca3af",
    "text.color": INK,
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 5),
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.3,
    "figure.constrained_layout.use": True,
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


@contextmanager
def canvas(
    path: Path, rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.2, 4.2), **kwargs
) -> Iterator:
    """A figure and its axes; saved as SVG to ``path`` when the block ends, with bytes that depend
    on nothing else. What the host draws with, and its figures, are left as they are.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.rcsetup import cycler

    settings: Any = _RC | {"axes.prop_cycle": cycler(color=CYCLE)}
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=size)
        page = FigureCanvasSVG(figure)
        yield figure, figure.subplots(rows, columns, **kwargs)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, _painted(page))


def _painted(page: FigureCanvasSVG) -> str:
    """The figure of a page as SVG: laid out and drawn, most of what a figure takes."""
    _let_formulas(page.figure)
    _keep_titles(page.figure)
    text = StringIO()
    # savefig would draw twice where a layout engine is on: once for the layout alone
    page.print_svg(text, metadata={"Date": None, "Creator": "ehbench"})
    return shrink(text.getvalue())


def _let_formulas(figure: Figure) -> None:
    """Names stand in a figure as people wrote them, also with dollar signs; only the labels that a
    logarithmic axis makes by itself are formulas.
    """
    import matplotlib
    from matplotlib.text import Text
    from matplotlib.ticker import LogFormatter

    axes = [axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)]
    logs = [axis for axis in axes if isinstance(axis.get_major_formatter(), LogFormatter)]
    if not logs:
        return
    for axis in axes:
        axis.get_major_ticks()  # those of names, while these are no formulas
    for axis in logs:
        for text in axis.findobj(Text):
            text.set_parse_math(text is not axis.label)
    matplotlib.rcParams["text.parse_math"] = True  # of labels to come; the canvas puts it back


def _keep_titles(figure: Figure) -> None:
    """Titles stay where they are, but where an axis may have a factor of its numbers, such as 1e6,
    at its top: to look for one, matplotlib measures all labels for each title. Those beside another
    one, which have a distance of their own, it may look after.
    """
    for ax in figure.axes:
        if 1e-2 <= np.abs(ax.get_ylim()).max() < 1e5 and not ax.get_title("right"):
            ax.set_title("", loc="center", y=1.0)


def shades(count: int) -> list:
    """``count`` colours from dark to light that keep their order in grey print."""
    import matplotlib

    return [matplotlib.colormaps["viridis"](0.8 * i / max(count - 1, 1)) for i in range(count)]


def thin(t: np.ndarray, y: np.ndarray, buckets: int = BUCKETS) -> tuple[np.ndarray, np.ndarray]:
    """The series with the least and the largest sample of each of ``buckets`` stretches: the same
    picture, fewer points.
    """
    if t.size <= 4 * buckets:
        return t, y
    ends = np.linspace(0, t.size, buckets + 1).astype(int)
    bucket = np.repeat(np.arange(buckets), np.diff(ends))
    some = np.logical_or.reduceat(np.isfinite(y), ends[:-1])
    retained = [np.array([0, t.size - 1])]
    for extreme in (np.fmin, np.fmax):
        hits = np.flatnonzero(y == extreme.reduceat(y, ends[:-1])[bucket])
        which, first = np.unique(bucket[hits], return_index=True)
        retained.append(hits[first[some[which]]])
    at = np.unique(np.concatenate(retained))
    return t[at], y[at]


def spread(places: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Places moved apart to ``gap`` between neighbours, in their order and inside low…high; closer
    where they are too many.
    """
    order = sorted(range(len(places)), key=lambda i: (places[i], i))
    gap = min(gap, (high - low) / max(len(places) - 1, 1))
    groups: list[
        list[float]
    ] = []  # (sum of desired first places, count) of runs of touching labels
    for rank, i in enumerate(order):
        groups.append([min(max(places[i], low), high) - rank * gap, 1.0])
        while len(groups) > 1 and groups[-2][0] / groups[-2][1] >= groups[-1][0] / groups[-1][1]:
            total, count = groups.pop()
            groups[-1][0] += total
            groups[-1][1] += count
    moved = [0.0] * len(places)
    rank = 0
    for total, count in groups:
        for _ in range(int(count)):
            first = min(max(total / count, low), high - (len(places) - 1) * gap)
            moved[order[rank]] = first + rank * gap
            rank += 1
    return moved


def cycled(index: int, **more: Any) -> Look:
    """Colour and dashes of the curve with this number."""
    return {"color": CYCLE[index % len(CYCLE)], "linestyle": MARKS[index % len(MARKS)]} | more


def key(label: str, **look: Any) -> Line2D:
    """An entry of a legend that stands for a line or a marker."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


def swatch(label: str, colour: str, **look: Any) -> Patch:
    """An entry of a legend that stands for an area."""
    from matplotlib.patches import Patch

    return Patch(color=colour, label=label, **look)


def legend_right(ax, handlelength: float = 1.8) -> None:
    """The legend of a panel, right of it."""
    where = {"loc": "center left", "bbox_to_anchor": (1.005, 0.5), "borderaxespad": 0.0}
    ax.legend(handlelength=handlelength, **where)


def legend(figure, handles: Sequence, **kwargs) -> None:
    """One legend line below all panels, where it covers nothing."""
    if handles:
        figure.legend(
            handles=list(handles), loc="outside lower center", ncols=min(len(handles), 5), **kwargs
        )
