"""Trials that are killed: what was logged can be read, the next run clears what is left and keeps
the log, and what a living process works on stays.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ehbench import inspection, rundir, workflow
from ehbench.errors import InputError
from ehbench.logs import LogWriter, read_record, write_log
from ehbench.recipe import load_recipe
from ehbench.record import Record

RIGS = Path(__file__).parents[2] / "recipes" / "rigs"
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
from ehbench.cli import main
sys.modules["ehbench.report"].draw = lambda folder: None
sys.argv[0] = "ehbench"
main()
"""

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in (("slow.toml", TRIAL), ("open.toml", OPEN)):
        Path(name).write_text(text.replace("RIG", str(RIGS / "slide_servo.toml")))
    Path("slow.py").write_text(SLOW)
    return tmp_path


@pytest.fixture
def gone():
    """The number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def started(*arguments):
    return subprocess.Popen([sys.executable, "-c", RUN, *arguments], stderr=subprocess.DEVNULL)


def killed(ticks):
    """A trial killed once its class has made so many ticks; (process, ticks made a second
    before).
    """
    process, made = started("run-trial", "slow.toml", "--allow-code", "-q"), []
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and (not made or made[-1][1] < ticks):
        time.sleep(0.05)
        assert process.poll() is None
        text = Path("ticks").read_text() if Path("ticks").exists() else ""
        made.append((time.monotonic(), int(text or (made[-1][1] if made else 0))))
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    end = made[-1][0]
    return process, max(n for t, n in made if t <= end - 1.0)


def test_a_killed_trial_keeps_all_but_its_last_second(place, undrawn):
    process, before = killed(600)
    (left,) = Path("reports").glob(".slow_*.part")
    assert left.name.endswith(f".{process.pid}.part")
    assert before > 200
    notes = workflow.run("open.toml").notes
    (note,) = [note for note in notes if "killed" in note]
    (log,) = Path("reports/salvaged").rglob("log.mcap")
    assert log.parent.name.endswith(f"_{process.pid}") and str(log) in note
    assert not left.exists()
    record = read_record(log)
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
    assert any("killed" in note for note in again.notes) and not first.notes


def test_two_logs_of_one_name_are_both_kept(tmp_path, gone):
    for size in (3, 4):
        left = tmp_path / f".a.{gone}.part"
        (left / "logs").mkdir(parents=True)
        x = np.arange(float(size))
        write_log(left / "logs" / "case.mcap", Record(x, {"press.x": x / 10}))
        (said,) = rundir.clear_left(tmp_path)
        assert "run of 'a' was killed" in said and not left.exists()
    sizes = [
        read_record(tmp_path / "salvaged" / name / "logs" / "case.mcap").t.size
        for name in (f"a_{gone}", f"a_{gone}_2")
    ]
    assert sizes == [3, 4]


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
    hold = rundir._held(left)
    assert rundir.clear_left(tmp_path) == () and left.exists()
    os.close(hold)
    rundir.clear_left(tmp_path)
    assert not left.exists()


@pytest.mark.slow
def test_a_living_run_is_left_alone_and_two_of_one_recipe_do_not_disturb_each_other(place):
    slow = started("run-trial", "slow.toml", "--allow-code", "-q")
    try:
        deadline = time.monotonic() + 60
        while not list(Path("reports").glob(".slow_*.part")) and time.monotonic() < deadline:
            time.sleep(0.05)
        two = [started("run-trial", "open.toml", "-q") for _ in range(2)]
        assert [each.wait(timeout=120) for each in two] == [0, 0]
        (whole,) = Path("reports").glob("open_*")
        assert rundir.is_whole(whole) and slow.poll() is None
        (left,) = Path("reports").glob(".*.part")
        assert left.name.startswith(".slow_")
    finally:
        slow.kill()
        slow.wait()


def test_an_error_leaves_nothing(place):
    Path("slow.py").write_text(SLOW.replace("return [2.0]", "return [1 / (100 - self.n)]"))
    with pytest.raises(InputError, match="raised ZeroDivisionError at t = 0.099"):
        workflow.run(load_recipe("slow.toml").path, workflow.Session(allow_code=True))
    assert not list(Path("reports").iterdir())
