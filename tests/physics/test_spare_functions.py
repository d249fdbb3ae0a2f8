"""The boom with a cartridge out of service: the four that are left move it as far as they can."""

import numpy as np
import pytest

from ehbench.config.recipe import Motion, TrialRecipe, load_recipe
from ehbench.data import read_log
from ehbench.trial.preparation import prepare
from ehbench.trial.running import run
from ehbench.vocabulary.codes import (
    EXTEND_RESISTIVE_FED_AT_ROD,
    HOLD,
    RETRACT_OVERRUNNING_THROUGH_ROD,
)
from tests.shared import ROOT, shipped


@pytest.mark.parametrize(
    ("valve", "function", "largest"),
    [
        ("boom.hect", RETRACT_OVERRUNNING_THROUGH_ROD, 0.2e-3),
        # before it lifts, the rod end must be filled to the pressure above the head end
        ("boom.hepc", EXTEND_RESISTIVE_FED_AT_ROD, 8e-3),
        ("boom.rect", EXTEND_RESISTIVE_FED_AT_ROD, 8e-3),
        ("boom.repc", None, 0.2e-3),
        ("boom.regen", None, 0.2e-3),
    ],
)
def test_the_load_moves_without_a_cartridge(tmp_path, valve, function, largest):
    """Nothing passes the valve, and oil that moves the cylinder comes and goes by the others."""
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe) and loaded.controller is not None
    way = {"waypoints": ["50 mm", "200 mm", "50 mm"], "hold": "1 s", "speed": "40 mm/s"}
    way |= {"acceleration": "0.3 m/s^2", "jerk": "6 m/s^3"}
    motion = Motion.model_validate({"kind": "point_to_point", "cylinder": "boom"} | way)
    controller = loaded.controller.model_copy(update={"unused": (valve,)})
    given = {"on": "model", "bench": None, "payload": "50 lb", "motion": motion}
    recipe = loaded.model_copy(update=given | {"controller": controller})
    log = tmp_path / "log.mcap"
    result = run(prepare(recipe, shipped("thesis_arm")), log=log)
    assert result.facts.stop is None
    assert result.facts.measures["tracking"]["max_error"] < largest
    frame = read_log(log)
    assert not np.any(frame[f"{valve}.command"])
    moving = np.abs(frame["boom.v_desired"]) > 0.01
    used = set(np.unique(frame["boom.function"][moving]).astype(int))
    assert HOLD not in used
    assert function is None or function in used
