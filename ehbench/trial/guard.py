"""Calls of a user's code, held to what a call may do: it comes back within a time, and does not
end the process.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ehbench.runtime.interrupts import Terminated

LONGEST = 60.0  # [s] of wall time that one step may take
LONGEST_START = 600.0  # [s] that loading and starting a class may take; it may compile
LOOK = 1.0  # [s] between two looks at the clock


class Overdue(BaseException):
    """Raised inside a call that has taken too long, where it stands."""


class Exit(BaseException):
    """Raised in place of an end of the process that code asked of the system."""


class Guard:
    """Runs calls of code that may do anything; ``longest`` [s] is what one may take.

    Only the main thread can be woken: elsewhere a call may take as long as it likes."""

    def __init__(self, longest: float = LONGEST_START) -> None:
        self.longest = longest
        self._since = 0.0

    def __call__(self, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """What the function gives.

        Raises:
            Overdue, Exit: it took too long, or asked for the process's end.
            Terminated, KeyboardInterrupt: the user ended the process.
            BaseException: whatever the code raised.
        """
        leave, os._exit = os._exit, _no_exit
        self._since = time.monotonic()
        try:
            return function(*given, **named)
        finally:
            self._since = 0.0
            os._exit = leave

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Within the block a call that takes too long is ended."""
        main = threading.current_thread() is threading.main_thread()
        if not main or not hasattr(signal, "setitimer") or signal.getitimer(signal.ITIMER_REAL)[0]:
            yield
            return
        before = signal.signal(signal.SIGALRM, self._look)
        signal.setitimer(signal.ITIMER_REAL, LOOK, LOOK)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)

    def _look(self, *_: object) -> None:
        if self._since and time.monotonic() - self._since > self.longest:
            raise Overdue


def _no_exit(status: int = 0) -> None:
    raise Exit(status)


def is_users(error: BaseException) -> bool:
    """Whether an error is the doing of who runs the program, and not the code's own."""
    return isinstance(error, (Terminated, KeyboardInterrupt))
