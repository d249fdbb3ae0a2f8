"""Figures of saved energy ledgers: where one trial's energy went, and how trials compare.

A ledger is read as its JSON has it: ``rows`` with name, energy [J], group, label, cylinder and
interval, and ``source``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.report.style import ACCENT, INK, MUTED, canvas, legend
from ehbench.report.words import DASH, fixed, number, places_of

SEEN = 2e-3  # share of the longest bar below which nobody sees a part
SMALL = 0.012  # share of all energy below which a row is drawn together with others
COLOURS = {
    "supply": "#1f3f66",
    "valve": "#e08214",
    "loss": "#8a7f72",
    "store": "#5b8fb9",
    "load": "#2e7d5b",
    "residual": ACCENT,
}
WORDS = {
    "supply": "supply",
    "valve": "throttling",
    "loss": "other losses",
    "store": "stored in oil",
    "load": "load",
    "residual": "not accounted for",
}
_GAP = 0.012
_BAR = 0.022  # width of a node


@dataclass
class _Node:
    """A bar of the picture: where it stands, and how much of it is taken by ribbons so far."""

    x: float
    label: str
    colour: str
    size: float = 0.0
    y: float = 0.0
    entered: float = 0.0
    left: float = 0.0


@dataclass
class _Flow:
    """A ribbon. ``end`` is a node, or None for a leaf at the right; ``start`` None for a source at
    the left.
    """

    start: str | None
    end: str | None
    energy: float
    group: str
    label: str
    half: float | None = None


@dataclass
class _Chart:
    nodes: dict[str, _Node] = field(default_factory=dict)
    flows: list[_Flow] = field(default_factory=list)


def _rows(ledger: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [dict(row) for row in ledger["rows"]]


def _scale(ledgers: Sequence[Mapping[str, Any]]) -> tuple[float, str]:
    """(J per unit, unit) in which the largest supply is a number of few digits."""
    most = max((abs(row["energy"]) for ledger in ledgers for row in ledger["rows"]), default=0.0)
    return (1e6, "MJ") if most >= 1e8 else (1e3, "kJ") if most >= 1e5 else (1.0, "J")


def half_of(row: Mapping[str, Any]) -> float | None:
    interval = row.get("interval")
    return None if interval is None or None in interval else 0.5 * (interval[1] - interval[0])


def _text(energy: float, half: float | None, unit: tuple[float, str], whole: float) -> str:
    """``424 ± 21 J · 7.7 %``."""
    value = energy / unit[0]
    if half is not None and half > 0.0 and math.isfinite(half):
        places = max(places_of(half / unit[0]), -2)
        shown = f"{fixed(value, places)} ± {fixed(half / unit[0], places)}"
    else:
        shown = number(value, 3)
    share = (
        f" · {number(100 * energy / whole, 2)} %"
        if whole > 0.0 and abs(energy) > 1e-5 * whole
        else ""
    )
    return f"{shown} {unit[1]}{share}"


def _merged(flows: list[_Flow], whole: float, several: bool) -> list[_Flow]:
    """Leaves and sources below SMALL drawn together, by node, so that labels do not crowd; the
    least are not drawn.
    """
    kept: list[_Flow] = []
    little: dict[tuple[str | None, str | None, bool], list[_Flow]] = {}
    for flow in flows:
        ends = flow.start is None or flow.end is None
        if ends and flow.energy < SMALL * whole and flow.group != "supply":
            little.setdefault((flow.start, flow.end, flow.group == "residual"), []).append(flow)
        else:
            kept.append(flow)
    for (start, end, left_over), few in little.items():
        energy = sum(flow.energy for flow in few)
        if energy < 0.15 * SMALL * whole or left_over and energy < 0.5 * SMALL * whole:
            continue
        halves = [flow.half for flow in few]
        half = None if None in halves else math.sqrt(sum(h * h for h in halves))
        one = few[0]
        label = (
            one.label
            if len(few) == 1
            else _prefix(start or end, several) + f"{len(few)} smaller ones"
        )
        group = one.group if len({flow.group for flow in few}) == 1 else "loss"
        kept.append(_Flow(start, end, energy, group, label, half))
    return kept


def _prefix(node: str | None, several: bool) -> str:
    return f"{node}: " if several and node not in (None, "pump", "mechanism") else ""


def _chart(ledger: Mapping[str, Any]) -> tuple[_Chart, float]:
    """Nodes and ribbons of a ledger, pump → oil of each cylinder → mechanism, and the energy that
    the supply gave [J].
    """
    rows = _rows(ledger)
    named = {row["name"]: row for row in rows}
    cylinders = list(dict.fromkeys(row["cylinder"] for row in rows if row["cylinder"] is not None))
    given = sum(row["energy"] for row in rows if row["group"] == "supply")
    chart = _Chart()
    works = {c: named[f"{c}.work"]["energy"] for c in cylinders}
    uphill = (
        sum(works.values()) < 0.0
    )  # the load drives the oil: then the mechanism stands before it
    whole = max(given, sum(abs(w) for w in works.values()), 1e-12)
    busy = [
        c
        for c in cylinders
        if max(abs(row["energy"]) for row in rows if row["cylinder"] == c) > SMALL * whole
    ] or cylinders[:1]
    chart.nodes["pump"] = _Node(0.0, "pump", COLOURS["supply"])
    for c in busy:
        chart.nodes[c] = _Node(0.36, c, INK)
    chart.nodes["mechanism"] = _Node(0.16 if uphill else 0.62, "mechanism", COLOURS["load"])

    def leaf(node: str, row: Mapping[str, Any], group: str, label: str) -> None:
        energy = row["energy"]
        if energy >= 0.0:
            chart.flows.append(_Flow(node, None, energy, group, label, half_of(row)))
        else:
            chart.flows.append(_Flow(None, node, -energy, group, label, half_of(row)))

    several = len(busy) > 1

    mechanical = ("friction", "end_stop", "stop", "damping")
    for row in rows:
        c, word = row["cylinder"], row["name"].rsplit(".", 1)[-1]
        if row["group"] in ("supply", "cylinder", "residual") or (c is not None and c not in busy):
            continue
        group = "residual" if row["group"] == "part" else row["group"]
        label = row["label"].split(",")[0] if group == "residual" else row["label"]
        if row["name"] == "supply_line" or row["name"].endswith(".supply_line"):
            leaf("pump", row, group, label if group != "residual" else f"{label}, supply line")
        elif group == "load" or word in mechanical or row["name"].endswith(".mechanism"):
            leaf(
                "mechanism",
                row,
                group,
                f"{label}, mechanism" if group == "residual" else _prefix(c, several) + label,
            )
        else:
            leaf(
                c,
                row,
                group,
                f"{label}, oil of {c}" if group == "residual" else _prefix(c, several) + label,
            )
    for c in busy:
        drawn = named[f"{c}.drawn"]["energy"] + named[f"{c}.drawn_compression"]["energy"]
        if drawn > 0.0:
            chart.flows.append(_Flow("pump", c, drawn, "supply", ""))
        elif drawn < 0.0:  # oil pressed back into the supply line
            chart.flows.append(_Flow(c, None, -drawn, "supply", f"{c}: back into the supply"))
        work = works[c]
        if work >= 0.0 and not uphill:
            chart.flows.append(_Flow(c, "mechanism", work, "load", ""))
        elif work < 0.0 and uphill:
            chart.flows.append(_Flow("mechanism", c, -work, "load", ""))
        elif work >= 0.0:
            chart.flows += [
                _Flow(c, None, work, "load", f"work of {c}"),
                _Flow(None, "mechanism", work, "load", f"work of {c}"),
            ]
        else:
            chart.flows += [
                _Flow(None, c, -work, "load", f"load on {c}"),
                _Flow("mechanism", None, -work, "load", f"into {c}"),
            ]
    if given > 0.0 and any(f.start == "pump" for f in chart.flows):
        chart.flows.append(_Flow(None, "pump", given, "supply", "pump", half_of(named["pump"])))
    chart.flows = _merged(chart.flows, whole, several)
    return chart, given


def _fit(sizes: Sequence[float], line: float) -> float:
    """Height per energy at which slots of max(size, label) and the gaps between them fill the
    picture.
    """
    low, high = 0.0, 0.94 / max(sum(sizes), 1e-12)
    room = 1.0 - _GAP * max(len(sizes) - 1, 0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high) if sum(max(s * middle, line) for s in sizes) <= room else (low, middle)
        )
    return low


def _slots(sizes: Sequence[float], scale: float, line: float) -> list[float]:
    """Middles of slots stacked from the top, as high as their ribbon or label, spread a little over
    the picture.
    """
    heights = [max(size * scale, line) for size in sizes]
    gap = min((1.0 - sum(heights)) / max(len(heights) - 1, 1), 3 * _GAP)
    y = 0.5 + 0.5 * (sum(heights) + gap * (len(heights) - 1))
    middles = []
    for height in heights:
        middles.append(y - 0.5 * height)
        y -= height + gap
    return middles


def _stand(chart: _Chart, at: Mapping[int, float], scale: float, line: float) -> list[str]:
    """Give every node that has ribbons its size and height; returns their names."""
    nodes, flows = chart.nodes, chart.flows
    used = [name for name in nodes if any(name in (f.start, f.end) for f in flows)]
    for name in used:
        out = sum(f.energy for f in flows if f.start == name)
        into = sum(f.energy for f in flows if f.end == name)
        nodes[name].size = max(out, into) * scale
    for name in sorted(
        used, key=lambda n: -nodes[n].x
    ):  # right to left: a node stands where most of what leaves it goes
        ends = [
            (at[id(f)] if f.end is None else nodes[f.end].y, f.energy)
            for f in flows
            if f.start == name
        ]
        weight = sum(e for _, e in ends)
        nodes[name].y = sum(y * e for y, e in ends) / weight if weight > 0.0 else 0.5
    column = sorted((n for n in used if n not in ("pump", "mechanism")), key=lambda n: -nodes[n].y)
    reach = 1.0
    for name in column:  # their names need room above
        node = nodes[name]
        node.y = min(node.y, reach - 0.5 * node.size - line)
        reach = node.y - 0.5 * node.size
    for name in column:
        nodes[name].y -= min(reach, 0.0)
    return used


def sankey(path: Path, ledger: Mapping[str, Any]) -> None:
    """Where the energy of one trial went: ribbons from the pump through the oil of each cylinder
    and the mechanism, to scale.

    What is given back (a load that sinks, oil that expands) enters from the left. Rows under 1.2 %
    are drawn together."""
    from matplotlib.patches import Patch

    chart, given = _chart(ledger)
    unit, nodes, flows = _scale([ledger]), chart.nodes, chart.flows
    order = {
        name: i
        for i, name in enumerate(
            ["mechanism", *[n for n in nodes if n not in ("pump", "mechanism")], "pump"]
        )
    }
    ranks = list(COLOURS)
    leaves = sorted(
        (f for f in flows if f.end is None),
        key=lambda f: (order[f.start], -ranks.index(f.group), -f.energy),
    )
    sources = sorted(
        (f for f in flows if f.start is None),
        key=lambda f: (f.end != "mechanism", f.end != "pump", order[f.end], -f.energy),
    )
    tall = min(max(3.0, 0.21 * len(leaves) + 1.3), 8.5)
    line, line_left = 0.175 / tall, 0.36 / tall
    scale = min(
        _fit([f.energy for f in leaves], line), _fit([f.energy for f in sources], line_left)
    )
    at = dict(zip(map(id, leaves), _slots([f.energy for f in leaves], scale, line), strict=True))
    at |= zip(map(id, sources), _slots([f.energy for f in sources], scale, line_left), strict=True)
    used = _stand(chart, at, scale, line)
    if len(sources) == 1:
        at[id(sources[0])] = nodes[sources[0].end].y
    for f in sources:
        if f.group == "supply" and f.label == "pump":
            nodes["pump"].y = at[id(f)]
    with canvas(path, size=(7.4, tall)) as (figure, ax):
        ax.set_xlim(-0.36, 1.98)
        ax.set_ylim(-0.04, 1.03)
        ax.axis("off")
        for f in sorted(
            flows, key=lambda f: (-_height(f.start, nodes, at, f), -_height(f.end, nodes, at, f))
        ):
            thick, colour = f.energy * scale, COLOURS[f.group]
            if f.start is None:
                bold = f.label == "pump" and f.end == "pump"
                words = f"{f.label}\n{_text(f.energy, f.half, unit, 0.0)}"
                if bold:
                    gained = next(
                        row["energy"] for row in ledger["rows"] if row["name"] == "pump_compression"
                    )
                    words = f"{f.label}\n{_text(f.energy - gained, f.half, unit, 0.0)}"
                    below = f"+ {_text(gained, None, unit, 0.0)} compression"
                    ax.text(
                        -0.025,
                        at[id(f)] - 1.35 * line,
                        below,
                        va="center",
                        ha="right",
                        fontsize=7,
                        color=MUTED,
                    )
                style = {"fontsize": 8.5, "weight": "bold"} if bold else {"fontsize": 8}
                ax.text(-0.025, at[id(f)], words, va="center", ha="right", linespacing=1.2, **style)
                ax.add_patch(
                    _bar(0.0, at[id(f)], max(thick, nodes["pump"].size) if bold else thick, colour)
                )
                if f.end == "pump":
                    continue
            y0 = _leave(nodes[f.start], thick) if f.start is not None else at[id(f)]
            y1 = _enter(nodes[f.end], thick) if f.end is not None else at[id(f)]
            x0 = nodes[f.start].x + _BAR if f.start is not None else _BAR
            x1 = nodes[f.end].x if f.end is not None else 1.0
            _ribbon(ax, x0, y0, x1, y1, thick, colour)
            if f.end is None:
                ax.add_patch(_bar(1.0, y1, thick, colour))
                ax.text(1.0 + 2.0 * _BAR, y1, f.label, va="center", fontsize=8)
                ax.text(
                    1.98,
                    y1,
                    _text(f.energy, f.half, unit, given),
                    va="center",
                    ha="right",
                    fontsize=8,
                )
        for name in used:
            node = nodes[name]
            if name != "pump":
                ax.add_patch(_bar(node.x, node.y, node.size, node.colour))
                ax.text(
                    node.x + 0.5 * _BAR,
                    node.y + 0.5 * node.size + 0.008,
                    node.label,
                    va="bottom",
                    ha="center",
                    fontsize=8.5,
                    weight="bold",
                    bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6},
                    zorder=5,
                )
        rest = next(row for row in ledger["rows"] if row["group"] == "residual")
        words = f"{rest['label']} in all: {_text(rest['energy'], half_of(rest), unit, given)}"
        ax.text(-0.36, -0.03, words, fontsize=8, color=MUTED)
        present = [g for g in COLOURS if any(f.group == g for f in flows)]
        legend(figure, [Patch(color=COLOURS[g], alpha=0.75, label=WORDS[g]) for g in present])


def _height(
    name: str | None, nodes: Mapping[str, _Node], at: Mapping[int, float], flow: _Flow
) -> float:
    return at[id(flow)] if name is None else nodes[name].y


def _leave(node: _Node, thick: float) -> float:
    y = node.y + 0.5 * node.size - node.left - 0.5 * thick
    node.left += thick
    return y


def _enter(node: _Node, thick: float) -> float:
    y = node.y + 0.5 * node.size - node.entered - 0.5 * thick
    node.entered += thick
    return y


def _bar(x: float, y: float, thick: float, colour: str):
    from matplotlib.patches import Rectangle

    return Rectangle(
        (x, y - 0.5 * thick), _BAR, thick, facecolor=colour, edgecolor="none", zorder=3
    )


def _ribbon(ax, x0: float, y0: float, x1: float, y1: float, thick: float, colour: str) -> None:
    """A band of even height that leaves and arrives level."""
    from matplotlib.patches import Polygon

    s = np.linspace(0.0, 1.0, 60)
    x, y = x0 + s * (x1 - x0), y0 + (3 * s**2 - 2 * s**3) * (y1 - y0)
    half = 0.5 * max(thick, 0.0012)
    edge = np.concatenate([np.stack([x, y + half], 1), np.stack([x, y - half], 1)[::-1]])
    ax.add_patch(
        Polygon(edge, closed=True, facecolor=colour, alpha=0.42, edgecolor="none", zorder=2)
    )


# --- several trials
# -------------------------------------------------------------------------------------------------

_PARTS = {
    "load": ("load", "#2e7d5b"),
    "mechanical": ("friction, damping, end stops", "#b59f3b"),
    "in": ("throttling, supply side", "#e08214"),
    "cross": ("throttling, head ↔ rod", "#f3b96b"),
    "out": ("throttling, tank side", "#8e4585"),
    "oil": ("leakage, relief, expansion, return line", "#8a7f72"),
    "store": ("stored in oil", "#5b8fb9"),
    "rest": ("not accounted for", ACCENT),
}
_LIMITS = {
    "standard": ("four-way valve", "-"),
    "six": ("six functions", "--"),
    "seventh": ("with the seventh", ":"),
}


def part_of(row: Mapping[str, Any]) -> str | None:
    """The stack to which a row belongs; None for rows that are not summed."""
    group, word = row["group"], row["name"].rsplit(".", 1)[-1]
    if group == "valve":
        ends = row["label"].rsplit(", ", 1)[-1].split(" → ")
        return "in" if "supply" in ends else "out" if "tank" in ends else "cross"
    if group == "loss":
        return "mechanical" if word in ("friction", "damping", "end_stop") else "oil"
    if word == "stop":
        return "mechanical"
    return {"load": "load", "store": "store", "residual": "rest"}.get(group)


def bars(
    path: Path,
    ledgers: Sequence[tuple[str, Mapping[str, Any]]],
    bounds: Sequence[Sequence[Mapping[str, Any]]] | None = None,
) -> None:
    """A stacked bar a trial: what its energy went into; what was given back lies left of zero.

    Args:
        path: of the SVG.
        ledgers: (title of the trial, its ledger).
        bounds: for each trial the bounds of its cylinders (``Bounds.as_json``), drawn as marks on
            the bar; empty for none.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    unit = _scale([ledger for _, ledger in ledgers])
    sums = []
    for _, ledger in ledgers:
        parts = dict.fromkeys(_PARTS, 0.0)
        for row in _rows(ledger):
            part = part_of(row)
            if part is not None:
                parts[part] += row["energy"] / unit[0]
        sums.append(parts)
    most = max(sum(max(v, 0.0) for v in parts.values()) for parts in sums)
    least = min(sum(min(v, 0.0) for v in parts.values()) for parts in sums)
    limits = [_sum_of(bounds[i]) if bounds is not None else {} for i in range(len(ledgers))]
    reach = max([most, *(value / unit[0] for one in limits for value in one.values())])
    drawn = [key for key in _PARTS if any(abs(parts[key]) > SEEN * most for parts in sums)]
    with canvas(path, size=(7.4, 0.62 * len(ledgers) + 1.7)) as (figure, ax):
        for i, ((_, ledger), parts) in enumerate(zip(ledgers, sums, strict=True)):
            ahead, behind = 0.0, 0.0
            for key in drawn:
                value = parts[key]
                start = ahead if value >= 0.0 else behind
                ax.barh(
                    i,
                    value,
                    left=start,
                    height=0.56,
                    color=_PARTS[key][1],
                    edgecolor="white",
                    linewidth=0.6,
                    zorder=2,
                )
                if abs(value) > 0.065 * (reach - least):
                    place = start + 0.5 * value, i
                    box = {"facecolor": _PARTS[key][1], "edgecolor": "none", "pad": 1.0}
                    words = number(value, 3)
                    ax.text(
                        *place,
                        words,
                        ha="center",
                        va="center",
                        fontsize=7.5,
                        color="white",
                        zorder=6,
                        bbox=box,
                    )
                if value >= 0.0:
                    ahead += value
                else:
                    behind += value
            pump = next(row for row in ledger["rows"] if row["name"] == "pump")
            half = half_of(pump)
            total = sum(row["energy"] for row in ledger["rows"] if row["group"] == "supply")
            if half:
                ax.errorbar(
                    total / unit[0],
                    i,
                    xerr=half / unit[0],
                    color=INK,
                    capsize=3,
                    linewidth=1.0,
                    zorder=5,
                )
            right = max(
                [
                    ahead,
                    (total + (half or 0.0)) / unit[0],
                    *(v / unit[0] for v in limits[i].values()),
                ]
            )
            words = _text(pump["energy"], half, unit, 0.0) if pump["energy"] else DASH
            ax.annotate(
                words,
                (right, i),
                (6, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                weight="bold",
            )
            for key, value in limits[i].items():
                style = {"color": INK, "linestyle": _LIMITS[key][1], "linewidth": 1.5, "zorder": 5}
                ax.plot([value / unit[0]] * 2, [i - 0.38, i + 0.38], **style)
        ax.axvline(0.0, color=MUTED, linewidth=0.8)
        ax.set_yticks(range(len(ledgers)), [title for title, _ in ledgers])
        ax.set_ylim(len(ledgers) - 0.45, -0.55)
        ax.set_xlim(1.05 * least, 1.24 * reach)
        ax.grid(False, axis="y")
        ax.set_xlabel(f"energy [{unit[1]}]; at the bar's end what the pump gave")
        handles = [Patch(color=_PARTS[key][1], label=_PARTS[key][0]) for key in drawn]
        kinds = [key for key in _LIMITS if any(key in one for one in limits)]
        handles += [
            Line2D([], [], color=INK, linestyle=_LIMITS[k][1], label=f"bound: {_LIMITS[k][0]}")
            for k in kinds
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _sum_of(bounds: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Bounds of several cylinders added up; one that a cylinder has not is left out."""
    found = {}
    for key in _LIMITS:
        values = [one.get(key) for one in bounds]
        if values and None not in values:
            found[key] = float(sum(values))
    return found
