"""Joysticks of Linux as levers, through evdev."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from ehbench.live.board import Facts
from ehbench.vocabulary import InputError, message

AXES = ("ABS_X", "ABS_Y", "ABS_RX", "ABS_RY")  # of the levers that name none, in turn


class Joystick:
    """A joystick that is plugged in.

    Args:
        device: its path, or a part of its name.
        axes: of the levers; "-ABS_Y" is the other way round, "" the next of the usual ones.
        button: that is the dead-man switch; "" for any.

    Raises:
        InputError: evdev is not installed; no such device, axis or button."""

    def __init__(self, device: str, axes: Sequence[str], button: str) -> None:
        try:
            from evdev import InputDevice, ecodes, list_devices
        except ImportError as error:
            raise InputError(message("live.extra")) from error
        known = [InputDevice(path) for path in list_devices()]
        chosen = [i for i in known if device == i.path or device.lower() in i.name.lower()]
        for item in known:
            if item not in chosen[:1]:
                item.close()
        if not chosen:
            names = ", ".join(f"{item.name} ({item.path})" for item in known) or "none"
            raise InputError(message("live.no_device", device=device, known=names))
        self._device, usual = chosen[0], iter(AXES)
        there: dict[int, Any] = self._device.capabilities()
        have = dict(there.get(ecodes.EV_ABS, ()))
        self._axes = []
        for axis in (axis or next(usual, "") for axis in axes):
            code = ecodes.ecodes.get(axis.removeprefix("-"))
            if code not in have:
                raise InputError(message("live.no_axis", device=self._device.name, axis=axis))
            self._axes.append((code, -1.0 if axis.startswith("-") else 1.0))
        self._button = ecodes.ecodes.get(button) if button else None
        if button and self._button not in there.get(ecodes.EV_KEY, ()):
            raise InputError(message("live.no_button", device=self._device.name, button=button))

    def read(self) -> list[float] | None:
        """As `OperatorInput.read`.

        Raises:
            OSError: it was unplugged."""
        keys, levers = self._device.active_keys(), []
        for code, way in self._axes:
            info = self._device.absinfo(code)
            share = (info.value - info.min) / (info.max - info.min)
            levers.append(way * (2.0 * share - 1.0))
        pressed = self._button in keys if self._button is not None else bool(keys)
        return levers if pressed else None

    def close(self) -> None:
        """Let it go."""
        self._device.close()


def stick_of(facts: Facts) -> Joystick:
    """The joystick of a trial's motion.

    Raises:
        InputError: as `Joystick`."""
    axes = [axis for axis, _ in facts.levers.values()]
    return Joystick(facts.device, axes, facts.button)


def follow_stick(facts: Facts, put: Callable[[list[float] | None], None]) -> None:
    """Hand on what a joystick says, for ever; one that was unplugged is let go until it is there
    again."""
    while True:
        try:
            stick = stick_of(facts)
            while True:
                put(stick.read())
                time.sleep(0.01)
        except (OSError, InputError):
            put(None)
            time.sleep(0.5)
