"""Every stage is whole: a recipe model of its own, a command, a section in the report."""

import tomllib
from types import SimpleNamespace
from typing import get_type_hints

import numpy as np
import pytest
import tomli_w

from ehbench import load_rig, workflow
from ehbench.app.cli import app
from ehbench.config import recipe
from ehbench.data.logs import write_log
from ehbench.plant.model import Model
from ehbench.report.stages import SECTIONS
from ehbench.report.terminal import Answer
from ehbench.stages import STAGES as KINDS
from ehbench.stages import stage_of
from ehbench.stages.hydraulics import HydraulicsStage
from ehbench.stages.tuning import TuningStage
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.commands import COMMANDS
from tests.shared import RIGS, ROOT, shipped
from tools.virtual_logs import virtual_log

EVERY = {kind: stage_of(model) for kind, model in recipe.recipe_kinds().items()}
STAGES = [stage for stage in EVERY.values() if stage.command]
KNOWN = {one.name or one.callback.__name__ for one in app.registered_commands}


def test_every_kind_of_recipe_has_its_stage():
    assert EVERY.keys() == KINDS.keys()
    for kind, model in recipe.recipe_kinds().items():  # by the type that it prepares
        assert get_type_hints(type(EVERY[kind]).prepare)["recipe"] is model


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_has_a_command_and_a_section(stage):
    assert stage.command in KNOWN and stage.writes
    assert stage.name in SECTIONS or stage.name == "campaign"  # a campaign is the page itself


def test_every_command_that_runs_recipes_has_a_stage():
    assert {one.name for one in COMMANDS} < {stage.command for stage in STAGES} <= KNOWN


@pytest.mark.parametrize("met, code", [(True, 0), (False, 4)])
def test_a_tuning_that_misses_its_demands_says_so_by_its_code(met, code, tmp_path):
    rig = load_rig(RIGS / "slide_servo.toml")
    state = SimpleNamespace(
        rig=rig, flow_maps=None, stage="validated", saved=lambda name: {"reservations": []}
    )
    tuning = SimpleNamespace(met=met, warnings=(), as_json=lambda: {"met": met})
    work = TuningStage()._written(SimpleNamespace(state=state), tmp_path, tuning)
    assert work.code == code and len(work.reasons) == (not met)


@pytest.mark.parametrize("stated", [{"reservations": [message("stages.demands_missed")]}, None])
def test_what_speaks_against_the_rig_of_a_tuning_is_said_in_plain_sight(stated, tmp_path):
    stage = "rejected" if stated is None else "validated"
    rig = load_rig(RIGS / "slide_servo.toml")
    state = SimpleNamespace(rig=rig, flow_maps=None, stage=stage, saved=lambda name: stated or {})
    tuning = SimpleNamespace(met=True, warnings=(), as_json=lambda: {})
    work = TuningStage()._written(SimpleNamespace(state=state), tmp_path, tuning)
    (note,) = work.facts["warnings"]
    key = "stages.tuned_unvalidated" if stated is None else "stages.tuned_with_reservation"
    lines = Answer("", notes=[note]).lines()
    assert note.key == key and any(f"- {note[:40]}" in line for line in lines)


@pytest.mark.parametrize(("known", "steps"), [({}, ["transfer = true"]), ({"transfers": [1]}, [])])
def test_a_response_without_plain_forms_says_how_to_get_them(known, steps):
    run = SimpleNamespace(json=lambda name: {"warnings": []} | known)
    assert [step.hint for step in SECTIONS["response"].findings(run).next] == steps


def test_a_true_error_stands_beside_the_measured_one():
    """A terminal leaves out the last columns that do not fit."""
    text = (ROOT / "ehbench" / "report" / "templates" / "trial.toml").read_text()
    heads = [column[0] for column in tomllib.loads(text)["tracking"]["columns"]]
    for name in ("largest", "rms"):
        assert heads.index(f"{name} true error") == heads.index(f"{name} error") + 1


def test_a_force_that_differs_between_logs_is_a_key_of_their_entry(tmp_path):
    """It is played on the rod: the same commands move the slide otherwise."""
    text = (RIGS / "slide_servo.toml").read_text()
    force = '\n[[cylinder.force]]\nkind = "channel"\nchannel = "press.force"\n'
    (tmp_path / "rig.toml").write_text(text + force)
    log = virtual_log("slide_servo", shipped("slide_servo"), "steps", 1, 1.0)
    write_log(tmp_path / "log.mcap", log)
    table = {
        "stage": "identify",
        "what": "hydraulics",
        "rig": "rig.toml",
        "data": [{"path": "log.mcap", "force": {"press.force": f"{kilo} kN"}} for kilo in (0, 2)],
        "parameters": ["bulk_modulus"],
    }
    (tmp_path / "fit.toml").write_text(tomli_w.dumps(table))
    given = recipe.load_recipe(tmp_path / "fit.toml")
    logs = HydraulicsStage().prepare(given, workflow.Session().inputs(given)).fit.logs
    assert [set(item.record["press.force"]) for item in logs] == [{0.0}, {2000.0}]
    model = Model.of(load_rig(tmp_path / "rig.toml"))
    free, pushed = (model.replay(item.record)["press.p_head"] for item in logs)
    area = model.rig.cylinder[0].areas()[0]
    assert np.ptp(pushed - free) > 0.2 * 2000.0 / area


@pytest.mark.parametrize("channel", ["press.fors", "press.load_force"])
def test_a_force_that_no_rod_of_the_rig_has_is_refused_with_its_line(channel, tmp_path):
    text = (RIGS / "slide_servo.toml").read_text()
    force = '\n[[cylinder.force]]\nkind = "channel"\nchannel = "press.force"\n'
    (tmp_path / "rig.toml").write_text(text + force)
    lines = ["stage = 'identify'", "what = 'hydraulics'", "rig = 'rig.toml'"]
    lines += ["data = [", "'log.mcap',"]
    lines += [f"{{ path = 'log.mcap', force = {{ '{channel}' = '2 kN' }} }}]"]
    (tmp_path / "fit.toml").write_text("\n".join([*lines, "parameters = ['bulk_modulus']"]))
    log = virtual_log("slide_servo", shipped("slide_servo"), "steps", 1, 1.0)
    write_log(tmp_path / "log.mcap", log)
    given = recipe.load_recipe(tmp_path / "fit.toml")
    with pytest.raises(InputError) as error:
        HydraulicsStage().prepare(given, workflow.Session().inputs(given))
    assert error.value.line == 4 and error.value.fields["known"] == "press.force"
