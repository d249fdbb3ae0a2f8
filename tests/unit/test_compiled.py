"""The kernel decorator and its cache."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

from ehbench import compiled


def test_a_kernel_cannot_allocate():
    """What numba compiles by itself, a kernel refuses when it is first called."""

    def grows(n):
        return np.zeros(n).sum()

    assert numba.njit(grows)(3) == 0.0
    with pytest.raises(NumbaError):
        compiled.kernel(grows)(3)


def test_the_cache_is_that_of_these_sources(tmp_path, monkeypatch):
    """A changed kernel file gives another folder, a file without kernels does not: callers are
    compiled again where they must.
    """
    (tmp_path / "law.py").write_text("@kernel\ndef f(x): return x\n")
    (tmp_path / "words.py").write_text("A = 1\n")
    monkeypatch.setattr(compiled, "PACKAGE", tmp_path)
    first = compiled._cache_folder()
    (tmp_path / "words.py").write_text("A = 2\n")
    assert compiled._cache_folder() == first
    (tmp_path / "law.py").write_text("@kernel\ndef f(x): return 2 * x\n")
    assert compiled._cache_folder() != first


def test_numba_uses_it():
    assert numba.config.CACHE_DIR
