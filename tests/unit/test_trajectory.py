"""Trajectories: boundary conditions, integrals, continuity, limits; shaping of a commanded step."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import signal

from ehbench.control import trajectory as tr
from ehbench.control.records import blank
from ehbench.vocabulary.errors import InputError
from tests.shared import refused

TICK = 1e-3
LIMITS = {"speed": 0.2, "acceleration": 1.5, "jerk": 30.0}
# distances that reach the speed limit, the acceleration limit only, the jerk limit only
DISTANCES = [0.2, 0.02, 1e-3, -0.15]
PROFILES = ["ramp", "seventh"]


def move(distance, profile, **changes):
    given = {"profile": profile, "tick": TICK} | LIMITS | changes
    return tr.point_to_point([0.03, 0.03 + distance], **given)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("distance", DISTANCES)
def test_from_rest_to_rest_within_limits_of_which_one_is_reached(distance, profile):
    table = move(distance, profile, hold=[0.05, 0.08])
    assert table[0] == pytest.approx([0.03, 0, 0, 0], abs=0)
    assert table[-1] == pytest.approx([0.03 + distance, 0, 0, 0], abs=1e-15)
    assert (table[:50] == table[0]).all() and (table[-79:] == table[-1]).all()
    assert (np.diff(table[:, tr.X]) * np.sign(distance) >= -1e-16).all()
    table = np.abs(move(distance, profile, tick=1e-5))
    peaks = [table[:, c].max() / limit for c, limit in ((tr.V, 0.2), (tr.A, 1.5), (tr.J, 30.0))]
    assert max(peaks) <= 1.0 + 1e-12
    assert max(peaks) > 0.999  # the finest tick sees a peak to 1e-3


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("distance", DISTANCES)
def test_columns_are_each_others_derivatives(distance, profile):
    """On h = 50 µs off by h²/6 of the third derivative, by h/4 of its jump where it jumps."""
    h = 5e-5
    table = move(distance, profile, tick=h)
    for column, word in ((tr.X, "speed"), (tr.V, "acceleration"), (tr.A, "jerk")):
        slope = (table[2:, column] - table[:-2, column]) / (2 * h)
        assert np.abs(slope - table[1:-1, column + 1]).max() < 5e-3 * LIMITS[word]


@pytest.mark.parametrize("profile", PROFILES)
def test_jerk_is_continuous(profile):
    """Halving the tick halves the largest step of the jerk, also over the seams."""
    steps = []
    for h in (2e-4, 1e-4):
        way = tr.point_to_point([0.0, 0.2, 0.0], tick=h, hold=0.1, profile=profile, **LIMITS)
        steps.append(np.abs(np.diff(way[:, tr.J])).max())
    assert steps[0] / steps[1] == pytest.approx(2.0, rel=0.02)
    assert steps[1] < 0.05 * LIMITS["jerk"]


def test_shortest_times_in_closed_form():
    """T = 35/16 D/v at the speed limit; D/v + 15/8 v/a at speed and acceleration."""
    free = {"acceleration": 1e3, "jerk": 1e6}
    seventh = tr.point_to_point([0.0, 0.2], speed=0.1, tick=TICK, profile="seventh", **free)
    assert seventh.shape[0] - 1 == math.ceil(35 / 16 * 0.2 / 0.1 / TICK)
    ramp = tr.point_to_point([0.0, 0.2], speed=0.1, acceleration=0.5, jerk=1e6, tick=TICK)
    assert ramp.shape[0] - 1 == math.ceil((0.2 / 0.1 + 15 / 8 * 0.1 / 0.5) / TICK)


def test_waypoints_holds_cycles_and_the_way_back():
    points = [0.05, 0.2, 0.2, 0.1]
    table = tr.point_to_point(points, tick=TICK, hold=[0.0, 0.1, 0.2, 0.3], **LIMITS)
    resting = np.flatnonzero((table[:, 1:] == 0).all(axis=1))
    counts = [np.isclose(table[resting, tr.X], x, atol=1e-15).sum() for x in (0.05, 0.2, 0.1)]
    assert counts == pytest.approx([1, 300, 300], abs=1)
    back = tr.point_to_point([0.1, 0.15, 0.1, 0.15, 0.1], tick=TICK, hold=0.1, **LIMITS)
    assert back[-1, tr.X] == pytest.approx(0.1, abs=1e-15)
    assert (np.diff(np.sign(back[:, tr.V])) != 0).sum() == 8
    once = tr.point_to_point([0.1, 0.15, 0.1], tick=TICK, hold=0.1, **LIMITS)
    assert back[: once.shape[0] - 1] == pytest.approx(once[:-1], abs=1e-12)
    still = tr.point_to_point([0.1], tick=TICK, hold=0.02, **LIMITS)
    assert still.shape == (21, 4) and (still == [0.1, 0, 0, 0]).all()
    ways = ([0.1, 0.3], [0.3, 0.1])
    there, back = (tr.point_to_point(way, tick=TICK, **LIMITS) for way in ways)
    assert there[:, tr.X] + back[:, tr.X] == pytest.approx(0.4, abs=1e-15)
    assert (there[:, 1:] == -back[:, 1:]).all()


def test_velocity_steps():
    full = 0.18
    levels, lengths = [0.3 * full, 0.7 * full, -full], [0.5, 0.2, 0.1]
    table = tr.velocity_steps(levels, duration=lengths, tick=TICK, rest=0.1, x=0.02)
    assert table.shape == (100 + 500 + 100 + 200 + 100 + 100 + 100 + 1, 4)
    assert not table[:, 2:].any()
    way = 0.02 + np.concatenate([[0], np.cumsum(table[:-1, tr.V])]) * TICK
    assert table[:, tr.X] == pytest.approx(way, abs=1e-15)
    assert table[-1, tr.X] == pytest.approx(0.02 + full * (0.15 + 0.14 - 0.1), abs=1e-12)
    values, counts = np.unique(table[:, tr.V], return_counts=True)
    assert values == pytest.approx([-full, 0.0, 0.3 * full, 0.7 * full])
    assert counts.tolist() == [100, 401, 500, 200]


def shaped(v_d, tick=TICK, **kind):
    shaped, shaping = blank(tr.SHAPED), tr.pack_shaping(**kind)

    def after(v):
        return tr.shape_speed(v, tick, shaping, shaped), shaped.acceleration, shaped.jerk

    return np.array([after(v) for v in v_d])


def test_no_shaping_passes_the_step():
    v = np.array([0.0, 0.1, 0.1, -0.2])
    assert (shaped(v)[:, 0] == v).all()


@pytest.mark.parametrize("jerk", [None, 40.0, 400.0])
@pytest.mark.parametrize("steps", [(0.18,), (0.05, 0.18, -0.18, 0.0), (0.01, -0.002)])
def test_a_limited_step_keeps_its_limits_and_does_not_overshoot(steps, jerk):
    v_d = np.repeat([0.0, *steps], 600)
    out = shaped(v_d, acceleration_max=1.0, jerk_max=jerk)
    assert np.abs(np.diff(out[:, 0])).max() <= 1.0 * TICK * (1 + 1e-12)
    if jerk:
        assert np.abs(np.diff(out[:, 0], 2)).max() <= jerk * TICK**2 * (1 + 1e-9)
        assert np.abs(out[:, 2]).max() <= jerk * (1 + 1e-12)
    for index, (before, after) in enumerate(zip((0.0, *steps), steps, strict=False)):
        part = out[600 * (index + 1) : 600 * (index + 2), 0]
        low, high = sorted((before, after))
        slack = (jerk or 0.0) * TICK**2 + 1e-15  # a jerk can only aim to within one tick
        assert part.min() >= low - slack and part.max() <= high + slack
        assert part[-1] == pytest.approx(after, abs=1e-9)


def test_a_limited_step_is_as_fast_as_its_limits_allow():
    """S-curve: v/a + a/j where the acceleration is reached, else 2 √(v/j), and a few ticks."""
    for v, a, j in ((0.18, 1.0, 40.0), (0.01, 1.0, 40.0)):
        ideal = v / a + a / j if v > a * a / j else 2 * math.sqrt(v / j)
        out = shaped(np.full(1000, v), acceleration_max=a, jerk_max=j)[:, 0]
        arrived = np.flatnonzero(np.abs(out - v) > 0.01 * v)[-1] * TICK
        assert 0.8 * ideal < arrived <= ideal + 5 * TICK


@pytest.mark.parametrize("zeta", [0.4, 1.0, 1.7])
def test_the_filter_is_the_second_order_one(zeta):
    rng = np.random.default_rng(0)
    v_d = np.repeat(rng.uniform(-0.2, 0.2, 20), 37)
    omega = 2 * math.pi * 4.0
    plant = (
        [[0.0, 1.0], [-(omega**2), -2 * zeta * omega]],
        [[0.0], [omega**2]],
        [[1.0, 0.0]],
        [[0.0]],
    )
    matrices: Any = signal.cont2discrete([np.array(m) for m in plant], TICK, "zoh")
    expected: Any = signal.dlsim((*matrices[:4], TICK), v_d)[1]
    ours = shaped(v_d, natural_frequency=omega, damping_ratio=zeta)[:, 0]
    assert ours[:-1] == pytest.approx(expected[1:, 0], abs=1e-11)


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"speed": 0.0}, "limit_range"),
        ({"jerk": math.nan}, "limit_range"),
        ({"tick": -1.0}, "limit_range"),
        ({"hold": -0.1}, "wrong_hold"),
        ({"hold": [0.1, 0.1, 0.1]}, "wrong_hold"),
        ({"waypoints": []}, "no_waypoints"),
        ({"waypoints": [0.1, math.inf]}, "no_waypoints"),
    ],
)
def test_wrong_trajectories_are_refused(wrong, key):
    with refused(f"control.{key}"):
        tr.point_to_point(**({"waypoints": [0.0, 0.1], "tick": TICK, **LIMITS} | wrong))


def test_wrong_steps_and_shapings_are_refused():
    for wrong in ({"levels": []}, {"duration": 0.0}, {"duration": [1.0, 1.0]}, {"rest": -1.0}):
        with refused("control.wrong_steps"):
            tr.velocity_steps(**({"levels": [0.1], "duration": 1.0, "tick": TICK} | wrong))
    with pytest.raises(
        InputError, check=lambda error: error.fields == {"name": "jerk_max", "value": -1.0}
    ):
        tr.pack_shaping(acceleration_max=1.0, jerk_max=-1.0)
    for wrong in (
        {"jerk_max": 1.0},
        {"natural_frequency": 1.0},
        {"acceleration_max": 1.0, "natural_frequency": 1.0, "damping_ratio": 1.0},
    ):
        with refused("control.shaping_incomplete"):
            tr.pack_shaping(**wrong)
