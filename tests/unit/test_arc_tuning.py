"""Tuning of adaptive robust control: the largest bandwidths that keep the demanded margins."""

import json
import tomllib
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ehbench.config.recipe import ArcTuneRecipe, load_recipe
from ehbench.report.saved import Saved
from ehbench.report.stages.arc_tuning import findings
from ehbench.runs.rundir import write_json
from ehbench.trial import prepare
from ehbench.tune.arc import ARC_SEARCH, CHOSEN, Search, tune_arc
from ehbench.tune.study import prepare_tuning
from tests.shared import RECIPES, cycle, refused, shipped


@cache
def rig():
    return shipped("boom_four_valve")


def asked(**given):
    """A recipe that tunes the adaptive robust controller."""
    return ArcTuneRecipe.model_validate({"stage": "tune", "what": "arc", "rig": "x", **given})


@cache
def tuned(**demands):
    given = {"postures": 2, "payloads": ("none",), **demands}
    return tune_arc(prepare_tuning(rig(), None, asked(speed_shares=(0.06,), **given)))


@pytest.mark.slow
def test_the_largest_sum_that_keeps_the_margins_is_chosen():
    found = tuned(delay_margin="3 ms")
    assert found.met and found.delay_margin >= 3.0e-3 and found.gain_margin >= 2.0
    total = sum(found.gains[f"{name}_bandwidth"] for name in ("position", "speed", "force"))
    larger = [one for one in found.candidates if one.sum > 1.001 * total]
    assert larger and not any(one.met for one in larger)
    # where the grid ends and bisection begins: the next larger one is near
    assert min(one.sum for one in larger) < 1.05 * total
    assert found.delay_margin == pytest.approx(min(one.delay_margin for one in found.points))


def test_more_delay_costs_bandwidth_and_too_much_is_said():
    near, far = tuned(delay_margin="3 ms"), tuned(delay_margin="6 ms")
    assert near.gains["force_bandwidth"] > 1.2 * far.gains["force_bandwidth"]
    never = tuned(delay_margin="900 ms", gain_margin="1000")
    missed: Any = never.warnings[0]
    assert not never.met and missed.key == "tune.missed_margins"
    assert sorted(missed.fields["margins"].split(" and ")) == ["delay margin", "gain margin"]
    assert len(never.candidates) == ARC_SEARCH.budgets[2]


def test_where_one_margin_is_out_of_reach_it_is_the_one_that_counts():
    """The largest delay margin is that of the slowest, whose gain margin is the smallest."""
    found = tuned(delay_margin="0 ms", gain_margin="1000", phase_margin="0 deg")
    assert found.gain_margin == max(item.gain_margin for item in found.candidates)
    assert found.delay_margin < max(item.delay_margin for item in found.candidates)
    missed: Any = found.warnings[0]
    assert missed.fields["margins"] == "gain margin"
    assert missed.fields["point"] == min(found.points, key=lambda at: at.gain_margin).name


@pytest.mark.parametrize(
    ("gain", "phase", "delay", "keys"),
    [
        (1.596, 1.402, 0.0689, 'gain_margin = "1.5"'),
        (2.3, 0.3089, 0.00299, 'phase_margin = "17 deg"\ndelay_margin = "2.9 ms"'),
        (0.0, 0.0, 0.0, ""),
    ],
)
def test_the_next_step_asks_for_what_was_reached_of_the_margins_missed(gain, phase, delay, keys):
    reached = {"gain_margin": gain, "phase_margin": phase, "delay_margin": delay}
    demanded = {"gain_margin": 2.0, "phase_margin": 0.349, "delay_margin": 5e-3}
    run = SimpleNamespace(
        rig=rig(),
        json=lambda name: {"met": False, "cylinder": "boom", "constraints": demanded, **reached},
    )
    (step,) = findings(cast(Saved, run)).next
    assert step.hint == keys
    recipe = asked(**tomllib.loads(keys))
    assert all(
        float(getattr(recipe, line.split()[0])) <= reached[line.split()[0]]
        for line in keys.splitlines()
    )


def test_motions_that_the_controller_leaves_are_left_out():
    """With regeneration at hand it does not feed the rod end from the supply on the way down."""
    arm = shipped("thesis_arm")

    def search(*functions):
        given = {"functions": functions, "cylinder": "boom", "payloads": ("none",), "postures": 1}
        return Search(prepare_tuning(arm, None, asked(speed_shares=(0.06,), **given)))

    both = search("retract_overrunning", "retract_overrunning_regeneration")
    assert {one.point.function for one in both.plants} == {"retract_overrunning_regeneration"}
    with refused("tune.other_function"):
        search("retract_overrunning")


def test_a_trial_takes_the_gains(tmp_path):
    found = tuned(delay_margin="3 ms")
    write_json(tmp_path / "tuning.json", found.as_json())
    told = json.loads((tmp_path / "tuning.json").read_text(encoding="utf-8"))
    assert told["what"] == "arc" and told["safety"] == 1.5
    given = {"gains": "tuning.json", "path": tmp_path / "trial.toml"}
    recipe = cycle("boom", ["100 mm", "120 mm"], "50 mm/s", **given)
    law = prepare(recipe, rig()).loop.laws[0]
    used = law.used["gains"]
    for name in CHOSEN:
        assert used[name] == pytest.approx(told[name], rel=0.02), name


@pytest.mark.parametrize("name", ["thesis", "slide_servo"])
def test_shipped_recipes_ask_for_it(name):
    recipe = load_recipe(RECIPES / name / "arc_tuning.toml")
    assert isinstance(recipe, ArcTuneRecipe)
