"""Many rigs, each simulated by itself, side by side on the cores: kernels hold no lock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count

import numpy as np

from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model
from ehbench.plant.paced import Step

AHEAD = 4  # simulations a core that may wait to be taken


def run_many(
    jobs: Iterable[tuple[Model, np.ndarray, np.ndarray]],
    tick: float = 1e-3,
    step: Step = STEP,
    workers: int | None = None,
) -> Iterator[np.ndarray]:
    """The log tables of `Model.run`, in the order of the jobs and the same to the bit on any number
    of workers; no more of them are held than AHEAD a worker.

    Example:
        jobs = ((model, model.trim(model.posture(None)), table) for model in models)
        tops = [log[:, 0].max() for log in run_many(jobs, step="auto")]

    Args:
        jobs: (model, state at the first sample, commands [V] of shape (samples, valves + played)),
            taken as they are needed.
        tick: time between samples [s].
        step: of the integration [s], or ``"auto"``.
        workers: threads; by default one a core.

    Raises:
        SimulationError: a state stopped being finite.
    """
    workers = workers or cpu_count() or 1
    waiting = deque()
    with ThreadPoolExecutor(workers) as pool:
        for model, start, commands in jobs:
            waiting.append(pool.submit(model.run, start, commands, tick, step))
            if len(waiting) >= AHEAD * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
