"""What tests share: where files lie, rigs as shipped, errors expected by their key."""

from functools import cache
from pathlib import Path

import pytest

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.vocabulary.errors import EhbenchError

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"
RIGS = RECIPES / "rigs"


@cache
def shipped(name: str) -> Rig:
    """The rig of a file of the repository."""
    return load_rig(RIGS / f"{name}.toml")


def refused(key: str, kind: type[EhbenchError] = EhbenchError):
    """An error of the catalogue's key is expected."""
    return pytest.raises(kind, check=lambda error: error.key == key)
