"""Where one trial's energy went, as ribbons to scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from ehbench.report.figures.energy import Ledger, energy_text, half_of, unit_for
from ehbench.report.style import ACCENT, INK, MUTED, canvas, legend, spread, swatch
from ehbench.vocabulary import grouped
from ehbench.vocabulary.terms import MECHANICAL

# colour and name of each group of rows
GROUPS = {
    "supply": ("#1f3f66", "supply"),
    "valve": ("#e08214", "throttling"),
    "loss": ("#8a7f72", "other losses"),
    "store": ("#5b8fb9", "stored in oil"),
    "load": ("#2e7d5b", "load"),
    "residual": (ACCENT, "not accounted for"),
}
SUPPLY, MECHANISM = "supply", "mechanism"
_COLOURS = {SUPPLY: GROUPS["supply"][0], MECHANISM: GROUPS["load"][0]}  # of nodes
_BAR, _END = 0.022, 0.92  # width of a node, and where the leaves are
_SMALL = 0.012  # share of all energy below which a row is drawn together with others


@dataclass(frozen=True, eq=False)
class _Flow:
    """A ribbon [J]; ``end`` None: a leaf at the right, ``start`` None: a source at the left."""

    start: str | None
    end: str | None
    energy: float
    group: str
    label: str = ""
    half: float | None = None

    @classmethod
    def of(cls, row: Any, several: bool) -> Self | None:
        """That of a row, which ends or begins outside; None of a row that is a sum of others."""
        cylinder = row["cylinder"]
        group, label, word = row["group"], row["label"], row["name"].rsplit(".", 1)[-1]
        if group in ("cylinder", "residual"):
            return None
        node = cylinder
        if group == "load" or word in (*MECHANICAL, "mechanism"):
            node = MECHANISM
        elif node is None or word == "supply_line":
            node = SUPPLY
        if node == SUPPLY and group == "supply":
            label = word.replace("_", " ")
        elif group == "part":  # of what is not accounted for
            place = f"oil of {node}" if node == cylinder else node
            group, label = "residual", f"{label.partition(',')[0]}, {place}"
        elif several and cylinder is not None:
            label = f"{cylinder}: {label}"
        # a supply gives what is positive, all others take it
        enters = (row["energy"] >= 0.0) == (group == "supply")
        ends = (None, node) if enters else (node, None)
        return cls(*ends, abs(row["energy"]), group, label, half_of(row))


def _given(ledger: Ledger) -> float:
    return sum(row["energy"] for row in ledger["rows"] if row["group"] == "supply")


def _works(ledger: Ledger) -> dict[str, float]:
    rows = (row for row in ledger["rows"] if row["name"] == f"{row['cylinder']}.work")
    return {row["cylinder"]: row["energy"] for row in rows}


def _through(ledger: Ledger) -> float:
    return max(_given(ledger), sum(map(abs, _works(ledger).values())), 1e-12)


def is_known(ledger: Ledger) -> bool:
    """Whether more energy went through a trial than any row of its ledger may be off: of others a
    picture would show noise."""
    return _through(ledger) > max(half_of(row) or 0.0 for row in ledger["rows"])


def _ribbons(ledger: Ledger, small: float) -> list[_Flow]:
    """Supply → oil of each cylinder → mechanism, and what leaves or enters on the way; cylinders
    of which no row reaches ``small`` [J] are left out."""
    rows, works = ledger["rows"], _works(ledger)
    busy = [
        name
        for name in works
        if any(abs(row["energy"]) > small for row in rows if row["cylinder"] == name)
    ]
    busy = busy or list(works)[:1]
    several = len(busy) > 1  # then labels say of which cylinder they are
    leaves = [_Flow.of(row, several) for row in rows if row["cylinder"] in (None, *busy)]
    flows = [flow for flow in leaves if flow is not None and flow.energy > 0.0]
    drives = sum(works.values()) < 0.0
    for cylinder in busy:
        names = [f"{cylinder}.{word}" for word in ("drawn", "drawn_compression")]
        drawn = sum(row["energy"] for row in rows if row["name"] in names)
        if drawn > 0.0:
            flows.append(_Flow(SUPPLY, cylinder, drawn, "supply"))
        elif drawn < 0.0:
            label = f"{cylinder}: back into the supply"
            flows.append(_Flow(cylinder, None, -drawn, "supply", label))
        pushes, work = works[cylinder] >= 0.0, abs(works[cylinder])
        start, end = (cylinder, MECHANISM) if pushes else (MECHANISM, cylinder)
        if pushes != drives:
            flows.append(_Flow(start, end, work, "load"))
        else:  # against the picture: out of it and in again
            label = f"work of {cylinder}" if pushes else f"into {cylinder}"
            flows.append(_Flow(start, None, work, "load", label))
            label = label if pushes else f"load on {cylinder}"
            flows.append(_Flow(None, end, work, "load", label))
    return flows


def _gathered(flows: Sequence[_Flow], small: float) -> list[_Flow]:
    """The ribbons with the leaves and sources below ``small`` [J] of each node as one; none where
    these come to next to nothing. What the supply gave or took back stands alone."""

    def little(flow: _Flow) -> tuple[str | None, str | None, bool] | None:
        inner = flow.start is not None and flow.end is not None
        if inner or flow.energy >= small or flow.group == "supply":
            return None
        return flow.start, flow.end, flow.group == "residual"

    several = len({flow.start for flow in flows} - {SUPPLY, MECHANISM, None}) > 1
    groups = grouped(flows, little)
    retained = groups.pop(None, [])
    for few in groups.values():
        first, energy = few[0], sum(flow.energy for flow in few)
        if energy < (0.5 if first.group == "residual" else 0.15) * small:
            continue
        if len(few) == 1:
            retained.append(first)
            continue
        halves = [flow.half for flow in few]
        half = math.hypot(*(h for h in halves if h)) if None not in halves else None
        group = first.group if len({flow.group for flow in few}) == 1 else "loss"
        node = first.start or first.end
        prefix = f"{node}: " if several and node not in (SUPPLY, MECHANISM) else ""
        label = f"{prefix}{len(few)} smaller ones"
        retained.append(_Flow(first.start, first.end, energy, group, label, half))
    return retained


class _Layout:
    """Where ribbons and nodes stand: columns from the leaves at the right to the sources."""

    def __init__(self, flows: Sequence[_Flow], drives: bool) -> None:
        """``drives``: the load drives the oil; then the mechanism stands before it."""
        names = dict.fromkeys(n for flow in flows for n in (flow.end, flow.start) if n)
        places = {MECHANISM: 0.14 if drives else 0.62, SUPPLY: 0.14}
        self.x = {name: places.get(name, 0.41) for name in names}  # of each node
        order, ranks = sorted(names, key=lambda n: -self.x[n]), list(GROUPS)
        leaves = sorted(  # from the bottom to the top
            (flow for flow in flows if flow.end is None),
            key=lambda f: (-order.index(f.start or ""), ranks.index(f.group), f.energy),
        )
        sources = [flow for flow in flows if flow.start is None]
        self.tall = max(0.23 * len(leaves), 0.5 * len(sources)) + 1.8  # [in]
        line = 0.175 / self.tall  # height of a line of text
        two = 2.1 * line  # of what stands beside a source
        self.scale = min(
            (1.0 - len(ends) * text) / max(sum(flow.energy for flow in ends), 1e-12)
            for ends, text in ((leaves, line), (sources, two))
        )  # height per J
        self.outer: dict[_Flow, float] = {}  # of leaves and sources
        self.middle: dict[str, float] = {}  # of each node
        self.size: dict[str, float] = {}
        slots = [f.energy * self.scale + line for f in leaves]
        self.outer |= zip(leaves, spread([0.5] * len(leaves), slots, 0.0, 1.0), strict=True)
        for x in sorted(set(self.x.values()), reverse=True):
            wanted: dict[str, float] = {}
            for name in (name for name in names if self.x[name] == x):
                out = [flow for flow in flows if flow.start == name]
                into = sum(flow.energy for flow in flows if flow.end == name)
                weight = sum(flow.energy for flow in out)
                self.size[name] = max(weight, into) * self.scale
                # where most of what leaves it goes
                ends = [(self.outer[f] if f.end is None else self.middle[f.end]) for f in out]
                moment = sum(y * f.energy for y, f in zip(ends, out, strict=True))
                wanted[name] = moment / weight if weight > 0.0 else 0.5
            slots = [self.size[name] + 2.0 * line for name in wanted]  # room for their names
            places = spread([*wanted.values()], slots, 0.0, 1.0)
            self.middle |= zip(wanted, places, strict=True)
        sources.sort(key=lambda flow: flow.energy)
        slots = [f.energy * self.scale + two for f in sources]
        places = spread([self.middle[f.end or ""] for f in sources], slots, 0.0, 1.0)
        self.outer |= zip(sources, places, strict=True)


def sankey(path: Path, ledger: Ledger) -> None:
    """Where the energy of one trial went: ribbons from the supply through the oil of each cylinder
    and the mechanism, to scale.

    What is given back (a load that sinks, oil that expands) enters from the left. Rows under 1.2 %
    are drawn together. Shares are of what the supply gave; where the load drives the oil, of all
    that enters."""
    from matplotlib.patches import Rectangle

    small = _SMALL * _through(ledger)
    flows, drives = _gathered(_ribbons(ledger, small), small), sum(_works(ledger).values()) < 0.0
    layout, unit = _Layout(flows, drives), unit_for([ledger])
    whole = sum(f.energy for f in flows if f.start is None) if drives else _given(ledger)
    tops = {n: (x, layout.middle[n] + 0.5 * layout.size[n]) for n, x in layout.x.items()}
    docked = {(name, side): y for name, (_, y) in tops.items() for side in (0.0, _BAR)}
    with canvas(path, size=(7.4, layout.tall)) as (figure, ax):
        ax.set(xlim=(-0.4, 1.98), ylim=(-0.05, 1.03))
        ax.axis("off")

        def draw_bar(x: float, y: float, thick: float, colour: str) -> None:
            look = {"facecolor": colour, "edgecolor": "none", "zorder": 3}
            ax.add_patch(Rectangle((x, y - 0.5 * thick), _BAR, thick, **look))

        heights: dict[_Flow | str, float] = {**layout.outer, **layout.middle}
        for flow in sorted(flows, key=lambda f: (-heights[f.start or f], -heights[f.end or f])):
            colour, thick = GROUPS[flow.group][0], flow.energy * layout.scale
            ends: list[tuple[float, float]] = []
            for node, side, x in ((flow.start, _BAR, 0.0), (flow.end, 0.0, _END)):
                if node is None:
                    ends.append((x + side, layout.outer[flow]))
                    draw_bar(x, layout.outer[flow], thick, colour)
                else:  # below what is docked there
                    docked[node, side] -= thick
                    ends.append((layout.x[node] + side, docked[node, side] + 0.5 * thick))
            (x, y), (x_end, y_end) = ends
            s = np.linspace(0.0, 1.0, 60)
            middle = y + (3 * s**2 - 2 * s**3) * (y_end - y)
            half = 0.5 * max(thick, 0.0012)
            look = {"facecolor": colour, "alpha": 0.42, "edgecolor": "none", "zorder": 2}
            ax.fill_between(x + s * (x_end - x), middle - half, middle + half, **look)
            look = {"va": "center", "fontsize": 8}
            if flow.start is None:
                words = f"{flow.label}\n{energy_text(flow.energy, flow.half, unit)}"
                ax.text(-0.025, y, words, ha="right", linespacing=1.2, **look)
            elif flow.end is None:
                ax.text(_END + 2.0 * _BAR, y_end, flow.label, **look)
                words = energy_text(flow.energy, flow.half, unit, whole)
                ax.text(1.98, y_end, words, ha="right", **look)
        look: dict[str, Any] = {"va": "bottom", "ha": "center", "fontsize": 8.5, "zorder": 5}
        look["weight"] = "bold"
        look["bbox"] = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6}
        for name, (x, top) in tops.items():
            draw_bar(x, layout.middle[name], layout.size[name], _COLOURS.get(name, INK))
            ax.text(x + 0.5 * _BAR, top + 0.008, name, **look)
        rest = next(row for row in ledger["rows"] if row["group"] == "residual")
        amount = energy_text(rest["energy"], half_of(rest), unit, whole)
        ax.text(-0.4, -0.04, f"{rest['label']} in all: {amount}", fontsize=8, color=MUTED)
        present = {flow.group for flow in flows}
        looks = [look for group, look in GROUPS.items() if group in present]
        legend(figure, [swatch(name, colour, alpha=0.75) for colour, name in looks])
