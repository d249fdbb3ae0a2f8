"""A held number that is wrong makes estimates surely wrong: the fit says so, names the number and
what the estimates would be. `python -m tools.studies.held_study` has every held number of every
rig."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ehbench.config.recipe import Sensor, load_rig
from ehbench.data import read
from ehbench.diagnosis import DOMINANT
from ehbench.diagnosis.faults import hypotheses
from ehbench.identification import sensitivity
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.identification.simulator import Effort
from ehbench.report.terminal import answer
from ehbench.validation.results import speaking_against
from tools.power import machine as power
from tools.studies.held_study import FATIGUE, fitted, held_wrong, log_of, off_by, rig_of
from tools.virtual_logs import clean_log, noisy, virtual_log

QUICK: Any = {"kinds": ("chirp",), "seconds": 2.0}
SLIDE = ["bulk_modulus", "carriage.damping", "press.friction_coulomb"]


def machine_of(name, words):
    return next(one.machine for one in held_wrong(name, rig_of(name)) if one.words == words)


def test_a_delay_held_short_is_named_with_what_the_estimates_would_be():
    """1 ms in the file, 2.5 ms in the machine: the damping comes out 25 times too large."""
    rig = rig_of(FATIGUE)
    machine = machine_of(FATIGUE, "valve's delay 1.5 ms short")
    fit = fitted(FATIGUE, rig, machine, **QUICK)
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
    fit = fitted("slide_servo", rig, rig, late=("command", 0.002), **QUICK)
    lean = fit.leans[0]
    assert lean.name == "press.servo.command.delay" and lean.here == 0.0
    assert lean.there == pytest.approx(2e-3, rel=0.05)
    assert lean.remedy.key == "faults.free_sensor"
    assert lean.sentence.key == "identification.time_fixed"


def test_a_delay_that_the_recipe_states_wrongly_is_named():
    """3 ms are stated of a driver that gives commands on 1 ms late: its remedy has what is too
    much, to 0.1 ms."""
    rig = rig_of("slide_servo")
    known = (Sensor(channel="press.servo.command", delay="3 ms"),)
    log = log_of("slide_servo", rig, "chirp", 7, ("command", 0.001), 2.0)
    options = FitOptions(sensors=known, start={"bulk_modulus": 7e8}, workers=1)
    lean = identify_hydraulics(rig, [("chirp", log)], SLIDE, options).leans[0]
    assert lean.name == "press.servo.command.delay" and lean.here == pytest.approx(3e-3)
    assert lean.there == pytest.approx(1e-3, rel=0.1)
    assert lean.sentence.fields["fixed"] == pytest.approx(3.0)
    assert lean.remedy.fields["ms"] == pytest.approx(2.0, abs=0.1)


def test_a_sound_fit_leans_on_nothing():
    rig = rig_of(FATIGUE)
    assert fitted(FATIGUE, rig, rig, **QUICK).leans == ()


def without_law(kind):
    """A slide with a law of friction that its model lacks, and what a fit leans on."""
    rig = rig_of("slide_servo").with_values({"press.friction_coulomb": 200.0})
    log = virtual_log("slide_servo", rig, "steps", 3)
    rows = hypotheses(rig, ["press"], ["press.v"], [log])
    machine = next(row for row in rows if row.kind == kind).rig(rig, 0.02)
    logs = [(kind, virtual_log("slide_servo", machine, kind, 3, 2.6)) for kind in ("steps", "sine")]
    return machine, identify_hydraulics(rig, logs, SLIDE).leans[0]


def test_a_law_of_friction_that_the_rig_file_does_not_have_is_named():
    """The slide takes more force to start than to move: its Coulomb friction, which is fitted,
    comes out too large."""
    machine, lean = without_law("friction law")
    static, coulomb = (
        float(machine.parameters()[f"press.friction_{word}"]) for word in ("static", "coulomb")
    )
    assert lean.name == "press.friction_static" and lean.there == pytest.approx(static, rel=0.1)
    assert lean.sentence.key == "identification.absent_fixed"
    moved = {item.name: item for item in lean.moved}["press.friction_coulomb"]
    assert moved.here > moved.there >= coulomb and moved.halves > 2.0


@pytest.mark.parametrize("speed", [10e-3, 0.4e-3])
def test_the_speed_over_which_friction_turns_round_is_named(speed):
    """The damping comes out wrong without it: it is read from slow motion, too."""
    rig = rig_of("slide_servo")
    machine = rig.with_values({"press.friction_coulomb": 800.0, "press.coulomb_speed": speed})
    lean = of_slide(machine, rig).leans[0]
    assert lean.name == "press.coulomb_speed"
    assert abs(lean.there - speed) < 4.0 * lean.std < speed
    assert lean.moved[0].there == pytest.approx(800.0, rel=0.02) and lean.beyond > 1.0


# a slide whose friction fades from 1.8 times Coulomb's over 20 mm/s, and its commands [V] from [s]
STICKY = power.Machine(
    kind="slide", spools=1, bore=0.06415, rod=0.04244, stroke=0.5295, volume_head=5.377e-4,
    volume_rod=1.3195e-3, bulk_modulus=7.944e8, supply=1.0365e7, tank=2.667e5, mass=315.8,
    damping=1587.4, omega=288.1, zeta=0.914, gain=(5.4e-8, 6.52e-8, 4.38e-8, 1.0135e-7),
    deadband=0.0, leakage_internal=5.9085e-12, coulomb=489.7, static=881.4, stribeck_speed=0.02,
)  # fmt: skip
LEVELS = (
    ((0.164, -2.2), (0.526, 0.71), (0.899, -1.39), (1.174, 2.16), (1.524, 0.0)),
    ((0.179, 2.34), (0.559, -1.23), (0.84, 0.81), (1.219, -2.49), (1.572, 0.0)),
)


@pytest.mark.slow
def test_what_a_missing_law_takes_to_an_end_of_its_range_is_told_beside_the_law(tmp_path):
    """The equations of the power study record it. Without the law the logs deny all of the damping
    but its lower end, where no slope leads away from, and the law alone moves nothing else far."""
    rng, logs = np.random.default_rng(1), []
    for k, levels in enumerate(LEVELS):
        u = np.zeros((2001, 1))
        for start, level in levels:
            u[round(1e3 * start) :] = level
        rod = 0.4 * STICKY.supply
        head = rod * STICKY.areas[1] / STICKY.areas[0]
        test = power.Test(u, np.array([0.45 * STICKY.stroke, 0.0, head, rod, 0.0, 0.0]))
        signals = power.channels(STICKY, power.simulated(STICKY, test))
        noise = {name: power.QUIET[name] * rng.standard_normal(len(u)) for name in signals}
        (tmp_path / f"log{k}.csv").write_text(power.log_text(STICKY, test, signals, noise))
        logs.append((f"log {k}", read(tmp_path / f"log{k}.csv")))
    (tmp_path / "rig.toml").write_text(power.rig_text(replace(STICKY, static=0.0, damping=2857.0)))
    options = FitOptions(
        start={"ram.friction_coulomb": 200.0},
        lower={"carriage.damping": 31.7},
        upper={"carriage.damping": 79000.0, "ram.friction_coulomb": 5000.0},
    )
    names = ["bulk_modulus", "carriage.damping", "ram.friction_coulomb", "ram.leakage_internal"]
    fit = identify_hydraulics(load_rig(tmp_path / "rig.toml"), logs, names, options)
    lean = fit.leans[0]
    assert lean.name == "ram.friction_static" and lean.there == pytest.approx(881.4, rel=0.1)
    moved = {item.name: item for item in lean.moved}
    damping, coulomb = moved["carriage.damping"], moved["ram.friction_coulomb"]
    assert damping.here < 100.0 and damping.halves > 2.0 and coulomb.here > 600.0
    assert damping.there == pytest.approx(1587.4, rel=0.1)
    assert coulomb.there == pytest.approx(489.7, rel=0.05)
    # a model without the law is not accepted plainly for that: it makes most of what is left
    assert lean.explains > DOMINANT and speaking_against(fit.as_json())


def of_slide(machine, rig, payload=None, seconds=2.0, seed=11):
    """A fit to steps of the empty slide and of a loaded or late one; what its checks simulated."""
    logs = []
    for k, load in enumerate((None, payload)):
        simulated = clean_log("slide_servo", machine.with_payload(load), "quick steps", seconds)
        logs.append((f"log {k}", noisy(simulated, seed + k, load)))
    return identify_hydraulics(rig, logs, SLIDE)


def test_a_payload_that_weighs_other_than_written_is_named():
    rig = rig_of("slide_servo")
    name = "100 kg.carriage.mass"
    machine = rig.with_values({name: 1.2 * float(rig.parameters()[name])})
    lean = of_slide(machine, rig, "100 kg", 1.2).leans[0]
    assert lean.name == name and lean.there == pytest.approx(420.0, rel=0.02)
    assert lean.remedy.fields["quoted"] == f'"{name}"'


def test_bristles_that_stick_at_rest_are_named_as_the_law_of_lugre():
    """The machine's friction has a state more than the model's, before the supply's."""
    _, lean = without_law("sticking")
    assert lean.name == "press.friction_static" and lean.explains > 0.7
    assert "lugre" in lean.remedy.fields["lines"]
    assert lean.sentence.key == "identification.absent_fixed"


def test_commands_of_cartridges_that_are_written_late_are_named():
    """All four are written 3 ms after they act: a delay below zero."""
    rig = rig_of("boom_four_valve")
    log = log_of("boom_four_valve", rig, "chirp", 5, ("command", -0.003), 2.0)
    fit = identify_hydraulics(rig, [("log", log)], ["bulk_modulus", "boom.joint_damping"])
    lean = fit.leans[0]
    assert lean.name.endswith(".command.delay") and lean.there == pytest.approx(-0.003, rel=0.2)
    assert lean.remedy.key == "faults.written_late"


def test_fixed_numbers_take_their_share_of_the_simulations_the_least_sure_first(monkeypatch):
    """What a short fit has no simulations left for is listed, and was the surest."""
    efforts, rows = [], []

    def counted():
        efforts.append(Effort())
        return efforts[-1]

    def fixed(fit, state, known=sensitivity._fixed_rows):
        rows.extend(known(fit, state))
        return rows

    few = replace(sensitivity.SETTINGS, quick=0.0, effort=0.05)
    monkeypatch.setattr(sensitivity, "SETTINGS", few)
    monkeypatch.setattr(sensitivity, "Effort", counted)
    monkeypatch.setattr(sensitivity, "_fixed_rows", fixed)
    rig = rig_of("slide_servo")
    fit = of_slide(rig.with_values({"press.bore": 0.0515}), rig)
    assert 8 <= efforts[0].evaluations <= sensitivity.SETTINGS.effort * fit.evaluations + 12
    surest = {row.name: row.certainty for row in rows}
    left = [surest[name] for name in fit.unasked]
    rest = [row.certainty for row in rows if row.name not in fit.unasked and row.numbers]
    assert left and min(left) >= max(rest)


def test_what_the_machine_lacks_is_tried_before_a_datasheet_is_doubted(slide_runs):
    """The virtual bench has the bore of the rig file, and much that the model lacks."""
    (folder,) = slide_runs.glob("hydraulics_*")
    first, second = answer(folder).steps[:2]
    assert first.key == "steps.suggest_first" and first.fields["number"] == "press.bore"
    assert second.key == "steps.free" and second.fields["line"] == '"press.bore"'
