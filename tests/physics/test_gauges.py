"""Gauges across the piston and load cells in the rod: what they read follows from the pressures and
from Newton's law of what the rod moves, and is compared where a chamber's pressure is not known."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from ehbench.app.mapping import draft
from ehbench.config.recipe import Thresholds, load_rig
from ehbench.config.recipe.columns import load_columns
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit, run_fit
from ehbench.plant.model import Model, simulate
from ehbench.vocabulary.quantities import GAUGES
from tests.shared import RIGS, judged, shipped

MASS, DAMPING = 250.0, 800.0
T = np.arange(1601) * 1e-3
TABLE = """[cylinder.friction]
law = "{}"
friction_static = "300 N"
stribeck_speed = "10 mm/s"
{}
"""
BRISTLES = 'bristle_stiffness = "1e7 N/m"\nbristle_damping = "1e4 N*s/m"'
FRICTION = {
    "coulomb": "",
    "stribeck": TABLE.format("stribeck", ""),
    "lugre": TABLE.format("lugre", BRISTLES),
}


def stepped(level: float) -> np.ndarray:
    """Out, a rest, and back."""
    return level * (((T > 0.2) & (T < 0.6)) * 1.0 - ((T > 0.9) & (T < 1.3)) * 1.0)


def slide(law: str = "coulomb", tmp_path: Path | None = None) -> Rig:
    """The shipped slide, with 200 N of friction where a law is asked for."""
    if tmp_path is None:
        return shipped("slide_servo")
    none = 'friction_coulomb = { value = "0 N"'
    text = (RIGS / "slide_servo.toml").read_text().replace(none, none.replace("0 N", "200 N"))
    at = text.index("[[cylinder.valve]]")
    (tmp_path / "rig.toml").write_text(text[:at] + FRICTION[law] + "\n" + text[at:])
    return load_rig(tmp_path / "rig.toml")


def bare(record: Record, *gauges: str) -> Record:
    """A recording that asks for gauges of which it holds nothing yet."""
    empty = {f"press.{word}": np.zeros(record.t.size) for word in gauges}
    return replace(record, channels={**record.channels, **empty})


@pytest.mark.parametrize("law", FRICTION)
def test_the_rod_moves_what_newton_says(law, tmp_path):
    rig = slide(law, tmp_path)
    u = np.repeat(stepped(3.0), 20)[:-19]  # friction turns round within a few milliseconds
    made = simulate(rig, {"press.servo": u}, 1.6, posture={"press": "150 mm"}, rate=20e3)
    seen = Model.of(rig).replay(bare(made, *GAUGES))
    v, p = seen["press.v"], [seen["press.p_head"], seen["press.p_rod"]]
    areas = rig.cylinder[0].areas()
    assert np.array_equal(seen["press.load_pressure"], p[0] - p[1])
    oil = p[0] * areas[0] - p[1] * areas[1]
    assert np.abs(seen["press.load_force"] - oil).max() < 1e-9 * np.abs(oil).max()
    impulse = cumulative_trapezoid(seen["press.rod_force"], dx=5e-5, initial=0.0)
    momentum = MASS * (v - v[0]) + DAMPING * (seen["press.x"] - seen["press.x"][0])
    assert np.abs(impulse - momentum).max() < 2e-3 * np.ptp(momentum)
    rubbing = cumulative_trapezoid(oil - seen["press.rod_force"], dx=5e-5, initial=0.0)
    assert np.ptp(rubbing) > 0.3 * np.ptp(momentum)  # a force with the friction would not do


def test_channels_of_gauges_appear_only_on_request():
    made = simulate(slide(), {"press.servo": stepped(2.0)}, 1.6)
    assert "press.rod_force" not in Model.of(slide()).replay(made).channels


def near(fit, wanted: dict[str, float]) -> None:
    """Fail unless each estimate lies within one and a half of its interval's half width."""
    for name, truth in wanted.items():
        low, high = fit[name].interval or (0.0, 0.0)
        assert abs(fit[name].value - truth) < 1.5 * (high - low) / 2, name


@cache
def logged(word: str) -> list[tuple[str, Record]]:
    """Logs of a machine with a place, one gauge, and no pressure of a chamber."""
    true = slide().with_values({"bulk_modulus": 7.5e8, "press.friction_coulomb": 180.0})
    noise, logs = {"x": 2e-5, word: 2e4 if word == "load_pressure" else 40.0}, []
    for seed, level in enumerate((3.0, 2.0)):
        made = simulate(true, {"press.servo": stepped(level)}, 1.6, posture={"press": "150 mm"})
        seen = Model.of(true).replay(bare(made, word))
        rng = np.random.default_rng(seed)
        own = {
            f"press.{w}": seen[f"press.{w}"] + s * rng.normal(size=T.size) for w, s in noise.items()
        }
        own |= {"press.servo.command": made["press.servo.command"]}
        logs.append((f"log{seed}", Record(made.t, own, {})))
    return logs


@pytest.mark.parametrize("word", ["load_pressure", "rod_force"])
def test_a_gauge_tells_the_oil_where_no_chamber_has_one(word):
    wanted = {"bulk_modulus": 7.5e8, "carriage.damping": DAMPING, "press.friction_coulomb": 180.0}
    fit = identify_hydraulics(slide(), logged(word), list(wanted))
    assert f"press.{word}" in fit.logs[0].fit_percent
    near(fit, wanted)
    low, high = fit["bulk_modulus"].interval or (0.0, np.inf)
    assert high - low < 0.05 * 7.5e8


def test_a_gauge_is_judged_by_the_thresholds_of_pressures():
    soft = slide().with_values({"bulk_modulus": 3.0e8, "press.friction_coulomb": 180.0})
    true = slide().with_values({"bulk_modulus": 7.5e8, "press.friction_coulomb": 180.0})
    good, bad = (judged(one, logged("load_pressure")[:1]) for one in (true, soft))
    assert good.verdict == "accepted"
    assert any(check.what == "press.load_pressure fit" for check in good.logs[0].checks)
    assert bad.verdict == "rejected"
    assert any("load pressure fit" in reason for reason in bad.reasons)


def test_a_recorded_spool_tells_its_own_dynamics_and_is_judged():
    valve = {"spool.natural_frequency": 2.0 * np.pi * 45.0, "spool.damping_ratio": 0.6}
    true = slide().with_values(valve)
    made = simulate(true, {"press.servo": stepped(3.0)}, 1.6, posture={"press": "150 mm"})
    rng, noise = np.random.default_rng(2), {"press.servo.opening": 0.01, "press.x": 1e-4}
    own = {c: made[c] + s * rng.normal(size=T.size) for c, s in noise.items()}
    log = Record(made.t, own | {"press.servo.command": made["press.servo.command"]}, {})
    without, fit = (
        run_fit(prepare_fit(slide(), [("a", log)], list(valve), options=FitOptions(channels=asked)))
        for asked in (("v",), ("v", "opening"))
    )
    assert "press.servo.opening" in fit.logs[0].fit_percent
    near(fit, valve)
    for name in valve:
        assert fit[name].std < 0.5 * without[name].std
    limits = Thresholds(fit_percent={"v": 50.0, "opening": 90.0})
    good, bad = (
        judged(one, [("a", log)], channels=("v", "opening"), thresholds=limits)
        for one in (true, slide().with_values({"spool.natural_frequency": 2.0 * np.pi * 8.0}))
    )
    assert good.verdict == "accepted"
    assert "press.servo.opening" in [one.channel for one in good.logs[0].channels]
    assert any("press.servo opening fit" in reason for reason in bad.reasons)


def test_gauges_are_known_by_name_and_unit(tmp_path):
    t = np.arange(400) * 1e-3
    names = "Time\tServo Cmd\tAct Disp\tLoad Cell\tDiff Press\tSpool Pos\n"
    names += "(sec)\t(mA)\t(in)\t(lbf)\t(psi)\t(%)\n"
    row = "{0:.4f}\t{1:.3f}\t{0:.4f}\t{2:.2f}\t{3:.2f}\t{4:.2f}"
    rows = [row.format(s, 8 * np.sin(20 * s), s * 90, s * 100, s * 80) for s in t]
    (tmp_path / "run.txt").write_text(names + "\n".join(rows))
    made = draft(tmp_path / "run.txt", tmp_path / "run.map.toml", slide())
    found = load_columns(made.place).columns.names
    assert found["Load Cell"].channel == "press.rod_force"
    assert found["Diff Press"].channel == "press.load_pressure"
    assert found["Spool Pos"].channel == "press.servo.opening"
    assert "1000 Hz" in "\n".join(made.notes)
