"""Which state asks for very short steps where the steps are chosen by the guard."""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.plant.derivatives import derivatives
from ehbench.plant.integrate import STIFF
from ehbench.plant.model import Model, Start
from ehbench.plant.paced import pace_of
from ehbench.vocabulary import Message, message, setting


@dataclass(frozen=True)
class StiffnessSettings:
    """Numbers of the note on very short steps."""

    steps: float = setting(
        2.0e4, "1/s", "steps a second above which their cause is told", "shipped rigs take 4 100"
    )
    examined: int = setting(100, "", "steps that are examined for their cause", "a share to 10 %")


SETTINGS = StiffnessSettings()


class Stiffness(NamedTuple):
    """Steps a second [1/s] of a replay, the state that limits most of them, the share it limits."""

    steps: float
    state: str
    share: float


def stiffness_of(model: Model, record: Record, start: Start) -> Stiffness | None:
    """What limits the steps of a recording's replay; None where they are not very short.

    Of steps evenly out of all, the state with the largest error (`ehbench.plant.paced`) of a step
    twice as long, from the sample that is before it.

    Raises:
        LogError, SimulationError: as `Model.replay`."""
    model, commands, y = model.along(record, start)
    plant, tick = model.plant, record.sample_time
    log, steps = model.paced(y, commands, tick, flows=False)
    count = len(steps) / float(np.ptp(record.t))
    if count <= SETTINGS.steps:
        return None
    pace, work = pace_of(plant, model.layout, tick), np.empty(plant.at.work)
    samples, limited = (np.cumsum(steps) - steps) // pace.units, Counter[str]()

    def slope(state: np.ndarray, command: np.ndarray) -> np.ndarray:
        rates = np.empty_like(state)
        derivatives(state, command, plant, rates, work)
        return rates

    for i in np.linspace(0, len(steps) - 1, SETTINGS.examined).astype(int):
        y, command, d = log[samples[i]], commands[samples[i]], 2.0 * tick / pace.units * steps[i]
        first = slope(y, command)
        second = slope(y + 0.5 * d * first, command)
        third = slope(y + 0.5 * d * second, command)
        last = slope(y + d * third, command)
        end = slope(y + d / 6.0 * (first + 2.0 * (second + third) + last), command)
        errors = pace.weights * np.abs(last - end)
        limited[model.layout.state_names[int(np.nanargmax(errors))]] += 1
    state, times = limited.most_common(1)[0]
    return Stiffness(count, state, times / SETTINGS.examined)


def short_steps(
    model: Model, record: Record, start: Start, rate: float = math.inf
) -> Iterator[Message]:
    """Where a recording's replay asks for very short steps, which state limits them and what makes
    it fast; nothing of an FMU, which chooses its steps itself.

    Args:
        rate: of fixed steps the fastest rate [1/s] that they met, in the mean: where it does not
            make them short, nothing is asked.

    Raises:
        LogError, SimulationError: as `stiffness_of`."""
    if model.rig.model is not None or rate < STIFF * SETTINGS.steps:
        return
    stiff = stiffness_of(model, record, start)
    if stiff is not None:
        word = stiff.state.rpartition(".")[2]
        kind = "motion" if word in ("q", "qd") else "pressure"
        kind = kind if word.startswith(("q", "p_")) else "mount"
        cause = message(f"plant.stiff_{kind}")
        yield message("plant.short_steps", cause=cause, **stiff._asdict())
