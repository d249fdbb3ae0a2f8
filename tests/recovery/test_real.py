"""Recordings by others, read from where the user keeps them (EHBENCH_DATA); without it, that is
said."""

import os
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from ehbench.config.recipe import load_recipe
from ehbench.frequency_response.transfer import transfers
from ehbench.report.saved import Saved
from ehbench.report.stages.response import section
from ehbench.signals.series import lowpass
from ehbench.vocabulary.errors import InputError

REAL = Path(__file__).parents[2] / "recipes" / "real"
HERE = Path(os.environ.get("EHBENCH_DATA", "nowhere"))
UNIT = 10e5  # [Pa] of the actuator's file, as its map has it


def here(name: str) -> None:
    if not (HERE / name).is_dir():
        pytest.skip(f"EHBENCH_DATA holds no {name}")


def test_where_files_are_is_asked_for(monkeypatch):
    monkeypatch.delenv("EHBENCH_DATA", raising=False)
    recipe = load_recipe(REAL / "actuator_identify.toml")
    with pytest.raises(InputError, match="EHBENCH_DATA is not set") as refused:
        recipe.file("$EHBENCH_DATA/actuator.csv")
    assert "export EHBENCH_DATA" in str(refused.value)
    monkeypatch.setenv("EHBENCH_DATA", "/data")
    assert recipe.file("$EHBENCH_DATA/actuator.csv") == Path("/data/actuator.csv")


def swept(pole, delay, second=None):
    """Input and output of a form at 1 kHz, the output with noise and an offset."""
    rng = np.random.default_rng(5)
    u = lowpass(rng.standard_normal(6000), 1e-3, 20.0)
    t = np.arange(u.size) * 1e-3
    fine = np.arange(0.0, t[-1], 1e-4)
    y, x, seen = 0.0, 0.0, []
    for late in np.interp(fine - delay, t, u):
        x += 1e-4 * pole * (late - x)
        y += 1e-4 * second * (x - y) if second else x - y
        seen.append(y)
    seen = np.interp(t, fine, seen)
    return u, 2.0 * seen + 0.3 + 0.02 * np.std(seen) * rng.standard_normal(u.size)


def test_one_pole_and_a_delay_are_told_from_two_poles():
    best = transfers([swept(40.0, 0.006)], 1000.0)[0]
    assert best.form == "first order and delay" and best.preferred and best.delay_std is not None
    assert best.poles[0] == pytest.approx(40.0, abs=3.0 * best.pole_stds[0] + 0.2)
    assert best.delay == pytest.approx(0.006, abs=3.0 * best.delay_std + 1e-4)
    assert best.gain == pytest.approx(2.0, rel=0.01)
    two = transfers([swept(40.0, 0.0, 150.0)], 1000.0)[0]
    assert two.form == "two poles" and two.fit_percent[0] > 95.0
    assert two.poles == pytest.approx((40.0, 150.0), rel=0.05)


def test_a_servohydraulic_sweep_is_one_pole_and_a_delay(undrawn, tmp_path):
    here("mts_servohydraulic_vrths")
    made = workflow.run(REAL / "servohydraulic.toml", workflow.Session(root=tmp_path))
    found = made.json("response")
    low, high = found["coherent_range"]
    assert low <= 0.5 and high == pytest.approx(20.0, abs=0.3)
    best, *others = found["transfers"]
    assert best["form"] == "first order and delay"
    assert best["poles"][0] == pytest.approx(44.5, abs=3.0 * best["pole_stds"][0])
    assert best["delay"] == pytest.approx(4.4e-3, abs=3.0 * best["delay_std"])
    assert best["fit_percent"][0] > 94.7 and best["fit_percent"][1] > 94.5
    (two,) = (one for one in others if one["form"] == "two poles")
    assert np.all(np.array(best["fit_percent"]) > np.array(two["fit_percent"]))
    said = section(Saved(made.folder), lambda **_: ()).sentence
    assert "first order and delay is preferred, 45.2 ± 2.6 rad/s and 4.50 ± 0.57 ms" in said


def test_an_actuator_of_unknown_scales_is_followed_freely(undrawn, tmp_path):
    here("actuator_linkoping")
    made = workflow.run(REAL / "actuator_validation.toml", workflow.Session(root=tmp_path))
    assert made.code == 0
    (log,) = made.json("validation")["logs"]
    (channel,) = (one for one in log["channels"] if one["channel"] == "ram.p_head")
    error = channel["rms_error"] / UNIT
    assert log["status"] == "held_out" and log["scored"][0] == pytest.approx(5.12)
    others = [one["value"] / UNIT for one in made.json("validation")["references"]]
    assert others == pytest.approx([1.594, 0.954, 0.773])
    assert error < 0.43  # published: 0.954 of a linear ARX model, 0.773 of a recurrent GP
