"""What it learns of its oil: told from late samples, slow valves and wrong flows, and used."""

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe
from ehbench.trial import prepare, run
from tests.shared import RECIPES, shipped

RIG = shipped("thesis_arm")
DESIGN = float(RIG.oil.bulk_modulus)


def ran(machine, payload="50 lb", **gains):
    """A fast cycle of the boom on the model of a changed machine."""
    motion = {"kind": "point_to_point", "cylinder": "boom", "hold": "0.6 s", "speed": "180 mm/s"}
    motion |= {"waypoints": ["50 mm", "200 mm", "50 mm"]}
    motion |= {"acceleration": "1 m/s^2", "jerk": "20 m/s^3"}
    given = {"stage": "trial", "rig": "x.toml", "on": "model", "machine": machine}
    given |= {"payload": payload, "motion": motion, "path": RECIPES / "trial.toml"}
    given |= {"controller": {"kind": "arc", "gains": gains}}
    recipe = TrialRecipe.model_validate(given)
    return run(prepare(recipe, RIG))


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.5])
def test_the_bulk_modulus_is_told_in_one_cycle(factor):
    record = ran({"bulk_modulus": factor}).record
    told = record["boom.bulk_measured"]
    assert told[0] == pytest.approx(DESIGN)
    assert told[-1] == pytest.approx(factor * DESIGN, rel=0.07)


OTHERS = {
    "late samples": ({"delay": "5 ms"}, 0.2),
    "slow valves": ({"valve_lag": 2.0}, 0.2),
    "quick valves": ({"valve_lag": 0.33}, 0.12),
    "friction": ({"friction": 3.0}, 0.05),
    "less flow": ({"flow": 0.9}, 0.08),
    "more flow": ({"flow": 1.1}, 0.08),
}


@pytest.mark.parametrize("other", OTHERS)
def test_what_is_not_oil_is_not_taken_for_it(other):
    machine, within = OTHERS[other]
    assert ran(machine).record["boom.bulk_measured"][-1] == pytest.approx(DESIGN, rel=within)


@pytest.mark.parametrize("payload", ["50 lb", "100 lb"])
def test_soft_oil_is_followed_the_better_for_it(payload):
    errors = []
    for on in (True, False):
        measures = ran({"bulk_modulus": 0.5}, payload, adapt_oil=on).facts.measures
        assert measures["limit_cycle"] is None
        errors.append(measures["tracking"]["max_error"])
    assert errors[0] < 0.85 * errors[1] and errors[0] < 1.0e-3


@pytest.mark.parametrize("off", [{"adapt_oil": False}, {"adapt": False}])
def test_without_it_the_design_stands(off):
    told = ran({"bulk_modulus": 0.5}, **off).record["boom.bulk_measured"]
    assert np.array_equal(told, np.full(told.size, told[0]))
    assert told[0] == pytest.approx(DESIGN)


def test_what_is_taken_has_bounds():
    """Oil four times as soft is followed up to two and a half times."""
    told = ran({"bulk_modulus": 0.25}).record["boom.bulk_measured"]
    assert told.min() > 0.999 * DESIGN / 2.5
    assert told[-1] == pytest.approx(DESIGN / 2.5, rel=0.1)


@pytest.mark.parametrize(("factor", "share"), [(0.9, 0.8), (1.1, 0.4)])
def test_flow_that_lacks_is_asked_for_within_the_first_ramp(factor, share):
    """Of 10 % less flow a valve at its end is left, of 10 % more hardly anything."""
    with_it, without = (ran({"flow": factor}, adapt_oil=on).facts.measures for on in (True, False))
    assert with_it["limit_cycle"] is None
    assert with_it["tracking"]["max_error"] < share * without["tracking"]["max_error"]
    assert with_it["tracking"]["max_error"] < 1.5e-3


def test_valves_that_are_late_are_asked_ahead():
    with_it, without = (
        ran({"valve_lag": 2.0}, adapt_oil=on).facts.measures for on in (True, False)
    )
    assert with_it["tracking"]["rms_error"] < 0.8 * without["tracking"]["rms_error"]
