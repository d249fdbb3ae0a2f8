"""Laws of friction of a cylinder: their closed forms, in motion on a rig, in the ledger, in the
linear model.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from ehbench.errors import InputError
from ehbench.ledger import ledger_of_log, ledger_of_model
from ehbench.parts.friction import friction_slope, friction_steady
from ehbench.parts.friction.stribeck import SMOOTHING
from ehbench.plant.integrate import rk4
from ehbench.plant.model import Model, simulate
from ehbench.record import Record
from ehbench.recipe import load_rig
from ehbench.recipe.toml import read_toml, validated
from ehbench.rig import Rig
from ehbench.tune.linear import (
    circuit_of,
    development_model,
    equivalent,
    operating_point,
    plant_model,
)

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"
TABLES = {
    "stribeck": {"friction_static": "160 N", "stribeck_speed": "20 mm/s"},
}
VISCOUS, COULOMB, STATIC, DIP = 300.0, 80.0, 160.0, 0.02


def rig_with(law: str, name: str = "slide_servo", **more) -> Rig:
    """A shipped rig with a law of friction in each cylinder."""
    plain = load_rig(RIGS / f"{name}.toml").as_toml()
    for cylinder in plain["cylinder"]:
        cylinder |= {"friction_viscous": "300 N*s/m", "friction_coulomb": "80 N"}
        cylinder["friction"] = {"law": law} | TABLES[law] | more
    return Rig.model_validate(plain)


def to_and_fro(rig: Rig, seconds: float = 1.2, volts: float = 0.4) -> Record:
    t = np.arange(round(1000 * seconds) + 1) * 1e-3
    u = volts * np.sin(2 * np.pi * t / 0.6)
    return simulate(rig, {"press.servo": u}, seconds)


def steady(v: float) -> float:
    """Stribeck's curve of the tables, not smoothed."""
    dip = (STATIC - COULOMB) * math.exp(-((v / DIP) ** 2))
    return math.copysign(COULOMB + dip, v) + VISCOUS * v


def test_stribeck_is_the_curve_beyond_its_smoothing():
    row = Model.of(rig_with("stribeck")).plant.cylinders[0]
    for v in (-0.3, -0.02, 0.008, 0.05):
        turned = math.tanh(abs(v) / SMOOTHING)
        bare = steady(v) - VISCOUS * v
        assert friction_steady(row, v) == pytest.approx(bare * turned + VISCOUS * v, rel=1e-12)
    assert friction_steady(row, 0.0) == 0.0


@pytest.mark.parametrize("law", TABLES)
def test_the_slope_is_that_of_the_curve(law):
    row = Model.of(rig_with(law)).plant.cylinders[0]
    for v in (-0.1, 0.008, 0.02, 0.3):
        rise = (friction_steady(row, v * 1.001) - friction_steady(row, v / 1.001)) / (
            v * 1.001 - v / 1.001
        )
        assert friction_slope(row, v) == pytest.approx(rise, rel=1e-4)


@pytest.mark.parametrize("law", TABLES)
@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional"])
def test_the_ledger_closes(law, name):
    """To what RK4 leaves over, and friction only takes."""
    model = Model.of(rig_with(law, name))
    valve, n = model.layout.valves[0], 1001
    t = np.arange(n) * 1e-3
    volts = {"slide_servo": 0.8, "crane_proportional": 5.0}[name]
    table = model.rest_commands(n)
    table[:, model.layout.valves.index(valve)] = volts * np.sin(2 * np.pi * t / 0.5)
    log = model.run(model.trim(model.posture(None)), table)
    made = model.record(t, table, log)
    ledger = ledger_of_model(model, made, points=100)
    for row in ledger.rows:
        if row.group in ("part", "residual"):
            assert abs(row.energy) < 1e-5 * ledger.pump, row
    cylinder = model.layout.cylinders[0]
    taken = ledger.series[f"{cylinder}.friction"]
    assert taken[-1] > 1e-3 * ledger.pump
    assert (np.diff(taken) >= -1e-9 * taken[-1]).all()
    samples = ledger_of_model(model, made, "samples")
    assert samples[f"{cylinder}.friction"].energy == pytest.approx(taken[-1], rel=0.02)


@pytest.mark.parametrize("law", TABLES)
def test_the_ledger_of_a_log_counts_it_too(law):
    """From what sensors tell: the rows of friction are those of the model to 3 %."""
    rig = rig_with(law)
    made = to_and_fro(rig)
    words = ("q", "qd", "x", "v", "p_head", "p_rod", "p_supply", "p_tank", "command")
    seen = {n: v for n, v in made.channels.items() if n.rsplit(".", 1)[-1] in words}
    whole = ledger_of_model(Model.of(rig), made)
    ledger = ledger_of_log(rig, None, Record(made.t, seen, made.meta))
    assert ledger["press.friction"].energy == pytest.approx(
        whole["press.friction"].energy, rel=0.03
    )


@pytest.mark.parametrize("law", TABLES)
def test_the_integrator_keeps_its_order(law):
    """Fourth order within 0.3 on a motion that does not turn round, substeps taken by the guard
    among them.
    """
    model = Model.of(rig_with(law))
    start = model.trim(model.posture(None))
    command, work = np.array([2.0]), np.empty(model.plant.at.work)
    k = np.empty((5, model.layout.states))
    for _ in range(400):  # under way
        rk4(start, command, model.plant, 5e-4, k, work)
    ends = []
    for steps in (50, 100, 800):
        y = start.copy()
        for _ in range(steps):
            rk4(y, command, model.plant, 0.05 / steps, k, work)
        ends.append(y)
    coarse, fine = (np.abs(y - ends[2])[1] for y in ends[:2])
    assert coarse > 1e-13, "nothing to see the order by"
    assert math.log2(coarse / fine) > 3.7


@pytest.mark.parametrize("law", TABLES)
def test_the_linear_model_has_its_steady_slope(law):
    """Equations and differences of the plant agree; the slope of the curve is in them."""
    model = Model.of(rig_with(law))
    circuit = circuit_of(model, 0)
    here = equivalent(model, 0, np.array([0.2]))
    point = operating_point(
        model, circuit, 1, here, 0, speed=0.03, low_pressure=7e5, cross_drop=7e5
    )
    assert point.friction == pytest.approx((steady(0.0301) - steady(0.0299)) / 2e-4, rel=1e-3)
    ours, plant = development_model(model, point), plant_model(model, point)
    assert ours.states == plant.states
    # differences over 1e-5 m/s are good to 1e-4 of a slope that bends within millimetres a second
    assert ours.a[0] == pytest.approx(plant.a[0], rel=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"160 N"', '"60 N"', "friction.friction_static: must not lie below friction_coulomb"),
        ('"160 N"', '"160 N/m"', "friction.friction_static: 'N/m' cannot be turned into N"),
        ('law = "stribeck"', 'law = "stribek"', "is none of 'coulomb_viscous', 'stribeck'"),
        ('law = "stribeck"', "", "'friction.law' is missing"),
        ("stribeck_speed", "stribeck_sped", "'friction.stribeck_sped' (did you mean"),
        ('friction_static = "160 N"\n', "", "'friction.friction_static' is missing"),
    ],
)
def test_a_slip_is_one_sentence_with_its_line(tmp_path, old, new, words):
    text = (RIGS / "slide_servo.toml").read_text()
    table = (
        '\n[cylinder.friction]\nlaw = "stribeck"\n'
        'friction_static = "160 N"\nstribeck_speed = "20 mm/s"\n\n[[cylinder.valve]]'
    )
    text = text.replace("[[cylinder.valve]]", table, 1).replace('"0 N"', '"80 N"')
    path = tmp_path / "rig.toml"
    path.write_text(text)
    assert load_rig(path).cylinder[0].friction.law == "stribeck"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_rig(path)
    assert words in str(caught.value) and "\n" not in str(caught.value)
    there = path.read_text().splitlines()[caught.value.line - 1]
    assert (new or "[cylinder.friction]").split(" ")[0] in there


def test_a_rig_with_it_is_written_and_read_again(tmp_path):
    import tomli_w

    rig = rig_with("stribeck")
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(rig.as_toml()))
    assert validated(Rig, *read_toml(path), path) == rig
    other = rig.with_values({"press.stribeck_speed": 0.03})
    assert float(other.parameters()["press.stribeck_speed"]) == 0.03
