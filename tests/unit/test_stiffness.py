"""Very short steps are reported with the state that asks for them."""

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe, load_recipe, load_rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import prepare_fit, simulator_of
from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model, Start
from ehbench.plant.paced import AUTO
from ehbench.plant.stiffness import stiffness_of
from ehbench.trial import prepare, run
from ehbench.vocabulary.fields import Value
from tests.shared import RIGS, ROOT, judged

SLIDE = load_rig(RIGS / "slide_servo.toml")
SMALL = {"press.volume_head": 2.0e-6, "press.volume_rod": 2.0e-6}
DAMPED = {"carriage.mass": 1.0, "carriage.damping": 2.0e5}
CASES = {
    "shipped": ({}, None, None),
    "small volumes": (SMALL, "press.p_rod", "pressure"),
    "damping on a light load": (DAMPED, "carriage.qd", "motion"),
    "a small supply line": ({"supply.volume": 2.0e-7}, "p_supply", "pressure"),
}


def stepped(values, middle="200 mm"):
    """A model, its state at rest and a step of its valve."""
    model, t = Model.of(SLIDE.with_values(values)), np.arange(0.0, 1.0, 1e-3)
    record = Record(t, {"press.servo.command": np.where(t > 0.1, 5.0, 0.0)})
    return model, Start(model.trim(model.posture({"press": middle}))), record


@pytest.mark.parametrize("case", CASES)
def test_what_is_fast_limits_the_steps(case):
    values, state, _ = CASES[case]
    model, start, record = stepped(values)
    stiff = stiffness_of(model, record, start)
    assert (stiff and stiff.state) == state
    assert stiff is None or (stiff.steps > 2.0e4 and stiff.share > 0.5)


def test_a_light_load_in_its_end_stop_is_named():
    model, start, record = stepped({"carriage.mass": 0.1}, "380 mm")
    stiff = stiffness_of(model, record, start)
    assert stiff is not None and stiff.state == "carriage.qd"


@pytest.mark.parametrize("case", CASES)
def test_a_fit_says_so_of_each_log_with_the_cause(case):
    values, state, kind = CASES[case]
    if values is SMALL:  # no rig file may have volumes that small: oil that is as stiff
        values = {"bulk_modulus": 1.0e12}
    model, start, record = stepped(values)
    replayed = model.replay(record, start=start)
    prepared = prepare_fit(model.rig, [("one", replayed)], ["press.friction_coulomb"])
    simulator = simulator_of(prepared, prepared.logs)
    at = [float(model.rig.parameters()["press.friction_coulomb"])]
    told = list(simulator.short_steps(at, simulator.unshifted()))
    assert len(told) == (state is not None)
    for text in told:
        note = text.fields["note"]
        assert text.fields["log"] == "one" and note.fields["state"] == state
        assert note.fields["cause"].key == f"plant.stiff_{kind}"


def check_notes(warnings, state, kind):
    notes = [text for text in warnings if getattr(text, "key", "") == "plant.short_steps"]
    assert [note.fields["state"] for note in notes] == [state] * (state is not None)
    assert [note.fields["cause"].key for note in notes] == [f"plant.stiff_{kind}"] * len(notes)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["shipped", "a small supply line"])
def test_a_validation_says_so_of_its_log(case):
    values, state, kind = CASES[case]
    model, start, record = stepped(values)
    replayed = model.replay(record, start=start)
    [log] = judged(model.rig, [("one", replayed)]).logs
    check_notes(log.warnings, state, kind)


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize(
    ("case", "on", "step"),
    [
        ("shipped", "model", STEP),
        ("shipped", "bench", STEP),
        ("small volumes", "model", STEP),
        ("shipped", "model", AUTO),
        ("damping on a light load", "model", AUTO),
    ],
)
def test_a_trial_says_so_whose_steps_are_short(case, on, step, fast):
    values, state, kind = CASES[case]
    recipe = load_recipe(ROOT / "recipes/trials/multisine.toml")
    assert isinstance(recipe, TrialRecipe)
    changes = {"on": on, "bench": None, "duration": Value(2.0), "step": step}
    trial = prepare(recipe.model_copy(update=changes), SLIDE.with_values(values))
    check_notes(run(trial, fast=fast).facts.warnings, state, kind)
