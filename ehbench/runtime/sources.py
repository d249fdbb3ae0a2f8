"""The package's own files, by which results and compiled code are named."""

import os
from pathlib import Path

APART = ("__pycache__", "shipped")  # what compilers keep, and recipes and datasets of a wheel


def sources(package: Path, *suffixes: str) -> list[Path]:
    """The files below a package that have one of these suffixes, in the order of their paths.

    What lies APART is not looked into: another process may clear old code away meanwhile."""
    results = []
    for folder, below, names in os.walk(package):
        below[:] = [name for name in below if name not in APART]
        results += [Path(folder, name) for name in names if name.endswith(suffixes)]
    return sorted(results)
