"""A cylinder's circuit under one working function: which edges are open, where oil flows."""

from collections import Counter
from itertools import pairwise
from pathlib import Path

from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, INK, MUTED, SIMULATED, canvas

_SIZE = (10.0, 6.4)
_PORTS = {"head": (2.6, 4.1), "rod": (7.4, 4.1)}  # where the pipes of the two ends begin
_RAILS = {"tank": 1.3, "supply": 0.5}  # their heights
Place = tuple[float, float]


def flow_words(edge: Table) -> str:
    """The steady flow through an open edge, such as ``(A₁ − A₂) |v|``."""
    head, rod = edge["shares"]
    return "(A₁ − A₂) |v|" if head and rod else "A₁ |v|" if head else "A₂ |v|"


def circuit(path: Path, function: Table) -> None:
    """The cylinder above, its edges below it down to the rails of supply and tank."""
    with canvas(path, size=(5.6, 3.7)) as (_, ax):
        ax.set_axis_off()
        ax.set(xlim=(0.0, _SIZE[0]), ylim=(0.0, _SIZE[1]), aspect="equal")
        _draw_box(ax, (1.6, 4.9), 6.6, 1.1, fill=False, edgecolor=INK, linewidth=1.5)
        _draw_box(ax, (4.6, 4.9), 0.35, 1.1, facecolor=INK, edgecolor=INK)
        _draw_box(ax, (4.95, 5.33), 4.0, 0.24, facecolor="#d1d5db", edgecolor=INK)
        for x, y in _PORTS.values():
            ax.plot([x, x], [y, 4.9], color=INK, linewidth=1.3)
            ax.plot(x, y, marker="o", color=INK, markersize=3.5)
        ax.text(2.0, 5.45, "head end", va="center", fontsize=7.5)
        ax.text(5.3, 5.75, "rod end", va="center", fontsize=7.5)
        way = function["direction"]
        _draw_arrow(ax, (4.77, 6.2), (4.77 + 1.3 * way, 6.2), INK)
        ax.text(4.77 - 0.15 * way, 6.2, "v", va="center", fontsize=9, ha="center")
        load = way if function["along"] else -way
        start = 9.2 if load > 0 else 9.95
        _draw_arrow(ax, (start, 5.45), (start + 0.75 * load, 5.45), INK)
        ax.text(9.55, 5.72, "load", ha="center", fontsize=7.5)
        for name, y in _RAILS.items():
            ax.plot([0.4, _SIZE[0] - 0.4], [y, y], color=INK, linewidth=1.6, zorder=1)
            ax.text(_SIZE[0] - 0.3, y, name, va="center", fontsize=8)
        drawn: Counter[frozenset[str]] = Counter()
        for edge in function["edges"]:
            nodes = frozenset(edge["ends"])
            _draw_edge(ax, edge, drawn[nodes])
            drawn[nodes] += 1


def _draw_edge(ax, edge: Table, nth: int) -> None:
    """The ``nth`` pipe between two nodes with its valve, an arrow along its flow."""
    is_open, ends = bool(edge["way"]), edge["ends"]
    colour = MUTED if not is_open else ACCENT if edge["meters"] else SIMULATED
    if set(ends) == set(_PORTS):
        first, last = (_PORTS[end] for end in ends)
        near, far = (x + (0.5 if x < _SIZE[0] / 2 else -0.5) for x, _ in (first, last))
        top, low = first[1], first[1] - 0.75 - nth * 0.9
        points = [first, (near, top), (near, low), (far, low), (far, top), last]
    else:
        port, rail = sorted(ends, key=lambda end: end not in _PORTS)
        outward = -1.0 if port == "head" else 1.0
        x = _PORTS[port][0] + outward * ((0.0 if rail == "tank" else 2.0) - 0.6 * nth)
        points = [_PORTS[port], (x, _PORTS[port][1]), (x, _RAILS[rail])]
        points = points if ends[0] == port else points[::-1]
    xs, ys = zip(*points, strict=True)
    if is_open:
        ax.plot(xs, ys, color="white", linewidth=5.0, zorder=2)
    width, dashes = (2.0, "-") if is_open else (1.0, (0, (3, 2)))
    ax.plot(xs, ys, color=colour, linewidth=width, linestyle=dashes, zorder=3)
    for x, y in (points[0], points[-1]):
        if y in _RAILS.values():
            ax.plot(x, y, marker="o", color=colour, markersize=3.5, zorder=4)
    start, stop = max(
        pairwise(points if edge["way"] >= 0 else points[::-1]),
        key=lambda ends: sum(abs(b - a) for a, b in zip(*ends, strict=True)),
    )
    x, y = (0.5 * (a + b) for a, b in zip(start, stop, strict=True))
    face = colour if is_open else "white"
    _draw_box(ax, (x - 0.22, y - 0.22), 0.44, 0.44, facecolor=face, edgecolor=colour, zorder=5)
    label = edge["name"] + (f"\n{flow_words(edge)}" if is_open else "")
    look = {"fontsize": 6.8, "color": colour, "zorder": 6}
    if start[0] != stop[0]:
        ax.text(x, y + 0.32, label, ha="center", va="bottom", **look)
    elif x < _SIZE[0] / 2:
        ax.text(x + 0.32, y, label, ha="left", va="center", **look)
    else:
        ax.text(x - 0.32, y, label, ha="right", va="center", **look)
    if is_open:
        near, far = (
            (start[0] + s * (stop[0] - start[0]), start[1] + s * (stop[1] - start[1]))
            for s in (0.7, 0.92)
        )
        _draw_arrow(ax, near, far, colour)


def _draw_box(ax, corner: Place, width: float, height: float, **look) -> None:
    from matplotlib.patches import Rectangle

    ax.add_patch(Rectangle(corner, width, height, **look))


def _draw_arrow(ax, start: Place, stop: Place, colour: str) -> None:
    look = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.6, "mutation_scale": 11}
    ax.annotate("", xy=stop, xytext=start, arrowprops=look, zorder=6)
