"""One loop for every trial: sample → controller → limits → log → tick, whatever the machine and
whatever the controller.

A machine that can advance many rows in one compiled call does (`advance_of`), to the same bits."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ehbench.control.monitor import watched
from ehbench.data.record import Record
from ehbench.machines.protocol import (
    Machine,
    advance_of,
    applied_of,
    carry_of,
    ends_of,
    halt_of,
    hidden_of,
    in_real_time,
    packet_of,
    reason_of,
    stamp_of,
    truth_of,
)
from ehbench.machines.rows import (
    AGE,
    LIMITS,
    MACHINE,
    MISMATCH,
    MONITOR,
    Controls,
    LawRows,
    control,
    violated,
)
from ehbench.parts.sample import LineEntries
from ehbench.runtime.interrupts import unbroken
from ehbench.runtime.realtime import aside
from ehbench.trial.controllers import Compiled
from ehbench.trial.lever import LEVER_CHANNELS
from ehbench.trial.operator import Operator, OperatorInput, levers_of, refuse_unmanned
from ehbench.trial.preparation import RUN_OUT, Aftermath, Prepared, Stop
from ehbench.trial.user_code import UserCode
from ehbench.vocabulary import InputError, message, quantity, setting
from ehbench.vocabulary.codes import HOLD

if TYPE_CHECKING:
    from ehbench.data.logs import LogWriter


@dataclass(frozen=True)
class SessionSettings:
    """Numbers of the loop of a trial."""

    look: float = setting(0.1, "s", "standstill that ends a stopped trial", "the ramp is over")
    still: float = setting(5e-3, "m/s", "speed below which a machine stands", "sensor noise")
    patience: float = setting(20.0, "s", "wall time before a class's pace counts", "it may compile")
    longest: float = setting(36e3, "s", "wall time of a trial with a class", "ten hours")
    chunk: int = setting(1000, "ticks", "between progress reports", "a second at 1 kHz")
    wait: float = setting(0.4, "s", "until rows are logged, and between syncs", "twice it < 1 s")


SESSION = SessionSettings()
STAMPS = ("sample_time", "sample_sequence", "sample_age", "missed_ticks")
PACKETS = ("packet", "packet_sent", "packet_received", "packet_acknowledged")
# telemetry that is 0 after a stop, beside the edges' flows
DEMANDS = (
    *("v_desired", "a_desired", "j_desired", "v_shaped"),
    *("function_status", "limits", "feedback_flow"),
)


class Watcher(Protocol):
    """Who watches a trial, without holding it up."""

    def show(self, session: Session, row: int) -> None:
        """Take in a row that has just been logged."""
        ...


class Session:
    """A trial on a machine, which it starts, to its last row; arguments as in
    `ehbench.trial.run`.

    Raises:
        InputError: a posture that the machine cannot take; a limit reached before the start; a
            user's class that cannot be loaded."""

    def __init__(
        self,
        prepared: Prepared,
        machine: Machine,
        fast: bool = True,
        watcher: Watcher | None = None,
        operator: OperatorInput | None = None,
    ) -> None:
        refuse_unmanned(prepared, operator)
        self.prepared, self.machine, self.watcher = prepared, machine, watcher
        self._truth, self._hidden = truth_of(machine), hidden_of(machine)
        self._known = self._truth or self._hidden
        self.rows = prepared.first_rows(machine)
        measured, turns = self.rows.checks.measured, prepared.rig.mechanism.kind != "slide"
        self._logged = [
            (i, name)
            for i, name in enumerate(machine.channels)
            if measured[i] and (turns or not name.endswith((".q", ".qd")))
        ]
        self.gaps = np.zeros(len(machine.channels), dtype=int)  # samples that no log takes
        known = [quantity(name) for name in machine.channels]
        self._plausible = np.array([(row.lower, row.upper) for row in known]).T
        self.laws = prepared.law(machine)
        self.user_code = next((law for law in self.laws if isinstance(law, UserCode)), None)
        compiled = [law for law in self.laws if isinstance(law, Compiled)]
        self._refuse_blind(compiled, measured)
        for part in compiled:
            law = part.controller
            if law.monitor is not None:  # what it finds stops the trial
                alarm = self.rows.checks.alarms[law.axis.circuit.cylinder :][:1]
                part.controller = law._replace(monitor=law.monitor._replace(alarm=alarm))
        self._packed = packed(self.laws)
        self._step = None if self.user_code is None else self.user_code.step
        self._operator = None
        if operator is not None and levers_of(prepared):
            self._operator = Operator(operator, prepared, self.laws, self.rows.checks)
        self._bind = advance_of(machine) if fast and self._operator is None else None
        often = self._step is not None
        self._advance = None if self._bind is None else self._bind(self.rows, self._packed, often)
        self.stop: Stop | None = None
        self.after: Aftermath | None = None
        self.end = prepared.t.size
        self._halted, self._next_look = 0, sys.maxsize
        self._ticked = self._logged_rows = 0
        self._sent = machine.commands.rest.copy()  # the last command that the machine got
        stamp = stamp_of(machine)
        self.missed, self._real_time = 0.0, in_real_time(machine)
        self._packet = packet_of(machine)
        self._stamps = STAMPS + PACKETS if self._packet else STAMPS
        if self._real_time:
            self.rows = self.rows._replace(t=self.rows.t.copy())  # measured as samples come
        stamped = stamp is not None and self._bind is None
        self.stamps = np.zeros((prepared.t.size, len(self._stamps))) if stamped else None
        self._stretch = max(1, round(SESSION.look * machine.rate))

    def _refuse_blind(self, laws: list[Compiled], measured: np.ndarray) -> None:
        """Refuse a law that needs a channel for which the machine has no sensor."""
        for part in laws:
            needed = part.controller.observed
            if part.controller.monitor is not None:
                needed = needed | watched(part.controller.axis, needed.size)
            blind = np.flatnonzero(needed & ~measured)
            if blind.size:
                names = ", ".join(self.machine.channels[i] for i in blind)
                fields = {"law": part.law.name, "machine": self.machine.name, "channels": names}
                raise InputError(
                    message("trial.blind_law", **fields), **self.prepared.recipe.at("controller")
                )

    def run(
        self, log: LiveLog | None = None, progress: Callable[[str, float], None] | None = None
    ) -> None:
        """Run to the end, or after a limit until the machine stands, for RUN_OUT at most; ``stop``
        then says which limit, ``after`` what came of it, ``end`` how many rows there are. A log
        takes the rows as they come.

        Raises:
            SimulationError: the numbers left the finite range.
            InputError: a user's class raised, or gave no commands."""
        with nullcontext() if self.user_code is None else self.user_code.watched():
            try:
                self._run(log, progress)
            except BaseException as error:  # the valves go to rest by the recipe's ramp
                rest = self.machine.commands.rest
                ramp = round(float(self.prepared.recipe.limits.ramp) * self.machine.rate)
                if (halt := halt_of(self.machine)) is not None:
                    halt()
                with unbroken():
                    for share in np.minimum(np.arange(1.0, ramp + 2) / (ramp + 1), 1.0):
                        with suppress(Exception):  # one that fails still gets what follows
                            self.machine.tick((1.0 - share) * self._sent + share * rest)
                    if log is not None and self._ticked and not isinstance(error, OSError):
                        self._log(log, self._ticked)
                        log.break_off(float(self.rows.t[self._ticked - 1]))
                raise

    def _run(self, log: LiveLog | None, progress: Callable[[str, float], None] | None) -> None:
        first = 0
        if self.user_code is not None:
            self.user_code.start(self.rows.sample)
        begun = time.monotonic()
        while first < self.end:
            payloads, carry = self.prepared.payloads, carry_of(self.machine)
            if carry is not None and first in payloads:
                carry(payloads[first])
            change = min((row for row in payloads if row > first), default=sys.maxsize)
            until = min(first + SESSION.chunk, self._next_look, self.end, change)
            stopped_at, upto = self._through(first, until)
            if stopped_at >= 0:
                self._halt(stopped_at)
            self._log(log, upto)
            first = upto
            if first == self._next_look:
                self._look(first)
            slow = self._pace(first, time.monotonic() - begun)
            if progress is not None:
                progress(slow, first / self.end)

    def _log(self, log: LiveLog | None, upto: int) -> None:
        """Let a log take the rows since the last that it took."""
        first = self._logged_rows
        if self._truth is None:  # the value before, where a sensor gave no plausible number
            samples, (lowest, highest) = self.rows.samples, self._plausible
            part = samples[first:upto]
            gaps = self.rows.checks.measured & ~((lowest <= part) & (part <= highest))
            for i, j in zip(*np.nonzero(gaps), strict=True):
                samples[first + i, j] = samples[first + i - 1, j]
            self.gaps += gaps.sum(axis=0)
        if log is not None:
            log.add(self.rows.t[first:upto], self.channels(slice(first, upto)))
        self._logged_rows = upto

    def _pace(self, done: int, seconds: float) -> str:
        """Words on a class that is slow to answer; refuses one that would take for ever."""
        if self.user_code is None or seconds < SESSION.patience or done >= self.end:
            return ""
        remaining = (self.end - done) * seconds / done
        pace = {"label": self.user_code.label, "tick": seconds / done, "hours": remaining / 3600}
        slow = message("trial.slow_class", **pace)
        if remaining > SESSION.longest:
            raise InputError(slow, file=self.user_code.code.file)
        return slow if remaining > 60.0 else ""

    def _through(self, first: int, stop: int) -> tuple[int, int]:
        """Run rows from ``first`` on: the row at a limit, or −1, and the row up to which there are
        rows now: ``stop``, or sooner when ``wait`` is over."""
        if self._advance is not None and self._step is None:
            row = self._advance(first, stop)
            upto = stop if row < 0 else row
            if upto > first:
                self._sent = self.rows.commands[upto - 1].copy()
                if self.watcher is not None:
                    self.watcher.show(self, upto - 1)
            return row, upto
        rows, advance, step, packed = self.rows, self._advance, self._step, self._packed
        now, until = time.monotonic, time.monotonic() + SESSION.wait
        for i in range(first, stop):
            begun = now()
            over = self._operator is not None and self._operator.write(i)
            if step is not None:
                step(i, float(rows.t[i]), rows.sample, rows.commands[i])
            elif packed is not None:
                control(packed, i, rows)
            if self.stamps is not None and self._real_time:
                rows.checks.stamp[4] = now() - begun
            if self._tick(i) if advance is None else advance(i, i + 1) >= 0:
                return i, i
            if self.watcher is not None:
                self.watcher.show(self, i)
            if over:
                self.end = i + 1
            if over or now() > until:
                return -1, i + 1
        return -1, stop

    def _tick(self, i: int) -> bool:
        """Check row ``i``, log it and let its command act; whether it is at a limit instead."""
        rows = self.rows
        if violated(rows, i):
            return True
        rows.samples[i] = rows.sample
        if self._known is not None:
            self._known.read(rows.commands[i], rows.truth[i])
        if self.stamps is not None:
            if i >= len(self.stamps):
                self.stamps = np.concatenate([self.stamps, np.zeros_like(self.stamps)])
            self.stamps[i] = *rows.checks.stamp[:3], self.missed, *self._packet
        self._sent, self._ticked = rows.commands[i].copy(), i + 1
        rows.sample[:] = self.machine.tick(rows.commands[i])
        stamp, applied = stamp_of(self.machine), applied_of(self.machine)
        self._packet = packet_of(self.machine)
        if applied is not None:  # what it does not say, or cannot be, acted as given
            np.copyto(rows.commands[i], applied, where=quantity("command").holds(applied))
        if stamp is not None:
            step = stamp.sequence - rows.checks.stamp[1]
            self.missed = max(step - 1.0, 0.0)
            if self._real_time and i + 1 < rows.t.size:
                nominal = 1.0 / self.machine.rate
                measured = stamp.time if step > 0.0 else stamp.time + stamp.age
                rows.t[i + 1] = max(measured, rows.t[i] + 0.1 * nominal)
            rows.checks.stamp[:4] = stamp
        return False

    def _halt(self, row: int) -> None:
        """A limit was reached: valves to rest from this row on, by the recipe's ramp, the limits
        off, the controller silent."""
        self.stop = self.prepared.reached(self.machine, self.rows, row)
        if (halt := halt_of(self.machine)) is not None:
            halt()
        rate, rest = self.machine.rate, self.machine.commands.rest
        ramp = round(float(self.prepared.recipe.limits.ramp) * rate)
        self.end = row + 1 + ramp + round(RUN_OUT * rate)
        if (ends := ends_of(self.machine)) is not None:
            self.end = min(self.end, ends)
        more = max(self.end - self.rows.t.size, 0)
        tables = {
            name: np.concatenate([table[: self.end], np.zeros((more, *table.shape[1:]))])
            for name, table in self.rows._asdict().items()
            if name in ("commands", "samples", "truth")
        }
        t = np.arange(self.end) / rate
        t[: self.rows.t.size] = self.rows.t[: self.end]
        # pyrefly: ignore[bad-argument-type]
        self.rows = rows = self.rows._replace(t=t, **tables)
        rows.checks.armed[0] = False
        before = rows.commands[row - 1].copy() if row else rest
        share = np.minimum(np.arange(1.0, self.end - row + 1) / (ramp + 1), 1.0)[:, None]
        shut = np.where(self.prepared.shut_at_once(self.stop, before), 1.0, share)
        rows.commands[row:] = (1.0 - shut) * before + shut * rest
        self._halted, self._next_look = row, min(row + 1 + ramp + self._stretch, self.end)
        (lowest, highest), sample = self._plausible, rows.sample
        sound = ((lowest <= sample) & (sample <= highest) | ~rows.checks.measured).all()
        for law in self.laws:
            # the last estimates and the desired stroke stay, nothing is asked for any more
            last = min(row, len(law.telemetry) - 1)
            retained, known = law.telemetry[last], law.telemetry[max(last - 1, 0)]
            retained = np.where(np.isfinite(retained) & sound, retained, known)
            after = np.tile(retained, (self.end - row, 1))
            law.telemetry = np.concatenate([law.telemetry[:row], after])
            for column, name in enumerate(law.channels):
                word = name.rsplit(".", 1)[-1]
                if word in DEMANDS or word.startswith("flow"):
                    law.telemetry[row:, column] = 0.0
                elif word == "function":
                    law.telemetry[row:, column] = HOLD
        self._packed = self._step = self._operator = None
        if self._bind is not None:
            self._advance = self._bind(rows, None, False)

    def _look(self, row: int) -> None:
        """Whether the machine stood all the time since the look before: then the trial ends."""
        stretch = self.rows.samples[row - self._stretch : row]
        speeds = [i for i, name in enumerate(self.machine.channels) if name.endswith(".v")]
        still = bool((np.abs(stretch[:, speeds]) < SESSION.still).all())
        late = self.rows.checks.stamp[2] > self.rows.limits[AGE]
        doubting = (LIMITS[MISMATCH], LIMITS[MONITOR])  # one of two positions is wrong
        stop = self.stop
        doubted = stop is not None and stop.limit in doubting and stop.channel.endswith(".x")
        if stop is not None and stop.limit == LIMITS[MACHINE]:
            doubted = reason_of(self.machine, int(stop.value)) == "frozen"
        sound = bool(np.isfinite(self.rows.sample[speeds]).all()) and not late and not doubted
        sound &= row > self._halted
        begun = float(self.rows.t[min(self._halted, row - 1)])
        waited = float(self.rows.t[row - 1]) - begun  # a silent link's rows last longer than a tick
        if still and sound or waited > RUN_OUT + float(self.prepared.recipe.limits.ramp):
            self.end = row
        self._next_look = min(row + self._stretch, self.end)
        if row == self.end:
            span = slice(min(self._halted, self.end - 1), self.end)
            known = still if sound else None
            self.after = self.prepared.aftermath(self.machine, self.rows, span, known)

    def telemetry(self, row: int) -> list[np.ndarray]:
        """A row of each controller's telemetry."""
        return [part.telemetry[row] for part in self.laws]

    @property
    def true_strokes(self) -> np.ndarray | None:
        """Strokes [m] as they are, shape (rows, cylinders), of a machine that keeps them from its
        log."""
        return None if self._hidden is None else self.rows.truth[: self.end]

    def channels(self, part: slice) -> dict[str, np.ndarray]:
        """Rows of the trial by channel, SI: what the machine measured, or all that a simulation
        knows; commands; the controller's telemetry."""
        rows, commands = self.rows, self.rows.commands[part]
        if self._truth is not None:
            channels = self._truth.channels(rows.t[part], commands, rows.truth[part])
        else:
            samples = rows.samples[part]
            channels = {name: samples[:, i].copy() for i, name in self._logged}
            lines = {name: channels.pop(name) for name in LineEntries._fields if name in channels}
            valves = self.machine.commands.names
            channels |= {f"{name}.command": commands[:, i].copy() for i, name in enumerate(valves)}
            channels |= lines
        if self.stamps is not None:
            stamps = self.stamps[part]
            channels |= {name: stamps[:, i].copy() for i, name in enumerate(self._stamps)}
        for law in self.laws:
            telemetry = law.telemetry[part]
            channels |= {name: telemetry[:, i] for i, name in enumerate(law.channels)}
        for item in () if self.prepared.loop is None else self.prepared.loop.driven:
            if item.references.lever is not None:
                levers = np.zeros((len(commands), len(LEVER_CHANNELS)))
                inputs = item.references.inputs[part]
                levers[: len(inputs)] = inputs
                channels |= {
                    f"{item.cylinder}.{n}": levers[:, i] for i, n in enumerate(LEVER_CHANNELS)
                }
        plan = None if self.prepared.loop is None else self.prepared.loop.plan
        return channels if plan is None else channels | plan.channels(part, channels)


class LiveLog:
    """The log of a running trial: what came until less than a second ago can be read, however the
    process ends. The facts in ``meta`` are those that are known; ``threaded``, a thread writes,
    and the trial does not wait for the disk."""

    def __init__(
        self,
        path: Path,
        channels: list[str],
        meta: dict[str, str],
        attachments: dict[str, bytes],
        threaded: bool = False,
    ) -> None:
        from ehbench.data.logs import LogWriter

        self.path, self.meta, self.attachments = path, meta, attachments
        self.writer: LogWriter = LogWriter(path, channels, meta, attachments, sync=SESSION.wait)
        self._pool = ThreadPoolExecutor(1, initializer=aside) if threaded else None
        self._writing: Future[None] | None = None

    def add(self, t: np.ndarray, channels: dict[str, np.ndarray]) -> None:
        """Append rows.

        Raises:
            OSError: the disk is full, perhaps since the rows before."""
        rows = np.stack(list(channels.values()), axis=1)
        if self._pool is None:
            return self.writer.extend(t, rows)
        if self._writing is not None and self._writing.done():
            self._writing.result()
        self._writing = self._pool.submit(self.writer.extend, t.copy(), rows)

    def break_off(self, t: float) -> None:
        """Say in the log that it ends at ``t`` [s] because its trial was broken off."""
        lose, text = self.writer.lose, message("trial.broken_off", t=t)
        if self._pool is None:
            lose(text)
        else:
            self._pool.submit(lose, text)

    def finish(self, record: Record) -> None:
        """Close the log of a trial that came to its end. Its bytes hang on ``record`` alone: a log
        that a sync cut into chunks, or whose facts have changed since, is written once more."""
        from ehbench.data.logs import write_log

        self.close()
        if self._writing is not None:
            self._writing.result()
        if self.writer.cut or dict(record.meta) != self.meta or self._pool is not None:
            write_log(
                self.path,
                Record(record.t, record.channels, record.meta, self.attachments, record.losses),
            )

    def close(self) -> None:
        """Close what was written as it stands."""
        if self._pool is not None:
            self._pool.shutdown()
        self.writer.close()


def packed(laws: Sequence[Compiled | UserCode]) -> Controls | None:
    """Built-in controllers as compiled code takes them; None without, or for a user's class."""
    built_in = [law for law in laws if isinstance(law, Compiled)]
    rows = (LawRows(law.references, law.controller, law.telemetry) for law in built_in)
    return tuple(rows) if built_in else None
