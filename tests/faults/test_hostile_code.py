"""A user's class that does what none should: one sentence names it, and the log is true."""

import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe
from ehbench.config.recipe.trial import Limits
from ehbench.data import read
from ehbench.trial import prepare, run, run_trial, session, user_code
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, refused, shipped

RIG = shipped("slide_servo")
HEAD = "class C:\n    channels = ['press.x']\n"
START = "    def start(self, rig, tick, sample): pass\n"
STEP = "    def step(self, t, sample, desired): return {}\n"
MOTION = {"kind": "point_to_point", "waypoints": ["100 mm", "110 mm"], "speed": "80 mm/s"}


def recipe(folder, code):
    (folder / "mine.py").write_text(code)
    (folder / "trial.toml").write_text("# the recipe\n")
    controller = {"class": "mine:C"}
    given = {"path": folder / "trial.toml", "controller": controller, "motion": MOTION}
    return TrialRecipe(stage="trial", rig="x.toml", duration="0.3 s", **given)


def noting(notes, note):
    return (
        f"from math import *\n{HEAD}    notes = {notes}\n{START}"
        f"    def step(self, t, sample, desired):\n        self.note = {note}\n"
        "        return {}\n"
    )


def test_a_note_never_stands_for_what_was_measured(tmp_path):
    names = ["press.x", "press.p_head", "press.servo.command", "press.x_desired", "t"]
    asked = recipe(tmp_path, noting(names, "[0.2, 1e5, 3.0, 0.15, 7.0]"))
    plain = run_trial(RIG, recipe(tmp_path, HEAD + START + STEP), allow_code=True)
    (tmp_path / "mine.py").write_text(noting(names, "[0.2, 1e5, 3.0, 0.15, 7.0]"))
    noted = run(prepare(asked, RIG, allow_code=True), log=tmp_path / "log.mcap")
    for name, values in plain[0].channels.items():
        assert np.array_equal(noted.record[name], values), name
    assert noted.facts.measures["tracking"] == plain[1].measures["tracking"]
    back = read(tmp_path / "log.mcap")
    assert (back["note.press.x"] == 0.2).all() and (back["note.t"] == 7.0).all()
    assert np.array_equal(back.t, noted.record.t)


@pytest.mark.parametrize(
    ("notes", "note", "key"),
    [
        ("['press.x']", "[nan]", "note_range"),
        ("['press.x']", "[1e300]", "note_range"),
        ("['t']", "[inf]", "note_range"),
        ("['press.x', 'press.v']", "0.2", "note_count"),
        ("['press.x', 'press.x']", "[0.2, 0.3]", "note_twice"),
        ("['press.x [m]']", "[0.2]", "note_name"),
        ("['a\\nfloat64 b.x']", "[0.2]", "note_name"),
        ("[3]", "[0.2]", "not_text"),
        ("['x' * 5000]", "[0.2]", "note_name"),
        ("['press.x'] * 100000", "[0.2]", "note_twice"),
    ],
)
def test_notes_that_no_log_holds_are_refused(tmp_path, notes, note, key):
    with pytest.raises(InputError) as error:
        run_trial(RIG, recipe(tmp_path, noting(notes, note)), allow_code=True)
    assert error.value.key == f"trial.{key}"
    assert error.value.file.endswith("mine.py") and len(str(error.value)) < 1000


EVIL = """
class Evil:
    def __float__(self): raise ZeroDivisionError('float')
    def __repr__(self): raise ZeroDivisionError('repr')
    def __len__(self): raise ZeroDivisionError('len')
    def __getitem__(self, i): raise ZeroDivisionError('item')
    def __array__(self, *_, **__): raise ZeroDivisionError('array')
    def __hash__(self): raise ZeroDivisionError('hash')
class Mute(Exception):
    def __str__(self): raise ZeroDivisionError('str')
class Dark(BaseException): pass
from collections.abc import Mapping
class Map(Mapping):
    def __getitem__(self, key): raise KeyError
    def __iter__(self): raise KeyError()
    def __len__(self): return 1
"""


ANSWERS = [
    "Evil()",
    "[Evil()]",
    "{'press.servo': Evil()}",
    "{Evil(): 1.0}",
    "{('a', []): 1.0}",
    "{'press.servo': [1.0, 2.0]}",
    "{'press.servo': 1j}",
    "{None: 1.0}",
    "Map()",
    "(_ for _ in ()).throw(Mute())",
    "(_ for _ in ()).throw(Dark())",
    "[[[]] * 3, 5]",
    "'x' * 10**6",
    "[float('nan')]",
    "object()",
    "__import__('os')._exit(0)",
    "self.step(t, sample, desired)",
]
SHAPES = [
    "    channels = property(lambda self: 1 / 0)\n",
    "    channels = [Evil()]\n",
    "    channels = Evil()\n",
    "    channels = 5\n",
    "    channels = ['*', 3]\n",
    "    channels = ['press.x']\n    notes = property(lambda self: 1 / 0)\n",
    "    channels = ['press.x']\n    notes = [Evil()]\n",
    "    channels = ['press.x']\n    notes = ['press.v']\n    note = Evil()\n",
    "    channels = ['press.x']\n    notes = ['press.v']\n    note = [Evil()]\n",
    "    channels = ['press.x']\n    step = 5\n",
    "    channels = ['press.x']\n    start = property(lambda self: 1 / 0)\n",
    "    channels = ['press.x']\n    def __init__(self): raise Dark\n",
    "    channels = ['press.x']\n    def __new__(cls): return None\n",
]
FILES = ["\0", "(" * 5000, "\xff\xfe", "x = " + "-" * 200000 + "1", "import nothing_of_the_kind"]


def answering(answer: str) -> str:
    """A class whose step answers so."""
    return f"{EVIL}{HEAD}{START}    def step(self, t, sample, desired): return {answer}\n"


def shaped(body: str) -> str:
    """A class with a body, and the methods that it leaves out."""
    rest = START * ("start =" not in body) + STEP * ("step =" not in body)
    return f"{EVIL}class C:\n{rest}{body}"


@pytest.mark.parametrize("code", [*map(answering, ANSWERS), *map(shaped, SHAPES), *FILES])
def test_code_of_any_kind_is_a_sentence(tmp_path, code):
    asked = recipe(tmp_path, HEAD)
    (tmp_path / "mine.py").write_bytes(code.encode("latin-1"))
    with pytest.raises(InputError) as error:
        run_trial(RIG, asked, allow_code=True)
    assert error.value.file.endswith("mine.py") and (code in FILES or "C" in error.value.message)
    assert len(str(error.value)) < 1000 and "\n" not in error.value.message


def test_code_that_ends_the_process_is_named(tmp_path):
    before = os._exit
    code = "from os import _exit\n" + HEAD + START
    code += "    def step(self, t, sample, desired):\n        _exit(0)\n"
    with refused("trial.code_exits") as e:
        run_trial(RIG, recipe(tmp_path, code), allow_code=True)
    assert e.value.line == 6 and os._exit is before


@pytest.mark.parametrize("body", ["time.sleep(60)", "while True: pass"])
def test_a_step_that_does_not_come_back_is_ended(tmp_path, monkeypatch, body):
    monkeypatch.setattr(user_code, "CODE", replace(user_code.CODE, step=0.5, look=0.1))
    code = "import time\n" + HEAD + START
    code += f"    def step(self, t, sample, desired):\n        {body}\n"
    asked, begun = recipe(tmp_path, code), time.monotonic()
    with pytest.raises(InputError, check=lambda e: e.fields["longest"] == 0.5) as error:
        run_trial(RIG, asked, allow_code=True)
    assert error.value.line == 6 and time.monotonic() - begun < 20.0


def test_a_class_that_is_slow_is_named(tmp_path, monkeypatch):
    short = replace(session.SESSION, patience=0.1, longest=1.0)
    monkeypatch.setattr(session, "SESSION", short)
    code = "import time\n" + HEAD + START
    code += "    def step(self, t, sample, desired):\n        time.sleep(0.02)\n        return {}\n"
    with refused("trial.slow_class"):
        run_trial(RIG, recipe(tmp_path, code), allow_code=True)


def test_a_command_beyond_its_limit_in_the_first_tick_never_acts(tmp_path):
    code = HEAD + START + "    def step(self, t, sample, desired): return {'press.servo': 9.0}\n"
    asked = recipe(tmp_path, code).model_copy(update={"limits": Limits(command_max="5 V")})
    record, facts = run_trial(RIG, asked, allow_code=True)
    assert facts.stop.limit == "command_max" and facts.stop.t == 0.0 and facts.stop.value == 9.0
    assert not record["press.servo.command"].any() and facts.after.still


RUN = """
import sys
from ehbench.app.cli import main
sys.argv = ["ehbench", "run-trial", "trial.toml", "--allow-code", "-q", "--out", "out"]
main()
"""


@pytest.mark.slow
def test_a_terminated_trial_does_not_blame_the_class(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import time\n" + HEAD + START + "    def step(self, t, sample, desired):\n"
        "        open('begun', 'w').close()\n        time.sleep(0.01)\n        return {}\n"
    )
    rig = ROOT / "recipes" / "rigs" / "slide_servo.toml"
    (tmp_path / "trial.toml").write_text(
        f"stage = 'trial'\nrig = '{rig}'\n[controller]\nclass = 'mine:C'\n[motion]\n"
        "kind = 'point_to_point'\nwaypoints = ['100 mm', '110 mm']\nspeed = '80 mm/s'\n"
        "hold = '20 s'\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", RUN], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "begun").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.terminate()
    said = process.communicate(timeout=30)[1]
    assert process.returncode == 143 and "C.step" not in said
    left = {p.name for p in tmp_path.iterdir()}
    assert left - {"begun"} == {"mine.py", "trial.toml"}
