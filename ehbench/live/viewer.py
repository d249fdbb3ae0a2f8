"""The process of a live view: it reads the board some times a second and shows it on a page, on the
terminal and, where its package is installed, to Foxglove."""

from __future__ import annotations

import json
import math
import mmap
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from typing import Any

from ehbench.live.board import ENDED, HEARD, HELD, HOST, LEVERS, PAGE, RUNNING, STATE, VIEW, Facts
from ehbench.live.frames import frame_of
from ehbench.live.joystick import follow_stick

SAFE = {
    "Content-Security-Policy": "default-src 'none'; connect-src 'self'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


class Page(BaseHTTPRequestHandler):
    """Answers browsers on this computer who know the page's secret address."""

    protocol_version = "HTTP/1.1"
    timeout = 30.0
    # pyrefly: ignore[bad-override-mutable-attribute]
    server: Server

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def _path(self) -> str | None:
        """The path behind the token; None of a request that came by another name or without it."""
        hosts = {f"{name}:{self.server.server_port}" for name in (HOST, "localhost")}
        begin = f"/{self.server.token}/"
        known = self.headers.get("Host") in hosts and self.path.startswith(begin)
        return self.path.removeprefix(begin) if known else None

    def _answer(self, code: int, body: bytes = b"", kind: str = "text/plain") -> None:
        self.send_response(code)
        for name, value in (SAFE | {"Content-Type": f"{kind}; charset=utf-8"}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self) -> None:
        """The page, or the stream of its frames."""
        path = self._path()
        if path == "":
            self._answer(200, Path(__file__).with_name("page.html").read_bytes(), "text/html")
        elif path != "events":
            self._answer(403 if path is None else 404)
        else:
            self.send_response(200)
            for name, value in (SAFE | {"Content-Type": "text/event-stream"}).items():
                self.send_header(name, value)
            self.send_header("Connection", "close")
            self.end_headers()
            with suppress(OSError):
                self._send("facts", self.server.facts)
                while True:
                    frame = self.server.frame
                    self._send("frame", frame)
                    if frame["state"] == "ended":
                        break
                    time.sleep(1.0 / VIEW.frames)

    def do_POST(self) -> None:
        """What the levers of the page say: ``{"held": true, "levers": [0.5, -0.1]}``."""
        path, server = self._path(), self.server
        try:
            size = int(self.headers.get("Content-Length", "0"))
            if not 0 <= size <= VIEW.longest:
                self.close_connection = True  # what it sends is not read
                raise ValueError
            words = json.loads(self.rfile.read(size))
            pressed, levers = bool(words["held"]), [float(lever) for lever in words["levers"]]
            sound = len(levers) == len(server.facts["levers"]) and all(map(math.isfinite, levers))
        except (ValueError, TypeError, KeyError):
            sound, pressed, levers = False, False, []
        taken = path == "levers" and sound and server.facts["device"] == PAGE
        if taken:
            server.put(levers if pressed else None)
        self._answer(204 if taken else 403 if path is None else 400)

    def _send(self, name: str, content: Any) -> None:
        self.wfile.write(f"event: {name}\ndata: {json.dumps(content)}\n\n".encode())


class Server(ThreadingHTTPServer):
    """The page's server, on a socket that listens already."""

    daemon_threads = True

    def __init__(
        self, door: socket.socket, token: str, facts: Facts, board: memoryview[float]
    ) -> None:
        super().__init__(door.getsockname(), Page, bind_and_activate=False)
        self.socket.close()
        self.socket, self.server_port = door, door.getsockname()[1]
        self.token, self.frame = token, frame_of(facts, board)
        shown = ("title", "machine", "duration", "rate", "units", "levers", "device")
        self.facts = {name: getattr(facts, name) for name in shown}
        self._inputs = board[facts.first_lever :]

    def put(self, levers: Sequence[float] | None) -> None:
        """Write what the operator says onto the board; None while the dead-man switch is open."""
        for number, lever in enumerate(levers or [0.0] * len(self.facts["levers"]), LEVERS):
            self._inputs[number] = lever
        self._inputs[HELD], self._inputs[HEARD] = float(levers is not None), time.monotonic()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no error."""


@contextmanager
def foxglove(facts: Facts) -> Iterator[Callable[[dict[str, Any]], None]]:
    """What hands frames to Foxglove, on its usual port of this computer; nothing without its
    package, or where the port is taken."""
    if find_spec("foxglove") is None:
        yield lambda frame: None
        return
    import foxglove

    foxglove.set_log_level("CRITICAL")
    try:
        server = foxglove.start_server(name=f"ehbench: {facts.title}", host=HOST)
    except Exception:
        yield lambda frame: None
        return
    try:
        yield lambda frame: foxglove.log("/trial", frame)
    finally:
        server.stop()


@contextmanager
def terminal(facts: Facts) -> Iterator[Callable[[dict[str, Any]], None]]:
    """What draws frames on the terminal; it is as before afterwards."""
    from rich.console import Console
    from rich.live import Live

    from ehbench.live.screen import screen

    with Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live:
        yield lambda frame: live.update(screen(facts, frame), refresh=True)


def show_trial(memory: int, door: int, token: str, draws: bool, parent: int, known: Any) -> None:
    """The view, until the trial ends it or is no more.

    Args:
        memory: file of the board.
        door: file of the page's socket.
        token: of the page's address.
        draws: on the terminal.
        parent: number of the trial's process.
        known: facts of the trial, as plain values."""
    with suppress(OSError):
        os.nice(5)
    facts, board = Facts(**known), memoryview(mmap.mmap(memory, 0)).cast("d")
    server = Server(socket.socket(fileno=door), token, facts, board)
    Thread(target=server.serve_forever, daemon=True).start()
    if facts.levers and facts.device != PAGE:
        Thread(target=follow_stick, args=(facts, server.put), daemon=True).start()

    def frames(until: float) -> Iterator[dict[str, Any]]:
        while board[STATE] < until and os.getppid() == parent:
            server.frame = frame_of(facts, board)
            yield server.frame
            time.sleep(1.0 / VIEW.frames)

    for _ in frames(RUNNING):  # the terminal may be somebody else's before
        pass
    with foxglove(facts) as log, terminal(facts) if draws else nullcontext() as draw:
        for frame in frames(ENDED):
            log(frame)
            if draw is not None:
                with suppress(OSError):
                    draw(frame)
    board[STATE] = ENDED
    server.frame = frame_of(facts, board)
    time.sleep(2.0 / VIEW.frames)  # pages take their last frame


if __name__ == "__main__":
    show_trial(*json.loads(sys.argv[1]))
