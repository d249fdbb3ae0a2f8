"""Adaptive robust control with its defaults on machines that are not the one it was designed on: it
does not swing.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ehbench.recipe import TrialRecipe, load_rig
from ehbench.trial import run_trial
from ehbench.tune.arc_loop import Sensing

sys.path.append(str(Path(__file__).parent))
from delayed_loop import Bench  # noqa: E402

RECIPES = Path(__file__).parents[2] / "recipes"
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


def facts_of(name, payload, change, speed="70 mm/s", seed=0, **gains):
    """What came of a trial on the changed machine."""
    cylinder, strokes, _ = RIGS[name]
    recipe = TrialRecipe.model_validate(
        {
            "stage": "trial",
            "rig": "x.toml",
            "on": "bench",
            "bench": f"bench/{name}.toml",
            "machine": change,
            "payload": payload,
            "seed": seed,
            "motion": {
                "kind": "point_to_point",
                "cylinder": cylinder,
                "waypoints": strokes,
                "speed": speed,
                "acceleration": "0.4 m/s^2",
                "jerk": "8 m/s^3",
                "hold": "0.6 s",
            },
            "controller": {"kind": "arc", "gains": gains},
            "path": RECIPES / "trial.toml",
        }
    )
    return run_trial(load_rig(RECIPES / "rigs" / f"{name}.toml"), recipe)[1]


@pytest.mark.parametrize("change", MACHINES)
@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("name", RIGS)
def test_nothing_swings(name, loaded, change):
    payload = RIGS[name][2] if loaded else None
    facts = facts_of(name, payload, MACHINES[change])
    assert not facts.stopped
    assert facts.measures["limit_cycle"] is None


def test_100_lb_ask_for_a_lower_budget_of_phase():
    """With it the arm does not swing on late pressures, where it does with the defaults."""
    late = MACHINES["pressure sensors 10 ms slower"]
    given = ("thesis_arm", "100 lb", late, "180 mm/s")
    assert facts_of(*given).measures["limit_cycle"] is not None
    assert facts_of(*given, lag_budget="0.3 rad").measures["limit_cycle"] is None


LIVELY = {
    "defaults": {},
    "livelier": {"lag_budget": 0.6, "robust_limit": 0.3},
    "slow observer": {"lag_budget": 0.5, "observer_bandwidth": 90.0},
    "fast adaptation": {"adaptation": 4.0},
}
UNITS = {"lag_budget": "rad", "observer_bandwidth": "rad/s", "adaptation": "rad/s"}


def _stated(name, gains):
    """(stated, computed) delay margin [s] at the worst point of these loads, of the design
    model.
    """
    unsure = {key: v for key, v in gains.items() if key in ("lag_budget", "adaptation")}
    given = {key: v for key, v in gains.items() if key not in unsure}
    cylinder, _, load = RIGS[name]
    loads = ("none", load)
    rig = Bench(load_rig(RECIPES / "rigs" / f"{name}.toml"), cylinder, 3, (0.06, 0.3), loads)
    packed = rig.gains(unsure, **given)
    found = [rig.loop(at, packed).margins(Sensing(1e-3, 1e-3)) for at in rig.points]
    worst = min(found, key=lambda one: one.delay)
    return worst.stated, worst.delay


@pytest.mark.parametrize("gains", LIVELY)
@pytest.mark.parametrize("name", ["thesis_arm", "boom_four_valve"])
def test_the_stated_delay_margin_is_kept_by_the_virtual_rig(name, gains):
    """With as much more delay as is stated the virtual rig does not swing, loaded or not."""
    told = {key: f"{v} {UNITS[key]}" if key in UNITS else v for key, v in LIVELY[gains].items()}
    stated, _ = _stated(name, LIVELY[gains])
    assert stated > 0.0
    for payload in (None, RIGS[name][2]):
        facts = facts_of(name, payload, _later(stated), **told)
        assert facts.measures["limit_cycle"] is None, payload


def test_beyond_its_delay_margin_the_virtual_rig_swings():
    """Twice the computed margin: it swings, and the trial says so."""
    gains = {"lag_budget": 0.6, "robust_limit": 0.3}
    _, computed = _stated("thesis_arm", gains)
    told = {"lag_budget": "0.6 rad", "robust_limit": 0.3}
    facts = facts_of("thesis_arm", "50 lb", _later(2.0 * computed), **told)
    assert facts.measures["limit_cycle"]["amplitude"] > 2.0e-4
    assert any("swings by itself" in text for text in facts.warnings)
