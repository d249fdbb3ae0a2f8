"""What captions say of trials after a stop and at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.comparisons import lasting
from ehbench.report.rest_words import rest_caption, swing_after
from ehbench.report.saved import Series, Table

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
    channels = {
        "boom.v": v,
        "boom.v_desired": 0.1 * MOVING,
        "boom.function": function,
        "boom.hect.command": command,
    }
    row = {
        "cylinder": "boom",
        "controller": "six_functions",
        "steps": [{"speed": 0.1, "steady_error": 0.0}] if steps else [],
        "stopped": "",
    }
    return Case(Table(row, Path("x")), "x", Path("x"), Path("x")), Record(T, channels)


def told(*made: tuple[Case, Record]) -> str:
    return rest_caption(RIG, [case for case, _ in made], [record for _, record in made])


def test_a_quiet_trial_says_nothing():
    assert told(trial()) == ""


def test_swinging_after_a_stop_is_told_with_its_end():
    case, record = trial(swing=0.05)
    first, last = swing_after(case, record) or (0.0, 0.0)
    assert first == pytest.approx(0.05 * np.exp(-0.16), rel=0.03)
    assert last == pytest.approx(0.05 * np.exp(-1.83), rel=0.1)
    text = told((case, record))
    assert "After the stop it swings by up to 43 mm/s" in text and "no feedback damps it" in text


def test_changes_of_the_function_at_rest_are_counted():
    assert "the working function changes 12 times (six functions)" in told(trial(changes=6))


def test_a_restless_command_is_told_with_its_valve():
    text = told(trial(chatter=1.0, steps=False), trial())
    assert "the command of hect swings by up to 2 V within 0.1 s" in text
    assert "swings" not in told(trial(chatter=0.1, steps=False))


def test_a_channel_that_lies_off_for_long_is_told():
    recorded = np.where(T < 2.0, 0.0, 1e6)
    off = recorded + np.where((T > 1.0) & (T < 2.5), 2e5, 0.0)
    series = Series(
        T, {"a.p_rod": recorded, "a.p_head": recorded}, {"a.p_rod": off, "a.p_head": recorded}
    )
    assert lasting(series, ["a.p_rod", "a.p_head"]) == [
        "Rod-end pressure: off to one side by more than 10 % of its range for 1.5 s."
    ]
