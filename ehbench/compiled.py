"""How the hot functions are compiled: one decorator for the laws, the plant and the integrator, one
cache for their code.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from pathlib import Path

import numba

PACKAGE = Path(__file__).resolve().parent

# Without numba's reference counting a kernel cannot allocate (the compiler refuses it), and passing
# rows and slices of
# arrays from kernel to kernel costs nothing: 1.4 times as fast a plant. Arguments are the caller's,
# who holds them.
OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False}
kernel = numba.njit(cache=True, **OPTIONS)


def _cache_folder() -> Path:
    """A cache for these very sources: numba looks only at a function's own file, and would keep
    what it inlined of others.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        content = path.read_bytes()
        if b"njit" in content or b"@kernel" in content:
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + content)
    return PACKAGE / "__pycache__" / f"kernels_{digest.hexdigest()[:12]}"


def _use_cache() -> None:
    """Point numba to the cache; those of other sources go when a day old, as another process may
    still work with them.
    """
    folder = _cache_folder()
    if not folder.is_dir():
        for old in folder.parent.glob("kernels_*"):
            if time.time() - old.stat().st_mtime > 86400:
                shutil.rmtree(old, ignore_errors=True)
    numba.config.CACHE_DIR = str(folder)


if not numba.config.CACHE_DIR:
    _use_cache()
