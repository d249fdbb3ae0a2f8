"""Runs of many models, put into lanes where they may go side by side: to the bits of `Model.run`
and of `Model.paced`, so that nobody can tell which were.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from ehbench.data.record import Means, Record
from ehbench.parts.valve.delay import Line
from ehbench.plant.lanes.paced import Track, run_apart
from ehbench.plant.lanes.pack import filled, in_lanes, layout_of, line_in_lanes, side_by_side
from ehbench.plant.lanes.steps import run_lanes
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.model import FREE, Model, Start, finite
from ehbench.plant.paced import pace_of
from ehbench.vocabulary.errors import EhbenchError

LEAST = 3  # runs that are worth a call in lanes, which takes as long as some two and a half alone

Asked = TypeVar("Asked")
Made = TypeVar("Made")


class Job(NamedTuple):
    """A run to make: a model, its state at the first sample, commands as `Model.run` takes them;
    where steps are chosen, a ``mesh`` of them to take again, or the ``slack`` that they have, as
    `Model.paced` takes it.
    """

    model: Model
    start: np.ndarray
    commands: np.ndarray
    mesh: np.ndarray = FREE
    slack: float = 1.0


def has_lanes(kernel: object) -> bool:
    """Whether a kernel in lanes is there: it takes half a minute to compile, so that is done
    beforehand (`ehbench.app.warm`) or not at all.
    """
    return getattr(kernel, "is_kept", False)


def tempo(job: Job) -> Hashable:
    """What runs in steps that each chooses, or of its own mesh, must share to go side by side."""
    return job.commands.shape[1], layout_of(job.model.plant)


def beat(job: Job) -> Hashable:
    """What runs in fixed steps must share to go side by side."""
    return job.commands.shape, layout_of(job.model.plant)


def go_together(first: Job, other: Job) -> bool:
    """Whether two runs may go side by side in fixed steps."""
    return beat(first) == beat(other)


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
    plants = [job.model.plant for job in jobs]
    commands = side_by_side([np.asarray(job.commands, float) for job in jobs])
    line = line_in_lanes(plants, tick, commands.shape[1])
    return in_lanes(plants), side_by_side([job.start for job in jobs]), commands, line


def _begins(commands: np.ndarray, late: bool) -> np.ndarray:
    """The samples from which commands act, each until another comes, one a sample where they are
    late; then the number of samples.
    """
    count = len(commands)
    if late:
        return np.arange(count + 1)
    changes = np.any(np.diff(commands, axis=0) != 0.0, axis=1)
    return np.array([0, *np.flatnonzero(changes) + 1, count])


def _track(jobs: Sequence[Job]) -> Track:
    """What runs follow."""
    valves = jobs[0].model.plant.valves
    late, known = bool(valves["delay"].any()), {}
    tables = [job.commands.tobytes() for job in jobs]
    for job, table in zip(jobs, tables, strict=True):  # several may be of one log
        if table not in known:
            begins = _begins(job.commands, late)
            known[table] = job.commands[begins[:-1]], begins
    rows, begins = zip(*(known[table] for table in tables), strict=True)
    some = [job.model.plant.valves[: valves.size if late else 0] for job in jobs]
    return Track(
        _padded(rows),
        _padded(begins),
        _padded([job.mesh for job in jobs]),
        np.array(filled([job.mesh.size for job in jobs])),
        side_by_side([item["delay"] for item in some]),
        side_by_side([item["before"] for item in some]),
    )


def _padded(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of one shape but for their length, with a last axis of lanes; the last row of shorter
    ones again.
    """
    longest = max(1, *(len(array) for array in arrays))
    built = np.zeros((longest, *arrays[0].shape[1:], LANES), arrays[0].dtype)
    for lane, item in enumerate(filled(arrays)):
        built[: len(item), ..., lane] = item
        if len(item):
            built[len(item) :, ..., lane] = item[-1]
    return built


def pace_together(
    jobs: Sequence[Job], tick: float, each: int = 1
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(the log table of `Model.paced`, the steps that were taken) of at most LANES runs whose
    `tempo` is the same, without flows, means of ``each`` samples; they are not looked at whether
    they are finite.
    """
    track, plants = _track(jobs), [job.model.plant for job in jobs]
    y = side_by_side([job.start for job in jobs])
    line = Line(
        float(tick),
        np.zeros((1, 0, LANES)),
        np.zeros(1, np.int64),
        np.zeros((track.commands.shape[1], LANES)),
    )
    log = np.zeros((LANES, max(len(job.commands) for job in jobs) // each, y.shape[0]))
    paces = [pace_of(job.model.plant, job.model.layout, tick) for job in jobs]
    weights = [1.0 / job.slack * pace.weights for job, pace in zip(jobs, paces, strict=True)]
    pace = paces[0]._replace(weights=side_by_side(weights))
    steps, count = run_apart(y, track, in_lanes(plants), line, pace, each, log)
    return [
        (log[lane, : len(job.commands) // each], steps[lane, : count[lane]].copy())
        for lane, job in enumerate(jobs)
    ]


class Run(NamedTuple):
    """A replay of a recording from a start. Where steps are chosen, a ``mesh`` of them to take
    again, or the ``slack`` that they have; of ``means`` of the recording such means of the replay.
    """

    model: Model
    record: Record
    start: Start
    mesh: np.ndarray = FREE
    slack: float = 1.0
    means: Means | None = None

    @property
    def each(self) -> int:
        """Samples of which a row of the replay is the mean."""
        return 1 if self.means is None else self.means.each

    def job(self) -> Job:
        """It as a run of its model."""
        model, table, start = self.model.along(self.record, self.start)
        return Job(model, start, table, self.mesh, self.slack)


Logs = list[tuple[np.ndarray, np.ndarray]]
Replayed = tuple[Record, np.ndarray]


def replays_paced(runs: Sequence[Run]) -> list[Replayed | None]:
    """`Model.replay_paced` of several runs; None for those that fail.

    Args:
        runs: at most LANES, of one sample time and of means of as many samples.
    """

    def alone(run: Run) -> Replayed:
        return run.model.replay_paced(run.record, run.start, run.mesh, run.slack, run.means)

    def together(jobs: Sequence[Job], tick: float) -> Logs:
        return pace_together(jobs, tick, runs[0].each)

    return _replays(runs, run_apart, tempo, together, alone)


def replays_fixed(runs: Sequence[Run], step: float) -> list[Record | None]:
    """`Model.replay` of several runs in fixed steps [s]; None for those that fail.

    Args:
        runs: at most LANES, of one sample time.
    """

    def alone(run: Run) -> Replayed:
        return run.model.replay(run.record, step, start=run.start), FREE

    def together(jobs: Sequence[Job], tick: float) -> Logs:
        return [(log, FREE) for log in run_together(jobs, tick, max(1, round(tick / step)))]

    result = _replays(runs, run_lanes, beat, together, alone)
    return [None if item is None else item[0] for item in result]


def _replays(
    runs: Sequence[Run],
    kernel: object,
    shared: Callable[[Job], Hashable],
    run_all: Callable[[Sequence[Job], float], Logs],
    alone: Callable[[Run], Replayed],
) -> list[Replayed | None]:
    """(replays, steps taken) of which those that have what must be ``shared`` as the first has it
    are run at once, where they are enough and there is a kernel for it, and the others alone.
    """
    if len(runs) < LEAST or not has_lanes(kernel):
        return [_tried(alone, run) for run in runs]
    jobs = [_tried(Run.job, run) for run in runs]
    ready = {i: job for i, job in enumerate(jobs) if job is not None}
    result: list[Replayed | None] = [None] * len(runs)
    kinds = {i: shared(job) for i, job in ready.items()}
    together = [i for i, kind in kinds.items() if kind == kinds[min(kinds)]]
    together = together if len(together) >= LEAST else []
    if together:
        tick = runs[together[0]].record.sample_time
        built = run_all([ready[i] for i in together], tick)
        for i, (log, steps) in zip(together, built, strict=True):
            result[i] = _tried(_replayed, (runs[i], ready[i], log, steps, tick))
    for i in ready.keys() - set(together):
        result[i] = _tried(alone, runs[i])
    return result


def _replayed(built: tuple[Run, Job, np.ndarray, np.ndarray, float]) -> Replayed:
    run, job, log, steps, tick = built
    log = finite(log, run.each * tick)
    return run.model.replayed(run.record, job.commands, log, run.start, run.means), steps


def _tried(do: Callable[[Asked], Made], requested: Asked) -> Made | None:
    try:
        return do(requested)
    except (EhbenchError, ArithmeticError):
        return None
