"""Runs of many models, put into lanes where they may go side by side: to the bits of `Model.run`
and of `Model.paced`, so that nobody can tell which were.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ehbench.errors import EhbenchError
from ehbench.plant.lanes.pack import alike, filled, in_lanes, line_in_lanes, side_by_side
from ehbench.plant.lanes.steps import Held, run_lanes, run_meshed
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.model import Model, Start, finite
from ehbench.plant.paced import pace_of
from ehbench.record import Means, Record

LEAST = 3  # runs that are worth a call in lanes, which takes as long as some two and a half alone


class Job(NamedTuple):
    """A run to make: a model, its state at the first sample, commands as `Model.run` takes them."""

    model: Model
    start: np.ndarray
    commands: np.ndarray


def has_lanes(kernel: object) -> bool:
    """Whether a kernel in lanes is there: it takes half a minute to compile, so that is done
    beforehand (`ehbench.warm`) or not at all.
    """
    return getattr(kernel, "is_kept", False)


def go_together(first: Job, other: Job) -> bool:
    """Whether two runs may go side by side in fixed steps."""
    same = first.commands.shape == other.commands.shape
    return same and alike(first.model.plant, other.model.plant)


def run_together(jobs: Sequence[Job], tick: float, steps: int) -> list[np.ndarray]:
    """The log tables of `Model.run` in fixed steps, so many a ``tick`` [s], of at most LANES runs
    that `go_together`; they are not looked at whether they are finite.
    """
    plant, y, commands, line = _packed(jobs, tick)
    columns = y.shape[0] + plant.edges.shape[0] + 1
    log = np.empty((LANES, commands.shape[0], columns))
    run_lanes(y, commands, plant, line, steps, log)
    return list(log[: len(jobs)])


def _packed(jobs: Sequence[Job], tick: float):
    """(plant, states, commands, lines of past commands), all in lanes."""
    full = filled(jobs)
    plants = [job.model.plant for job in full]
    commands = side_by_side([np.asarray(job.commands, float) for job in full])
    line = line_in_lanes(plants, tick, commands.shape[1])
    return in_lanes(plants), side_by_side([job.start for job in full]), commands, line


def _changes(commands: np.ndarray) -> np.ndarray:
    return np.any(np.diff(commands, axis=0) != 0.0, axis=1)


def _follow_together(first: Job, other: Job) -> bool:
    """Whether two runs may go side by side along one mesh: their commands change together."""
    if not go_together(first, other):
        return False
    if first.commands is other.commands or np.array_equal(first.commands, other.commands):
        return True
    return np.array_equal(_changes(first.commands), _changes(other.commands))


def follow_together(
    jobs: Sequence[Job], tick: float, mesh: np.ndarray, each: int = 1
) -> list[np.ndarray]:
    """The log tables of `Model.paced` along a mesh, without flows, means of ``each`` samples, which
    are not looked at whether they are finite.
    """
    first = jobs[0]
    count, changes = len(first.commands), np.flatnonzero(_changes(first.commands)) + 1
    begins = np.array([0, *changes, count], dtype=np.int64)
    changing = [job._replace(commands=job.commands[begins[:-1]]) for job in jobs]
    plant, y, commands, line = _packed(changing, tick)
    log = np.zeros((LANES, count // each, y.shape[0]))
    pace = pace_of(first.model.plant, first.model.layout, tick)
    run_meshed(y, Held(commands, begins), plant, line, pace, mesh, each, log)
    return list(log[: len(jobs)])


Run = tuple[Model, Record, Start]


def replays_meshed(
    runs: Sequence[Run], mesh: np.ndarray, means: Means | None = None
) -> list[Record | None]:
    """`Model.replay_paced` of several runs along one mesh; None for those that fail.

    Args:
        runs: (model, recording, start); at most LANES, of one sample time.
        means: of the recording, as which replays are wanted.
    """
    each = 1 if means is None else means.each

    def alone(run: Run) -> Record:
        model, record, start = run
        return model.replay_paced(record, start, mesh, means=means)[0]

    def together(jobs: Sequence[Job], tick: float) -> list[np.ndarray]:
        return follow_together(jobs, tick, mesh, each)

    return _replays(runs, _follow_together, together, alone, means)


def replays_fixed(runs: Sequence[Run], step: float) -> list[Record | None]:
    """`Model.replay` of several runs in fixed steps [s]; None for those that fail.

    Args:
        runs: (model, recording, start); at most LANES, of one sample time.
    """

    def alone(run: Run) -> Record:
        model, record, start = run
        return model.replay(record, step, start=start)

    def together(jobs: Sequence[Job], tick: float) -> list[np.ndarray]:
        return run_together(jobs, tick, max(1, round(tick / step)))

    if len(runs) < LEAST or not has_lanes(run_lanes):
        return [_tried(alone, run) for run in runs]
    return _replays(runs, go_together, together, alone)


def _replays(
    runs: Sequence[Run],
    may: Callable[[Job, Job], bool],
    run_all: Callable[[Sequence[Job], float], list[np.ndarray]],
    alone: Callable[[Run], Record],
    means: Means | None = None,
) -> list[Record | None]:
    """Replays of which those that may go beside the first are run at once, where they are enough,
    and the others alone.
    """
    ready: dict[int, Job] = {}
    for i, (model, record, start) in enumerate(runs):
        try:
            own, table, y = model.along(record, start)
            ready[i] = Job(own, y, table)
        except (EhbenchError, ArithmeticError):
            continue
    found: list[Record | None] = [None] * len(runs)
    together = [i for i in ready if may(ready[min(ready)], ready[i])]
    if len(together) >= LEAST:
        tick = runs[together[0]][1].sample_time
        logs = run_all([ready[i] for i in together], tick)
        for i, log in zip(together, logs, strict=True):
            found[i] = _record(runs[i], ready[i], log, tick, means)
    for i in ready.keys() - set(together if len(together) >= LEAST else ()):
        found[i] = _tried(alone, runs[i])
    return found


def _record(run: Run, job: Job, log: np.ndarray, tick: float, means: Means | None) -> Record | None:
    model, record, start = run
    try:
        log = finite(log, tick)
    except EhbenchError:
        return None
    return model.replayed(record, job.commands, log, start, means)


def _tried(alone: Callable[[Run], Record], run: Run) -> Record | None:
    try:
        return alone(run)
    except (EhbenchError, ArithmeticError):
        return None
