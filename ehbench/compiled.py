"""How the hot functions are compiled: one decorator for the laws, the plant and the integrator, one
for loops that allocate, one cache for their code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

PACKAGE = Path(__file__).resolve().parent
_MARKS = (b"njit", b"@kernel", b"@allocating_kernel")


def _cache_folder() -> Path:
    """A cache for these very sources: numba looks only at a function's own file, and would keep
    what it inlined of others.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + content)
    return PACKAGE / "__pycache__" / f"kernels_{digest.hexdigest()[:12]}"


def _compiler(folder: Path, **options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles when first called and keeps the code in ``folder``.

    numba reads where to keep code when it wraps a function, and from its global settings only;
    they are as before once the function is wrapped.
    """

    def compiled(function: Callable) -> Any:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
        try:
            return numba.njit(cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


_FOLDER = _cache_folder()

# Without numba's reference counting a kernel cannot allocate (the compiler refuses it), and passing
# rows and slices of arrays costs nothing: 1.4 times as fast a plant. Arguments are the caller's.
kernel = _compiler(_FOLDER, error_model="numpy", _nrt=False)

allocating_kernel = _compiler(_FOLDER)
