"""Signals that end the process. They are raised in the main thread, wherever it stands, but not
while it does what an exception must not leave half done.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN = 0.02  # [s] until an end that got lost is asked for again


class Terminated(SystemExit):
    """The process was asked to end by a signal, by ``number``: what is under way is cleared,
    nothing blamed.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(128 + number)


class _Held:
    """How many blocks are at work that nothing may break, and the signal that waits for them."""

    depth = 0
    waiting = 0


def listen() -> None:
    """Let SIGTERM, and the keyboard where Python's own handler has it, raise `Terminated`; also
    where that was lost at first, as in a finaliser, from which no exception comes out.
    """
    signal.signal(signal.SIGTERM, _end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)  # the command line's library says nothing of it
    before = sys.unraisablehook

    def lost(found: Any) -> None:
        if not isinstance(found.exc_value, Terminated):
            before(found)
            return
        again = threading.Timer(AGAIN, os.kill, (os.getpid(), found.exc_value.number))
        again.daemon = True
        again.start()

    sys.unraisablehook = lost


def _end(number: int, _: object) -> None:
    if _Held.depth:
        _Held.waiting = number
    else:
        raise Terminated(number)


@contextmanager
def unbroken() -> Iterator[None]:
    """A block that signals which end the process wait for.

    The compiler's library is one: it calls Python back and takes a null where that raises, and a
    lock that it had just taken would be kept for ever.

    Raises:
        Terminated: at its end, where one came meanwhile.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread alone
        return
    _Held.depth += 1
    try:
        yield
    finally:
        _Held.depth -= 1
        if _Held.waiting and not _Held.depth:
            number, _Held.waiting = _Held.waiting, 0
            raise Terminated(number)
