"""The kernel decorators, their cache, and the sources that it is named by."""

import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

from ehbench.app import starter, warm
from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.control import LAW_NAMES
from ehbench.physics.flow_map import bspline_pieces
from ehbench.plant import integrate
from ehbench.runtime import compiled
from ehbench.runtime.sources import sources


def grows(n):
    return np.zeros(n).sum()


def test_kernels_cannot_allocate_and_use_the_public_interface():
    """What numba compiles by itself, a kernel refuses when it is first called."""
    assert numba.njit(grows)(3) == 0.0
    with pytest.raises(NumbaError):
        compiled.kernel(grows)(3)
    used = {
        line.strip()
        for path in compiled.PACKAGE.rglob("*.py")
        for line in path.read_text().splitlines()
        if re.match(r"\s*(import|from) (numba|llvmlite)", line)
    }
    assert all(line == "import numba" or "numba.extending" in line for line in used)


def test_the_cache_is_that_of_these_sources(tmp_path, monkeypatch):
    """A changed kernel file gives another folder, a file without kernels does not."""
    monkeypatch.setattr(compiled, "PACKAGE", tmp_path)
    folders = set()
    for mark in ("kernel", "allocating_kernel"):
        (tmp_path / "words.py").write_text("A = 1\n")
        (tmp_path / "law.py").write_text(f"@{mark}\ndef f(x): return x\n")
        first = compiled._cache_folder()
        (tmp_path / "words.py").write_text("A = 2\n")
        assert compiled._cache_folder() == first
        (tmp_path / "law.py").write_text(f"@{mark}\ndef f(x): return 2 * x\n")
        folders |= {first, compiled._cache_folder()}
    assert len(folders) == 4


def test_the_cache_lies_where_it_can_be_written(tmp_path, monkeypatch):
    """Beside the package, where numba was told, at the user's home, or for this process alone."""
    places = [tmp_path / name for name in ("package", "told", "home", "temporary")]
    places[3].mkdir()
    monkeypatch.setattr(compiled, "PACKAGE", places[0])
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(places[1]))
    monkeypatch.setenv("HOME", str(places[2]))
    monkeypatch.setenv("USERPROFILE", str(places[2]))
    monkeypatch.setattr(compiled.tempfile, "tempdir", str(places[3]))
    monkeypatch.setattr(compiled.atexit, "register", lambda *_, **given: given)
    for place in places[:3]:
        assert place in compiled._cache_folder().parents
        shutil.rmtree(place)
        place.write_text("no folder")
    folder = compiled._cache_folder()
    assert folder.parent == places[3] and folder.is_dir()


@pytest.mark.parametrize("where", ["", "/elsewhere"])
def test_kernels_use_it_and_numba_keeps_its_own(where, monkeypatch):
    """Also where the host has told numba of a place of its own."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", where)
    mine = compiled.allocating_kernel(grows)
    assert numba.config.CACHE_DIR == where
    folder = str(compiled._cache_folder())
    for function in (mine, integrate.run, integrate.advance):
        assert function.outer.stats.cache_path.startswith(folder)


def twice(x):
    return 2.0 * x


def test_processes_that_compile_at_once_write_files_of_their_own():
    """Else one would load the other's code, which was compiled for other types."""
    files = compiled.kernel(twice).inner._cache._cache_file
    assert files._data_name(1) != files._data_name(1)


def test_old_caches_stay_until_they_are_cleaned():
    """Importing removes nothing: another process may work with the cache of other sources."""
    old = compiled.PACKAGE / "__pycache__" / "kernels_of_older_sources"
    old.mkdir(exist_ok=True)
    try:
        os.utime(old, (0, 0))
        subprocess.run([sys.executable, "-c", "import ehbench.runtime.compiled"], check=True)
        assert old.is_dir()
    finally:
        old.rmdir()


def test_rows_and_tables_are_those_of_numpy():
    """Fields, columns, what they hold in turn, and what is no field, as numpy's records have it."""
    inner = compiled.record(("gain", "f8"), ("count", "i8"))
    layout = compiled.record(("size", "f8"), ("past", "f8", (3,)), ("inner", inner))
    made = compiled.table(4, layout)
    plain = np.zeros(4, np.dtype((np.record, layout.descr))).view(np.recarray)
    for rows in (made, plain):
        rows["past"] = np.arange(12.0).reshape(4, 3)
        rows.inner.gain = 2.0
        rows[1].past = 7.0
        rows[2].inner.count = 5
        rows[3].inner = (3.0, 4)
    assert made.tobytes() == plain.tobytes() and made.size == plain.size == 4
    for ours, theirs in ((made, plain), (made[1:], plain[1:]), (made.inner, plain.inner)):
        assert isinstance(ours, compiled.Table) and isinstance(ours[0], compiled.Row)
        assert ours.dtype.type is compiled.Row and repr(ours.tolist()) == repr(theirs.tolist())
    assert type(made.past) is np.ndarray and type(made.inner.gain) is np.ndarray
    assert type(made[1].past) is np.ndarray and type(made[1].inner.gain) is np.float64
    made[1].past[0] = 1.0  # what is looked at is the table itself
    assert made.past[1, 0] == 1.0
    copied = pickle.loads(pickle.dumps((made, made[2])))
    assert copied[0].tobytes() == made.tobytes()
    assert copied[0].inner.count[2] == copied[1].inner.count == 5
    assert not hasattr(made, "weight") and not hasattr(made[0], "weight")
    with pytest.raises(AttributeError, match="weight"):
        made[0].weight = 1.0


# --- what is compiled after an install is what trials then run


@pytest.mark.parametrize("machine", ["model", "bench"])
def test_every_law_runs_on_every_machine(machine, tmp_path):
    starter.init(tmp_path / "rig")
    rig = load_rig(tmp_path / "rig" / "rig.toml")
    laws = [
        recipe.controller.kind if recipe.controller else None
        for keys in warm.recipes(rig, machine)
        if (recipe := TrialRecipe(stage="trial", rig="rig.toml", path=Path("x"), **keys)).on
    ]
    assert laws == [None, *LAW_NAMES]
    assert machine in warm.trials(machine, "", *LAW_NAMES)


def test_an_arm_moves_and_fits_find_their_kernels_compiled():
    assert warm.together("an arm") == "an arm"
    assert warm.replays("steps") == "steps"
    assert warm.fits("fits") == "fits"
    folder = Path(bspline_pieces.outer.stats.cache_path)
    assert list(folder.glob("*bspline_pieces*.nbi"))


AHEAD = """
from pathlib import Path
from numba.core.caching import NullCache
from ehbench.app import warm
from ehbench.ledger import quadrature
from ehbench.plant import derivatives, valves
from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.trial import account, prepare, run

warm.ahead()
tops = (quadrature.integrate, quadrature.stores_at, valves.follow_valves)
kernels = [*(each.inner for each in derivatives.LAST), *(each.outer for each in tops)]
known = [each.signatures for each in kernels]
assert all(len(each) == 1 for each in known), known
rig = load_rig(Path("rig/rig.toml"))
recipe = TrialRecipe(stage="trial", rig="x", path=Path("x"), **next(warm.recipes(rig, "model")))
prepared = prepare(recipe, rig)
result = run(prepared)
account(prepared, result)
derivatives.derivatives.inner._cache = NullCache()
y = result.record.t
derivatives.derivatives.compile(y, y, result.model.plant, y, y)
assert known == [each.signatures for each in kernels]
"""


@pytest.mark.slow
def test_what_is_compiled_ahead_is_what_a_trial_calls(tmp_path):
    """For the very types: a trial on the model compiles none of it for others."""
    starter.init(tmp_path / "rig")
    command = [sys.executable, "-c", AHEAD]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_only_own_files_of_these_kinds_in_one_order(tmp_path):
    for name in ("b.py", "a.py", "a/z.py", "a.html", "__pycache__/c.py", "a/shipped/d.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    found = [path.relative_to(tmp_path).as_posix() for path in sources(tmp_path, ".py", ".html")]
    assert found == ["a/z.py", "a.html", "a.py", "b.py"]


def test_what_another_process_clears_away_is_not_looked_into(monkeypatch):
    """A cache of older sources may go while one looks."""
    looked, scan = [], os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: looked.append(str(path)) or scan(path))
    assert compiled.PACKAGE / "workflow.py" in sources(compiled.PACKAGE, ".py")
    assert looked and not any("__pycache__" in path for path in looked)
