"""Racks and rotary actuators: a constant lever, held against a slide of the mass that it feels."""

import math
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import identify_hydraulics
from ehbench.ledger import ledger_of_model
from ehbench.physics.cylinder import RACK, joint_angle, joint_range, linkage
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.plausibility import off_pins
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, shipped

SLIDE = (RIGS / "slide_servo.toml").read_text()
RADIUS, INERTIA, DAMPING = 0.125, 250.0 * 0.125**2, 800.0 * 0.125**2
JOINT = f"""[mechanism]
kind = "chain"
first_axis = "vertical"

[[mechanism.joint]]
name = "carriage"
dh_a = "0 m"
mass = "1 kg"
com = ["0 m", "0 m", "0 m"]
inertia = ["2 kg*m^2", "2 kg*m^2", "{INERTIA} kg*m^2", "0 kg*m^2", "0 kg*m^2", "0 kg*m^2"]
joint_damping = {{ value = "{DAMPING} N*m*s/rad", upper = "400 N*m*s/rad" }}

"""
PINION = """[cylinder.rack]
radius = "125 mm"
sign = {sign}
retracted_angle = "30 deg"

"""
T = np.arange(1201) * 1e-3
COMMAND = 3.0 * (((T > 0.1) & (T < 0.5)) * 1.0 - ((T > 0.7) & (T < 1.0)) * 1.0)


def text_of(sign: int = 1) -> str:
    """The shipped slide with its mass turned on a rack of 125 mm."""
    start, valve = SLIDE.index("[mechanism]"), SLIDE.index("[[cylinder.valve]]")
    body = SLIDE[SLIDE.index("[[cylinder]]") : valve]
    return SLIDE[:start] + JOINT + body + PINION.format(sign=sign) + SLIDE[valve:]


def turned(tmp_path: Path, sign: int = 1) -> Rig:
    path = tmp_path / "rack.toml"
    path.write_text(text_of(sign))
    return load_rig(path)


def run(rig: Rig) -> Record:
    return simulate(rig, {"press.servo": COMMAND}, 1.2, posture={"press": "150 mm"})


@pytest.mark.parametrize("sign", [1, -1])
def test_a_rack_on_its_pinion_is_a_slide_of_the_mass_it_feels(sign, tmp_path):
    """``m = I/r²`` and ``b = B/r²``: the same strokes and pressures, the angle by the radius."""
    rack, slide = run(turned(tmp_path, sign)), run(shipped("slide_servo"))
    for word in ("x", "v", "p_head", "p_rod"):
        one, other = rack[f"press.{word}"], slide[f"press.{word}"]
        assert np.abs(one - other).max() < 1e-6 * np.ptp(other), word
    angle = math.radians(30.0) + sign * rack["press.x"] / RADIUS
    assert rack["press.q"] == pytest.approx(angle, abs=1e-12)


def test_a_rack_is_its_inverse_and_its_energy_sum_closes(tmp_path):
    pins = (RACK, 0.125, 0.0, -1, 0.0, 0.4)
    q = joint_angle(*pins, np.array([0.0, 0.1, 0.3]))
    for angle, x in zip(q, (0.0, 0.1, 0.3), strict=True):
        assert linkage(*pins, angle) == pytest.approx((x, -0.125, 0.0), abs=1e-15)
    assert joint_range(*pins, 0.3) == pytest.approx((0.4, 0.4 - 0.3 / 0.125))
    rig = turned(tmp_path)
    ledger = ledger_of_model(Model.of(rig), run(rig))
    work = abs(ledger["press.servo_supply_head.throttling"].energy)
    assert work > 10.0 and abs(ledger.residual.energy) < 1e-6 * work


def test_logs_of_its_angle_tell_the_oil(tmp_path):
    true, rng = turned(tmp_path).with_values({"bulk_modulus": 7.0e8}), np.random.default_rng(3)
    made, noise = run(true), {"q": 2e-4, "qd": 1e-3, "p_head": 1e4, "p_rod": 1e4, "command": 0.0}
    own = {
        name: y + noise[word] * rng.normal(size=y.size)
        for name, y in made.channels.items()
        if (word := name.rpartition(".")[2]) in noise
    }
    log = Record(made.t, own, {})
    wanted = {"bulk_modulus": 7.0e8, "carriage.joint_damping": DAMPING}
    fit = identify_hydraulics(turned(tmp_path), [("a", log)], list(wanted))
    for name, truth in wanted.items():
        low, high = fit[name].interval or (0.0, 0.0)
        assert abs(fit[name].value - truth) < 1.5 * (high - low) / 2, name
    shifted = Record(made.t, own | {"press.x": made["press.x"] + 0.01}, {})
    assert off_pins(shifted, Model.of(true)) == {"press": pytest.approx(0.01, abs=1e-4)}


def test_a_cylinder_has_one_linkage(tmp_path):
    pins = '[cylinder.pins]\nl_a = "0.7 m"\nl_b = "0.4 m"\nretracted_length = "0.55 m"\n\n'
    rack = PINION.format(sign=1)
    for text, more, said in (
        (text_of(), pins, "sits on 'pins' or drives a 'rack', not both"),
        (SLIDE, rack, "on a slide it has none"),
    ):
        file = tmp_path / "rig.toml"
        file.write_text(text.replace("[[cylinder.valve]]", more + "[[cylinder.valve]]"))
        with pytest.raises(InputError, match=said):
            load_rig(file)
