"""Whether a log was recorded otherwise than it is said to be: with another payload of the rig, or
with two of its channels exchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from ehbench.diagnosis.cases import DOMINANT, QUIET, Case, counts, total
from ehbench.plant.foreign import model_of
from ehbench.preprocessing.observations import payload_of
from ehbench.vocabulary.errors import EhbenchError
from ehbench.vocabulary.messages import Message, message

NONE = "none"
Otherwise = tuple[Case, str, dict[str, str]]  # a log recorded otherwise, its message and fields
ASTRAY = 0.5  # rms residual, share of the spread, from which channels may be exchanged


def misread(case: Case) -> Iterator[Message]:
    """A note on a log that is followed much better if it was recorded otherwise, with what to
    write.
    """
    if case.model.rig.model is not None or not case.channels:
        return
    case = replace(case, refined=False)
    left = case.left(case.simulated())
    now, noise = total([left]), case.noise_squares
    if now < QUIET * left.size:
        return
    spread = sum(y.size * (np.std(y) / case.scales[name]) ** 2 for name, y in case.recorded.items())
    astray = now > ASTRAY**2 * spread
    best, gain = None, DOMINANT * (now - noise)
    for other, key, fields in (*_carrying(case), *(_exchanged(case) if astray else ())):
        try:
            less = now - total([other.left(other.simulated())])
        except EhbenchError:  # nothing moves so
            continue
        best, gain = ((key, fields), less) if less > gain else (best, gain)
    if best is None or not counts(gain, now, noise, case.independent(left)):
        return
    key, fields = best
    share, log = min(1.0, gain / (now - noise)), case.name
    cause = message(f"diagnosis.{key}", log=log, share=share, **fields)
    remedy = message(f"diagnosis.write_{key}", log=log, **fields)
    yield message("diagnosis.misread", cause=cause, remedy=remedy, share=share)


def _carrying(case: Case) -> Iterator[Otherwise]:
    """A log with each other payload of the rig."""
    rig, said = case.model.bare, payload_of(case.record) or NONE
    for load in (NONE, *rig.payload):
        if load != said:
            model = model_of(rig, case.maps, None if load == NONE else load)
            yield replace(case, model=model), "carried", {"load": load, "said": said}


def _exchanged(case: Case) -> Iterator[Otherwise]:
    """A log with two channels of a cylinder exchanged: its pressures, or the commands of two
    valves.
    """
    record, rig = case.record, case.model.rig
    for name in case.cylinders:
        commands = [f"{name}.{valve.name}.command" for valve in rig.cylinder_named(name).valve]
        for first, second in ((f"{name}.p_head", f"{name}.p_rod"), *combinations(commands, 2)):
            if first in record and second in record:
                given = {first: record[second], second: record[first]}
                other = replace(case, record=replace(record, channels=record.channels | given))
                yield other, "exchanged", {"first": first, "second": second}
