"""Signals that end the process. They are raised in the main thread, wherever it stands, but not
while it does what an exception must not leave half done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

AGAIN = 2.0  # [s] of work after which an end that has not come is asked for again


class Terminated(SystemExit):
    """The process was asked to end by a signal, by ``number``: what is under way is cleared,
    nothing blamed."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(128 + number)


class _State:
    """How many blocks are at work that nothing may break, the signal that waits for them, and the
    one that the process is ending by."""

    depth = 0
    waiting = 0
    requested = 0


def listen() -> None:
    """Let SIGTERM, a terminal that closes (SIGHUP, unless ``nohup`` ignores it), and the keyboard
    where Python's own handler has it, raise `Terminated`; again and again until `ended`, for
    libraries turn it into errors of theirs, or swallow it, and no exception comes out of a
    finaliser."""
    signal.signal(signal.SIGTERM, _end)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        signal.signal(signal.SIGHUP, _end)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)  # the command line's library says nothing of it
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGVTALRM, lambda *_: _end(_State.requested))


def ended() -> int:
    """The signal by which the process was asked to end, 0 if by none; it is not asked again."""
    number, _State.requested = _State.requested, 0
    _ask_after(0.0)
    return number


def _ask_after(time: float) -> None:
    # by a clock of the system's: to start a thread waits for a lock that may be taken here
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_VIRTUAL, time)


def _end(number: int, _: object = None) -> None:
    if _State.depth:
        _State.waiting = number
        return
    _State.requested = number
    _ask_after(AGAIN)
    raise Terminated(number)


@contextmanager
def unbroken() -> Iterator[None]:
    """A block that signals which end the process wait for.

    The compiler's library is one: it calls Python back and takes a null where that raises, and a
    lock that it had just taken would be kept for ever.

    Raises:
        Terminated: at its end, where one came meanwhile."""
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread alone
        return
    _State.depth += 1
    try:
        yield
    finally:
        _State.depth -= 1
        if _State.waiting and not _State.depth:
            number, _State.waiting = _State.waiting, 0
            _end(number)
