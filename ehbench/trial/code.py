"""Where a user's code lies and which files it imports, without running any of it."""

import ast
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ehbench.config.recipe import TrialRecipe
from ehbench.vocabulary import InputError, message, shortened

_PACKAGE = Path(__file__).resolve().parents[1]


def refuse_code(recipe: TrialRecipe, allowed: bool) -> None:
    """Refuse a user's controller unless it is allowed.

    Raises:
        InputError: it is not allowed."""
    if recipe.controller is not None and recipe.controller.code is not None and not allowed:
        where = recipe.at(*recipe.controller.where, "class")
        raise InputError(message("trial.code_not_allowed", code=recipe.controller.code), **where)


def code_file(recipe: TrialRecipe) -> Path | None:
    """The Python file of the recipe's ``class``: next to the recipe, else that of an importable
    module; None without class.

    Raises:
        InputError: there is none."""
    if recipe.controller is None or recipe.controller.code is None:
        return None
    text, where = recipe.controller.code, recipe.at(*recipe.controller.where, "class")
    module, _, name = text.partition(":")
    words = module.split(".")
    if not (name.isidentifier() and all(word.isidentifier() for word in words) and len(text) < 300):
        raise InputError(message("trial.no_class_name", text=shortened(text, 100)), **where)
    additional = recipe.path.parent / (module.replace(".", "/") + ".py")
    if additional.is_file():
        return additional.resolve()
    result = source_of(module)
    if result is None:
        raise InputError(message("trial.no_module", module=module, file=additional.name), **where)
    return result


def code_files(recipe: TrialRecipe) -> tuple[Path, ...]:
    """The code file of a recipe, then those that it imports and that are not installed."""
    code = code_file(recipe)
    return () if code is None else files_of(code)


def source_of(module: str) -> Path | None:
    """The Python file of an importable module by its dotted name; None where there is none.

    No package on the way is imported, as `importlib.util.find_spec` would."""
    result, folders = None, None
    words = module.split(".")
    for end in range(1, len(words) + 1):
        if not words[end - 1].isidentifier():
            return None
        name, result = ".".join(words[:end]), None
        for finder in sys.meta_path:
            with suppress(ImportError, AttributeError, ValueError, OSError):
                result = result or finder.find_spec(name, folders)
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


def files_of(code: Path) -> tuple[Path, ...]:
    """A code file and all that it imports, and those in turn, but for what is installed: the
    standard library, site packages and this package, which a run names by version. Sorted, the
    file itself first."""
    paths = sysconfig.get_paths()
    places = [Path(paths[key]).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib")]
    installed, files, waiting = {*places, _PACKAGE}, {code}, [code]
    while waiting:
        for module in _imported(waiting.pop()):
            file = source_of(module)
            if file is not None and file not in files and installed.isdisjoint(file.parents):
                files.add(file)
                waiting.append(file)
    return (code, *sorted(files - {code}))


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
