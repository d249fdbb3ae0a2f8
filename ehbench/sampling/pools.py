"""Where samples are made: threads or processes here, or a Dask cluster
(`ehbench.sampling.cluster`). No sample depends on where or in which order it is made."""

import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import LifoQueue, SimpleQueue
from typing import Any

from ehbench.runtime.blas import one_thread
from ehbench.sampling.sample import Make, Open, Sample, Task
from ehbench.vocabulary import message, setting


@dataclass(frozen=True)
class PoolSettings:
    """How long a pool waits for a sample."""

    grace: float = setting(2.0, "s", "time beyond a sample's limit", "a busy machine")
    first_grace: float = setting(120.0, "s", "the same of the first sample", "all kernels compile")
    attempts: int = setting(2, "", "processes that a sample may end", "one may die by chance")


POOLS = PoolSettings()


def in_threads(
    make: Make, tasks: Iterable[Task], workers: int, stop: Callable[[], None] = lambda: None
) -> Iterator[list[Sample]]:
    """Samples by threads of this process, as they come: for those whose time goes into compiled
    loops, which release the interpreter's lock. ``stop`` ends those under way when nobody wants
    more."""
    done: SimpleQueue[Future[Sample]] = SimpleQueue()
    tasks, waiting = iter(tasks), 0
    with ThreadPoolExecutor(workers) as pool:
        try:
            while True:
                for task in islice(tasks, 2 * workers - waiting):
                    pool.submit(make, *task).add_done_callback(done.put)
                    waiting += 1
                if not waiting:
                    return
                jobs = [done.get(), *(done.get() for _ in range(done.qsize()))]
                waiting -= len(jobs)
                yield [job.result() for job in jobs]
        finally:
            stop()
            pool.shutdown(cancel_futures=True)


class _Worker:
    """A process that makes one sample after the other."""

    def __init__(self, opener: bytes) -> None:
        self.pipe, other = Pipe()
        code = f"from ehbench.sampling.pools import serve; serve({other.fileno()})"
        self.process = subprocess.Popen([sys.executable, "-c", code], pass_fds=[other.fileno()])
        other.close()
        self.pipe.send_bytes(opener)
        self._grace = POOLS.first_grace

    def make(self, task: Task, limit: float | None) -> Sample | None:
        """The sample of a task; None where it takes longer than ``limit`` [s].

        Raises:
            OSError, EOFError: the process died."""
        self.pipe.send(task)
        if not self.pipe.poll(None if limit is None else limit + self._grace):
            return None
        self._grace = POOLS.grace
        return self.pipe.recv()

    def end(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.wait()


class Processes:
    """Processes of this machine, to which ``open`` goes pickled, for samples of so many
    ``measures``. One that dies, or works on a sample beyond ``limit`` [s], is replaced; a sample
    that ends several of them is given up."""

    def __init__(self, open: Open, workers: int, measures: int, limit: float | None = None) -> None:
        self._opener, self._count = pickle.dumps(open), workers
        self._measures, self._limit = measures, limit
        self._idle: LifoQueue[_Worker | None] = LifoQueue()
        self.workers: set[_Worker] = set()
        self._stopped = False

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """The samples of tasks, some at a time, in any order."""
        for _ in range(self._count):
            self._idle.put(None)
        return in_threads(self._make, tasks, self._count, self._stop)

    def _make(self, index: int, settings: Any) -> Sample:
        for _ in range(POOLS.attempts):
            if self._stopped:
                raise CancelledError
            worker = self._idle.get() or _Worker(self._opener)
            self.workers.add(worker)
            try:
                sample = worker.make((index, settings), self._limit)
            except (EOFError, OSError):
                self._replace(worker)
                continue
            if sample is not None:
                self._idle.put(worker)
                return sample
            self._replace(worker)
            text = message("sampling.ended", limit=self._limit)
            return Sample.lost(index, text, self._measures, late=True)
        text = message("sampling.died", attempts=POOLS.attempts)
        return Sample.lost(index, text, self._measures)

    def _replace(self, worker: _Worker) -> None:
        worker.end()
        self.workers.discard(worker)
        self._idle.put(None)

    def _stop(self) -> None:
        self._stopped = True
        for worker in list(self.workers):
            worker.end()
            self.workers.discard(worker)


@one_thread()
def serve(descriptor: int) -> None:
    """Make samples for another process until it closes the pipe; it handles the keyboard."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe = Connection(descriptor)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        make = pickle.loads(pipe.recv_bytes())()
        while True:
            pipe.send(make(*pipe.recv()))
