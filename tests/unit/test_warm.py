"""What is compiled after an install is what trials then run."""

from __future__ import annotations

from pathlib import Path

import pytest

from ehbench import starter, warm
from ehbench.control import LAW_NAMES
from ehbench.recipe import TrialRecipe, load_rig


@pytest.mark.parametrize("machine", ["model", "bench"])
def test_every_law_runs_on_every_machine(machine, tmp_path):
    starter.init(tmp_path / "rig")
    rig = load_rig(tmp_path / "rig" / "rig.toml")
    laws = [
        recipe.controller.kind if recipe.controller else None
        for keys in warm.recipes(rig, machine)
        if (recipe := TrialRecipe(stage="trial", rig="rig.toml", path=Path("x"), **keys)).on
    ]
    assert laws == [None, *LAW_NAMES]
    assert warm.warm(machine) == machine
