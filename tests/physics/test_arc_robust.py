"""Its defaults on machines that are not the design: they do not swing."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from delayed_loop import GAINS, Bench

from ehbench.config.recipe import load_rig
from ehbench.trial import run_trial
from tests.shared import RECIPES, cycle, shipped

# rig → (cylinder, strokes, payload)
RIGS = {
    "thesis_arm": ("boom", ("50 mm", "200 mm", "50 mm"), "50 lb"),
    "boom_four_valve": ("boom", ("100 mm", "350 mm", "100 mm"), "bucket"),
    "crane_proportional": ("lift", ("100 mm", "400 mm", "100 mm"), "200 kg"),
    "slide_servo": ("press", ("50 mm", "300 mm", "50 mm"), "100 kg"),
}


def _later(seconds):
    return {"delay": f"{float(seconds)!r} s"}


MACHINES = {
    "as shipped": {},
    "5 ms more delay": _later(5e-3),
    "pressure sensors 10 ms slower": {"pressure_lag": "10 ms"},
    "valves twice as slow": {"valve_lag": 2.0},
    "valves three times as fast": {"valve_lag": 0.33},
    "oil half as stiff": {"bulk_modulus": 0.5},
    "oil stiffer by half": {"bulk_modulus": 1.5},
    "three times the friction": {"friction": 3.0},
    "10 % less flow": {"flow": 0.9},
    "10 % more flow": {"flow": 1.1},
    "supply 20 % short": {"supply_pressure": 0.8},
}


def trial_of(name, payload, change, speed="70 mm/s", move=None, seed=0, gains=None, **given):
    """What came of a trial on the changed machine: its record, and its facts."""
    cylinder, strokes, _ = RIGS[name]
    move = {"acceleration": "0.4 m/s^2", "jerk": "8 m/s^3", "hold": "0.6 s"} | (move or {})
    about = {"rig": f"rigs/{name}.toml", "on": "bench", "bench": f"bench/{name}.toml"}
    about |= {"machine": change, "payload": payload, "seed": seed} | given
    recipe = cycle(cylinder, strokes, speed, gains=gains, move=move, **about)
    return run_trial(load_rig(RECIPES / recipe.rig), recipe)


def facts_of(name, payload, change, speed="70 mm/s", seed: Any = 0, **gains):
    """The facts of `trial_of`."""
    return trial_of(name, payload, change, speed, seed=seed, gains=gains)[1]


# the arm with and without load under each change, the others with load under every other one
SWINGS = [
    (name, loaded, change)
    for name in RIGS
    for loaded in (False, True)
    for i, change in enumerate(MACHINES)
    if name == "thesis_arm" or (i % 2 == 0) == loaded
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "loaded", "change"), SWINGS)
def test_nothing_swings(name, loaded, change):
    payload = RIGS[name][2] if loaded else None
    facts = facts_of(name, payload, MACHINES[change])
    assert not facts.stopped and facts.measures["limit_cycle"] is None


LATE = ("5 ms more delay", "pressure sensors 10 ms slower", "valves twice as slow")


@pytest.mark.parametrize("speed", ["60 mm/s", "180 mm/s"])
@pytest.mark.parametrize("change", LATE)
def test_100_lb_do_not_swing(change, speed):
    """On twice the load that the arm is made for the bandwidths go down by themselves."""
    facts = facts_of("thesis_arm", "100 lb", MACHINES[change], speed)
    assert not facts.stopped and facts.measures["limit_cycle"] is None
    assert facts.measures["tracking"]["max_error"] < 1.3e-3


def test_a_trial_says_its_gains_as_designed_and_under_its_load():
    design = facts_of("thesis_arm", "50 lb", {}).measures
    assert "eased" not in design and "gains_under_load" not in design
    heavy = facts_of("thesis_arm", "100 lb", {}).measures
    assert heavy["gains"] == design["gains"]
    share, under = heavy["eased"]["share"], heavy["gains_under_load"]
    assert 0.5 < share < 0.95
    # what 100 lb are to the mechanism, as motion tells it at its most
    assert heavy["eased"]["payload"] == pytest.approx(45.4, rel=0.25)
    for name in ("position_bandwidth", "force_bandwidth", "observer_bandwidth", "adaptation"):
        assert under[name] == pytest.approx(share * heavy["gains"][name])
    assert under["speed_tolerance"] == pytest.approx(heavy["gains"]["speed_tolerance"] / share)
    assert "bandwidth_limit" not in under


def test_without_that_they_swing_in_motion_and_calm_down_at_rest():
    late = MACHINES["pressure sensors 10 ms slower"]
    facts = facts_of("thesis_arm", "100 lb", late, "60 mm/s", bandwidth_limit="0 rad/s")
    assert facts.measures["limit_cycle"] is not None
    # Bandwidths too high for a late machine: after the stop valves keep up no swing
    late, gains = MACHINES["5 ms more delay"], {"bandwidth_limit": "0 rad/s"}
    record, facts = trial_of("thesis_arm", "100 lb", late, "180 mm/s", gains=gains)
    stop = record.t[record["boom.v_desired"] != 0.0][-1]
    swing = facts.measures["limit_cycle"]  # in motion it does swing
    assert swing is None or swing["start"] + swing["duration"] < stop
    error = (record["boom.x"] - record["boom.x_desired"])[record.t > stop + 0.1]
    trend = np.polynomial.Polynomial.fit(np.arange(error.size), error, 2)(np.arange(error.size))
    assert np.abs(error - trend).max() < 0.05e-3


@cache
def bench(name, *about):
    """A rig, its operating points and the controller designed for it."""
    return Bench(shipped(name), *about)


def test_bandwidths_go_by_the_load():
    """The margin with 100 lb is that with 50 lb; without the limit it is far from that."""

    def margin(payload, **given):
        rig = bench("thesis_arm", "boom", 2, (0.7,), (payload,))
        return rig.worst(rig.gains(**given))[0].delay

    light, heavy = margin("50 lb"), margin("100 lb")
    assert light == margin("50 lb", bandwidth_limit=0.0)
    assert heavy > 0.95 * light > 1.1 * margin("100 lb", bandwidth_limit=0.0)


def test_a_spool_as_fast_as_cartridges_comes_to_rest():
    """At a reference at rest the law goes on through the spool's centre: chosen by the error's sign
    its opening kept 50 lb swinging by 0.2 mm, with the half of its hysteresis that stays open."""
    standard = "thesis_arm_standard.toml"
    four_way: dict[str, Any] = {"rig": f"rigs/{standard}", "bench": f"bench/{standard}"}
    four_way |= {"dynamics": {"boom.spool": "cartridge"}}
    record, facts = trial_of("thesis_arm", "50 lb", {}, "60 mm/s", {"hold": "2 s"}, **four_way)[:2]
    error = record["boom.x"] - record["boom.x_desired"]
    moving = np.flatnonzero(record["boom.v_desired"])
    late = np.arange(record.t.size) > moving[-1] + 700
    assert np.abs(error[late]).max() < 1.0e-4
    assert facts.measures["limit_cycle"] is None


def test_the_overlap_of_a_spool_is_learnt():
    """The slide's rig file has none: the bench's costs a fifth of the flow."""
    kept = {"adapt_oil": False}
    both = (facts_of("slide_servo", None, {}, adapt_maps=on, **kept) for on in (True, False))
    with_maps, without = (facts.measures for facts in both)
    default = facts_of("slide_servo", None, {}, adapt_maps=True).measures
    assert with_maps["limit_cycle"] is None and default["limit_cycle"] is None
    for edge, one in (*with_maps["maps"].items(), *default["maps"].items()):
        assert one["error_after"] < 0.4 * one["error_before"], edge
    assert with_maps["tracking"]["rms_error"] < 0.6 * without["tracking"]["rms_error"]


LIVELY = GAINS | {"fast adaptation": {"adaptation": 4.0}}
UNITS = {"lag_budget": "rad", "observer_bandwidth": "rad/s", "adaptation": "rad/s"}


@cache
def _stated(name, which):
    """(stated, computed) delay margin [s] at the worst point, of the design model."""
    cylinder, _, load = RIGS[name]
    rig = bench(name, cylinder, 3, (0.06, 0.3), ("none", load))
    worst, _ = rig.worst(rig.gains(**LIVELY[which]), "delay", 1e-3, 1e-3)
    return worst.stated, worst.delay


@pytest.mark.slow
@pytest.mark.parametrize("gains", LIVELY)
@pytest.mark.parametrize("name", ["thesis_arm", "boom_four_valve"])
def test_the_stated_delay_margin_is_kept_by_the_virtual_rig(name, gains):
    """With as much more delay as is stated the virtual rig does not swing, loaded or not."""
    told = {key: f"{v} {UNITS[key]}" if key in UNITS else v for key, v in LIVELY[gains].items()}
    stated, _ = _stated(name, gains)
    assert stated > 0.0
    for payload in (None, RIGS[name][2]):
        facts = facts_of(name, payload, _later(stated), **told)
        assert facts.measures["limit_cycle"] is None, payload


def test_beyond_its_delay_margin_the_virtual_rig_swings():
    """Twice the margin: it swings in motion, and the trial says so; at rest it calms down."""
    _, computed = _stated("thesis_arm", "livelier")
    told = {"lag_budget": "0.6 rad", "robust_limit": 0.3}
    facts = facts_of("thesis_arm", "50 lb", _later(2.0 * computed), **told)
    assert facts.measures["limit_cycle"]["amplitude"] > 1.0e-4
    assert any(text.key == "trial.swings" for text in facts.warnings)


@pytest.mark.parametrize("speed", ["60 mm/s", "180 mm/s"])
def test_a_coarse_sensor_slows_the_observer(speed):
    """One count of 0.5 mm is no jolt: the true error is a third of that of the fast observer."""
    coarse = {"bench": "bench/thesis_arm_adc.toml"}
    facts = {}
    for observer in ({}, {"observer_bandwidth": "370 rad/s"}):
        gains = {"stroke_resolution": "0.5 mm"} | observer
        _, facts[len(observer)] = trial_of("thesis_arm", "50 lb", {}, speed, gains=gains, **coarse)
    slow, fast = facts[0].measures, facts[1].measures
    assert slow["gains"]["observer_bandwidth"] < 60.0
    assert slow["tracking_true"]["max_error"] < 0.35 * fast["tracking_true"]["max_error"]
