"""Where a user's code lies and which files it imports, found without running any of it."""

from __future__ import annotations

import ast
import sys
import sysconfig
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def source_of(module: str) -> Path | None:
    """The Python file of an importable module by its dotted name; None where there is none.

    No package on the way is imported, as `importlib.util.find_spec` would."""
    result, folders = None, None
    words = module.split(".")
    for end in range(1, len(words) + 1):
        if not words[end - 1].isidentifier():
            return None
        result = _spec(".".join(words[:end]), folders)
        if result is None:
            return None
        folders = result.submodule_search_locations
        if folders is None and end < len(words):
            return None
        folders = None if folders is None else list(folders)
    if result is None or not result.origin:
        return None
    file = Path(result.origin)
    return file.resolve() if file.suffix == ".py" and file.is_file() else None


def _spec(name: str, folders: list[str] | None) -> ModuleSpec | None:
    for finder in sys.meta_path:
        try:
            result = finder.find_spec(name, folders)
        except (ImportError, AttributeError, ValueError, OSError):
            continue
        if result is not None:
            return result
    return None


def files_of(code: Path) -> tuple[Path, ...]:
    """A code file and all that it imports, and those in turn, but for what is installed: the
    standard library, site packages and this package, which a run names by version. Sorted, the
    file itself first.
    """
    own, waiting = {code}, [code]
    while waiting:
        for module in _imported(waiting.pop()):
            file = source_of(module)
            if file is not None and file not in own and not _is_installed(file):
                own.add(file)
                waiting.append(file)
    return (code, *sorted(own - {code}))


def _imported(file: Path) -> Iterator[str]:
    """The modules that a file's import statements name, each with the packages it lies in."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError, MemoryError, OSError):
        return  # the run will say so
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            words = name.split(".")
            if words[0] not in sys.stdlib_module_names:
                yield from (".".join(words[:end]) for end in range(1, len(words) + 1))


def _is_installed(file: Path) -> bool:
    paths = sysconfig.get_paths()
    places = [Path(paths[key]).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib")]
    return any(place in file.parents for place in (*places, _PACKAGE))
