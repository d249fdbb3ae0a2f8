"""The ledger of a machine's log, from measured channels alone, and how far it can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.ledger.loads import Loads
from ehbench.ledger.powers import COMPRESSION, OF, PUMP, SUPPLY_LINE, power_at
from ehbench.ledger.quadrature import flows_at, powers_at, stiffness_at
from ehbench.ledger.readings import Readings, noise_of, read_log
from ehbench.ledger.sheet import Ledger, Sheet, must_have_samples, oil_drawn, payload_of
from ehbench.parts.edge import MAP
from ehbench.parts.nodes import SUPPLY, TANK
from ehbench.parts.oil import bulk
from ehbench.plant.build import Maps, map_of
from ehbench.plant.model import Model
from ehbench.plant.valves import follow_friction, follow_parts, follow_valves, opening_of
from ehbench.vocabulary import message
from ehbench.vocabulary.fields import scalars


@dataclass(frozen=True)
class Accuracy:
    """Standard errors that a log and its rig do not state, as shares; the defaults are those of
    ordinary industrial sensors.

    ``pressure``: zero of a pressure sensor, of the set supply pressure. ``position``: scale of a
    position sensor. ``flow``: flow of an edge whose law or map states no error, or of a map outside
    of its readings. ``leakage``: what a shut edge at the supply lets pass, of the pump's largest
    flow. ``lag``: natural frequency of a valve that states no error. ``alignment``:
    samples by which commands and readings may be apart. ``draws``: repetitions from which the
    effect of the sensors' noise is found."""

    pressure: float = 0.0025
    position: float = 0.002
    flow: float = 0.05
    leakage: float = 3.0e-4
    lag: float = 0.2
    alignment: float = 1.0
    draws: int = 12


@dataclass(frozen=True)
class Measured:
    """Readings on a model and what follows from them, evaluated again for every source of doubt:
    edge flows [m³/s], shape (samples, edges + 1), last the pump's measured flow, or 0; powers [W],
    shape (samples, columns)."""

    sheet: Sheet
    loads: Loads
    accuracy: Accuracy
    model: Model
    readings: Readings
    states: np.ndarray
    flows: np.ndarray
    power: np.ndarray

    @staticmethod
    def of(sheet: Sheet, loads: Loads, accuracy: Accuracy, model: Model, m: Readings) -> Measured:
        """With the openings that follow from the commands."""
        names, n = model.layout, model.plant.at.rates
        states = np.zeros((m.t.size, names.states))
        states[:, : 2 * n + m.p.shape[1]] = np.concatenate([m.q, m.qd, m.p], axis=1)
        follow_valves(m.t, m.commands, model.plant, False, states)
        follow_friction(m.t, model.plant, states)
        states[:, model.plant.at.supply] = m.p_supply
        if model.layout.lines or model.layout.mounts or model.layout.sways:
            follow_parts(m.t, m.commands, model.plant, states)
        flows = np.empty((m.t.size, len(names.edges) + 1))
        flows_at(states, m.commands, m.p_tank, model.plant.at_pressures(), flows)
        flows[:, -1] = 0.0 if m.flow_supply is None else m.flow_supply
        power = np.empty((m.t.size, sheet.powers))
        bare = Measured(sheet, loads, accuracy, model, m, states, flows, power)
        return bare.flowing(bare.balanced() if accuracy.flow else flows)

    def doubted(self, model: Model, readings: Readings) -> np.ndarray:
        """Energies [J] of all rows as another model or other readings give them, shape (rows,)."""
        return Measured.of(self.sheet, self.loads, self.accuracy, model, readings).energies()

    def flowing(self, flows: np.ndarray) -> Measured:
        """With other flows."""
        plant, power = self.model.plant.at_pressures(), np.empty_like(self.power)
        m = self.readings
        powers_at(self.states, m.commands, flows, m.p_tank, plant, self.sheet.owner, power)
        return replace(self, flows=flows, power=power)

    def thinned(self, rows: np.ndarray) -> Measured:
        """At some of the samples."""
        given = {n: value[rows] for n, value in vars(self.readings).items() if value is not None}
        given = {"readings": replace(self.readings, **given)}
        given |= {name: getattr(self, name)[rows] for name in ("states", "flows", "power")}
        return replace(self, **given)

    def balanced(self) -> np.ndarray:
        """The flows with a factor for each edge of a chamber by which its oil comes out even: what
        came in is what the piston's way, compression and leakages took.

        Readings of a map go up, a motion goes to and fro, and hysteresis makes 2 % of that, a small
        opening more; ``position`` is an error of the way that the piston went. Factors are 1 ±
        ``flow`` before, cylinders with lines as they are."""
        m, plant, flows = self.readings, self.model.plant, self.flows
        result, dt = flows.copy(), np.diff(m.t)[:, None]
        for c, row in enumerate(plant.cylinders):
            nodes: list[int] = [int(row.node_head), int(row.node_rod)]
            ways = np.array([plant.edges.to_node == i for i in nodes], float)
            ways -= [plant.edges.from_node == i for i in nodes]
            (among,) = np.nonzero(ways.any(axis=0))
            if not among.size:
                continue
            areas = np.array([row.area_head, -row.area_rod])
            p, x = m.p[:, 2 * c : 2 * c + 2], m.x[:, c]
            oil = [row.volume_head, row.volume_rod] + np.outer(x, areas)
            across = row.leakage_internal * (p[:, :1] - p[:, 1:]) * [1.0, -1.0]
            lost = across + [row.leakage_head, row.leakage_rod] * (p - m.p_tank[:, None])
            stiff = stiffness_at(plant.cylinders, c, p)
            pressed = 0.5 * (oil / stiff)[1:] + 0.5 * (oil / stiff)[:-1]
            taken = np.diff(oil, axis=0) + pressed * np.diff(p, axis=0)
            taken += 0.5 * dt * (lost[1:] + lost[:-1])
            moved = 0.5 * dt * (flows[1:, among] + flows[:-1, among])
            brought = np.cumsum(moved[:, None] * ways[:, among], axis=0)  # sample, chamber, edge
            missing = np.cumsum(taken, axis=0) - brought.sum(axis=2)
            whole = np.abs(areas) * (float(np.ptp(x)) or row.stroke) * np.sqrt(len(dt))
            shares = (brought / whole[:, None]).reshape(-1, among.size)
            certain = self.accuracy.position / self.accuracy.flow * np.eye(among.size)
            target = np.append((missing / whole).ravel(), np.zeros(among.size))
            result[:, among] *= 1.0 + np.linalg.lstsq(np.vstack([shares, certain]), target)[0]
        return result

    def energies(self, at: np.ndarray | None = None) -> np.ndarray:
        """Energies [J] of all rows at the end, shape (rows,); or, cumulated, at the samples ``at``,
        shape (at, rows)."""
        model, m, states, sheet = self.model, self.readings, self.states, self.sheet
        plant = model.plant
        at = np.array([m.t.size - 1]) if at is None else at
        dt = np.diff(m.t)
        spent = _cumulated(0.5 * dt, self.power, at)
        changes = [int(np.searchsorted(m.t, when - 1e-9)) for when, _ in self.loads.changes]
        retained = np.unique([0, *changes, *at])
        stored = self.loads.stored(model, m.t[retained], states[retained], self.sheet.stores)
        fixed = stored[np.searchsorted(retained, at)]
        edges, cylinders = len(model.layout.edges), range(m.x.shape[1])
        for c in cylinders:
            # ∫ P_L dx over the measured stroke: a filtered speed lags behind the pressures
            row = plant.cylinders[c]
            force = m.p[:, 2 * c] * row.area_head - m.p[:, 2 * c + 1] * row.area_rod
            x = m.x[:, c] if row.mount_state < 0 else m.x[:, c] + states[:, row.mount_state]
            work = _cumulated(0.5 * np.diff(x), force[:, None], at)
            spent[:, power_at(edges, c, OF.work)] = work[:, 0]
        if m.flow_supply is None and plant.supply.flow_limit > 0.0:
            drawn, compression = (
                spent[:, [power_at(edges, c, which) for c in cylinders]].sum(axis=1)
                for which in (OF.drawn, OF.drawn_compression)
            )
            pressed = _pressed(plant.supply, m.p_supply)[at]
            # the last of the powers are the low rail's, which the line's pump does not give
            railed = spent[:, -2:] if plant.supply.rail > 0.0 else np.zeros((at.size, 2))
            spent[:, PUMP] = drawn - railed[:, 0] + pressed
            if plant.supply.gas_volume > 0.0:
                spent[:, PUMP] += fixed[:, sheet.stores - 1]
            spent[:, COMPRESSION] = compression - railed[:, 1] + fixed[:, SUPPLY_LINE] - pressed
        rows = sheet.expand(np.concatenate([spent, fixed], axis=1))
        return rows[0] if at.size == 1 else rows


def _pressed(supply: np.record, pressure: np.ndarray) -> np.ndarray:
    """``∫ p V/β dp`` [J] of the supply line from the first of its pressures [Pa] to each."""
    if supply.air == 0.0:
        return 0.5 * supply.volume / supply.bulk_modulus * (pressure**2 - pressure[0] ** 2)
    oil = (supply.bulk_modulus, supply.air, supply.polytropic)
    per = supply.volume * pressure / np.array([bulk(p, *oil) for p in pressure])
    steps = 0.5 * (per[1:] + per[:-1]) * np.diff(pressure)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _cumulated(half: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Trapezoids of columns up to the samples ``at``; ``half`` are half the steps between them."""
    if at.size == 1:
        upto = int(at[0])
        return (half[:upto] @ values[:upto] + half[:upto] @ values[1 : upto + 1])[None]
    sums = np.zeros(values.shape)
    np.cumsum(half[:, None] * (values[1:] + values[:-1]), axis=0, out=sums[1:])
    return sums[at]


def ledger_of_log(
    rig: Rig,
    maps: Maps | None,
    record: Record,
    *,
    payload: str | None = None,
    accuracy: Accuracy | None = Accuracy(),
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
        accuracy: what sensors are good for; None where no interval is asked for, which is quicker.

    Raises:
        LogError: a channel is missing or not finite.
        InputError: no such payload, or an edge without its map."""
    must_have_samples(record)
    payload = record.meta.get("payload", "none") if payload is None else payload
    load = None if payload in ("none", "") else payload
    model = Model.of(rig, maps, load)
    readings, notes = read_log(model, record)
    loads = Loads.of(record, load)
    shown = payload_of(record) if loads.changes else payload
    sheet = Sheet(model, "unexplained", bool(loads.changes))
    measured = Measured.of(sheet, loads, accuracy or Accuracy(), model, readings)
    base = measured.energies()
    std, sources = np.zeros_like(base), {}
    if accuracy is not None:
        effects, more = _effects(rig, maps, load, measured, base)
        notes += more
        std = np.sqrt(sum(effect**2 for effect in effects.values()))
        sources = {name: float(abs(effect[-1])) for name, effect in effects.items()}
        sources = dict(sorted(sources.items(), key=lambda item: -item[1]))
    every = np.arange(readings.t.size)
    table = measured.energies(every)
    facts = {"functions": sheet.functions(record, table), "sources": sources, "notes": tuple(notes)}
    drawn = oil_drawn(model, readings.t, measured.flows)
    return sheet.ledger(model, record, shown, base, std, oil_drawn=drawn, **facts)


def _effects(
    rig: Rig, maps: Maps | None, payload: str | None, measured: Measured, base: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """(effect of one standard error of each source on the energies [J], assumptions)."""
    model, readings, accuracy = measured.model, measured.readings, measured.accuracy
    effects: dict[str, np.ndarray] = {}
    lags: dict[str, np.ndarray] = {}

    def effect(name: str, value: float) -> np.ndarray:
        model = Model.of(rig.with_values({name: value}), maps, payload)
        return measured.doubted(model, readings) - base

    parameters = rig.parameters()
    for name, value in parameters.items():
        if value.std:
            effects[name] = effect(name, float(value) + value.std)
    for name, dynamics in rig.dynamics.items():  # of valves that state no error of their lag
        omega = f"{name}.natural_frequency"
        if omega in parameters and not any(value.std for _, value in scalars(dynamics)):
            lags[f"lag of {name}"] = effect(omega, float(parameters[omega]) / (1.0 + accuracy.lag))
    notes: list[str] = []
    for e, name in enumerate(model.layout.edges):
        std, texts = _flow_std(maps, e, measured)
        notes += texts
        row, shut = model.plant.edges[e], measured.flows[:, e] == 0.0
        way = float(row.from_node == SUPPLY) - float(row.to_node == SUPPLY)
        leak = way * accuracy.leakage * model.plant.supply.flow_limit * shut
        for source, more in (("flow", std), ("leakage while shut", leak)):
            if more.any():
                flows = measured.flows.copy()
                flows[:, e] += more
                effects[f"{source} of {name}"] = measured.flowing(flows).energies() - base
    effects |= lags
    for name, moved in _doubts(model, readings, accuracy):
        effects[name] = measured.doubted(model, moved) - base
    if readings.t.size > 4:
        retained = np.unique(np.append(np.arange(0, readings.t.size, 2), readings.t.size - 1))
        effects["sampling"] = (measured.thinned(retained).energies() - base) / 3.0
    scatter = _noise(measured) - base
    for row, bias, energy in zip(measured.sheet.rows, scatter.mean(axis=0), base):
        if row[0].endswith(".damping") and abs(bias) > accuracy.flow * abs(energy) > 0.0:
            notes.append(message("ledger.noisy_speed", row=row[0], share=abs(bias / energy)))
    effects["noise of the sensors"] = np.sqrt(
        scatter.var(axis=0, ddof=1) + scatter.mean(axis=0) ** 2
    )
    return effects, notes


def _flow_std(maps: Maps | None, e: int, measured: Measured) -> tuple[np.ndarray, list[str]]:
    """(standard error [m³/s] of an edge's flow at each sample, along it; assumptions)."""
    model, m, accuracy = measured.model, measured.readings, measured.accuracy
    states, flow = measured.states, measured.flows[:, e]
    plant, name = model.plant, model.layout.edges[e]
    edge = model.rig.all_edges()[name]
    if not flow.any():
        return np.zeros_like(flow), []
    share, fields = accuracy.flow * np.abs(flow), {"edge": name, "share": 100 * accuracy.flow}
    row = plant.edges[e]
    if row.law != MAP:
        if edge.gain is not None and edge.gain.std:
            return np.zeros_like(flow), []
        return share * np.sign(flow), [message("ledger.no_error_stated", **fields)]
    item: Any = map_of(maps, name)
    valve = int(row.valve)
    opening = row.sign * opening_of(plant, valve, m.commands[:, valve], states)

    def pressure(node: int) -> np.ndarray:
        return m.p_tank if node == TANK else states[:, plant.nodes[node].state]

    drop = pressure(int(row.from_node)) - pressure(int(row.to_node))
    std = np.where(flow == 0.0, 0.0, item.flow_std(drop, opening))
    outside = (flow != 0.0) & ~item.inside(drop, opening)
    std = np.where(outside, np.maximum(std, share), std)
    beyond = np.abs(flow[outside]).sum() / np.abs(flow).sum()
    notes: list[str] = []
    if beyond > 0.01:
        notes.append(message("ledger.outside_map", outside=100 * beyond, **fields))
    return std * np.sign(flow), notes


def _doubts(model: Model, m: Readings, accuracy: Accuracy) -> Iterator[tuple[str, Readings]]:
    """Readings moved by a standard error of each sensor, and of the commands' alignment."""
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


def _noise(measured: Measured) -> np.ndarray:
    """Energies with the readings' noise added once more, (draws, rows); the same draws always."""
    m, rng = measured.readings, np.random.default_rng(0)
    names = ("q", "qd", "x", "p", "p_supply", "p_tank")
    sizes = {name: np.apply_along_axis(noise_of, 0, getattr(m, name)) for name in names}

    def drawn() -> Readings:
        values = {name: getattr(m, name) for name in names}
        scattered = {n: v + sizes[n] * rng.standard_normal(v.shape) for n, v in values.items()}
        return replace(m, **scattered)

    draws = range(max(measured.accuracy.draws, 2))
    return np.stack([measured.doubted(measured.model, drawn()) for _ in draws])
