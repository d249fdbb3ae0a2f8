"""How the energies of several trials compare, as stacked bars."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ehbench.report.style import ACCENT, INK, MUTED, canvas, key, legend, swatch
from ehbench.report.words import DASH, fixed, number, places_of
from ehbench.vocabulary import message

SEEN = 2e-3  # share of the longest bar below which nobody sees a part
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
_LIMITS: dict[str, tuple[str, Any]] = {
    "standard": ("four-way valve", "-"),
    "six": ("six functions", "--"),
    "seventh": ("with the seventh", ":"),
}


Ledger = Mapping[str, Any]
Unit = tuple[float, str]  # (J per unit, unit)


def unit_for(ledgers: Sequence[Ledger]) -> Unit:
    """The unit in which the largest energy is a number of few digits."""
    maximum = max((abs(row["energy"]) for ledger in ledgers for row in ledger["rows"]), default=0.0)
    return (1e6, "MJ") if maximum >= 1e8 else (1e3, "kJ") if maximum >= 1e5 else (1.0, "J")


def half_of(row: Mapping[str, Any]) -> float | None:
    """Half the 95 % interval of a row [J]; None where it has none."""
    interval = row.get("interval")
    return None if interval is None or None in interval else 0.5 * (interval[1] - interval[0])


def energy_text(energy: float, half: float | None, unit: Unit, whole: float = 0.0) -> str:
    """``424 ± 21 J · 7.7 %``, the share where ``whole`` [J] is given."""
    value = energy / unit[0]
    if half is not None and half > 0.0 and math.isfinite(half):
        places = max(places_of(half / unit[0]), -2)
        text = f"{fixed(value, places)} ± {fixed(half / unit[0], places)}"
    else:
        text = number(value, 3)
    counts = whole > 0.0 and abs(energy) > 1e-5 * whole
    share = f" · {number(100 * energy / whole, 2)} %" if counts else ""
    return f"{text} {unit[1]}{share}"


def part_of(row: Mapping[str, Any]) -> str | None:
    """The stack to which a row belongs; None for rows that are not summed."""
    group, word = row["group"], row["name"].rsplit(".", 1)[-1]
    if group == "valve":
        ends = row["label"].rsplit(", ", 1)[-1].split(" → ")
        return "in" if "supply" in ends else "out" if "tank" in ends else "cross"
    if group == "loss":
        rubs = ("friction", "damping", "end_stop", "mount", "sway")
        return "mechanical" if word in rubs else "oil"
    if word in ("stop", "mount_spring"):
        return "mechanical"
    return {"load": "load", "store": "store", "residual": "rest"}.get(group)


def bars(
    path: Path, ledgers: Sequence[tuple[str, Ledger]], bounds: Sequence[Sequence[Mapping[str, Any]]]
) -> None:
    """A stacked bar a trial, by its title and ledger: what its energy went into; what was given
    back lies left of zero. The bounds of its cylinders (``Bounds.as_json``) are marks on the bar.
    """
    unit = unit_for([ledger for _, ledger in ledgers])
    stacks = []
    for _, ledger in ledgers:
        stacks.append(dict.fromkeys(_PARTS, 0.0))
        for row in ledger["rows"]:
            if (part := part_of(row)) is not None:
                stacks[-1][part] += row["energy"] / unit[0]
    maximum = max(sum(max(v, 0.0) for v in parts.values()) for parts in stacks)
    minimum = min(sum(min(v, 0.0) for v in parts.values()) for parts in stacks)
    limits: list[dict[str, float]] = [{} for _ in ledgers]
    for sums, items in zip(limits, bounds, strict=True):
        for kind in _LIMITS:  # one that a cylinder has not is left out
            values = [value for item in items if (value := item.get(kind)) is not None]
            if values and len(values) == len(items):
                sums[kind] = float(sum(values)) / unit[0]
    reach = max([maximum, *(value for limit in limits for value in limit.values())])
    drawn = [name for name in _PARTS if any(abs(parts[name]) > SEEN * maximum for parts in stacks)]
    with canvas(path, size=(7.4, 0.72 * len(ledgers) + 1.7)) as (figure, ax):
        for i, (_, ledger) in enumerate(ledgers):
            parts = {name: stacks[i][name] for name in drawn}
            end = _draw_stack(ax, i, parts, 0.065 * (reach - minimum))
            _draw_total(ax, i, ledger, unit, end, abs(end) < 0.01 * maximum)
            for kind, value in limits[i].items():
                look = {"color": INK, "linestyle": _LIMITS[kind][1], "linewidth": 1.6, "zorder": 5}
                for side in (-1, 1):  # above and below the bar, whose numbers stay free
                    ax.plot([value] * 2, [i + side * 0.28, i + side * 0.46], **look)
        ax.axvline(0.0, color=MUTED, linewidth=0.8)
        ax.set_yticks(range(len(ledgers)), [title for title, _ in ledgers])
        ax.set(ylim=(len(ledgers) - 0.45, -0.55), xlim=(1.05 * minimum, 1.4 * reach))
        ax.grid(False, axis="y")
        ax.set_xlabel(message("report.bar", unit=unit[1]))
        handles: list = [swatch(*_PARTS[name]) for name in drawn]
        handles += [
            key(f"bound: {name}", color=INK, linestyle=style)
            for kind, (name, style) in _LIMITS.items()
            if any(kind in limit for limit in limits)
        ]
        legend(figure, handles, 3)


def _draw_stack(ax, place: int, parts: Mapping[str, float], room: float) -> float:
    """Draw the parts of a bar, numbered where longer than ``room``; gives the bar's end."""
    right, left = 0.0, 0.0
    for kind, value in parts.items():
        start = right if value >= 0.0 else left
        colour = _PARTS[kind][1]
        edge = {"edgecolor": "white", "linewidth": 0.6, "zorder": 2}
        ax.barh(place, value, left=start, height=0.56, color=colour, **edge)
        if abs(value) > room:
            look = {"ha": "center", "va": "center", "fontsize": 7.5, "color": "white", "zorder": 6}
            box = {"facecolor": colour, "edgecolor": "none", "pad": 1.0}
            ax.text(start + 0.5 * value, place, number(value, 3), bbox=box, **look)
        right, left = right + max(value, 0.0), left + min(value, 0.0)
    return right


def _draw_total(ax, place: int, ledger: Ledger, unit: Unit, end: float, empty: bool) -> None:
    """What the pump gave, with its interval, and compression, right of the bar."""
    given = [row for row in ledger["rows"] if row["name"] in ("pump", "low_rail")]
    halves = [half for row in given if (half := half_of(row)) is not None]
    half = math.hypot(*halves) if halves else None
    drawn = sum(row["energy"] for row in given)
    total = sum(row["energy"] for row in ledger["rows"] if row["group"] == "supply")
    if half:
        look = {"color": INK, "capsize": 3, "linewidth": 1.0, "zorder": 5}
        ax.errorbar(total / unit[0], place, xerr=half / unit[0], **look)
    right = max(end, (total + (half or 0.0)) / unit[0])
    words = energy_text(drawn, half, unit) if drawn else DASH
    look = {"textcoords": "offset points", "va": "center", "zorder": 6}
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
    label = ax.annotate(words, (right, place), (6, 0), fontsize=8, weight="bold", bbox=box, **look)
    look |= {"xycoords": label, "fontsize": 7.5}
    if empty:
        ax.annotate(message("report.bar_empty"), (1.0, 0.5), (5, 0), **look)
        return
    rest = total - drawn
    texts = [f"low rail {energy_text(row['energy'], None, unit)}" for row in given[1:]]
    if abs(rest) > SEEN * abs(total):
        sign = "+" if rest > 0.0 else "−"
        texts.append(f"{sign} {number(abs(rest) / unit[0], 2)} {unit[1]} compression")
    if text := "\n".join(texts):
        ax.annotate(text, (1.0, 0.5), (5, 0), bbox=box, **look)
