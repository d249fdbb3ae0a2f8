"""Working functions in trials: no hunting at rest, stalls are told, choosing by power pays."""

import pytest

from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.trial import prepare, run, run_trial
from ehbench.trial.cases import account
from ehbench.vocabulary.errors import InputError
from tests.shared import RECIPES, shipped

LIFT = load_rig(RECIPES / "choice" / "lift.toml")


def lifting(controller, payload="1200 kg", **more):
    way = {"waypoints": ["100 mm", "200 mm", "100 mm"], "speed": "150 mm/s", "hold": "0.3 s"}
    motion = {"kind": "point_to_point", "cylinder": "lift"} | way
    recipe = {"stage": "trial", "rig": "lift.toml", "payload": payload}
    recipe |= {"controller": controller, "motion": motion}
    return TrialRecipe.model_validate(recipe | more)


@pytest.mark.parametrize("on", ["model", "bench"])
def test_at_rest_nothing_hunts(on):
    """50 lb at rest: leakage and sensor counts change the function once a second at most."""
    way = {"waypoints": ["50 mm", "60 mm"], "speed": "60 mm/s", "hold": "2 s"}
    given = {"stage": "trial", "rig": "thesis_arm.toml", "on": on, "payload": "50 lb"}
    given |= {"bench": str(RECIPES / "bench" / "thesis_arm.toml"), "controller": {"kind": "arc"}}
    given |= {"motion": {"kind": "point_to_point", "cylinder": "boom"} | way}
    recipe = TrialRecipe.model_validate(given | {"path": RECIPES / "rigs" / "x.toml"})
    rig = shipped("thesis_arm")
    if on == "model":
        leaks = {"boom.leakage_internal": 2e-13, "boom.leakage_head": 3e-13}
        rig = rig.with_values(leaks)
    facts = run_trial(rig, recipe)[1]
    assert facts.measures["functions"]["changes_at_rest"] <= 1.0
    if on == "model":
        assert abs(facts.measures["tracking"]["final_error"]) < 2e-5


def test_a_load_beyond_the_supply_is_told():
    weak = LIFT.with_values({"supply.pressure": 5e6})
    facts = run_trial(weak, lifting({"kind": "position"}))[1]
    assert facts.measures["functions"]["stalled"] > 0.1
    assert any(text.key == "trial.stalled" for text in facts.warnings)
    sound = run_trial(LIFT, lifting({"kind": "position"}))[1]
    assert sound.measures["functions"]["stalled"] == 0.0
    assert not any(text.key == "trial.stalled" for text in sound.warnings)


RAILS = {"low_rail": {"rail_pressure": "60 bar", "rail_margin": "10 bar"}}


def pump_energy(payload, rules, **more):
    """[J] of lifting and lowering, its largest error [m]."""
    recipe = lifting({"kind": "position", "rules": rules}, payload, **more)
    prepared = prepare(recipe, LIFT)
    facts = account(prepared, run(prepared)).facts
    assert not facts.stopped
    return facts.measures["energy"]["pump"], facts.measures["tracking"]["max_error"]


@pytest.mark.parametrize(("payload", "most"), [(None, 0.75), ("1200 kg", 1.001)])
def test_least_power_never_takes_more_than_the_ranked_choice(payload, most):
    """Without load the drop between the ends is too small for the ranked rule to regenerate."""
    ranked, error = pump_energy(payload, {})
    least, other = pump_energy(payload, {"choice": "least_power"})
    assert least <= most * ranked and other < 1.3 * error < 2e-3


def test_on_two_rails_less_oil_is_not_less_power():
    """The low rail carries 600 kg on the whole piston, regeneration would need the high one."""
    rules = {"allow_seventh": True}
    ranked, _ = pump_energy("600 kg", rules, supply=RAILS)
    least, _ = pump_energy("600 kg", rules | {"choice": "least_power"}, supply=RAILS)
    assert least < 0.9 * ranked
    with pytest.raises(InputError, match="choice = 'least'.*ranked, least_power"):
        prepare(lifting({"kind": "position", "rules": {"choice": "least"}}), LIFT)
