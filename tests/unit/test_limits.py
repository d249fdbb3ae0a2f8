"""Pressures recorded at the end of their sensor's range."""

from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.data import read
from ehbench.data.record import Record
from ehbench.identification.simulator import prepare
from ehbench.plant.model import Model
from ehbench.preprocessing.plausibility import at_limit, held, notes_on_channels
from ehbench.validation.residuals import pair_of
from tests.shared import ROOT

LOG = ROOT / "datasets/slide_servo/steps/press_no_load.mcap"
RIG = ROOT / "recipes/rigs/slide_servo.toml"


def wave(noise: float = 1e4, step: float = 0.0) -> np.ndarray:
    """Pressure that swings from 2 to 8 MPa and stands at 5 MPa in between."""
    t = np.arange(2000) / 1000
    y = 5e6 + np.where((t % 1) > 0.4, 3e6 * np.sin(10 * np.pi * (t - 0.4)), 0.0)
    y += noise * np.random.default_rng(5).standard_normal(t.size)
    return np.round(y / step) * step if step else y


def stalled() -> np.ndarray:
    """Pressure of a stalled cylinder, which comes up to the supply's and falls at once; coarse."""
    t = np.arange(2000) / 1000
    y = np.where(t < 1.5, 8e6 - 6e6 * np.exp(-t / 0.05), 2e6 + 1e6 * np.exp(-t))
    return np.round(y / 2e4) * 2e4


SOUND = {"noise": wave(), "no noise": wave(0.0), "a coarse converter": wave(step=1e5)}
SOUND |= {"a pressure that comes to stand at its largest": stalled(), "constant": np.full(50, 3e6)}
SOUND |= {"two samples": np.array([1.0, 2.0])}


@pytest.mark.parametrize("name", SOUND)
def test_readings_within_the_range_are_let_be(name):
    assert not at_limit(SOUND[name]).any()


@pytest.mark.parametrize("step", [0.0, 2e4])
@pytest.mark.parametrize("end", ["upper", "lower"])
def test_readings_at_an_end_are_found(step, end):
    y = wave(step=step)
    cut = np.clip(y, None, 7e6) if end == "upper" else np.clip(y, 3e6, None)
    there = at_limit(cut)
    assert np.array_equal(there, cut == (7e6 if end == "upper" else 3e6)) and there.sum() > 200


def test_a_fit_does_not_count_them_and_a_validation_ends_there_too():
    rig, record = load_rig(RIG), read(LOG)
    top = 0.8 * np.max(record["press.p_head"])
    cut = np.clip(record["press.p_head"], None, top)
    clipped = replace(record, channels=record.channels | {"press.p_head": cut})
    log = prepare(Model.of(rig), clipped, "log", ("qd", "p_head", "p_rod"), (), 1, None)
    at = log.channels.index("press.p_head")
    assert np.array_equal(log.counts[:, at], cut < top) and not log.counts[:, at].all()
    assert log.counts[:, [i for i in range(len(log.channels)) if i != at]].all()
    assert any("press.p_head stands at" in text for text in log.warnings)
    pair = pair_of(clipped, record, "press.p_head")
    assert pair is not None and np.array_equal(pair.simulated, cut)


def lost_messages(record: Record, count: int = 8) -> tuple[Record, np.ndarray]:
    """A log whose recorder held all readings of the press for ``count`` samples, three times while
    it moved and once at rest; where it held them while it moved."""
    moving = np.abs(record["press.v"]) > 0.3 * np.abs(record["press.v"]).max()
    firsts = np.flatnonzero(moving)[[20, 200, 400]]
    rows, there = np.arange(record.t.size), np.zeros(record.t.size, bool)
    for first in (2, *firsts):
        rows[first : first + count] = first
        there[first + 1 : first + count] = first > 2
    readings = {
        name: y[rows] if name.startswith("press.") and not name.endswith("command") else y
        for name, y in record.channels.items()
    }
    return replace(record, channels=readings), there


def test_readings_that_stand_are_no_held_ones():
    record = read(LOG)
    for y in SOUND.values():
        for other in (y, np.roll(y, 30)):
            log = Record(np.arange(y.size) * 1e-3, {"press.p_head": y, "press.p_rod": other})
            assert not held(log, "press.p_head").any()
    assert not any(held(record, name).any() for name in record.channels)


def test_held_readings_are_said_and_count_nowhere():
    record, there = lost_messages(read(LOG))
    assert np.array_equal(held(record, "press.v"), there) and not held(record, "p_supply").any()
    model = Model.of(load_rig(RIG))
    (note,) = [item for item in notes_on_channels(record, model) if item.key.endswith(".held")]
    assert note.fields["share"] == pytest.approx(100.0 * there.mean())
    assert note.fields["time"] == record.t[np.argmax(there)]
    log = prepare(model, record, "log", ("v", "p_head", "p_rod"), (), 1, None)
    assert np.array_equal(log.counts, np.repeat(~there[:, None], len(log.channels), axis=1))
    pair = pair_of(record, read(LOG), "press.p_head")
    assert pair is not None and np.array_equal(pair.simulated[there], pair.recorded[there])
    assert not np.array_equal(pair.simulated, pair.recorded)
