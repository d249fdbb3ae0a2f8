"""The live view of a trial as the trial sees it.

A trial copies a row of numbers into shared memory: it never waits for the view, and a view that
ends changes nothing."""

import json
import math
import mmap
import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from tempfile import TemporaryFile

import numpy as np

from ehbench.live import board
from ehbench.live.joystick import stick_of
from ehbench.machines.rows import LIMITS
from ehbench.trial.operator import levers_of
from ehbench.trial.preparation import Prepared
from ehbench.trial.session import Session
from ehbench.vocabulary import VOCABULARY, from_si

SHOWN = ("x", "v", "p_head", "p_rod", "command", "following_error")  # words with a unit of a view


def facts_of(prepared: Prepared) -> board.Facts:
    """What there is to know of a prepared trial."""
    rig, recipe, machine = prepared.rig, prepared.recipe, prepared.machine
    units = {}
    for word in SHOWN:
        unit = rig.unit_of(word)
        units[word] = (unit, float(from_si(1.0, unit, VOCABULARY[word])))
    limits = zip(LIMITS, prepared.limits.tolist(), strict=True)
    cylinders = [item.name for item in rig.cylinder]
    checks = prepared.checks(machine, 1)
    follows = np.isfinite(checks.desired[0])
    bounds = np.where(follows, checks.following, np.inf).tolist()
    levers, motion = levers_of(prepared), recipe.motion
    return board.Facts(
        recipe.title or recipe.path.stem,
        recipe.on,
        prepared.duration,
        machine.rate,
        (
            *machine.channels,
            *(f"{name}.command" for name in machine.commands.names),
            *prepared.telemetry,
        ),
        units,
        LIMITS,
        {name: bound for name, bound in limits if math.isfinite(bound)},
        dict(zip(cylinders, bounds, strict=True)),
        dict(zip(cylinders, machine.strokes.tolist(), strict=True)),
        float(rig.supply.pressure),
        {name: (lever.axis, lever.speed * units["v"][1]) for name, lever in levers.items()},
        "" if motion is None else motion.device,
        "" if motion is None else motion.button,
    )


class View:
    """The live view of a trial as the trial sees it: a process of its own draws a page on loopback,
    and the terminal.

    Args:
        prepared: the trial.
        announce: gets the address of the page; says whether the view may draw on the terminal.

    Raises:
        InputError: the joystick of its motion is not there."""

    def __init__(self, prepared: Prepared, announce: Callable[[str], bool]) -> None:
        facts = facts_of(prepared)
        if facts.levers and facts.device != board.PAGE:
            stick_of(facts).close()
        self._gaps, size = 0.0, 8 * (facts.first_lever + board.LEVERS + len(facts.levers))
        token = secrets.token_urlsafe(12)
        with socket.create_server((board.HOST, 0)) as door, TemporaryFile() as memory:
            memory.truncate(size)
            self.numbers = np.frombuffer(mmap.mmap(memory.fileno(), size))
            self._inputs = self.numbers[facts.first_lever :]
            self.url = f"http://{board.HOST}:{door.getsockname()[1]}/{token}/"
            files = memory.fileno(), door.fileno()
            given = [*files, token, announce(self.url), os.getpid(), asdict(facts)]
            self.process = subprocess.Popen(
                [sys.executable, "-m", "ehbench.live.viewer", json.dumps(given)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=files,
                start_new_session=True,  # signals of the terminal are the trial's
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )

    def show(self, session: Session, row: int) -> None:
        """As `Watcher.show`."""
        numbers, rows, machine = self.numbers, session.rows, session.machine
        self._gaps += session.missed
        numbers[board.TIME] = rows.t[row]
        numbers[board.LATE] = self._gaps + getattr(machine, "missed", 0)
        first, end = board.FIRST, numbers.size - self._inputs.size
        for values in (rows.samples[row], rows.commands[row], *session.telemetry(row)):
            last = min(first + values.size, end)  # notes of a class stay away
            numbers[first:last] = values[: last - first]
            first = last
        if session.stop is not None:
            numbers[board.LIMIT] = LIMITS.index(session.stop.limit)
        numbers[board.STATE] = board.RUNNING if session.stop is None else board.STOPPING

    def read(self) -> list[float] | None:
        """As `OperatorInput.read`."""
        inputs = self._inputs
        silent = time.monotonic() - inputs[board.HEARD] > board.VIEW.silence
        return None if silent or not inputs[board.HELD] else inputs[board.LEVERS :].tolist()

    def close(self) -> None:
        """End the view."""
        self.numbers[board.STATE] = board.ENDED
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(board.VIEW.end)
        self.process.kill()
        self.process.wait()
