"""The ledger itself: its rows and what can be asked of them."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import message

GROUPS = ("supply", "valve", "loss", "store", "load", "residual", "cylinder", "part")


@dataclass(frozen=True)
class Row:
    """One line of a ledger.

    ``energy`` [J] counts positive as the group reads: given by the ``supply``, taken by a
    ``valve``, ``loss``, ``store`` or ``load``. Rows of the group ``cylinder`` are transfers inside
    of the balance (drawn from the supply, work of the piston), those of ``part`` say where the
    residual arose; neither is summed. ``interval`` [J] is the 95 % interval, None where nothing is
    uncertain. ``cylinder`` is None for what cylinders share."""

    name: str
    energy: float
    group: str
    label: str
    cylinder: str | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class Ledger:
    """Where the energy of a trial went. ``source`` is ``model`` or ``log``.

    The sum closes: supply = valve + loss + store + load + residual. ``functions`` holds, by
    cylinder and by the working function that its controller logged, the energies [J] of the rows
    while that function was at work; they add up to the rows. ``series`` holds cumulated energies
    [J] by row at times ``t`` [s], if asked for; ``sources`` the standard error [J] that each source
    of doubt gives to the residual; ``notes`` what had to be assumed; ``oil_drawn`` [m³] what all
    edges took from the supply."""

    source: str
    rig: str
    payload: str
    duration: float
    rows: tuple[Row, ...]
    sources: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    functions: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    t: np.ndarray | None = None
    series: dict[str, np.ndarray] = field(default_factory=dict)
    oil_drawn: float = 0.0

    def __getitem__(self, name: str) -> Row:
        """The row of that name.

        Raises:
            InputError: no such row; names those there are.
        """
        for row in self.rows:
            if row.name == name:
                return row
        known = ", ".join(row.name for row in self.rows)
        raise InputError(message("ledger.no_row", name=name, known=known))

    def of(self, cylinder: str) -> tuple[Row, ...]:
        """The rows of one cylinder."""
        return tuple(row for row in self.rows if row.cylinder == cylinder)

    def total(self, group: str, cylinder: str | None = None) -> float:
        """Sum [J] of a group, of one cylinder's rows if named."""
        return math.fsum(
            row.energy
            for row in self.rows
            if row.group == group and cylinder in (None, row.cylinder)
        )

    @property
    def pump(self) -> float:
        """Energy [J] of the pump, ``∫ Ps Q dt`` (SPEC 4), the low rail and cylinders' pumps."""
        given = (row for row in self.rows if row.name in ("pump", "low_rail"))
        shafts = (row for row in self.rows if row.name.endswith(".shaft"))
        return math.fsum(row.energy for row in (*given, *shafts))

    @property
    def low_rail(self) -> float | None:
        """What the low rail gave less what it took back [J], None where there is none."""
        return next((row.energy for row in self.rows if row.name == "low_rail"), None)

    @property
    def residual(self) -> Row:
        """What the rows leave over: ``residual`` of a model, ``unexplained`` of a log."""
        return next(row for row in self.rows if row.group == "residual")

    @property
    def cylinders(self) -> tuple[str, ...]:
        """Cylinders that have rows, in order."""
        return tuple(dict.fromkeys(row.cylinder for row in self.rows if row.cylinder is not None))

    def as_json(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return {
            "source": self.source,
            "rig": self.rig,
            "payload": self.payload,
            "duration": self.duration,
            "rows": [asdict(row) for row in self.rows],
            "totals": {group: self.total(group) for group in GROUPS if group != "part"},
            "cylinders": {
                name: {"drawn": self[f"{name}.drawn"].energy, "work": self[f"{name}.work"].energy}
                | {group: self.total(group, name) for group in ("valve", "loss", "store")}
                for name in self.cylinders
            },
            "residual_share": abs(self.residual.energy) / self.pump if self.pump > 0.0 else None,
            "sources": dict(self.sources),
            "notes": list(self.notes),
            "functions": self.functions,
            "t": None if self.t is None else self.t.tolist(),
            "series": {name: values.tolist() for name, values in self.series.items()},
        }
