"""A cylinder's circuit under one working function: which edges are open, where oil flows."""

from __future__ import annotations

from pathlib import Path

from ehbench.report.saved import Table
from ehbench.report.style import ACCENT, INK, MUTED, SIMULATED, canvas

WIDTH, HEIGHT = 10.0, 6.4
PORTS = {"head": 2.6, "rod": 7.4}  # where the two ends stand
LEVEL = 4.1  # height of the ports' pipes
RAILS = {"tank": 1.3, "supply": 0.5}
GAP = 0.6  # between two edges that join the same two nodes
Point = tuple[float, float]


def flow_words(edge: Table) -> str:
    """The steady flow through an open edge, such as ``(A₁ − A₂) |v|``."""
    head, rod = edge["shares"]
    return "(A₁ − A₂) |v|" if head and rod else "A₁ |v|" if head else "A₂ |v|"


def _colour(edge: Table) -> str:
    """Of an edge's pipe and valve."""
    return MUTED if not edge["way"] else ACCENT if edge["meters"] else SIMULATED


def circuit(path: Path, function: Table) -> None:
    """The cylinder above, its edges below it down to the rails of supply and tank."""
    with canvas(path, size=(5.6, 3.7)) as (_, ax):
        ax.set_axis_off()
        ax.set_xlim(0.0, WIDTH)
        ax.set_ylim(0.0, HEIGHT)
        ax.set_aspect("equal")
        _cylinder(ax, function)
        for name, y in RAILS.items():
            ax.plot([0.4, WIDTH - 0.4], [y, y], color=INK, linewidth=1.6, zorder=1)
            ax.text(WIDTH - 0.3, y, name, va="center", fontsize=8)
        count: dict[frozenset[str], int] = {}
        for edge in function["edges"]:
            nodes = frozenset(edge["ends"])
            _edge(ax, edge, count.setdefault(nodes, 0))
            count[nodes] += 1


def _cylinder(ax, function: Table) -> None:
    from matplotlib.patches import Rectangle

    ax.add_patch(Rectangle((1.6, 4.9), 6.6, 1.1, fill=False, edgecolor=INK, linewidth=1.5))
    ax.add_patch(Rectangle((4.6, 4.9), 0.35, 1.1, facecolor=INK, edgecolor=INK))
    ax.add_patch(Rectangle((4.95, 5.33), 4.0, 0.24, facecolor="#d1d5db", edgecolor=INK))
    for x in PORTS.values():
        ax.plot([x, x], [LEVEL, 4.9], color=INK, linewidth=1.3)
        ax.plot(x, LEVEL, marker="o", color=INK, markersize=3.5)
    ax.text(2.0, 5.45, "head end", va="center", fontsize=7.5)
    ax.text(5.3, 5.75, "rod end", va="center", fontsize=7.5)
    _arrow(ax, (4.77, 6.2), (4.77 + 1.3 * function["direction"], 6.2), INK)
    ax.text(4.77 - 0.15 * function["direction"], 6.2, "v", va="center", fontsize=9, ha="center")
    load = function["direction"] if function["along"] else -function["direction"]
    start = 9.2 if load > 0 else 9.95
    _arrow(ax, (start, 5.45), (start + 0.75 * load, 5.45), INK)
    ax.text(9.55, 5.72, "load", ha="center", fontsize=7.5)


def _edge(ax, edge: Table, nth: int) -> None:
    """An edge's pipe with its valve, an arrow along its flow where it is open."""
    colour = _colour(edge)
    points = _pipe(edge["ends"], nth)
    style = (0, (3, 2)) if not edge["way"] else "-"
    width = 1.0 if not edge["way"] else 2.0
    xs, ys = zip(*points, strict=True)
    if edge["way"]:
        ax.plot(xs, ys, color="white", linewidth=5.0, zorder=2)
    ax.plot(xs, ys, color=colour, linewidth=width, linestyle=style, zorder=3)
    ends = [(x, y) for x, y in (points[0], points[-1]) if y in RAILS.values()]
    for x, y in ends:
        ax.plot(x, y, marker="o", color=colour, markersize=3.5, zorder=4)
    (xa, ya), (xb, yb) = _longest(points)
    _valve(ax, edge, (0.5 * (xa + xb), 0.5 * (ya + yb)), upright=xa == xb)
    if edge["way"]:
        (xa, ya), (xb, yb) = _longest(points if edge["way"] > 0 else points[::-1])
        near, far = ((xa + s * (xb - xa), ya + s * (yb - ya)) for s in (0.7, 0.92))
        _arrow(ax, near, far, colour)


def _pipe(ends: tuple[str, str], nth: int) -> list[Point]:
    """The corners of an edge's pipe from its first node to its second."""
    if set(ends) == set(PORTS):
        y = LEVEL - 0.75 - nth * 0.9
        xs = [PORTS[end] for end in ends]
        inner = [x + (0.5 if x < WIDTH / 2 else -0.5) for x in xs]
        return [
            (xs[0], LEVEL),
            (inner[0], LEVEL),
            (inner[0], y),
            (inner[1], y),
            (inner[1], LEVEL),
            (xs[1], LEVEL),
        ]
    port = next(end for end in ends if end in PORTS)
    rail = next(end for end in ends if end not in PORTS)
    outward = -1.0 if port == "head" else 1.0
    x = PORTS[port] + outward * ((0.0 if rail == "tank" else 2.0) - GAP * nth)
    points = [(PORTS[port], LEVEL), (x, LEVEL), (x, RAILS[rail])]
    return points if ends[0] == port else points[::-1]


def _longest(points: list[Point]) -> tuple[Point, Point]:
    """The longest straight part of a pipe."""
    parts = zip(points[:-1], points[1:], strict=True)
    return max(parts, key=lambda p: abs(p[1][0] - p[0][0]) + abs(p[1][1] - p[0][1]))


def _valve(ax, edge: Table, at: Point, upright: bool) -> None:
    from matplotlib.patches import Rectangle

    (x, y), colour = at, _colour(edge)
    face = colour if edge["way"] else "white"
    box = Rectangle((x - 0.22, y - 0.22), 0.44, 0.44, facecolor=face, edgecolor=colour)
    box.set_zorder(5)
    ax.add_patch(box)
    label = edge["name"] + (f"\n{flow_words(edge)}" if edge["way"] else "")
    if upright:
        side = 1.0 if x < WIDTH / 2 else -1.0
        ax.text(
            x + 0.32 * side,
            y,
            label,
            ha="left" if side > 0 else "right",
            va="center",
            fontsize=6.8,
            color=colour,
            zorder=6,
        )
    else:
        look = {"fontsize": 6.8, "color": colour, "zorder": 6}
        ax.text(x, y + 0.32, label, ha="center", va="bottom", **look)


def _arrow(ax, start: Point, stop: Point, colour: str) -> None:
    look = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.6, "mutation_scale": 11}
    ax.annotate("", xy=stop, xytext=start, arrowprops=look, zorder=6)
