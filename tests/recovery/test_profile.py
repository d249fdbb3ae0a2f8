"""Profile likelihoods: a parabola where the interval is right, open where the logs set no end."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from ehbench import workflow
from ehbench.guidance.profile import LEVEL_95, profile
from ehbench.identification.hydraulics import FitOptions, prepare_fit
from ehbench.plant.model import simulate
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, ROOT, measured, shipped

NOISE = {"v": 1e-3, "p_head": 6e4, "p_rod": 6e4, "x": 1e-5, "p_supply": 6e3}


@pytest.fixture(scope="module")
def prepared():
    rig = shipped("slide_servo")
    u = np.zeros(801)
    u[60:240], u[440:640] = 3.0, -3.0
    log = measured(simulate(rig, {"press.servo": u}, 0.8), 4, NOISE)
    names = ["bulk_modulus", "press.volume_head", "carriage.damping"]
    return prepare_fit(rig, [("log", log)], names, FitOptions(workers=1))


def test_the_profile_of_a_plain_parameter_is_the_parabola_of_its_interval(prepared):
    fit, found = profile(prepared, "bulk_modulus")
    assert found.shape == "parabola" and len(found.values) == 13
    own = fit["bulk_modulus"]
    assert found.best == pytest.approx(own.value, rel=1e-4)
    # the profile's ends and the interval's are the same to a tenth of its width
    tenth = 0.1 * (own.interval[1] - own.interval[0])
    assert found.ends == pytest.approx(own.interval, abs=tenth)
    assert min(found.rise) == 0.0 and found.rise[0] > LEVEL_95 < found.rise[-1]
    assert set(found.followed) == {"press.volume_head", "carriage.damping"}
    assert json.loads(json.dumps(asdict(found), allow_nan=False))["shape"] == "parabola"


def test_the_others_are_fitted_again_along_a_profile(prepared):
    fit, found = profile(prepared, "press.volume_head")
    followed = np.array(found.followed["bulk_modulus"])
    middle = followed[int(np.argmin(found.rise))]
    assert middle == pytest.approx(fit["bulk_modulus"].value, rel=1e-3)
    # by more than its own interval is wide: the two are known together only
    low, high = fit["bulk_modulus"].interval
    assert np.ptp(followed) > high - low
    # the rise falls to the best value and grows beyond it
    k = int(np.argmin(found.rise))
    assert np.all(np.diff(found.rise[: k + 1]) < 0) and np.all(np.diff(found.rise[k:]) > 0)
    with pytest.raises(InputError, match="not among the parameters"):
        profile(prepared, "carriage.mass")


@pytest.mark.slow
def test_the_command_leaves_a_run_with_its_picture(inside, tmp_path):
    recipe, out = tmp_path / "fit.toml", tmp_path / "profile"
    log = ROOT / "datasets" / "slide_servo" / "steps" / "press_100kg.mcap"
    recipe.write_text(
        f'stage = "identify"\nwhat = "hydraulics"\nrig = "{RIGS}/slide_servo.toml"\n'
        f'data = ["{log}"]\nparameters = ["bulk_modulus", "carriage.damping"]\n'
    )
    words = ("identify", recipe, "--profile", "bulk_modulus", "--out", out)
    done = inside(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Profile of bulk_modulus" in done.stdout and "by the fit" in done.stdout
    picture = (out / "figures" / "profile.svg").read_text(encoding="utf-8")
    assert "rise of −2 log likelihood" in picture
    page = workflow.report([out], workflow.Session(out=tmp_path / "report"))
    assert "Profile of bulk_modulus" in (page.folder / "report.html").read_text(encoding="utf-8")
