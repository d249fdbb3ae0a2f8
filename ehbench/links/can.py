"""Vectors as frames of CAN, by a DBC file: signals ``up_press_x``, ``down_press_servo_command``."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.links.layout import FRAMES
from ehbench.links.responder import Target
from ehbench.links.transport import datagram_of
from ehbench.vocabulary import InputError, message


class Frames:
    """The frames of one direction: all that have a signal of it, as a vector is whole with all of
    them also where only some of its numbers are named."""

    def __init__(self, way: str, names: Sequence[str], path: Path) -> None:
        import cantools

        try:
            known: Any = cantools.database.load_file(path)
        except (cantools.Error, ValueError) as error:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(message("links.dbc", why=why), file=path) from None
        self.signals = {f"{way}_{name.replace('.', '_')}": i for i, name in enumerate(names)}
        ours = {s.name for m in known.messages for s in m.signals if s.name.startswith(f"{way}_")}
        messages = [m for m in known.messages if any(s.name in ours for s in m.signals)]
        self.messages: dict[int, Any] = {
            m.frame_id: m for m in sorted(messages, key=lambda m: m.frame_id)
        }
        if ours.isdisjoint(self.signals):
            fields = {"way": way, "such": next(iter(self.signals))}
            raise InputError(message("links.dbc_signals", **fields), file=path)
        self.last, self._numbers = max(self.messages), np.full(len(names), np.nan)
        self._came: set[int] = set()  # since the last vector

    def encode(self, numbers: np.ndarray) -> list[Any]:
        """The frames of a vector; numbers that it lacks are 0.

        Raises:
            InputError: one that its signal cannot hold.
        """
        import can
        import cantools

        frames, whole = [], np.zeros(len(self.signals))
        whole[: numbers.size] = numbers
        for number, frame in self.messages.items():
            places = ((s.name, self.signals.get(s.name)) for s in frame.signals)
            values = {name: 0.0 if i is None else whole[i] for name, i in places}
            try:
                data = frame.encode(values)
            except (cantools.Error, ValueError, OverflowError) as error:
                problem = message("links.no_room", name=frame.name, why=str(error))
                raise InputError(problem) from error
            extended = frame.is_extended_frame
            frames.append(can.Message(arbitration_id=number, data=data, is_extended_id=extended))
        return frames

    def take(self, frame) -> np.ndarray | None:
        """The vector that a frame completes; None of one of whose frames was lost, as a number of
        the vector before it would pass for one of now."""
        known = self.messages.get(frame.arbitration_id)
        if known is None or len(frame.data) < known.length:
            return None
        if frame.is_error_frame or frame.is_extended_id != known.is_extended_frame:
            return None  # a controller's report, or another's number
        for name, value in known.decode(frame.data, decode_choices=False).items():
            if name in self.signals:
                self._numbers[self.signals[name]] = value
        if frame.arbitration_id in self._came:  # the last frame of the vector before was lost
            self._came.clear()
        self._came.add(frame.arbitration_id)
        if frame.arbitration_id != self.last:
            return None
        whole, self._came = self._came == set(self.messages), set()
        return self._numbers.copy() if whole else None


def open_bus(interface: str, channel: str):
    """A bus by its interface of python-can and its channel.

    Raises:
        OSError: there is none.
    """
    import can

    try:
        return can.Bus(interface=interface, channel=channel)
    except (can.CanError, ValueError) as error:
        raise OSError(0, str(error)) from error


class CanLink:
    """A target on a CAN bus.

    Args:
        interface: of python-can, such as ``socketcan``.
        channel: such as ``can0``.
        names: of all numbers that come up, and of those that go down.
        path: the DBC file.
    """

    virtual = False

    def __init__(
        self, interface: str, channel: str, names: tuple[Sequence[str], Sequence[str]], path: Path
    ) -> None:
        import can

        self._up, self._down = (Frames(w, n, path) for w, n in zip(FRAMES, names, strict=True))
        self._bus, self._error = open_bus(interface, channel), can.CanError

    def encode(self, numbers: np.ndarray) -> list[Any]:
        """As `Link.encode`."""
        return self._down.encode(numbers)

    def send(self, numbers: np.ndarray) -> None:
        """As `Link.send`; what the bus does not take is lost."""
        with suppress(self._error):
            for frame in self.encode(numbers):
                self._bus.send(frame)

    def receive(self, timeout: float) -> list[np.ndarray]:
        """As `Link.receive`."""
        came, until = [], time.monotonic() + timeout
        with suppress(self._error):
            while (
                frame := self._bus.recv(0.0 if came else max(until - time.monotonic(), 0.0))
            ) or (not came and time.monotonic() < until):
                numbers = None if frame is None else self._up.take(frame)
                came += [] if numbers is None else [numbers]
        return came

    def close(self) -> None:
        """As `Link.close`."""
        self._bus.shutdown()


def serve(
    target: Target,
    interface: str,
    channel: str,
    names: tuple[Sequence[str], Sequence[str]],
    path: Path,
    ready: Callable[[], None],
) -> None:
    """Serve a target on a CAN bus, on its own clock; ``ready`` is called when the bus is open."""
    up, down = (Frames(way, n, path) for way, n in zip(FRAMES, names, strict=True))
    with open_bus(interface, channel) as bus:
        ready()
        due = time.monotonic()
        while True:
            while (frame := bus.recv(max(due - time.monotonic(), 0.0))) is not None:
                if (numbers := down.take(frame)) is None:
                    continue
                target.receive(datagram_of(numbers, target), time.monotonic())
            if datagram := target.tick(time.monotonic()):
                for frame in up.encode(np.frombuffer(datagram, "<f8")):
                    bus.send(frame)
            due = max(due + 1.0 / target.rate, time.monotonic() - 0.1)
