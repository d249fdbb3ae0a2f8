"""A loop as punctual as Linux lets a process be."""

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

PRIORITY = 60  # of SCHED_FIFO: above interrupt threads, below watchdogs of the kernel
LOCK_ALL = 3  # MCL_CURRENT | MCL_FUTURE
SWITCH = 5e-5  # [s] after which another thread of Python's gives way


@contextmanager
def punctual(priority: int = PRIORITY, pinned: bool = True) -> Iterator[list[str]]:
    """A block that other processes, paging and the collector of garbage do not hold up.

    Args:
        priority: among processes in real time.
        pinned: to the last core.

    Yields:
        what the system did not allow: ``fifo``, ``memory``, ``core``."""
    refused: list[str] = []
    restore: list[Callable[[], None]] = []

    def attempt(name: str, change: Callable[[], None], undo: Callable[[], None]) -> None:
        try:
            change()
            restore.append(undo)
        except (OSError, AttributeError, ValueError):
            refused.append(name)

    def lock(flags: int | None) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        if (libc.munlockall() if flags is None else libc.mlockall(flags)) != 0:
            raise OSError(ctypes.get_errno(), "mlockall")

    def schedule(policy: str, flag: str, level: int) -> None:
        number = getattr(os, policy) | getattr(os, flag, 0)  # threads begun inside are ordinary
        os.sched_setscheduler(0, number, os.sched_param(level))

    urgent = partial(schedule, "SCHED_FIFO", "SCHED_RESET_ON_FORK", priority)
    attempt("fifo", urgent, partial(schedule, "SCHED_OTHER", "", 0))
    attempt("memory", partial(lock, LOCK_ALL), partial(lock, None))
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    if pinned and len(cores) > 1:
        bind, last = partial(os.sched_setaffinity, 0), {max(cores)}
        attempt("core", partial(bind, last), partial(bind, cores))
    interval, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield refused
    finally:
        if collects:
            gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(interval)
        for undo in reversed(restore):
            with suppress(OSError):
                undo()


def aside() -> None:
    """Let a thread begun in a punctual block run on other cores, below the block's priority: were
    it not in real time, others could stop it while it holds the lock of Python's interpreter."""
    with suppress(OSError, AttributeError):
        os.sched_setaffinity(0, set(range(os.cpu_count() or 1)))
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY // 2))
