"""Laws of friction: closed forms, in motion, in the ledger, in the linear model."""

import math

import numpy as np
import pytest
from plant_differences import plant_model
from with_parts import closes, point_of, sampled

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.ledger import ledger_of_log, ledger_of_model
from ehbench.parts.friction import (
    friction_force,
    friction_loss,
    friction_rates,
    friction_settle,
    friction_slope,
    friction_steady,
)
from ehbench.plant.integrate import rk4
from ehbench.plant.model import Model, simulate
from ehbench.tune.linear import development_model
from tests.shared import shipped

BREAKS = {"friction_static": "160 N", "stribeck_speed": "20 mm/s"}
BRISTLES = {"bristle_stiffness": "4000 N/mm", "bristle_damping": "2000 N*s/m"}


RETRACTING = {"friction_retracting": "130 N"}
TABLES = {"stribeck": BREAKS, "lugre": BREAKS | BRISTLES, "directional": RETRACTING}
STIFFNESS, DAMPING = 4.0e6, 2.0e3
VISCOUS, COULOMB, STATIC, DIP = 300.0, 80.0, 160.0, 0.02


def rig_with(law: str, turning: str = "", **more) -> Rig:
    """The shipped slide with a law of friction in its cylinder, that turns round over a speed."""
    plain = shipped("slide_servo").as_toml()
    (cylinder,) = plain["cylinder"]
    cylinder |= {"friction_viscous": "300 N*s/m", "friction_coulomb": "80 N"}
    cylinder |= {"coulomb_speed": turning} if turning else {}
    cylinder["friction"] = {"law": law} | TABLES.get(law, {}) | more
    return Rig.model_validate(plain)


def to_and_fro(rig: Rig) -> Record:
    t = np.arange(1201) * 1e-3
    return simulate(rig, {"press.servo": 0.4 * np.sin(2 * np.pi * t / 0.6)}, 1.2)


def steady(v: float) -> float:
    """Stribeck's curve of the tables, not smoothed."""
    dip = (STATIC - COULOMB) * math.exp(-((v / DIP) ** 2))
    return math.copysign(COULOMB + dip, v) + VISCOUS * v


@pytest.mark.parametrize("retracting", [130.0, 0.0])
def test_friction_of_either_direction_is_its_own(retracting):
    table = {"friction_retracting": f"{retracting} N"}
    row = Model.of(rig_with("directional", **table)).plant.cylinders[0]
    for v, coulomb in ((0.05, COULOMB), (-0.05, retracting)):
        assert friction_steady(row, v) == pytest.approx(math.copysign(coulomb, v) + VISCOUS * v)
        assert friction_loss(row, v, np.zeros(0)) == pytest.approx(friction_steady(row, v) * v)
    assert friction_steady(row, 0.0) == 0.0


@pytest.mark.parametrize(("turning", "speed"), [("", 2e-3), ("0.5 mm/s", 5e-4), ("10 mm/s", 0.01)])
def test_laws_turn_round_over_the_speed_of_their_cylinder(turning, speed):
    row = Model.of(rig_with("stribeck", turning)).plant.cylinders[0]
    for v in (-0.3, -0.02, 0.008, 0.05):
        turned = math.tanh(abs(v) / speed)
        bare = steady(v) - VISCOUS * v
        assert friction_steady(row, v) == pytest.approx(bare * turned + VISCOUS * v, rel=1e-12)
    assert friction_steady(row, 0.0) == 0.0
    for law, retracting in (("coulomb_viscous", COULOMB), ("directional", 130.0)):
        row = Model.of(rig_with(law, turning)).plant.cylinders[0]
        for v in (-0.3, -2e-3, 0.0, 1e-9, 0.05):
            rubs = (COULOMB if v >= 0.0 else retracting) * math.tanh(v / speed)
            assert friction_steady(row, v) == pytest.approx(VISCOUS * v + rubs, rel=1e-12)


def test_bristles_bear_the_curve_once_a_speed_has_lasted():
    model = Model.of(rig_with("lugre"))
    row, y = model.plant.cylinders[0], np.zeros(model.layout.states)
    rates = np.full_like(y, np.nan)
    for v in (-0.3, -0.02, 0.001, 0.05):
        friction_settle(row, v, y)
        friction_rates(row, v, y, rates)
        assert friction_force(row, v, y) == pytest.approx(steady(v), rel=1e-12)
        assert friction_steady(row, v) == pytest.approx(steady(v), rel=1e-12)
        assert abs(rates[row.friction_state]) < 1e-12 * abs(v)
        assert friction_loss(row, v, y) == pytest.approx(steady(v) * v, rel=1e-12)


def test_bristles_lose_what_the_rod_gives_and_they_do_not_hold():
    """``F v = loss + d/dt(σ0 z²/2)`` at any bending, and the loss is none where it must not be."""
    model = Model.of(rig_with("lugre"))
    row, y = model.plant.cylinders[0], np.zeros(model.layout.states)
    rates, rng = np.zeros_like(y), np.random.default_rng(0)
    for v, share in zip(rng.uniform(-0.05, 0.05, 50), rng.uniform(-1, 1, 50), strict=True):
        z = y[row.friction_state] = share * COULOMB / STIFFNESS
        friction_rates(row, v, y, rates)
        kept = STIFFNESS * z * rates[row.friction_state]
        lost = friction_loss(row, v, y)
        assert lost + kept == pytest.approx(friction_force(row, v, y) * v, rel=1e-9, abs=1e-12)
        assert lost >= 0.0


def held_by_friction(law: str, degrees: float) -> tuple[float, np.ndarray, np.ndarray]:
    """(force of the tank pressure [N], strokes [m], last states) of a slide on a slope whose oil
    leaks away, so that nothing but friction holds it."""
    plain = rig_with(law).as_toml()
    plain["mechanism"]["incline"] = f"{degrees} deg"
    for cylinder in plain["cylinder"]:
        cylinder |= {f"leakage_{end}": "6000 mL/min/bar" for end in ("head", "rod")}
    model = Model.of(Rig.model_validate(plain))
    y = model.trim(model.posture(None))
    y[model.layout.state("p_head")] = y[model.layout.state("p_rod")] = model.plant.tank_pressure
    area = model.plant.cylinders[0]
    push = model.plant.tank_pressure * (area.area_head - area.area_rod)
    log = model.run(y, model.rest_commands(2001))
    return push, log[:, 0], log[-1]


def test_a_rod_sticks_below_break_away_and_slides_beyond():
    """Under a force below break-away the rod bends the bristles by ``F/σ0`` and stays: no creep."""
    degrees = 1.5
    push, x, last = held_by_friction("lugre", degrees)
    force = push - 250.0 * 9.80665 * math.sin(math.radians(degrees))
    assert 0.5 * COULOMB < abs(force) < 0.95 * STATIC
    assert last[4 + 2] == pytest.approx(force / STIFFNESS, rel=1e-6)  # behind opening and rate
    assert force / STIFFNESS < x[-1] - x[0] < 3 * force / STIFFNESS
    assert abs(x[-1] - x[1000]) < 1e-12
    _, creeping, _ = held_by_friction("stribeck", degrees)
    assert abs(creeping[-1] - creeping[1000]) > 1e-5
    _, x, _ = held_by_friction("lugre", 8.0)
    assert x[-1] - x[0] < -0.02


def test_the_rod_rings_on_its_bristles():
    """Before it slides: ``m ẍ = −σ0 x − (σ1 + viscous + damping) ẋ``, on its oil as well."""
    model = Model.of(rig_with("lugre"))
    layout, row = model.layout, model.plant.cylinders[0]
    y = model.trim(model.posture(None))
    x = y[0]
    y[layout.state("qd")] = 1e-5
    log = model.run(y, model.rest_commands(30), tick=1e-4, step=2e-5)
    volumes = row.volume_head + row.area_head * x, row.volume_rod - row.area_rod * x
    oil = row.bulk_modulus * (row.area_head**2 / volumes[0] + row.area_rod**2 / volumes[1])
    mass, damping = 250.0, DAMPING + VISCOUS + 800.0
    s = damping / (2 * mass)
    w = math.sqrt((STIFFNESS + oil) / mass - s * s)
    t = np.arange(30) * 1e-4
    expected = 1e-5 * np.exp(-s * t) * np.sin(w * t) / w
    # σ1 and the bristles' bending give at 1e-5 m/s by σ0 v/g, a share of 4e-3 over these 3 ms
    assert np.abs(log[:, 0] - x - expected).max() < 5e-3 * np.abs(expected).max()


@pytest.mark.parametrize("law", TABLES)
def test_the_linear_model_has_the_slope_of_the_curve(law):
    row = Model.of(rig_with(law)).plant.cylinders[0]
    for v in (-0.1, 0.008, 0.02, 0.3):
        ends = v / 1.001, v * 1.001
        rise = np.diff([friction_steady(row, end) for end in ends])[0] / np.diff(ends)[0]
        assert friction_slope(row, v) == pytest.approx(rise, rel=1e-4)
    # Equations and differences of the plant agree; the slope of the curve is in them
    model = Model.of(rig_with(law))
    point = point_of(model, low=7e5, cross=7e5, speed=0.03)
    dip = (steady(0.0301) - steady(0.0299)) / 2e-4
    assert point.friction == pytest.approx(VISCOUS if law == "directional" else dip, rel=1e-3)
    ours, plant = development_model(model, point), plant_model(model, point)
    assert ours.states == plant.states
    # differences over 1e-5 m/s are good to 1e-4 of a slope that bends within millimetres a second
    assert ours.a[0] == pytest.approx(plant.a[0], rel=1e-4)


@pytest.mark.parametrize("law", TABLES)
def test_the_ledger_closes_and_that_of_a_log_agrees(law):
    """To what RK4 leaves over, friction only takes; from what sensors tell it is so to 3 %."""
    rig = rig_with(law)
    made, model = to_and_fro(rig), Model.of(rig)
    ledger = ledger_of_model(model, made)
    closes(ledger)
    taken = sampled(model, made)["press.friction"]
    assert taken[-1] > 1e-3 * ledger.pump
    assert (np.diff(taken) >= -1e-9 * taken[-1]).all()
    whole = ledger["press.friction"].energy
    assert whole == pytest.approx(taken[-1], rel=0.02)
    words = ("q", "qd", "x", "v", "p_head", "p_rod", "p_supply", "p_tank", "command")
    seen = {n: v for n, v in made.channels.items() if n.rsplit(".", 1)[-1] in words}
    of_log = ledger_of_log(rig, None, Record(made.t, seen, made.meta))
    assert of_log["press.friction"].energy == pytest.approx(whole, rel=0.03)


@pytest.mark.parametrize("law", TABLES)
def test_the_integrator_keeps_its_order(law):
    """Fourth order within 0.3; with the guard's substeps a coarse step is as good as the finest."""
    model = Model.of(rig_with(law))
    start = model.trim(model.posture(None))
    command, work = np.array([2.0]), np.empty(model.plant.at.work)
    k = np.empty((5, model.layout.states))
    for _ in range(400):  # under way
        rk4(start, command, model.plant, 5e-4, k, work)
    ends = []
    # so fine that the guard takes no substeps
    first = {"stribeck": 50, "lugre": 400, "directional": 50}[law]
    for steps in (first, 2 * first, 16 * first):
        y = start.copy()
        for _ in range(steps):
            rk4(y, command, model.plant, 0.05 / steps, k, work)
        ends.append(y)
    coarse, fine = (np.abs(y - ends[2])[1] for y in ends[:2])
    assert coarse > 1e-13, "nothing to see the order by"
    assert math.log2(coarse / fine) > 3.7
    if law == "lugre":
        y = start.copy()
        taken = [rk4(y, command, model.plant, 1e-3, k, work) for _ in range(50)]
        assert min(taken) > 1 and np.abs(y - ends[2])[1] < 1e-8


def test_a_rig_with_it_is_written_and_read_again():
    rig = rig_with("stribeck")
    assert Rig.model_validate(rig.as_toml()) == rig
    other = rig.with_values({"press.stribeck_speed": 0.03})
    assert float(other.parameters()["press.stribeck_speed"]) == 0.03
