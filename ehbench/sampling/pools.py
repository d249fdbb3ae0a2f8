"""Where samples are made: in threads, in processes, or on a Dask cluster. Every pool takes numbered
tasks and gives samples as they come; which pool, how many workers and in which order is seen in no
sample.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import starmap
from multiprocessing import Pipe
from multiprocessing import connection as connections
from multiprocessing.connection import Connection
from typing import Protocol

from ehbench.sampling.sample import Open, Sample, Task

AIM = 0.3  # [s] that a chunk of tasks shall take
MOST = 5000  # tasks in a chunk
GRACE = 2.0  # [s] beyond its time limit after which a sample's process is ended
WARMING = 120.0  # [s] the same of the first sample, for which compiled code is loaded or made
DEATHS = 2  # of processes after which a sample is given up


class Pool(Protocol):
    """What makes samples."""

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """The samples of tasks, some at a time, in any order."""
        ...


class Chunks:
    """Tasks in chunks of about AIM, by what samples have taken so far."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._tasks = iter(tasks)
        self._again: list[list[Task]] = []
        self._seconds, self._count = 0.0, 0

    def take(self) -> list[Task]:
        """The next chunk; empty when there are no more tasks."""
        if self._again:
            return self._again.pop()
        size = 1
        if self._count:
            size = max(1, min(MOST, round(AIM * self._count / max(self._seconds, 1e-9))))
        chunk = []
        for task in self._tasks:
            chunk.append(task)
            if len(chunk) == size:
                break
        return chunk

    def give_back(self, tasks: list[Task], alone: bool = False) -> None:
        """Tasks that are to be made again, each in a chunk of its own if ``alone``."""
        self._again += [[task] for task in tasks] if alone else [tasks] if tasks else []

    def learn(self, samples: Iterable[Sample]) -> None:
        """Learn from what samples took."""
        for sample in samples:
            self._seconds += sample.seconds
            self._count += 1


class Threads:
    """Threads of this process: right where the time goes into compiled loops, which let go of the
    interpreter.
    """

    def __init__(self, open: Open, workers: int) -> None:
        self._open, self._workers = open, workers

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """As `Pool.run`."""
        make, chunks = self._open(), Chunks(tasks)
        if self._workers == 1:
            while chunk := chunks.take():
                built = [make(*task) for task in chunk]
                chunks.learn(built)
                yield built
            return
        with ThreadPoolExecutor(self._workers) as pool:
            waiting: set[Future] = set()
            try:
                while True:
                    while len(waiting) <= self._workers and (chunk := chunks.take()):
                        waiting.add(pool.submit(lambda c: [make(*task) for task in c], chunk))
                    if not waiting:
                        return
                    done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    for job in done:
                        chunks.learn(job.result())
                        yield job.result()
            finally:
                pool.shutdown(cancel_futures=True)


class _Worker:
    """A process that makes samples, and what it has been given."""

    def __init__(self, opener: bytes) -> None:
        self.pipe, other = Pipe()
        command = [sys.executable, "-m", "ehbench.sampling.worker", str(other.fileno())]
        self.process = subprocess.Popen(command, pass_fds=[other.fileno()])
        other.close()
        self.pipe.send_bytes(opener)
        self.tasks: list[Task] = []
        self.since = time.monotonic()
        self.grace = WARMING
        self._given = 0

    @property
    def hungry(self) -> bool:
        """Whether it is at the last chunk that it has: the next shall lie ready when it is done."""
        return len(self.tasks) <= self._given

    def give(self, tasks: list[Task]) -> None:
        """Let it make samples."""
        if not self.tasks:
            self.since = time.monotonic()
        self.tasks += tasks
        self._given = len(tasks)
        self.pipe.send(tasks)

    def end(self) -> None:
        """End the process at once."""
        self.pipe.close()
        self.process.kill()
        self.process.wait()


class Processes:
    """Processes of this machine. One that dies, or works on a sample beyond ``limit`` [s], is
    replaced; a sample that ends DEATHS of them is given up.

    Args:
        open: can be pickled.
        workers: processes.
        measures: of a sample.
        limit: None for none.
    """

    def __init__(self, open: Open, workers: int, measures: int, limit: float | None = None) -> None:
        self._opener, self._count = pickle.dumps(open), workers
        self._measures, self._limit = measures, limit
        self._deaths: dict[int, int] = {}
        self.workers: list[_Worker] = []

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """As `Pool.run`."""
        chunks = Chunks(tasks)
        try:
            while True:
                self._feed(chunks)
                busy = [worker for worker in self.workers if worker.tasks]
                if not busy:
                    return
                pause = None if self._limit is None else min(0.2, self._limit)
                ready = connections.wait([item.pipe for item in busy], pause)
                for item in busy:
                    built = self._heard(item) if item.pipe in ready else self._overdue(item)
                    if item.pipe.closed:
                        self.workers.remove(item)
                        chunks.give_back(item.tasks)
                    if built:
                        chunks.learn(built)
                        yield built
        finally:
            for worker in self.workers:
                worker.end()
            self.workers.clear()

    def _feed(self, chunks: Chunks) -> None:
        """Give work to those who soon have none, as many processes as there is work for."""
        hungry = sorted(
            (worker for worker in self.workers if worker.hungry), key=lambda o: len(o.tasks)
        )
        while hungry or len(self.workers) < self._count:
            chunk = chunks.take()
            if not chunk:
                return
            if len(self.workers) < self._count:
                self.workers.append(_Worker(self._opener))
                hungry.insert(0, self.workers[-1])
            hungry.pop(0).give(chunk)

    def _heard(self, item: _Worker) -> list[Sample]:
        """What a process has made; a dead one is cleared away, its pipe closed."""
        built = []
        try:
            while item.pipe.poll():
                built.append(item.pipe.recv())
        except (EOFError, OSError):
            return built + self._dead(item, len(built))
        item.tasks, item.since, item.grace = item.tasks[len(built) :], time.monotonic(), GRACE
        return built

    def _dead(self, item: _Worker, built: int = 0) -> list[Sample]:
        """A process that died on the first task it had left; the task is given up if it was not the
        first to die so.
        """
        item.tasks = item.tasks[built:]
        item.end()
        if not item.tasks:
            return []
        index = item.tasks[0][0]
        self._deaths[index] = self._deaths.get(index, 0) + 1
        if self._deaths[index] < DEATHS:
            return []
        item.tasks = item.tasks[1:]
        message = f"the process that made it died {DEATHS} times"
        return [Sample.lost(index, message, self._measures)]

    def _overdue(self, item: _Worker) -> list[Sample]:
        """A process that hangs is ended, and its sample late."""
        if self._limit is None or time.monotonic() - item.since < self._limit + item.grace:
            return []
        item.end()
        (index, _), *item.tasks = item.tasks
        message = f"it took longer than {self._limit:g} s and was ended"
        return [Sample.lost(index, message, self._measures, late=True)]


def serve(pipe: Connection) -> None:
    """What a process of `Processes` does: make samples, one after the other, until it is ended."""
    make = pickle.loads(pipe.recv_bytes())()
    while True:
        for item in starmap(make, pipe.recv()):
            pipe.send(item)
