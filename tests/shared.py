"""What tests share: where files lie, rigs as shipped, errors expected by their key."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.vocabulary.errors import EhbenchError

if TYPE_CHECKING:
    from ehbench.validation import Validation

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


def judged(rig: Rig, logs, channels=(), thresholds=None, fitted_on=()) -> Validation:
    """The verdict on logs by their checks alone: to diagnose what is left takes most of one."""
    from ehbench.validation import prepare_validation, run_validation
    from ehbench.validation.judge import CHANNELS

    prepared = prepare_validation(rig, logs, channels or CHANNELS, fitted_on=fitted_on)
    return run_validation(prepared, thresholds, diagnose=False)
