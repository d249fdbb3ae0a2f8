"""How vectors of float64 reach a target and come back as datagrams, over UDP or on a virtual
clock."""

import math
import socket
import time
from typing import Any, Protocol

import numpy as np

from ehbench.links.responder import ALIVE, HEADER, STOPPING, Target

LAYOUT, TOKEN, SEQUENCE, TIME, ACKNOWLEDGED, STATE, REASON, WATCHDOG = range(len(HEADER))
LARGEST = 65535  # bytes of a datagram


class Link(Protocol):
    """A way to a target.

    Attributes:
        virtual: the target's time goes on with the host's vectors, not by itself.
    """

    virtual: bool

    def encode(self, numbers: np.ndarray) -> Any:
        """Header and values as they are sent.

        Raises:
            InputError: one that the link cannot hold."""
        ...

    def send(self, numbers: np.ndarray) -> None:
        """Send header and values."""
        ...

    def receive(self, timeout: float) -> list[np.ndarray]:
        """What has come, oldest first; at the latest after ``timeout`` [s], then perhaps none."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class UdpLink:
    """Datagrams to one address, and from no other.

    Args:
        host: name or address.
        port: of the target.
        virtual: the target runs on a virtual clock and answers each datagram.
    """

    def __init__(self, host: str, port: int, virtual: bool = False) -> None:
        self.virtual = virtual
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError:
            self._socket.close()
            raise

    def encode(self, numbers: np.ndarray) -> bytes:
        """As `Link.encode`; every number has room."""
        return numbers.astype("<f8").tobytes()

    def send(self, numbers: np.ndarray) -> None:
        """As `Link.send`; a target that is not there, or no longer, is no error."""
        try:
            self._socket.send(self.encode(numbers))
        except OSError:
            time.sleep(1e-3)

    def receive(self, timeout: float) -> list[np.ndarray]:
        """As `Link.receive`; what is no vector is left out by its size."""
        taken: list[np.ndarray] = []
        self._socket.settimeout(1.0 if self.virtual else max(timeout, 1e-6))
        try:
            while True:
                taken.append(vector(self._socket.recv(LARGEST)))
                self._socket.setblocking(False)
        except OSError:  # nothing more, or a network that is down
            return taken

    def close(self) -> None:
        """As `Link.close`."""
        self._socket.close()


class VirtualClock:
    """The time of a target that goes on with its host's datagrams."""

    def __init__(self, target: Target) -> None:
        self.target, self._token, self._origin = target, math.nan, 0

    def pass_by(self, ticks: int) -> None:
        """Let time go by without a datagram."""
        for _ in range(ticks):
            self.target.tick(self.target.sequence / self.target.rate)

    def answer(self, datagram: bytes) -> bytes:
        """What a target answers: its time goes on to the host's, then the datagram comes, then it
        ticks once; b"" where its answer is lost."""
        target, numbers = self.target, vector(datagram)
        if numbers.size >= len(HEADER) and np.isfinite(numbers[: len(HEADER)]).all():
            host = round(numbers[TIME] * target.rate)
            if numbers[TOKEN] != self._token:
                self._token, self._origin = numbers[TOKEN], target.sequence + 1 - host
            # no host may let it run for ever
            self.pass_by(min(self._origin + host - target.sequence - 1, round(10.0 * target.rate)))
        now = target.sequence / target.rate
        target.receive(datagram, now)
        return target.tick(now)


def vector(datagram: bytes) -> np.ndarray:
    """The numbers of a datagram; one that is not a whole number of them gives none."""
    return np.frombuffer(datagram if len(datagram) % 8 == 0 else b"", "<f8")


def datagram_of(numbers: np.ndarray, target: Target) -> bytes:
    """The datagram for a target of a vector with room for all values of any mode."""
    bare = numbers[STATE] in (ALIVE, STOPPING) or numbers[LAYOUT] not in target.modes
    size = 0 if bare else target.modes[int(numbers[LAYOUT])][0]
    return numbers[: len(HEADER) + size].astype("<f8").tobytes()
