"""Margins of adaptive robust control: the linear check says where the model swings."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from delayed_loop import GAINS, TICK, Bench

from ehbench.machines.simulated import model_tick
from ehbench.parts.sample import sample_channels
from ehbench.parts.valve.delay import line_of
from ehbench.tune import arc_loop
from ehbench.tune.arc_loop import ArcLoop, Sampled, SampledPlant, Sensing
from ehbench.tune.operating_point import state_of
from ehbench.vocabulary.codes import DISTURBANCE, INVERSE_INERTIA
from tests.shared import shipped


@cache
def bench(name, cylinder):
    return Bench(shipped(name), cylinder, shares=(0.06,))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "gains"),
    [*(("thesis_arm", gains) for gains in GAINS), ("boom_four_valve", "defaults")],
)
def test_the_delay_margin_is_where_the_model_begins_to_swing(name, gains):
    """Within 20 %, at the point with the least margin, its neighbours free on their oil."""
    rig = bench(name, "boom")
    packed = rig.gains(**GAINS[gains])
    margins, worst = rig.worst(packed)
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


# --- in closed form: an integrator K T z⁻ᵈ/(z − 1) in a loop

T, K = 1.0e-3, 100.0


def loop_of(a, b, gain, lagged=False):
    """A plant whose states are sensed, and a law without memory."""
    n, none = len(a), np.zeros((0, 0))
    plant = Sampled(np.array(a, float), np.array(b, float), np.eye(n), np.zeros((n, len(b[0]))))
    law = Sampled(none, np.zeros((0, n)), np.zeros((len(gain), 0)), np.array(gain, float))
    return ArcLoop(plant, law, T, np.full(n, lagged))


def turning(omega, growth):
    """A state that swings and grows, over a tick."""
    turn = omega * T + np.array([[0.0, -np.pi / 2], [np.pi / 2, 0.0]])
    return math.exp(growth * T) * np.cos(turn)


@pytest.mark.parametrize("late", [3, 8])
@pytest.mark.parametrize("gains", [(K,), (0.3 * K, K)])
def test_margins_of_late_integrators(gains, late):
    """The worst of several that share their valves: 2 sin(π/(4d + 2))/K T, π/2 − (d + ½) ω T."""
    count = len(gains)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]]) if count > 1 else np.eye(1)
    gain = -turn @ np.diag(gains) @ turn.T
    margins = loop_of(np.eye(count), T * np.eye(count), gain).margins(Sensing(late * T))
    omega = 2.0 * math.asin(0.5 * K * T) / T
    phase = 0.5 * math.pi - (late + 0.5) * omega * T
    assert margins.frequency == pytest.approx(omega, rel=1e-3)
    assert margins.phase == pytest.approx(phase, rel=2e-3)
    assert margins.delay == pytest.approx(phase / omega, rel=2e-3)
    assert margins.stated == pytest.approx(margins.delay / 1.5)
    least = 2.0 * math.sin(math.pi / (4 * late + 2)) / (K * T)
    assert margins.gain == pytest.approx(least, rel=2e-3)
    beyond = loop_of(np.eye(count), T * np.eye(count), 1.02 * least * gain)
    assert beyond.margins(Sensing(late * T)) == (0.0,) * 5


@pytest.mark.parametrize("late", [0, 3])
def test_a_lag_runs_away_without_a_swing(late):
    """z = p + (1 − p) k g z⁻ᵈ at z = e^(3T), where it grows as fast as the slowest swing."""
    keep, gain, z = math.exp(-20.0 * T), 0.3, math.exp(3.0 * T)
    loop = loop_of([[keep]], [[1.0 - keep]], [[gain]])
    margins = loop.margins(Sensing(late * T))
    assert margins.away == pytest.approx((z - keep) / (1.0 - keep) / gain * z**late, rel=1e-9)
    assert margins.stated_gain == margins.away and margins.delay == margins.phase == math.inf
    assert loop_of([[keep]], [[1.0 - keep]], [[-gain]]).margins(Sensing()).away == math.inf


def test_the_gain_margin_is_where_a_low_chamber_runs_away():
    """On a low supply the rod end is let to tank by the measured drop: commanded louder, that gives
    way more than the drop holds against it."""
    plain = shipped("boom_four_valve")
    low = plain.with_values({"supply.pressure": 0.22 * float(plain.supply.pressure)})
    rig = Bench(low, "boom", 1, (0.3,))
    gains = rig.gains()
    at = next(at for at in rig.points if at.point.function == "extend_resistive")
    margins = rig.loop(at, gains).margins(Sensing())
    margin = margins.stated_gain
    assert margins.gain > 5.0 * margin
    assert not rig.grows(at, gains, 0.0, 2.0e-6, 0.9 * margin, 0.7)
    assert rig.grows(at, gains, 0.0, 2.0e-6, 1.2 * margin, 0.7)


@pytest.mark.parametrize("lag", [0.0, 4.0e-3])
@pytest.mark.parametrize("late", [0.0, 0.3, 2.6])
def test_poles_are_roots_of_the_characteristic_polynomial(late, lag):
    """(z − 1)(z − e) zᵈ⁺¹ + K T (1 − e) z ((1 − s) z + s), read s of a tick before d."""
    keep, whole, share = math.exp(-T / lag) if lag else 0.0, int(late), late % 1.0
    polynomial = np.polymul([1.0, -1.0 - keep, keep], [1.0, *np.zeros(whole + 1)])
    between = K * T * (1.0 - keep) * np.array([1.0 - share, share, 0.0])
    roots = np.roots(np.polyadd(polynomial, between))
    wanted = np.log(roots[np.abs(roots) > 1e-6].astype(complex)) / T
    poles = loop_of([[1.0]], [[T]], [[-K]], True).poles(Sensing(late * T, lag))
    for pole in wanted:
        assert np.abs(poles - pole).min() < 1e-6 * np.abs(wanted).max()


def test_the_locus_of_a_lagging_sensor_that_is_late():
    sensing = Sensing(2.5e-3, 4.0e-3)
    omega, loci = loop_of([[1.0]], [[T]], [[-K]], True).loci(sensing)
    z, keep = np.exp(1j * omega * T), math.exp(-T / sensing.lag)
    late = np.exp(-1j * omega * sensing.delay) * (1.0 - keep) * z / (z - keep)
    assert loci[:, 0] == pytest.approx(-K * T * late / (z - 1.0), rel=1e-9)
    assert omega[[0, -1]] == pytest.approx([3.0, 0.98 * math.pi / T])


@pytest.mark.parametrize(
    ("omega", "growth", "swings"), [(4.0, 0.06, 1), (4.0, 0.04, 0), (2.0, 9.0, 0)]
)
def test_what_grows_slowly_or_swings_slowly_is_the_motion_itself(omega, growth, swings):
    plant = np.zeros((4, 4))
    plant[:2, :2], plant[2:, 2:] = turning(omega, growth), turning(50.0, -1.0)
    loop = loop_of(plant, np.zeros((4, 1)), np.zeros((1, 4)))
    assert (loop.margins(Sensing()).gain == 0.0) == bool(swings)
    if omega > 3.0:
        assert loop.growth(Sensing()) == pytest.approx(growth)


@pytest.mark.parametrize("damping", [1e-4, 1e-3])
def test_the_peak_of_a_mode_that_hardly_decays_is_found(damping):
    """Between even steps it would pass the point −1 unseen."""
    mode = turning(300.0, -300.0 * damping)
    high = 1.0 - math.exp(-300.0 * damping * T)  # of the peak: b/2 over it
    loop = loop_of(mode, [[high], [0.0]], [[-0.9, 0.0]])
    omega, loci = loop.loci(Sensing())
    assert np.abs(loci[:, 0]).max() == pytest.approx(0.45, rel=0.01)
    near = np.abs(omega - 300.0) < 20.0 * 300.0 * damping
    assert near.sum() > 30


@pytest.mark.parametrize("turned", [-2.4, -0.9, 2.4])
def test_margins_of_a_resonance_that_is_turned(turned):
    """Of k e^(jψ)/(1 + jx): 1 at x = ±√(k² − 1), and the way on to the point by the angle of it;
    real at x = tan ψ, if that is ahead, where k cos ψ is left."""
    decay, k, angle = 3.0, 1.35, turned - 300.0 * T
    high, side = 2.0 * k * (1.0 - math.exp(-decay * T)), math.sqrt(k**2 - 1.0)
    gain = [high * math.cos(turned), high * math.sin(turned)]
    margins = loop_of(turning(300.0, -decay), [[1.0], [0.0]], [gain]).margins(Sensing())
    ways = {300.0 + x * decay: angle - math.atan(x) for x in (-side, side)}
    first = min(ways, key=lambda omega: ways[omega] % (2.0 * math.pi) / omega)
    assert margins.frequency == pytest.approx(first, rel=1e-3)
    assert margins.delay * first == pytest.approx(ways[first] % (2.0 * math.pi), abs=0.01)
    sizes = [abs(math.remainder(way, 2.0 * math.pi)) for way in ways.values()]
    assert margins.phase == pytest.approx(min(sizes), abs=0.01)
    left = k * math.cos(angle)
    assert margins.gain == pytest.approx(1.0 / left if left > 0.0 else math.inf, rel=0.01)


def test_a_small_push_of_the_valves_goes_on_as_the_map_says():
    """The model itself for 20 ms: what a command that differs by 5 mV makes of it."""
    rig = bench("boom_four_valve", "boom")
    at = rig.points[0]
    plant = SampledPlant.of(at.model, at.point, TICK)
    y, held = state_of(at.model, at.point)
    rows = at.model.plant.valves.copy()
    rows.delay[:] = 0.0
    model = at.model.plant._replace(valves=rows)
    line, work = line_of(model, TICK), np.empty(model.at.work)
    for i, valve in enumerate(plant.valves):
        ends, linear = [], np.zeros(y.size)
        for push in (5e-3, -5e-3):
            state, given, sample = y.copy(), held.copy(), np.empty(plant.sample.size)
            given[valve] += push
            for _ in range(20):
                model_tick(state, given, model, line, 2, np.empty((5, y.size)), work, sample)
            ends.append(np.append(state, sample))
        for _ in range(20):
            linear = plant.plant.a @ linear + plant.plant.b[:, i] * 5e-3
        change, wanted = 0.5 * (ends[0] - ends[1]), np.append(linear, plant.plant.c @ linear)
        assert (np.abs(change - wanted) <= 0.03 * np.abs(change) + 1e-9).all()
        assert np.count_nonzero(change[y.size :]) > 3


@pytest.mark.parametrize("name", ["boom_four_valve", "thesis_arm", "crane_proportional"])
def test_a_steady_motion_stays_as_it_is(name):
    """A tick leaves the controller's memory as it was, and commands what holds the motion."""
    rig = bench(name, "lift" if name.startswith("crane") else "boom")
    gains = rig.gains()
    for at in rig.points:
        plant = SampledPlant.of(at.model, at.point, TICK)
        assert plant.stays(rig.site, gains)
        law = arc_loop._LawTick(plant, rig.site, gains)
        after = law.after(np.zeros(law.sizes.size), np.zeros(law.reads.size))
        start = {name: float(law.start[name]) for name in arc_loop.MEMORY_STEPS}
        start["x"] += TICK * start["v"]
        memory, commands = np.split(after, [law.sizes.size])
        assert memory == pytest.approx([*start.values(), *law.start.estimates], rel=1e-9, abs=1e-9)
        _, held = state_of(at.model, at.point)
        assert commands == pytest.approx(held[list(plant.valves)], rel=0.03)


def test_estimates_of_a_steady_motion_keep_off_their_bounds_and_pressures_lag():
    """By a thousandth of the width: differences see no kink."""
    rig = bench("thesis_arm", "boom")
    gains, at = rig.gains().copy(), rig.points[0]
    gains.upper[INVERSE_INERTIA], gains.lower[DISTURBANCE] = 0.9, -1.0
    state = arc_loop.steady_memory(at.model, at.point, rig.site, gains)
    channels = sample_channels(at.model.layout.cylinders)
    lagged = rig.loop(at, rig.gains()).lagged
    assert [".p_" in name or name.startswith("p_") for name in channels] == lagged.tolist()
    width = gains.upper - gains.lower
    inside = 1e-3 * width
    assert state.estimates[INVERSE_INERTIA] == pytest.approx(0.9 - inside[INVERSE_INERTIA])
    assert state.estimates[DISTURBANCE] == pytest.approx(-1.0 + inside[DISTURBANCE])
