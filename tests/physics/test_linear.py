"""The linear model against the plant, closed forms, energy, the compiled controller."""

import math

import numpy as np
import pytest
from plant_differences import plant_model, points, steady_rates

from ehbench.physics import arm
from ehbench.physics.cylinder import joint_angle
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.tune.linear import development_model, faster
from ehbench.tune.loop import dominant
from ehbench.tune.operating_point import Aim, equivalent, operating_point, state_of
from ehbench.vocabulary.codes import EXTEND_OVERRUNNING, FUNCTIONS
from tests.shared import refused, shipped

MACHINES = [
    ("thesis_arm", "boom", None),
    ("thesis_arm", "boom", "50 lb"),
    ("thesis_arm", "stick", "50 lb"),
    ("boom_four_valve", "boom", "bucket"),
    ("crane_proportional", "lift", None),
    ("slide_servo", "press", "100 kg"),
]


def machine(rig, cylinder, payload=None, **values):
    given = shipped(rig)
    model = Model.of(given.with_values(values) if values else given, None, payload)
    index = model.layout.cylinders.index(cylinder)
    return model, index, circuit_of(model, index)


def scales(linear):
    """Sizes of the states: m/s, MPa, V, 100 V/s."""
    s = np.ones(len(linear.states))
    s[1:3], s[4::2] = 1e6, 100.0
    return s


@pytest.mark.parametrize("case", MACHINES, ids=lambda c: "-".join(map(str, c)))
def test_equations_agree_with_differences_of_the_plant(case):
    model, index, circuit = machine(*case)
    count = 0
    for point in points(model, index, circuit):
        ours, plant = development_model(model, point), plant_model(model, point)
        s = scales(ours)
        a, b = ours.a * s / s[:, None], ours.b / s[:, None]
        row = np.abs(a).max(axis=1, keepdims=True)
        # 1e-7 of a row's largest: central differences are good to 1e-8 here (slopes of the flow
        # laws among them)
        assert (np.abs(a - plant.a * s / s[:, None]) <= 1e-7 * row).all(), point.name
        assert (np.abs(b - plant.b / s[:, None]) <= 1e-7 * np.abs(b).max()).all(), point.name
        count += 1
    assert count >= 12
    rig, cylinder, payload = case
    given = {"leakage_internal": 2e-12, "leakage_head": 1e-12, "leakage_rod": 3e-12}
    given |= {"friction_viscous": 900.0, "friction_coulomb": 300.0}
    extra = {f"{cylinder}.{key}": value for key, value in given.items()}
    model, index, circuit = machine(rig, cylinder, payload, **extra)
    for point in points(model, index, circuit, shares=(0.5,), strokes=(0.4,)):
        ours, plant = development_model(model, point), plant_model(model, point)
        s = scales(ours)
        size = np.abs(ours.a * s / s[:, None]).max(axis=1, keepdims=True)
        # the slope of smoothed Coulomb friction is steep in v: differences over 1e-5 m/s are good
        # to 1e-4 of it
        assert (np.abs((ours.a - plant.a) * s / s[:, None]) <= 1e-4 * size).all(), point.name


@pytest.mark.parametrize("case", MACHINES, ids=lambda c: "-".join(map(str, c)))
def test_an_operating_point_is_a_steady_motion(case):
    model, index, circuit = machine(*case)
    plant, n = model.plant, len(model.layout.joints)
    for point in points(model, index, circuit):
        rate, (y, _) = steady_rates(model, point), state_of(model, point)
        mass = np.empty((n, n))
        arm.mass_matrix(plant.kind, plant.links, y[:n], mass, np.empty(arm.work_size(n)))
        joint = plant.cylinders[index].joint
        held = mass[joint] @ rate[n : 2 * n] / mass[joint, joint]
        # lever'/lever²·v²: what keeps the cylinder's speed, not the joint's
        push = point.lever * held + 0.5 * point.bend * point.v
        assert abs(push) <= 1e-9 * abs(point.load_force) / point.mass + 1e-9, point.name


@pytest.mark.parametrize("case", MACHINES, ids=lambda c: "-".join(map(str, c)))
def test_equivalents_against_energy(case):
    model, index, _ = machine(*case)
    plant, joint = model.plant, int(model.plant.cylinders[index].joint)
    row = plant.cylinders[index]
    n = len(model.layout.joints)
    work, v = np.empty(arm.work_size(n)), 0.3
    for x in np.linspace(0.1, 0.9, 5) * row.stroke:
        here = equivalent(model, index, np.array([x - 1e-4, x, x + 1e-4]))
        potential = []
        for at in range(3):
            q, qd = model.posture(None), np.zeros(n)
            linkage = row.geometry, row.l_a, row.l_b, row.side, row.phase, row.retracted_length
            q[joint] = joint_angle(*linkage, here.x[at])
            qd[joint] = v / here.lever[at]
            kinetic, height = arm.energy(plant.kind, plant.links, plant.gravity, q, qd, work)
            potential.append(height)
            assert kinetic == pytest.approx(0.5 * here.mass[at] * v**2, rel=1e-12)
            with_rate, at_rest = np.empty(n), np.empty(n)
            arm.turn(plant.links, q, work)
            arm.bias_turned(plant.kind, plant.links, plant.gravity, qd, with_rate, work)
            arm.bias_turned(plant.kind, plant.links, plant.gravity, np.zeros(n), at_rest, work)
            # one joint alone feels no Coriolis torque of its own, so the rest is damping
            lost = (with_rate - at_rest)[joint] * qd[joint]
            assert lost == pytest.approx(here.damping[at] * v**2, rel=1e-9)
        # central difference over 0.1 mm: (h²/6)·F'' is below 1e-6 of F
        slope = (potential[2] - potential[0]) / 2e-4
        assert slope == pytest.approx(here.gravity_force[1], rel=1e-5, abs=1e-6)


def test_free_joints_matter_and_faster_valves_keep_their_damping():
    for case, same in ((MACHINES[1], False), (MACHINES[3], True)):
        model, index, circuit = machine(*case)
        point = next(points(model, index, circuit))
        held, free = plant_model(model, point), plant_model(model, point, others="free")
        assert np.allclose(held.a, free.a, rtol=1e-9) is same
        assert np.allclose(held.e, free.e, rtol=1e-9) is same
    model, index, circuit = machine("boom_four_valve", "boom")
    linear = development_model(model, next(points(model, index, circuit)))
    quick = faster(linear, 10.0)
    for one, times in ((linear, 1.0), (quick, 10.0)):
        block = one.a[3:5, 3:5]
        assert -block[1, 0] == pytest.approx((times * 2 * math.pi * 30) ** 2, rel=1e-9)
        assert -block[1, 1] == pytest.approx(2 * times * 2 * math.pi * 30, rel=1e-9)


def test_position_adds_a_slow_pole_and_little_else():
    model, index, circuit = machine("thesis_arm", "boom", None)
    for point in points(model, index, circuit, shares=(0.3,), strokes=(0.5,)):
        if not point.fits:
            continue
        both = (plant_model(model, point, position=on).a for on in (False, True))
        without, with_x = map(np.linalg.eigvals, both)
        # over a metre posture changes everything; within a swing of a few Hz a moving posture is
        # worth a few per cent
        assert abs(dominant(with_x)) == pytest.approx(abs(dominant(without)), rel=0.05)


def test_refusals():
    model, index, circuit = machine("crane_proportional", "lift")
    here = equivalent(model, index, np.array([0.3]))
    with refused("tune.unable"):
        cross = FUNCTIONS.index("retract_overrunning_regeneration")
        operating_point(model, circuit, cross, here, 0, Aim(1e5, 1e5, speed=0.1))


def test_a_path_that_leakage_outdoes_is_out_of_reach():
    leak = 1e-11
    values = {"lift.leakage_internal": leak}
    model, index, circuit = machine("crane_proportional", "lift", **values)
    here = equivalent(model, index, np.array([0.2]))
    for speed, reached in ((1e-3, False), (0.05, True)):
        aim = Aim(1e5, 1e5, speed=speed)
        point = operating_point(model, circuit, EXTEND_OVERRUNNING, here, 0, aim)
        out = speed * model.plant.cylinders[index].area_rod - leak * (point.p_rod - point.p_head)
        path = next(path for path in point.paths if path.metering)
        assert (out > 0.0) == path.reachable == reached
