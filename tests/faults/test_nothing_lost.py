"""Only files that a run itself made are ever replaced, whatever is named as its place."""

import errno
import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from ehbench.app import starter
from ehbench.data import read
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.runs import rundir
from ehbench.runtime import disk
from ehbench.vocabulary.errors import InputError
from tests.shared import refused

RECIPE = "recipe.toml"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with a file that stands for a recipe."""
    monkeypatch.chdir(tmp_path)
    Path(RECIPE).write_text("stage = 'trial'\n")
    return tmp_path


def made(final, text="one", on="model"):
    """A run in ``final`` that left one file and one in a folder."""
    with rundir.open_run(Path(final), "trial", Path(RECIPE), []) as run:
        run.facts["on"] = on
        (run.path / "result.json").write_text(text)
        (run.path / "figures").mkdir()
        (run.path / "figures" / "a.svg").write_text(text)
    return run


def tree(folder):
    """Every file below a folder with its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in Path(folder).rglob("*.*")}


@pytest.mark.parametrize("there", [False, True])
def test_a_refused_run_leaves_no_folder_that_was_not_there(place, there):
    if there:
        Path("reports").mkdir()
    with (
        pytest.raises(InputError),
        rundir.open_run(Path("reports/new/trial_1"), "trial", Path(RECIPE), []),
    ):
        raise InputError("no")
    assert Path("reports").is_dir() is there and not Path("reports/new").exists()


def test_a_run_replaces_the_run_before(place):
    made("out")
    assert made("out", "two").left_over == ()
    assert Path("out/result.json").read_text() == Path("out/figures/a.svg").read_text() == "two"
    assert sorted(p.name for p in place.iterdir()) == ["out", RECIPE]


def test_the_same_run_made_again_stays_where_others_read_it(place):
    """What a process reads is there at any moment, and the time of the run is the last one's."""
    made("run")
    volatile = Path("run/volatile.json")
    before, read_there = volatile.read_bytes(), Path("run").stat().st_ino
    volatile.write_bytes(before + b" ")
    made("run")
    assert Path("run").stat().st_ino == read_there and volatile.read_bytes()[-1:] != b" "
    Path("run/result.json").write_text("edited")
    made("run")
    assert Path("run").stat().st_ino != read_there
    assert Path("run/result.json").read_text() == "one"


@pytest.mark.parametrize("facts", ["{}", "[]", "", '{"outputs": []}', "[" * 5000, None])
def test_a_folder_with_other_files_is_left_alone(place, facts):
    Path("out").mkdir()
    Path("out/keep.txt").write_text("mine")
    if facts is not None:
        Path("out/run.json").write_text(facts)
    before = tree("out")
    with pytest.raises(InputError):
        made("out")
    assert tree("out") == before and not list(place.glob(".*"))


@pytest.mark.parametrize("name", ["notes.txt", "figures/mine.svg", "sub/result.json", ""])
def test_a_run_is_not_replaced_with_a_file_that_it_did_not_write_or_of_a_machine(place, name):
    """Without a foreign file, what a machine did."""
    made("out", on="model" if name else "udp://127.0.0.1:47000")
    if name:
        (place / "out" / name).parent.mkdir(exist_ok=True)
        (place / "out" / name).write_text("mine")
    before = tree("out")
    with refused("runs.foreign_file" if name else "runs.recorded", InputError) as caught:
        made("out", "two")
    assert caught.value.fields.get("name", "") == name and caught.value.file == "out"
    assert tree("out") == before and not list(place.glob(".*"))


@pytest.mark.parametrize("folder", [".", "..", "../../runs"])
def test_a_run_does_not_replace_the_folder_that_a_user_is_in(folder, place, monkeypatch):
    (place / "runs" / "empty").mkdir(parents=True)
    monkeypatch.chdir(place / "runs" / "empty")
    with refused("runs.current_folder", InputError):
        made(folder)
    assert Path.cwd().is_dir()


def test_a_folder_is_refused_before_runs_that_a_recipe_names_are_made(place):
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine")
    Path(RECIPE).write_text('stage = "validate"\nrig = "none.toml"\ndata = ["none.csv"]\n')
    with refused("runs.not_a_run", InputError):
        workflow.run(RECIPE, workflow.Session(root=place, out=Path("mine")))


def test_a_file_put_there_while_the_run_is_made_is_kept(place):
    made("out")
    with pytest.raises(InputError, match="late.txt"):
        with rundir.open_run(Path("out"), "trial", Path(RECIPE), []) as run:
            (run.path / "result.json").write_text("two")
            Path("out/late.txt").write_text("mine")
    assert Path("out/late.txt").read_text() == "mine" and not list(place.glob(".*"))
    assert Path("out/result.json").read_text() == "one"


def test_what_a_machine_did_is_kept_beside_a_place_that_was_taken_meanwhile(place):
    """As a whole run, or its log where the run fails."""
    with rundir.open_run(Path("out"), "trial", Path(RECIPE), []) as run:
        run.facts["on"] = "udp://127.0.0.1:47000"
        (run.path / "result.json").write_text("moved")
        Path("out").mkdir()
        Path("out/late.txt").write_text("mine")
    (said,) = run.left_over
    assert said.key == "runs.beside" and tree("out") == {"late.txt": b"mine"}
    assert run.final == Path("out_2") and rundir.is_whole(run.final)
    with pytest.raises(OSError) as caught:
        with rundir.open_run(Path("new"), "trial", Path(RECIPE), []) as run:
            run.facts["on"] = "udp://127.0.0.1:47000"
            write_log(run.path / "log.mcap", Record(np.arange(3.0), {"press.x": np.zeros(3)}))
            raise OSError("no figure")
    (note,) = caught.value.__notes__
    (log,) = Path("salvaged").rglob("log.mcap")
    assert str(log) in note and read(log).t.size == 3 and not Path("new").exists()


def test_a_file_of_the_run_that_was_changed_is_kept_aside(place):
    made("out")
    Path("out/figures/a.svg").write_text("drawn over")
    (said,) = made("out", "two").left_over
    kept = Path("salvaged/out/figures/a.svg")
    assert kept.read_text() == "drawn over" and str(kept) in said and "figures/a.svg" in said
    assert Path("out/figures/a.svg").read_text() == "two"


def test_names_in_a_run_that_lead_out_of_it_are_never_followed(place):
    made("out")
    Path("mine.txt").write_text("mine")
    facts = json.loads(Path("out/run.json").read_text())
    facts["outputs"]["../mine.txt"] = rundir.sha256(Path("mine.txt"))
    Path("out/run.json").write_text(json.dumps(facts))
    made("out", "two")
    assert Path("mine.txt").read_text() == "mine"


def test_a_link_is_followed_and_stays(place):
    Path("real").mkdir()
    Path("link").symlink_to("real")
    made("link")
    assert Path("link").is_symlink() and Path("real/result.json").read_text() == "one"
    made("link", "two")
    assert Path("link").is_symlink() and Path("real/result.json").read_text() == "two"


def test_a_link_within_a_run_is_no_file_of_it(place):
    made("out")
    Path("mine.txt").write_text("one")
    Path("out/result.json").unlink()
    Path("out/result.json").symlink_to(Path("mine.txt").resolve())
    with pytest.raises(InputError, match="result.json"):
        made("out", "two")
    assert Path("mine.txt").read_text() == "one"


def test_a_place_that_is_none_is_a_sentence(place):
    Path("a").symlink_to("b")
    Path("b").symlink_to("a")
    Path("file").write_text("mine")
    for final in ("a", "x" * 5000, "a\0b", "file", "file/below"):
        with pytest.raises(InputError):
            made(final)
    assert Path("file").read_text() == "mine"


def test_a_full_disk_is_a_sentence_and_leaves_nothing(place, monkeypatch):
    def full(path, value):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rundir, "write_json", full)
    with pytest.raises(InputError, match=r"out: .*No space left on device"):
        made("out")
    assert sorted(p.name for p in place.iterdir()) == [RECIPE]


def test_init_never_writes_over_a_file(place):
    Path("a").mkdir()
    Path("a/rig.toml").write_text("mine")
    for folder in ("a", "b/../a", "a/rig.toml", "a/rig.toml/sub", "x" * 5000, "a\0"):
        with pytest.raises(InputError):
            starter.init(Path(folder))
    assert tree("a") == {"rig.toml": b"mine"} and not Path("b").exists()
    os.symlink("a", "link")
    with pytest.raises(InputError):
        starter.init(Path("link"))
    starter.init(Path("new/deep"))
    assert tree("new/deep") == tree(rundir.PACKAGE / "workspace")


@contextmanager
def disk_of(size):
    """While no file may grow beyond ``size`` [bytes]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_takes_no_more_is_one_sentence_of_the_place_that_was_asked_for(place, inside):
    starter.init(Path("ws"))
    words = ("run-trial", "ws/recipes/step_small.toml", "--out", "out", "-q")
    for size in (4_000, 60_000, 100_000):
        with disk_of(size):
            done = inside(*words, cwd=place)
        assert done.returncode == 2, done.stderr
        (sentence,) = done.stderr.splitlines()
        assert sentence.startswith("error: out: ") and "File too large" in sentence
        assert not Path("out").exists() and not list(place.glob(".*"))
    done = inside(*words, cwd=place)
    assert done.returncode == 0, "it was the disk alone"


WRITES = {  # (command, a page that stood there before)
    "show": (("show", "log.csv", "--out", "page.html"), "page.html"),
    "convert": (("convert", "log.csv", "--to", "mat", "--out", "log.mat"), None),
    "map": (("map", "log.csv", "--out", "log.map.toml"), None),
    "init": (("init", "ws"), None),
}


@pytest.mark.parametrize("name", WRITES)
def test_a_full_disk_leaves_each_output_as_it_was(place, name):
    words, earlier = WRITES[name]
    t = np.arange(4000) / 1e3
    table = np.column_stack([t, np.sin(t), np.random.default_rng(1).normal(size=t.size)])
    header = "t [s],press.x [m],press.p_head [Pa]"
    np.savetxt("log.csv", table, delimiter=",", header=header, comments="")
    if earlier:
        Path(earlier).write_text('<meta name="generator" content="ehbench show">' + "x" * 9_000)
    before = tree(place)
    line = [sys.executable, "-m", "ehbench.app.cli", *words]
    with disk_of(2_500):
        done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert tree(place) == before and not list(place.glob(".*"))


def test_a_disk_that_is_read_only_is_named_by_what_was_asked_for(place, monkeypatch):
    """Linux refuses there even to remove a file that is not there."""

    def refuse(self, missing_ok=False):
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError) as error, disk.replacing(place / "page.html"):
        pass
    assert error.value.errno == errno.EROFS and error.value.filename == str(place / "page.html")


def test_a_device_is_written_to_and_a_link_is_followed(place):
    Path("real.txt").write_text("old")
    os.symlink("real.txt", "link.txt")
    disk.write_text(Path("link.txt"), "new")
    assert Path("link.txt").is_symlink() and Path("real.txt").read_text() == "new"
    os.mkfifo("pipe")
    with subprocess.Popen(["cat", "pipe"], stdout=subprocess.PIPE, text=True) as reader:
        disk.write_text(Path("pipe"), "through")
        assert reader.communicate()[0] == "through"
    assert Path("pipe").is_fifo()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device here")
def test_words_that_nobody_takes_are_no_traceback(place):
    starter.init(Path("ws"))
    line = [sys.executable, "-m", "ehbench.app.cli", "check", "ws/rig.toml"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(line, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2 and done.stderr == "error: No space left on device\n"
