"""What trials took from their pumps on supplies of different kinds."""

from __future__ import annotations

from collections.abc import Sequence

from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Bullets, Cell, Grid, Text
from ehbench.report.captions import capital, span
from ehbench.report.cases import Case
from ehbench.report.content import num, quantity_cell
from ehbench.report.energy_tables import four_way
from ehbench.report.trial_tables import WHO, rail_cell, who
from ehbench.report.words import DASH, axis, number

ONE_PRESSURE = "constant pressure"


def supply_of(case: Case) -> str:
    """What kind of supply a trial ran on."""
    return case.row["energy"].get("supply", ONE_PRESSURE)


def supply_blocks(rig: Rig, cases: Sequence[Case]) -> list[Block]:
    """What each supply took, against the four-way valve on it and on constant pressure; nothing
    where all trials have one kind of supply.
    """
    kinds = list(dict.fromkeys(map(supply_of, cases)))
    if len(kinds) < 2:
        return []
    result = _Compared(cases)
    return [
        Text("What the valve saves on each supply:"),
        Bullets([text for kind in kinds if (text := result.caption(kind))]),
        result.table(rig),
    ]


class _Compared:
    """Pump energies [J] of trials, and of the four-way valve on the same motion by supply."""

    def __init__(self, cases: Sequence[Case]) -> None:
        self.cases = [case for case in cases if case.fit]
        self.four_way: dict[tuple[str, str, str], float] = {}
        self.plain: list[Case] = []
        for case in self.cases:
            ledger = case.energy()
            if ledger is not None and four_way(ledger, case.cylinder):
                self.plain.append(case)
                self.four_way[self._key(case, supply_of(case))] = case.row["energy"]["pump"]

    @property
    def rails(self) -> bool:
        """Whether some trial had a low rail."""
        return any("low_rail" in case.row["energy"] for case in self.cases)

    @staticmethod
    def _key(case: Case, kind: str) -> tuple[str, str, str]:
        return case.row["payload"], case.row["motion"], kind

    def less(self, case: Case, kind: str) -> float | None:
        """Share by which a trial took less than the four-way valve on a kind of supply."""
        reference = self.four_way.get(self._key(case, kind))
        return None if reference is None else 1.0 - case.row["energy"]["pump"] / reference

    def caption(self, kind: str) -> str:
        """What was saved on one kind of supply, in a sentence."""
        own = [case for case in self.cases if supply_of(case) == kind]
        words = []
        for name in dict.fromkeys(case.row["controller"] for case in own if case not in self.plain):
            trials = [case for case in own if case.row["controller"] == name]
            shares = [less for case in trials if (less := self.less(case, kind)) is not None]
            if shares:
                words.append(f"{name} took {_percent(shares)} less than the four-way valve on it")
        against = [
            less
            for case in own
            if case in self.plain and (less := self.less(case, ONE_PRESSURE)) is not None
        ]
        if against and kind != ONE_PRESSURE:
            words.append(
                f"the four-way valve itself {_percent(against)} less than on {ONE_PRESSURE}"
            )
        return f"{capital(kind)}: {', '.join(words)}." if words else ""

    def table(self, rig: Rig) -> Grid:
        """A row a trial."""
        head = [
            *WHO,
            "supply",
            axis(rig, "energy", "pump energy"),
            *([axis(rig, "energy", "of it low rail")] if self.rails else []),
            "less than the four-way valve on this supply [%]",
            f"less than the four-way valve on {ONE_PRESSURE} [%]",
        ]
        rows = [self._row(rig, case) for case in self.cases]
        note = (
            "Pump energy is ∫ p Q dt at the pressure at which each oil was given; no pump of any "
            "supply has losses of its own here."
        )
        return Grid(head, rows, note, "supplies", "Energy on each supply.")

    def _row(self, rig: Rig, case: Case) -> list[Cell | str]:
        kind = supply_of(case)
        shares = (self.less(case, kind), self.less(case, ONE_PRESSURE))
        return [
            *who(case),
            kind,
            quantity_cell(rig, "energy", case.row["energy"]["pump"]),
            *([rail_cell(rig, case)] if self.rails else []),
            *(num(DASH if less is None else number(100.0 * less, 3)) for less in shares),
        ]


def _percent(shares: Sequence[float]) -> str:
    return f"{span([100.0 * share for share in shares])} %"
