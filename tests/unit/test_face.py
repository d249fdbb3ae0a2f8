"""What `import ehbench` gives, in any order of use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ehbench

ROOT = Path(__file__).parents[2]


def test_the_face_is_whole_and_documented():
    for name in ehbench.__all__:
        assert callable(getattr(ehbench, name)) and getattr(ehbench, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        ehbench.simulat  # noqa: B018


def test_functions_stay_functions_whatever_was_imported():
    code = (
        "import ehbench, ehbench.workflow, ehbench.simulation, ehbench.validation, ehbench.identification.hydraulics as h\n"
        "rig = ehbench.load_rig('recipes/rigs/slide_servo.toml')\n"
        "[ehbench.simulate(rig, {'press.servo': 2.0}, duration=0.1) for _ in range(2)]\n"
        "assert callable(ehbench.identify) and callable(ehbench.validate)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr


def test_simulate_gives_a_frame_with_units():
    rig = ehbench.load_rig(ROOT / "recipes/rigs/slide_servo.toml")
    command = np.zeros(201)
    command[100:] = 2.0
    frame = ehbench.simulate(
        rig, {"press.servo": command}, duration=0.2, posture={"press": "100 mm"}
    ).frame()
    assert frame.attrs["units"]["press.p_head"] == "Pa"
    assert frame["press.x"].iloc[0] == pytest.approx(0.1) and frame["press.x"].iloc[-1] > 0.1
