"""The kernel decorators and their cache."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

from ehbench import compiled
from ehbench.plant import integrate


def grows(n):
    return np.zeros(n).sum()


def test_a_kernel_cannot_allocate():
    """What numba compiles by itself, a kernel refuses when it is first called."""
    assert numba.njit(grows)(3) == 0.0
    with pytest.raises(NumbaError):
        compiled.kernel(grows)(3)


def test_the_cache_is_that_of_these_sources(tmp_path, monkeypatch):
    """A changed kernel file gives another folder, a file without kernels does not: callers are
    compiled again where they must.
    """
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


def test_what_kernels_call_has_no_machine_code_of_its_own():
    """It stands in that of its callers alone."""
    inner = compiled._compiler(compiled._APART, kept=False)(twice)

    def calls(x):
        return inner(x) + 1.0

    assert compiled._compiler(compiled._APART, kept=False)(calls)(3.0) == 7.0
    (made,) = inner._inner.overloads.values()
    assert made.library.get_pointer_to_function(made.fndesc.llvm_func_name) == 0


def test_processes_that_compile_at_once_write_files_of_their_own():
    """Else one would load the other's code, which was compiled for other types."""
    files = compiled.kernel(twice)._inner._cache._cache_file
    assert files._data_name(1) != files._data_name(1)


def test_old_caches_stay_until_they_are_cleaned():
    """Importing removes nothing: another process may work with the cache of other sources."""
    old = compiled.PACKAGE / "__pycache__" / "kernels_of_older_sources"
    old.mkdir(exist_ok=True)
    try:
        os.utime(old, (0, 0))
        subprocess.run([sys.executable, "-c", "import ehbench.compiled"], check=True)
        assert old.is_dir()
    finally:
        old.rmdir()
