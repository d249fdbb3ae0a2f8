"""A ledger, what the columns of a rig's powers and stores are called, and how it is filled."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ehbench.data.record import Record, payloads_of
from ehbench.ledger.powers import CylinderPowers, CylinderStores
from ehbench.parts.nodes import SUPPLY
from ehbench.plant.model import Model
from ehbench.vocabulary import Z95, InputError, LogError, message
from ehbench.vocabulary.codes import FUNCTIONS
from ehbench.vocabulary.terms import MECHANICAL

GROUPS = ("supply", "valve", "loss", "store", "load", "residual", "cylinder", "part")
Named = tuple[str, str, str, str | None]  # name, group, label, cylinder
Part = tuple[Named, Sequence[str], Sequence[str]]  # what the residual is of: +, −
# (group, label) of a cylinder's powers, in the order of CylinderPowers
CYLINDER_ROWS = (
    ("cylinder", "drawn from the supply, Ps·Q"),
    ("cylinder", "drawn, compression"),
    ("cylinder", "cylinder work"),
    ("loss", "expansion of the oil"),
    ("loss", "leakage"),
    ("loss", "relief valve"),
    ("loss", "cavitation make-up"),
    ("loss", "return line, Pt·Q"),
    ("loss", "cylinder friction"),
    ("loss", "end stops"),
    ("load", "force on the rod from outside"),
)
STORE_LABELS = (
    *("oil of the head end", "oil of the rod end", "spring of the end stops"),
    "springs on the rod",
)
# what the low rail gave, less what it took back; the last of the powers
RAIL: list[Named] = [
    ("low_rail", "supply", "low rail, p·Q", None),
    ("low_rail_compression", "supply", "low rail, compression of the oil", None),
]
# what goes with a payload that is put down, or comes with one that is taken up
PAYLOAD: Named = ("payload", "load", "gone with the payload", None)
# rows of a cylinder that stand in a ledger only where the rig file has the table
OPTIONAL = {"force": ("external_force", "load_spring")}


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
    while that function was at work; they add up to the rows. ``sources`` holds the standard error
    [J] that each source of doubt gives to the residual; ``notes`` what had to be assumed;
    ``oil_drawn`` [m³] what all edges took from the supply."""

    source: str
    rig: str
    payload: str
    duration: float
    rows: tuple[Row, ...]
    sources: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    functions: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    oil_drawn: float = 0.0

    def __getitem__(self, name: str) -> Row:
        """The row of that name.

        Raises:
            InputError: no such row; names those there are."""
        for row in self.rows:
            if row.name == name:
                return row
        known = ", ".join(row.name for row in self.rows)
        raise InputError(message("ledger.no_row", name=name, known=known))

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
        }


class Sheet:
    """What the columns of a rig's powers and stores are called, and how the residuals follow from
    them.

    Attributes:
        owner: cylinder to which each edge belongs.
        powers, stores: how many columns of each there are; behind them, where the payload
            changes, one of what it takes along.
        rows: of each column.
        every: these, the residual's parts, and their sum.
        absent: names of rows that are left out, as of parts which the rig has not.
        combinations: how much of each column is in each part, shape (parts, columns)."""

    def __init__(self, model: Model, word: str, changes: bool = False) -> None:
        names = model.layout
        owners = [names.cylinders.index(name.split(".", 1)[0]) for name in names.edges]
        self.owner = np.array(owners, dtype=np.int64)
        self.cylinders = names.cylinders
        self.absent = {
            f"{c.name}.{key}"
            for c in model.rig.cylinder
            for table, keys in OPTIONAL.items()
            for key in keys
            if not getattr(c, table)
        }
        powers, stores = _rows(model)
        self.powers, self.stores, self.rows = len(powers), len(stores), powers + stores
        if changes:
            self.rows.append(PAYLOAD)
        parts = _parts(self.rows, names.cylinders, word)
        self.every = [*self.rows, *(row for row, *_ in parts), (word, "residual", word, None)]
        at = {name: i for i, (name, *_) in enumerate(self.rows)}
        self.combinations = np.zeros((len(parts), len(self.rows)))
        for vector, (*_, plus, minus) in zip(self.combinations, parts, strict=True):
            vector[[at[name] for name in plus]] += 1.0
            vector[[at[name] for name in minus]] -= 1.0

    def expand(self, vector: np.ndarray) -> np.ndarray:
        """Energies of columns, shape (..., columns), then the residual's parts and their sum."""
        parts = vector @ self.combinations.T
        return np.concatenate([vector, parts, parts.sum(axis=-1, keepdims=True)], axis=-1)

    def ledger(
        self,
        model: Model,
        record: Record,
        payload: str,
        energies: np.ndarray,
        std: np.ndarray | None,
        **facts: Any,
    ) -> Ledger:
        """The ledger of expanded energies and their standard errors."""
        rows = []
        for i, (name, group, label, cylinder) in enumerate(self.every):
            if name in self.absent:
                continue
            energy, interval = float(energies[i]), None
            if std is not None:
                half = Z95 * float(std[i])
                interval = energy - half, energy + half
            rows.append(Row(name, energy, group, label, cylinder, interval))
        rows.sort(key=lambda row: GROUPS.index(row.group))
        source, duration = "model" if std is None else "log", float(record.t[-1] - record.t[0])
        return Ledger(source, model.rig.name, payload or "none", duration, tuple(rows), **facts)

    def functions(
        self, record: Record, table: np.ndarray
    ) -> dict[str, dict[str, dict[str, float]]]:
        """Energies by cylinder, working function and row, of ``table``, which has them cumulated to
        every sample, shape (samples, rows); rows that stay zero are left out."""
        names = [name for name, *_ in self.every]
        results, steps = {}, np.diff(table, axis=0)
        for cylinder in self.cylinders:
            if (function := function_of(record, cylinder)) is not None:
                sums = {FUNCTIONS[f]: steps[function == f].sum(axis=0) for f in np.unique(function)}
                results[cylinder] = {
                    word: {n: float(v) for n, v in zip(names, energies, strict=True) if v}
                    for word, energies in sums.items()
                }
        return results


def _rows(model: Model) -> tuple[list[Named], list[Named]]:
    """(rows of the powers, rows of what is stored), in the order of `ehbench.ledger.powers`."""
    names, joints = model.layout, model.plant.cylinders.joint
    powers: list[Named] = [
        ("pump", "supply", "pump, Ps·Q", None),
        ("pump_compression", "supply", "pump, compression of the oil", None),
    ]
    spools = {
        f"{c.name}.{valve.edge_name(edge)}": valve.name
        for c, valve, edge in model.rig.edges()
        if len(valve.edge) > 1
    }
    shafts: list[Named] = []
    for name, edge in model.rig.all_edges().items():
        cylinder, edge_name = name.split(".", 1)
        shown = spools.get(name, edge_name)
        if edge.law == "pump":
            powers.append((f"{name}.slip", "loss", f"{shown}, slip", cylinder))
            shafts.append((f"{name}.shaft", "supply", f"{edge_name}, shaft of the pump", cylinder))
        else:
            label = f"{shown}, {edge.from_} → {edge.to}"
            powers.append((f"{name}.throttling", "valve", label, cylinder))
    for name in names.cylinders:
        pairs = zip(CylinderPowers._fields, CYLINDER_ROWS, strict=True)
        powers += [(f"{name}.{key}", *labels, name) for key, labels in pairs]
    driven = {int(j): names.cylinders[i] for i, j in enumerate(joints)}
    label = "slide damping" if model.rig.mechanism.kind == "slide" else "joint damping"
    for j, name in enumerate(names.joints):
        powers.append((f"{name}.damping", "loss", label, driven.get(j)))
    powers += shafts
    for c, end in names.lines:
        name = names.cylinders[c]
        powers.append((f"{name}.line_{end}.throttling", "loss", f"line of the {end} end", name))
    powers += _of_each(model, names.mounts, "mount", "loss", "mount")
    powers += _of_each(model, names.sways, "sway", "loss", "damper of what sways")
    powers += RAIL if model.rig.supply.low_rail is not None else []
    stores: list[Named] = [
        ("supply_line", "store", "oil of the supply line", None),
        ("kinetic", "load", "kinetic energy", None),
        ("potential", "load", "potential energy", None),
    ]
    for name in names.cylinders:
        pairs = zip(CylinderStores._fields, STORE_LABELS, strict=True)
        stores += [(f"{name}.{key}", "store", label, name) for key, label in pairs]
    springy = dict.fromkeys(c for c, _ in names.friction_states)
    stores += _of_each(model, springy, "friction_spring", "store", "spring of the friction")
    for c, end in names.lines:
        name = names.cylinders[c]
        stores.append((f"{name}.line_{end}", "store", f"oil of the {end} end's line", name))
    stores += _of_each(model, names.mounts, "mount_spring", "store", "spring of the mount")
    stores += _of_each(model, names.sways, "swaying", "load", "mass that sways")
    if model.rig.supply.accumulator is not None:
        stores.append(("accumulator", "store", "accumulator", None))
    return powers, stores


def _of_each(
    model: Model, cylinders: Iterable[int], key: str, group: str, label: str
) -> list[Named]:
    names = [model.layout.cylinders[c] for c in cylinders]
    return [(f"{name}.{key}", group, label, name) for name in names]


def _parts(rows: list[Named], cylinders: Sequence[str], word: str) -> list[Part]:
    """Where the residual may have arisen, each with the rows that it is the difference of."""
    drawn = [f"{name}.{key}" for name in cylinders for key in ("drawn", "drawn_compression")]
    given = [row for row, group, _, owner in rows if group == "supply" and owner is None]
    retained = [row for row, group, *_ in rows if row in ("supply_line", "accumulator")]
    line = (f"{word}.supply_line", "part", f"{word}, supply line", None)
    parts: list[Part] = [(line, given, (*drawn, *retained))]
    for name in cylinders:
        taken = [
            row
            for row, group, _, cylinder in rows
            if cylinder == name
            and group in ("valve", "loss", "store")
            and row.rsplit(".", 1)[-1] not in ("work", *MECHANICAL)
        ]
        shafts = [row for row, group, _, owner in rows if owner == name and group == "supply"]
        supplied = (f"{name}.drawn", f"{name}.drawn_compression", *shafts)
        taken.append(f"{name}.work")
        oil = (f"{name}.{word}", "part", f"{word}, oil of the cylinder", name)
        parts.append((oil, supplied, taken))
    work = [f"{name}.work" for name in cylinders]
    spent = [
        row for row, group, _, _ in rows if group == "load" or row.rsplit(".", 1)[-1] in MECHANICAL
    ]
    parts.append(((f"{word}.mechanism", "part", f"{word}, mechanism", None), work, spent))
    return parts


def function_of(record: Record, cylinder: str) -> np.ndarray | None:
    """The working function of every tick as logged, shape (samples − 1,); None without."""
    channel = record.channels.get(f"{cylinder}.function")
    if channel is None:
        return None
    return np.clip(channel[:-1].round().astype(int), 0, len(FUNCTIONS) - 1)


def oil_drawn(model: Model, t: np.ndarray, flows: np.ndarray) -> float:
    """Oil [m³] that edges took from the supply, by trapezes, shape (samples, edges + 1)."""
    sign, edges = np.zeros(flows.shape[1]), model.plant.edges
    sign[:-1] = 1.0 * (edges.from_node == SUPPLY) - 1.0 * (edges.to_node == SUPPLY)
    drawn = flows @ sign
    return float(np.sum(0.5 * (drawn[1:] + drawn[:-1]) * np.diff(t)))


def must_have_samples(record: Record) -> None:
    """Raise LogError where a record is too short."""
    if record.t.size < 2:
        raise LogError(message("ledger.too_short"))


def payload_of(record: Record) -> str:
    """The payloads that a record names, and from when on; '' for none."""
    (_, first), *changes = payloads_of(record)
    messages = [first or "none", *(f"{name or 'none'} from {at:g} s" for at, name in changes)]
    return "" if messages == ["none"] else ", ".join(messages)
