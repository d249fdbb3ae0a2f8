"""Many rigs, each simulated by itself, side by side on the cores, for kernels hold no lock, and in
the lanes of each (`ehbench.plant.lanes`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import starmap

import numpy as np

from ehbench.plant.integrate import STEP
from ehbench.plant.lanes.many import LEAST, Job, go_together, has_lanes, run_together
from ehbench.plant.lanes.steps import run_lanes
from ehbench.plant.lanes.vectors import LANES
from ehbench.plant.model import Model, finite
from ehbench.plant.paced import AUTO, Step
from ehbench.runtime.cores import cores

AHEAD = 4  # simulations a core that may wait to be taken; in lanes, sets of them for two cores


def run_many(
    jobs: Iterable[tuple[Model, np.ndarray, np.ndarray]],
    tick: float = 1e-3,
    step: Step = STEP,
    workers: int | None = None,
    lanes: bool = True,
) -> Iterator[np.ndarray]:
    """The log tables of `Model.run`, in the order of the jobs and the same to the bit on any number
    of workers, in lanes or not; no more of them are held than AHEAD a worker, or that many sets of
    lanes for every two.

    Example:
        jobs = ((model, model.trim(model.posture(None)), table) for model in models)
        tops = [log[:, 0].max() for log in run_many(jobs)]

    Args:
        jobs: (model, state at the first sample, commands [V] of shape (samples, valves + played)),
            taken as they are needed.
        tick: time between samples [s].
        step: of the integration [s], or ``"auto"``.
        workers: threads; by default one a core.
        lanes: let neighbours of one layout go side by side, in fixed steps, where the kernel for it
            is compiled (`ehbench.app.warm`).

    Raises:
        SimulationError: a state stopped being finite.
    """
    workers = workers or cores()
    together = lanes and step != AUTO and has_lanes(run_lanes)
    fixed = max(2, AHEAD * workers // 2) if together else AHEAD * workers
    waiting: deque[Future[list[np.ndarray]]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        for some in _sets(starmap(Job, jobs), LANES if together else 1):
            waiting.append(pool.submit(_runs, some, tick, step))
            if len(waiting) >= fixed:
                yield from (finite(log, tick) for log in waiting.popleft().result())
        while waiting:
            yield from (finite(log, tick) for log in waiting.popleft().result())


def _sets(jobs: Iterable[Job], maximum: int) -> Iterator[list[Job]]:
    """Jobs in sets that may go side by side, each of its neighbours."""
    some: list[Job] = []
    for job in jobs:
        if some and (len(some) == maximum or not go_together(some[0], job)):
            yield some
            some = []
        some.append(job)
    if some:
        yield some


def _runs(jobs: Sequence[Job], tick: float, step: Step) -> list[np.ndarray]:
    if step == AUTO or len(jobs) < LEAST:
        return [job.model.run(job.start, job.commands, tick, step) for job in jobs]
    return run_together(jobs, tick, max(1, round(tick / step)))
