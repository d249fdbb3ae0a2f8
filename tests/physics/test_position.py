"""The position controller: closed form on an ideal actuator, and untuned on every shipped rig."""

import math

import numpy as np
import pytest
from closed_loop import LONG

from ehbench.config.recipe import TrialRecipe
from ehbench.control.functions import METERING, PATH_FLOWS, path_drop
from ehbench.control.measured import pressures
from ehbench.control.registry import tick
from ehbench.parts.edge import edge_flow
from ehbench.parts.sample import LINE, OF, entry, line_entry
from ehbench.trial import prepare, run_trial
from ehbench.vocabulary.codes import EXTEND_RESISTIVE, RETRACT_RESISTIVE, SATURATED
from tests.shared import refused, shipped

SLIDE = shipped("slide_servo")
MOTION = {"kind": "point_to_point", "cylinder": "press", "waypoints": ["100 mm", "200 mm"]}
MOTION |= {"speed": "50 mm/s"}
T = 1e-3


def recipe(motion=MOTION, gains=None, **given):
    controller = {"kind": "position", "gains": gains or {}}
    return TrialRecipe(stage="trial", rig="x.toml", controller=controller, motion=motion, **given)


def ideal(gains, v_d, z_0, seconds, passes=lambda t, v: v):
    """(telemetry by name, stroke error [m]) of an actuator that moves as its metering edge passes
    oil at standing pressures; ``passes`` (t, speed) is what it makes of that."""
    law = prepare(recipe(gains=gains), SLIDE).loop.laws[0]
    own, count = law.controller, round(seconds / T)
    circuit = own.axis.circuit
    sample = np.zeros(own.given.size)
    # resistive both ways: the piston pushes against its motion
    against = math.copysign(1.0, v_d)
    sample[entry(0, OF.p_head)] = 3e6 if against > 0 else 1e6
    sample[entry(0, OF.p_rod)] = 1e6 if against > 0 else 8e6
    sample[line_entry(1, LINE.p_supply)] = 14e6
    command, x = np.zeros(1), 0.1 + z_0
    telemetry, errors = np.zeros((count, len(law.channels))), np.zeros(count)
    function = EXTEND_RESISTIVE if v_d > 0 else RETRACT_RESISTIVE
    path = METERING[function]
    edge, along = circuit.paths[path], circuit.along[path]
    drop = path_drop(path, pressures(sample, 0), circuit)
    to_speed = PATH_FLOWS[function, path] @ [circuit.area_head, circuit.area_rod]
    for i in range(count):
        x_d = 0.1 + v_d * i * T
        errors[i], sample[entry(0, OF.x)] = x - x_d, x
        tick(i * T, sample, np.array([x_d, v_d, 0.0, 0.0]), own, command, telemetry[i])
        passed = along * edge_flow(along * drop, command[0], circuit.edges[edge], circuit.maps)
        x += T * passes(i * T, passed / to_speed)
    names = [name.split(".", 1)[1] for name in law.channels]
    return dict(zip(names, telemetry.T, strict=True)), errors


@pytest.mark.parametrize("v_d", [0.05, -0.05])
@pytest.mark.parametrize("z_0", [4e-3, -4e-3])
def test_on_an_ideal_actuator_the_error_decays_with_the_bandwidth(v_d, z_0):
    """z = z_0 (1 − k T)^n, which is e^(−k t) up to k T/2 of its exponent, in motion either way."""
    k = 8.0
    told, z = ideal({"position_bandwidth": f"{k} rad/s"}, v_d, z_0, 0.8)
    t = T * np.arange(z.size)
    assert set(told["function"]) == {EXTEND_RESISTIVE if v_d > 0 else RETRACT_RESISTIVE}
    assert not told["limits"].any()
    np.testing.assert_allclose(z, z_0 * (1.0 - k * T) ** np.arange(z.size), rtol=1e-7)
    np.testing.assert_allclose(z, z_0 * np.exp(-k * t), rtol=0.51 * k * T * k * 0.8)
    np.testing.assert_allclose(told["v_asked"], v_d - k * z, rtol=1e-12)
    np.testing.assert_array_equal(told["x_error"], z)


def test_the_integral_takes_away_what_is_left_and_does_not_wind_up():
    """A valve 20 % below its map leaves ε v/(k (1 − ε)) behind; with an integral nothing."""
    k, v_d = 8.0, 0.05
    weak = lambda t, v: 0.8 * v
    gains = {"position_bandwidth": f"{k} rad/s"}
    _, z = ideal(gains, v_d, 0.0, 2.0, weak)
    assert z[-1] == pytest.approx(-0.2 * v_d / (0.8 * k), rel=1e-5)
    told, z = ideal(gains | {"integral_bandwidth": "2 rad/s"}, v_d, 0.0, 6.0, weak)
    assert abs(z[-1]) < 1e-6
    assert told["v_integral"][-1] == pytest.approx(0.25 * v_d, rel=1e-2)
    # Stuck for 4 s, then free: the error comes back without going far to the other side
    most, k, corner = 0.04, 8.0, 2.0
    sticks = lambda t, v: 0.0 if t < 4.0 else v
    gains = {"position_bandwidth": f"{k} rad/s", "integral_bandwidth": f"{corner} rad/s"}
    gains |= {"speed_correction": f"{most} m/s"}
    told, z = ideal(gains, 0.01, 0.0, 12.0, sticks)
    assert np.abs(told["v_asked"] - told["v_desired"]).max() <= most * (1 + 1e-12)
    # 0.5 s at 0.01 m/s would do: the integral stops where the correction is at its end
    assert told["v_integral"][3999] < 0.5 * most
    assert z[4000] == pytest.approx(-0.04, rel=1e-3) and abs(z[-1]) < 1e-6
    assert z.max() < most / k
    # Asked for more speed than the spool passes, the integral stands still
    motion = MOTION | {"speed": "3 m/s", "acceleration": "20 m/s^2"}
    motion |= {"waypoints": ["50 mm", "350 mm"]}
    gains = {"integral_bandwidth": "1 rad/s", "speed_correction": "10 m/s"}
    record, _ = run_trial(SLIDE, recipe(motion, gains))
    full = np.flatnonzero(record["press.limits"].astype(int)[:-1] & SATURATED)
    moved = np.diff(record["press.v_integral"])
    assert full.size > 20 and not moved[full].any() and moved.any()


MACHINES = LONG | {"thesis_arm_standard": LONG["thesis_arm"]}


@pytest.mark.parametrize("on", ["model", "bench"])
@pytest.mark.parametrize("name", MACHINES)
def test_it_works_untuned_on_every_shipped_rig(name, on):
    """A payload that it is not told: within what a valve off by a third leaves, ε v/k, and in
    the end within 2 mm, of which the benches' sensors and deadbands take most."""
    cylinder, low, high, speed, payload = MACHINES[name]
    motion = {"kind": "point_to_point", "cylinder": cylinder}
    motion |= {"waypoints": [f"{low} m", f"{high} m", f"{low} m"], "hold": "1 s"}
    motion |= {"speed": f"{speed} m/s", "acceleration": f"{5 * speed} m/s^2"}
    rig = shipped(name)
    record, facts = run_trial(rig, recipe(motion, payload=payload, on=on))
    gains, tracking = facts.measures["gains"], facts.measures["tracking"]
    assert not facts.stopped and 2.0 < gains["position_bandwidth"] < 6.0
    assert tracking["max_error"] < speed / gains["position_bandwidth"] / 3.0
    assert abs(tracking["final_error"]) < (1e-3 if on == "model" else 2e-3)
    asked = record[f"{cylinder}.v_asked"] - record[f"{cylinder}.v_desired"]
    error = record[f"{cylinder}.x_error"]
    np.testing.assert_allclose(asked, -gains["position_bandwidth"] * error, atol=1e-12)


def test_gains_that_cannot_work_are_refused():
    low = {"position_bandwidth": "2 rad/s"}
    for gains, key in (
        ({"position_bandwidth": "0 rad/s"}, "control.position_gain_range"),
        (low | {"integral_bandwidth": "3 rad/s"}, "control.integral_above_bandwidth"),
        ({"position_gain": "2 rad/s"}, "trial.unknown_key"),
        ({"position_bandwidth": "2 mm"}, "trial.wrong_value"),
    ):
        with refused(key):
            prepare(recipe(gains=gains), SLIDE)
