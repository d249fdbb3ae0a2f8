"""The arm against MuJoCo and against closed forms."""

import math

import mujoco
import numpy as np
import pytest

from ehbench.physics import arm
from ehbench.physics.tip import Chain, tip_of
from ehbench.runtime.compiled import table_of

G = 9.81
# up is no axis of the base frame, so that no entry can be forgotten
GRAVITY = np.array([2.9, 7.3, -5.9])
SIZES = (1, 2, 3, 6)


def random_body(rng):
    """Mass, centre and a physically possible inertia tensor: that of six point masses."""
    points, weights = rng.normal(scale=0.3, size=(6, 3)), rng.uniform(0.5, 3.0, 6)
    com = weights @ points / weights.sum()
    arms = points - com
    parts = (w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weights, arms, strict=True))
    return weights.sum(), com, sum(parts)


def random_chain(n, rng):
    """Rows of ``links``, and the numbers that went into them."""
    given = [
        (*rng.uniform(-1, 1, 2), *rng.uniform(-3, 3, 2), *random_body(rng), rng.uniform(0, 5))
        for _ in range(n)
    ]
    return table_of([arm.pack_link(*row) for row in given], arm.LINK), given


def mujoco_model(given):
    """The same chain in MuJoCo: bodies are link-end frames, the joint at their begin."""

    def text(values):
        return " ".join(repr(float(v)) for v in values)

    body, close = "", ""
    for a, d, alpha, theta, mass, com, j, damping in given:
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        axes = (c, s, 0.0, -s * ca, c * ca, sa)
        full = (j[0, 0], j[1, 1], j[2, 2], j[0, 1], j[0, 2], j[1, 2])
        body += (
            f'<body pos="{text((a * c, a * s, d))}" xyaxes="{text(axes)}">'
            f'<joint type="hinge" pos="{text((-a, -d * sa, -d * ca))}" axis="{text((0, sa, ca))}" '
            f'damping="{damping!r}"/>'
            f'<inertial pos="{text(com)}" mass="{float(mass)!r}" fullinertia="{text(full)}"/>'
        )
        close += "</body>"
    xml = (
        '<mujoco><compiler angle="radian"/><option '
        f'gravity="{text(-GRAVITY)}"/><worldbody>{body}{close}</worldbody></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(xml)
    return model, mujoco.MjData(model)


def states(n, rng, count=20):
    for _ in range(count):
        angles = rng.uniform(-math.pi, math.pi, n)
        yield angles, rng.normal(scale=2.0, size=n), rng.normal(scale=100.0, size=n)


def tip(links, q, kind=arm.CHAIN):
    """The tip with z up."""
    return tip_of(Chain(kind, links, np.array([0.0, 0.0, G]), -np.inf, np.inf), q)


def kernels(links):
    """The kernels as functions that return new arrays."""
    n, work = links.shape[0], np.full(arm.work_size(links.shape[0]), np.nan)
    kind = arm.CHAIN

    def bias(q, qd, gravity=GRAVITY):
        arm.turn(links, q, work)
        arm.bias_turned(kind, links, gravity, qd, out := np.empty(n), work)
        return out

    def mass(q):
        arm.mass_matrix(kind, links, q, out := np.empty((n, n)), work)
        return out

    def forward(q, qd, torque, added=0.0):
        drive = np.append(torque, np.broadcast_to(added, n))
        arm.forward(kind, links, GRAVITY, q, qd, drive, out := np.empty(n), work)
        return out

    def weight(q):
        arm.gravity_torque(kind, links, GRAVITY, q, out := np.empty(n), work)
        return out

    return bias, mass, forward, weight, lambda q, qd: arm.energy(kind, links, GRAVITY, q, qd, work)


@pytest.mark.parametrize("n", SIZES)
def test_agrees_with_mujoco(n):
    rng = np.random.default_rng(n)
    links, given = random_chain(n, rng)
    model, data = mujoco_model(given)
    bias, mass, forward, weight, energy = kernels(links)
    for q, qd, torque in states(n, rng):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, qd, torque
        mujoco.mj_forward(model, data)
        full = np.empty((n, n))
        mujoco.mj_fullM(model, data, full)
        # 1e-12 of the largest entry is a hundred roundings of the 400 terms of six joints
        assert mass(q) == pytest.approx(full, rel=0, abs=1e-12 * np.abs(full).max())
        assert (mass(q) == mass(q).T).all()
        expected = data.qfrc_bias - data.qfrc_passive
        slack = 1e-12 * (10 + np.abs(expected).max())
        assert bias(q, qd) == pytest.approx(expected, rel=0, abs=slack)
        assert weight(q) == pytest.approx(bias(q, np.zeros(n)), rel=0, abs=slack)
        # the acceleration may lose the digits that the condition of the mass matrix costs
        slack = (1e-15 * np.linalg.cond(full) + 1e-12) * np.abs(data.qacc).max()
        assert forward(q, qd, torque) == pytest.approx(data.qacc, rel=0, abs=slack)
        assert tip(links, q) == pytest.approx(data.xpos[-1], rel=0, abs=1e-12)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        slack = 1e-12 * (10 + abs(data.energy).sum())
        assert energy(q, qd) == pytest.approx(data.energy[::-1], rel=0, abs=slack)


def test_pendulum_by_hand_and_a_shorter_chain():
    """One link about a horizontal axis: D = I + m l², c = m g l cos q."""
    # joint 1 turns about the vertical, so the pendulum is joint 2
    upright = arm.pack_link(0, 0, math.pi / 2, 0, 1.0, (0, 0, 0), np.eye(3), 0.0)
    bob = arm.pack_link(2.0, 0, 0, 0, 3.0, (-0.5, 0, 0), np.diag([0.1, 0.2, 0.3]), 0.7)
    links = table_of([upright, bob], arm.LINK)
    bias, mass, _, _, _ = kernels(links)
    q, qd = np.array([0.3, 0.4]), np.array([0.0, 2.0])
    assert mass(q)[1, 1] == pytest.approx(0.3 + 3.0 * 1.5**2, rel=1e-14)
    torque = 3.0 * G * 1.5 * math.cos(0.4) + 0.7 * 2.0
    assert bias(q, qd, np.array([0.0, 0.0, G]))[1] == pytest.approx(torque, rel=1e-14)
    level = 2.0 * math.cos(0.4)
    end = level * math.cos(0.3), level * math.sin(0.3), 2.0 * math.sin(0.4)
    assert tip(links, q) == pytest.approx(end, rel=1e-14)
    links, _ = random_chain(3, np.random.default_rng(1))
    q = np.array([0.1, 0.2, 0.3])
    way = math.hypot(links[2].a, links[2].d)
    assert np.linalg.norm(tip(links, q) - tip(links[:2], q[:2])) == pytest.approx(way, rel=1e-13)


def test_slide_on_an_incline():
    incline, m, b = 0.3, 20.0, 50.0
    links = table_of([arm.pack_slide(m, b, incline)], arm.LINK)
    q, qd, drive = np.array([0.4]), np.array([0.2]), np.array([100.0, 0.0])
    out, full, work = np.empty(1), np.empty((1, 1)), np.empty(arm.work_size(1))
    weight, pull = m * G * math.sin(incline), np.array([0.0, 0.0, G])
    arm.bias_turned(arm.SLIDE, links, pull, qd, out, work)
    assert out[0] == pytest.approx(weight + b * 0.2, rel=1e-14)
    arm.gravity_torque(arm.SLIDE, links, pull, q, out, work)
    assert out[0] == pytest.approx(weight, rel=1e-14)
    arm.mass_matrix(arm.SLIDE, links, q, full, work)
    assert full[0, 0] == m
    arm.forward(arm.SLIDE, links, pull, q, qd, drive, out, work)
    assert out[0] == pytest.approx((100.0 - weight - b * 0.2) / m, rel=1e-13)
    held = arm.energy(arm.SLIDE, links, pull, q, qd, work)
    assert held == pytest.approx((0.5 * m * 0.2**2, weight * 0.4), rel=1e-14)
    end = 0.4 * math.cos(incline), 0.0, 0.4 * math.sin(incline)
    assert tip(links, q, arm.SLIDE) == pytest.approx(end, rel=1e-14)


def test_acceleration_may_overwrite_the_torque():
    rng = np.random.default_rng(60)
    links, _ = random_chain(3, rng)
    _, _, forward, _, _ = kernels(links)
    q, qd, torque = next(states(3, rng))
    expected, shared = forward(q, qd, torque), np.append(torque, np.zeros(3))
    arm.forward(arm.CHAIN, links, GRAVITY, q, qd, shared, shared, np.empty(arm.work_size(3)))
    assert (shared[:3] == expected).all()


@pytest.mark.parametrize("n", SIZES)
def test_inertia_may_be_added_to_a_joint(n):
    """Against MuJoCo's armature of a joint."""
    rng = np.random.default_rng(n)
    links, given = random_chain(n, rng)
    model, data = mujoco_model(given)
    _, _, forward, _, _ = kernels(links)
    for q, qd, torque in states(n, rng, 3):
        model.dof_armature[:] = added = rng.uniform(0.0, 3.0, n)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, qd, torque
        mujoco.mj_forward(model, data)
        slack = 1e-10 * np.abs(data.qacc).max()
        assert forward(q, qd, torque, added) == pytest.approx(data.qacc, rel=0, abs=slack)


def test_workspace_is_not_overrun():
    rng = np.random.default_rng(61)
    for n in SIZES:
        links, _ = random_chain(n, rng)
        work = np.full(arm.work_size(n) + 8, 7.0)
        q, qd, torque = next(states(n, rng))
        out, drive = np.empty(n), np.append(torque, np.zeros(n))
        arm.forward(arm.CHAIN, links, GRAVITY, q, qd, drive, out, work[:-8])
        arm.gravity_torque(arm.CHAIN, links, GRAVITY, q, out, work[:-8])
        assert (work[-8:] == 7.0).all() and np.isfinite(out).all()
