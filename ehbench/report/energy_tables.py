"""Energy of trials: what was saved, against which bound, what ate the rest, other supplies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Bullets, Cell, Text
from ehbench.report.cases import Case, by_controller
from ehbench.report.content import num
from ehbench.report.figures.energy import SEEN, half_of, part_of
from ehbench.report.saved import Table
from ehbench.report.template import Template
from ehbench.report.words import load_name, number, shown, with_error, words
from ehbench.vocabulary import grouped

_BOUNDS = {
    "standard": "a four-way valve",
    "six": "six functions",
    "seventh": "the seventh function",
}
_JOINS = {"supply → head", "head → tank", "supply → rod", "rod → tank"}
_KINDS = {
    "mechanical": "friction, damping, end stops",
    "oil": "expansion, leakage, relief, return line",
    "load": "load",
    "store": "stored in oil",
    "rest": "not accounted for",
}
_CONSTANT = "constant pressure"


@dataclass(frozen=True)
class Saving:
    """A closed cycle against its bound, energies in J: ``used``, drawn from the supply, ± ``half``
    (95 %), of what that gave in all; the minimum of its working functions, ``bound``, in the
    circuit ``against``; half the interval of what is not accounted for; what the thriftiest
    four-way valve drew, ``reference``."""

    case: Case
    ledger: Table
    limits: Table
    against: str
    used: float
    bound: float
    half: float | None
    rest_half: float | None
    given: float
    is_spool: bool
    reference: float | None = None

    @classmethod
    def of(cls, case: Case, ledger: Table, limits: Table) -> Self:
        """That of a trial by its ledger and one of the bounds there."""
        rows, against = ledger["rows"], limits.get("against") or "standard"
        drawn = next(row for row in rows if row["name"] == f"{case.cylinder}.drawn")
        halves = half_of(drawn), half_of(next(r for r in rows if r["group"] == "residual"))
        given = math.fsum(row["energy"] for row in rows if row["group"] == "supply")
        about = against, limits["used"], limits[against], *halves, given
        return cls(case, ledger, limits, *about, four_way(ledger, case.cylinder))

    @property
    def saved(self) -> float | None:
        """Share by which it drew less than the four-way valve."""
        return None if self.reference is None else 1.0 - self.used / self.reference

    @property
    def name(self) -> str:
        """Payload and motion in words."""
        payload, motion = load_name(self.motion[0]), words(self.motion[1])
        return f"{payload}, {motion}".rstrip(", ")

    @property
    def motion(self) -> tuple[str, str]:
        """Payload and motion."""
        return self.case.row["payload"], self.case.row["motion"]

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

    @property
    def by_motion(self) -> dict[str, float]:
        """The same [J]: compressed, moving out, moving in, holding."""
        ways = {item["function"]: item["way"] for item in self.limits.get("beyond", [])}
        sums = {"compression": 0.0, "out": 0.0, "in": 0.0, "hold": 0.0}
        for name, energy in self.causes.items():
            sums[name if name in sums else "out" if ways[name] > 0.0 else "in"] += energy
        return sums


def valves_of(ledger: Table, cylinder: str) -> list[tuple[str, str, float]]:
    """(valve, what it joins, throttling loss [J]) of every edge of a cylinder."""
    rows = (r for r in ledger["rows"] if r["group"] == "valve" and r["cylinder"] == cylinder)
    return [(*row["label"].rsplit(", ", 1), row["energy"]) for row in rows]


def four_way(ledger: Table, cylinder: str) -> bool:
    """Whether one command meters all four ways of a cylinder."""
    edges = valves_of(ledger, cylinder)
    return len({valve for valve, *_ in edges}) == 1 and {joins for _, joins, _ in edges} == _JOINS


def savings_of(cases: Sequence[Case]) -> list[Saving]:
    """The closed cycles among some trials, with their bounds."""
    savings = [
        Saving.of(case, ledger, limits)
        for case in cases
        if not case.row.get("stopped") and (ledger := case.energy()) is not None
        for limits in ledger.get("bounds", [])
        if limits["closed"] and limits.get("used") is not None
    ]
    valves: dict[tuple[str, str], float] = {}
    for item in savings:
        if item.is_spool:
            valves[item.motion] = min(item.used, valves.get(item.motion, math.inf))
    return [replace(saving, reference=valves.get(saving.motion)) for saving in savings]


def saved_caption(rig: Rig, savings: Sequence[Saving], controller: str) -> str:
    """What one controller saved over all its cycles, what its bound is, and what ate the
    difference: the three largest causes at their worst."""
    telling = 0.01  # share of what was drawn
    against = [s.saved for s in savings if s.saved is not None and not s.is_spool]
    names = dict.fromkeys(name for saving in savings for name in saving.causes)
    worst = [(name, max(savings, key=lambda s, n=name: s.causes.get(n, 0.0))) for name in names]
    eaten = [(item.causes.get(name, 0.0), name, item) for name, item in worst]
    eaten = sorted((e for e in eaten if e[0] > telling * e[2].used), key=lambda e: -e[0])
    bounded = any(saving.against != "standard" for saving in savings)
    return Template("energy", rig).text(
        "saved",
        name=controller,
        compared=bool(against),
        shares=against or [saving.limits["saving"] for saving in savings],
        limits=[_BOUNDS[a] for a in dict.fromkeys(s.against for s in savings)] if bounded else [],
        bounds=[1.0 - saving.bound / saving.limits["standard"] for saving in savings],
        drawn=[saving.used for saving in savings],
        above=[saving.used - saving.bound for saving in savings],
        halves=[saving.half for saving in savings if saving.half],
        causes=[(energy, name, item.name) for energy, name, item in eaten[:3]],
        telling=telling,
    )


def passes_caption(rig: Rig, savings: Sequence[Saving]) -> str:
    """Why a cycle saves more than its bound says, by the four-way valve; else empty."""
    better = [
        saving
        for saving in savings
        if saving.saved is not None
        and saving.bound < saving.limits["standard"]
        and saving.saved > 1.0 - saving.bound / saving.limits["standard"]
    ]
    against = {item.motion for item in better}
    spools = [s for s in savings if s.used == s.reference and s.is_spool and s.motion in against]
    if not spools:
        return ""
    return Template("energy", rig).text(
        "passes",
        bounds=[1.0 - item.bound / item.limits["standard"] for item in better],
        above=[spool.used - spool.bound for spool in spools],
        pressed=[spool.causes["compression"] for spool in spools],
    )


def open_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """That no saving is stated for motions that came back, ways out and in alike to 2 %, with the
    oil in another state; empty where none does."""
    retained = []
    for case in cases:
        ledger = None if case.row.get("stopped") else case.energy()
        for bound in ledger.get("bounds", []) if ledger is not None else []:
            if bound["closed"] or bound.get("retained") is None:
                continue
            ways = (bound["travel_out"], bound["travel_in"])
            if abs(ways[0] - ways[1]) <= 0.02 * max(ways):
                retained.append(bound["retained"])
    return Template("energy", rig).text("open", retained=retained) if retained else ""


def lost_caption(savings: Sequence[Saving], controller: str) -> str:
    """Where one controller's energy was lost, the largest shares first."""
    tables = [went(saving) for saving in savings]
    given = [saving.given for saving in savings]
    shares = {
        name: [100.0 * t.get(name, 0.0) / whole for t, whole in zip(tables, given, strict=True)]
        for table in tables
        for name in table
    }
    lost = [name for name in shares if name not in ("rest", "load", "store")]
    lost.sort(key=lambda name: -max(shares[name]))
    return Template("energy").text(
        "lost",
        name=controller,
        kinds=[(_KINDS.get(name, f"throttling {name}"), shares[name]) for name in lost[:4]],
        low=[100.0 * low_side(s) / whole for s, whole in zip(savings, given, strict=True)],
    )


def went(item: Saving) -> dict[str, float]:
    """Energies [J] by what an edge that throttles joins, then by the kinds of the bar chart."""
    sums: dict[str, float] = {}
    for _, joins, energy in valves_of(item.ledger, item.case.cylinder):
        sums[joins] = sums.get(joins, 0.0) + energy
    for row in item.ledger["rows"]:
        kind = part_of(row)
        if kind and not (row["group"] == "valve" and row["cylinder"] == item.case.cylinder):
            kind = kind if kind in _KINDS else "throttling of others"
            sums[kind] = sums.get(kind, 0.0) + row["energy"]
    return sums


def spent_in(item: Saving, function: str, groups: Sequence[str], joins: str = "") -> float:
    """What rows of some groups, perhaps only those that join two nodes, took [J]."""
    ledger, cylinder = item.ledger, item.case.cylinder
    taken = ledger.get("functions", {}).get(cylinder, {}).get(function, {})
    rows = [
        row
        for row in ledger["rows"]
        if row["group"] in groups
        and row["label"].endswith(joins)
        and row["cylinder"] in (None, cylinder)
    ]
    return math.fsum(taken.get(row["name"], 0.0) for row in rows)


def low_side(item: Saving) -> float:
    """What the off-side pressure cost where the load resists: throttling out to tank [J]."""
    ways = (("extend_resistive", "rod → tank"), ("retract_resistive", "head → tank"))
    return math.fsum(spent_in(item, function, ("valve",), joins) for function, joins in ways)


def saving_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """Sentences and tables on closed cycles of a set of trials, if there are any."""
    page, savings = Template("energy", rig), savings_of(cases)
    caption = open_caption(rig, cases)
    left_out: list[Block] = [Text(caption, "note")] if caption else []
    if not savings:
        return left_out
    by_name = grouped(savings, lambda saving: saving.case.row["controller"])
    cycle, seeds = (any(case.row.get(key) for case in cases) for key in ("cycle", "seeds"))

    def energy(value: float | None, whole: float, half: float | None = None) -> Cell:
        """An energy; a nought where it is next to nothing of ``whole``."""
        value = 0.0 if value is not None and abs(value) < 1e-4 * whole else value
        value, half = shown(rig, "energy", value), shown(rig, "energy", half)
        text = with_error(value, half).replace(" ", "\u00a0") if half else number(value, 3)
        return num(text)

    compared = any(saving.reference is not None for saving in savings)
    logged = any(saving.ledger["source"] == "log" for saving in savings)
    # what any trial's energy went into, as far as it can be seen: throttling first
    tables = [(went(saving), saving.used) for saving in savings]
    names = [
        name
        for name in dict.fromkeys(name for table, _ in tables for name in table)
        if (name == "rest" and logged)
        or any(abs(table.get(name, 0.0)) > SEEN * used for table, used in tables)
    ]
    names.sort(key=lambda name: list(_KINDS).index(name) if name in _KINDS else -1)
    losses = page.table(
        "losses",
        savings,
        names=names,
        kinds=_KINDS | ({"rest": "unexplained"} if logged else {}),
        logged=logged,
        energy=energy,
        went=went,
        low_side=low_side,
        spent_in=spent_in,
    )
    return [
        Text(page.text("saved_title")),
        Bullets([saved_caption(rig, items, name) for name, items in by_name.items()]),
        *([Text(passes)] if (passes := passes_caption(rig, savings)) else []),
        Text(page.text("volume", cycle=cycle, seeds=seeds), "note"),
        *left_out,
        page.table("saving", savings, compared=compared, energy=energy),
        Text(page.text("lost_title")),
        Bullets([lost_caption(items, name) for name, items in by_name.items()]),
        losses,
    ]


def supply_of(case: Case) -> str:
    """What kind of supply a trial ran on."""
    return case.row["energy"].get("supply", _CONSTANT)


def supply_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """What each kind of supply took, against the four-way valve; nothing of one kind alone."""
    kinds = list(dict.fromkeys(map(supply_of, cases)))
    if len(kinds) < 2:
        return []
    page, fit = Template("energy", rig), [case for case in cases if case.fit]
    ledgers = [(case, case.energy()) for case in fit]
    spools = [case for case, led in ledgers if led is not None and four_way(led, case.cylinder)]

    def key(case: Case, kind: str) -> tuple[str, str, str]:
        return case.row["payload"], case.row["motion"], kind

    valve = {key(case, supply_of(case)): case.row["energy"]["pump"] for case in spools}

    def less(case: Case, kind: str) -> float | None:
        """Share by which a trial took less than the four-way valve on a kind of supply."""
        reference = valve.get(key(case, kind))
        return None if reference is None else 1.0 - case.row["energy"]["pump"] / reference

    def shares(trials: Sequence[Case], kind: str) -> list[float]:
        return [100.0 * share for case in trials if (share := less(case, kind)) is not None]

    texts = []
    for kind in kinds:
        laws_of = [case for case in fit if supply_of(case) == kind and case not in spools]
        by_name = by_controller(laws_of)
        laws = [(name, part) for name, c in by_name.items() if (part := shares(c, kind))]
        plain = [case for case in spools if supply_of(case) == kind and kind != _CONSTANT]
        fields: dict[str, Any] = {"laws": laws, "valve": shares(plain, _CONSTANT)}
        if any(fields.values()):
            texts.append(page.text("supply", kind=kind, plain=_CONSTANT, **fields))
    rails = any("low_rail" in case.row["energy"] for case in fit)
    fields = {"plain": _CONSTANT, "rails": rails, "less": less, "supply_of": supply_of}
    table = page.table("supplies", fit, **fields)
    return [Text(page.text("supplies_title")), Bullets(texts), table]
