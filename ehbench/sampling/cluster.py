"""Samples on a Dask cluster: chunks of tasks go to its scheduler, the study's files to each worker
once, under their hash. Workers may come, go and die; no sample shows where it was made.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Any, NamedTuple

from ehbench.runs.versions import METHODS
from ehbench.runtime.blas import one_thread
from ehbench.sampling.pools import DEATHS, GRACE, WARMING, Chunks
from ehbench.sampling.sample import Make, Sample, Task
from ehbench.vocabulary.errors import InputError

if TYPE_CHECKING:
    from distributed import Future

WAITING = 3  # chunks for each thread of the cluster that are under way at most
CONNECT = 20.0  # [s]


def _code() -> str:
    """The package's version, with those of all methods."""
    numbers = ".".join(map(str, METHODS.values()))
    return f"{metadata.version('ehbench')} (methods {numbers})"


@dataclass(frozen=True)
class Bundle:
    """What a study reads, to be laid out on another machine as it lies on this one: files by their
    path from the root, and what opens them there, given where the root is.
    """

    files: dict[str, bytes]
    open: Any
    code: str = field(default_factory=_code)

    def unpacked(self, root: Path) -> Make:
        """Write the files below ``root``; what makes samples of them."""
        for name, data in self.files.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return self.open(root)


class Sent(NamedTuple):
    """A bundle on its way: its bytes and their hash."""

    digest: str
    data: bytes


class OtherCode(Exception):
    """A worker has another version of the package."""


_OPENING = threading.Lock()


@lru_cache(maxsize=4)
def _opened(digest: str, data: bytes) -> Make:
    bundle: Bundle = pickle.loads(data)
    if bundle.code != _code():
        raise OtherCode(f"{bundle.code} here, {_code()} there")
    return bundle.unpacked(Path(mkdtemp(prefix=f"ehbench_{digest[:8]}_")))


@one_thread()
def make_chunk(sent: Sent, chunk: list[Task]) -> list[Sample]:
    """What a worker of the cluster does."""
    with _OPENING:
        make = _opened(*sent)
    return [make(*task) for task in chunk]


class Cluster:
    """The workers behind a Dask scheduler.

    Args:
        address: of the scheduler, such as ``tcp://host:8786``.
        bundle: of the study.
        measures: of a sample.
        limit: time [s] that a sample may take; a worker that hangs beyond it is started anew.

    Raises:
        InputError: no such extra is installed, or nobody answers.
    """

    def __init__(
        self, address: str, bundle: Bundle, measures: int, limit: float | None = None
    ) -> None:
        try:
            from distributed import Client
            from distributed.comm.addressing import parse_address, parse_host_port
        except ImportError:
            raise InputError(
                "workers of a scheduler need Dask", hint="install it: pip install 'ehbench[scale]'"
            ) from None
        try:
            parse_host_port(parse_address(address)[1])  # a client refused half-made is noisy
            self._client: Any = Client(address, timeout=CONNECT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no Dask scheduler answers at '{address}': {error}",
                hint="start one: dask scheduler; dask worker tcp://host:8786",
            ) from None
        data = pickle.dumps(bundle)
        self._sent = Sent(hashlib.sha256(data).hexdigest(), data)
        self._measures, self._limit = measures, limit
        self._done: SimpleQueue[Future] = SimpleQueue()
        self._deaths: dict[int, int] = {}
        self._since: dict[Future, float] = {}
        self._chunks: dict[Future, list[Task]] = {}

    def run(self, tasks: Iterable[Task]) -> Iterator[list[Sample]]:
        """As `Pool.run`.

        Raises:
            InputError: a worker has other code than this process.
        """
        chunks = Chunks(tasks)
        with self._client as client:
            sent = client.scatter(self._sent, broadcast=False, hash=True)
            try:
                while True:
                    self._feed(chunks, sent)
                    if not self._chunks:
                        return
                    for built in self._ready(chunks):
                        chunks.learn(built)
                        yield built
            finally:
                client.cancel(list(self._chunks), force=True)
                self._chunks.clear()

    def _feed(self, chunks: Chunks, sent: Future) -> None:
        """Keep the cluster busy, however many workers it has now."""
        threads = sum(self._client.nthreads().values())
        while len(self._chunks) < max(WAITING * threads, 2) and (chunk := chunks.take()):
            job = self._client.submit(make_chunk, sent, chunk, pure=False)
            self._chunks[job], self._since[job] = chunk, time.monotonic()
            job.add_done_callback(self._done.put)

    def _ready(self, chunks: Chunks) -> Iterator[list[Sample]]:
        """The samples of chunks that are done; those of lost ones go back."""
        try:
            job = self._done.get(timeout=1.0)
        except Empty:
            yield from self._overdue(chunks)
            return
        if job not in self._chunks:  # it was given up
            return
        chunk = self._chunks.pop(job)
        del self._since[job]
        if job.status == "finished":
            yield job.result()
        else:
            yield from self._lost(job, chunk, chunks)

    def _lost(self, job: Future, chunk: list[Task], chunks: Chunks) -> Iterator[list[Sample]]:
        """A chunk that ended its workers, or whose worker has other code."""
        error = job.exception() if job.status == "error" else None
        if isinstance(error, OtherCode):
            raise InputError(
                f"a worker has another version of ehbench: {error}",
                hint="install the same on all machines",
            )
        if len(chunk) > 1:
            chunks.give_back(chunk, alone=True)
            return
        index = chunk[0][0]
        self._deaths[index] = self._deaths.get(index, 0) + 1
        if self._deaths[index] < DEATHS:
            chunks.give_back(chunk)
            return
        message = f"the workers that made it died: {type(error).__name__}"
        yield [Sample.lost(index, message, self._measures)]

    def _overdue(self, chunks: Chunks) -> Iterator[list[Sample]]:
        """A chunk at work for longer than its samples may take: its worker is started anew."""
        if self._limit is None:
            return
        busy = {key: at for at, keys in self._client.processing().items() for key in keys}
        for job, chunk in list(self._chunks.items()):
            allowed = len(chunk) * WAITING * (self._limit + GRACE) + WARMING
            if job.key not in busy or time.monotonic() - self._since[job] < allowed:
                continue
            del self._chunks[job], self._since[job]
            self._client.cancel([job], force=True)
            self._client.restart_workers([busy[job.key]], raise_for_error=False)
            if len(chunk) > 1:
                chunks.give_back(chunk, alone=True)
            else:
                message = f"it took longer than {self._limit:g} s and was ended"
                yield [Sample.lost(chunk[0][0], message, self._measures, late=True)]


def file_name(path: Path) -> str:
    """A file's name in a bundle: its path from the root."""
    return os.path.relpath(path.resolve(), path.resolve().anchor)
