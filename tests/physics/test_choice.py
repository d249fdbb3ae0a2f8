"""Working functions in trials: no hunting at rest, stalls are told, choosing by power pays."""

from __future__ import annotations

from pathlib import Path

import pytest

from ehbench.recipe import TrialRecipe, load_recipe, load_rig
from ehbench.trial import run_trial
from ehbench.trial.cases import Case, run_cases

RECIPES = Path(__file__).parents[2] / "recipes"
LIFT = load_rig(RECIPES / "choice" / "lift.toml")


def lifting(controller, payload="1200 kg", **more):
    recipe = {
        "stage": "trial",
        "rig": "lift.toml",
        "payload": payload,
        "controller": controller,
        "motion": {
            "kind": "point_to_point",
            "cylinder": "lift",
            "waypoints": ["100 mm", "200 mm", "100 mm"],
            "speed": "150 mm/s",
            "hold": "0.3 s",
        },
    }
    return TrialRecipe.model_validate(recipe | more)


@pytest.mark.parametrize("on", ["model", "bench"])
def test_at_rest_nothing_hunts(on):
    """50 lb and the adaptive law: leakage, and on the bench counts of the sensor, change the
    function no more than once a second while no speed is desired.
    """
    recipe = TrialRecipe.model_validate(
        {
            "stage": "trial",
            "rig": "thesis_arm.toml",
            "on": on,
            "bench": str(RECIPES / "bench" / "thesis_arm.toml"),
            "payload": "50 lb",
            "controller": {"kind": "arc"},
            "motion": {
                "kind": "point_to_point",
                "cylinder": "boom",
                "waypoints": ["50 mm", "60 mm"],
                "speed": "60 mm/s",
                "hold": "2 s",
            },
        }
    ).model_copy(update={"path": RECIPES / "rigs" / "x.toml"})
    rig = load_rig(RECIPES / "rigs" / "thesis_arm.toml")
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
    assert any("'lift' was stalled in " in text for text in facts.warnings)
    sound = run_trial(LIFT, lifting({"kind": "position"}))[1]
    assert sound.measures["functions"]["stalled"] == 0.0
    assert not any("stalled" in text for text in sound.warnings)


@pytest.fixture(scope="module")
def energies():
    """Pump energy [J] of corners of the map that the recipe makes, by (load, controller)."""
    recipe = load_recipe(RECIPES / "choice" / "map.toml")
    planned = [
        (name, one)
        for name, _, one in recipe.cases()
        if one.motion.name == "150 mm/s" and one.payload in (None, "1200 kg")
    ]
    cases = [Case(name, one, LIFT, None) for name, one in planned]
    found = {}
    for case, result in zip(cases, run_cases(cases), strict=True):
        facts = result.account.facts
        assert not facts.stopped
        found[facts.payload, case.recipe.controller.label] = facts.measures
    return found


def test_least_power_never_takes_more_than_the_ranked_choice(energies):
    for load in ("none", "1200 kg"):
        for kind in ("", ", seven", ", seven, two rails"):
            ranked, least = (energies[load, f"{one}{kind}"] for one in ("ranked", "least power"))
            assert least["energy"]["pump"] <= 1.02 * ranked["energy"]["pump"]
            worst = max(one["tracking"]["max_error"] for one in (ranked, least))
            assert least["tracking"]["max_error"] < 1.3 * ranked["tracking"]["max_error"] < 0.1
            assert worst < 0.05


def test_on_two_rails_it_takes_less(energies):
    least, ranked = (
        energies["none", f"{one}, seven, two rails"]["energy"]["pump"]
        for one in ("least power", "ranked")
    )
    assert least < 0.97 * ranked
