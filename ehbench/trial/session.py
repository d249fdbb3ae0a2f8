"""One loop for every trial: sample → controller → limits → log → tick, whatever the machine and
whatever the controller.

A machine that can advance many rows in one compiled call does (`advance_of`), to the same bits."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ehbench.codes import HOLD
from ehbench.errors import SimulationError
from ehbench.machines.protocol import Machine, advance_of, truth_of
from ehbench.machines.rows import NO_LIMITS, LawRows, control, violated
from ehbench.record import Record
from ehbench.trial.controllers import Compiled
from ehbench.trial.preparation import Prepared, Stop
from ehbench.trial.user_code import UserCode

if TYPE_CHECKING:
    from ehbench.logs import LogWriter

RUN_OUT = 0.3  # [s] logged after a stop, valves at rest
CHUNK = 1000  # ticks between two reports of progress
WAIT = 0.2  # [s] of wall time after which rows go to the log, however few
SYNC = 0.7  # [s] of wall time between two syncs of the log: with WAIT, less than a second is lost
# telemetry that is 0 after a stop, beside the edges' flows
DEMANDS = (
    *("v_desired", "a_desired", "j_desired", "v_shaped"),
    *("function_status", "limits", "feedback_flow"),
)


class Session:
    """A trial on a machine, from its start to its last row.

    Args:
        prepared: the trial.
        machine: that it runs on; the session starts it.
        fast: advance many rows at a time where the machine can.

    Raises:
        InputError: a posture that the machine cannot take; a limit reached before the start; a
            user's class that cannot be loaded.
    """

    def __init__(self, prepared: Prepared, machine: Machine, fast: bool = True) -> None:
        self.prepared, self.machine = prepared, machine
        self._truth = truth_of(machine)
        self.rows = prepared.first_rows(machine)
        self.law = prepared.law(machine)
        self._packed = None if self.law is None else _packed(self.law)
        self._step = getattr(self.law, "step", None)
        self._bind = advance_of(machine) if fast else None
        often = self._step is not None
        self._advance = None if self._bind is None else self._bind(self.rows, self._packed, often)
        self.stop: Stop | None = None
        self.end = prepared.t.size

    def run(
        self,
        log: LiveLog | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> None:
        """Run to the end, or to RUN_OUT after a limit; ``stop`` then says which, ``end`` how many
        rows there are.

        Args:
            log: takes the rows as they come.
            progress: told the share done, from 0 to 1.

        Raises:
            SimulationError: the numbers left the finite range.
            InputError: a user's class raised, or gave no commands.
        """
        first, rate = 0, self.machine.rate
        if isinstance(self.law, UserCode):
            self.law.start(self.rows.sample)
        while first < self.end:
            stopped_at, upto = self._through(first, min(first + CHUNK, self.end))
            if not np.isfinite(self.rows.sample).all():
                raise SimulationError(
                    f"the trial left finite numbers before t = {upto / rate:.4g} s",
                    hint="take a smaller step",
                )
            if stopped_at >= 0:
                self._halt(stopped_at)
            if log is not None:
                log.add(self.rows.t[first:upto], self.channels(slice(first, upto)))
            first = upto
            if progress is not None:
                progress("", first / self.end)

    def _through(self, first: int, stop: int) -> tuple[int, int]:
        """Run rows from ``first`` on: the row at a limit, or −1, and the row up to which there are
        rows now: ``stop``, or sooner when WAIT is over.
        """
        if self._advance is not None and self._step is None:
            row = self._advance(first, stop)
            return row, stop if row < 0 else row
        rows, advance, step, packed = self.rows, self._advance, self._step, self._packed
        now, until = time.monotonic, time.monotonic() + WAIT
        for i, t in enumerate(rows.t[first:stop].tolist(), first):
            if step is not None:
                step(i, t, rows.sample, rows.commands[i])
            elif packed is not None:
                control(packed, i, rows)
            if self._tick(i) if advance is None else advance(i, i + 1) >= 0:
                return i, i
            if now() > until:
                return -1, i + 1
        return -1, stop

    def _tick(self, i: int) -> bool:
        """Check row ``i``, log it and let its command act; whether it is at a limit instead."""
        rows = self.rows
        if violated(rows, i):
            return True
        rows.samples[i] = rows.sample
        if self._truth is not None:
            self._truth.read(rows.commands[i], rows.truth[i])
        rows.sample[:] = self.machine.tick(rows.commands[i])
        return False

    def _halt(self, row: int) -> None:
        """A limit was reached: valves to rest from this row on, the limits off, the controller
        silent.
        """
        rows = self.rows
        self.stop = self.prepared.reached(self.machine, rows, row)
        rows.limits[:] = NO_LIMITS
        self.end = min(self.end, row + 1 + round(RUN_OUT * self.machine.rate))
        rows.commands[row:] = self.machine.commands.rest
        if self.law is not None:
            _let_go(self.law, row, self.end)
        self._packed = self._step = None
        if self._bind is not None:
            self._advance = self._bind(rows, None, False)

    def channels(self, part: slice) -> dict[str, np.ndarray]:
        """Rows of the trial by channel, SI: what the machine measured, or all that a simulation
        knows; commands; the controller's telemetry.
        """
        rows, commands = self.rows, self.rows.commands[part]
        if self._truth is not None:
            channels = self._truth.channels(rows.t[part], commands, rows.truth[part])
        else:
            samples = rows.samples[part]
            channels = {name: samples[:, i].copy() for i, name in enumerate(self.machine.channels)}
            lines = {name: channels.pop(name) for name in ("p_supply", "p_tank")}
            valves = self.machine.commands.names
            channels |= {f"{name}.command": commands[:, i].copy() for i, name in enumerate(valves)}
            channels |= lines
        if self.law is not None:
            telemetry = self.law.telemetry[part]
            channels |= {name: telemetry[:, i] for i, name in enumerate(self.law.channels)}
        return channels


class LiveLog:
    """The log of a running trial: what came until less than a second ago can be read, however the
    process ends.

    Args:
        path: of the log.
        channels: names, in the order of the log.
        meta: the run's facts, as far as they are known.
        attachments: files that travel with the log.
    """

    def __init__(
        self, path: Path, channels: list[str], meta: dict[str, str], attachments: dict[str, bytes]
    ) -> None:
        from ehbench.logs import LogWriter

        self.path, self.meta, self.attachments = path, meta, attachments
        self.writer: LogWriter = LogWriter(path, channels, meta, attachments, sync=SYNC)

    def add(self, t: np.ndarray, channels: dict[str, np.ndarray]) -> None:
        """Append rows."""
        self.writer.extend(t, np.stack(list(channels.values()), axis=1))

    def finish(self, record: Record) -> None:
        """Close the log of a trial that came to its end. Its bytes hang on ``record`` alone: a log
        that a sync cut into chunks, or whose facts have changed since, is written once more.
        """
        from ehbench.logs import write_log

        self.writer.close()
        if self.writer.cut or dict(record.meta) != self.meta:
            write_log(
                self.path,
                Record(record.t, record.channels, record.meta, self.attachments, record.losses),
            )

    def close(self) -> None:
        """Close what was written as it stands."""
        self.writer.close()


def _packed(law: Compiled | UserCode) -> LawRows | None:
    """A built-in controller as compiled code takes it; None for a class that steps in Python."""
    if isinstance(law, UserCode):
        return None
    return LawRows(law.references, law.controller, law.telemetry)


def _let_go(law: Compiled | UserCode, row: int, end: int) -> None:
    """Telemetry after a stop: the last estimates and the desired stroke stay, nothing is asked for
    any more.
    """
    law.telemetry[row:end] = law.telemetry[row]
    for column, name in enumerate(law.channels):
        word = name.rsplit(".", 1)[-1]
        if word in DEMANDS or word.startswith("flow"):
            law.telemetry[row:end, column] = 0.0
        elif word == "function":
            law.telemetry[row:end, column] = HOLD
