"""What captions say of trials after a stop and at rest."""

import re
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.comparisons import lasting
from ehbench.report.saved import Series, Table
from ehbench.report.trial_captions import standstill_caption, swing_after

RIG = load_rig(Path(__file__).parents[2] / "recipes" / "rigs" / "thesis_arm.toml")
T = np.arange(0.0, 4.0, 0.001)
MOVING = (T >= 0.5) & (T < 2.0)


def trial(
    swing: float = 0.0, changes: int = 0, chatter: float = 0.0, steps: bool = True
) -> tuple[Case, Record]:
    v = np.where(MOVING, 0.1, swing * np.exp(-(T - 2.0)) * np.cos(20.0 * (T - 2.0)) * (T >= 2.0))
    function = np.where(MOVING, 1.0, 0.0)
    for place in range(changes):
        function[(T >= 2.5 + 0.1 * place) & (T < 2.55 + 0.1 * place)] = 1.0
    command = np.where(MOVING, 4.0 + chatter * np.sin(2.0 * np.pi * 40.0 * T), 0.0)
    channels = {"boom.v": v, "boom.v_desired": 0.1 * MOVING, "boom.function": function}
    channels |= {"boom.hect.command": command}
    row = {
        "cylinder": "boom",
        "controller": "six_functions",
        "steps": [{"speed": 0.1, "steady_error": 0.0}] if steps else [],
        "stopped": "",
    }
    return Case(Table(row, Path("x")), "x", Path("x"), Path("x")), Record(T, channels)


def caption(*trials: tuple[Case, Record]) -> str:
    return standstill_caption(RIG, [case for case, _ in trials], [log for _, log in trials])


@pytest.mark.parametrize(
    ("trials", "numbers"),
    [
        ([{}], []),
        ([{"swing": 0.05}], ["43"]),
        ([{"changes": 6}], ["12"]),
        ([{"chatter": 1.0, "steps": False}, {}], ["2", "0.1"]),
        ([{"chatter": 0.1, "steps": False}], []),
    ],
    ids=["quiet", "swings after the stop", "function changes", "command chatters", "calm"],
)
def test_what_happens_at_standstill_is_reported_with_its_size(trials, numbers):
    text = caption(*(trial(**given) for given in trials))
    assert all(re.search(rf"\b{number}\b", text) for number in numbers)
    assert bool(text) == bool(numbers)


def test_a_swing_and_a_channel_that_lies_off_are_reported():
    first, last = swing_after(*trial(swing=0.05)) or (0.0, 0.0)
    assert first == pytest.approx(0.05 * np.exp(-0.16), rel=0.03)
    assert last == pytest.approx(0.05 * np.exp(-1.83), rel=0.1)
    recorded = np.where(T < 2.0, 0.0, 1e6)
    off = recorded + np.where((T > 1.0) & (T < 2.5), 2e5, 0.0)
    series = Series(
        T, {"a.p_rod": recorded, "a.p_head": recorded}, {"a.p_rod": off, "a.p_head": recorded}
    )
    assert lasting(series, ["a.p_rod", "a.p_head"]) == [("a.p_rod", pytest.approx(1.5, abs=0.01))]
