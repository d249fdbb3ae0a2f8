"""A limit cycle is told from ringing, from noise and from what the reference asks for."""

import numpy as np
import pytest

from ehbench.trial import run_trial
from ehbench.trial.limit_cycle import limit_cycle
from ehbench.trial.measures import short_measures, unmoved_measures
from ehbench.vocabulary.messages import is_warning
from tests.shared import cycle, shipped

T = np.arange(8000) / 1000.0
STROKE = 0.25
RAMP = 0.05 + 0.02 * T
ACTING = np.sin(75.0 * T)[:, None]  # commands [V]


def error_of(damping):
    swing = 2.0e-3 * np.exp(-damping * 75.0 * T) * np.sin(75.0 * T)
    return swing + 2.0e-5 * np.random.default_rng(1).standard_normal(T.size)


def test_a_lasting_swing_is_told_with_its_size_and_period():
    """Amplitude, period and begin of a swing of 2 mm at 75 rad/s that is there from 3 s to 5 s."""
    on = (T > 3.0) & (T < 5.0)
    found = limit_cycle(T, RAMP + np.where(on, error_of(0.0), 0.0), RAMP, ACTING, STROKE)
    assert found is not None
    assert found.amplitude == pytest.approx(2.0e-3, rel=0.15)
    assert found.period == pytest.approx(2.0 * np.pi / 75.0, rel=0.05)
    assert found.start == pytest.approx(3.0, abs=0.1)
    assert found.duration == pytest.approx(2.0, abs=0.2)


def s_curve(speed: float, acceleration: float, jerk: float) -> np.ndarray:
    """A stroke of 150 mm out and back, as a motion with limited jerk goes."""
    push = np.zeros(T.size)
    for begin, way in ((1.0, 1.0), (4.5, -1.0)):
        rise = np.clip(jerk * np.minimum(T - begin, begin + speed / acceleration - T), 0.0, None)
        up = np.minimum(rise, acceleration)
        late = int(round(1000.0 * 0.15 / speed))
        push += way * (up - np.roll(up, late))
    x = np.cumsum(np.cumsum(push)) * 1e-6
    return 0.05 + 0.15 * x / np.abs(x).max()


@pytest.mark.parametrize("speed, acceleration, jerk", [(0.18, 1.0, 20.0), (0.06, 0.3, 6.0)])
@pytest.mark.parametrize("frequency", [9.5, 11.0, 13.0])
def test_a_swing_during_a_ramp_is_no_part_of_the_ramp(speed, acceleration, jerk, frequency):
    """A ramp has energy at every frequency: its edges excused swings of fast motions."""
    desired = s_curve(speed, acceleration, jerk)
    lag = np.gradient(desired, T) * 2.0e-3  # what a sound controller leaves
    acts = np.sin(2.0 * np.pi * frequency * T)[:, None]
    noise = 2.0e-5 * np.random.default_rng(3).standard_normal(T.size)
    assert limit_cycle(T, desired - lag + noise, desired, acts, STROKE) is None
    moves = np.abs(np.gradient(desired, T)) > 0.01 * speed
    moves |= np.roll(moves, 200)  # it goes on a little after each edge
    swing = np.where(moves, 5.0e-4 * np.sin(2.0 * np.pi * frequency * T), 0.0)
    found = limit_cycle(T, desired - lag + noise + swing, desired, acts, STROKE)
    assert found is not None
    assert found.amplitude == pytest.approx(5.0e-4, rel=0.3)
    assert found.period == pytest.approx(1.0 / frequency, rel=0.1)


@pytest.mark.parametrize("damping", [0.05, 0.1, 0.3])
def test_ringing_that_dies_out_is_none(damping):
    assert limit_cycle(T, RAMP + error_of(damping), RAMP, ACTING, STROKE) is None


def test_ringing_noise_and_counts_are_no_limit_cycle():
    assert limit_cycle(T, RAMP + error_of(0.0), RAMP, 0.0 * ACTING, STROKE) is None
    assert limit_cycle(T, RAMP + error_of(0.0), RAMP, ACTING, STROKE) is not None
    noise = 3.0e-5 * np.random.default_rng(2).standard_normal(T.size)
    x = np.round((RAMP + noise) / 2.5e-5) * 2.5e-5
    assert limit_cycle(T, x, RAMP, ACTING, STROKE) is None


@pytest.mark.parametrize("harmonic", [1, 2, 3])
def test_an_error_that_the_reference_makes_is_none(harmonic):
    """A reference of 1 Hz, followed with an error at its frequency or at a harmonic of it."""
    asked = 0.1 + 0.02 * np.sin(2.0 * np.pi * T)
    followed = asked + 5.0e-4 * np.sin(2.0 * np.pi * harmonic * T + 0.4)
    assert limit_cycle(T, followed, asked, ACTING, STROKE) is None
    assert limit_cycle(T, followed + error_of(0.0), asked, ACTING, STROKE) is not None


def _trial(**gains):
    move = {"acceleration": "0.3 m/s^2", "hold": "0.3 s"}
    of = "boom", ["220 mm", "40 mm"], "60 mm/s"
    recipe = cycle(*of, gains=gains, move=move, payload="50 lb")
    return run_trial(shipped("thesis_arm"), recipe)[1]


def test_a_trial_that_swings_says_so_and_a_sound_one_does_not():
    sound, swinging = _trial(), _trial(lag_budget="2.5 rad", robust_limit=0.3)
    assert sound.measures["limit_cycle"] is None
    assert not any(text.key == "trial.swings" for text in sound.warnings)
    cycle = swinging.measures["limit_cycle"]
    assert cycle["amplitude"] > 5.0e-4 and 0.01 < cycle["period"] < 0.3
    assert any(w.key == "trial.swings" and is_warning(w) for w in swinging.warnings)


def test_how_far_valves_at_their_end_let_a_cylinder_fall_behind():
    t = np.arange(1000) * 1e-3
    desired = np.where(t < 0.8, -0.2, 0.0)
    at_end = (t >= 0.2) & (t < 0.5)
    reached = np.where(at_end, 0.9, 1.0) * desired
    found = short_measures(t, reached, desired, at_end)
    assert found is not None
    assert (found["start"], found["duration"]) == pytest.approx((0.2, 0.3))
    assert (found["desired"], found["reached"]) == pytest.approx((0.2, 0.18))
    assert short_measures(t, desired, desired, at_end) is None  # nothing was missed
    assert short_measures(t, reached, desired, at_end & (t < 0.25)) is None  # a correction's
    assert short_measures(t, reached, desired, t >= 0.85) is None  # nothing was asked for


def test_a_cylinder_that_stands_still_is_told_from_one_that_goes_elsewhere():
    t = np.arange(1000) * 1e-3
    v = np.where(t < 0.3, -0.2, np.where(t < 0.6, 0.2, 0.0))
    desired = 0.1 + np.cumsum(v) * 1e-3  # 60 mm in and out again
    sinks = 0.1 - 2e-3 * t
    found = unmoved_measures(t, sinks, desired)
    assert found == pytest.approx({"duration": 0.6, "desired": 0.2}, rel=0.01)
    assert unmoved_measures(t, 0.1 + 0.1 * (desired - 0.1), desired) is None  # slowly
    assert unmoved_measures(t, 0.2 - desired, desired) is None  # the other way
    assert unmoved_measures(t, 0.1 + 0.01 * np.sin(60.0 * t), desired) is None  # as it likes
    assert unmoved_measures(t[:80], sinks[:80], desired[:80]) is None  # it may be late
    assert unmoved_measures(t, sinks, np.full(1000, 0.1)) is None
