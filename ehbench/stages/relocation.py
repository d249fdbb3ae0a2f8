"""Recipes written into another folder name the same files from there."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ehbench.config.recipe import Recipe

# keys of a recipe that name files, and lists whose plain texts do
_KEYS = ("rig", "flow_maps", "bench", "file", "path", "from", "gains", "columns")
_LISTS = ("data", "beside")


def relocated(table: Any, name_of: Callable[[str], str], key: str = "") -> Any:
    """A recipe's table, or a part of it by its key, with the files that it names under other names:
    ``name_of`` gives the new one by that in the recipe."""
    if isinstance(table, dict):
        return {name: relocated(value, name_of, name) for name, value in table.items()}
    if isinstance(table, list):
        return [relocated(item, name_of, key if key in _LISTS else "") for item in table]
    if isinstance(table, str) and key in (*_KEYS, *_LISTS) and "$" not in table:
        return name_of(table)
    return table


def relative(path: Path, folder: Path) -> str:
    """A file as a recipe in a folder names it."""
    return Path(os.path.relpath(path, folder)).as_posix()


def name_from(folder: Path, recipe: Recipe, name: str) -> str:
    """A file of a recipe as a recipe in another folder names it; what is no file stays as it is."""
    path = recipe.file(name) if name else None
    if path is None or not path.exists():
        return name
    return relative(path, folder.resolve())
