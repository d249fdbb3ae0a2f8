"""Margins against closed forms, poles made to cross the axis, and dense sweeps."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from ehbench.config.recipe import TuneRecipe
from ehbench.tune.loop import Law, _open_loops
from ehbench.tune.stability import OpenLoop, gain_margin, phase_margin
from ehbench.tune.study import prepare_tuning
from tests.shared import shipped


def chain(gain: float, *poles: float) -> OpenLoop:
    """``L = gain/Π(s + p)`` in the companion form of its polynomial."""
    coefficients = np.poly(-np.array(poles))
    size = len(poles)
    a = np.eye(size, k=1)
    a[-1] = -coefficients[:0:-1]
    return OpenLoop(a, np.eye(size)[-1], gain * np.eye(size)[0])


def crossing(a: np.ndarray, way: np.ndarray, factors: np.ndarray) -> float:
    """The first factor on the loop with which a pole grows, by halving; inf if none."""

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


def delayed(plant: OpenLoop, delay: float) -> OpenLoop:
    """A loop with a delay of its input, in the Padé form of the second order."""
    size, root, twice = len(plant.a), math.sqrt(12.0) / delay, 12.0 / delay
    a = np.zeros((size + 2, size + 2))
    a[:size, :size], a[:size, -1] = plant.a, -twice / root * plant.b
    a[-2:, -2:] = [[0.0, root], [-root, -0.5 * twice]]
    b, c = np.append(plant.b, [0.0, root]), np.append(plant.c, [0.0, 0.0])
    return OpenLoop(a, b, c, delay, slice(size, None))


@pytest.mark.parametrize("late", [0.01, 0.3, 0.9, 1.5])
def test_margins_of_a_late_integrator_by_hand(late):
    """``e^(−sT)/s`` with T in s: gain margin π/(2T), phase margin π/2 − T."""
    loop = delayed(chain(1.0, 0.0), late)
    assert gain_margin(loop) == pytest.approx(0.5 * math.pi / late, rel=1e-6)
    assert phase_margin(loop) == pytest.approx(0.5 * math.pi - late, abs=1e-6)


def late_loops(count: int) -> Iterator[tuple[OpenLoop, np.ndarray, np.ndarray]]:
    """Stable loops with a delayed input, each with its poles and residues, some cancelled."""
    rng = np.random.default_rng(7)
    while count > 0:
        real = -(10.0 ** rng.uniform(0.0, 3.0, rng.integers(1, 4)))
        size, zeta = 10.0 ** rng.uniform(0.5, 3.0, 2), rng.uniform(0.02, 0.9, 2)
        pair = size * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        weights = rng.choice([1e-6, 1.0], 2) * rng.uniform(0.3, 3.0, 2)
        poles = np.concatenate([real, pair, pair.conj()])
        slow = -real * rng.uniform(-0.3, 1.0, real.size)
        residues = np.concatenate([slow, *2 * [-0.5j * weights * size]])
        residues[-2:] = residues[-4:-2].conj()
        a = np.zeros((poles.size, poles.size))
        a[range(real.size), range(real.size)] = real
        b, c = np.ones(poles.size), np.zeros(poles.size)
        c[: real.size] = residues[: real.size].real
        for k, at in enumerate(range(real.size, poles.size, 2)):
            root, share = pair[k], residues[real.size + k]
            a[at : at + 2, at : at + 2] = [[root.real, root.imag], [-root.imag, root.real]]
            # (s − a)⁻¹ [1, 1] of a block, by its partial fractions
            c[at] = share.real - share.imag
            c[at + 1] = share.real + share.imag
        loop = delayed(OpenLoop(a, b, c), 10.0 ** rng.uniform(-3.0, -1.0))
        if loop.growth() <= 0.0:
            count -= 1
            yield loop, poles, residues


def swept(reply: np.ndarray) -> tuple[float, float]:
    """(gain, phase) margins from a dense response: −1/re where im turns, angle at size 1."""
    ends = []
    for level in (reply.imag, np.abs(reply) - 1.0):
        at = np.flatnonzero((level[1:] > 0.0) != (level[:-1] > 0.0))
        part = level[at] / (level[at] - level[at + 1])
        ends.append(reply[at] + part * (reply[at + 1] - reply[at]))
    real = np.append(ends[0].real, reply[0].real)  # at standstill it is real
    real = real[(real < 0.0) & (real > -1.0)]
    angle = np.abs(np.angle(-ends[1])).min(initial=math.inf)
    return float((-1.0 / real).min(initial=math.inf)), float(angle)


def late_differences(count: int) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """((gain, phase) margins, the same by a dense sweep) where they differ."""
    off = []
    for loop, poles, residues in late_loops(count):
        omega = np.geomspace(1e-2, 3e4, 400_001)
        pairs = zip(poles, residues, strict=True)
        reply = sum(share / (1j * omega - pole) for pole, share in pairs)
        reply = np.exp(-1j * omega * loop.delay) * reply
        by_hand = swept(reply)
        result = gain_margin(loop), phase_margin(loop)
        if not np.allclose(result, by_hand, rtol=2e-3, atol=2e-3):
            off.append((result, by_hand))
    return off


def test_margins_of_late_loops_are_those_of_a_dense_sweep():
    assert not late_differences(60)


@pytest.mark.parametrize("gain, margin", [(-0.5, 4.0), (-1.9, 2.0 / 1.9), (0.5, math.inf)])
def test_a_loop_may_leave_at_standstill_or_never(gain, margin):
    loop = chain(gain, 1.0, 2.0)
    assert gain_margin(loop) == pytest.approx(margin, rel=1e-6)
    assert phase_margin(chain(0.5, 1.0)) == math.inf


def rig_loops(count: int, delays: tuple[float, ...] = (0.0, 1e-3)) -> Iterator[OpenLoop]:
    """Stable loops of two rigs at random operating points, laws and gains."""
    rng = np.random.default_rng(3)
    about = {"postures": 2, "speed_shares": (0.4,), "draws": 0, "cylinder": "boom"}
    about |= {"low_pressure": "8 bar", "cross_drop": "8 bar"}
    recipe = TuneRecipe(stage="tune", rig="x", **about)
    rigs = map(shipped, ("boom_four_valve", "thesis_arm"))
    motions = [one for rig in rigs for one in prepare_tuning(rig, None, recipe).motions]
    while count > 0:
        ways = ([0.0, 2.0, 20.0], [0.0, 0.0, 1e-11], delays, [0.0, 5.0], ["metered", "load"])
        law = Law(*map(rng.choice, ways))
        loop = motions[rng.integers(len(motions))].loop(law)
        for item in _open_loops(loop, 10.0 ** rng.uniform(-12.0, -9.0)):
            if item.growth() <= 0.0:
                count -= 1
                yield item


def rig_differences(count: int) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """((gain, phase) margins, the same by poles that are made to cross the axis) where they
    differ."""
    off = []
    for loop in rig_loops(count):
        way = np.outer(loop.b, loop.c)
        factor = math.exp(crossing(loop.a, way, np.geomspace(1.0, 1e4, 400)))
        angle = crossing(loop.a, way, np.exp(1j * np.linspace(0.0, 0.9999 * math.pi, 400)))
        gain, phase = gain_margin(loop), phase_margin(loop)
        gain, phase = (gain if gain < 1e4 else math.inf), (phase if phase < 3.14 else math.inf)
        # a slow pole has to grow by more than rounding before it counts
        if not (np.isclose(gain, factor, rtol=0.01) and np.isclose(phase, angle, atol=0.005)):
            off.append(((gain, phase), (factor, angle)))
    return off


@pytest.mark.slow
def test_margins_of_rigs_are_where_their_poles_cross():
    assert not rig_differences(60)


def test_the_response_of_a_rig_has_its_delay_exactly():
    """Against the matrices without Padé's states: what a pressure does late turns with e^(−jωT)."""
    for loop in rig_loops(6, (20e-3,)):
        size, ends = loop.late.start, range(loop.late.start + 1, loop.late.stop, 2)
        rest = [i for i in range(len(loop.a)) if not loop.late.start <= i < loop.late.stop]
        for omega in (3.0, 100.0, 157.1, 900.0):
            a, c, turn = loop.a.astype(complex), loop.c.astype(complex), np.exp(-1j * omega * 20e-3)
            for end in ends:
                source = int(np.abs(loop.a[end, :size]).argmax())
                for of, late in ((a, loop.a[:, end]), (c, loop.c[end])):
                    of[..., source] += (turn - 1.0) * late / -math.sqrt(12.0)
            inverse = np.linalg.inv(1j * omega * np.eye(len(rest)) - a[np.ix_(rest, rest)])
            by_hand = c[rest] @ inverse @ loop.b[rest]
            assert loop.response(np.array([omega]))[0] == pytest.approx(by_hand, rel=1e-6)
