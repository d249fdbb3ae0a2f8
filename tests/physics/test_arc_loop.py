"""Margins of adaptive robust control: the linear check says where the model swings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from delayed_loop import Bench

from ehbench.tune.arc_loop import Sampled, Sensing
from tests.shared import shipped

GAINS = {
    "defaults": ({}, {}),
    "livelier": ({"lag_budget": 0.6}, {"robust_limit": 0.3}),
    "slow observer": ({"lag_budget": 0.5}, {"observer_bandwidth": 90.0}),
    "fast adaptation": ({"adaptation": 3.5}, {}),
}


@cache
def bench(name, cylinder):
    return Bench(shipped(name), cylinder, shares=(0.06,))


@pytest.mark.slow
@pytest.mark.parametrize("gains", GAINS)
@pytest.mark.parametrize(
    ("name", "cylinder"), [("thesis_arm", "boom"), ("boom_four_valve", "boom")]
)
def test_the_delay_margin_is_where_the_model_begins_to_swing(name, cylinder, gains):
    """Within 20 %, at the point with the least margin, its neighbours free on their oil."""
    rig = bench(name, cylinder)
    unsure, given = GAINS[gains]
    packed = rig.gains(unsure, **given)
    told = [(rig.loop(at, packed).margins(Sensing()), at) for at in rig.points]
    margins, worst = min(told, key=lambda one: one[0].delay)
    assert margins.delay > 0.0
    assert rig.onset(worst, packed) == pytest.approx(margins.delay, rel=0.2), worst.point.name


def test_a_response_is_that_of_the_equations_solved_at_each_frequency():
    """Also of states whose units are ten powers apart, one lightly damped, and of one state."""
    rng = np.random.default_rng(3)
    for states in (9, 1):
        units = 10.0 ** np.linspace(-5.0, 7.0, states)
        a = 0.3 * rng.standard_normal((states, states))
        a *= 0.999 / np.abs(np.linalg.eigvals(a)).max()
        plain = Sampled(
            a, rng.standard_normal((states, 2)), rng.standard_normal((3, states)), np.ones((3, 2))
        )
        z = np.exp(1j * np.linspace(0.01, 3.1, 50))
        wanted = [
            plain.c @ np.linalg.solve(one * np.eye(states) - a, plain.b) + plain.d for one in z
        ]
        scaled = Sampled(
            a * np.divide.outer(units, units), plain.b * units[:, None], plain.c / units, plain.d
        )
        for sampled in (plain, scaled):
            found = sampled.response(z)
            assert found.shape == (50, 3, 2)
            assert np.abs(found - wanted).max() < 1e-11 * np.abs(wanted).max()


def test_margins_are_those_of_the_closed_loop():
    """At the margin a pole of the sampled loop stands on the circle, at its frequency."""
    rig = bench("thesis_arm", "boom")
    loop = rig.loop(rig.points[0], rig.gains())
    margins = loop.margins(Sensing())
    poles = loop.poles(Sensing(margins.delay))
    near = poles[np.argmin(abs(poles - 1j * margins.frequency))]
    assert abs(near - 1j * margins.frequency) < 0.03 * margins.frequency
    louder = replace(loop, plant=loop.plant._replace(b=margins.gain * loop.plant.b))
    assert abs(louder.growth(Sensing())) < 0.02 * margins.frequency
