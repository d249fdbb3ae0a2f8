"""Machines that play a whole table of commands by their own clock and then give their log: enough
for every open-loop test."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ehbench.links.client import LINK, LinkMachine, refuse_other_supply
from ehbench.links.responder import (
    ALIVE,
    ARMED,
    DISAGREEMENT,
    DONE,
    REASONS,
    RUNNING,
    STOPPED,
    STOPPING,
)
from ehbench.links.transport import ACKNOWLEDGED, REASON, STATE
from ehbench.machines.protocol import Advance, Inputs, Posture
from ehbench.machines.rows import Controls, Rows, violated
from ehbench.plant.trim import LowSide
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary import InputError, message, quantity

STOPPED_BY = 3  # where the stamp of a row's checks has the machine's reason


class Played(NamedTuple):
    """What a machine says of a table: the ``samples`` after each row, the commands that were
    ``applied`` [V] in it, both as long as it ran, and the number of the reason for which they end
    before the table."""

    samples: np.ndarray
    applied: np.ndarray
    reason: int = DISAGREEMENT


class Buffered:
    """The rows of a trial from a machine that has played them. The host's limits look at the log
    afterwards; while it plays, only the machine's own stop it."""

    _played: Played | None = None

    @property
    def ends(self) -> int | None:
        """As `ends_of` says."""
        return None if self._played is None else len(self._played.samples)

    def play(self, table: np.ndarray) -> Played:
        """Play commands [V], shape (rows, valves)."""
        raise NotImplementedError

    def advance(self, rows: Rows, law: Controls | None, often: bool) -> Advance:
        """As `advance_of` says; the table is played when the first row is asked for."""

        def through(first: int, stop: int) -> int:
            played = self._played
            if played is None:
                played = self._played = self.play(rows.commands.copy())
            last = len(played.samples)
            for i in range(first, stop):
                if i == last:
                    rows.checks.stamp[STOPPED_BY] = played.reason
                if violated(rows, i):
                    return i
                rows.samples[i] = rows.sample
                rows.sample[:], acted = played.samples[i], played.applied[i]
                np.copyto(rows.commands[i], acted, where=quantity("command").holds(acted))
            return -1

        return through


def refuse_loop(prepared: Prepared) -> None:
    """Refuse a trial whose commands are not known before.

    Raises:
        InputError: it has a controller.
    """
    if prepared.loop is not None:
        raise InputError(message("links.buffered_loop"), **prepared.recipe.at("controller"))


class BufferedLink(Buffered, LinkMachine):
    """A target at the other end of a link in mode ``buffered``."""

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`; it is armed when it plays.

        Raises:
            InputError: as `LinkMachine.start`; a closed loop.
        """
        refuse_loop(self.prepared)
        expected = self.reach(posture, low_side)
        refuse_other_supply(self, self.prepared.rig, expected, self.sample())
        self._played = None
        return self.sample()

    def play(self, table: np.ndarray) -> Played:
        """As `Buffered.play`: upload, arm, run, download.

        Raises:
            InputError: the target does not take a row, arm or answer.
        """
        for row, command in enumerate(table):
            first = self.sequence + 1
            self._until(ALIVE, row, command, lambda: self.newest[ACKNOWLEDGED] >= first)  # noqa: B023
        rest = self.commands.rest
        self._until(ARMED, -1, rest, lambda: self.state >= ARMED)
        end = len(table) / self.rate
        self._until(RUNNING, -1, rest, lambda: self.state > RUNNING, end)
        self._until(STOPPING, -1, rest, lambda: self.state == STOPPED)
        # then its log, row by row, which says nothing of the link
        before = self.exchanges.copy(), self.newest, self.missed
        rows, requests, log = len(table), {}, {}
        missing, until = dict.fromkeys(range(rows)), self.now() + LINK.patience + 3.0 * end
        while missing and self.now() < until:
            row = next(iter(missing))
            missing[row] = missing.pop(row)  # behind the others, should its answer be lost
            requests[self.sequence + 1] = row
            self.exchange(STOPPING, np.array([row, *rest]))
            row = requests.get(int(self.newest[ACKNOWLEDGED]), rows)
            if row in missing and self.newest[STATE] != STOPPED:
                log[row] = (self.sample(), self.newest[-len(rest) :].copy())
                del missing[row]
            elif row in missing:  # it was stopped before
                missing = {item: None for item in missing if item < row}
        count = next((row for row in range(rows) if row not in log), rows)
        if count == 0:
            raise InputError(message("links.no_log", url=self.name))
        samples, applied = (np.array([log[row][k] for row in range(count)]) for k in (0, 1))
        self.exchanges, self.newest, self.missed = before
        reason = int(self.newest[REASON])
        return Played(samples, applied, reason if reason > DONE else DISAGREEMENT)

    def _until(
        self, wish: int, row: int, command: np.ndarray, done: Callable[[], bool], seconds=0.0
    ) -> None:
        """Wish something, with a row of the table, until it is done."""
        until = self.now() + LINK.patience + seconds
        while not done():
            self.exchange(wish, np.array([row, *command]))
            self.refuse_unarmed(self.now() > until or (self.state == STOPPED and wish < RUNNING))


class Card(Protocol):
    """An interface card with a clock for outputs and inputs together."""

    def play(self, table: np.ndarray, rate: float) -> np.ndarray:
        """Put out a table of volts, shape (rows, outputs); the volts that came in."""
        ...

    def close(self) -> None:
        """Let it go, outputs at rest."""
        ...


class CardMachine(Buffered):
    """An interface card behind the protocol of a machine; it has no watchdog.

    Args:
        prepared: the trial.
        card: that plays.
        scales: (factor, offset) from volts to SI of each input, nan of a channel without sensor,
            and from commands [V] to volts of each output.
        name: of the card, for logs."""

    latency, reasons = 0.0, REASONS

    def __init__(
        self, prepared: Prepared, card: Card, scales: tuple[np.ndarray, np.ndarray], name: str
    ) -> None:
        design = prepared.machine
        self.prepared, self.card, self.name = prepared, card, name
        self.channels, self.strokes, self.rate = design.channels, design.strokes, design.rate
        self.commands: Inputs = design.commands
        self._inputs, self._outputs = scales
        empty = np.flatnonzero(np.isnan(self._inputs[:, 0]))
        self.unmeasured = tuple(self.channels[i] for i in empty)

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`."""
        self.prepared.machine.check_posture(posture)

    def _played_volts(self, commands: np.ndarray) -> np.ndarray:
        clamped = np.clip(commands, self.commands.lowest, self.commands.highest)
        volts = self._outputs[:, 0] * clamped + self._outputs[:, 1]
        there = np.isfinite(self._inputs[:, 0])
        samples = np.full((len(volts), len(self.channels)), np.nan)
        scale, offset = self._inputs[there].T
        samples[:, there] = scale * self.card.play(volts, self.rate) + offset
        return samples

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`: ten rows at rest.

        Raises:
            InputError: a closed loop.
        """
        refuse_loop(self.prepared)
        self._played = None
        sample = self._played_volts(np.tile(self.commands.rest, (10, 1)))[-1]
        refuse_other_supply(self, self.prepared.rig, self.prepared.machine.start(posture), sample)
        return sample

    def play(self, table: np.ndarray) -> Played:
        """As `Buffered.play`; the last row is rest."""
        whole = np.vstack([table, self.commands.rest])
        return Played(self._played_volts(whole)[1:], table)

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`: one row."""
        return self._played_volts(np.tile(command, (2, 1)))[-1]

    def close(self) -> None:
        """As `Machine.close`."""
        self.card.close()
