"""Pump, check valve and accumulator against their closed forms, and in the energy sum."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from ehbench.config.recipe import TrialRecipe, load_recipe
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.ledger import ledger_of_model
from ehbench.machines.virtual import VirtualMachine
from ehbench.parts.accumulator import gas_capacity, gas_energy
from ehbench.parts.edge import CHECK, EDGE, PUMP, edge_command, edge_flow, edge_slope
from ehbench.parts.edge.orifice import root
from ehbench.parts.oil import compressed
from ehbench.parts.supply import RECOVERY_TIME
from ehbench.parts.supply import SUPPLY as LINE
from ehbench.physics.cylinder import ATMOSPHERE
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import supply_off
from ehbench.runtime.compiled import table_of
from ehbench.signals.series import ringing
from ehbench.trial import run_trial
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, refused, shipped

RIG = shipped("pump_cylinder")
MAPS = np.zeros(1)


def trial(rig: Rig, commands: np.ndarray, tick: float = 1e-3, posture: str = "150 mm") -> Record:
    model = Model.of(rig)
    log = model.run(model.trim(model.posture({"lift": posture})), commands[:, None], tick)
    return model.record(np.arange(commands.size) * tick, commands[:, None], log)


def up_and_down(samples: int = 2001) -> np.ndarray:
    u = np.zeros(samples)
    u[100 : samples // 3], u[samples // 2 : 5 * samples // 6] = 3.0, -4.0
    return u


@pytest.fixture(scope="module")
def made() -> Record:
    return trial(RIG, up_and_down())


# --- pump


def pump(**given: float) -> np.record:
    own = {"displacement": 1.3e-6, "speed_gain": 15.0, "slip": 4e-12, "sign": 1.0}
    return table_of([{"law": PUMP, "unmetered": 1} | own | given], EDGE)[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_pump_moves_its_displacement_less_its_slip(sign):
    row = pump(sign=sign, pump_speed=20.0)
    for drop in (-2e7, -1e5, 0.0, 3e6):
        for command in (-8.0, 0.0, 2.5):
            flow = edge_flow(drop, command, row, MAPS)
            speed = 20.0 + 15.0 * sign * command
            assert flow == pytest.approx(1.3e-6 * speed + 4e-12 * drop, rel=1e-14)
            assert edge_command(drop, flow, row, MAPS) == pytest.approx(command, abs=1e-12)
            assert edge_slope(drop, flow, command, row) == 4e-12


def test_a_pump_of_fixed_speed_is_one_at_a_held_command():
    def turned(edges: list[dict], fixed: list[dict]) -> Rig:
        table = RIG.as_toml()
        own = table["cylinder"][0]
        own["valve"][0]["edge"] = edges
        own["edge"] = [*own["edge"], *fixed]
        return Rig.model_validate(table)

    pumping = {"from": "rod", "to": "head", "law": "pump", "displacement": "8 mL/rev"}
    spilling = {"from": "head", "to": "supply", "law": "orifice", "flow_gain": "1 mL/s/V/bar^0.5"}
    driven = turned([pumping | {"name": "pump", "speed_gain": "150 rpm/V"}, spilling], [])
    held = turned([spilling], [pumping | {"name": "pump", "pump_speed": "300 rpm"}])
    models = [Model.of(rig) for rig in (driven, held)]
    states = [model.trim(model.posture({"lift": "150 mm"})) for model in models]
    for model, y in zip(models, states, strict=True):
        y[model.layout.state("opening")] = 2.0
    one, two = (
        model.run(y, np.full((400, 1), 2.0)) for model, y in zip(models, states, strict=True)
    )
    size = states[0].size
    assert np.abs(one[:, :size] - two[:, :size]).max() <= 1e-9 * np.abs(one[:, :size]).max()
    assert one[-1, 0] > one[0, 0] + 5e-3


# --- check valve


def check(**given: float) -> np.record:
    own = {"gain": 1e-7, "cracking_pressure": 3e4, "opening_range": 5e4, "pilot_ratio": 0.0}
    row = {"law": CHECK, "unmetered": 1, "valve": -1, "sign": 1.0}
    return table_of([row | own | given], EDGE)[0]


def test_a_check_valve_is_shut_below_cracking_and_an_orifice_above_its_range():
    row = check()
    for drop in (-3e7, -1.0, 0.0, 2.99e4):
        assert edge_flow(drop, 0.0, row, MAPS) == 0.0
    for drop in (8e4, 1e6, 2e7):
        assert edge_flow(drop, 0.0, row, MAPS) == pytest.approx(1e-7 * root(drop), rel=1e-14)
    assert edge_flow(2e7, 0.0, row, MAPS) == pytest.approx(1e-7 * math.sqrt(2e7), rel=1e-6)
    drops = np.linspace(2e4, 2e5, 20001)
    flows = np.array([edge_flow(drop, 0.0, row, MAPS) for drop in drops])
    steep = np.diff(flows) / np.diff(drops)
    assert (np.diff(flows) >= 0.0).all()
    # continuously differentiable: the slope changes by less than its size over a few points
    assert np.abs(np.diff(steep)).max() < 1e-2 * steep.max()
    passing = np.flatnonzero(flows[1:])
    bound = [edge_slope(drops[i + 1], flows[i + 1], 0.0, row) for i in passing]
    assert (np.array(bound) > 0.99 * steep[passing]).all()


def test_a_pilot_opens_against_the_flow_where_it_overcomes_drop_and_spring():
    """``ratio (p_pilot − p_from) > (p_to − p_from) + cracking``."""
    row = check(pilot_ratio=4.0)
    held = 2e6
    needed = (held + 3e4) / 4.0
    assert edge_flow(-held, 0.999 * needed, row, MAPS) == 0.0
    ajar = edge_flow(-held, needed + 1e3, row, MAPS)
    full = edge_flow(-held, needed + 5e4 / 4.0, row, MAPS)
    assert full == pytest.approx(-1e-7 * root(held), rel=1e-12)
    # 4 kPa beyond the onset of a range of 50 kPa
    assert ajar == pytest.approx(full * 0.08**2 * (3.0 - 2.0 * 0.08), rel=1e-9)


def test_oil_goes_back_through_piloted_valves_only():
    """Lowering, the rod's surplus goes through the valve that the load pilots."""
    u = np.zeros(1201)
    u[100:] = -5.0
    record = trial(RIG, u, posture="300 mm")
    assert record["lift.check_rod.flow"].min() < -2e-5
    assert np.abs(record["lift.check_head.flow"]).max() == 0.0
    table = RIG.as_toml()
    for edge in table["cylinder"][0]["edge"]:
        del edge["pilot"], edge["pilot_ratio"]
    plain = trial(Rig.model_validate(table), u, posture="300 mm")
    assert plain["lift.check_rod.flow"].min() >= 0.0
    assert plain["lift.p_rod"].max() > 5.0 * record["lift.p_rod"].max()


# --- accumulator


def line(**given: float) -> np.record:
    own = {"gas_volume": 1e-3, "precharge": 4e5, "polytropic_exponent": 1.2}
    return table_of([{"volume": 2e-4, "bulk_modulus": 1e9} | own | given], LINE)[0]


@pytest.mark.parametrize("n", [1.0, 1.2, 1.4])
def test_the_gas_follows_its_polytrope(n):
    """``∫ C dp`` is what ``p V^n = const`` lets in; nothing below the precharge."""
    row = line(polytropic_exponent=n)
    for pressure in (4.5e5, 8e5, 3e6):
        taken = quad(lambda p: gas_capacity(p, row), 4e5, pressure, epsabs=0.0, epsrel=1e-12)[0]
        ratio = (4e5 + ATMOSPHERE) / (pressure + ATMOSPHERE)
        assert taken == pytest.approx(1e-3 * (1.0 - ratio ** (1.0 / n)), rel=1e-10)
    assert gas_capacity(3.9e5, row) == 0.0 and gas_energy(3.9e5, row) == 0.0


@pytest.mark.parametrize("n", [1.0, 1.3])
def test_the_energy_of_the_gas_is_its_work(n):
    """``∫ p dV`` of the polytrope less that on the atmosphere; soft oil by quadrature."""
    first, last = 4e5 + ATMOSPHERE, 3e6 + ATMOSPHERE
    gas = 1e-3 * (first / last) ** (1.0 / n)
    work = (
        (last * gas - first * 1e-3) / (n - 1.0) if n > 1.0 else first * 1e-3 * math.log(1e-3 / gas)
    )
    work -= ATMOSPHERE * (1e-3 - gas)
    assert gas_energy(3e6, line(polytropic_exponent=n, bulk_modulus=1e15)) == pytest.approx(
        work, rel=1e-7
    )
    row = line(polytropic_exponent=n, bulk_modulus=3e8)
    whole, _ = quad(
        lambda p: (p + compressed(p, 3e8)) * gas_capacity(p, row), 4e5, 3e6, epsabs=0, epsrel=1e-12
    )
    assert gas_energy(3e6, row) == pytest.approx(whole, rel=1e-12)


def test_a_charge_pump_brings_the_pressure_back():
    """Below its limit the pump closes what is missing with its own time constant, gas or not."""
    rig = RIG.with_values({"supply.flow_limit": 1e-2, "lift.pump.slip": 0.0})
    model = Model.of(rig)
    y = model.trim(model.posture(None))
    y[model.plant.at.supply] -= 2e4  # too little to open a check valve
    log = model.run(y, np.zeros((81, 1)))
    missing = 8e5 - log[:, model.plant.at.supply]
    assert missing[60] == pytest.approx(2e4 * math.exp(-0.06 / RECOVERY_TIME), rel=1e-3)


# --- together


def test_the_energy_sum_closes_with_pump_checks_and_accumulator(made):
    """To rounding: a part of 1e9 of what was lifted and lost is left over."""
    model = Model.of(RIG)
    for step in (5e-4, 1e-4):
        log = model.run(
            model.trim(model.posture({"lift": "150 mm"})), up_and_down()[:, None], 1e-3, step
        )
        record = model.record(made.t, up_and_down()[:, None], log)
        ledger = ledger_of_model(model, record, step=step)
        moved = abs(ledger["potential"].energy) + ledger["lift.pump.slip"].energy
        assert abs(ledger.residual.energy) < 1e-9 * moved
        assert ledger.notes == () and moved > 10.0

    def total(power: np.ndarray) -> float:
        return float(np.trapezoid(power, record.t))

    edge, rise = RIG.all_edges()["lift.pump"], record["lift.p_head"] - record["lift.p_rod"]
    speed = float(edge.speed_gain) * record["lift.drive.opening"]
    shaft = total(float(edge.displacement) * speed * rise)
    assert ledger["lift.pump.shaft"].energy == pytest.approx(shaft, rel=1e-3)
    assert ledger["lift.pump.slip"].energy == pytest.approx(
        total(float(edge.slip) * rise**2), rel=1e-3
    )
    throttled = total((record["p_supply"] - record["lift.p_rod"]) * record["lift.check_rod.flow"])
    assert ledger["lift.check_rod.throttling"].energy == pytest.approx(throttled, rel=1e-2)
    row = model.plant.supply
    gained = gas_energy(record["p_supply"][-1], row) - gas_energy(record["p_supply"][0], row)
    assert ledger["accumulator"].energy == pytest.approx(gained, abs=1e-9)
    assert ledger.pump == ledger["lift.pump.shaft"].energy and ledger["pump"].energy == 0.0


def test_the_virtual_rig_of_a_pump_stays_quiet_and_moves():
    bench = VirtualMachine(RIG, load_recipe(ROOT / "recipes" / "bench" / "pump_cylinder.toml"))
    first = bench.start({"lift": "150 mm"})
    at = bench.channels.index("lift.x")
    for _ in range(300):
        still = bench.tick(np.zeros(1))
    # the slip of its pump lets the load sink by some millimetres a second
    assert -2e-3 < still[at] - first[at] < 0.0
    for _ in range(300):
        moved = bench.tick(np.array([4.0]))
    assert moved[at] > still[at] + 1e-2
    with pytest.raises(InputError, match="'lift.check_rod' of the bench does not meter"):
        bench.static_flow("lift.check_rod", np.zeros(1), np.full(1, 1e5))


@pytest.mark.parametrize("payload", [None, "150 kg"])
def test_trim_is_an_equilibrium_where_nothing_slips(payload):
    """The load stands on the pump, the rod end on the charge line: two seconds later still."""
    model = Model.of(RIG.with_values({"lift.pump.slip": 0.0}), payload=payload)
    for stroke in ("10 mm", "0.2 m", "390 mm"):
        y = model.trim(model.posture({"lift": stroke}))
        log = model.run(y, np.zeros((2001, 1)))
        assert np.abs(log[-1, : y.size] - y).max() < 1e-9 * np.abs(y).max()


def test_checks_that_open_and_shut_within_a_step_are_not_stepped_over():
    """A shaken load turns pressures over in less than a step; a check opens in 1/50 of that."""
    t = np.arange(2001) * 1e-3
    shaken = 3.0 * np.sin(2.0 * math.pi * (0.5 + 3.75 * t) * t)
    model = Model.of(RIG)
    y = model.trim(model.posture({"lift": "200 mm"}))
    found, exact = (model.run(y, shaken[:, None], 1e-3, step) for step in (5e-4, 1e-5))
    names = [model.layout.state(f"p_{side}", 0) for side in ("head", "rod")]
    span = np.ptp(exact[:, names], axis=0).max()
    # a check that opens a step late is off by what its chamber gains in that time, near 1e-2
    assert span > 5e6 and np.abs(found - exact)[:, names].max() < 2e-4 * span


def test_the_head_end_alone_is_the_spring():
    """A pump at rest shuts it in, a check valve ties the rod end: ``ω² = β A1²/(V1 m)``."""
    values = {"lift.pump.slip": 0.0, "table.damping": 0.0, "supply.gas_volume": 1.0}
    model = Model.of(RIG.with_values(values | {"lift.check_rod.orifice_gain": 1e-5}))
    row, y = model.plant.cylinders[0], model.trim(model.posture({"lift": "200 mm"}))
    mass = float(RIG.parameters()["table.mass"])
    volume = row.volume_head + 0.2 * row.area_head
    omega = row.area_head * math.sqrt(row.bulk_modulus / (volume * mass))
    y[1] = 1e-5 * omega
    samples = round(6 * 2 * math.pi / omega / 5e-4)
    speed = model.run(y, np.zeros((samples, 1)), 5e-4)[:, 1]
    found = ringing(5e-4 * np.arange(samples), speed, guess=(0.9 * omega, 0.01), trim=False)
    assert found.ok and found.natural_frequency == pytest.approx(omega, rel=1e-3)


# --- what is not for it


def test_controllers_of_metering_edges_refuse_a_pump():
    with refused("control.pump_edge"):
        circuit_of(Model.of(RIG), 0)
    motion = {"kind": "point_to_point", "waypoints": ["100 mm", "150 mm"], "speed": "50 mm/s"}
    given = {"controller": {"kind": "open_loop"}, "motion": motion}
    recipe = TrialRecipe(stage="trial", rig="pump_cylinder.toml", **given)
    with refused("control.pump_edge"):
        run_trial(RIG, recipe)


# --- where a cylinder rests


@pytest.mark.parametrize("end", ["head", "rod"])
def test_a_check_valve_holds_up_its_own_chamber_alone(end):
    """The chamber that it feeds rests at the supply's pressure, the other where the load has it."""
    both = Model.of(RIG).plant
    tables = RIG.as_toml()
    (own,) = tables["cylinder"]
    own["edge"] = [one for one in own["edge"] if one["to"] == end]
    model = Model.of(Rig.model_validate(tables))
    supply = both.supply.pressure
    for incline in (0.2, -0.5, 1.2):
        rig = Rig.model_validate(tables).with_values({"table.incline": incline})
        model = Model.of(rig)
        y = model.trim(model.posture(None))
        p = {side: y[model.layout.state(f"p_{side}", 0)] for side in ("head", "rod")}
        row = model.plant.cylinders[0]
        load = p["head"] * row.area_head - p["rod"] * row.area_rod
        weight = float(rig.mechanism.mass) * 9.80665 * math.sin(incline)
        assert load == pytest.approx(weight, rel=1e-3)
        assert p[end] >= supply * (1.0 - 1e-12)
        assert min(p.values()) < supply or p[end] == pytest.approx(supply)
    y = Model.of(RIG).trim(Model.of(RIG).posture(None))
    assert min(y[2:4]) >= supply


def test_check_valves_that_stand_open_leave_a_creep_at_rest():
    """It starts where ``Q_head/A1 = Q_out/A2``, so that its pressures stay."""
    tables = RIG.as_toml()
    (own,) = tables["cylinder"]
    small = {"law": "check", "orifice_gain": "0.5 L/min/bar^0.5"}
    own["edge"] = [
        small | {"name": "feed", "from": "supply", "to": "head", "cracking_pressure": "0.5 bar"},
        small | {"name": "out", "from": "rod", "to": "tank", "cracking_pressure": "1 bar"},
    ]
    record = trial(Rig.model_validate(tables).with_values({"table.incline": 0.0}), np.zeros(2))
    row = Model.of(RIG).plant.cylinders[0]
    fed, out = (record[f"lift.{name}.flow"][0] for name in ("feed", "out"))
    assert fed * row.area_rod == pytest.approx(out * row.area_head, rel=1e-9) and fed > 1e-6
    load = record["lift.p_head"][0] * row.area_head - record["lift.p_rod"][0] * row.area_rod
    assert abs(load) < 1e-6 * row.area_head * record["lift.p_head"][0]


@pytest.mark.parametrize("seen", [True, False])
def test_a_log_that_empties_its_accumulator_is_told(seen):
    """Not where the recording drives the model, nor at the precharge itself under noise."""
    precharge, t = float(RIG.supply.accumulator.precharge), np.arange(1001) * 1e-3
    noise = 1e4 * np.random.default_rng(2).standard_normal(t.size)
    full = precharge * np.interp(t, [0.0, 1.0], [2.0, 1.0])
    falls = np.where(t < 0.6, full, 0.2 * precharge)

    def told(pressure: np.ndarray, meta: dict[str, str]) -> list[str]:
        model = Record(t, {"p_supply": pressure}, {})
        log = Record(t, {"p_supply": pressure + noise} if seen else {}, meta)
        # pyrefly: ignore[bad-return]
        return supply_off(log, model, RIG)

    assert told(full, {}) == []
    (only,) = told(falls, {})
    assert only.startswith("the accumulator runs empty at t = 0.6 s")
    assert ('supply = "recorded"' in only) == seen
