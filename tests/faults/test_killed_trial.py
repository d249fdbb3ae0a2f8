"""Killed trials: what was logged is read, what is left is cleared, what lives stays."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.config.recipe import TrialRecipe, load_recipe
from ehbench.data import read
from ehbench.data.logs import LogWriter, write_log
from ehbench.data.record import Record
from ehbench.links import arming
from ehbench.runs import rundir
from ehbench.runtime.interrupts import Terminated
from ehbench.trial import prepare, run
from ehbench.vocabulary.errors import InputError, LogError
from tests.shared import RIGS, ROOT, shipped

SLOW = """
import time
class Slow:
    channels = ["press.x"]
    def start(self, rig, tick, sample):
        self.n = 0
    def step(self, t, sample, desired):
        self.n += 1
        time.sleep(0.004)
        with open("ticks", "w") as file:
            file.write(str(self.n))
        return [2.0]
"""
TRIAL = """stage = "trial"
rig = "RIG"
duration = "60 s"
[controller]
class = "slow:Slow"
"""
OPEN = """stage = "trial"
rig = "RIG"
duration = "0.2 s"
"""
# the command; nothing here looks at figures, and to draw them takes longer than such a run
RUN = """
import sys
import ehbench.report
from ehbench.app.cli import main
sys.modules["ehbench.report"].draw = lambda folder: None
sys.argv[0] = "ehbench"
main()
"""

RIG = shipped("slide_servo")
STEP = {"valve": "press.servo", "kind": "step", "amplitude": "2 V", "start": "0.1 s"}

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")


def filled(folder):
    """A folder with two recipes and a class that is slow."""
    for name, text in (("slow.toml", TRIAL), ("open.toml", OPEN)):
        (folder / name).write_text(text.replace("RIG", str(RIGS / "slide_servo.toml")))
    (folder / "slow.py").write_text(SLOW)
    return folder


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return filled(tmp_path)


@pytest.fixture
def gone():
    """The number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def started(folder, *arguments):
    line = [sys.executable, "-c", RUN, *arguments]
    return subprocess.Popen(line, cwd=folder, stderr=subprocess.DEVNULL)


def until(true, seconds=120):
    deadline = time.monotonic() + seconds
    while not true() and time.monotonic() < deadline:
        time.sleep(0.05)


class Lived(NamedTuple):
    """A trial beside which two runs of one recipe were made, and which was then killed: its folder,
    its process; exit codes of the two, what they left, whether that is whole, what lay beside it;
    ticks that its class had made a second before it was killed."""

    folder: Path
    process: subprocess.Popen
    codes: list[int]
    made: list[Path]
    whole: bool
    beside: list[Path]
    before: int


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    folder = filled(tmp_path_factory.mktemp("lived"))
    reports, ticks, seen = folder / "reports", folder / "ticks", []
    slow = started(folder, "run-trial", "slow.toml", "--allow-code", "-q")

    def long():
        assert slow.poll() is None
        text = ticks.read_text() if ticks.exists() else ""
        if text:  # the class may just be writing it anew
            seen.append((time.monotonic(), int(text)))
        return seen and seen[-1][1] >= 500 and seen[-1][0] > seen[0][0] + 1.0

    try:
        until(lambda: list(reports.glob(".slow_*.part")), 60)
        two = [started(folder, "run-trial", "open.toml", "-q") for _ in range(2)]
        codes = [each.wait(timeout=120) for each in two]
        assert slow.poll() is None
        made, beside = list(reports.glob("open_*")), list(reports.glob(".*.part"))
        whole = all(map(rundir.is_whole, made))
        until(long)
    finally:
        slow.kill()
        slow.wait()
    before = max(n for t, n in seen if t <= seen[-1][0] - 1.0)
    return Lived(folder, slow, codes, made, whole, beside, before)


def test_a_living_run_is_left_alone_and_two_of_one_recipe_do_not_disturb_each_other(lived):
    assert lived.codes == [0, 0]
    assert len(lived.made) == 1 and lived.whole
    (left,) = lived.beside
    assert left.name.startswith(".slow_")


def test_a_killed_trial_keeps_all_but_its_last_second(lived, undrawn, monkeypatch):
    monkeypatch.chdir(lived.folder)
    process, before = lived.process, lived.before
    (left,) = Path("reports").glob(".slow_*.part")
    assert left.name.endswith(f".{process.pid}.part")
    assert before > 200
    notes = workflow.run("open.toml").notes
    (note,) = [note for note in notes if "not finished" in note]
    (log,) = Path("reports/salvaged").rglob("log.mcap")
    assert log.parent.name.endswith(f"_{process.pid}") and str(log) in note
    assert not left.exists()
    record = read(log)
    assert record.t.size >= before and "breaks off" in record.losses[-1]
    assert np.array_equal(record.t, np.arange(record.t.size) / 1000)
    assert (record["press.servo.command"] == 2.0).all() and record.meta["controller"] == "Slow"
    assert set(record.attachments) == {"recipe.toml", "rig.toml"}
    found = inspection.check(log)
    assert found.code == 3 and "breaks off" in "\n".join(found.lines)


def test_what_is_said_of_the_killed_is_not_in_the_run(place, undrawn, gone):
    """Two runs with one hash hold the same bytes, whatever lay beside them."""
    first = workflow.run("open.toml")
    kept = (first.folder / "run.json").read_bytes()
    left = Path("reports") / f".other_12345678.{gone}.part"
    left.mkdir()
    write_log(left / "log.mcap", Record(np.arange(3.0), {"press.x": np.zeros(3)}))
    again = workflow.run("open.toml")
    assert (again.folder / "run.json").read_bytes() == kept
    assert any("not finished" in note for note in again.notes) and not first.notes


def test_two_logs_of_one_name_are_both_kept(tmp_path, gone):
    for size in (3, 4):
        left = tmp_path / f".a.{gone}.part"
        (left / "logs").mkdir(parents=True)
        x = np.arange(float(size))
        write_log(left / "logs" / "case.mcap", Record(x, {"press.x": x / 10}))
        (said,) = rundir.clear_left(tmp_path)
        assert "run of 'a' was not finished" in said and not left.exists()
    for name, size in ((f"a_{gone}", 3), (f"a_{gone}_2", 4)):
        assert read(tmp_path / "salvaged" / name / "logs" / "case.mcap").t.size == size


def test_what_holds_no_samples_is_cleared_without_a_word(tmp_path, gone):
    left = tmp_path / f".a.{gone}.part"
    left.mkdir()
    LogWriter(left / "log.mcap", ["press.x"]).close()
    assert rundir.clear_left(tmp_path) == () and not any(tmp_path.iterdir())


def test_what_is_not_left_by_a_run_stays(tmp_path, gone):
    (tmp_path / ".a.0.part").mkdir()
    (tmp_path / ".a.part").mkdir()
    (tmp_path / f".a.{10**30}.part").mkdir()
    (tmp_path / f".b.{gone}.part").write_text("a file")
    assert rundir.clear_left(tmp_path) == () and len(list(tmp_path.iterdir())) == 4


def test_a_folder_that_a_process_holds_stays(tmp_path, gone):
    """Such as one of another container, whose process numbers mean nothing here."""
    left = tmp_path / f".a.{gone}.part"
    left.mkdir()
    hold = rundir._lock(left)
    assert rundir.clear_left(tmp_path) == () and left.exists()
    os.close(hold)
    rundir.clear_left(tmp_path)
    assert not left.exists()


def test_an_error_leaves_nothing(place):
    Path("slow.py").write_text(SLOW.replace("return [2.0]", "return [1 / (100 - self.n)]"))
    with pytest.raises(InputError, match="ZeroDivisionError at t = 0.099"):
        workflow.run(load_recipe("slow.toml").path, workflow.Session(allow_code=True))
    assert not list(Path().glob("reports/*"))


@pytest.mark.parametrize("real_time", [False, True], ids=["written here", "by a thread"])
def test_a_trial_that_is_broken_off_leaves_its_log_to_the_last_tick(tmp_path, real_time):
    """And the log says that it was: it is read, with a loss."""
    recipe = {"stage": "trial", "rig": "x.toml", "duration": "1 s", "command": (STEP,)}
    ready = prepare(TrialRecipe(path=ROOT / "recipes/trials/position.toml", **recipe), RIG)
    machine, sent = ready.machine, []

    def tick(command, real=machine.tick):
        sent.append(command[0])
        if len(sent) == 334:
            raise Terminated(signal.SIGINT)
        return real(command)

    machine.tick, machine.real_time = tick, real_time
    with pytest.raises(Terminated):
        run(ready, log=tmp_path / "log.mcap", fast=False)
    record = read(tmp_path / "log.mcap")
    assert record.t.size == 334 and record["press.servo.command"][-1] == sent[333] == 2.0
    assert len(sent) == 385 and sent[-1] == 0.0 and (np.diff(sent[333:]) < 0.0).all()  # its ramp
    assert len(record.losses) == 1 and "t = 0.333 s" in record.losses[0]
    assert set(record.attachments) == {"recipe.toml", "rig.toml"}
    assert inspection.check(tmp_path / "log.mcap").code == 3


@pytest.mark.parametrize(
    "ends",
    [
        lambda log: Terminated(signal.SIGINT),
        lambda log: OSError(errno.ENOSPC, "full"),
        lambda log: LogError("full", file=log),
    ],
    ids=["signal", "full disk", "no log"],
)
def test_an_end_of_a_trial_on_a_machine_leaves_its_log(place, monkeypatch, ends):
    """However it ends: what a machine did is not to be had again, and the place is said."""

    def broken_off(prepared, url, ask, log, *others):
        write_log(log, Record(np.arange(3.0), {"press.x": np.zeros(3)}))
        raise ends(log)

    monkeypatch.setattr(arming, "run_remote", broken_off)
    Path("open.toml").write_text(OPEN.replace("RIG", "slide.toml") + 'on = "udp://127.0.0.1:1"')
    Path("slide.toml").write_bytes((RIGS / "slide_servo.toml").read_bytes())
    with pytest.raises((Terminated, InputError, LogError)) as ending:
        workflow.run("open.toml")
    (log,) = (path for path in Path("reports").rglob("*") if path.is_file())
    assert str(log) in ending.value.__notes__[0] and read(log).t.size == 3
