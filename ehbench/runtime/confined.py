"""Work in a child process with bounded memory, time and files, for libraries that a damaged or
hostile file may bring down."""

import faulthandler
import os
import resource
import select
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from ehbench.runtime.landlock import restrict, system_paths
from ehbench.runtime.memory import used_memory

_PIPE_BYTES = 1 << 20  # bytes that a pipe hands over at once


@dataclass(frozen=True)
class Bounds:
    """What a child may use: ``memory`` [bytes] beyond what the process holds already, ``seconds``
    [s] of computing, and ``wait`` [s] in all."""

    memory: float
    seconds: float
    wait: float


class Ended(Exception):
    """The child ended before its work was done: by ``number``, the signal that ended it."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)

    @property
    def late(self) -> bool:
        """Whether it was ended for the time that it took."""
        return self.number in (signal.SIGXCPU, signal.SIGALRM)

    @property
    def name(self) -> str:
        """What ended it, such as SIGSEGV."""
        return signal.Signals(self.number).name if self.number else "no word"


def confined(
    work: Callable[[BinaryIO], None], bounds: Bounds, readable: Iterable[Path] = ()
) -> bytearray:
    """What a piece of work writes into the pipe that it is given.

    It runs in a fork of this process: what is imported here is imported there. It prints nothing
    and changes nothing here; where the system knows how, it opens no other files.

    Args:
        work: what is done, in an empty folder.
        bounds: what it may use.
        readable: whole paths of files and folders that it may read.

    Raises:
        Ended: it crashed, or took longer than its bounds."""
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the child starts no thread of these
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            code = 1
            try:
                os.close(reading)
                confine(bounds)
                tempfile.tempdir = folder
                os.chdir(folder)
                restrict([*system_paths(), *readable], Path(folder))
                with os.fdopen(writing, "wb") as pipe:
                    work(pipe)
                code = 0
            finally:
                os._exit(code)
        os.close(writing)
        return _outcome(child, reading, bounds)


def _outcome(child: int, reading: int, bounds: Bounds) -> bytearray:
    """What a child writes until it ends; raises as `confined`."""
    result, end, waiting = bytearray(), time.monotonic() + bounds.wait, select.poll()
    waiting.register(reading, select.POLLIN)
    try:
        while True:
            left = end - time.monotonic()
            if left <= 0.0 or len(result) > bounds.memory:
                raise Ended(signal.SIGALRM if left <= 0.0 else signal.SIGKILL)
            if not waiting.poll(1e3 * left):
                continue
            if not (piece := os.read(reading, _PIPE_BYTES)):
                break
            result += piece
    except BaseException:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    finally:
        os.close(reading)
    status = os.waitpid(child, 0)[1]
    if status:
        raise Ended(os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0)
    return result


def confine(bounds: Bounds) -> None:
    """Bound this process, a child, whose standard files then lead nowhere."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    faulthandler.disable()
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nothing, number)
    seconds = max(round(bounds.seconds), 1)
    for kind, limit in (
        (resource.RLIMIT_AS, int(used_memory() + bounds.memory)),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, int(bounds.memory)),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, hard))
