"""How well this computer and this link serve a trial, measured before any oil moves."""

import secrets
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ehbench.links.client import LINK, TOKENS, no_samples
from ehbench.links.responder import ALIVE, HEADER
from ehbench.links.transport import ACKNOWLEDGED, SEQUENCE, STATE, TIME, TOKEN, WATCHDOG, Link
from ehbench.vocabulary import Message, message, setting


@dataclass(frozen=True)
class QualitySettings:
    """What a link must keep."""

    late: float = setting(0.01, "", "share of late ticks that is refused", "twice an ordinary one")
    gap: float = setting(0.5, "", "longest gap, as a share of the watchdog's time", "half of it")
    samples: float = setting(4.0, "", "in a watchdog's time, at least", "one may be late")


QUALITY = QualitySettings()


@dataclass(frozen=True)
class Quality:
    """What was measured of a link.

    ``ticks`` of the target, ``lost`` samples, ``late`` ticks without a fresh answer; ``round_trip``
    [s] from sending to the sample that acknowledges it: median, 99.9 % and longest; ``gap`` [s] the
    longest between two samples; ``watchdog`` [s] and ``rate`` [Hz] of the target."""

    url: str
    ticks: int
    lost: int
    late: int
    round_trip: tuple[float, float, float]
    gap: float
    watchdog: float
    rate: float
    refused: tuple[str, ...] = ()

    @property
    def late_share(self) -> float:
        """Share of ticks without a fresh answer."""
        return self.late / max(self.ticks, 1)

    def problems(self) -> list[Message]:
        """Why no trial may run over it; none of a sound one."""
        reasons = []
        if self.late_share > QUALITY.late:
            reasons.append(message("links.late", share=self.late_share, most=QUALITY.late))
        if self.gap > QUALITY.gap * self.watchdog:
            fields = {"gap": 1e3 * self.gap, "most": 1e3 * QUALITY.gap * self.watchdog}
            longer = max(self.gap / QUALITY.gap, QUALITY.samples / self.rate)
            reasons.append(message("links.gap", longer=1e3 * longer, **fields))
        return reasons

    def rows(self) -> list[tuple[str, str]]:
        """A table for people."""
        trip = " / ".join(f"{1e3 * value:.3g}" for value in self.round_trip)
        return [
            ("ticks", f"{self.ticks} at {self.rate:.4g} Hz"),
            ("late ticks", f"{self.late} ({100 * self.late_share:.2f} %)"),
            ("lost samples", str(self.lost)),
            ("round trip, median / 99.9 % / longest", f"{trip} ms"),
            (
                "longest gap",
                f"{1e3 * self.gap:.3g} ms of a watchdog of {1e3 * self.watchdog:.3g} ms",
            ),
            ("not allowed here", ", ".join(self.refused) or "nothing"),
        ]


def measure(link: Link, url: str, seconds: float, refused: tuple[str, ...] = ()) -> Quality:
    """Answer a target's samples for a while, valves at rest; then the link is closed.

    Raises:
        InputError: nobody answers.
    """
    token, times, rows, newest = secrets.randbelow(TOKENS - 1) + 1, [], [], 0.0
    header, rejected = np.zeros(len(HEADER)), Counter()
    header[TOKEN], header[STATE] = token, ALIVE
    begun = heard = now = time.monotonic()
    with closing(link):
        while now - begun <= seconds or len(rows) < 2:
            times.append(now)
            header[[SEQUENCE, ACKNOWLEDGED]] = len(times), newest
            header[TIME] = 1e-3 * len(times) if link.virtual else now
            link.send(header)
            answers = link.receive(0.1)
            now = time.monotonic()
            for item in answers:
                if item.size >= len(HEADER) and item[TOKEN] == token:
                    rows.append((now, *item[[SEQUENCE, TIME, ACKNOWLEDGED, WATCHDOG]].tolist()))
                    newest, heard = item[SEQUENCE], now
                else:
                    rejected["malformed" if item.size < len(HEADER) else "foreign"] += 1
            if now - heard > LINK.patience:
                raise no_samples(url, rejected)
    sent, table = np.array(times), np.array(rows)
    came, sequence, t, acknowledged = table[:, :4].T
    steps = np.diff(acknowledged)
    first = np.flatnonzero(np.r_[True, steps > 0.0] & (acknowledged > 0.0))
    trips = came[first] - sent[acknowledged[first].astype(int) - 1]
    ticks = int(sequence[-1] - sequence[0])
    return Quality(
        url,
        ticks,
        ticks - (len(table) - 1),
        ticks - int((steps > 0.0).sum()),
        (float(np.median(trips)), float(np.quantile(trips, 0.999)), float(trips.max())),
        float(np.diff(came).max()),
        float(table[-1, 4]),
        ticks / max(float(t[-1] - t[0]), 1e-9),
        refused,
    )
