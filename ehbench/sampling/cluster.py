"""Samples on a Dask cluster: chunks of tasks, the study's files once to each worker. Workers may
come, go and die."""

import os
import pickle
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any

from ehbench.runs.versions import METHODS
from ehbench.runtime.blas import one_thread
from ehbench.sampling.pools import POOLS
from ehbench.sampling.sample import Make, Sample, Task, Workers
from ehbench.vocabulary import InputError, message, setting

if TYPE_CHECKING:
    from distributed import Future


@dataclass(frozen=True)
class ClusterSettings:
    """How samples are handed to a cluster."""

    chunk: float = setting(0.3, "s", "work in one chunk of samples", "1.7 ms of overhead")
    under_way: int = setting(3, "", "chunks for each thread of the cluster", "no thread runs dry")


CLUSTER = ClusterSettings()


def _code() -> str:
    """The package's version, with those of all methods."""
    numbers = ".".join(map(str, METHODS.values()))
    return f"{metadata.version('ehbench')} (methods {numbers})"


@dataclass(frozen=True)
class Bundle:
    """What a study reads, for another machine: files by their path from the root, and what opens
    them."""

    files: dict[str, bytes]
    open: Any
    code: str = field(default_factory=_code)


class OtherCode(Exception):
    """A worker has another version of the package."""


_OPENING = threading.Lock()


@lru_cache(maxsize=4)
def _opened(data: bytes) -> Make:
    bundle: Bundle = pickle.loads(data)
    if bundle.code != _code():
        raise OtherCode(_code())
    root = Path(mkdtemp(prefix="ehbench_"))
    for name, content in bundle.files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return bundle.open(root)


@one_thread()
def make_chunk(data: bytes, chunk: list[Task]) -> list[Sample]:
    """What a worker of the cluster does, by the bytes of a bundle."""
    with _OPENING:
        make = _opened(data)
    return [make(*task) for task in chunk]


class Cluster:
    """The workers of a Dask scheduler for a study whose samples have so many ``measures``; one that
    hangs over a sample beyond the ``limit`` [s] is restarted.

    Raises:
        InputError: no such extra is installed, or no scheduler answers."""

    def __init__(
        self, workers: Workers, bundle: Bundle, measures: int, limit: float | None = None
    ) -> None:
        try:
            from distributed import Client, Security
            from distributed.comm.addressing import parse_address, parse_host_port
        except ImportError:
            raise InputError(message("sampling.no_dask")) from None
        try:
            parse_host_port(parse_address(workers.scheduler)[1])  # else a client is half-made
            files: dict[str, str] = {}
            if workers.certificates is not None:
                ca, cert, key = map(os.fspath, workers.certificates)
                files = {"tls_ca_file": ca, "tls_client_cert": cert, "tls_client_key": key}
            security = Security(require_encryption=workers.is_encrypted or None, **files)
            known = security.get_connection_args("client").get("ssl_context")
            if workers.is_encrypted and known is None:  # else a client is half-made
                address = workers.scheduler
                raise InputError(message("sampling.certificates_missing", address=address))
            self._client: Any = Client(workers.scheduler, set_as_default=False, security=security)
        except (OSError, ValueError, TypeError) as error:
            text = message("sampling.no_scheduler", address=workers.scheduler, reason=str(error))
            raise InputError(text) from None
        self._sent = pickle.dumps(bundle)
        self._measures, self._limit = measures, limit
        self._done: SimpleQueue[Future] = SimpleQueue()
        self._jobs: dict[Future, tuple[list[Task], float]] = {}  # chunk and when it was sent [s]
        self._alone: list[Task] = []  # of chunks that were lost
        self._seconds = self._count = 0.0

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """The samples of tasks, some at a time, in any order.

        Raises:
            InputError: there is no worker, or one has another version of the package."""
        tasks = iter(tasks)
        with self._client as client:
            try:
                sent = client.scatter(self._sent, broadcast=False, hash=True)
            except TimeoutError:
                address = client.scheduler.address
                raise InputError(message("sampling.no_worker", address=address)) from None
            try:
                while True:
                    threads = sum(client.nthreads().values())  # however many workers there are now
                    while len(self._jobs) < max(CLUSTER.under_way * threads, 2):
                        rate = self._count / self._seconds if self._seconds else 0.0
                        size = max(1, round(CLUSTER.chunk * rate))
                        chunk = [self._alone.pop()] if self._alone else list(islice(tasks, size))
                        if not chunk:
                            break
                        job = client.submit(make_chunk, sent, chunk, pure=False)
                        self._jobs[job] = chunk, time.monotonic()
                        job.add_done_callback(self._done.put)
                    if not self._jobs:
                        return
                    for samples in self._ready():
                        self._seconds += sum(sample.seconds for sample in samples)
                        self._count += len(samples)
                        yield samples
            finally:
                client.cancel(list(self._jobs), force=True)
                self._jobs.clear()

    def _ready(self) -> Iterator[list[Sample]]:
        """The samples of chunks that are done; those of lost ones go back."""
        try:
            job = self._done.get(timeout=1.0)
        except Empty:  # chunks at work for longer than their samples may take: workers restart
            if (limit := self._limit) is None:
                return
            busy = {key: at for at, keys in self._client.processing().items() for key in keys}
            for late, (chunk, since) in list(self._jobs.items()):
                allowed = len(chunk) * CLUSTER.under_way * (limit + POOLS.grace)
                waited = time.monotonic() - since
                if late.key in busy and waited >= allowed + POOLS.first_grace:
                    del self._jobs[late]
                    self._client.cancel([late], force=True)
                    self._client.restart_workers([busy[late.key]], raise_for_error=False)
                    yield from self._lost(chunk, message("sampling.ended", limit=limit), late=True)
            return
        if job not in self._jobs:  # it was given up
            return
        chunk, _ = self._jobs.pop(job)
        if job.status == "finished":
            yield job.result()
            return
        error = job.exception() if job.status == "error" else None
        if isinstance(error, OtherCode):
            raise InputError(message("sampling.other_code", here=_code(), there=str(error)))
        # the scheduler has tried it on several workers
        yield from self._lost(chunk, message("sampling.workers_died", error=type(error).__name__))

    def _lost(self, chunk: list[Task], text: str, late: bool = False) -> Iterator[list[Sample]]:
        """A chunk that ended its workers: its samples are tried alone, one alone is given up."""
        if len(chunk) > 1:
            self._alone += chunk
        else:
            yield [Sample.lost(chunk[0][0], text, self._measures, late)]


def file_name(path: Path) -> str:
    """A file's name in a bundle: its path from the root."""
    return os.path.relpath(path.resolve(), path.resolve().anchor)
