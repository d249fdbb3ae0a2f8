"""What is compiled after an install is what trials then run."""

import subprocess
import sys
from pathlib import Path

import pytest

from ehbench.app import starter, warm
from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.control import LAW_NAMES
from ehbench.physics.flow_map import bspline_pieces


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


def test_an_arm_moves_and_fits_find_their_kernels_compiled():
    assert warm.together("an arm") == "an arm"
    assert warm.fits("fits") == "fits"
    folder = Path(bspline_pieces.outer.stats.cache_path)
    assert list(folder.glob("*bspline_pieces*.nbi"))


AHEAD = """
from pathlib import Path
from numba.core.caching import NullCache
from ehbench.app import warm
from ehbench.ledger import quadrature
from ehbench.plant import derivatives, valves
from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.trial import account, prepare, run

warm.ahead()
tops = (quadrature.integrate, quadrature.stores_at, valves.follow_valves)
kernels = [*(each.inner for each in derivatives.LAST), *(each.outer for each in tops)]
known = [each.signatures for each in kernels]
assert all(len(each) == 1 for each in known), known
rig = load_rig(Path("rig/rig.toml"))
recipe = TrialRecipe(stage="trial", rig="x", path=Path("x"), **next(warm.recipes(rig, "model")))
prepared = prepare(recipe, rig)
result = run(prepared)
account(prepared, result)
derivatives.derivatives.inner._cache = NullCache()
y = result.record.t
derivatives.derivatives.compile(y, y, result.model.plant, y, y)
assert known == [each.signatures for each in kernels]
"""


@pytest.mark.slow
def test_what_is_compiled_ahead_is_what_a_trial_calls(tmp_path):
    """For the very types: a trial on the model compiles none of it for others."""
    starter.init(tmp_path / "rig")
    command = [sys.executable, "-c", AHEAD]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
