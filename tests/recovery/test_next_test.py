"""The next test: what it is said to tell is what it tells when the virtual rig runs it."""

import math
import shutil
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.guidance.next_test import WAVES, Drive, entries_of
from ehbench.runs import rundir
from ehbench.stages.hydraulics import HydraulicsStage
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, shipped

RECIPE = ROOT / "recipes" / "slide_servo" / "hydraulics.toml"


@pytest.fixture(scope="module")
def place(slide_runs, tmp_path_factory) -> Path:
    """A fit of the slide's two shipped logs, beside a recipe that asks for the same."""
    root = tmp_path_factory.mktemp("next")
    (fit,) = slide_runs.glob("hydraulics_*")
    shutil.copytree(fit, root / "fit")
    text = RECIPE.read_text(encoding="utf-8")
    text = text.replace("../rigs", f"{ROOT}/recipes/rigs").replace(
        "../../datasets", f"{ROOT}/datasets"
    )
    (root / "fit.toml").write_text(text, encoding="utf-8")
    return root


def rows_of(folder):
    found = rundir.read_json(folder / "parameters.json")["parameters"]
    return {row["name"]: row for row in found}


def width(ends):
    """Of an interval, as a ratio: fitted values move with the log that is added."""
    return math.log(ends[1] / ends[0])


@pytest.mark.parametrize("amplitude", [0.01, 0.5, 1.0])
def test_every_command_of_a_test_opens_its_valve(amplitude):
    """Of the crane's ±10 V the first 1.5 V are overlap: a share counts of the rest."""
    drive = Drive("lift", {"lift.spool": 1.0}, {"lift.spool": -0.8})
    entries = entries_of(shipped("crane_proportional"), drive, "steps", amplitude)
    assert len(entries) == sum(map(len, WAVES["steps"]))
    for share in (1.0, -0.8):
        said = [one["amplitude"] for one in entries if one["amplitude"] * share > 0.0]
        volts = math.copysign(1.5, share) + 8.5 * amplitude * share
        assert said and said == pytest.approx([volts] * len(said), abs=1e-3)


@pytest.mark.slow
def test_the_proposed_test_tells_what_it_was_said_to_when_the_virtual_rig_runs_it(place, undrawn):
    name = "carriage.damping"
    session = workflow.Session(root=place / "runs", out=place / "next.toml")
    found = workflow.next_test(place / "fit", name, session)
    said = found.proposals[0]
    assert not found.changes and said.share is not None and said.share < 0.8
    text = (place / "fit.toml").read_text(encoding="utf-8")
    again = place / "again.toml"
    again.write_text(text.replace("data = [", 'data = ["next.toml",'), encoding="utf-8")
    session = workflow.Session(root=place / "runs", out=place / "again")
    made = workflow.run(again, session)
    ratio = width(rows_of(made.folder)[name]["interval"]) / width(said.interval)
    assert 1 / 1.5 < ratio < 1.5
    assert width(rows_of(made.folder)[name]["interval"]) < width(
        rows_of(place / "fit")[name]["interval"]
    )


def test_proposals_come_best_first_and_the_least_known_is_meant_by_default(place, tmp_path):
    """Three quarters of each variance are of fixed numbers: they stay."""
    folder = shutil.copytree(place / "fit", tmp_path / "fit")
    fit = rundir.read_json(folder / "parameters.json")
    for row in fit["parameters"]:
        row["from_fixed"] = 0.75
    rundir.write_json(folder / "parameters.json", fit)
    found = workflow.next_test(folder)
    widths = [one.interval[1] - one.interval[0] for one in found.proposals]
    assert widths == sorted(widths) and len(widths) > 5
    shares = [one.share or 0.0 for one in found.proposals]
    assert 0.75**0.5 < min(shares) < 0.97 and max(shares) < 1.0
    relative = {n: row["interval"] for n, row in rows_of(folder).items()}
    assert found.known.name in relative and found.as_json()["tests"][0]["commands"]
    answer = found.answer(folder, None)
    assert len(answer.tables[0].rows) > 5 and answer.steps[0].key == "steps.write_test"


def test_a_name_is_refused_before_anything_is_run(place, monkeypatch):
    monkeypatch.setattr(HydraulicsStage, "prepare", lambda *_: pytest.fail("prepared"))
    with pytest.raises(InputError, match="'press.q' was not fitted"):
        workflow.next_test(place / "fit", "press.q")


def test_what_cannot_be_planned_is_refused_with_a_sentence(place, tmp_path):
    with pytest.raises(InputError, match="was not fitted"):
        workflow.next_test(place / "fit", "press.leakage_internal")
    changed = shutil.copytree(place / "fit", tmp_path / "fit")
    said = rundir.read_json(changed / "volatile.json")
    said["recipe"] = str(place / "fit.toml")  # which names its files by other paths
    rundir.write_json(changed / "volatile.json", said)
    with pytest.raises(InputError, match="has changed since"):
        workflow.next_test(changed)


def test_a_run_that_was_edited_since_says_so(place, tmp_path):
    edited = shutil.copytree(place / "fit", tmp_path / "fit")
    with (edited / "parameters.json").open("a", encoding="utf-8") as file:
        file.write("\n")
    (change,) = workflow.next_test(edited, "bulk_modulus").changes
    assert change.key == "report.output_changed" and change.fields["file"] == "parameters.json"
