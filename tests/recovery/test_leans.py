"""A held number that is wrong makes estimates surely wrong: the fit says so, names the number and
what the estimates would be. `python -m tools.studies.held_study` has every held number of every
rig."""

import numpy as np
import pytest

from ehbench.diagnosis.faults import hypotheses
from ehbench.identification.covariance import Block, Prior, release_of
from ehbench.identification.hydraulics import identify_hydraulics
from tests.virtual_logs import virtual_log
from tools.studies.held_study import FATIGUE, fitted, held_wrong, off_by, rig_of


def machine_of(name, words):
    return next(one.machine for one in held_wrong(name, rig_of(name)) if one.words == words)


def test_a_delay_held_short_is_named_with_what_the_estimates_would_be():
    """1 ms in the rig file, 2.5 ms in the machine: the damping comes out 25 times too large, far
    beyond its interval. What the fit says is held against the truth.
    """
    rig = rig_of(FATIGUE)
    machine = machine_of(FATIGUE, "valve's delay 1.5 ms short")
    fit = fitted(FATIGUE, rig, machine, kinds=("chirp",))
    halves, share, worst = off_by(fit, rig)[0]
    assert halves > 5.0 and share > 5.0 and worst == "carriage.damping"
    lean = fit.leans[0]
    assert lean.name == "late.delay" and lean.here == pytest.approx(1e-3)
    assert abs(lean.there - 2.5e-3) < 4.0 * lean.std < 1e-4 and lean.explains > 0.5
    would = {one.name: one.there for one in lean.moved}
    assert would["bulk_modulus"] == pytest.approx(9e8, rel=0.01)
    assert would["carriage.damping"] == pytest.approx(800.0, rel=0.1)
    assert lean.beyond > 5.0 and lean.remedy.key == "faults.free"
    assert lean.sentence.key == "identification.number_fixed"
    assert lean.sentence.fields["estimate"] == "carriage.damping"
    assert fit.as_json()["leans"][0]["name"] == "late.delay"


def test_a_delay_that_the_rig_file_does_not_have_is_named():
    """The driver of the slide gives commands on 2 ms late."""
    rig = rig_of("slide_servo")
    fit = fitted("slide_servo", rig, rig, late=("command", 0.002), kinds=("chirp",))
    lean = fit.leans[0]
    assert lean.name == "press.servo.command.delay" and lean.here == 0.0
    assert lean.there == pytest.approx(2e-3, rel=0.05)
    assert lean.remedy.key == "faults.free_sensor"
    assert lean.sentence.key == "identification.time_fixed"


def test_a_sound_fit_leans_on_nothing():
    rig = rig_of(FATIGUE)
    assert fitted(FATIGUE, rig, rig, kinds=("chirp",)).leans == ()


def test_what_others_do_when_a_number_is_freed_is_the_least_squares_of_all():
    """Of a linear model without noise: freed, all come to the truth, and the cost to nothing."""
    rng = np.random.default_rng(3)
    slopes = rng.standard_normal((400, 1, 3))
    truth = np.array([0.3, -0.2, 0.5])
    held = np.linalg.lstsq(slopes[:, 0, :2], slopes[:, 0] @ truth, rcond=None)[0]
    left = slopes[:, :, :2] @ held - slopes @ truth
    block = Block(("a",), slopes, np.zeros((400, 1, 0)), left, np.zeros(0))
    found = release_of([block], Prior(np.zeros(3), np.zeros(3), 1.0), np.inf)
    assert found.move == pytest.approx(0.5) and found.gain == pytest.approx(np.sum(left**2))
    assert found.follow == pytest.approx(truth[:2] - held)


def test_a_law_of_friction_that_the_rig_file_does_not_have_is_named():
    """The slide takes more force to start than to move: its Coulomb friction, which is fitted,
    comes out too large.
    """
    rig = rig_of("slide_servo").with_values({"press.friction_coulomb": 200.0})
    log = virtual_log("slide_servo", rig, "steps", 3)
    rows = hypotheses(rig, ["press"], ["press.v"], [log])
    law = next(row for row in rows if row.kind == "friction law")
    machine = law.rig(rig, 0.02)
    static, coulomb = (
        float(machine.parameters()[f"press.friction_{word}"]) for word in ("static", "coulomb")
    )
    logs = [(kind, virtual_log("slide_servo", machine, kind, 3)) for kind in ("steps", "sine")]
    names = ["bulk_modulus", "carriage.damping", "press.friction_coulomb"]
    fit = identify_hydraulics(rig, logs, names)
    lean = fit.leans[0]
    assert lean.name == "press.friction_static" and lean.there == pytest.approx(static, rel=0.1)
    assert lean.sentence.key == "identification.absent_fixed"
    moved = {item.name: item for item in lean.moved}["press.friction_coulomb"]
    assert moved.here > moved.there >= coulomb and moved.halves > 2.0
