"""A process that makes samples for another one: ``python -m ehbench.sampling.worker <fd>``."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from multiprocessing.connection import Connection

from ehbench.runtime.blas import one_thread
from ehbench.sampling.pools import serve


@one_thread()
def main(descriptor: int) -> None:
    """Serve the pipe until the other end is closed; the keyboard is the other process's matter."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        serve(Connection(descriptor))


if __name__ == "__main__":
    main(int(sys.argv[1]))
