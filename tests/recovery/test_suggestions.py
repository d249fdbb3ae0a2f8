"""`identify --suggest`: the cure of a built fault comes first, a sound fit gets none, and what is
written fits. `tools/studies/suggestion_study.py` has every fault of every rig."""

import math
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from ehbench import workflow
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.diagnosis.faults import hypotheses
from ehbench.guidance.suggestions import Setup, Tried, _Trials, suggest
from ehbench.identification.hydraulics import FitOptions, prepare_fit
from ehbench.parts.sway import Sway
from ehbench.runs.rundir import read_json
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, shipped
from tools.studies.structure_study import Fault, faults, log_of, spoilt
from tools.studies.suggestion_study import recipe_of, right, suggested

STEPS = ("quick steps",)
# [s] of a log: a step out and a step back, in which all faults show but two; and a third of another
# size
SHORT, LONG = 1.2, 2.0
# a gain, a delay and an offset have tests of their own below
SLIDE = ("lag", "deadband", "friction", "load", "leakage", "saturation", "preload")


def rig_of(name="slide_servo"):
    return shipped(name)


def built(kind):
    return next(one for one in faults("slide_servo", rig_of()) if one.kind == kind)


@cache
def cured(kind):
    """What is suggested where a fault was built in, and what was told meanwhile."""
    told, length = [], LONG if kind in ("saturation", "late command") else SHORT
    recipe = recipe_of("slide_servo", rig_of(), built(kind), 7, STEPS, length)
    return suggest(*recipe, lambda text, share: told.append(text), 3600.0, 1), told


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*SLIDE, "late command", "sensor scale", "sensor lag"])
def test_the_cure_of_a_built_fault_comes_first(kind):
    found, _ = cured(kind)
    assert right(found, built(kind)), [row.words for row in found.rows[:4]]
    first = found.rows[0]
    spool = {"deadband": "overlap"}.get(kind, kind)  # one number for its four edges
    assert first.changes[0].startswith(spool) and first.recipe_lines
    assert first.not_worse and first.misfit < 0.5
    assert bool(first.rig_lines) == (kind in ("saturation", "deadband"))


@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional"])
def test_a_sound_fit_gets_no_suggestion(name):
    found = suggested(name, rig_of(name), Fault("none", "", rig_of(name)), 21, STEPS, length=SHORT)
    (row,) = found.rows
    assert not row.changes and row.misfit == 1.0
    answer = found.answer(Path("fit.toml"))
    assert answer.verdict.key == "guidance.nothing_better" and not answer.steps


@pytest.mark.slow
def test_one_wrong_edge_is_told_from_four():
    rig = rig_of()
    fault = next(one for one in faults("slide_servo", rig) if one.words == "one gain 8 % down")
    first = suggested("slide_servo", rig, fault, kinds=STEPS, length=SHORT).rows[0]
    assert first.changes == ("gain of press.servo_supply_head",)
    assert first.recipe_lines == ('parameters: add "press.servo_supply_head.flow_gain"',)


def test_time_is_bounded_and_what_was_not_tried_is_named():
    log = log_of("slide_servo", built("friction"), *STEPS, 3, SHORT)
    prepared = prepare_fit(rig_of(), [("log", log)], ["bulk_modulus"])
    told = []
    found = suggest(prepared, [("log", log)], lambda text, share: told.append((text, share)), 0.01)
    assert [row.changes for row in found.rows] == [()]
    assert "friction of press" in found.untried
    answer = found.answer(Path("fit.toml"))
    assert answer.verdict.key == "guidance.nothing_tried"
    (note,) = answer.notes
    assert note.key == "guidance.untried" and "friction of press" in note.fields["names"]
    assert told[0][0].startswith("suggest") and told[-1] == ("suggest: done", 1.0)


@pytest.mark.slow
def test_what_is_written_can_be_run_and_fits(undrawn, inside, tmp_path):
    fault = spoilt("press.p_head", lambda y: y + 5e5)
    machine = built("delay")._replace(sensors=fault)
    write_log(tmp_path / "log.mcap", log_of("slide_servo", machine, *STEPS, 3, SHORT))
    recipe = {"stage": "identify", "what": "hydraulics", "rig": str(RIGS / "slide_servo.toml")}
    recipe |= {"data": ["log.mcap"], "parameters": ["bulk_modulus", "carriage.damping"]}
    (tmp_path / "fit.toml").write_text(tomli_w.dumps(recipe))
    done = inside("identify", "fit.toml", "--suggest", "--out", "new", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = done.stdout
    assert "sensor offset of press.p_head and delay of press.servo" in told
    assert "[dynamics.press_servo_delay]" in told and 'kind = "delay"' in told
    assert "new/fit.toml" in told
    rows = read_json(tmp_path / "new" / "suggestions.json")
    assert rows[0]["freedom"] == 2
    written = tomllib.loads((tmp_path / "new" / "fit.toml").read_text())
    (sensor,) = written["sensor"]  # begins where the trials have come to
    assert float(sensor["offset"]["value"].split()[0]) == pytest.approx(5e5, rel=0.05)
    made = workflow.run(tmp_path / "new" / "fit.toml", workflow.Session(root=tmp_path / "runs"))
    found = {row["name"]: row for row in made.json("parameters")["parameters"]}
    assert found["press_servo_delay.delay"]["value"] == pytest.approx(0.015, abs=5e-4)
    (sensor,) = made.json("parameters")["sensors"]
    assert sensor["value"] == pytest.approx(5e5, rel=0.02)
    with pytest.raises(InputError, match="not empty"):
        session = workflow.Session(out=tmp_path / "new")
        workflow.suggest(tmp_path / "fit.toml", session, 0.01)


VALVES = ("ht", "sh", "sr", "rt")
T = np.arange(200) * 0.01
STEPPED = 3.0 * (T > 0.5) - 1.5 * (T > 1.5)


def rows_of(rig, cylinder, log):
    return {row.name: row for row in hypotheses(rig, [cylinder], [], [log])}


def boom_rows(rig, *still):
    given = {f"boom.{v}.command": STEPPED * (v not in still) for v in VALVES}
    return rows_of(rig, "boom", Record(T, given))


def test_valves_with_one_dynamics_share_its_rows():
    """Of four poppets their common lag and one delay for all are tried, and each once."""
    rig = rig_of("boom_four_valve")
    rows = boom_rows(rig)
    assert [row.parameters for row in rows.values() if row.kind == "lag"] == [
        ("poppet.natural_frequency",)
    ]
    altered = rows["delay of boom.ht+sh+sr+rt"].altered(rig)
    assert {item.series for item in altered.cylinder[0].valve} == {("poppet", "boom_delay")}
    fewer = boom_rows(rig, "ht")["delay of boom.sh+sr+rt"].altered(rig)
    assert len(fewer.cylinder[0].valve[0].series) == 1


def test_what_all_valves_may_have_alike_is_one_row():
    """Four poppets on one driver saturate together: tried one by one none of them would help."""
    rig = rig_of("boom_four_valve")
    rows = boom_rows(rig)
    whole = rows["saturation of boom.ht+sh+sr+rt"]
    assert whole.freedom == 4 and len(whole.starts) == 2 and len(whole.rig_lines(rig)) == 4
    assert {e.law for v in whole.altered(rig).cylinder[0].valve for e in v.edge} == {"saturating"}
    assert all(start.keys() == set(whole.parameters) for start in whole.starts)
    assert rows["gain of boom.ht+sh+sr+rt"].freedom == 4
    drives = rows["saturation of the drive of boom.ht+sh+sr+rt"]
    limits = [float(v.drive_limit or 0.0) for v in drives.altered(rig).cylinder[0].valve]
    assert limits == pytest.approx([0.85 * 3.0] * 4)
    assert "saturation of the drive of boom.sh" in rows


def test_a_pump_s_drive_may_give_no_more():
    rig, t = rig_of("pump_cylinder"), np.arange(9) * 0.01

    def drives(rig, command):
        rows = rows_of(rig, "lift", Record(t, {"lift.drive.command": command}))
        return [row for row in rows.values() if row.kind == "saturation"]

    (drive,) = drives(rig, np.arange(9.0))
    assert drive.upper == {"lift.drive.drive_limit": pytest.approx(1.2 * 8.0)}
    assert drives(drive.altered(rig), np.arange(9.0)) == []
    assert drives(rig, 8.0 * np.sign(np.arange(9.0) - 4.0)) == []  # a lower gain would do as much


def test_losses_of_a_pump_s_cylinder_go_by_the_pressure_that_its_pump_makes():
    """Its charge line has 8 bar, by which dry friction could not reach what its seals have."""
    rig = rig_of("pump_cylinder")
    fault = next(item for item in faults("pump_cylinder", rig) if item.kind == "friction")
    rows = rows_of(rig, "lift", Record(T[:9], {"lift.drive.command": np.arange(9.0)}))
    built = float(fault.machine.parameters()["lift.friction_coulomb"])
    law = rows["friction law of lift"]
    assert law.upper["lift.friction_static"] > 3.0 * built
    assert law.parts([*rows.values()]) == [rows["friction of lift"]]  # which it elaborates
    assert law.without(["lift.friction_coulomb"], []).parts([*rows.values()]) == []


def test_what_promises_little_beside_the_best_is_not_tried():
    found, told = cured("friction")
    tried = [text for text in told if "promises" not in text][1:-1]
    looked = [text for text in told if "promises" in text]
    assert tried[0].startswith("suggest: friction")
    assert len(tried) < len(looked) / 3 and not found.untried


def test_the_error_of_what_is_left_is_of_the_difference_as_a_share_of_the_recipes(monkeypatch):
    """5 ± … and 0.6 of three windows: the differences are 72, 108 and 84 % of what the first
    leaves."""
    monkeypatch.setattr("ehbench.guidance.suggestions._Trials._begun", lambda _, item: item.setup)
    trials = object.__new__(_Trials)
    trials.spread, setup = {"v": 1e-9}, Setup(rig_of(), (), FitOptions())
    trials.tried = [
        Tried(setup, {("log", n): {"v": size} for n, size in enumerate(sizes)}, (), ())
        for sizes in ((4.0, 6.0, 5.0), (0.4, 0.6, 0.8))
    ]
    best, recipe = trials._table(()).rows
    assert (best.misfit, recipe.misfit) == pytest.approx((0.12, 1.0))
    assert best.std == 0.0
    assert recipe.std == pytest.approx(math.sqrt((0.16**2 + 0.20**2 + 0.04**2) / 2.0 / 3.0))


def test_where_nothing_that_promised_helps_the_rest_is_tried(monkeypatch):
    """A promise is to first order, and a cure may lie beyond."""

    def blind(self, now, left):
        return [(1.0, one) for one in left if one.kind in ("friction", "leakage")], []

    monkeypatch.setattr("ehbench.guidance.suggestions._Trials._promised", blind)
    log = log_of("slide_servo", built("friction"), *STEPS, 3, SHORT)
    prepared = prepare_fit(rig_of(), [("log", log)], ["bulk_modulus"])
    found = suggest(prepared, [("log", log)], seconds=600.0, rounds=1)
    assert found.rows[0].changes[0].startswith("friction"), found.rows
    assert len(found.rows) > 2  # the others of them too


@pytest.mark.slow
def test_a_load_that_sways_is_found():
    """A third of the load on a spring; oil, mass and spring of the fit begin elsewhere."""
    sway = {"mass": "90 kg", "stiffness": "150 N/mm", "damping": "800 N*s/m"}
    cylinder = rig_of().cylinder[0].model_copy(update={"sway": Sway.model_validate(sway)})
    machine = rig_of().model_copy(update={"cylinder": (cylinder,)})
    found = suggested(
        "slide_servo", rig_of(), Fault("sway", "", machine), 7, STEPS, 3600.0, 1, SHORT
    )
    first = found.rows[0]
    assert first.changes == ("sway of press",), [row.words for row in found.rows[:4]]
    assert first.misfit < 0.3 and first.freedom == 3
    assert found.setups[0].options.start["press.sway.mass"] == pytest.approx(90.0, rel=0.1)
