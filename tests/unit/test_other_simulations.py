"""Files that two recorders wrote of one run, by their clocks or by a shift."""

import sys

import numpy as np
import pytest

from ehbench.config.recipe import load_recipe, load_rig
from ehbench.stages.dry_run import DryRun
from ehbench.stages.notes import Notes
from ehbench.vocabulary.errors import InputError, UnitError
from tests.shared import ROOT

RECIPE = """
stage = "validate"
rig = "RIG"
[[data]]
path = "daq.csv"
columns = { file = "daq.map.toml" }
[[data.beside]]
path = "place.txt"
columns = "place.map.toml"
"""
BEGAN = 51000.25  # s after midnight at which the faster recorder began


def place(t):
    """What the slower recorder saw: linear, so that straight lines between samples are exact."""
    return 0.1 + 0.02 * t


@pytest.fixture
def two(tmp_path):
    """A function that writes both files and reads them by a recipe with some keys more."""

    def write(zero: str, more: str = "", late: float = -0.4) -> tuple:
        """``zero`` is what the slower file's time says at the faster one's start."""
        rows = ["Zeit;Ventil;pA", "hh:mm:ss,ms;V;bar"]
        for k in range(1000):
            minute, second = divmod(BEGAN + k / 500, 60)
            clock = f"{int(minute) // 60:02d}:{int(minute) % 60:02d}:{second:06.3f}"
            rows.append(f"{clock.replace('.', ',')};{k % 7};{50 + 0.01 * k:.2f}".replace(".", ","))
        (tmp_path / "daq.csv").write_text("\n".join(rows))
        (tmp_path / "daq.map.toml").write_text(
            '[names]\n"Zeit" = "t"\n"Ventil" = "press.servo.command"\n"pA" = "press.p_head"\n'
        )
        t = late + np.arange(600) / 200
        lines = [f"{float(zero) + one:.4f}\t{1e3 * place(one):.5f}" for one in t]
        (tmp_path / "place.txt").write_text("unix [s]\tx [mm]\n" + "\n".join(lines))
        (tmp_path / "place.map.toml").write_text(
            '[names]\n"unix [s]" = "t [s]"\n"x [mm]" = "press.x [mm]"\n'
        )
        rig = ROOT / "recipes/rigs/slide_servo.toml"
        path = tmp_path / "validate.toml"
        path.write_text(RECIPE.replace("RIG", str(rig)) + more)
        recipe = load_recipe(path)
        inputs = DryRun(tmp_path).inputs(Notes(recipe, dry_run=True))
        return inputs.logs(recipe.data, load_rig(rig))

    return write


@pytest.mark.parametrize(
    ("zero", "more"),
    {
        "by date and time of day": (1_000_000_000 - 1_000_000_000 % 86400 + BEGAN, ""),
        "in another zone": (1_000_000_000 - 1_000_000_000 % 86400 + BEGAN - 3600, 'shift = "1 h"'),
        "without a clock": (0.0, 'shift = "0 s"'),
        "on a trigger": (1_000_000_000.4, 'clock = "own"\nshift = "-0.4 s"'),
    }.values(),
)
def test_two_files_come_on_one_time(zero, more, two):
    logs = two(f"{zero:.4f}", more)
    ((_, record),) = logs.records
    assert set(record.channels) == {"press.servo.command", "press.p_head", "press.x"}
    assert record.t[0] == 0.0 and record.sample_time == pytest.approx(2e-3)
    assert np.allclose(record["press.x"], place(record.t), atol=1e-6)
    assert np.allclose(record["press.p_head"], 5e6 + 1e3 * np.round(500 * record.t), atol=1.0)
    names = ["daq.csv", "daq.map.toml", "place.map.toml", "place.txt"]
    assert sorted(path.name for _, path in logs.files) == names


@pytest.mark.parametrize(
    ("zero", "more", "said"),
    [
        (0.0, "", "nothing tells when it began against daq.csv: 14:10:00.250 there, no clock"),
        (1_000_000_000 - 1_000_000_000 % 86400 + BEGAN - 3600, "", 'shift = "1 h" puts them'),
        (0.0, 'shift = "2 min"', "no sample while daq.csv runs"),
    ],
)
def test_files_that_nothing_puts_together_are_refused(zero, more, said, two):
    with pytest.raises(InputError, match="place.txt") as caught:
        two(f"{zero:.4f}", more)
    assert said in str(caught.value)


def test_a_position_beyond_the_cylinder_is_a_bad_sample(two, tmp_path, monkeypatch):
    """9999 mm, which a stroke of 400 mm cannot reach, though others can."""
    monkeypatch.setattr(sys.modules[__name__], "place", lambda t: 9.999 if t == 1.0 else 0.1)
    with pytest.raises(UnitError, match=r"place.txt:202: press.x = 9999 mm .* -700 to 900 mm"):
        two("0", 'shift = "0 s"', 0.0)


def test_what_one_file_does_not_cover_is_left_out_and_said(two):
    logs = two("0", 'shift = "0.65 s"', 0.0)
    ((_, record),) = logs.records
    assert record.t[0] == pytest.approx(0.65, abs=2e-3) and record.t[-1] == pytest.approx(1.998)
    assert any("left out: not all tables" in loss for loss in logs.losses)
