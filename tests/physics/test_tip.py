"""The tip of a mechanism, and the search for joint coordinates that bring it somewhere."""

import numpy as np
import pytest

from ehbench.parts.cylinder import joint_range_of
from ehbench.physics.arm import energy, work_size
from ehbench.physics.tip import FOUND, Chain, polish, reach, tip_frames, tip_jacobian, tip_of
from ehbench.plant.model import Model
from tests.shared import shipped

NAMES = ("thesis_arm", "crane_proportional", "boom_four_valve", "slide_servo")


def chain_of(name):
    plant = Model.of(shipped(name)).plant
    low, high = np.array([sorted(joint_range_of(row)) for row in plant.cylinders]).T
    return Chain(plant.kind, plant.links, plant.gravity, low, high)


@pytest.fixture(scope="module", params=NAMES)
def chain(request):
    return chain_of(request.param)


def postures(chain, count, seed=1):
    share = np.random.default_rng(seed).uniform(0.05, 0.95, (count, chain.low.size))
    return chain.low + share * (chain.high - chain.low)


def test_the_jacobian_is_the_slope_of_the_tip(chain):
    for q in postures(chain, 5):
        for j, column in enumerate(tip_jacobian(chain, tip_frames(chain, q)).T):
            step = 1e-6 * np.eye(q.size)[j]
            slope = (tip_of(chain, q + step) - tip_of(chain, q - step)) / 2e-6
            assert np.abs(slope - column).max() < 1e-8


def test_the_tip_is_as_high_as_a_mass_there_weighs():
    """By the potential energy of the equations of motion, of 1 kg at the end of the last link."""
    from ehbench.control.axis import _tip

    for name in NAMES:
        chain = chain_of(name)
        tip, n = _tip(chain.kind, chain.links), chain.low.size
        g, work = np.linalg.norm(chain.gravity), np.zeros(work_size(n))
        for q in postures(chain, 3):
            _, potential = energy(chain.kind, tip, chain.gravity, q, np.zeros(n), work)
            assert tip_of(chain, q)[2] == pytest.approx(potential / g, abs=1e-12)


def test_what_forward_kinematics_reach_is_found_again(chain):
    free = np.ones(chain.low.size, bool)
    middle = 0.5 * (chain.low + chain.high)
    for q in postures(chain, 20):
        found = reach(chain, tip_of(chain, q), middle, free)
        assert found.there and found.miss <= FOUND and not found.beyond.any()
        assert np.abs(found.q - q).max() < 1e-6, "within the strokes there is one posture"
    free, q = np.ones(chain.low.size, bool), postures(chain, 10)
    found, miss = polish(chain, tip_of(chain, q), q + 1e-2 * (chain.high - chain.low), free)
    assert miss.max() <= FOUND and np.abs(found - q).max() < 1e-6


def test_six_joints_find_their_tip_and_stay_near_where_they_were():
    links = np.concatenate([chain_of("thesis_arm").links] * 2).view(np.recarray)
    wide = np.full(6, 2.0)
    chain = Chain(0, links, np.array([0.0, 0.0, 9.8]), -wide, wide)
    q = np.random.default_rng(2).uniform(-0.8, 0.8, 6)
    target = tip_of(chain, q) + (0.01, -0.01, 0.01)
    found = reach(chain, target, q, np.ones(6, bool))
    assert found.there and np.linalg.norm(tip_of(chain, found.q) - target) <= FOUND
    assert np.abs(found.q - q).max() < 0.1


def test_out_of_reach_it_comes_as_near_as_it_can():
    chain = chain_of("thesis_arm")
    middle, free = 0.5 * (chain.low + chain.high), np.ones(3, bool)
    far = np.array([5.0, 0.0, 0.5])
    found = reach(chain, far, middle, free)
    assert not found.there
    grid = [np.linspace(a, b, 25) for a, b in zip(chain.low, chain.high)]
    places = tip_of(chain, np.stack(np.meshgrid(*grid), -1).reshape(-1, 3))
    nearest = np.linalg.norm(places - far, axis=1).min()
    assert found.miss == pytest.approx(nearest, abs=2e-2) and found.miss <= nearest
    held = reach(chain, tip_of(chain, chain.low), middle, np.array([False, True, True]))
    assert not held.there and held.q[0] == middle[0]
