"""Cylinder geometry, chambers and end stops against closed forms."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from ehbench.parts.cylinder import CYLINDER, VOLUME_MARGIN, chamber_inflow, chamber_oil
from ehbench.parts.end_stop import STOP_DISSIPATION, stop_force
from ehbench.parts.nodes import NODE
from ehbench.physics import cylinder
from ehbench.runtime.compiled import table, table_of
from ehbench.vocabulary.errors import InputError

# SPEC 1: (kind, l_A, l_B, sign, phase, retracted), stroke, joint range in degrees
THESIS = {
    "swing": ((cylinder.PINS, 0.70, 0.20, 1, math.radians(80.0), 0.55), 11 * 0.0254, (-44, 44)),
    "boom": ((cylinder.PINS, 0.55, 0.25, 1, math.radians(95.5), 0.50), 10 * 0.0254, (-30, 42)),
    "stick": ((cylinder.PINS, 0.70, 0.22, -1, 0.0, 0.55), 12 * 0.0254, (-40, -129)),
}
AREA_HEAD, AREA_ROD, BULK, FLOOR = 2.0268e-3, 1.0688e-3, 2.71e8, -0.9e5
AREAS = (AREA_HEAD, AREA_ROD)
SLIDE = (cylinder.DIRECT, 0.0, 0.0, 1, 0.0, 0.0)
THESIS_CASES = pytest.mark.parametrize(
    ("geometry", "stroke", "degrees"), THESIS.values(), ids=THESIS
)


def row(**given):
    """The row of a cylinder."""
    return table_of([given], CYLINDER)[0]


def rk4(rate, state, step, count):
    """Fixed-step RK4 of an autonomous ``rate``; all states, shape (count + 1, len(state))."""
    states = [np.asarray(state, dtype=float)]
    for _ in range(count):
        y = states[-1]
        k1 = rate(y)
        k2 = rate(y + 0.5 * step * k1)
        k3 = rate(y + 0.5 * step * k2)
        k4 = rate(y + step * k3)
        states.append(y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return np.array(states)


@THESIS_CASES
def test_joint_range_lever_and_its_inverse_of_the_thesis(geometry, stroke, degrees):
    # pyrefly: ignore[bad-argument-count]
    ends = np.degrees(cylinder.joint_range(*geometry, stroke))
    assert ends == pytest.approx(degrees, abs=0.5)  # SPEC prints whole degrees
    h = 1e-5  # truncation h² = 1e-10 of the value, rounding 1e-16 / h = 1e-11
    # pyrefly: ignore[bad-argument-count]
    for q in np.linspace(*cylinder.joint_range(*geometry, stroke), 15):
        below, here, above = (cylinder.linkage(*geometry, q + k * h) for k in (-1, 0, 1))
        assert here[1] == pytest.approx((above[0] - below[0]) / (2 * h), abs=1e-9)
        assert here[2] == pytest.approx((above[1] - below[1]) / (2 * h), abs=1e-9)
        assert here[1] * geometry[3] > 0
    x = np.linspace(0.0, stroke, 50)
    # pyrefly: ignore[bad-argument-count]
    q = cylinder.joint_angle(*geometry, x)
    assert [cylinder.linkage(*geometry, value)[0] for value in q] == pytest.approx(x, abs=1e-14)
    # pyrefly: ignore[bad-argument-count]
    assert cylinder.joint_angle(*geometry, x[7]) == q[7]


def test_linkages_by_hand_at_dead_points_and_of_a_slide():
    """Pins 3 and 4 m from the joint at a right angle are 5 m apart."""
    state = cylinder.linkage(cylinder.PINS, 3.0, 4.0, 1, math.pi / 2, 4.0, 0.0)
    assert state == pytest.approx((1.0, 12 / 5, -(2.4**2) / 5), rel=1e-14)
    geometry = (cylinder.PINS, 0.5, 0.3, 1, 0.0, 0.0)
    assert cylinder.joint_angle(*geometry, 0.5 - 0.3) == 0.0
    assert cylinder.joint_angle(*geometry, 0.5 + 0.3) == pytest.approx(math.pi, abs=1e-15)
    assert cylinder.linkage(*geometry, 0.0)[:2] == pytest.approx((0.2, 0.0), abs=1e-15)
    assert cylinder.linkage(*SLIDE, 0.3) == (0.3, 1.0, 0.0)
    assert cylinder.joint_angle(*SLIDE, 0.3) == 0.3
    assert cylinder.joint_range(*SLIDE, 0.5) == (0.0, 0.5)


@pytest.mark.parametrize("x", [-0.31, 0.41, math.nan])
def test_a_stroke_out_of_reach_is_refused(x):
    with pytest.raises(InputError, match="does not fit its linkage.*200 to 800 mm"):
        cylinder.joint_angle(cylinder.PINS, 0.5, 0.3, 1, 0.0, 0.4, np.array([0.0, x]))


PISTON = row(area_head=AREA_HEAD, area_rod=AREA_ROD, volume_head=4e-4, volume_rod=9e-4)


class Chambers(NamedTuple):
    """One cylinder whose pressures are the whole state: head, rod; tank pressure fixed."""

    nodes: np.recarray


def rates(
    v=0.0, into=(0.0, 0.0), p=(1e6, 2e6), leaks=(0.0, 0.0, 0.0), volumes=(4e-4, 9e-4), areas=AREAS
):
    """(ṗ_head, ṗ_rod) [Pa/s] for speed, inflows, pressures, and three leakages."""
    nodes, row = table(4, NODE), table(1, CYLINDER)[0]
    nodes.state = (-1, -1, 0, 1)
    nodes[1].pressure = 1e5
    row.node_head, row.node_rod = 2, 3
    row.area_head, row.area_rod = areas
    row.leakage_internal, row.leakage_head, row.leakage_rod = leaks
    row.relief_pressure = math.inf
    found = []
    for side in range(2):
        inflow = chamber_inflow(row, side, v, into[side], np.array(p), Chambers(nodes))
        found.append(cylinder.chamber_rate(inflow, p[side], volumes[side], BULK, FLOOR))
    return tuple(found)


def test_chamber_rates_term_by_term():
    """Each term of thesis 2.4 and 2.5 alone."""
    head, rod = BULK / 4e-4, BULK / 9e-4
    c = 1e-12
    assert rates(into=(1e-4, 0.0)) == pytest.approx((head * 1e-4, 0.0), rel=1e-14)
    assert rates(into=(0.0, -1e-4)) == pytest.approx((0.0, -rod * 1e-4), rel=1e-14)
    assert rates(v=0.1) == pytest.approx((-head * AREA_HEAD * 0.1, rod * AREA_ROD * 0.1), rel=1e-14)
    assert rates(leaks=(c, 0, 0)) == pytest.approx((head * c * 1e6, -rod * c * 1e6), rel=1e-14)
    assert rates(leaks=(0, c, 0)) == pytest.approx((-head * c * 0.9e6, 0.0), rel=1e-14)
    assert rates(leaks=(0, 0, c)) == pytest.approx((0.0, -rod * c * 1.9e6), rel=1e-14)


def test_head_and_rod_mirror():
    """Swap the ends, the areas and the directions: the two rates swap."""
    c = (2e-12, 3e-12, 5e-12)
    one = rates(0.2, (1e-4, -3e-4), (1e6, 2e6), c)
    swapped = (c[0], c[2], c[1])
    two = rates(-0.2, (-3e-4, 1e-4), (2e6, 1e6), swapped, (9e-4, 4e-4), AREAS[::-1])
    assert two == pytest.approx(one[::-1], rel=1e-14)


def test_a_guard_keeps_a_volume():
    assert chamber_oil(PISTON, 1, 0.3) == 9e-4 - AREA_ROD * 0.3
    assert chamber_oil(PISTON, 1, 5.0) == VOLUME_MARGIN * 9e-4


def test_cavitation_is_reversible_and_its_rate_continuous():
    rate = cylinder.chamber_rate
    stiff = BULK / 4e-4 * 1e-5
    assert rate(1e-5, FLOOR, 4e-4, BULK, FLOOR) == pytest.approx(stiff, rel=1e-14)
    assert rate(-1e-5, FLOOR, 4e-4, BULK, FLOOR) == 0.0
    assert rate(-1e-5, FLOOR - 1e4, 4e-4, BULK, FLOOR) > 0.0
    assert rate(-1e-5, FLOOR + cylinder.CAVITATION_BAND, 4e-4, BULK, FLOOR) == pytest.approx(
        -stiff, rel=1e-14
    )
    assert rate(-1e-5, -1e9, 4e-4, BULK, -math.inf) == pytest.approx(-stiff, rel=1e-14)
    # Over the top of the band and through zero flow: RK4 meets kinks but no jumps
    top = FLOOR + cylinder.CAVITATION_BAND
    for p, flow in ((top, -1e-4), (FLOOR, -1e-4), (FLOOR + 1e4, 0.0)):
        values = [
            cylinder.chamber_rate(flow + df, p + dp, 4e-4, BULK, FLOOR)
            for dp in (-1e-3, 1e-3)
            for df in (-1e-13, 1e-13)
        ]
        # 2e-3 Pa of 0.9e5 Pa of the full rate 6.8e7 Pa/s, and 2e-13 m³/s of β/V = 6.8e11
        assert max(values) - min(values) <= 2e-3 / 0.9e5 * 6.8e7 + 2e-13 * 6.8e11


def test_oil_balance_closes_with_makeup_and_relief_opens_one_way():
    def rate(state):
        inflow = -3e-5 * math.cos(40.0 * state[2])
        made = cylinder.makeup_flow(inflow, state[0], FLOOR)
        return np.array(
            [cylinder.chamber_rate(inflow, state[0], 4e-4, BULK, FLOOR), made, 1.0, inflow]
        )

    p, made, _, inflow = rk4(rate, [0.0, 0.0, 0.0, 0.0], 1e-4, 2000)[-1]
    assert made > 1e-8
    assert p * 4e-4 / BULK == pytest.approx(made + inflow, rel=0, abs=1e-12 * made)
    assert cylinder.relief_flow(99e5, 100e5) == 0.0
    assert cylinder.relief_flow(105e5, 100e5) == pytest.approx(5e-4, rel=1e-12)
    assert cylinder.relief_flow(1e12, math.inf) == 0.0


def test_end_stop_never_pulls_and_is_continuous():
    rng = np.random.default_rng(0)
    stroke, k = 0.254, 1e8
    stops = row(stroke=stroke, stop_stiffness=k)
    for x, v in zip(
        rng.uniform(-0.02, stroke + 0.02, 2000), rng.normal(scale=1.0, size=2000), strict=True
    ):
        force = stop_force(stops, x, v)
        if x < 0:
            assert force >= 0
        elif x > stroke:
            assert force <= 0
        else:
            assert force == 0
        # the other end is the mirror image; x and stroke − x differ by a rounding of the stroke
        mirrored = pytest.approx(-force, rel=1e-9, abs=k * 1e-15)
        assert stop_force(stops, stroke - x, -v) == mirrored
    assert stop_force(stops, -1e-3, 0.0) == pytest.approx(1e5, rel=1e-14)
    assert stop_force(stops, -1e-12, -3.0) == pytest.approx(0.0, abs=k * 1e-12 * 16)


def test_bounce_loses_what_the_dissipation_says():
    """Restitution 1 − (2/3) d v for small d v (Hunt & Crossley)."""
    mass, d, v0 = 500.0, STOP_DISSIPATION, -0.01
    stops = row(stroke=0.3, stop_stiffness=1e7)

    def rate(state):
        return np.array([state[1], stop_force(stops, state[0], state[1]) / mass])

    path = rk4(rate, [0.0, v0], 1e-5, 3000)
    assert path[-1, 0] > 0
    # the next term of the series is of order (d v)² = 2.5e-3
    assert path[-1, 1] / -v0 == pytest.approx(1 - 2 / 3 * d * -v0, abs=2.5e-3)
