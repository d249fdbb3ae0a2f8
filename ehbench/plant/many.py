"""Several simulations at once, on threads: kernels release Python's lock."""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import NamedTuple, TypeVar

from ehbench.data.record import Record
from ehbench.plant.integrate import STEP
from ehbench.plant.model import Model, Start
from ehbench.plant.paced import Step
from ehbench.runtime.cores import cores
from ehbench.vocabulary import EhbenchError

Task = TypeVar("Task")
Result = TypeVar("Result")


class Replay(NamedTuple):
    """A recording that a model follows from a start."""

    model: Model
    record: Record
    start: Start


def replay_many(replays: Sequence[Replay], step: Step = STEP) -> list[Record | None]:
    """`Model.replay` of each, in such steps; None for those that cannot be simulated."""

    def record_of(replay: Replay) -> Record | None:
        try:
            return replay.model.replay(replay.record, step, start=replay.start)
        except (EhbenchError, ArithmeticError):
            return None

    return map_threads(record_of, replays)


def map_threads(
    function: Callable[[Task], Result], tasks: Sequence[Task], workers: int | None = None
) -> list[Result]:
    """The results of a function for all tasks, in their order, by this thread and others."""
    results: dict[int, Result] = {}
    indices = iter(range(len(tasks)))

    def work() -> None:
        try:
            for i in indices:
                results[i] = function(tasks[i])
        except BaseException:
            deque(indices, maxlen=0)  # no task begins after an error
            raise

    others = min(workers or cores(), len(tasks)) - 1
    futures = [_threads().submit(work) for _ in range(others)]
    try:
        work()
    finally:  # those that found no free thread have nothing left to do
        wait([future for future in futures if not future.cancel()])
    for future in futures:
        if not future.cancelled():
            future.result()
    return [results[i] for i in range(len(tasks))]


@cache
def _threads() -> ThreadPoolExecutor:
    """Threads that stay: a fit calls for them thousands of times, and to start one takes as long as
    a short simulation."""
    return ThreadPoolExecutor(cores())
