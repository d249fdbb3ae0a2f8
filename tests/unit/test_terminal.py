"""What a run found, on a terminal and for scripts."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from ehbench.app import cli
from ehbench.report import terminal
from ehbench.report.blocks import Grid
from ehbench.runs.rundir import plain
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.text import folded
from tests.shared import ROOT


@pytest.fixture(scope="module")
def judged(slide_runs, tmp_path_factory):
    """The run that validates the sliding mass; that of its identification lies beside it."""
    root = shutil.copytree(slide_runs, tmp_path_factory.mktemp("runs") / "slide")
    return next(Path(root).glob("validation_*"))


@pytest.fixture(scope="module")
def fitted(judged):
    return next(judged.parent.glob("hydraulics_*"))


def test_a_fit_shows_each_parameter_to_people_and_scripts(fitted):
    told = terminal.answer(fitted).lines(100)
    known = json.loads((fitted / "parameters.json").read_text())["parameters"]
    for one in known:
        # the sentence above the table may break before a name too
        (line,) = [line for line in told if line.startswith(one["name"] + "  ")]
        assert "…" in line and one["status"].replace("_", " ") in line
    assert max(map(len, told)) <= 100
    found = terminal.answer(fitted).values
    known = json.loads((fitted / "parameters.json").read_text())["parameters"]
    assert [row["parameter"] for row in found["results"]] == [one["name"] for one in known]
    assert found["numbers"]["parameters"] == known and "parameters.json" in found["files"]


def test_a_narrow_terminal_gets_fewer_columns_and_no_broken_line(fitted):
    wide, narrow = terminal.answer(fitted).lines(100), terminal.answer(fitted).lines(40)
    rule = next(line for line in narrow if line.startswith("─"))
    assert "status" in " ".join(wide) and len(rule) <= 40
    assert any(line.startswith("bulk_modulus") for line in narrow)
    assert len(max(terminal.answer(fitted).lines(40, whole=True), key=len)) > 100


def test_a_verdict_comes_first_and_in_capitals(judged):
    assert terminal.answer(judged).verdict.startswith("ACCEPTED WITH RESERVATION on 1 held-out")
    table = json.loads((judged / "validation.json").read_text())
    fields = {"channels": "press.servo.command", "ms": 10.0, "names": "late"}
    remedy = plain(message("faults.written_late", **fields))
    lean = {"estimate": "bulk_modulus", "instead": "800 MPa", "here": "862 MPa", "remedy": remedy}
    reasons = ["it rings at another rate", {"key": "", "text": "late", "fields": lean}]
    said = dict(table, accepted=False, verdict="rejected", reasons=reasons)
    kept = (judged / "validation.json").read_text()
    (judged / "validation.json").write_text(json.dumps(said))
    try:
        told = terminal.answer(judged)
        assert told.verdict.startswith("REJECTED") and "- it rings" in str(told.lines(whole=True))
        # its cause precedes what the residuals follow, and names the column
        assert told.steps[0].hint == 'late = "10 ms"' and "press.servo.command" in told.steps[0]
        (judged / "validation.json").write_text(json.dumps(said | {"reasons": reasons[1:]}))
        assert "800 MPa, not 862 MPa" in terminal.answer(judged).verdict
    finally:
        (judged / "validation.json").write_text(kept)


@pytest.mark.parametrize("option", ["-q", "--json", ""])
def test_the_path_ends_what_is_printed_and_is_all_of_it_when_quiet(
    option, inside, undrawn, tmp_path
):
    recipe, out = tmp_path / "still.toml", tmp_path / "run"
    rig = ROOT / "recipes" / "rigs" / "slide_servo.toml"
    recipe.write_text(f'stage = "trial"\nduration = "0.2 s"\nrig = "{rig}"\n')
    done = inside("run-trial", recipe, "--out", out, *([option] if option else []))
    assert done.returncode == 0, done.stderr
    if option == "--json":
        assert json.loads(done.stdout)["folder"] == str(out)
    else:
        *told, path = done.stdout.splitlines()
        assert path == str(out) and bool(told) == (option == "")
        assert option == "" or not done.stderr


def test_notes_of_several_logs_that_differ_in_numbers_alone_are_one():
    said = [
        "out: p_supply is up to 285 psi below the model's (at t = 2.665 s)",
        "out: the stroke begins 3.1 mm off",
        "ram.a.gain is held, and these logs would have it 2 % off: what is left would fall by 5 %",
        "back_2: p_supply is up to 90.4 psi below the model's (at t = 12 s)",
        "ram.b.gain is held, and these logs would have it 3 % off: what is left would fall by 9 %",
        "up: p_supply is up to 7 psi above the model's (at t = 1 s)",
    ]
    assert folded([*said, said[1]]) == [f"{said[0]} (the like of back_2)", *said[1:3], *said[4:]]


def test_a_long_verdict_ends_with_a_clause():
    parts = [f"fit of channel number {n} is {n} %" for n in range(20)]
    (line,) = terminal.Answer("REJECTED on one log: " + ", ".join(parts)).lines(width=1000)
    assert line.endswith(" %, …") and 20 < len(line.split()) <= 31
    (line,) = terminal.Answer("word " * 40).lines(width=1000)
    assert line.split() == ["word"] * 30 + ["…"]


def test_a_long_table_is_cut_and_says_so():
    rows = [[str(n)] for n in range(30)]
    answer = terminal.Answer("done", [Grid(["n"], rows)], rows=24)
    short, whole = answer.lines(), answer.lines(whole=True)
    assert short[4:-2] == [str(n) for n in range(24)] and "6 more rows with -v" in short[-2]
    assert whole[4:-1] == [str(n) for n in range(30)]


def test_a_log_that_is_no_terminal_hears_each_half_minute_how_far_it_is(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(cli, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with cli._session(quiet=False) as session:
        assert session.progress is not None
        for share, now[0] in ((0.0, 0.0), (0.1, 10.0), (0.3, 31.0), (0.4, 40.0), (0.625, 62.0)):
            session.progress("study: some samples", share)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3 and [line[-4:] for line in said[1:]] == ["30 %", "62 %"]
