"""A check looks at code without running any; what a class imports belongs to its run."""

import sys

import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.trial.code import files_of, source_of
from tests.shared import ROOT

RIG = ROOT / "recipes" / "rigs" / "slide_servo.toml"
CLASS = (
    "class C:\n    channels = ['press.x']\n    def start(self, rig, tick, sample): pass\n"
    "    def step(self, t, sample, desired): return {'press.servo': VOLTS}\n"
)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, from which modules are imported too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("helper", "deeper", "pkg", "pkg.sub", "pkg.other"):
        sys.modules.pop(name, None)


def recipe(place, name="mine:C"):
    (place / "trial.toml").write_text(
        f"stage = 'trial'\nrig = '{RIG}'\nduration = '0.2 s'\n[controller]\nclass = '{name}'\n"
        "[motion]\nkind = 'point_to_point'\nwaypoints = ['100 mm', '101 mm']\nspeed = '80 mm/s'\n"
    )
    return place / "trial.toml"


@pytest.mark.parametrize("name", ["pkg.sub:C", "pkg.sub.deeper:C", "pkg:C", "this:C", "this.x:C"])
def test_a_check_runs_no_code(place, capsys, name):
    (place / "pkg").mkdir()
    for file in ("pkg/__init__.py", "pkg/sub.py", "pkg/other.py"):
        (place / file).write_text("import pathlib\npathlib.Path('touched').touch()\n")
    sys.modules.pop("this", None)
    try:
        inspection.check(recipe(place, name))
    except workflow.InputError:
        pass
    assert not (place / "touched").exists() and not capsys.readouterr().out
    assert not {"pkg", "pkg.sub", "this"} & set(sys.modules)


@pytest.mark.parametrize("name", ["a b:C", "..:C", "a.:C", "x" * 5000 + ":C", "x:C\0", "os\0:C"])
def test_what_names_no_class_is_a_sentence(place, name):
    path = recipe(place, "mine:C")
    path.write_text(path.read_text().replace("'mine:C'", '"' + name.replace("\0", "\\u0000") + '"'))
    found = inspection.check(path)
    assert found.code == 2 and all(len(str(error)) < 500 for error in found.errors)


def test_files_that_a_class_imports_are_found_and_none_that_is_installed(place):
    (place / "mine.py").write_text(
        "import os, numpy, helper\nfrom pkg import sub\nimport not_there\nfrom ehbench import rig\n"
    )
    (place / "helper.py").write_text("def f():\n    import deeper.nothing, mine\n")
    (place / "deeper.py").write_text("(((")
    (place / "pkg").mkdir()
    for file in ("__init__", "sub", "other"):
        (place / "pkg" / f"{file}.py").write_text("")
    names = [file.relative_to(place).as_posix() for file in files_of(place / "mine.py")]
    assert names == ["mine.py", "deeper.py", "helper.py", "pkg/__init__.py", "pkg/sub.py"]
    assert source_of("pkg.other") == place / "pkg" / "other.py" and source_of("pkg.none") is None


def test_a_module_that_a_class_imports_makes_another_run(place, undrawn):
    (place / "mine.py").write_text("from helper import VOLTS\n" + CLASS)
    path, session = recipe(place), workflow.Session(allow_code=True, root=place / "runs")
    folders = set()
    for volts in (0.0, 1.0, 0.0):
        (place / "helper.py").write_text(f"VOLTS = {volts}\n")
        sys.modules.pop("helper", None)
        sys.path_importer_cache.clear()
        made = workflow.run(path, session)
        folders.add(made.folder)
        inputs = [one["path"] for one in made.json("run")["inputs"] if one["role"] == "code"]
        assert inputs == ["mine.py", "helper.py"]
    assert len(folders) == 2
