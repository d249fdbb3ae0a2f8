"""What a fit should compare, by what its logs show."""

from dataclasses import replace

import numpy as np
import pytest

from ehbench.guidance.comparison import comparison_of
from ehbench.identification.hydraulics import prepare_fit
from tests.shared import shipped
from tools.virtual_logs import virtual_log


def compared(log):
    rig = shipped("slide_servo")
    return comparison_of(prepare_fit(rig, [("log", log)], ["bulk_modulus"]))


def spoilt(kind):
    """A log of the slide as it is, with a noisy rate, or a command made of the position."""
    log, rng = virtual_log("slide_servo", shipped("slide_servo"), "steps", 3), {}
    noise = np.random.default_rng(5).standard_normal(log.t.size)
    if kind == "noisy rate":
        rng["press.v"] = 0.3 * noise
    if kind == "controlled":
        x = log["press.x"] + 1e-4 * noise
        u = np.roll(100.0 * (np.mean(x) - x), 2)
        rng |= {"press.x": x, "press.servo.command": np.clip(u, -9.0, 9.0)}
    return replace(log, channels=log.channels | rng)


@pytest.mark.parametrize(
    ("kind", "channels", "tied", "steps"),
    [
        ("as it is", ("qd", "p_head", "p_rod"), False, []),
        ("noisy rate", ("x", "p_head", "p_rod"), False, ["steps.compare_position"]),
        ("controlled", ("qd", "p_head", "p_rod"), True, ["steps.tie_position"]),
    ],
)
def test_what_a_log_is_compared_by(kind, channels, tied, steps):
    log = spoilt(kind)
    result = compared(log)
    assert (result.channels, result.tied) == (channels, tied)
    assert [step.key for step in result.steps] == steps and len(result.lines) == len(steps)
    ((_, record),) = result.records([("log", log)])
    assert record.meta.get("tied", "none") == ("position" if tied else "none")
