"""Tables and sentences on energy: what controllers saved, against which bound, what ate the rest,
and where all of it went.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Bullets, Cell, Grid, Text
from ehbench.report.captions import capital, load_name, percent, span
from ehbench.report.cases import Case
from ehbench.report.content import num
from ehbench.report.figures.energy import half_of, part_of
from ehbench.report.figures.energy_bars import SEEN
from ehbench.report.saved import Table
from ehbench.report.trial_tables import WHO, who
from ehbench.report.words import (
    DASH,
    axis,
    count,
    number,
    pretty,
    shown,
    unit_of,
    with_error,
    words,
)

_BOUNDS = {
    "standard": "a four-way valve",
    "six": "six functions",
    "seventh": "the seventh function",
}
NOTHING = 1e-4  # share of what was drawn that a table shows as nought
SAME_WAY = 0.02  # share by which the ways out and in may differ where a motion came back
TELLING = 0.01  # share of what was drawn from which a cause is named
_JOINS = {"supply → head", "head → tank", "supply → rod", "rod → tank"}
_KINDS = {
    "mechanical": "friction, damping, end stops",
    "oil": "expansion, leakage, relief, return line",
    "load": "load",
    "store": "stored in oil",
    "rest": "not accounted for",
}
_VOLUME = (
    "The supply keeps its pressure and is paid for the volume drawn. "
    "Load, friction and the low pressure of the off-side chamber decide where that energy is lost, "
    "not how much is drawn; that grows where oil is compressed, "
    "and where a function draws what its bound does without."
)
_UNEXPLAINED = (
    " Unexplained: what measured channels and the identified model do not account for, "
    "with its 95 % interval."
)


@dataclass(frozen=True)
class Saving:
    """A closed cycle of one trial against its bound, and against the four-way valve that drew least
    on the same motion, if one ran: ``reference`` [J].
    """

    case: Case
    ledger: Table
    limits: Table
    reference: float | None

    @property
    def used(self) -> float:
        """Drawn from the supply [J]."""
        return self.limits["used"]

    @property
    def bound(self) -> float:
        """The least that its working functions can do with [J]."""
        return self.limits[self.limits.get("against") or "standard"]

    @property
    def half(self) -> float | None:
        """Half the 95 % interval of what was drawn [J]."""
        return next(
            half_of(row)
            for row in self.ledger["rows"]
            if row["name"] == f"{self.case.cylinder}.drawn"
        )

    @property
    def given(self) -> float:
        """What the supply gave in all [J]."""
        return math.fsum(row["energy"] for row in self.ledger["rows"] if row["group"] == "supply")

    @cached_property
    def causes(self) -> dict[str, float]:
        """What was drawn beyond the bound [J], by cause; they add up to ``used − bound``."""
        by_cause = {"compression": 0.0}
        for item in self.limits.get("beyond", []):
            more = item["drawn"] - item["bound"]
            pressed = min(max(item["compression"], 0.0), max(more, 0.0))
            by_cause["compression"] += pressed
            by_cause[item["function"]] = more - pressed
        return by_cause


def valves_of(ledger: Table, cylinder: str) -> list[tuple[str, str, float]]:
    """(valve, what it joins, throttling loss [J]) of every edge of a cylinder."""
    own = [row for row in ledger["rows"] if row["group"] == "valve" and row["cylinder"] == cylinder]
    return [(*row["label"].rsplit(", ", 1), row["energy"]) for row in own]


def four_way(ledger: Table, cylinder: str) -> bool:
    """Whether one command meters all four ways of a cylinder."""
    edges = valves_of(ledger, cylinder)
    return len({valve for valve, *_ in edges}) == 1 and {joins for _, joins, _ in edges} == _JOINS


def savings_of(cases: Sequence[Case]) -> list[Saving]:
    """The closed cycles among some trials, with their bounds."""
    known = []
    for case in cases:
        ledger = None if case.row.get("stopped") else case.energy()
        for limits in ledger.get("bounds", []) if ledger is not None else []:
            if limits["closed"] and limits.get("used") is not None:
                known.append((case, ledger, limits))
    valves: dict[tuple[str, str], float] = {}
    for case, ledger, limits in known:
        if four_way(ledger, case.cylinder):
            key = (case.row["payload"], case.row["motion"])
            valves[key] = min(limits["used"], valves.get(key, math.inf))
    return [
        Saving(case, ledger, limits, valves.get((case.row["payload"], case.row["motion"])))
        for case, ledger, limits in known
    ]


def saved_caption(rig: Rig, savings: Sequence[Saving], controller: str) -> str:
    """What one controller saved over all its cycles, what its bound is, and what ate the
    difference.
    """
    drawn = _energies(rig, [saving.used for saving in savings], 4)
    above = _energies(rig, [saving.used - saving.bound for saving in savings])
    text = f"{capital(words(controller))}: {_saved_share(savings)}{_bound_caption(savings)}. "
    text += f"Drawn {drawn}, {above} above its bound"
    halves = [saving.half for saving in savings if saving.half]
    text += f" (± {_energies(rig, halves, 2)})" if halves else ""
    return text + f"; {_eaters(rig, savings)}."


def passes_caption(rig: Rig, savings: Sequence[Saving]) -> str:
    """Why some cycle saves more than its bound says, in numbers of the four-way valve that it is
    compared with; empty where none does.
    """
    better = [
        saving
        for saving in savings
        if saving.reference is not None
        and saving.bound < saving.limits["standard"]
        and saving.used / saving.reference < saving.bound / saving.limits["standard"]
    ]
    against = {(item.case.row["payload"], item.case.row["motion"]) for item in better}
    spools = [
        saving
        for saving in savings
        if saving.used == saving.reference
        and four_way(saving.ledger, saving.case.cylinder)
        and (saving.case.row["payload"], saving.case.row["motion"]) in against
    ]
    if not spools:
        return ""
    bounds = span([100.0 * (1.0 - item.bound / item.limits["standard"]) for item in better])
    above = _energies(rig, [spool.used - spool.bound for spool in spools])
    pressed = _energies(rig, [spool.causes["compression"] for spool in spools])
    return (
        f"Some save more than the bound's {bounds} %: the four-way valve is above its own bound as "
        f"well, by {above} a cycle. It draws {pressed} to press the oil in its chambers together; "
        "part of that it draws less where the oil expands again, the rest goes to tank."
    )


def open_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """That no saving is told of ways that end with the oil in another state; empty where none
    does.
    """
    retained = []
    for case in cases:
        ledger = None if case.row.get("stopped") else case.energy()
        for bound in ledger.get("bounds", []) if ledger is not None else []:
            if bound["closed"] or bound.get("kept") is None:
                continue
            ways = (bound["travel_out"], bound["travel_in"])
            if abs(ways[0] - ways[1]) <= SAME_WAY * max(ways):
                retained.append(bound["kept"])
    if not retained:
        return ""
    return (
        f"No saving is told of {count(len(retained), 'trial')} that came back with the oil in "
        f"another state, {_energies(rig, retained)} more pressed into it than at the beginning: "
        "let the motion make 2 cycles."
    )


def _energies(rig: Rig, values: Sequence[float], digits: int = 3) -> str:
    """The span of some energies [J], with unit."""
    shown_values = [float(shown(rig, "energy", value)) for value in values]
    return f"{span(shown_values, digits)} {pretty(unit_of(rig, 'energy'))}"


def _saved_share(savings: Sequence[Saving]) -> str:
    """How much less than a four-way valve: the one that ran, or the least that any must draw."""
    against = [
        1.0 - saving.used / saving.reference
        for saving in savings
        if saving.reference is not None and not four_way(saving.ledger, saving.case.cylinder)
    ]
    if against:
        return f"{_less(against)} than the four-way valve"
    return (
        f"{_less([saving.limits['saving'] for saving in savings])} than a four-way valve must draw"
    )


def _bound_caption(savings: Sequence[Saving]) -> str:
    """The bound of its functions, where it is another than the four-way valve's."""
    if all(saving.limits.get("against", "standard") == "standard" for saving in savings):
        return ""
    limits = " or ".join(
        dict.fromkeys(_BOUNDS[saving.limits.get("against") or "standard"] for saving in savings)
    )
    bound = span([100.0 * (1.0 - saving.bound / saving.limits["standard"]) for saving in savings])
    return f"; the bound of {limits} is {bound} % less"


def _eaters(rig: Rig, savings: Sequence[Saving]) -> str:
    """What ate the difference to the bound, the largest causes first, each at its worst."""
    worst = {
        name: max(savings, key=lambda entry, n=name: saving.causes.get(n, 0.0))
        for saving in savings
        for name in saving.causes
    }
    eaten = [(item.causes.get(name, 0.0), name, item) for name, item in worst.items()]
    eaten = sorted((e for e in eaten if e[0] > TELLING * e[2].used), key=lambda e: -e[0])
    if not eaten:
        return f"no single cause takes more than {percent(TELLING, 1)} of what was drawn"
    return "the difference is " + ", ".join(
        f"{_cause(name)} (up to {_energies(rig, [maximum])}, {_where(item.case)})"
        for maximum, name, item in eaten[:3]
    )


def _less(shares: Sequence[float]) -> str:
    """``34.1 to 36.9 % less``; ``more`` where all are negative."""
    more = max(shares) < 0.0
    size = span([100.0 * (-share if more else share) for share in shares])
    return f"{size} % {'more' if more else 'less'}"


def _cause(name: str) -> str:
    return {"compression": "oil compressed", "hold": "drawn while holding"}.get(
        name, f"drawn in {words(name)}"
    )


def _where(case: Case) -> str:
    return f"{load_name(case.row['payload'])}, {words(case.row['motion'])}".rstrip(", ")


def went_caption(savings: Sequence[Saving], controller: str) -> str:
    """Where one controller's energy was lost, the largest shares first."""
    tables = [went(saving.ledger, saving.case.cylinder) for saving in savings]
    given = [saving.given for saving in savings]
    shares = {
        name: [
            100.0 * table.get(name, 0.0) / whole for table, whole in zip(tables, given, strict=True)
        ]
        for table in tables
        for name in table
    }
    lost = sorted(
        (name for name in shares if name not in ("rest", "load", "store")),
        key=lambda name: -max(shares[name]),
    )
    parts = [
        f"{_KINDS.get(name, f'throttling {name}')} {span(shares[name], 2)} %" for name in lost[:4]
    ]
    low = [
        100.0 * low_side(saving.ledger, saving.case.cylinder) / whole
        for saving, whole in zip(savings, given, strict=True)
    ]
    if max(low) > 0.0:
        parts.append(f"pressure left in the off-side chamber of resistive motion {span(low, 2)} %")
    return f"{capital(words(controller))}: {', '.join(parts)}."


def went(ledger: Table, cylinder: str) -> dict[str, float]:
    """Energies [J] by what they went into: throttling by what an edge joins, then the kinds of the
    bar chart.
    """
    sums: dict[str, float] = {}
    for _, joins, energy in valves_of(ledger, cylinder):
        sums[joins] = sums.get(joins, 0.0) + energy
    for row in ledger["rows"]:
        kind = part_of(row)
        if kind is not None and not (row["group"] == "valve" and row["cylinder"] == cylinder):
            kind = kind if kind in _KINDS else "throttling of others"
            sums[kind] = sums.get(kind, 0.0) + row["energy"]
    return sums


def spent_in(
    ledger: Table, cylinder: str, function: str, groups: Sequence[str], joins: str = ""
) -> float:
    """What rows of some groups took while a working function was at work [J], of those only that
    join two nodes if named.
    """
    taken = ledger.get("functions", {}).get(cylinder, {}).get(function, {})
    rows = [
        row
        for row in ledger["rows"]
        if row["group"] in groups
        and row["label"].endswith(joins)
        and row["cylinder"] in (None, cylinder)
    ]
    return math.fsum(taken.get(row["name"], 0.0) for row in rows)


def low_side(ledger: Table, cylinder: str) -> float:
    """What the pressure kept on the off-side chamber took where the load resists: throttling on the
    way out to tank [J].
    """
    ways = (("extend_resistive", "rod → tank"), ("retract_resistive", "head → tank"))
    return math.fsum(
        spent_in(ledger, cylinder, function, ("valve",), joins) for function, joins in ways
    )


def saving_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Sentences and tables on the closed cycles of a set of trials; nothing where there are
    none.
    """
    savings, caption = savings_of(cases), open_caption(rig, cases)
    left_out: list[Block] = [Text(caption, "note")] if caption else []
    if not savings:
        return left_out
    names = list(dict.fromkeys(saving.case.row["controller"] for saving in savings))
    by_name = {
        name: [saving for saving in savings if saving.case.row["controller"] == name]
        for name in names
    }
    return [
        Text("What was saved, and what ate the rest:"),
        Bullets([saved_caption(rig, item, name) for name, item in by_name.items()]),
        *([Text(passes)] if (passes := passes_caption(rig, savings)) else []),
        Text(_VOLUME + _of_cycle(cases), "note"),
        *left_out,
        _saved_table(rig, savings),
        Text("Where it was lost, as shares of what the supply gave:"),
        Bullets([went_caption(item, name) for name, item in by_name.items()]),
        _went_table(rig, savings),
    ]


def _of_cycle(cases: Sequence[Case]) -> str:
    """Which part of the trials the energies are of, and of which run."""
    text = ""
    if any(case.row.get("cycle") for case in cases):
        text += " Energies are of the last cycle, which begins and ends with the oil in one state."
    if any(case.row.get("seeds") for case in cases):
        text += " Of several runs they are those of the run with the median error."
    return text


def _energy(rig: Rig, value: float | None, whole: float, half: float | None = None) -> Cell:
    """An energy; a nought where it is nothing beside ``whole``."""
    value = 0.0 if value is not None and abs(value) < NOTHING * whole else value
    shown_ones = [None if v is None else float(shown(rig, "energy", v)) for v in (value, half)]
    return num(with_error(*shown_ones).replace(" ", "\u00a0") if half else number(shown_ones[0], 3))


def _saved_table(rig: Rig, savings: Sequence[Saving]) -> Grid:
    compared = any(saving.reference is not None for saving in savings)
    unit = pretty(unit_of(rig, "energy"))
    head = [
        *WHO,
        axis(rig, "energy", "drawn"),
        "less than the four-way valve [%]"
        if compared
        else "less than a four-way valve must draw [%]",
        "bound of its functions [%]",
        f"that bound [{unit}]",
        f"above it [{unit}]",
        *(
            f"{text} [{unit}]"
            for text in ("of it by compression", "moving out", "moving in", "holding")
        ),
    ]
    note = (
        "Bounds for the way that was really made; for a cycle with the load on the head end "
        "a four-way valve Ps (A1 + A2) Δx, six functions Ps A1 Δx, the seventh Ps (A1 − A2) Δx."
    )
    rows = [_saved_row(rig, saving, compared) for saving in savings]
    return Grid(head, rows, note, "saving", "Energy saved.")


def _saved_row(rig: Rig, item: Saving, compared: bool) -> list[Cell | str]:
    if not compared:
        saving = item.limits["saving"]
    else:
        saving = None if item.reference is None else 1.0 - item.used / item.reference
    above = (item.used - item.bound, *_by_motion(item).values())
    return [
        *who(item.case),
        _energy(rig, item.used, 0.0, item.half),
        num(DASH if saving is None else number(100.0 * saving, 3)),
        num(number(100.0 * (1.0 - item.bound / item.limits["standard"]), 3)),
        _energy(rig, item.bound, 0.0),
        *(_energy(rig, energy, item.used) for energy in above),
    ]


def _by_motion(entry: Saving) -> dict[str, float]:
    """What was drawn beyond the bound [J]: compressed, moving out, moving in, holding."""
    ways = {item["function"]: item["way"] for item in entry.limits.get("beyond", [])}
    sums = {"compression": 0.0, "out": 0.0, "in": 0.0, "hold": 0.0}
    for name, energy in entry.causes.items():
        sums[name if name in sums else "out" if ways[name] > 0.0 else "in"] += energy
    return sums


def _went_table(rig: Rig, savings: Sequence[Saving]) -> Grid:
    names = _went_names(savings)
    logged = any(saving.ledger["source"] == "log" for saving in savings)
    rest = "unexplained" if logged else _KINDS["rest"]
    head = [
        *WHO,
        *(rest if name == "rest" else _KINDS.get(name, name) for name in names),
        "of all this pressure of the off-side",
        "of all this holding",
    ]
    note = (
        f"Energies in {pretty(unit_of(rig, 'energy'))}; negative: given back. "
        "Arrows: throttling on the edges that join the two. "
        "Pressure of the off-side: throttled at the outlet where the load resists."
        + (_UNEXPLAINED if logged else "")
    )
    rows = [_went_row(rig, saving, names) for saving in savings]
    return Grid(head, rows, note, "losses", "Where the energy went.")


def _went_names(savings: Sequence[Saving]) -> list[str]:
    """What any trial's energy went into, as far as one can see it: throttling first."""
    tables = [went(saving.ledger, saving.case.cylinder) for saving in savings]
    logged = any(saving.ledger["source"] == "log" for saving in savings)
    names = [
        name
        for name in dict.fromkeys(name for table in tables for name in table)
        if name == "rest"
        and logged
        or any(
            abs(table.get(name, 0.0)) > SEEN * saving.used
            for table, saving in zip(tables, savings, strict=True)
        )
    ]
    return sorted(names, key=lambda name: list(_KINDS).index(name) if name in _KINDS else -1)


def _went_row(rig: Rig, item: Saving, names: Sequence[str]) -> list[Cell | str]:
    cylinder, ledger = item.case.cylinder, item.ledger
    table = went(ledger, cylinder)
    half = half_of(next(row for row in ledger["rows"] if row["group"] == "residual"))
    cells = [
        _energy(rig, table.get(name), 0.0 if half else item.used, half)
        if name == "rest"
        else _energy(rig, table.get(name), item.used)
        for name in names
    ]
    also = (low_side(ledger, cylinder), spent_in(ledger, cylinder, "hold", ("valve", "loss")))
    return [*who(item.case), *cells, *(_energy(rig, value, item.used) for value in also)]
