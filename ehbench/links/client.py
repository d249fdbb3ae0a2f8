"""A target at the other end of a link, behind the protocol of every machine."""

import math
import secrets
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ehbench.config.rig import Rig
from ehbench.links.layout import Layout, Mode
from ehbench.links.responder import (
    ALIVE,
    ARMED,
    DISAGREEMENT,
    DONE,
    HEADER,
    HOST,
    NONE,
    REASONS,
    RUNNING,
    STOPPED,
    STOPPING,
)
from ehbench.links.transport import (
    ACKNOWLEDGED,
    LAYOUT,
    REASON,
    SEQUENCE,
    STATE,
    TIME,
    TOKEN,
    WATCHDOG,
    Link,
)
from ehbench.machines.protocol import Machine, Posture, Stamp, reason_of
from ehbench.plant.trim import LowSide
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary import InputError, message, setting

TOKENS = 2**24  # a float32 holds every one
STATES = dict(enumerate(("idle", "alive", "armed", "running", "stopping", "stopped")))


@dataclass(frozen=True)
class LinkSettings:
    """Numbers of a link to a target."""

    patience: float = setting(3.0, "s", "until a target must answer, arm or stop", "sixty ramps")
    answer: float = setting(0.5, "s", "until a target must say its layout", "a sixth of patience")
    posture: float = setting(
        0.03, "", "of a stroke or command by which it is another one", "sensors to 1 %"
    )
    supply: float = setting(0.01, "", "of the design's supply pressure", "unloaded pumps: 0.03")
    drift: float = setting(2e-4, "", "difference of two clocks' rates", "quartz within 100 ppm")
    rate: float = setting(0.02, "", "difference of the target's rate from the trial's", "jitter")
    jump: float = setting(
        0.1, "s", "of a target's clock beyond its count or the host's clock", "five watchdogs"
    )
    frozen: float = setting(0.1, "s", "without a sensor that changes by a bit", "valves are late")
    frozen_samples: float = setting(10.0, "", "the same in samples", "coarse sensors of slow rigs")
    moving: float = setting(
        0.1, "", "of a command's range within which a machine may stand", "deadbands: 0.05"
    )


LINK = LinkSettings()


def no_samples(url: str, rejected: Mapping[str, int]) -> InputError:
    """No sample came; ``rejected`` counts the packets that came, by why they did not count."""
    counts = ", ".join(f"{count} {why}" for why, count in rejected.items()) or "none"
    return InputError(message("links.silent", url=url, rejected=counts))


def refuse_other_supply(
    machine: Machine, rig: Rig, expected: np.ndarray, sample: np.ndarray
) -> None:
    """Refuse a machine without the supply of the design's first sample: the pump is off, or its
    numbers are no pascals. One that is unloaded until the trial runs is let through.

    Raises:
        InputError: names both pressures.
    """
    place = machine.channels.index("p_supply")
    if sample[place] < LINK.supply * expected[place]:  # one without a sensor is no number
        stands, begins = (rig.shown("p_supply", float(p[place])) for p in (sample, expected))
        raise InputError(message("links.supply", stands=stands, begins=begins))


class LinkMachine:
    """A target behind the protocol of a machine.

    A trial's ticks are the target's samples: the host waits for one, answers, and never sleeps.
    ``stamp`` has the target's clock; ``applied`` the commands that acted, as the target says;
    ``rejected`` counts packets by why they did not count. Until a stop, ``missed`` ticks came
    without a sample, and in ``unheeded`` ticks acted another command than was sent.

    Args:
        prepared: the trial; the design's machine lends channels, valves and strokes.
        layout: of its rig.
        link: the way to the target.
        mode: what goes down.
        name: of the link, for logs."""

    latency, reasons = 0.0, (*REASONS, "clock", "frozen")

    def __init__(
        self, prepared: Prepared, layout: Layout, link: Link, mode: Mode, name: str
    ) -> None:
        design = prepared.machine
        self.name, self.prepared, self.layout = name, prepared, layout
        self.link, self.mode = link, mode
        self.channels, self.commands = layout.channels, layout.commands
        self.strokes, self.rate = design.strokes, design.rate
        self.real_time = not link.virtual
        self.unmeasured: tuple[str, ...] = ()
        self.rejected: Counter[str] = Counter()
        self._number, self._up = layout.number(mode), len(HEADER) + len(layout.up)
        self._open = False
        self._begin()

    def _begin(self) -> None:
        self.token = secrets.randbelow(TOKENS - 1) + 1
        self.sequence = self.missed = self.unheeded = self.row = 0
        self.newest, self._offset, self._wish = np.zeros(self._up), math.inf, RUNNING
        self._epoch, self._clock, self._fresh = np.zeros(self._up), 0.0, False
        self.stamp, self.watchdog, self._every = Stamp(0.0, 0, 0.0), 0.0, 1
        self.exchanges: list[tuple[float, ...]] = []
        self._heard: list[np.ndarray] = []
        self._sent: dict[int, np.ndarray] = {}  # commands, by the number of their packet
        self._halted = False
        self._last, self._calm, self._since = np.empty(0), np.empty(0), 0.0

    def now(self) -> float:
        """Time [s] by the host's clock, or by the virtual one."""
        return self._clock if self.link.virtual else time.monotonic()

    def check_posture(self, posture: Posture) -> None:
        """As `Machine.check_posture`: the machine stands where it stands."""
        self.prepared.machine.check_posture(posture)

    def exchange(self, wish: int, values: np.ndarray, reason: int = NONE) -> bool:
        """Send a wish with values, then wait for the next sample; whether one came."""
        self.sequence += 1
        tick = 1.0 / self.rate
        self._clock += tick
        header, sent = np.zeros(len(HEADER)), self.now()
        header[[LAYOUT, TOKEN, SEQUENCE, TIME]] = self._number, self.token, self.sequence, sent
        header[[ACKNOWLEDGED, STATE, REASON]] = self.newest[SEQUENCE], wish, reason
        self.link.send(np.concatenate([header, values]))
        deadline, due, fresh = sent + 2.0 * tick, self.newest[SEQUENCE] + self._every, False
        while self.newest[SEQUENCE] < due:
            for numbers in self.link.receive(deadline - self.now()):
                fresh |= self._take(numbers)
            if self.link.virtual or self.now() >= deadline:
                break
        self._offset += LINK.drift * tick
        if fresh:
            self._offset = min(self._offset, self.now() - self.newest[TIME])
            sample = self.newest[[TIME, ACKNOWLEDGED]].tolist()
            self.exchanges.append((self.sequence, sent, self.now(), *sample))
        self.missed += not fresh and not self._halted
        self._fresh = fresh
        return fresh

    def _take(self, numbers: np.ndarray) -> bool:
        """Take a vector that came; whether it is a new sample of this session."""
        newest = self.newest
        if numbers.size != self._up or not np.isfinite(numbers[: len(HEADER)]).all():
            problem = "malformed" if numbers.size <= self._up else "oversized"
        elif numbers[LAYOUT] != self._number or numbers[TOKEN] != self.token:
            problem = "foreign"
        elif (count := numbers[SEQUENCE] - newest[SEQUENCE]) <= 0.0:
            problem = "replayed"
        elif self.row > 0 and (
            abs(numbers[TIME] - newest[TIME] - count / (self.rate * self._every)) > LINK.jump
            or self._offset - (self.now() - numbers[TIME]) > LINK.jump
        ):  # beyond its count, or with it beyond the host's clock
            problem = "clock"
        else:
            self.newest = numbers
            self._heard.append(numbers)
            return True
        self.rejected[problem] += 1
        return False

    @property
    def packet(self) -> tuple[float, ...]:
        """As `packet_of` says."""
        number, sent, came, _, acknowledged = self.exchanges[-1] if self.exchanges else [0.0] * 5
        return number, sent, came, acknowledged

    @property
    def state(self) -> int:
        """Of the target, as its newest sample says."""
        return int(self.newest[STATE])

    @property
    def applied(self) -> np.ndarray | None:
        """As `applied_of` says; None while no sample comes."""
        return self.newest[len(HEADER) + len(self.channels) :] if self._fresh else None

    def sample(self) -> np.ndarray:
        """The newest sample."""
        return self.newest[len(HEADER) : len(HEADER) + len(self.channels)].copy()

    def connect(self) -> None:
        """Let the target send samples, its valves at rest.

        Raises:
            InputError: nobody answers, or a target of another rig or rate.
        """
        self._begin()
        self.link.receive(0.0)  # of a session before
        self._open, first, start = True, 0.0, 0.0
        until = self.now() + LINK.patience
        while self.newest[SEQUENCE] < first + 20 or first == 0.0:
            if self.exchange(ALIVE, np.empty(0)) and first == 0.0:
                first, start = self.newest[SEQUENCE], self.newest[TIME]
            if self.now() > until:
                self._refuse_other_layout()
                raise no_samples(self.name, self.rejected)
        rate = (self.newest[SEQUENCE] - first) / max(self.newest[TIME] - start, 1e-9)
        self._every = max(round(rate / self.rate), 1) if self.mode == "setpoint" else 1
        if abs(rate / (self.rate * self._every) - 1.0) > LINK.rate:
            fields = {"url": self.name, "rate": rate, "trial": self.rate}
            raise InputError(message("links.other_rate", **fields))
        self.watchdog = float(self.newest[WATCHDOG])
        silent = np.flatnonzero(np.isnan(self.sample()))
        self.unmeasured = tuple(self.channels[i] for i in silent)

    def _refuse_other_layout(self) -> None:
        """Ask a target that says nothing for its layout.

        Raises:
            InputError: it has another.
        """
        header, until = np.zeros(len(HEADER)), self.now() + LINK.answer
        header[[TOKEN, STATE]] = secrets.randbelow(TOKENS - 1) + 1, ALIVE
        while self.now() < until:
            self._clock += 1.0 / self.rate
            header[[SEQUENCE, TIME]] = header[SEQUENCE] + 1, self.now()
            self.link.send(header)
            for item in self.link.receive(0.1):
                known = item.size >= len(HEADER) and item[TOKEN] == header[TOKEN]
                if known and item[LAYOUT] != self._number:
                    fields = {"url": self.name, "layout": int(item[LAYOUT])}
                    fields |= {"mode": self.mode, "expected": self._number}
                    raise InputError(message("links.other_layout", **fields))

    def start(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """As `Machine.start`: the target is armed, its valves at rest.

        Raises:
            InputError: as `reach`; it does not arm; its supply is not there.
        """
        expected = self.reach(posture, low_side)
        until, self.row = self.now() + LINK.patience, 0
        while self.state != ARMED:
            self.exchange(ARMED, self._down(self.commands.rest))
            self.refuse_unarmed(self.state >= STOPPING or self.now() > until)
        refuse_other_supply(self, self.prepared.rig, expected, self.sample())
        self._epoch, self.row, self.missed = self.newest.copy(), 0, 0
        self._heard = [self.newest]
        self.exchanges.clear()
        self.rejected.clear()
        self.stamp = Stamp(0.0, 0, 0.0)
        return self.sample()

    def refuse_unarmed(self, over: bool) -> None:
        """Refuse a target that does not do what was wished, where the time for it is ``over``.

        Raises:
            InputError: says its state and its reason to stop, or that it fell silent.
        """
        if over:
            state = STATES.get(self.state, self.state) if self._fresh else "silent"
            fields = {"state": state, "reason": reason_of(self, int(self.newest[REASON]))}
            raise InputError(message("links.not_armed", url=self.name, **fields))

    def reach(self, posture: Posture = None, low_side: LowSide = None) -> np.ndarray:
        """Let the target send samples; it stands where the trial begins: the sample of the design.

        Raises:
            InputError: as `connect`; names the cylinder and both strokes.
        """
        self.connect()
        expected = self.prepared.machine.start(posture, low_side)
        places = [i for i, name in enumerate(self.channels) if name.endswith(".x")]
        for place, stroke in zip(places, self.strokes, strict=True):
            x, begin = self.sample()[place], expected[place]
            if abs(x - begin) > LINK.posture * stroke:
                shown = (self.prepared.rig.shown("x", float(value)) for value in (x, begin))
                fields = dict(zip(("stands", "begins"), shown, strict=True))
                raise InputError(message("links.stands", channel=self.channels[place], **fields))
        return expected

    def _down(self, command: np.ndarray) -> np.ndarray:
        """The values that go down with a command [V]: itself, or what the target shall follow."""
        if self.mode == "stream":
            return command
        loop, columns = self.prepared.loop, len(self.layout.references) // len(self.strokes)
        x = [self.sample()[i] for i, name in enumerate(self.channels) if name.endswith(".x")]
        values = np.zeros((len(x), columns))
        values[:, 0] = x
        for item in () if loop is None else loop.driven:
            table = item.references.table
            values[item.design.index] = table[min(self.row, len(table) - 1), :columns]
        return values.ravel()

    def tick(self, command: np.ndarray) -> np.ndarray:
        """As `Machine.tick`; without a new sample the last, older."""
        if self.row == 0:  # the log was opened since
            self.exchange(ARMED, self._down(self.commands.rest))
            self._epoch, self.missed, self._heard = self.newest.copy(), 0, [self.newest]
        values = self._down(np.asarray(command, dtype=float))
        self._sent[self.sequence + 1] = values.copy()
        self.exchange(self._wish, values, HOST if self._wish == STOPPING else NONE)
        self.row += 1
        self.unheeded += self.acted_otherwise() and not self._halted
        stopped, state = 0, self.state
        starting = state == ARMED and self.row <= max(3.0, self.watchdog * self.rate)
        if self._wish == RUNNING and state != RUNNING and not starting:
            stopped = (int(self.newest[REASON]) if state >= STOPPING else 0) or DISAGREEMENT
        elif self.rejected["clock"]:
            stopped = self.reasons.index("clock")
        at, count = (float(self.newest[k] - self._epoch[k]) for k in (TIME, SEQUENCE))
        if self._frozen(values, at):
            stopped = stopped or self.reasons.index("frozen")
        age = self.now() - self.newest[TIME] - self._offset
        self.stamp = Stamp(at, int(count) // self._every, max(float(age), 0.0), stopped)
        return self.sample()

    def _frozen(self, values: np.ndarray, at: float) -> bool:
        """Whether at ``at`` [s] no sensor has changed for long, although the commands are away from
        rest, or under a controller from those before: the target counts, and measures nothing."""
        if self.mode != "stream":
            return False
        sample, span = self.sample(), self.commands.highest - self.commands.lowest
        changed = not np.array_equal(sample, self._last, equal_nan=True)
        if changed:
            self._calm = self.commands.rest if self.prepared.loop is None else values
        if changed or (np.abs(values - self._calm) <= LINK.moving * span).all():
            self._last, self._since = sample, at
        return at - self._since > max(LINK.frozen, LINK.frozen_samples / self.rate)

    def acted_otherwise(self) -> bool:
        """Whether a command acted that lies beyond the last three packets that the target had: one
        of them acts, by when it reads them, or what its clamps let pass on the way there."""
        had, acted = int(self.newest[ACKNOWLEDGED]), self.applied
        for number in [number for number in self._sent if number < had - 2]:
            del self._sent[number]
        sent = [self._sent[number] for number in range(had - 2, had + 1) if number in self._sent]
        if self.mode != "stream" or self.state != RUNNING or acted is None or len(sent) < 3:
            return False
        beyond = np.maximum(acted - np.max(sent, axis=0), np.min(sent, axis=0) - acted)
        return bool((beyond > LINK.posture * (self.commands.highest - self.commands.lowest)).any())

    def heard(self) -> tuple[np.ndarray, np.ndarray] | None:
        """As `heard_of` says; of a table the log says it."""
        if self.link.virtual or self.mode == "buffered":
            return None
        table = np.array(self._heard)
        return table[:, TIME] - self._epoch[TIME], table[:, len(HEADER) :]

    def halt(self) -> None:
        """As `halt_of` says: a target that makes its own commands stops by itself."""
        self._halted = True
        if self.mode != "stream":
            self._wish = STOPPING

    def close(self) -> None:
        """As `Machine.close`: the target lets its valves go to rest."""
        moved, self._open = self._open, False
        until = self.now() + 0.5 if moved else 0.0
        while self.state != STOPPED and self.now() < until:
            self.exchange(STOPPING, np.empty(0), DONE)
        self.link.close()
