"""Samples that come late by a known time, by the true stroke of the virtual bench."""

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe, load_recipe
from ehbench.config.recipe.trial import Controller, MachineChange
from ehbench.control.law import late_of
from ehbench.trial import prepare, run
from tests.shared import ROOT, shipped


def errors(told: str) -> tuple[float, float]:
    """rms errors [m], by the sensor and true, of ARC on a bench whose samples are 6 ms late."""
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe)
    law = Controller.model_validate({"kind": "arc", "delay": told})
    machine = MachineChange.model_validate({"delay": "5 ms"})
    changes = {"controller": law, "machine": machine, "payload": "50 lb"}
    measures = run(prepare(loaded.model_copy(update=changes), shipped("thesis_arm"))).facts.measures
    return measures["tracking"]["rms_error"], measures["tracking_true"]["rms_error"]


def test_the_true_error_loses_what_the_delay_adds():
    """It does not keep speed times delay, and the sensor's error is the true one."""
    measured, true = errors("0 ms")
    assert true > 2.5 * measured
    measured, true = errors("6 ms")
    assert true == pytest.approx(measured, rel=0.1) and true < 0.2e-3


@pytest.mark.parametrize(
    ("delay", "ticks", "share"), [(0.0, 1, 0.0), (2e-3, 3, 0.0), (2.3e-3, 4, 0.7)]
)
def test_a_delay_is_whole_ticks_and_a_share(delay, ticks, share):
    late = late_of(delay, 1e-3)
    assert late.desired.shape == (ticks, 2) and np.isnan(late.desired).all()
    assert late.share == pytest.approx(share, abs=1e-9)
