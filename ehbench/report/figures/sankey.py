"""Where one trial's energy went, as ribbons to scale."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from ehbench.report.figures.energy import Ledger, Unit, energy_text, half_of, unit_for
from ehbench.report.style import ACCENT, INK, MUTED, canvas, legend, swatch

# colour and name of each group of rows
GROUPS = {
    "supply": ("#1f3f66", "supply"),
    "valve": ("#e08214", "throttling"),
    "loss": ("#8a7f72", "other losses"),
    "store": ("#5b8fb9", "stored in oil"),
    "load": ("#2e7d5b", "load"),
    "residual": (ACCENT, "not accounted for"),
}
PUMP, RAIL, MECHANISM = "pump", "low rail", "mechanism"
# rows that a source of the supply is the sum of; the last of them has a line of its label
SOURCES = {PUMP: ("pump", "pump_compression"), RAIL: ("low_rail", "low_rail_compression")}
_BAR = 0.022  # width of a node
_MECHANICAL = (
    *("friction", "friction_spring", "end_stop", "stop", "damping"),
    *("mount", "mount_spring", "sway", "swaying"),
)


@dataclass(frozen=True, eq=False)
class _Flow:
    """A ribbon; ``end`` None: a leaf at the right, ``start`` None: a source at the left."""

    start: str | None
    end: str | None
    energy: float
    group: str
    label: str
    half: float | None = None

    @property
    def feeds_pump(self) -> bool:
        """Whether it is what drives the pump."""
        return self.start is None and self.end == PUMP

    @property
    def has_compression(self) -> bool:
        """Whether what compression gave stands in a further line below its energy."""
        return self.feeds_pump and self.label in SOURCES


@dataclass(frozen=True)
class _Account:
    """A ledger prepared for the picture: energies in J."""

    rows: Sequence[Mapping[str, Any]]
    named: Mapping[str, Mapping[str, Any]]
    works: Mapping[str, float]  # of every cylinder
    busy: Sequence[str]  # cylinders worth a node
    given: float  # by the supply
    small: float  # energy below which a row is drawn together with others

    @classmethod
    def of(cls, ledger: Ledger) -> Self:
        """A ledger with the cylinders and rows above 1.2 % of all energy."""
        share = 0.012
        rows = ledger["rows"]
        named = {row["name"]: row for row in rows}
        cylinders = dict.fromkeys(row["cylinder"] for row in rows if row["cylinder"] is not None)
        works = {name: named[f"{name}.work"]["energy"] for name in cylinders}
        given = sum(row["energy"] for row in rows if row["group"] == "supply")
        whole = max(given, sum(abs(work) for work in works.values()), 1e-12)
        tops = {
            name: max(abs(row["energy"]) for row in rows if row["cylinder"] == name)
            for name in cylinders
        }
        busy = [name for name in cylinders if tops[name] > share * whole]
        return cls(rows, named, works, busy or list(cylinders)[:1], given, share * whole)

    @property
    def rails(self) -> bool:
        """Whether there is a low rail besides the pump: then both have ribbons to the supply."""
        return "low_rail" in self.named

    @property
    def uphill(self) -> bool:
        """Whether the load drives the oil: then the mechanism stands before it."""
        return sum(self.works.values()) < 0.0

    def prefix(self, node: str | None) -> str:
        """The cylinder's name before a label, where there are several."""
        named = len(self.busy) > 1 and node not in (None, PUMP, MECHANISM)
        return f"{node}: " if named else ""


def _ribbons(account: _Account) -> list[_Flow]:
    """Pump → oil of each cylinder → mechanism, and what leaves or enters on the way."""
    flows = [flow for row in account.rows if (flow := _leaf(row, account)) is not None]
    for cylinder in account.busy:
        drawn = sum(
            account.named[f"{cylinder}.{word}"]["energy"] for word in ("drawn", "drawn_compression")
        )
        if drawn > 0.0:
            flows.append(_Flow(PUMP, cylinder, drawn, "supply", ""))
        elif drawn < 0.0:
            label = f"{cylinder}: back into the supply"
            flows.append(_Flow(cylinder, None, -drawn, "supply", label))
        work, to_mechanism = account.works[cylinder], account.works[cylinder] >= 0.0
        start, end = (cylinder, MECHANISM) if to_mechanism else (MECHANISM, cylinder)
        if to_mechanism != account.uphill:
            flows.append(_Flow(start, end, abs(work), "load", ""))
            continue
        # against the picture: out of it and in again
        label = f"work of {cylinder}" if to_mechanism else f"into {cylinder}"
        flows.append(_Flow(start, None, abs(work), "load", label))
        label = label if to_mechanism else f"load on {cylinder}"
        flows.append(_Flow(None, end, abs(work), "load", label))
    if any(flow.start == PUMP for flow in flows):
        for label, names in SOURCES.items():
            rows = [account.named[name] for name in names if name in account.named]
            given = sum(row["energy"] for row in rows)
            if given > 0.0:
                flows.append(_Flow(None, PUMP, given, "supply", label, half_of(rows[0])))
    retained: list[_Flow] = []
    little: dict[tuple[str | None, str | None, bool], list[_Flow]] = {}
    for flow in flows:
        ends = flow.start is None or flow.end is None
        if ends and flow.energy < account.small and flow.group != "supply":
            little.setdefault((flow.start, flow.end, flow.group == "residual"), []).append(flow)
        else:
            retained.append(flow)
    for (start, end, rest), few in little.items():
        energy = sum(flow.energy for flow in few)
        if energy < (0.5 if rest else 0.15) * account.small:
            continue
        if len(few) == 1:
            retained += few
            continue
        halves = [flow.half for flow in few]
        half = math.hypot(*(h for h in halves if h)) if None not in halves else None
        group = few[0].group if len({flow.group for flow in few}) == 1 else "loss"
        label = account.prefix(start or end) + f"{len(few)} smaller ones"
        retained.append(_Flow(start, end, energy, group, label, half))
    return retained


def _leaf(row: Mapping[str, Any], account: _Account) -> _Flow | None:
    """The ribbon of a row that ends or begins outside; None if it is drawn otherwise."""
    cylinder, name, energy, label = row["cylinder"], row["name"], row["energy"], row["label"]
    group = row["group"]
    if group in ("cylinder", "residual") or cylinder not in (None, *account.busy):
        return None
    if group == "supply":  # the shaft of a pump at a cylinder, a motor where it is negative
        if cylinder is None:
            return None
        start, end = (None, cylinder) if energy >= 0.0 else (cylinder, None)
        label = account.prefix(cylinder) + label
        return _Flow(start, end, abs(energy), group, label, half_of(row))
    moving = name.rsplit(".", 1)[-1] in _MECHANICAL or name.endswith(".mechanism")
    node, place, prefix = cylinder, f"oil of {cylinder}", account.prefix(cylinder)
    if name in ("supply_line", "accumulator") or name.endswith(".supply_line"):
        node, place, prefix = PUMP, "supply line", ""
    elif group == "load" or moving:
        node, place = MECHANISM, "mechanism"
    if group == "part":  # of what is not accounted for
        group, label = "residual", f"{label.split(',')[0]}, {place}"
    else:
        label = prefix + label
    start, end = (node, None) if energy >= 0.0 else (None, node)
    return _Flow(start, end, abs(energy), group, label, half_of(row))


def _fit(sizes: Sequence[float], lines: Sequence[float]) -> float:
    """Height per energy at which slots of max(size, line) and their gaps fill the picture."""
    low, high = 0.0, 0.94 / max(sum(sizes), 1e-12)
    room = 1.0 - 0.012 * max(len(sizes) - 1, 0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        filled = sum(max(s * middle, line) for s, line in zip(sizes, lines, strict=True))
        low, high = (middle, high) if filled <= room else (low, middle)
    return low


class _Dock:
    """A node in place: as high as what passes it, ribbons stacked on both sides from the top."""

    def __init__(self, x: float, label: str, colour: str, middle: float, size: float) -> None:
        self.x, self.label, self.colour = x, label, colour
        self.middle, self.size = middle, size
        self._taken = {"left": 0.0, "right": 0.0}

    def dock(self, side: str, thick: float) -> float:
        """The height at which the next ribbon of a side meets the node."""
        y = self.middle + 0.5 * self.size - self._taken[side] - 0.5 * thick
        self._taken[side] += thick
        return y


@dataclass(frozen=True)
class _Layout:
    """Where everything stands: nodes, and the outer ends of leaves and sources by their flow."""

    flows: Sequence[_Flow]
    docks: Mapping[str, _Dock]
    outer: Mapping[_Flow, float]
    scale: float  # height per J
    line: float  # height of a line of text
    tall: float  # [in]


def _layout(account: _Account) -> _Layout:
    flows = _ribbons(account)
    nodes = {  # from right to left, mechanism and load drawn at the left where they drive
        MECHANISM: (0.16 if account.uphill else 0.62, MECHANISM, GROUPS["load"][0]),
        **{cylinder: (0.36, cylinder, INK) for cylinder in account.busy},
        PUMP: (0.11 if account.rails else 0.0, "supply", GROUPS["supply"][0]),
    }
    order, ranks = {name: i for i, name in enumerate(nodes)}, list(GROUPS)
    leaves = sorted(
        (f for f in flows if f.end is None),
        key=lambda f: (order[f.start or ""], -ranks.index(f.group), -f.energy),
    )
    sources = sorted(
        (f for f in flows if f.start is None),
        key=lambda f: (f.end != MECHANISM, f.end != PUMP, order[f.end or ""], -f.energy),
    )
    tall = min(max(3.4 if account.rails else 3.0, 0.21 * len(leaves) + 1.3), 8.5)
    line = 0.175 / tall
    columns = [
        (leaves, [f.energy for f in leaves], [line] * len(leaves)),
        (
            sources,
            [f.energy for f in sources],
            [(3.8 if f.has_compression else 2.1) * line for f in sources],
        ),
    ]
    scale = min(_fit(sizes, lines) for _, sizes, lines in columns)
    outer: dict[_Flow, float] = {}
    for ends, sizes, lines in columns:
        heights = [max(size * scale, line) for size, line in zip(sizes, lines, strict=True)]
        gap = min((1.0 - sum(heights)) / max(len(heights) - 1, 1), 0.036)
        y = 0.5 + 0.5 * (sum(heights) + gap * (len(heights) - 1))
        middles = []
        for height in heights:
            middles.append(y - 0.5 * height)
            y -= height + gap
        outer |= zip(ends, middles, strict=True)
    heights, middles = {}, {}
    for name in sorted(nodes, key=lambda name: -nodes[name][0]):
        out = [f for f in flows if f.start == name]
        into = sum(f.energy for f in flows if f.end == name)
        if not out and not any(f.end == name for f in flows):
            continue
        weight = sum(f.energy for f in out)
        heights[name] = max(weight, into) * scale
        ends = [(outer[f] if f.end is None else middles[f.end], f.energy) for f in out]
        # where most of what leaves it goes
        middles[name] = sum(y * e for y, e in ends) / weight if weight > 0.0 else 0.5
    _make_room(heights, middles, line)
    if len(sources) == 1:
        outer[sources[0]] = middles[sources[0].end or ""]
    for flow in sources:
        if flow.feeds_pump and flow.label == PUMP and not account.rails:
            middles[PUMP] = outer[flow]
    docks = {n: _Dock(*nodes[n], middles[n], heights[n]) for n in nodes if n in heights}
    return _Layout(flows, docks, outer, scale, line, tall)


def _make_room(sizes: Mapping[str, float], middles: dict[str, float], line: float) -> None:
    """Move cylinders apart: their names need room above."""
    column = sorted((n for n in sizes if n not in (PUMP, MECHANISM)), key=lambda n: -middles[n])
    reach = 1.0
    for name in column:
        middles[name] = min(middles[name], reach - 0.5 * sizes[name] - line)
        reach = middles[name] - 0.5 * sizes[name]
    for name in column:
        middles[name] -= min(reach, 0.0)


def is_known(ledger: Ledger) -> bool:
    """Whether more energy went through a trial than any row of its ledger may be off: of others a
    picture would show noise."""
    account = _Account.of(ledger)
    whole = max(account.given, sum(map(abs, account.works.values())))
    return whole > max(half_of(row) or 0.0 for row in account.rows)


def sankey(path: Path, ledger: Ledger) -> None:
    """Where the energy of one trial went: ribbons from the pump through the oil of each cylinder
    and the mechanism, to scale.

    What is given back (a load that sinks, oil that expands) enters from the left. Rows under 1.2 %
    are drawn together. Shares are of what the supply gave; where the load drives the oil, of all
    that enters."""
    account = _Account.of(ledger)
    layout, unit, given = _layout(account), unit_for([ledger]), account.given
    if account.uphill:
        given = sum(flow.energy for flow in layout.flows if flow.start is None)
    with canvas(path, size=(7.4, layout.tall)) as (figure, ax):
        ax.set_xlim(-0.36, 1.98)
        ax.set_ylim(-0.04, 1.03)
        ax.axis("off")
        heights: dict[_Flow | str, float] = {
            **layout.outer,
            **{name: dock.middle for name, dock in layout.docks.items()},
        }
        for flow in sorted(
            layout.flows,
            key=lambda f: (-heights[f.start or f], -heights[f.end or f]),
        ):
            if flow.start is None:
                _draw_source(ax, layout, flow, unit, account)
            colour, thick = GROUPS[flow.group][0], flow.energy * layout.scale
            if account.rails or not flow.feeds_pump:
                y = layout.outer.get(flow, 0.0)
                start, end = (_BAR, y), (1.0, y)
                if flow.start is not None:
                    dock = layout.docks[flow.start]
                    start = (dock.x + _BAR, dock.dock("right", thick))
                if flow.end is not None:
                    dock = layout.docks[flow.end]
                    end = (dock.x, dock.dock("left", thick))
                s = np.linspace(0.0, 1.0, 60)
                x = start[0] + s * (end[0] - start[0])
                y = start[1] + (3 * s**2 - 2 * s**3) * (end[1] - start[1])
                half = 0.5 * max(thick, 0.0012)
                look = {"facecolor": colour, "alpha": 0.42, "edgecolor": "none", "zorder": 2}
                ax.fill(np.append(x, x[::-1]), np.append(y + half, (y - half)[::-1]), **look)
            if flow.end is None:
                y, words = layout.outer[flow], energy_text(flow.energy, flow.half, unit, given)
                _draw_bar(ax, 1.0, y, thick, colour)
                ax.text(1.0 + 2.0 * _BAR, y, flow.label, va="center", fontsize=8)
                ax.text(1.98, y, words, va="center", ha="right", fontsize=8)
        box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6}
        look = {"va": "bottom", "ha": "center", "fontsize": 8.5, "weight": "bold", "zorder": 5}
        for name, dock in layout.docks.items():
            if account.rails or name != PUMP:
                _draw_bar(ax, dock.x, dock.middle, dock.size, dock.colour)
                top = dock.middle + 0.5 * dock.size + 0.008
                ax.text(dock.x + 0.5 * _BAR, top, dock.label, bbox=box, **look)
        rest = next(row for row in ledger["rows"] if row["group"] == "residual")
        amount = energy_text(rest["energy"], half_of(rest), unit, given)
        ax.text(-0.36, -0.03, f"{rest['label']} in all: {amount}", fontsize=8, color=MUTED)
        present = {flow.group for flow in layout.flows}
        looks = [look for group, look in GROUPS.items() if group in present]
        legend(figure, [swatch(name, colour, alpha=0.75) for colour, name in looks])


def _draw_source(ax, layout: _Layout, flow: _Flow, unit: Unit, account: _Account) -> None:
    """Bar and label at the left; of the pump and a low rail in bold, compression apart."""
    y, thick = layout.outer[flow], flow.energy * layout.scale
    energy, style = flow.energy, {"fontsize": 8}
    if flow.has_compression:
        gained = account.named[SOURCES[flow.label][1]]["energy"]
        energy, style = flow.energy - gained, {"fontsize": 8.5, "weight": "bold"}
        below = f"+ {energy_text(gained, None, unit)} compression"
        look = {"va": "center", "ha": "right", "fontsize": 7, "color": MUTED}
        ax.text(-0.025, y - 1.35 * layout.line, below, **look)
        thick = thick if account.rails else max(thick, layout.docks[PUMP].size)
    words = f"{flow.label}\n{energy_text(energy, flow.half, unit)}"
    ax.text(-0.025, y, words, va="center", ha="right", linespacing=1.2, **style)
    _draw_bar(ax, 0.0, y, thick, GROUPS[flow.group][0])


def _draw_bar(ax, x: float, y: float, thick: float, colour: str) -> None:
    from matplotlib.patches import Rectangle

    look = {"facecolor": colour, "edgecolor": "none", "zorder": 3}
    ax.add_patch(Rectangle((x, y - 0.5 * thick), _BAR, thick, **look))
