"""A failed valve is detected by flows and the load moves on; a wrong sensor stops the trial."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ehbench.config.recipe import Fault, MachineChange, Motion, TrialRecipe, load_recipe
from ehbench.config.recipe.trial import Controller, OtherSupply
from ehbench.control.sensor_checks import RESIDUALS, SCORES, Sensors, _score
from ehbench.trial.preparation import prepare
from ehbench.trial.running import run
from ehbench.trial.session import Session
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, shipped

START = 2.0  # s: the boom rises at full speed
HIGH = {"kind": "offset", "value": "400 psi"}
TWO_RAILS = {"low_rail": {"rail_pressure": "500 psi", "rail_margin": "100 psi"}}


def result_of(
    payload: str | None = None, gains=None, hold="1 s", top="200 mm", supply=None, **changes
):
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe)
    motion = Motion.model_validate(
        {
            "kind": "point_to_point",
            "cylinder": "boom",
            "waypoints": ["50 mm", top, "50 mm"],
            "hold": hold,
            "speed": "60 mm/s",
            "acceleration": "0.3 m/s^2",
            "jerk": "6 m/s^3",
        }
    )
    controller = Controller.model_validate({"kind": "arc", "monitor": True, "gains": gains or {}})
    updates = {"motion": motion, "controller": controller, "payload": payload, **changes}
    updates["supply"] = OtherSupply.model_validate(supply or {})
    recipe = loaded.model_copy(update=updates)
    # tick by tick, as with a fault, which ends the same and is one kernel fewer to compile
    return run(prepare(recipe, shipped("thesis_arm")), fast=False).facts


@pytest.mark.parametrize(
    ("valve", "kind", "stays", "within", "largest", "supply"),
    [
        # lowered from 4.7 s on, before which the valve has nothing to do
        ("hect", "stuck_closed", "shut", 3.2, 6e-3, {}),
        ("hepc", "stuck_closed", "shut", 0.15, 20e-3, {}),
        ("hepc", "stuck_closed", "shut", 0.15, 20e-3, TWO_RAILS),
        ("rect", "stuck_closed", "shut", 0.25, 10e-3, {}),
        ("hepc", "stuck_open", "open", 0.25, None, {}),
        ("regen", "stuck_open", "open", 0.2, None, {}),
        ("regen", "stuck_open", "open", 0.2, None, TWO_RAILS),
    ],
)
def test_a_valve_that_fails_is_named_and_the_others_go_on(
    valve, kind, stays, within, largest, supply
):
    """By the true stroke of the virtual bench, whose valves are not the design model's."""
    fault = {"start": f"{START} s", "kind": kind, "target": f"boom.{valve}"}
    facts = result_of("50 lb", supply=supply, fault=(Fault.model_validate(fault),))
    found = facts.measures["valve_fault"]
    assert (found["valve"], found["stays"]) == (f"boom.{valve}", stays)
    assert START < found["t"] < START + within
    assert f"trial.valve_{stays}" in [note.key for note in facts.warnings]
    assert (facts.stop is None) == (largest is not None)
    if largest is not None:
        assert facts.measures["tracking_true"]["max_error"] < largest


@pytest.mark.parametrize(
    ("fault", "channel", "within", "largest", "supply"),
    [
        ({"kind": "stuck", "target": "boom.x"}, "boom.x", 0.2, 5e-3, {}),
        ({"kind": "stuck", "target": "boom.x"}, "boom.x", 0.2, 5e-3, TWO_RAILS),
        ({"kind": "offset", "target": "boom.x", "value": "-8 mm"}, "boom.x", 0.1, 2e-3, {}),
        ({"kind": "drift", "target": "boom.q", "value": "5 deg"}, "boom.x", 0.5, 2e-3, {}),
        ({"kind": "scale", "target": "boom.x", "value": "1.08"}, "boom.x", 0.1, 2e-3, {}),
        (
            {"kind": "offset", "target": "boom.p_head", "value": "400 psi"},
            "boom.p_head",
            0.1,
            9e-3,
            {},
        ),
        ({"kind": "zero", "target": "boom.p_head"}, "boom.p_head", 0.1, 9e-3, {}),
        (
            {"kind": "offset", "target": "boom.p_rod", "value": "400 psi"},
            "boom.p_rod",
            0.1,
            9e-3,
            {},
        ),
        ({"kind": "stuck", "target": "boom.p_rod"}, "boom.p_rod", 2.5, 9e-3, {}),
        ({"kind": "stuck", "target": "boom.p_rod"}, "boom.p_rod", 2.5, 9e-3, TWO_RAILS),
        ({"kind": "scale", "target": "p_supply", "value": "0.6"}, "p_supply", 0.3, 2e-3, {}),
        ({"kind": "scale", "target": "p_supply", "value": "0.6"}, "p_supply", 0.3, 2e-3, TWO_RAILS),
        ({"kind": "offset", "target": "p_tank", "value": "300 psi"}, "p_tank", 0.3, 2e-3, {}),
    ],
    ids=str,
)
def test_a_wrong_sensor_stops_the_trial_and_is_named(fault, channel, within, largest, supply):
    given = Fault.model_validate({"start": f"{START} s", **fault})
    facts = result_of("50 lb", supply=supply, fault=(given,))
    assert (facts.stop.limit, facts.stop.channel) == ("monitor", channel)
    assert START < facts.stop.t < START + within
    assert facts.measures["tracking_true"]["max_error"] < largest


def test_noise_of_the_assumed_deviation_is_no_fault():
    """A residual of deviation 1 and the scores' correlation time for six minutes."""
    decay = np.exp(-SCORES.corner * 1e-3)
    none, still = np.zeros(RESIDUALS), np.zeros((2, 5))
    parts = none, none, none, none, none, none.copy(), none
    sensors = Sensors(*parts, still, none, none, 0.0, True, 1e-3)
    drawn = np.random.default_rng(5).standard_normal(360_000)
    highest = 0.0
    for e in lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], drawn):
        _score(0, float(e), 1.0, sensors)
        highest = max(highest, sensors.scores[0])
    assert 0.1 < highest < 0.4 * SCORES.alarm


@pytest.mark.parametrize(
    ("payload", "change", "supply"),
    [
        (None, {}, {}),
        (None, {"flow": 0.8}, TWO_RAILS),
        ("50 lb", {}, TWO_RAILS),
        ("50 lb", {"flow": 0.8}, {}),
        ("50 lb", {"valve_lag": 2.0}, {}),
        ("50 lb", {"bulk_modulus": 0.5}, {}),
        ("50 lb", {"friction": 3.0}, {}),
    ],
    ids=str,
)
def test_a_sound_machine_is_not_blamed(payload, change, supply):
    machine = MachineChange.model_validate(change)
    facts = result_of(payload, machine=machine, supply=supply)
    assert "valve_fault" not in facts.measures
    assert facts.stop is None and np.isfinite(facts.measures["tracking"]["max_error"])


def test_the_noise_of_a_coarse_sensors_speed_blames_no_pressure():
    """Its acceleration times the inertia is larger than the load force."""
    gains = {"stroke_resolution": "0.5 mm"}
    facts = result_of("50 lb", gains, "6 s", "230 mm", bench="../bench/thesis_arm_adc.toml")
    assert facts.stop is None and "valve_fault" not in facts.measures


@pytest.mark.parametrize(("monitor", "refused"), [(True, True), (False, False)])
def test_a_monitor_without_a_sensor_of_speed_is_refused(monitor, refused):
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    controller = Controller(kind="open_loop", monitor=monitor)
    recipe = loaded.model_copy(update={"controller": controller, "on": "model", "bench": None})
    trial = prepare(recipe, shipped("thesis_arm"))
    trial.machine.unmeasured = ("boom.v",)
    if not refused:
        Session(trial, trial.machine, False)
        return
    with pytest.raises(InputError) as error:
        Session(trial, trial.machine, False)
    assert error.value.key == "trial.blind_law" and "boom.v" in str(error.value)
