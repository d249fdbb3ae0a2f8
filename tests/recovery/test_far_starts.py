"""Every number of every part is on trial in `tools.studies.recovery_study`, of which a handful
stands here:
what comes back from far off, what is told as a range, and what the logs leave open.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
import tomli_w
from pydantic import BaseModel

from ehbench.app import inspection
from ehbench.config.rig import Rig
from ehbench.data.logs import write_log
from ehbench.identification import simulator
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.plant.model import Model
from ehbench.vocabulary.errors import InsufficientData
from ehbench.vocabulary.fields import Q, Value, Vector
from tests.shared import RIGS
from tools.studies.recovery_study import BEDS, Trial, bed, logs_of, offered, tried
from tools.virtual_logs import noisy

# numbers of a rig file that no fit offers, and why
NEVER = {
    "command_min": "the driver's, beyond which commands are refused",
    "command_max": "as command_min",
    "flow": "of a rated point, which is turned into the gain of its edge",
    "command": "as flow",
    "drop": "as flow",
    "overlap": "of a whole spool: what the dead bands of its edges say, see test_strangers",
    "null": "as overlap",
    "number": "of an FMU, whose equations are not here",
}


def parts_of(kind: Any) -> Iterator[Any]:
    """An annotation, and all that it is made of."""
    yield kind
    for one in get_args(kind):
        yield from parts_of(one)


def numbers(table: type[BaseModel], seen: set[type[BaseModel]]) -> Iterator[tuple[str, str]]:
    """(table, key) of every number that a table of a rig file can have, and those in it."""
    if table in seen:
        return
    seen.add(table)
    for key, field in table.model_fields.items():
        kinds = [*parts_of(field.annotation), *field.metadata]
        if Value in kinds:
            yield table.__name__, key
        if Vector in kinds:
            (row,) = (kind for kind in kinds if isinstance(kind, Q))
            yield from ((table.__name__, f"{key}_{axis}") for axis in row.axes.split())
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from numbers(kind, seen)


def given(part: Any) -> Iterator[tuple[str, str]]:
    """(table, key) of every number that a rig has."""
    if isinstance(part, BaseModel):
        for key in type(part).model_fields:
            value = getattr(part, key)
            if isinstance(value, Value):
                yield type(part).__name__, key
            if isinstance(value, Vector):
                yield from ((type(part).__name__, f"{key}_{axis}") for axis in value.axes)
            yield from given(value)
    elif isinstance(part, (tuple, dict)):
        for one in part.values() if isinstance(part, dict) else part:
            yield from given(one)


def test_every_number_of_every_part_and_rig_is_on_trial():
    beds = [bed(name) for name in BEDS]
    on_trial = {pair for one in beds for pair in given(one.rig)}
    every = set(numbers(Rig, set()))
    # what a payload changes of a link are the link's own numbers
    missing = {key for table, key in every - on_trial if table not in ("LinkLoad", "Rated")}
    assert len(every) > 90 and missing <= set(NEVER)
    words = {name.rpartition(".")[2] for name in BEDS for name in offered(name)}
    assert {key for _, key in every} - words == set(NEVER)
    for path in sorted(RIGS.glob("*.toml")):
        assert offered(path.stem) == list(bed(path.stem).rig.parameters())


# from as far off as the study goes: what only its range tells, what lies just where the logs begin
# to feel it, what has no sign, what no rig can have where the search starts
FAR = [
    ("slide_servo", Trial("supply.flow_limit", 4.1e-4, 8.2e-4), "back"),
    ("slide_servo", Trial("supply.flow_limit", 4.1e-4, 2.05e-4), "back"),
    ("slide_servo", Trial("supply.pressure", 1.4e7, 7e6), "back"),
    ("slide_servo", Trial("gravity", 9.80665, 4.9), "untold"),
    ("crane_proportional", Trial("arm.dh_a", 3.5, 7.0), "back"),
    ("crane_proportional", Trial("lift.phase", math.radians(80.0), math.radians(160.0)), "back"),
    ("crane_proportional", Trial("lift.stroke", 0.6, 0.3), "wide"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "trial", "kind"), FAR)
def test_from_far_off(name, trial, kind):
    found = tried(name, trial)
    assert found.kind in (kind, "beside" if kind == "back" else kind), found


def test_a_pressure_that_each_log_has_is_not_asked_of_it():
    one = bed("slide_servo")
    logs = [(f"log {i}", noisy(log, i)) for i, log in enumerate(logs_of("slide_servo")[:1])]
    with pytest.raises(InsufficientData, match="goes by its own p_supply") as refused:
        identify_hydraulics(one.rig, logs, ["supply.pressure"], FitOptions(workers=1))
    assert "read it there" in str(refused.value)


def test_sensitivities_of_a_wide_line_are_those_of_the_line():
    """Oil of line and chamber swaps fast: steps of one alone let rounding grow."""
    name, one = "press.line_rod.orifice_gain", bed("slide, lines")
    truth = float(one.rig.parameters()[name])
    log = one.logs(one.rig)[0].at(slice(700))
    models = [Model.of(one.rig.with_values({name: truth * (1.0 + d)})) for d in (0.0, 1e-9, 1e-4)]
    base, near, far = (m.replay(log, "auto") for m in models)
    for channel in ("press.v", "press.p_head", "press.p_rod"):
        slopes = [
            np.sqrt(np.mean((y[channel] - base[channel]) ** 2)) / d
            for y, d in ((near, 1e-9), (far, 1e-4))
        ]
        assert slopes[0] < 10.0 * slopes[1], channel


def test_starts_that_are_estimated_cost_less_than_as_much_again(monkeypatch):
    """Simulations of a fit, with and without what is not known of where the logs start."""
    one = bed("slide_servo")
    logs = [(f"log {i}", noisy(log, i)) for i, log in enumerate(logs_of("slide_servo"))]
    asked = ["bulk_modulus", "carriage.damping", "press.leakage_internal"]
    start = {"bulk_modulus": 5e8, "carriage.damping": 1500.0}
    options = FitOptions(start=start, upper={"press.leakage_internal": 1e-11}, workers=1)
    counts = [identify_hydraulics(one.rig, logs, asked, options).evaluations]
    begun = simulator.initial_state_of
    monkeypatch.setattr(
        simulator, "initial_state_of", lambda *of: replace(begun(*of), uncertain=())
    )
    counts.append(identify_hydraulics(one.rig, logs, asked, options).evaluations)
    assert counts[1] < counts[0] < 2 * counts[1], counts


@pytest.mark.parametrize("stage", ["identify", "validate"])
def test_a_check_says_where_stroke_angle_and_pins_disagree(stage, tmp_path):
    log = noisy(logs_of("crane_proportional")[0], 3)
    away = replace(log, channels=log.channels | {"lift.x": log["lift.x"] + 0.0118})
    recipe: dict[str, Any] = {"stage": stage, "rig": str(RIGS / "crane_proportional.toml")}
    fits = {"what": "hydraulics", "parameters": ["bulk_modulus"]}
    recipe |= {"data": ["log.mcap"]} | (fits if stage == "identify" else {})
    (tmp_path / "recipe.toml").write_text(tomli_w.dumps(recipe))
    told = []
    for record in (log, away):
        write_log(tmp_path / "log.mcap", record)
        lines = inspection.check(tmp_path / "recipe.toml").lines
        told.append([line for line in lines if "the pins give" in line])
    assert told[0] == []
    (line,) = told[1]
    assert line.strip().startswith("note: log: lift.x is 11.8 mm above what lift.q and the pins")
