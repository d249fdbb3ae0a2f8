"""Adaptive robust control with its defaults on machines that are not the one it was designed on: it
does not swing.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest
import tomli_w

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


def _times(text, factor):
    """A number with its unit, times a factor."""
    number, unit = text.split(" ", 1)
    return f"{factor * float(number)!r} {unit}"


def _later(seconds):
    def change(bench, rig):
        bench["delay"] = f"{float(bench.get('delay', '1 ms').split()[0]) + 1e3 * seconds} ms"

    return change


def _pressures(bench, rig):
    for one in bench.setdefault("sensors", {"all": {}}).values():
        one["pressure_lag"] = f"{float(one.get('pressure_lag', '0 ms').split()[0]) + 10.0} ms"


def _slower(factor):
    def change(bench, rig):
        for one in rig.get("dynamics", {}).values():
            for key, power in (("s1", 1), ("s2", 2), ("natural_frequency", -1)):
                if key in one:
                    one[key]["value"] = _times(one[key]["value"], factor**power)

    return change


def _oil(factor):
    def change(bench, rig):
        given = bench.setdefault("truth", {}).get("bulk_modulus", rig["oil"]["bulk_modulus"])
        text = given["value"] if isinstance(given, dict) else given
        bench["truth"]["bulk_modulus"] = _times(text, factor)

    return change


def _friction(bench, rig):
    for one in bench.get("cylinder", {}).values():
        for key in ("friction_coulomb", "friction_static", "friction_viscous"):
            if key in one:
                one[key] = _times(one[key], 3.0)


def _supply(bench, rig):
    rig["supply"]["pressure"]["value"] = _times(rig["supply"]["pressure"]["value"], 0.8)


MACHINES = {
    "as shipped": lambda bench, rig: None,
    "5 ms more delay": _later(5e-3),
    "pressure sensors 10 ms slower": _pressures,
    "valves twice as slow": _slower(2.0),
    "valves three times as fast": _slower(0.33),
    "oil half as stiff": _oil(0.5),
    "oil stiffer by half": _oil(1.5),
    "three times the friction": _friction,
    "supply 20 % short": _supply,
}


def machine(name, change, folder):
    """The bench file of a rig's machine after a change, its own rig beside it."""
    bench = tomllib.loads((RECIPES / "bench" / f"{name}.toml").read_text(encoding="utf-8"))
    rig = tomllib.loads((RECIPES / "rigs" / f"{name}.toml").read_text(encoding="utf-8"))
    change(bench, rig)
    bench["rig"] = "machine_rig.toml"
    for file, table in (("machine_rig.toml", rig), ("bench.toml", bench)):
        (folder / file).write_text(tomli_w.dumps(table), encoding="utf-8")
    return "bench.toml"


def facts_of(name, payload, change, folder, speed="70 mm/s", seed=0, **gains):
    """What came of a trial on the changed machine."""
    cylinder, strokes, _ = RIGS[name]
    recipe = TrialRecipe.model_validate(
        {
            "stage": "trial",
            "rig": "x.toml",
            "on": "bench",
            "bench": machine(name, change, folder),
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
            "path": folder / "trial.toml",
        }
    )
    return run_trial(load_rig(RECIPES / "rigs" / f"{name}.toml"), recipe)[1]


@pytest.mark.parametrize("change", MACHINES)
@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("name", RIGS)
def test_nothing_swings(name, loaded, change, tmp_path):
    payload = RIGS[name][2] if loaded else None
    facts = facts_of(name, payload, MACHINES[change], tmp_path)
    assert not facts.stopped
    assert facts.measures["limit_cycle"] is None


def test_100_lb_ask_for_a_lower_budget_of_phase(tmp_path):
    """With it the arm does not swing on late pressures, where it does with the defaults."""
    late = MACHINES["pressure sensors 10 ms slower"]
    given = ("thesis_arm", "100 lb", late, tmp_path, "180 mm/s")
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
def test_the_stated_delay_margin_is_kept_by_the_virtual_rig(name, gains, tmp_path):
    """With as much more delay as is stated the virtual rig does not swing, loaded or not."""
    told = {key: f"{v} {UNITS[key]}" if key in UNITS else v for key, v in LIVELY[gains].items()}
    stated, _ = _stated(name, LIVELY[gains])
    assert stated > 0.0
    for payload in (None, RIGS[name][2]):
        facts = facts_of(name, payload, _later(stated), tmp_path, **told)
        assert facts.measures["limit_cycle"] is None, payload


def test_beyond_its_delay_margin_the_virtual_rig_swings(tmp_path):
    """Twice the computed margin: it swings, and the trial says so."""
    gains = {"lag_budget": 0.6, "robust_limit": 0.3}
    _, computed = _stated("thesis_arm", gains)
    told = {"lag_budget": "0.6 rad", "robust_limit": 0.3}
    facts = facts_of("thesis_arm", "50 lb", _later(2.0 * computed), tmp_path, **told)
    assert facts.measures["limit_cycle"]["amplitude"] > 2.0e-4
    assert any("swings by itself" in text for text in facts.warnings)
