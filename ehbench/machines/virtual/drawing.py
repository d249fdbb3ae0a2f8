"""A virtual bench drawn for a rig: what its bench file says, and plausible numbers for the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from ehbench.config.recipe import BenchRecipe
from ehbench.config.rig import Edge, Rig, Valve
from ehbench.machines.virtual.laws import edge_flow, spool_for
from ehbench.machines.virtual.plant import (
    BENCH_EDGE,
    BENCH_VALVE,
    CURVE,
    FLUID,
    RAW,
    SENSOR,
    VirtualPlant,
    offsets_of,
)
from ehbench.parts.edge import CHECK, PUMP, check, pump
from ehbench.parts.sample import LINE, OF
from ehbench.parts.valve.second_order import SecondOrder, second_order
from ehbench.plant.layout import Layout
from ehbench.plant.model import Model
from ehbench.runtime.compiled import table
from ehbench.vocabulary import VOCABULARY, InputError, message, placed
from ehbench.vocabulary.fields import Value, read_value


class _Given:
    """What a bench file says of one thing: its own entry, else that of ``all``, else a default."""

    def __init__(self, table: Mapping[str, Any], name: str) -> None:
        self.entries = [table[key] for key in (name, "all") if key in table]

    def __call__(self, key: str, default: float) -> float:
        given = (getattr(entry, key) for entry in self.entries)
        return next((float(value) for value in given if value is not None), default)

    def reverse(self) -> _Given:
        result = _Given({}, "")
        result.entries = [entry.reverse for entry in self.entries]
        return result


def _draws(seed: int, name: str) -> np.random.Generator:
    """The generator of one part: its numbers do not depend on what other parts the machine has."""
    return np.random.default_rng([seed, crc32(name.encode())])


def true_rig(recipe: BenchRecipe, rig: Rig) -> Rig:
    """The rig as the bench has it: its own parameters, an analytic law in place of a map."""
    values = {}
    for name, text in recipe.truth.items():
        row = VOCABULARY.get(name.rsplit(".", 1)[-1])
        with placed(recipe.at("truth", name), f"truth.{name}"):
            # of an unknown parameter `with_values` says that there is none
            values[name] = 0.0 if row is None else float(read_value(text, row))
    with placed(recipe.at("truth"), "truth"):
        rig = rig.with_values(values)

    def edge(edge: Edge, valve: Valve) -> Edge:
        if edge.law != "map":
            return edge
        update: dict[str, Any] = {"law": "compensated"}
        if edge.compensated_gain is None and edge.flow_gain is not None:
            update["law"] = "orifice"
        elif edge.compensated_gain is None:
            update["compensated_gain"] = Value(float(rig.supply.flow_limit) / valve.largest)
        return edge.model_copy(update=update)

    return rig.with_valves(
        lambda _, valve: valve.model_copy(
            update={"edge": tuple(edge(item, valve) for item in valve.edge)}
        )
    )


def check_names(recipe: BenchRecipe, names: Layout) -> None:
    for kind, allowed in (
        ("cylinder", names.cylinders),
        ("valve", names.valves),
        ("edge", names.edges),
        ("sensors", (*names.cylinders, "supply")),
    ):
        for name in getattr(recipe, kind):
            if name != "all" and name not in allowed:
                fields = {"kind": kind, "name": name, "known": ", ".join(allowed)}
                text = message("machines.no_part", **fields)
                raise InputError(text, **recipe.at(kind, name))


def _curve(given: _Given, edge: Edge, valve: Valve, rng: np.random.Generator) -> np.record:
    """One direction of an edge. All is drawn, so that giving one value leaves the others."""
    full = valve.largest
    compensated = edge.law in ("compensated", "flow_control")
    low, high = (
        np.array([0.85, 0.03, 0.9, 0.97, 1.4, 1.2, 0.10]),
        np.array([1.1, 0.06, 1.4, 1.03, 2.0, 1.8, 0.18]),
    )
    onset, soft, sat, factor, setting, wide, force = rng.uniform(low, high)
    row = table(1, CURVE)[0]
    dead = valve.onset(edge)
    row.onset = given("onset", onset * dead if dead != 0.0 else 0.1 * soft * full)
    row.softness = given("softness", soft * full if compensated else 0.3 * soft * full)
    usual = sat * full if compensated else 1.6 * sat * full
    if edge.opening_max is not None:
        usual = float(edge.opening_max) - dead
    row.saturation = given("saturation", usual) or math.inf
    assert edge.gain is not None  # `true_rig` sees to it
    gain = float(edge.gain) * given("gain_factor", factor)
    row.gain = gain
    if compensated:
        row.setting = given("compensation_drop", setting * float(edge.compensation_drop))
        row.gain = gain / math.sqrt(row.setting)
        row.wide_open = given("compensator_opening", wide * full)
        row.flow_force = given("flow_force", force / full)
    return row


def _tune(
    valve: Valve, row: np.record, curves: np.recarray, drop: float, width: float
) -> tuple[float, float]:
    """(gain, offset) of a driver turned until the rig file's calibration holds, the command coming
    up from rest.

    With one calibration point only the offset is turned; with more the first and the last hold."""
    drop += float(row.cracking_pressure)  # a valve is calibrated without what stands behind it
    points = sorted(
        (float(read_value(u, VOCABULARY["command"])), float(read_value(q, VOCABULARY["flow"])))
        for u, q in valve.calibration
    )

    def spool(flow: float) -> float:
        maximum = 4.0 * float(valve.command_max)
        if edge_flow(drop, row.sign * maximum, row, curves) < flow:
            raise InputError(message("machines.calibration", valve=valve.name, flow=flow))
        return spool_for(flow, drop, maximum, row, curves)

    ends = [(command - 0.5 * width, spool(flow)) for command, flow in (points[0], points[-1])]
    (u0, s0), (u1, s1) = ends
    gain = (s1 - s0) / (u1 - u0) if u1 > u0 else 1.0
    return gain, s0 - gain * u0


class _Seeded(NamedTuple):
    recipe: BenchRecipe
    model: Model
    seed: int
    p_supply: float


def build(recipe: BenchRecipe, model: Model, tick: float) -> VirtualPlant:
    """The compiled form of a bench whose truth ``model`` is."""
    plant = model.plant
    of = _Seeded(recipe, model, recipe.seed, float(model.rig.supply.pressure))
    edges, curves = _edges(of)
    valves, elements = _valves(of, edges, curves)
    fluid = table(1, FLUID)[0]
    fluid.air, fluid.polytropic = _air(of)
    fluid.droop = 0.03 * of.p_supply if recipe.droop is None else float(recipe.droop)
    fluid.pump_lag = float(recipe.pump_lag)
    relief = math.inf if model.rig.supply.accumulator is not None else 1.15 * of.p_supply
    fluid.supply_relief = relief if recipe.supply_relief is None else float(recipe.supply_relief)
    if fluid.pump_lag > 0.0 and fluid.droop == 0.0:
        raise InputError(message("machines.needs_droop"), **recipe.at("droop"))
    ticks = float(recipe.delay) / tick
    omega, zeta = 2 * math.pi * float(recipe.velocity_cutoff), float(recipe.velocity_damping)
    return VirtualPlant(
        kind=plant.kind,
        gravity=plant.gravity,
        links=plant.links,
        cylinders=_bench_cylinders(of),
        nodes=plant.nodes,
        valves=valves,
        elements=elements,
        edges=edges,
        curves=curves,
        supply=plant.supply,
        forces=plant.forces,
        lines=_lines(of),
        fluid=fluid,
        sensors=_sensors(of),
        delay=math.floor(ticks),
        share=ticks - math.floor(ticks),
        speed=speed_filter(omega, zeta, tick),
        at=offsets_of(model.layout, math.floor(ticks) + 2),
    )


def _bench_cylinders(of: _Seeded) -> np.recarray:
    recipe, p_supply = of.recipe, of.p_supply
    cylinders = of.model.plant.cylinders.copy()
    names, items = of.model.layout.cylinders, of.model.rig.cylinder
    for name, item, row in zip(names, items, cylinders, strict=True):
        given = _Given(recipe.cylinder, name)
        force = p_supply * row.area_head
        rng = _draws(of.seed, name)
        coulomb, static, viscous, speed = rng.uniform(
            [0.004, 1.4, 0.015, 0.006], [0.007, 1.8, 0.03, 0.012]
        )
        plain, damper = float(item.friction_coulomb), float(item.friction_viscous)
        row.friction_coulomb = given("friction_coulomb", plain or coulomb * force)
        row.friction_static = given(
            "friction_static", row.friction_static or static * row.friction_coulomb
        )
        row.friction_viscous = given("friction_viscous", damper or viscous * force)
        row.stribeck_speed = given("stribeck_speed", row.stribeck_speed or speed)
        if row.friction_static < row.friction_coulomb:
            text = message("machines.static_below_coulomb", cylinder=name)
            raise InputError(text, **recipe.at("cylinder", name))
        for key in ("leakage_internal", "leakage_head", "leakage_rod"):
            if f"{name}.{key}" not in recipe.truth and row[key] == 0.0:
                typical = 1e-4 if key == "leakage_internal" else 1e-5
                row[key] = rng.uniform(0.5, 1.5) * typical * row.area_head / p_supply
        if _air(of)[0] > 0.0:
            row.cavitation_pressure = -math.inf  # the air itself keeps a chamber above vacuum
    return cylinders


def _lines(of: _Seeded) -> np.recarray:
    lines = of.model.plant.lines.copy()
    lines.air, lines.polytropic = _air(of)
    if lines.size and _air(of)[0] > 0.0:
        lines.cavitation_pressure = -math.inf
    return lines


def _edges(of: _Seeded) -> tuple[np.recarray, np.recarray]:
    plant, names = of.model.plant, of.model.layout.edges
    edges, curves = table(len(names), BENCH_EDGE), table(2 * len(names), CURVE)
    metering = [(edge, valve) for _, valve, edge in of.model.rig.edges()]
    for index, name in enumerate(names):
        row, modelled, given = edges[index], plant.edges[index], _Given(of.recipe.edge, name)
        for key in ("from_node", "to_node", "valve", "law", "unmetered"):
            row[key] = modelled[key]
        row.forward, row.reverse = 2 * index, 2 * index + 1
        rng, row.sign = _draws(of.seed, name), modelled.sign
        if modelled.law in (PUMP, CHECK):  # like the model's, and none like another
            for key, _ in (*pump.LAW.columns, *check.LAW.columns):
                row[key] = modelled[key]
            size, second = rng.uniform([0.97, 0.7], [1.0, 1.4])
            size = given("gain_factor", size)
            row.displacement *= size
            row.gain *= size
            row.slip = given("null_leakage", second * modelled.slip)
            row.cracking_pressure *= second
            continue
        edge, valve = metering[index]
        full = valve.largest
        row.blocked, row.null_width = edge.reverse == "blocked", 0.05 * full
        row.cracking_pressure = float(edge.cracking_pressure)
        curves[row.forward] = forward = _curve(given, edge, valve, rng)
        curves[row.reverse] = _curve(given.reverse(), edge, valve, rng)
        rated = forward.gain * full * math.sqrt(forward.setting or of.p_supply)
        share = 1e-4 if len(valve.edge) > 1 else 1e-5  # of a spool, of a cartridge
        row.null = given("null_leakage", share * rated / of.p_supply)
    return edges, curves


def _valves(
    of: _Seeded, edges: np.recarray, curves: np.recarray
) -> tuple[np.recarray, np.recarray]:
    recipe, rig = of.recipe, of.model.rig
    modelled = of.model.plant.valves
    valves = table(modelled.shape[0], BENCH_VALVE)
    for name in modelled.dtype.names or ():
        valves[name] = modelled[name]
    elements = of.model.plant.elements.copy()
    for index, (name, (_, valve)) in enumerate(
        zip(of.model.layout.valves, rig.valves(), strict=True)
    ):
        row = valves[index]
        given, rng = _Given(recipe.valve, name), _draws(of.seed, name)
        full = valve.largest
        width, gain, offset, faster, damper = rng.uniform(
            [0.002, 0.97, -0.003, 0.93, 0.9], [0.006, 1.03, 0.003, 1.07, 1.1]
        )
        row.hysteresis = given("hysteresis", width * full)
        if valve.calibration:
            edge: Any = edges[np.flatnonzero(edges.valve == index)[0]]
            drop = float(recipe.calibration_drop)
            gain, offset = _tune(valve, edge, curves, drop, row.hysteresis)
            offset /= full
        row.gain, row.offset = given("driver_gain", gain), given("driver_offset", offset * full)
        series = [element for element in of.model.layout.elements if element.valve == index]
        for at, item in enumerate(series, int(row.first)):
            dynamics = rig.dynamics[item.dynamics]
            if not isinstance(dynamics, SecondOrder):
                continue
            omega, zeta = dynamics.frequency_and_damping()
            omega = given("natural_frequency", faster * omega)
            zeta = given("damping_ratio", damper * zeta)
            for key, value in second_order(omega, zeta).items():
                elements[at][key] = value
    return valves, elements


def _air(of: _Seeded) -> tuple[float, float]:
    """(share of free air, its exponent): the bench file's, else the rig's, else usual ones."""
    recipe, oil = of.recipe, of.model.rig.oil
    share, exponent = (
        getattr(oil, key) if key not in recipe.model_fields_set else None
        for key in ("air_fraction", "polytropic_exponent")
    )
    return float(share or recipe.air_fraction), float(exponent or recipe.polytropic_exponent)


PERFECT = (0.0, 0.0, 0.0, 0.0)  # lag, noise, resolution and zero offset of a perfect sensor


def _sensors(of: _Seeded) -> np.recarray:
    slide = of.model.rig.mechanism.kind == "slide"
    rows: list[tuple[float, ...]] = []
    for name in (*of.model.layout.cylinders, "supply"):
        given, rng = _Given(of.recipe.sensors, name), _draws(of.seed, f"sensors {name}")
        step = given("position_resolution", 2.54e-5)
        position = (0.0, given("position_noise", 0.2 * step), step, 0.0)
        counts = given("encoder_counts", 4096)
        turn = 2 * math.pi / counts if counts else 0.0
        angle = position if slide else (0.0, 0.1 * turn, turn, 0.0)
        resolution = given("pressure_resolution", of.p_supply / 2048)
        lag = given("pressure_lag", 5.3e-5)
        noise = given("pressure_noise", 5e-4 * of.p_supply)
        spread = given("pressure_offset", 1e-3 * of.p_supply)
        zeros = np.clip(rng.standard_normal(2), -2, 2) * spread
        both = [(lag, noise, resolution, float(zero)) for zero in zeros]
        of_cylinder = {OF.q: angle, OF.x: position, OF.p_head: both[0], OF.p_rod: both[1]}
        of_lines = {LINE.p_supply: both[0], LINE.p_tank: both[1]}
        sensors_of, channels = (of_lines, LINE) if name == "supply" else (of_cylinder, RAW)
        rows += [sensors_of.get(channel, PERFECT) for channel in channels]
    sensors = table(len(rows), SENSOR)
    sensors[:] = rows
    return sensors


def speed_filter(omega: float, zeta: float, tick: float) -> np.ndarray:
    """Numbers of `follow`: the 2 × 2 transition over a tick, row by row, the tick [s], the lag 2
    ζ/ω [s]."""
    root = complex(zeta * zeta - 1.0) ** 0.5
    if abs(root) < 1e-6:
        root = complex(1e-6)
    first, second = omega * (-zeta + root), omega * (-zeta - root)
    grow, fall = np.exp(first * tick), np.exp(second * tick)
    rows = [
        first * fall - second * grow,
        grow - fall,
        first * second * (fall - grow),
        first * grow - second * fall,
    ]
    return np.array([*np.real(np.array(rows) / (first - second)), tick, 2 * zeta / omega])
