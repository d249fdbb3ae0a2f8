"""A model or a virtual bench as a target of its own: the reference for what a rig must do."""

import socket
import struct
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from ehbench.config.recipe import Fault
from ehbench.links.layout import REFERENCES, Layout
from ehbench.links.quality import QUALITY
from ehbench.links.responder import RUNNING, STOPPED, Target
from ehbench.links.transport import ACKNOWLEDGED, LARGEST, SEQUENCE, VirtualClock
from ehbench.machines.faults import FaultyMachine
from ehbench.machines.rows import LawRows, control
from ehbench.parts.sample import OF, entry
from ehbench.trial.controllers import Compiled
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary import SimulationError

LINK_FAULTS = ("link_lost", "link_delayed", "link_reordered")  # those of packets


class Served:
    """A simulated machine as a target ticks it."""

    ahead = True

    def __init__(self, prepared: Prepared) -> None:
        self.prepared, self.machine = prepared, prepared.machine
        self.reset()
        self.tick(self.follow([0.0] * len(REFERENCES) * len(self.machine.strokes)))  # compile now
        self.reset()

    def reset(self) -> None:
        """Stand where the trial begins, valves and controllers at rest."""
        self._rows = self.prepared.first_rows(self.machine, 2)
        self._laws = tuple(
            LawRows(law.references[:2] * 0.0, law.controller, law.telemetry[:2])
            for law in self.prepared.law(self.machine)
            if isinstance(law, Compiled)
        )
        self._sample = self._rows.sample.copy()
        self._given, self._since = [], 0

    def tick(self, commands: list[float]) -> list[float]:
        """What the sensors say; not a number where the machine's own numbers left their range."""
        try:
            self._sample = self.machine.tick(np.array(commands))
        except SimulationError:
            self._sample = np.full_like(self._sample, np.nan)
        return self._sample.tolist()

    def follow(self, references: list[float]) -> list[float]:
        """Commands [V] of the recipe's laws towards x, v, a desired of each cylinder, which go on
        as they say until the next come."""
        rows, setpoints = self._rows, np.reshape(references, (len(self.machine.strokes), -1))
        self._since = self._since + 1 if references == self._given else 0
        self._given, t = references, self._since / self.machine.rate
        x, v, a = setpoints.T
        setpoints = np.column_stack([x + t * (v + 0.5 * t * a), v + t * a, a])
        loop = self.prepared.loop
        for law, item in zip(self._laws, () if loop is None else loop.driven, strict=False):
            row = setpoints[item.design.index]
            law.references[0, : row.size] = row
        rows.sample[:] = self._sample
        control(self._laws, 0, rows)
        return rows.commands[0].tolist()


class ServedTarget(Target):
    """A target that serves a prepared trial's machine in all modes, with faults of its link.

    A table that was uploaded in mode ``buffered`` runs by the target's clock; afterwards a row of
    its log goes out in place of a sample for each that the host asks for.

    Args:
        prepared: the trial whose machine is served, whose posture it stands in and whose laws close
            the loop in mode ``setpoint``.
        faults: of the link.
        watchdog: time [s] without a command after which it stops; None for 20 ms, or the few
            samples that a sound link needs if these take longer."""

    def __init__(
        self, prepared: Prepared, faults: Sequence[Fault] = (), watchdog: float | None = None
    ) -> None:

        def following(values: list[float]) -> list[float]:
            """The commands of the table's next row; after the last it is done."""
            if (row := self._table.get(len(self._log))) is None:
                self.stop(1)
                row = self.applied
            return row

        layout, self.served = Layout.of(prepared.rig), Served(prepared)
        count = len(layout.commands.names)
        self._buffered = layout.number("buffered")
        modes = {
            layout.number("stream"): (count, list),
            layout.number("setpoint"): (len(layout.references), self.served.follow),
            self._buffered: (count + 1, following),
        }
        limits, peak = [], prepared.recipe.limits.pressure_max
        for c, stroke in enumerate(self.served.machine.strokes.tolist()):
            limits += [(entry(c, OF.x), 0.0, stroke)]
            if peak is not None:  # the host's limit comes first
                limits += [(entry(c, p), -np.inf, 1.2 * float(peak)) for p in (OF.p_head, OF.p_rod)]
        ramp, rate = float(prepared.recipe.limits.ramp), self.served.machine.rate
        watchdog = watchdog or max(0.02, QUALITY.samples / rate)
        super().__init__(self.served, layout.clamps(), modes, rate, watchdog, ramp, limits)
        self.faults, self._late, self._held = faults, deque[tuple[int, bytes]](), b""
        self._table: dict[int, list[float]] = {}
        self._log: list[bytes] = []
        self._asked, self._began, self._ran = -1, 0, False

    def receive(self, datagram: bytes, now: float) -> bool:
        """As `Target.receive`."""
        before = self.token
        if self._fails("link_lost") is not None or not super().receive(datagram, now):
            return False
        if self.token != before:
            self._table, self._log, self._began = {}, [], self.sequence
        row, *commands = struct.unpack_from(f"<{len(datagram) // 8}d", datagram)[8:] or (-1.0,)
        if self.layout == self._buffered and commands:
            self._asked = int(row)
            if self.state < RUNNING:
                self._table[int(row)] = commands
        return True

    def _fails(self, kind: str) -> Fault | None:
        """The fault of a kind that acts now, in time since the valves could first move."""
        t = (self.sequence - self._began) / self.rate
        for fault in self.faults:
            ends = np.inf if fault.stop is None else float(fault.stop)
            if fault.kind == kind and float(fault.start) <= t < ends:
                return fault
        return None

    def tick(self, now: float) -> bytes:
        """As `Target.tick`; b"" where the link loses it."""
        if self.state <= RUNNING:
            self._ran = self.state == RUNNING
        if not self._ran:  # nor in a session that ends before
            self._began = self.sequence
            if isinstance(self.served.machine, FaultyMachine):
                self.served.machine.begin()
        running = self.state == RUNNING
        datagram = super().tick(now)
        if running and self.layout == self._buffered:
            self._log.append(datagram)
        if self.state == STOPPED and 0 <= self._asked < len(self._log):
            past = np.frombuffer(self._log[self._asked]).copy()  # as the answer to this packet
            now_at = [SEQUENCE, ACKNOWLEDGED]
            past[now_at] = np.frombuffer(datagram)[now_at]
            datagram = past.tobytes()
        return self._sent(datagram)

    def _sent(self, datagram: bytes) -> bytes:
        if self._fails("link_reordered") is not None:
            if self.sequence % 2:  # it comes behind the next, which is newer
                self._held, datagram = datagram, self._held
            return datagram
        late = self._fails("link_delayed")
        due = self.sequence + (round(float(late.duration) * self.rate) if late else 0)
        self._late.append((due, datagram))
        newest = b""
        for due, item in list(self._late):
            if due <= self.sequence:
                newest = item
                while self._late[0][1] is not item:
                    self._late.popleft()
        if newest:
            self._late.popleft()
        return b"" if self._fails("link_lost") is not None else newest


def serve_virtual(target: Target, port: int, host: str, ready: Callable[[], None]) -> None:
    """Answer each datagram after one tick, on the virtual clock of its host; ``ready`` is called
    when it can."""
    clock = VirtualClock(target)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((host, port))
        ready()
        while True:
            datagram, sender = link.recvfrom(LARGEST)
            link.sendto(clock.answer(datagram), sender)
