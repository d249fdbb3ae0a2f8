"""What tests share: where files lie, rigs as shipped, errors expected by their key."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ehbench.config.recipe import TrialRecipe, load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
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


def slide(**cylinder: Any) -> Rig:
    """The shipped sliding mass, its cylinder with further keys and tables of a rig file."""
    plain = shipped("slide_servo").as_toml()
    (own,) = plain["cylinder"]
    return Rig.model_validate(plain | {"cylinder": [own | cylinder]})


def cycle(cylinder: str, waypoints, speed: str, *, gains=None, move=None, **given) -> TrialRecipe:
    """A trial of adaptive robust control from stroke to stroke; ``move`` are more keys of its
    motion, ``given`` other ones of its recipe."""
    motion = {"kind": "point_to_point", "cylinder": cylinder, "waypoints": waypoints}
    motion |= {"speed": speed} | (move or {})
    about = {"stage": "trial", "rig": "x.toml", "motion": motion, "path": RECIPES / "trial.toml"}
    about |= {"controller": {"kind": "arc", "gains": gains or {}}}
    return TrialRecipe.model_validate(about | given)


def refused(key: str, kind: type[EhbenchError] = EhbenchError):
    """An error of the catalogue's key is expected."""
    return pytest.raises(kind, check=lambda error: error.key == key)


def measured(
    record: Record,
    seed: int,
    noise: Mapping[str, float],
    drop: Collection[str] = (),
    pole: float = 0.0,
    before: int = 0,
) -> Record:
    """What sensors would say of a simulation: no flows or openings, nothing of ``drop``, and noise
    of a size by word, white or of first order with ``pole``, begun so many samples ``before``."""
    from scipy.signal import lfilter

    rng, channels = np.random.default_rng(seed), {}
    for name, values in record.channels.items():
        word = name.rsplit(".", 1)[-1]
        if word not in ("flow", "opening", "flow_supply", *drop):
            white = rng.standard_normal(values.size + before)
            coloured = np.asarray(lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], white))
            channels[name] = values + noise.get(word, 0.0) * coloured[before:]
    return Record(record.t, channels, record.meta)


def identify(rig: Rig, logs, parameters, flow_maps=None, where=None, **options):
    """A fit of hydraulics with these options."""
    from ehbench.identification.hydraulics import FitOptions, identify_hydraulics

    places = {} if where is None else {"where": where}
    return identify_hydraulics(rig, logs, parameters, FitOptions(**options), flow_maps, **places)


def started_off(rig: Rig, logs, factors: Mapping[str, float], **options):
    """(fit of a rig's parameters that start so many times off, what they are)."""
    truth = {name: float(rig.parameters()[name]) for name in factors}
    start = {name: factor * truth[name] for name, factor in factors.items()}
    return identify(rig, logs, list(factors), start=start, **options), truth


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of each file of a run or more, but for those that differ from run to run."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "volatile.json"
    }


def result(name: str, file: str) -> dict[str, Any]:
    """A file of the one run of a recipe in ``reports``."""
    (path,) = Path("reports").glob(f"{name}_*/{file}.json")
    return json.loads(path.read_text())


def judged(rig: Rig, logs, channels=(), thresholds=None, fitted_on=()) -> Validation:
    """The verdict on logs by their checks alone: to diagnose what is left takes most of one."""
    from ehbench.validation import prepare_validation, run_validation
    from ehbench.validation.judge import CHANNELS

    prepared = prepare_validation(rig, logs, channels or CHANNELS, fitted_on=fitted_on)
    return run_validation(prepared, thresholds, diagnose=False)
