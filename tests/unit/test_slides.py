"""A mass that slides is told of in metres: its coordinate is no angle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ehbench import inspection
from ehbench.logs import read_record
from ehbench.recipe import load_rig
from ehbench.record import Record
from ehbench.report.figures.channels import title_of
from ehbench.report.viewer import page
from ehbench.report.words import axis, shown, symbol_of, unit_of

ROOT = Path(__file__).parents[2]
SLIDE = load_rig(ROOT / "recipes/rigs/slide_servo.toml")
BOOM = load_rig(ROOT / "recipes/rigs/boom_four_valve.toml")
LOG = ROOT / "datasets/slide_servo/steps/press_no_load.mcap"


def test_of_a_slide_people_see_position_and_speed():
    assert [SLIDE.seen_as(f"press.{word}") for word in ("q", "qd", "qdd", "p_head")] == [
        "press.x",
        "press.v",
        "press.a",
        "press.p_head",
    ]
    assert BOOM.seen_as("boom.q") == "boom.q" and SLIDE.seen_as("qd") == "v"
    assert unit_of(SLIDE, "press.q") == unit_of(SLIDE, "press.x")
    assert shown(SLIDE, "press.q", 0.15) == shown(SLIDE, "press.x", 0.15)
    assert symbol_of(SLIDE, "q") == "x" and "mm" in axis(SLIDE, "press.q", "stroke")
    assert title_of("press.q", SLIDE) == "Stroke" and title_of("boom.q", BOOM) == "Joint angle"


def test_a_log_shows_itself_that_its_cylinder_slides():
    record = read_record(LOG)
    assert record.seen_as("press.q") == "press.x" and record.seen_as("press.qd") == "press.v"
    t = np.linspace(0, 1, 50)
    turned = Record(t, {"a.q": 0.3 + 0.5 * t, "a.x": 0.1 + 0.2 * t})
    assert turned.seen_as("a.q") == "a.q"
    assert Record(t, {"a.q": t}).seen_as("a.q") == "a.q"


@pytest.mark.parametrize("path", sorted((ROOT / "datasets/slide_servo").rglob("*.mcap")))
def test_check_and_show_tell_of_millimetres(path):
    lines = inspection.check(path).lines
    assert not any("deg" in line for line in lines)
    assert next(line for line in lines if "press.q:" in line).endswith("mm")


def test_the_page_of_a_log_has_no_joint_angle():
    text = page([LOG])
    assert "joint angle" not in text.lower() and "joint rate" not in text.lower()
