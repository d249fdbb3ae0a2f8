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
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

RECORDED, SIMULATED, ACCENT, MUTED = "#1f3f66", "#e08214", "#b3261e", "#6b7280"
INK = "#1f2937"
CYCLE = ("#1f3f66", "#e08214", "#2e7d5b", "#8e4585", "#7a6a4f", "#b3261e")
LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)))
Look = dict[str, Any]  # how a line or a text is drawn, by matplotlib's words

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
    on nothing else. What the host draws with, and its figures, are left as they are."""
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
        write_text(path, painted(page))


def painted(page: FigureCanvasSVG) -> str:
    """A figure as SVG; only numbers of logarithmic axes are formulas, names are not."""
    import matplotlib
    from matplotlib.text import Text
    from matplotlib.ticker import LogFormatter

    axes = [axis for ax in page.figure.axes for axis in (ax.xaxis, ax.yaxis)]
    logs = [axis for axis in axes if isinstance(axis.get_major_formatter(), LogFormatter)]
    for axis in axes if logs else ():
        axis.get_major_ticks()  # those of names, while these are no formulas
    for axis in logs:
        for item in axis.findobj(Text):
            item.set_parse_math(item is not axis.label)
        matplotlib.rcParams["text.parse_math"] = True  # of labels to come
    text = StringIO()
    # savefig would draw twice where a layout engine is on: once for the layout alone
    page.print_svg(text, metadata={"Date": None, "Creator": "ehbench"})
    return shrink(text.getvalue())


def shades(count: int) -> list:
    """``count`` colours from dark to light that keep their order in grey print."""
    import matplotlib

    return [matplotlib.colormaps["viridis"](0.8 * i / max(count - 1, 1)) for i in range(count)]


def thin(t: np.ndarray, y: np.ndarray, buckets: int = 320) -> tuple[np.ndarray, np.ndarray]:
    """The series by minimum and maximum of each of ``buckets`` stretches, to plot."""
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
    places = np.unique(np.concatenate(retained))
    return t[places], y[places]


def spread(
    places: Sequence[float], sizes: float | Sequence[float], low: float, high: float
) -> np.ndarray:
    """Middles of slots of these sizes, moved from their places until none lies on another, in order
    and inside low…high, as little as it takes; smaller where there is no room."""
    from scipy.optimize import isotonic_regression

    order = np.argsort(places, kind="stable")
    slots = np.broadcast_to(sizes, len(places))[order]
    slots = slots * min(1.0, (high - low) / max(float(slots.sum()), 1e-12))
    ramp = low + np.cumsum(slots) - 0.5 * slots
    firsts = isotonic_regression(np.take(places, order) - ramp).x
    moved = np.empty(len(places))
    moved[order] = np.clip(firsts, 0.0, max(high - low - float(slots.sum()), 0.0)) + ramp
    return moved


def cycled(index: int, **more: Any) -> Look:
    """Colour and dashes of the curve with this number."""
    return {"color": CYCLE[index % len(CYCLE)], "linestyle": LINES[index % len(LINES)]} | more


def key(label: str, **look: Any) -> Line2D:
    """An entry of a legend that stands for a line or a marker."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **look)


def swatch(label: str, colour: str, **look: Any) -> Patch:
    """An entry of a legend that stands for an area."""
    from matplotlib.patches import Patch

    return Patch(color=colour, label=label, **look)


def tag(
    ax, text: str, x: float, y: float, offset: tuple[int, int], within: str = "", **look: Any
) -> None:
    """A small word some points off a place; of the axes in ``within`` the place is a share."""
    where = tuple("axes fraction" if name in within else "data" for name in "xy")
    ax.annotate(text, (x, y), offset, where, "offset points", **{"fontsize": 8} | look)


def legend_right(ax, *entries: Any, **look: Any) -> None:
    """The legend of a panel, right of it; nothing where no line has a name."""
    if entries or ax.get_legend_handles_labels()[0]:
        place = {"loc": "center left", "bbox_to_anchor": (1.005, 0.5), "borderaxespad": 0.0}
        ax.legend(*entries, **{"handlelength": 1.8} | place | look)


def legend(figure, handles: Sequence, columns: int = 5, **kwargs) -> None:
    """The legend of a figure below all panels, where it covers nothing."""
    if handles:
        ncols = min(len(handles), columns)
        figure.legend(handles=list(handles), loc="outside lower center", ncols=ncols, **kwargs)
