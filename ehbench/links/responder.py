"""A target in Python: copy it to the rig's computer and fill in `Rig`; it needs Python alone.

A datagram is a vector of little-endian float64: HEADER, then values as ``ehbench wire`` says."""

import math
import socket
import struct
import time
from collections import Counter

HEADER = ("layout", "token", "sequence", "time", "acknowledged", "state", "reason", "watchdog")
IDLE, ALIVE, ARMED, RUNNING, STOPPING, STOPPED = range(6)
BUSY = (ARMED, RUNNING, STOPPING)
REASONS = ("none", "done", "host", "watchdog", "not_finite", "disagreement", "limit")
NONE, DONE, HOST, WATCHDOG, NOT_FINITE, DISAGREEMENT, LIMIT = range(7)
# a host's wishes by state; anything else is a disagreement
WISHES = {IDLE: (ALIVE,), ALIVE: (ALIVE, ARMED), ARMED: (ARMED, RUNNING), RUNNING: (RUNNING,)}
QUIET, PATIENCE = 0.5, 1.0  # [s] without a gap before it arms; of silence before it lets go


class Target:
    """The states of a target without its socket: `receive` datagrams, `tick` once a period.

    ``machine`` as `Rig`; ``commands`` (lowest, highest, rest [V], largest change [V/s]) of each
    valve; ``modes`` by layout: how many values a datagram has, what makes commands of them;
    ``rate`` [Hz]; ``watchdog``, ``ramp`` [s]; ``limits`` (index of a value, lowest, highest)."""

    def __init__(self, machine, commands, modes, rate, watchdog=0.02, ramp=0.05, limits=()):  # noqa: PLR0913
        self.machine, self.commands, self.modes, self.rate = machine, commands, modes, rate
        self.watchdog, self.ramp, self.limits, self.rejected = watchdog, ramp, limits, Counter()
        self.layout, self.state, self.reason, self.used = next(iter(modes)), IDLE, NONE, set()
        self.heard = self.gapless = 0.0  # [s] of the last datagram; since when without a gap
        self.token = self.sequence = self.acknowledged = self.ramped = 0
        self.values, self.applied = [], [rest for _, _, rest, _ in commands]

    def receive(self, datagram, now):
        """Take a datagram at ``now`` [s]; whether it counts."""
        if problem := self._problem(datagram):
            self.rejected[problem] += 1
            return False
        numbers = struct.unpack(f"<{len(datagram) // 8}d", datagram)
        layout, token, sequence, _, _, wish, reason, _ = map(int, numbers[:8])
        if token != self.token:  # a new session; it ends a stop
            self.used.add(self.token)  # its session is over
            self.machine.reset()
            self.token, self.gapless, self.state, self.reason = token, now, ALIVE, NONE
            self.layout, self.values = layout or self.layout, []
        self.gapless = now if now - self.heard > self.watchdog else self.gapless
        self.acknowledged, self.heard = sequence, now
        if all(map(math.isfinite, numbers)):
            self.values = list(numbers[8:]) or self.values
        elif self.state < STOPPING:
            self.stop(NOT_FINITE)
        if self.state >= STOPPING:
            return True
        if wish == STOPPING:
            self.stop(reason or HOST)
        elif wish not in WISHES[self.state]:
            self.stop(DISAGREEMENT)
        elif wish != ARMED or now - self.gapless >= QUIET:
            self.state = wish
        return True

    def _problem(self, datagram):
        size, header = len(datagram), 8 * len(HEADER)
        numbers = (math.nan,) if size % 8 or size < header else struct.unpack_from("<8d", datagram)
        if not all(map(math.isfinite, numbers)):
            return "malformed"
        layout, token, sequence, _, _, wish, _, _ = map(int, numbers)
        bare = size == header and wish in (ALIVE, STOPPING)  # it asks for samples alone
        if layout not in self.modes and not (bare and layout == 0):
            return "foreign"
        if not bare and size != header + 8 * self.modes[layout][0]:
            return "oversized"
        if token in self.used or token == self.token and sequence <= self.acknowledged:
            return "replayed"
        known = layout in (0, self.layout) if token == self.token else self.state not in BUSY
        return "" if known else "foreign"

    def stop(self, reason):
        """Let the valves go to rest, latched until a new token comes."""
        self.state = STOPPING if self.state == RUNNING else STOPPED
        self.reason, self.ramped = reason, 0

    def tick(self, now):
        """One period from ``now`` [s] on: what acts, then what the machine says as a datagram."""
        if now - self.heard > (self.watchdog if self.state == RUNNING else PATIENCE):
            if self.state in (ARMED, RUNNING):
                self.stop(WATCHDOG)
            self.state = IDLE if self.state == ALIVE else self.state
        acted, target = self.applied, [rest for _, _, rest, _ in self.commands]
        if self.state == RUNNING:
            target = self.modes[self.layout][1](self.values)
        elif self.state == STOPPING:
            left = max(round(self.ramp * self.rate) - self.ramped, 1)
            target = [a + (w - a) / left for a, w in zip(self.applied, target)]
            self.ramped, self.state = self.ramped + 1, STOPPED if left == 1 else STOPPING
        for i, (low, high, _, change) in enumerate(self.commands):
            last, step = acted[i], change / self.rate
            target[i] = min(max(target[i], low, last - step), high, last + step)
        self.applied, self.sequence = target, self.sequence + 1
        values = self.machine.tick(self.applied)
        acted = self.applied if self.machine.ahead else acted  # up to this sample
        if self.state == RUNNING and not all(a <= values[i] <= b for i, a, b in self.limits):
            self.stop(LIMIT)
        sent = [self.layout, self.token, self.sequence, self.sequence / self.rate]
        sent += [self.acknowledged, self.state, self.reason, self.watchdog, *values, *acted]
        return struct.pack(f"<{len(sent)}d", *sent)


class Rig:
    """Your inputs and outputs."""

    ahead = False  # whether a sample is of the end of its period, as a simulation can give it

    def tick(self, commands):
        """Read the sensors [SI] in the order of the layout, then set the valves [V]."""
        return [0.0] * SAMPLE

    def reset(self):
        """A new session begins, which ends a stop: look first."""


def serve(target, port, host="127.0.0.1", ready=lambda: None):
    """Serve one host at a time over UDP on the target's clock; ``ready`` is called when it can."""
    peer, due = None, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((host, port))
        link.setblocking(False)
        ready()
        while True:
            time.sleep(max(due - time.monotonic(), 0.0))
            try:
                while True:
                    datagram, sender = link.recvfrom(4096)
                    if sender != peer and target.state in BUSY:
                        target.rejected["foreign"] += 1
                    elif target.receive(datagram, time.monotonic()):
                        peer = sender
            except BlockingIOError:
                datagram = target.tick(time.monotonic())
            if datagram and peer and target.state != IDLE:
                link.sendto(datagram, peer)
            due = max(due + 1.0 / target.rate, time.monotonic() - 0.1)  # at most so far behind


if __name__ == "__main__":
    from ehb_wire import COMMANDS, LAYOUT, RATE, SAMPLE

    serve(Target(Rig(), COMMANDS, {LAYOUT: (len(COMMANDS), list)}, RATE), 47000)
