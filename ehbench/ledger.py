"""The energy ledger of a trial: where the pump's energy went, from a model's record or from
measured channels alone.

Energies count from oil at zero gauge pressure. A volume of oil that crosses a pressure p carries p,
and what its own compression holds, ``u(p) = β (e^(p/β) − 1) − p`` per volume; with these two the
chamber law ``V/β ṗ = Q − V̇`` is exactly ``(p + u(p)) Q = p V̇ + d/dt (V u(p))``: flow work is
piston work and a change of what is stored, a function of state."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from ehbench.codes import EXTEND_RESISTIVE_REGENERATION, FUNCTIONS
from ehbench.compiled import allocating_kernel, kernel
from ehbench.errors import InputError, InsufficientData, LogError
from ehbench.parts.cylinder import (
    chamber_inflow,
    chamber_makeup,
    chamber_of,
    chamber_oil,
    joint_of,
    linkage_arrays,
    linkage_of,
    relief_out,
)
from ehbench.parts.accumulator import gas_energy
from ehbench.parts.edge import MAP
from ehbench.parts.edge import PUMP as PUMP_LAW
from ehbench.parts.edge.pump import slip_loss
from ehbench.parts.end_stop import stop_held, stop_loss
from ehbench.parts.friction import friction_force
from ehbench.parts.nodes import SUPPLY, TANK, node_bulk_modulus, node_pressure
from ehbench.physics import arm
from ehbench.physics.cylinder import PINS, linkage
from ehbench.plant.build import Maps, map_of
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import MOST_SUBSTEPS, STEP, STIFF, advance
from ehbench.plant.model import Model
from ehbench.plant.valves import follow_valves, opening_of
from ehbench.record import Record
from ehbench.rig import Cylinder, Rig
from ehbench.terms import Z95

GROUPS = ("supply", "valve", "loss", "store", "load", "residual", "cylinder", "part")
FOLLOWS = 1.0e-2  # share of a state's range that a tick of the model may miss the next sample by
SETTLED_TRAVEL = 0.005  # share of the stroke below which a motion to and fro is no travel
CLOSED = 0.02  # share of the travel by which the ends of a closed cycle may differ
CUT_MEAN = (
    0.7561  # mean of |z|, z standard normal, where what exceeds its 90 % quantile is cut to it
)
ROUNDING = 1.0e-12  # smaller than any reading
LOADED = 0.02  # share of the supply's force on the head end below which a mean force is no load

# columns of power: pump, its share for compression, one per edge, ten per cylinder, one per joint,
# the shaft of each edge that is a pump
PUMP, COMPRESSION, FIRST_EDGE = 0, 1, 2
(
    DRAWN,
    DRAWN_COMPRESSION,
    WORK,
    EXPANSION,
    LEAKAGE,
    RELIEVED,
    MAKEUP,
    RETURNED,
    FRICTION,
    STOPPED,
) = range(10)
PER_CYLINDER = 10
# columns of what is stored: the supply line, the mechanism, then head, rod and end stops of each
# cylinder, then the accumulator where there is one
SUPPLY_LINE, KINETIC, POTENTIAL, FIRST_CYLINDER = 0, 1, 2, 3
HEAD, ROD, SPRING = range(3)


# --- laws
# -----------------------------------------------------------------------------------------------------------


@kernel
def compressed(pressure, bulk_modulus):
    """Energy [J/m³] in oil of bulk modulus β compressed to gauge pressure p: ``u = β (e^(p/β) − 1)
    − p ≈ p²/2β``.
    """
    return bulk_modulus * math.expm1(pressure / bulk_modulus) - pressure


@kernel
def _node(node, y, plant):
    """(pressure [Pa], energy of its compression [J/m³]) of the oil at a node of the circuit."""
    p = node_pressure(y, plant, node)
    return p, compressed(p, node_bulk_modulus(plant, node))


@kernel
def powers(y, flows, plant, owner, out):
    """Write every power [W] of a state into ``out``: what is spent positive, the supply's positive
    where it gives.

    A throttle of flow Q from a to b takes ``(p_a − p_b) Q`` (SPEC 4) and lets ``(u_a − u_b) Q`` of
    compression go. A pump takes what slips, and its shaft gives ``D ω (p_b − p_a)``. What comes to
    the tank is lost with the tank's own pressure on it. An end stop takes what it does not hold as
    a spring.

    Args:
        y: state, as in ``ehbench.plant``.
        flows: along the edges, then the pump's [m³/s].
        owner: cylinder to which each edge belongs.
        out: shape (2 + edges + 10·cylinders + joints + pumps,).
    """
    n, nc, ne = plant.links.shape[0], plant.cylinders.shape[0], plant.edges.shape[0]
    first = FIRST_EDGE + ne
    shaft = first + PER_CYLINDER * nc + n
    for i in range(out.shape[0]):
        out[i] = 0.0
    p_supply, u_supply = _node(SUPPLY, y, plant)
    p_tank, u_tank = _node(TANK, y, plant)
    out[PUMP], out[COMPRESSION] = p_supply * flows[ne], u_supply * flows[ne]
    for e in range(ne):
        flow = flows[e]
        a, b = plant.edges[e].from_node, plant.edges[e].to_node
        if plant.edges[e].law == PUMP_LAW:
            drop = node_pressure(y, plant, a) - node_pressure(y, plant, b)
            slipped = slip_loss(drop, plant.edges[e])
            out[FIRST_EDGE + e], out[shaft] = slipped, slipped - drop * flow
            shaft += 1
        if flow == 0.0:
            continue
        at = first + PER_CYLINDER * owner[e]
        p_a, u_a = _node(a, y, plant)
        p_b, u_b = _node(b, y, plant)
        if plant.edges[e].law != PUMP_LAW:
            out[FIRST_EDGE + e] = (p_a - p_b) * flow
        out[at + EXPANSION] += (u_a - u_b) * flow
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node == 0:
                out[at + DRAWN] += sign * p_supply * flow
                out[at + DRAWN_COMPRESSION] += sign * u_supply * flow
            elif node == TANK:
                out[at + RETURNED] -= sign * (p_tank + u_tank) * flow
    for c in range(nc):
        row, at = plant.cylinders[c], first + PER_CYLINDER * c
        x, lever, _ = linkage_of(row, y[row.joint])
        v = lever * y[n + row.joint]
        p_head, u_head = _node(row.node_head, y, plant)
        p_rod, u_rod = _node(row.node_rod, y, plant)
        across = row.leakage_internal * (p_head - p_rod)
        out[at + EXPANSION] += (u_head - u_rod) * across
        out[at + LEAKAGE] = across * (p_head - p_rod)
        for side in range(2):
            node, area, _, leakage = chamber_of(row, side)
            p, u = _node(node, y, plant)
            net = 0.0
            for e in range(ne):
                if plant.edges[e].from_node == node:
                    net -= flows[e]
                if plant.edges[e].to_node == node:
                    net += flows[e]
            relief = relief_out(row, p)
            makeup = chamber_makeup(row, p, chamber_inflow(row, side, v, net, y, plant))
            leak = leakage * (p - p_tank)
            to_tank = relief + leak - makeup
            out[at + LEAKAGE] += leak * (p - p_tank)
            out[at + RELIEVED] += relief * (p - p_tank)
            out[at + MAKEUP] += makeup * (p_tank - p)
            out[at + RETURNED] += (p_tank + u_tank) * to_tank
            out[at + EXPANSION] += (u - u_tank) * to_tank
            out[at + WORK] += p * area * v
        out[at + FRICTION] = friction_force(row, v, y) * v
        out[at + STOPPED] = stop_loss(row, x, v)
    for j in range(n):
        out[first + PER_CYLINDER * nc + j] = plant.links[j].damping * y[n + j] * y[n + j]


@kernel
def stores(y, plant, work, out):
    """Write every stored energy [J] of a state into ``out``, shape (3 + 3·cylinders,), one more
    with an accumulator.

    Oil: ``V u(p)``. The mechanism: kinetic and potential energy. An end stop: ``k δ²/2`` of its
    depth δ."""
    n = plant.links.shape[0]
    _, held = _node(SUPPLY, y, plant)
    out[SUPPLY_LINE] = plant.supply.volume * held
    out[KINETIC], out[POTENTIAL] = arm.energy(
        plant.kind, plant.links, plant.gravity, y[:n], y[n : 2 * n], work
    )
    for c in range(plant.cylinders.shape[0]):
        row, at = plant.cylinders[c], FIRST_CYLINDER + 3 * c
        x, _, _ = linkage_of(row, y[row.joint])
        for side in range(2):
            _, held = _node(chamber_of(row, side)[0], y, plant)
            out[at + side] = chamber_oil(row, side, x) * held
        out[at + SPRING] = stop_held(row, x)
    if plant.supply.gas_volume > 0.0:
        p_supply = node_pressure(y, plant, SUPPLY)
        out[FIRST_CYLINDER + 3 * plant.cylinders.shape[0]] = gas_energy(p_supply, plant.supply)


# --- over a trial
# ---------------------------------------------------------------------------------------------------


@allocating_kernel
def _integrate(t, states, commands, plant, owner, step, flows, energies, ends):
    """Integrate each tick anew from its logged state with the plant's own kernel, and the powers
    with it by Simpson's rule.

    Args:
        step: longest piece [s]; shorter ones are taken where the plant is stiff.
        flows: out, at each sample, shape (samples, edges + 1).
        energies: out, of each tick [J], shape (samples − 1, columns).
        ends: out, where each tick ended, shape (samples − 1, states).
    """
    size, columns = states.shape[1], energies.shape[1]
    k = np.empty((5, size))
    work, at = np.empty(plant.at.work), plant.at.flow
    y, start, middle = np.empty(size), np.empty(columns), np.empty(columns)
    for i in range(t.shape[0]):
        y[:] = states[i]
        rate = derivatives(y, commands[i], plant, k[0], work)
        flows[i] = work[at:]
        if i + 1 == t.shape[0]:
            break
        tick = t[i + 1] - t[i]
        pieces = min(MOST_SUBSTEPS, max(1, math.ceil(max(tick / step - 1e-6, rate * tick / STIFF))))
        h = tick / pieces
        powers(y, work[at:], plant, owner, start)
        energies[i] = 0.0
        for _ in range(pieces):
            advance(y, commands[i], plant, 0.5 * h, k, work, rate)
            rate = derivatives(y, commands[i], plant, k[0], work)
            powers(y, work[at:], plant, owner, middle)
            for j in range(columns):
                energies[i, j] += h / 6.0 * start[j] + h / 1.5 * middle[j]
            advance(y, commands[i], plant, 0.5 * h, k, work, rate)
            rate = derivatives(y, commands[i], plant, k[0], work)
            powers(y, work[at:], plant, owner, start)
            for j in range(columns):
                energies[i, j] += h / 6.0 * start[j]
        ends[i] = y


@allocating_kernel
def _flows_at(states, commands, tank, plant, flows):
    """Edge flows and the pump's at given states; ``tank`` [Pa] is written into the plant's nodes as
    it goes along.
    """
    k = np.empty(states.shape[1])
    work = np.empty(plant.at.work)
    for i in range(states.shape[0]):
        plant.nodes[TANK].pressure = tank[i]
        derivatives(states[i], commands[i], plant, k, work)
        flows[i] = work[plant.at.flow :]


@allocating_kernel
def _powers_at(states, flows, tank, plant, owner, out):
    for i in range(states.shape[0]):
        plant.nodes[TANK].pressure = tank[i]
        powers(states[i], flows[i], plant, owner, out[i])


@allocating_kernel
def _stores_at(states, plant, out):
    work = np.empty(arm.work_size(plant.links.shape[0]))
    for i in range(states.shape[0]):
        stores(states[i], plant, work, out[i])


# --- the ledger
# -----------------------------------------------------------------------------------------------------


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
        raise InputError(
            f"the ledger has no row '{name}'",
            hint="it has " + ", ".join(row.name for row in self.rows),
        )

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
        """Pump energy [J]: ``∫ Ps Q dt`` (SPEC 4), and what the shafts of pumps at cylinders gave."""
        shafts = (row.energy for row in self.rows if row.name.endswith(".shaft"))
        return math.fsum([self["pump"].energy, *shafts])

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


class _Sheet:
    """What the columns of a rig's powers and stores are called, and how the residuals follow from
    them.
    """

    def __init__(self, model: Model, word: str) -> None:
        names, nc, ne = model.layout, len(model.layout.cylinders), len(model.layout.edges)
        owners = [name.split(".", 1)[0] for name in names.edges]
        self.owner = np.array([names.cylinders.index(name) for name in owners], dtype=np.int64)
        pumps = [name for name, row in zip(names.edges, model.plant.edges) if row.law == PUMP_LAW]
        charged = model.rig.supply.accumulator is not None
        self.powers = FIRST_EDGE + ne + PER_CYLINDER * nc + len(names.joints) + len(pumps)
        self.stores = FIRST_CYLINDER + 3 * nc + charged
        rows: list[tuple[str, str, str, str | None]] = [
            ("pump", "supply", "pump, Ps·Q", None),
            ("pump_compression", "supply", "pump, compression of the oil", None),
        ]
        valves = {
            f"{c.name}.{valve.edge_name(edge)}": valve.name
            for c, valve, edge in model.rig.edges()
            if len(valve.edge) > 1
        }
        for (name, edge), owner in zip(model.rig.all_edges().items(), owners, strict=True):
            shown = valves.get(name, name.split(".", 1)[1])
            if name in pumps:
                rows.append((f"{name}.slip", "loss", f"{shown}, slip", owner))
                continue
            rows.append(
                (f"{name}.throttling", "valve", f"{shown}, {edge.from_} → {edge.to}", owner)
            )
        for name in names.cylinders:
            rows += [
                (f"{name}.{key}", group, label, name)
                for key, group, label in (
                    ("drawn", "cylinder", "drawn from the supply, Ps·Q"),
                    ("drawn_compression", "cylinder", "drawn, compression"),
                    ("work", "cylinder", "cylinder work"),
                    ("expansion", "loss", "expansion of the oil"),
                    ("leakage", "loss", "leakage"),
                    ("relief", "loss", "relief valve"),
                    ("makeup", "loss", "cavitation make-up"),
                    ("return_line", "loss", "return line, Pt·Q"),
                    ("friction", "loss", "cylinder friction"),
                    ("end_stop", "loss", "end stops"),
                )
            ]
        driven = {int(j): names.cylinders[i] for i, j in enumerate(model.plant.cylinders.joint)}
        rows += [
            (f"{name}.damping", "loss", "joint damping", driven.get(j))
            for j, name in enumerate(names.joints)
        ]
        if model.rig.mechanism.kind == "slide":
            rows[-1] = (rows[-1][0], "loss", "slide damping", rows[-1][3])
        shafts = [f"{name}.shaft" for name in pumps]
        for name in shafts:
            owner, edge, _ = name.split(".")
            rows.append((name, "supply", f"{edge}, shaft of the pump", owner))
        rows += [
            ("supply_line", "store", "oil of the supply line", None),
            ("kinetic", "load", "kinetic energy", None),
            ("potential", "load", "potential energy", None),
        ]
        for name in names.cylinders:
            kept = (
                ("head", "oil of the head end"),
                ("rod", "oil of the rod end"),
                ("stop", "spring of the end stops"),
            )
            rows += [(f"{name}.{key}", "store", label, name) for key, label in kept]
        if charged:
            rows.append(("accumulator", "store", "accumulator", None))
        self.rows = rows
        at = {name: i for i, (name, *_) in enumerate(rows)}

        def combination(plus: Sequence[str], minus: Sequence[str]) -> np.ndarray:
            vector = np.zeros(len(rows))
            for sign, chosen in ((1.0, plus), (-1.0, minus)):
                for name in chosen:
                    vector[at[name]] += sign
            return vector

        mechanical = ("work", "friction", "end_stop", "stop")
        drawn = [
            f"{name}.{key}" for name in names.cylinders for key in ("drawn", "drawn_compression")
        ]
        parts = [
            (
                f"{word}.supply_line",
                "supply line",
                None,
                combination(
                    ["pump", "pump_compression"],
                    [*drawn, "supply_line", *["accumulator"] * charged],
                ),
            )
        ]
        for name in names.cylinders:
            taken = [
                row
                for row, group, _, cylinder in rows
                if cylinder == name and group in ("valve", "loss", "store")
            ]
            taken = [row for row in taken if row.rsplit(".", 1)[-1] not in (*mechanical, "damping")]
            given = [f"{name}.drawn", f"{name}.drawn_compression"]
            given += [shaft for shaft in shafts if shaft.startswith(f"{name}.")]
            parts.append(
                (
                    f"{name}.{word}",
                    "oil of the cylinder",
                    name,
                    combination(given, [*taken, f"{name}.work"]),
                )
            )
        work = [f"{name}.work" for name in names.cylinders]
        spent = [
            row
            for row, group, _, _ in rows
            if group == "load" or row.rsplit(".", 1)[-1] in (*mechanical[1:], "damping")
        ]
        parts.append((f"{word}.mechanism", "mechanism", None, combination(work, spent)))
        self.cylinders = names.cylinders
        self.parts = [(name, where, cylinder) for name, where, cylinder, _ in parts]
        self.combinations = np.stack([vector for *_, vector in parts])
        self.word = word

    def expand(self, vector: np.ndarray) -> np.ndarray:
        """Energies of columns, shape (..., columns), with the parts of the residual and their sum
        behind them.
        """
        parts = vector @ self.combinations.T
        return np.concatenate([vector, parts, parts.sum(axis=-1, keepdims=True)], axis=-1)

    def ledger(
        self,
        model: Model,
        record: Record,
        payload: str,
        energies: np.ndarray,
        std: np.ndarray | None,
        **rest: Any,
    ) -> Ledger:
        """The ledger of expanded energies and their standard errors."""
        named = [
            *self.rows,
            *(
                (name, "part", f"{self.word}, {where}", cylinder)
                for name, where, cylinder in self.parts
            ),
            (self.word, "residual", self.word, None),
        ]
        rows = []
        for i, (name, group, label, cylinder) in enumerate(named):
            energy = float(energies[i])
            interval = (
                None
                if std is None
                else (energy - Z95 * float(std[i]), energy + Z95 * float(std[i]))
            )
            rows.append(Row(name, energy, group, label, cylinder, interval))
        rows.sort(key=lambda row: GROUPS.index(row.group))
        source, duration = "model" if std is None else "log", float(record.t[-1] - record.t[0])
        return Ledger(source, model.rig.name, payload or "none", duration, tuple(rows), **rest)

    def told(self, record: Record, table: np.ndarray, points: int) -> dict[str, Any]:
        """What a ledger holds of energies cumulated to every sample, shape (samples, rows): by
        working function, and, if asked for, at about ``points`` times; rows that stay zero are left
        out."""
        names = [name for name, *_ in self.rows] + [name for name, *_ in self.parts] + [self.word]
        found: dict[str, Any] = {"functions": {}}
        for cylinder in self.cylinders:
            if (function := _function(record, cylinder)) is not None:
                found["functions"][cylinder] = {
                    FUNCTIONS[f]: {
                        name: float(v)
                        for name, v in zip(
                            names, np.diff(table, axis=0)[function == f].sum(axis=0), strict=True
                        )
                        if v
                    }
                    for f in np.unique(function)
                }
        if points > 1:
            at = np.unique(
                np.linspace(0, record.t.size - 1, max(2, min(points, record.t.size)))
                .round()
                .astype(int)
            )
            series = {name: table[at, i] for i, name in enumerate(names) if table[at, i].any()}
            found |= {"t": record.t[at], "series": series}
        return found


def _function(record: Record, cylinder: str) -> np.ndarray | None:
    """The working function of every tick, shape (samples − 1,), as a controller logged it; None
    where none did.
    """
    channel = record.channels.get(f"{cylinder}.function")
    return (
        None
        if channel is None
        else np.clip(channel[:-1].round().astype(int), 0, len(FUNCTIONS) - 1)
    )


def _oil_drawn(model: Model, t: np.ndarray, flows: np.ndarray) -> float:
    """Oil [m³] that the edges took from the supply, by trapezes of their flows, shape (samples,
    edges + 1).
    """
    sign, edges = np.zeros(flows.shape[1]), model.plant.edges
    sign[:-1] = 1.0 * (edges.from_node == SUPPLY) - 1.0 * (edges.to_node == SUPPLY)
    drawn = flows @ sign
    return float(np.sum(0.5 * (drawn[1:] + drawn[:-1]) * np.diff(t)))


def _check(record: Record) -> None:
    if record.t.size < 2:
        raise LogError(
            "the record is too short for a ledger", hint="it takes two samples at the least"
        )


def _held_payload(model: Model, record: Record) -> str:
    return "" if record.meta.get("payload", "none") == "none" else record.meta["payload"]


# --- from the model
# -------------------------------------------------------------------------------------------------


def states_of(model: Model, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """(states, shape (samples, states); commands [V], shape (samples, valves)) of a model's record.

    The rates of the openings, which a record has not, follow from the openings and the commands.

    Raises:
        LogError: a channel of the model is missing.
    """
    names, plant = model.layout, model.plant
    samples, n = record.t.size, plant.at.rates
    states = np.zeros((samples, names.states))
    driven = {int(j): names.cylinders[i] for i, j in enumerate(plant.cylinders.joint)}
    for j, joint in enumerate(names.joints):
        own = driven.get(j, joint)
        states[:, j], states[:, n + j] = record[f"{own}.q"], record[f"{own}.qd"]
    for i, name in enumerate(names.cylinders):
        for key in ("p_head", "p_rod"):
            states[:, names.state(key, i)] = record[f"{name}.{key}"]
    commands = np.stack([record[f"{name}.command"] for name in names.valves], axis=1)
    commands = np.ascontiguousarray(commands, dtype=float)
    for name, valve in zip(names.valves, plant.valves, strict=True):
        if valve.output >= 0:
            states[:, valve.output] = record[f"{name}.opening"]
    follow_valves(np.ascontiguousarray(record.t), commands, plant, True, states)
    states[:, plant.at.supply] = record["p_supply"]
    return states, commands


def ledger_of_model(
    model: Model, record: Record, quadrature: str = "exact", points: int = 0, step: float = STEP
) -> Ledger:
    """The ledger of a trial on the model, from what the model logs.

    Args:
        model: with the rig, payload and maps that made the record.
        record: as `Model.record` gives it: states, commands, openings, at any rate that has every
            change of the commands.
        quadrature: ``exact`` integrates every tick anew from its logged state, and the powers with
            it; ``samples`` takes the trapezoid of the powers at the samples, which is quicker and
            as good as the sampling.
        points: how many times of cumulated energies to keep in ``series``; 0 for none.
        step: longest integration step [s].

    Raises:
        LogError: a channel is missing, or its flows are not those of this model.
        InputError: no such quadrature.
    """
    if quadrature not in ("exact", "samples"):
        raise InputError(f"there is no quadrature '{quadrature}'", hint="exact or samples")
    _check(record)
    t = np.ascontiguousarray(record.t, dtype=float)
    states, commands = states_of(model, record)
    plant = model.plant.at_pressures(tank=record["p_tank"][0] if "p_tank" in record else None)
    tank = np.full(t.size, plant.tank_pressure)
    sheet, notes = _Sheet(model, "residual"), []
    flows = np.empty((t.size, len(model.layout.edges) + 1))
    spent = np.zeros((t.size, sheet.powers))
    if quadrature == "exact":
        ticks, ends = np.empty((t.size - 1, sheet.powers)), np.empty((t.size - 1, states.shape[1]))
        _integrate(t, states, commands, plant, sheet.owner, step, flows, ticks, ends)
        np.cumsum(ticks, axis=0, out=spent[1:])
        notes += _missed(model, states, ends)
    else:
        _flows_at(states, commands, tank, plant, flows)
        power = np.empty((t.size, sheet.powers))
        _powers_at(states, flows, tank, plant, sheet.owner, power)
        np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t)[:, None], axis=0, out=spent[1:])
    _same_flows(model, record, flows)
    held = np.empty((t.size, sheet.stores))
    _stores_at(states, plant, held)
    table = sheet.expand(np.concatenate([spent, held - held[0]], axis=1))
    told = sheet.told(record, table, points) | {"oil_drawn": _oil_drawn(model, t, flows)}
    return sheet.ledger(
        model, record, _held_payload(model, record), table[-1], None, notes=tuple(notes), **told
    )


def _same_flows(model: Model, record: Record, flows: np.ndarray) -> None:
    """Raise where the record's flows are not those that the model has at the record's states."""
    for i, channel in enumerate([*(f"{name}.flow" for name in model.layout.edges), "flow_supply"]):
        if channel not in record:
            continue
        scale = max(np.abs(record[channel]).max(), np.abs(flows[:, i]).max(), ROUNDING)
        if np.abs(record[channel] - flows[:, i]).max() > FOLLOWS * scale:
            raise LogError(
                f"channel '{channel}' is not what this model gives at the record's own pressures and openings",
                hint="give the rig and the flow maps that the record was made with; of a machine's log take ledger_of_log",
            )


def _missed(model: Model, states: np.ndarray, ends: np.ndarray) -> list[str]:
    """A sentence where a tick of the model does not lead from one sample to the next."""
    n, nc = len(model.layout.joints), len(model.layout.cylinders)
    kinds = (("joint angle", 0, n), ("joint rate", n, 2 * n), ("pressure", 2 * n, 2 * n + 2 * nc))
    for what, low, high in kinds:
        scale = (
            np.abs(states[:, low:high]).max()
            if what == "pressure"
            else np.ptp(states[:, low:high], axis=0).max()
        )
        gap = np.abs(ends[:, low:high] - states[1:, low:high]).max()
        if gap > FOLLOWS * max(scale, ROUNDING):
            missed = f"the model misses the next sample's {what} by {100 * gap / max(scale, ROUNDING):.2g} % of its range"
            return [
                missed
                + ": commands change between samples, or the record was made with another payload"
            ]
    return []


# --- from a machine's log
# -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Accuracy:
    """Standard errors that a log and its rig do not state, as shares; the defaults are those of
    ordinary industrial sensors.

    ``pressure``: zero of a pressure sensor, of the set supply pressure. ``position``: scale of a
    position sensor. ``flow``: flow of an edge whose law or map states no error, or of a map outside
    of its readings. ``lag``: natural frequency of a valve that states no error. ``alignment``:
    samples by which commands and readings may be apart. ``draws``: repetitions from which the
    effect of the sensors' noise is found."""

    pressure: float = 0.0025
    position: float = 0.002
    flow: float = 0.05
    lag: float = 0.2
    alignment: float = 1.0
    draws: int = 12


@dataclass(frozen=True)
class _Readings:
    """A log in the order of a model's arrays: commands (samples, valves), q, qd (samples, joints),
    x (samples, cylinders), p (samples, 2·cylinders); ``flow_supply`` only where it was measured."""

    t: np.ndarray
    commands: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    x: np.ndarray
    p: np.ndarray
    p_supply: np.ndarray
    p_tank: np.ndarray
    flow_supply: np.ndarray | None


def _read(model: Model, record: Record) -> tuple[_Readings, list[str]]:
    """The readings of a log and a sentence for each that is missing.

    Raises:
        LogError: no pressures, no position or no commands of a cylinder; values that are not
            finite.
    """
    names, plant, notes = model.layout, model.plant, []
    samples, n, nc = record.t.size, len(names.joints), len(names.cylinders)

    def get(channel: str) -> np.ndarray:
        values = np.asarray(record[channel], dtype=float)
        if not np.isfinite(values).all():
            raise LogError(
                f"channel '{channel}' has values that are not finite",
                hint="cut the log to where all were read",
            )
        return values

    commands = model.rest_commands(samples)
    for i, name in enumerate(names.valves):
        if f"{name}.command" in record:
            commands[:, i] = get(f"{name}.command")
        else:
            notes.append(f"no command of {name}: taken to be at rest")
    q, qd, x, p = (np.zeros((samples, many)) for many in (n, n, nc, 2 * nc))
    driven = {int(j): i for i, j in enumerate(plant.cylinders.joint)}
    for j, joint in enumerate(names.joints):
        if j in driven:
            continue
        if f"{joint}.q" in record:
            q[:, j] = get(f"{joint}.q")
            qd[:, j] = (
                get(f"{joint}.qd") if f"{joint}.qd" in record else np.gradient(q[:, j], record.t)
            )
        else:
            notes.append(f"no angle of joint {joint}: taken to stand at zero")
    for i, name in enumerate(names.cylinders):
        row = plant.cylinders[i]
        j = int(row.joint)
        if f"{name}.q" not in record and f"{name}.x" not in record:
            raise LogError(
                f"the log has neither '{name}.q' nor '{name}.x'",
                hint="a ledger needs the position of every cylinder",
            )
        if f"{name}.x" in record:
            x[:, i] = get(f"{name}.x")
        if f"{name}.q" in record:
            q[:, j] = get(f"{name}.q")
        else:
            q[:, j] = joint_of(row, np.clip(x[:, i], 0.0, row.stroke))
        found, lever = linkage_arrays(row, q[:, j])
        if f"{name}.x" not in record:
            x[:, i] = found
        if f"{name}.qd" in record:
            qd[:, j] = get(f"{name}.qd")
        elif f"{name}.v" in record:
            qd[:, j] = get(f"{name}.v") / lever
        else:
            qd[:, j] = np.gradient(q[:, j], record.t)
            notes.append(f"no speed of {name}: taken from its position")
        for side, key in enumerate(("p_head", "p_rod")):
            if f"{name}.{key}" not in record:
                raise LogError(
                    f"the log has no channel '{name}.{key}'",
                    hint="a ledger needs both pressures of every cylinder",
                )
            p[:, 2 * i + side] = get(f"{name}.{key}")
    lines = []
    for channel, usual in (("p_supply", plant.supply.pressure), ("p_tank", plant.tank_pressure)):
        if channel in record:
            lines.append(get(channel))
        else:
            lines.append(np.full(samples, usual))
            notes.append(f"no {channel}: taken from the rig file")
    flow_supply = get("flow_supply") if "flow_supply" in record else None
    if flow_supply is None and plant.supply.flow_limit > 0.0:
        notes.append(
            "no flow of the pump: its energy is that of what the valves draw and the supply line stores"
        )
    return _Readings(
        np.ascontiguousarray(record.t, dtype=float), commands, q, qd, x, p, *lines, flow_supply
    ), notes


class _Account:
    """Energies of readings on a model: what `ledger_of_log` evaluates again for every source of
    doubt.
    """

    def __init__(self, sheet: _Sheet) -> None:
        self.sheet = sheet

    def states(self, model: Model, m: _Readings) -> np.ndarray:
        """States, shape (samples, states), with the openings that follow from the commands."""
        names, n = model.layout, model.plant.at.rates
        states = np.zeros((m.t.size, names.states))
        states[:, :n], states[:, n : 2 * n], states[:, 2 * n : 2 * n + m.p.shape[1]] = (
            m.q,
            m.qd,
            m.p,
        )
        follow_valves(m.t, m.commands, model.plant, False, states)
        states[:, model.plant.at.supply] = m.p_supply
        return states

    def flows(self, model: Model, m: _Readings, states: np.ndarray) -> np.ndarray:
        """Edge flows [m³/s] at the states, shape (samples, edges + 1); the last column is the
        measured flow of the pump, or 0.
        """
        plant = model.plant.at_pressures()
        flows = np.empty((m.t.size, len(model.layout.edges) + 1))
        _flows_at(states, m.commands, m.p_tank, plant, flows)
        flows[:, -1] = 0.0 if m.flow_supply is None else m.flow_supply
        return flows

    def power(
        self, model: Model, m: _Readings, states: np.ndarray, flows: np.ndarray
    ) -> np.ndarray:
        """Powers [W] of the columns, shape (samples, columns)."""
        plant = model.plant.at_pressures()
        power = np.empty((m.t.size, self.sheet.powers))
        _powers_at(states, flows, m.p_tank, plant, self.sheet.owner, power)
        return power

    def energies(
        self,
        model: Model,
        m: _Readings,
        states: np.ndarray,
        power: np.ndarray,
        at: np.ndarray | None = None,
    ) -> np.ndarray:
        """Energies [J] of all rows at the end, shape (rows,); or, cumulated, at the samples ``at``,
        shape (at, rows).
        """
        plant, sheet = model.plant, self.sheet
        at = np.array([m.t.size - 1]) if at is None else at
        dt = np.diff(m.t)
        spent = _cumulated(0.5 * dt, power, at)
        kept = np.concatenate([[0], at])
        held = np.empty((kept.size, sheet.stores))
        _stores_at(states[kept], plant, held)
        held = held[1:] - held[0]
        first = FIRST_EDGE + len(model.layout.edges)
        for c in range(m.x.shape[1]):
            # ∫ P_L dx over the measured stroke: a filtered speed lags behind the pressures
            row = plant.cylinders[c]
            force = m.p[:, 2 * c] * row.area_head - m.p[:, 2 * c + 1] * row.area_rod
            spent[:, first + PER_CYLINDER * c + WORK] = _cumulated(
                0.5 * np.diff(m.x[:, c]), force[:, None], at
            )[:, 0]
        if m.flow_supply is None and plant.supply.flow_limit > 0.0:
            drawn = first + PER_CYLINDER * np.arange(m.x.shape[1])
            volume, bulk = plant.supply.volume, plant.supply.bulk_modulus
            pressed = 0.5 * volume / bulk * (m.p_supply[at] ** 2 - m.p_supply[0] ** 2)
            if plant.supply.gas_volume > 0.0:
                pressed = pressed + held[:, -1]
            spent[:, PUMP] = spent[:, drawn + DRAWN].sum(axis=1) + pressed
            spent[:, COMPRESSION] = (
                spent[:, drawn + DRAWN_COMPRESSION].sum(axis=1) + held[:, SUPPLY_LINE] - pressed
            )
        rows = sheet.expand(np.concatenate([spent, held], axis=1))
        return rows[0] if at.size == 1 else rows

    def __call__(self, model: Model, m: _Readings) -> np.ndarray:
        """Energies [J] of all rows at the end, shape (rows,)."""
        states = self.states(model, m)
        return self.energies(
            model, m, states, self.power(model, m, states, self.flows(model, m, states))
        )


def _cumulated(half: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Trapezoids of columns up to the samples ``at``; ``half`` are half the steps between samples."""
    if at.size == 1:
        upto = int(at[0])
        return (half[:upto] @ values[:upto] + half[:upto] @ values[1 : upto + 1])[None]
    sums = np.zeros(values.shape)
    np.cumsum(half[:, None] * (values[1:] + values[:-1]), axis=0, out=sums[1:])
    return sums[at]


def noise_of(values: np.ndarray) -> float:
    """Standard deviation of a reading's white noise and quantization: from its second differences,
    or from its least step.

    Of the second differences, √6 times as large as the noise, the largest tenth is cut: it may be
    motion."""
    if values.size < 8:
        return 0.0
    bend = np.abs(np.diff(values, 2))
    bend = np.minimum(bend, np.quantile(bend, 0.9))
    steps = np.abs(np.diff(values))
    steps = steps[steps > ROUNDING * max(float(np.abs(values).max()), ROUNDING)]
    least = float(steps.min()) if steps.size else 0.0
    return max(float(bend.mean()) / (CUT_MEAN * math.sqrt(6.0)), least / math.sqrt(12.0))


def ledger_of_log(
    rig: Rig,
    maps: Maps | None,
    record: Record,
    *,
    payload: str | None = None,
    accuracy: Accuracy = Accuracy(),
    points: int = 0,
) -> Ledger:
    """The ledger of a machine's log, from measured channels alone: positions, pressures and
    commands.

    Edge flows are those of the identified maps or laws at the measured drops, at openings that
    follow from the commands by the valve dynamics; friction, damping and leakage are the identified
    model's. What these do not account for is the row ``unexplained``. Every row has a 95 %
    interval, the root of the sum of squares of independent sources of doubt: every rig parameter
    with a standard error; every edge's flow by one error common to all its points (a map's
    ``flow_std``, so an upper bound); valve lag; zeros and scales of sensors; their noise, with the
    bias it makes; alignment of commands and readings; sampling. A parameter that states no error is
    taken as exact, but for edges: ``notes`` says what was taken for those.

    Args:
        rig: identified, without its payload.
        maps: its flow maps by edge name.
        record: ``<cylinder>.q`` or ``.x``, ``.qd`` or ``.v``, ``.p_head``, ``.p_rod``,
            ``<valve>.command``; ``p_supply``, ``p_tank``, ``flow_supply`` where measured.
        payload: of the rig file; by default the one that the log names.
        accuracy: what sensors are good for.
        points: how many times of cumulated energies to keep in ``series``; 0 for none.

    Raises:
        LogError: a channel is missing or not finite.
        InputError: no such payload, or an edge without its map.
    """
    _check(record)
    if payload is None:
        payload = record.meta.get("payload", "none")
    load = None if payload in ("none", "") else payload
    model = Model.of(rig, maps, load)
    readings, notes = _read(model, record)
    sheet = _Sheet(model, "unexplained")
    account = _Account(sheet)
    states = account.states(model, readings)
    flows = account.flows(model, readings, states)
    power = account.power(model, readings, states, flows)
    base = account.energies(model, readings, states, power)
    effects: dict[str, np.ndarray] = {}

    for name, value in rig.parameters().items():
        if value.std:
            shifted = rig.with_values({name: float(value) + value.std})
            effects[name] = account(Model.of(shifted, maps, load), readings) - base
    for e, name in enumerate(model.layout.edges):
        std, said = _flow_std(model, maps, e, states, flows[:, e], readings, accuracy)
        notes += said
        if std.any():
            doubtful = flows.copy()
            doubtful[:, e] += std
            moved = account.power(model, readings, states, doubtful)
            effects[f"flow of {name}"] = account.energies(model, readings, states, moved) - base
    for name, dynamics in rig.dynamics.items():
        omega = f"{name}.natural_frequency"
        stated = [
            v.std
            for v in (dynamics.natural_frequency, dynamics.damping_ratio, dynamics.s1, dynamics.s2)
            if v is not None
        ]
        if not any(stated):
            slower = rig.with_values({omega: float(rig.parameters()[omega]) / (1.0 + accuracy.lag)})
            effects[f"lag of {name}"] = account(Model.of(slower, maps, load), readings) - base
    for name, moved in _doubts(model, readings, accuracy):
        effects[name] = account(model, moved) - base
    if readings.t.size > 4:
        kept = np.unique(np.append(np.arange(0, readings.t.size, 2), readings.t.size - 1))
        coarse = account.energies(model, _at(readings, kept), states[kept], power[kept])
        effects["sampling"] = (coarse - base) / 3.0
    scatter = _noise(account, model, readings, accuracy.draws) - base
    effects["noise of the sensors"] = np.sqrt(
        scatter.var(axis=0, ddof=1) + scatter.mean(axis=0) ** 2
    )
    std = np.sqrt(sum(effect**2 for effect in effects.values()))
    sources = {name: float(abs(effect[-1])) for name, effect in effects.items()}
    sources = dict(sorted(sources.items(), key=lambda item: -item[1]))
    every = np.arange(readings.t.size)
    told = sheet.told(record, account.energies(model, readings, states, power, every), points)
    told |= {"oil_drawn": _oil_drawn(model, readings.t, flows)}
    return sheet.ledger(
        model, record, payload, base, std, sources=sources, notes=tuple(notes), **told
    )


def _at(m: _Readings, kept: np.ndarray) -> _Readings:
    return _Readings(
        **{name: None if value is None else value[kept] for name, value in vars(m).items()}
    )


def _flow_std(
    model: Model,
    maps: Maps | None,
    e: int,
    states: np.ndarray,
    flow: np.ndarray,
    m: _Readings,
    accuracy: Accuracy,
) -> tuple[np.ndarray, list[str]]:
    """(standard error [m³/s] of an edge's flow at every sample, in the direction of the flow; what
    had to be assumed).
    """
    plant, names = model.plant, model.layout
    name = names.edges[e]
    edge = model.rig.all_edges()[name]
    if not flow.any():
        return np.zeros_like(flow), []
    share = accuracy.flow * np.abs(flow)
    row = plant.edges[e]
    if row.law != MAP:
        if edge.gain is not None and edge.gain.std:
            return np.zeros_like(flow), []
        said = f"the law of {name} states no error: its flow is taken to be good to {100 * accuracy.flow:g} %"
        return share * np.sign(flow), [said]
    one = map_of(maps, name)
    valve = int(row.valve)
    opening = row.sign * opening_of(plant, valve, m.commands[:, valve], states)

    def pressure(node: int) -> np.ndarray:
        return m.p_supply if node == 0 else (m.p_tank if node == TANK else m.p[:, node - 2])

    drop = pressure(int(row.from_node)) - pressure(int(row.to_node))
    std = np.where(flow == 0.0, 0.0, one.flow_std(drop, opening))
    outside = (flow != 0.0) & ~one.inside(drop, opening)
    std = np.where(outside, np.maximum(std, share), std)
    passed = np.abs(flow).sum()
    if np.abs(flow[outside]).sum() > 0.01 * passed:
        said = f"{100 * np.abs(flow[outside]).sum() / passed:.0f} % of the oil through {name} went outside of its map's readings"
        return std * np.sign(flow), [f"{said}: taken to be good to {100 * accuracy.flow:g} % there"]
    return std * np.sign(flow), []


def _doubts(model: Model, m: _Readings, accuracy: Accuracy) -> Iterator[tuple[str, _Readings]]:
    """Readings moved by one standard error of each sensor, and of the alignment of commands with
    them.
    """
    zero = accuracy.pressure * model.plant.supply.pressure
    for i, name in enumerate(model.layout.cylinders):
        for side, key in enumerate(("p_head", "p_rod")):
            p = m.p.copy()
            p[:, 2 * i + side] += zero
            yield f"zero of {name}.{key}", replace(m, p=p)
        x, q, qd, j = m.x.copy(), m.q.copy(), m.qd.copy(), int(model.plant.cylinders[i].joint)
        x[:, i] += accuracy.position * (x[:, i] - x[0, i])
        q[:, j] += accuracy.position * (q[:, j] - q[0, j])
        qd[:, j] *= 1.0 + accuracy.position
        yield f"scale of {name}.x", replace(m, x=x, q=q, qd=qd)
    yield "zero of p_supply", replace(m, p_supply=m.p_supply + zero)
    yield "zero of p_tank", replace(m, p_tank=m.p_tank + zero)
    if m.flow_supply is not None:
        yield "scale of flow_supply", replace(m, flow_supply=m.flow_supply * (1.0 + accuracy.flow))
    if accuracy.alignment:
        earlier = m.t - accuracy.alignment * float(np.median(np.diff(m.t)))
        late = np.stack([np.interp(earlier, m.t, column) for column in m.commands.T], axis=1)
        yield "alignment of the commands", replace(m, commands=late)


def _noise(account: _Account, model: Model, m: _Readings, draws: int) -> np.ndarray:
    """Energies of readings that carry their own noise once more, shape (draws, rows); the same
    draws every time.
    """
    rng = np.random.default_rng(0)
    names = ("q", "qd", "x", "p", "p_supply", "p_tank")
    sizes = {name: np.apply_along_axis(noise_of, 0, getattr(m, name)) for name in names}

    def drawn() -> _Readings:
        values = {name: getattr(m, name) for name in names}
        return replace(
            m,
            **{
                name: value + sizes[name] * rng.standard_normal(value.shape)
                for name, value in values.items()
            },
        )

    return np.stack([account(model, drawn()) for _ in range(max(draws, 2))])


# --- against what is possible
# ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Beyond:
    """What a cylinder drew beyond its bound while one working function was at work [J].

    ``drawn`` is Ps·Q drawn, ``bound`` what the bound pays for the way [m] made meanwhile, out
    positive; ``compression`` is ``Ps Σ ∫ V/β dp`` of both chambers: the part of what was drawn that
    pressed their oil together, negative where it expanded."""

    function: str
    way: float
    drawn: float
    bound: float
    compression: float


@dataclass(frozen=True)
class Bounds:
    """What a constant-pressure supply pays for the motion of one cylinder, against what was drawn
    (SPEC 4), all [J].

    ``standard``: a four-way valve draws A1 for every metre out and A2 for every metre in. ``six``:
    lifting as before, lowering with regeneration. ``seventh``: lifting with regeneration as well,
    None where the supply cannot carry the load on the area difference, or where the load hangs on
    the rod end. ``work``: lifting itself, ``∫ P_L v dt`` where positive. ``used`` is Ps·Q drawn,
    None where nothing says it; ``saving`` its share below ``standard``. ``carries`` is the chamber
    that holds the load, or none; ``closed`` says whether the motion ended where it began: only then
    do the bounds mean a cycle. ``against`` names the least bound that the working functions at work
    can reach, ``beyond`` what was drawn on top of it by each; empty and () where no controller
    logged its functions. A supply of constant pressure is paid for volume: load, friction and a low
    pressure on the off-side say where energy is lost, compression and oil let to tank say how much
    is drawn."""

    cylinder: str
    travel_out: float
    travel_in: float
    closed: bool
    carries: str
    standard: float
    six: float
    seventh: float | None
    work: float
    used: float | None
    saving: float | None
    against: str = ""
    beyond: tuple[Beyond, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain values for a JSON file."""
        return asdict(self)


def travels(x: np.ndarray, least: float) -> tuple[float, float]:
    """(way out, way in) [m] of a stroke, counted between turning points at least ``least`` [m]
    apart, so that noise is no way.
    """
    anchor, extreme, going = float(x[0]), float(x[0]), 0
    ways = [0.0, 0.0]
    for value in x:
        value = float(value)
        if going == 0:
            going = 1 if value - anchor > least else (-1 if anchor - value > least else 0)
            extreme = value
        elif going * (value - extreme) > 0.0:
            extreme = value
        elif going * (extreme - value) > least:
            ways[0 if going > 0 else 1] += abs(extreme - anchor)
            anchor, extreme, going = extreme, value, -going
    if going:
        ways[0 if going > 0 else 1] += abs(extreme - anchor)
    return ways[0], ways[1]


def bounds(rig: Rig, record: Record, cylinder: str, ledger: Ledger | None = None) -> Bounds:
    """What a record's motion of one cylinder must cost on a constant-pressure supply, and what it
    did cost.

    With Ps the set pressure, L+ and L− the ways out and in: standard ``Ps (A1 L+ + A2 L−)``. A load
    that the head end carries: six ``Ps A1 L+``, seventh ``Ps (A1 − A2) L+``. One that hangs on the
    rod end: six ``Ps (A2 L− + (A1 − A2) L+)``. No load: six as standard, seventh ``Ps ((A1 − A2) L+
    + A2 L−)``. For a cycle of stroke Δx with the load on the head end these are SPEC 4's ``Ps (A1 +
    A2) Δx``, ``Ps A1 Δx``, ``Ps (A1 − A2) Δx``.

    Args:
        rig: gives areas, pins and set pressure.
        record: with ``.p_head``, ``.p_rod`` and ``.x`` or ``.q`` of the cylinder.
        cylinder: its name.
        ledger: of the same record, for the energy drawn; without it the record's own edge flows say
            it, if it has them.

    Raises:
        InputError: no such cylinder.
        LogError: a channel is missing.
        InsufficientData: the cylinder did not move.
    """
    item = rig.cylinder_named(cylinder)
    head, rod = item.areas()
    if f"{cylinder}.x" in record:
        x = record[f"{cylinder}.x"]
    elif item.pins is None:
        x = record[f"{cylinder}.q"]
    else:
        pins = item.pins
        numbers = (
            float(pins.l_a),
            float(pins.l_b),
            pins.sign,
            float(pins.phase),
            float(pins.retracted_length),
        )
        x = np.array([linkage(PINS, *numbers, angle)[0] for angle in record[f"{cylinder}.q"]])
    force = record[f"{cylinder}.p_head"] * head - record[f"{cylinder}.p_rod"] * rod
    out, back = travels(x, SETTLED_TRAVEL * float(item.stroke))
    if out + back == 0.0:
        raise InsufficientData(f"cylinder '{cylinder}' did not move, so nothing bounds its energy")
    steps, middle = np.diff(x), 0.5 * (force[1:] + force[:-1])
    mean = float(np.trapezoid(force, record.t) / (record.t[-1] - record.t[0]))
    work = float((middle * steps)[middle * steps > 0.0].sum())
    pressure = float(rig.supply.pressure)
    lifting = force[:-1][steps > 0.0]
    regenerates = (
        head > rod and lifting.size > 0 and float(np.median(lifting)) < pressure * (head - rod)
    )
    carries = (
        "head"
        if mean > LOADED * pressure * head
        else "rod"
        if mean < -LOADED * pressure * head
        else "none"
    )
    prices = {
        "standard": (head, rod),
        "six": {"head": (head, 0.0), "rod": (head - rod, rod), "none": (head, rod)}[carries],
    }
    if regenerates and carries != "rod":
        prices["seventh"] = (head - rod, 0.0 if carries == "head" else rod)
    paid = {name: pressure * (a * out + b * back) for name, (a, b) in prices.items()}
    used = (
        ledger[f"{cylinder}.drawn"].energy if ledger is not None else _drawn(rig, record, cylinder)
    )
    closed = abs(out - back) <= CLOSED * max(out, back)
    saving = None if used is None else 1.0 - used / paid["standard"]
    against, beyond = "", ()
    if ledger is not None and (function := _function(record, cylinder)) is not None:
        at_work = {FUNCTIONS[f] for f in np.unique(function)}
        against = (
            "six"
            if any(name.endswith("overrunning_regeneration") for name in at_work)
            else "standard"
        )
        if "seventh" in paid and FUNCTIONS[EXTEND_RESISTIVE_REGENERATION] in at_work:
            against = "seventh"
        price = tuple(pressure * area for area in prices[against])
        beyond = _beyond(
            rig, record, item, x, function, price, (out, back), ledger.functions[cylinder]
        )
    return Bounds(
        cylinder,
        out,
        back,
        closed,
        carries,
        paid["standard"],
        paid["six"],
        paid.get("seventh"),
        work,
        used,
        saving,
        against,
        beyond,
    )


def _beyond(
    rig: Rig,
    record: Record,
    item: Cylinder,
    x: np.ndarray,
    function: np.ndarray,
    price: tuple[float, float],
    ways: tuple[float, float],
    drawn: dict[str, dict[str, float]],
) -> tuple[Beyond, ...]:
    """What each working function drew against its share of the way out and in, ``ways`` [m], at
    ``price`` [J/m] each.
    """
    areas, dead = item.areas(), (float(item.volume_head), float(item.volume_rod))
    bulk = float(item.bulk_modulus or rig.oil.bulk_modulus)
    squeezed = np.zeros(x.size - 1)
    for key, area, volume, sign in zip(("p_head", "p_rod"), areas, dead, (1.0, -1.0), strict=True):
        held = volume + sign * area * x
        squeezed += 0.5 * (held[1:] + held[:-1]) * np.diff(record[f"{item.name}.{key}"]) / bulk
    turns = np.flatnonzero(np.diff(function, prepend=-1))
    net, whose = np.add.reduceat(np.diff(x), turns), function[turns]
    shares = []
    for sign, way in zip((1.0, -1.0), ways, strict=True):
        made = np.maximum(sign * net, 0.0)
        shares.append(made * (way / made.sum() if made.sum() > 0.0 else 0.0))
    found = []
    for f in np.unique(function):
        out, back = (float(share[whose == f].sum()) for share in shares)
        energy = drawn[FUNCTIONS[f]].get(f"{item.name}.drawn", 0.0)
        pressed = float(rig.supply.pressure) * float(squeezed[function == f].sum())
        found.append(
            Beyond(FUNCTIONS[f], out - back, energy, price[0] * out + price[1] * back, pressed)
        )
    return tuple(found)


def _drawn(rig: Rig, record: Record, cylinder: str) -> float | None:
    """``∫ Ps Q dt`` [J] of a cylinder's edges from the supply, None where the record has not all
    their flows.
    """
    total = 0.0
    for name, edge in rig.all_edges().items():
        if name.split(".")[0] != cylinder or "supply" not in (edge.from_, edge.to):
            continue
        channel = f"{name}.flow"
        if channel not in record or "p_supply" not in record:
            return None
        sign = 1.0 if edge.from_ == "supply" else -1.0
        total += sign * float(np.trapezoid(record["p_supply"] * record[channel], record.t))
    return total
