"""The command line as a user meets it: help, exit codes, messages, nothing half-written."""

import json
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ehbench.app import cli, starter
from ehbench.report.terminal import answer
from tests.answers import short
from tests.shared import ROOT

COMMANDS = tuple(str(one.name or one.callback.__name__) for one in cli.app.registered_commands)


def ehbench(*words: str | Path, cwd: Path = ROOT, **options) -> subprocess.CompletedProcess:
    """Run the command as a user would, in a process of its own."""
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    line = [sys.executable, "-m", "ehbench.app.cli", *map(str, words)]
    ways = {"capture_output": True, "text": True, "timeout": 300, "check": False} | options
    # pyrefly: ignore[no-matching-overload]
    return subprocess.run(line, cwd=cwd, env=environment, **ways)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cli") / "my_rig"
    starter.init(folder)
    return folder


def test_help_and_readme_name_every_command():
    text = ehbench("--help").stdout
    for command in COMMANDS:
        assert command in text
    for code in range(6):
        assert re.search(rf"\b{code} \w", text)
    named = set(re.findall(r"ehbench ([a-z][a-z-]+)", (ROOT / "README.md").read_text()))
    assert set(COMMANDS) <= named
    assert named <= set(COMMANDS)


def test_quantities_lists_what_a_word_leads_to(inside):
    done = inside("quantities", "Damping", "--json")
    rows = {row["name"]: row for row in json.loads(done.stdout)["quantities"]}
    assert done.returncode == 0 and rows["joint_damping"]["unit"] == "N*m*s/rad"
    assert "bulk_modulus" not in rows
    assert inside("quantities", "presure").returncode == 2
    assert len(json.loads(inside("quantities", "--json").stdout)["quantities"]) > 200


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example(inside, command):
    done = inside(command, "--help")
    assert done.returncode == 0
    assert re.search(rf"Example:\s+ehbench {command} \S+", done.stdout)


def test_a_format_that_is_not_written_is_refused_in_plain_words(inside, tmp_path):
    done = inside("convert", tmp_path / "log.mcap", "--to", "xlsx")
    assert done.returncode == 2
    said = " ".join(done.stderr.split())
    assert "Invalid value for '--to': 'xlsx' is not one of 'parquet', 'mat'" in said


@pytest.mark.parametrize(
    "name, right",
    [("slide_serv", "did you mean 'slide_servo'?"), ("xyz", "recipes/: boom_four_valve, ")],
)
def test_a_campaign_that_is_not_there_is_told_from_those_that_are(inside, tmp_path, name, right):
    done = inside("reproduce", name, cwd=tmp_path)
    assert done.returncode == 2 and f"no campaign '{name}'" in done.stderr and right in done.stderr
    assert not list(tmp_path.iterdir())


def test_init_says_three_lines_and_leaves_a_full_folder_alone(inside, tmp_path):
    done = inside("init", tmp_path / "new")
    assert done.returncode == 0 and len(short(done.stdout)) == 3
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("keep")
    done = inside("init", full)
    assert done.returncode == 2 and "not empty" in done.stderr
    assert [p.name for p in full.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_a_new_workspace_runs_as_it_stands(workspace, inside, unpainted):
    """The commands of the workspace's own README, in order, in few words and without a doubt."""
    commands = re.findall(r"^    ehbench (.+)$", (workspace / "README.md").read_text(), re.M)
    assert len(commands) == 5
    for line in commands:
        words = line.split()
        if "*" in line:
            runs = (path for word in words for path in sorted(workspace.glob(word)))
            words = ["report", *(str(path.relative_to(workspace)) for path in runs)]
        done = inside(*words, cwd=workspace)
        assert done.returncode == 0, f"{line}: {done.stderr}"
    assert list(workspace.glob("reports/report_*/report.html"))
    for command, status in (("identify", "done"), ("validate", "accepted")):
        (run,) = workspace.glob(f"reports/{command}_*")
        notes = json.loads((run / "run.json").read_text())["notes"]
        assert not [note for note in notes if "counts on" not in note]
        said = answer(run, notes)
        assert said.values["status"] == status and short("\n".join(said.lines()))
    fit = json.loads(next(workspace.glob("reports/identify_*/parameters.json")).read_text())
    assert {row["status"] for row in fit["parameters"]} == {"estimated"}


def test_every_file_of_a_workspace_checks(workspace, inside):
    for path in [workspace / "rig.toml", *sorted((workspace / "recipes").glob("*.toml"))]:
        done = inside("check", path)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("ok: ")


def broken(workspace: Path, tmp_path: Path, file: str, old: str, new: str, without="reports"):
    """A copy of the workspace with one slip in one file."""
    copy = tmp_path / "ws"
    shutil.copytree(workspace, copy, ignore=shutil.ignore_patterns(without))
    text = (copy / file).read_text()
    assert old in text
    (copy / file).write_text(text.replace(old, new, 1))
    return copy


STEP = "recipes/step_small.toml"
SLIPS = [
    ("rig.toml", '"160 bar"', '"160"', ["rig.toml:18", "no unit"]),
    (STEP, 'valve = "lift.spool"', 'valve = "lift.spol"', ["lift.spool"]),
    (STEP, '"3.5 V"', '"35 V"', ["-10 to 10 V"]),
    (STEP, '"4 s"', '"4 s', ["step_small.toml", "TOML"]),
]


@pytest.mark.parametrize(("file", "old", "new", "words"), SLIPS)
def test_a_slip_gets_one_sentence_and_leaves_nothing(
    workspace, inside, tmp_path, file, old, new, words
):
    copy = broken(workspace, tmp_path, file, old, new)
    done = inside("run-trial", "recipes/step_small.toml", cwd=copy)
    assert done.returncode == 2, done.stderr
    sentence = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(sentence) == 1 and "Traceback" not in done.stderr
    for word in words:
        assert word in sentence[0]
    assert not (copy / "reports").exists() or not list((copy / "reports").iterdir())


def test_check_tells_all_mistakes_and_a_recipe_its_command(workspace, inside, tmp_path):
    copy = broken(workspace, tmp_path, "recipes/step_small.toml", '"3.5 V"', '"35 V"')
    done = inside("check", "recipes/step_small.toml", cwd=copy)
    assert done.returncode == 2 and done.stdout.startswith("1 error: ")
    assert re.fullmatch(r"error: .*step_small.toml:\d+: .*-10 to 10 V.*\n", done.stderr)
    done = inside("check", "recipes/validate.toml", cwd=copy)
    assert done.returncode == 2 and "35 V" in done.stderr and "runs first" in done.stdout
    assert not (copy / "reports").exists()
    done = inside("identify", workspace / "recipes" / "step_small.toml")
    assert done.returncode == 2 and "run-trial" in done.stderr


def test_a_limit_stops_a_trial_with_5_and_keeps_the_log(workspace, inside, undrawn, tmp_path):
    copy = broken(workspace, tmp_path, "recipes/step_small.toml", '"220 bar"', '"45 bar"')
    done = inside("run-trial", "recipes/step_small.toml", "--out", "stopped", cwd=copy)
    assert done.returncode == 5, done.stderr
    assert "pressure_max" in done.stdout and (copy / "stopped" / "log.mcap").is_file()


def test_a_rejected_model_exits_with_4_and_keeps_the_verdict(
    workspace, inside, undrawn, undiagnosed, tmp_path
):
    """Of the fit that stands in the workspace, if the test above has left it there."""
    slip = ("recipes/validate.toml", "p_head = 70", "p_head = 99.9")
    copy = broken(workspace, tmp_path, *slip, without="report_*")
    done = inside("validate", "recipes/validate.toml", "--out", "judged", cwd=copy)
    assert done.returncode == 4, done.stderr
    assert json.loads((copy / "judged" / "run.json").read_text())["accepted"] is False


def test_a_truncated_log_finishes_with_3_and_says_how_much_was_lost(
    workspace, inside, undrawn, tmp_path
):
    step = workspace / "recipes" / "step_small.toml"
    whole = inside("run-trial", step, "--out", tmp_path / "trial")
    assert whole.returncode == 0, whole.stderr
    data = (tmp_path / "trial" / "log.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * 0.7)])
    done = inside("check", tmp_path / "cut.mcap")
    assert done.returncode == 3 and "lost" in done.stdout


def test_an_out_that_is_no_run_is_left_alone(workspace, inside, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    step = workspace / "recipes" / "step_small.toml"
    done = inside("run-trial", step, "--out", tmp_path / "mine")
    assert done.returncode == 2 and (tmp_path / "mine" / "notes.txt").read_text() == "keep"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine"]


def test_a_terminated_run_leaves_nothing(workspace, tmp_path):
    words = ["identify", workspace / "recipes" / "identify.toml", "--out", tmp_path / "run"]
    line = [sys.executable, "-m", "ehbench.app.cli", *map(str, words)]
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(line, cwd=tmp_path, stdout=quiet, stderr=quiet)
    deadline = time.monotonic() + 60
    while not list(tmp_path.rglob(".*.part")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 143
    assert not (tmp_path / "run").exists() and not list(tmp_path.rglob("*.part"))


def test_a_signal_while_kernels_are_loaded_ends_the_run_once_they_are(workspace, tmp_path):
    """The compiler's library reads code by calling back, and takes a null where that raises."""
    asked_within = (
        "import os, signal, sys\n"
        "from numba.core.codegen import JITCodeLibrary\n"
        "reading = JITCodeLibrary._object_getbuffer_hook.__func__\n"
        "def asked(*of):\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "    return reading(*of)\n"
        "JITCodeLibrary._object_getbuffer_hook = classmethod(asked)\n"
        "from ehbench.app import cli\n"
        "cli.main()\n"
    )
    words = ["identify", str(workspace / "recipes" / "identify.toml"), "--out", "run"]
    line, ways = [sys.executable, "-c", asked_within, *words], {"timeout": 300, "check": False}
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, **ways)
    assert done.returncode == 143, done.stderr
    assert not (tmp_path / "run").exists() and not list(tmp_path.rglob("*.part"))


@pytest.mark.slow
def test_same_recipe_same_bytes(workspace, inside, tmp_path):
    """In this process and in one of its own."""
    for name, run in (("one", inside), ("two", ehbench)):
        done = run("run-trial", workspace / "recipes" / "step_large.toml", "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
    one, two = (
        {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "one", tmp_path / "two")
    )
    assert one.keys() == two.keys()
    for name, path in one.items():
        assert name.name == "volatile.json" or path.read_bytes() == two[name].read_bytes(), name


def test_a_log_becomes_a_page_and_what_is_none_is_named(inside, tmp_path):
    log, page = "datasets/slide_servo/steps/press_no_load.mcap", tmp_path / "look.html"
    done = inside("show", log, "--out", page)
    assert done.returncode == 0 and done.stdout.strip() == str(page)
    assert "press.p_head" in page.read_text()
    again = inside("show", ROOT / log, ROOT / log, cwd=tmp_path)
    assert again.returncode == 0 and (tmp_path / again.stdout.strip()).is_file()
    for words, says in ((["README.md"], "cannot show '.md'"), ([log] * 3, "one or two")):
        done = inside("show", *words)
        assert done.returncode == 2 and says in done.stderr


def test_two_runs_are_compared_as_a_table_and_as_json(inside, tmp_path):
    from tests.unit.report_runs import flow_map_run, hydraulics_run

    run, other = hydraulics_run(tmp_path), tmp_path / "other"
    shutil.copytree(run, other)
    table = json.loads((other / "parameters.json").read_text())
    table["parameters"][0]["value"] = 2.8e8
    (other / "parameters.json").write_text(json.dumps(table))
    done = inside("compare", run, other)
    assert done.returncode == 3 and re.search(r"bulk_modulus .* MPa .*0\.61", done.stdout)
    done = inside("compare", run, other, "--json")
    assert [one["name"] for one in json.loads(done.stdout)["parameters"]] == ["bulk_modulus"]
    done = inside("compare", run, flow_map_run(tmp_path))
    assert done.returncode == 2 and "compare runs of one stage" in done.stderr


def test_the_module_is_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ehbench", "--version"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("ehbench", run_name="__main__")
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("ehbench ")
