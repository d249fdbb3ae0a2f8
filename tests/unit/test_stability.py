"""Margins against closed forms, and against the poles of loops made faster and turned until one
crosses the axis.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import TuneRecipe, load_rig
from ehbench.tune.loop import Law, _open_loops
from ehbench.tune.stability import OpenLoop, gain_margin, phase_margin
from ehbench.tune.study import prepare_tuning

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"


def chain(gain: float, *poles: float) -> OpenLoop:
    """``L = gain/Π(s + p)`` in the companion form of its polynomial."""
    coefficients = np.poly(-np.array(poles))
    size = len(poles)
    a = np.eye(size, k=1)
    a[-1] = -coefficients[:0:-1]
    return OpenLoop(a, np.eye(size)[-1], gain * np.eye(size)[0])


def crossing(a: np.ndarray, way: np.ndarray, factors: np.ndarray) -> float:
    """Place of the first of some factors on the loop with which a pole grows, between them by
    halving; inf if there is none.
    """

    def grows(places: np.ndarray) -> np.ndarray:
        closed = a - np.multiply.outer(factor(places), way)
        return np.linalg.eigvals(closed).real.max(axis=-1) > 1e-9 * np.abs(a).max()

    def factor(places: np.ndarray) -> np.ndarray:
        return np.exp(1j * places) if factors.dtype == complex else np.exp(places)

    places = np.angle(factors) if factors.dtype == complex else np.log(factors)
    first = np.flatnonzero(grows(places))
    if not first.size:
        return math.inf
    low, high = places[first[0] - 1], places[first[0]]
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if grows(np.array([middle]))[0] else (middle, high)
    return float(high)


@pytest.mark.parametrize("gain", [0.5, 1.0, 3.0, 5.9])
def test_margins_of_three_lags_by_hand(gain):
    """gain/(s (s + 1) (s + 2)): the phase is −180° at √2 rad/s, where its size is gain/6."""
    loop = chain(gain, 0.0, 1.0, 2.0)
    assert gain_margin(loop) == pytest.approx(6.0 / gain, rel=1e-4)
    squares = np.roots([1.0, 5.0, 4.0, -(gain**2)])
    omega = math.sqrt(max(root.real for root in squares if abs(root.imag) < 1e-12))
    phase = math.pi / 2 - math.atan(omega) - math.atan(omega / 2.0)
    assert phase_margin(loop) == pytest.approx(phase, abs=1e-4)


@pytest.mark.parametrize("gain, margin", [(-0.5, 4.0), (-1.9, 2.0 / 1.9), (0.5, math.inf)])
def test_a_loop_may_leave_at_standstill_or_never(gain, margin):
    loop = chain(gain, 1.0, 2.0)
    assert gain_margin(loop) == pytest.approx(margin, rel=1e-6)
    assert phase_margin(chain(0.5, 1.0)) == math.inf


def rig_loops(count: int) -> Iterator[OpenLoop]:
    """Stable loops of two rigs at random operating points, laws and gains, most without control of
    the off-side.
    """
    rng = np.random.default_rng(3)
    recipe = TuneRecipe(
        stage="tune",
        rig="x",
        postures=2,
        speed_shares=(0.4,),
        draws=0,
        low_pressure="8 bar",  # pyright: ignore[reportArgumentType]
        cross_drop="8 bar",  # pyright: ignore[reportArgumentType]
        cylinder="boom",
    )
    motions = [
        motion
        for name in ("boom_four_valve", "thesis_arm")
        for motion in prepare_tuning(load_rig(RIGS / f"{name}.toml"), None, recipe).motions
    ]
    while count > 0:
        law = Law(
            rng.choice([0.0, 2.0, 20.0]),
            rng.choice([0.0, 0.0, 1e-11]),
            rng.choice([1e-3, 20e-3]),
            rng.choice([0.0, 5.0]),
            rng.choice(["metered", "load"]),
        )
        loop = motions[rng.integers(len(motions))].loop(law)
        for item in _open_loops(loop, 10.0 ** rng.uniform(-12.0, -9.0)):
            if item.growth() <= 0.0:
                count -= 1
                yield item


@pytest.mark.slow
def test_margins_of_rigs_are_where_their_poles_cross():
    off = []
    for loop in rig_loops(60):
        way = np.outer(loop.b, loop.c)
        factor = math.exp(crossing(loop.a, way, np.geomspace(1.0, 1e4, 400)))
        angle = crossing(loop.a, way, np.exp(1j * np.linspace(0.0, 0.9999 * math.pi, 400)))
        gain, phase = gain_margin(loop), phase_margin(loop)
        gain, phase = (gain if gain < 1e4 else math.inf), (phase if phase < 3.14 else math.inf)
        # a slow pole has to grow by more than rounding before it counts
        if not (np.isclose(gain, factor, rtol=0.01) and np.isclose(phase, angle, atol=0.005)):
            off.append((gain, factor, phase, angle))
    assert not off
