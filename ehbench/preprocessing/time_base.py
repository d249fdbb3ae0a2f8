"""The time base of a log: stamps that are not even, and gaps.

Stamps that jitter are put on the beats of their rate. A few missing samples are bridged, at longer
gaps the log is cut into parts. Each part is a log by itself: nothing is known of the gap, so a
simulation begins anew after it, from an initial state of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ehbench.data.rates import SETTINGS as RATES
from ehbench.data.record import Record, resampled
from ehbench.signals.timestamps import missing_rows, timestamps_of
from ehbench.vocabulary import LogError, Message, listed, message, setting


@dataclass(frozen=True)
class TimeSettings:
    """Numbers of uneven time bases and gaps."""

    even: float = setting(0.01, "", "error of an even step, of the sample time", "rounding")
    jitter: float = setting(0.25, "", "earliest or latest sample, likewise", "below a half")
    rare: float = setting(0.4, "", "gaps a sample of another rate", "the median step is a gap")
    shortest: float = setting(0.25, "s", "least length of a part between gaps", "it must move")
    share: float = setting(0.1, "", "least length of a part, share of the longest", "it must count")
    change: float = setting(0.02, "", "change of a command in a part, of its range", "noise")


SETTINGS = TimeSettings()
SEQUENCE = "sample_sequence"  # the number of the sample that a row of a machine's log has


def evened(name: str, record: Record) -> tuple[Record, list[Message]]:
    """The record on an even time base, and a message if that took resampling: readings
    interpolated, commands constant.

    Raises:
        LogError: samples are missing, or their stamps are not those of one rate, early and late."""
    steps = np.diff(record.t)
    tick = record.sample_time
    if np.abs(steps - tick).max() <= SETTINGS.even * tick:
        return record, []
    even = (record.t[-1] - record.t[0]) / (record.t.size - 1)
    off = np.abs(steps - even)
    worst = int(np.argmax(off))
    # a step ends in two samples, one early and one late
    if off[worst] > (2.0 * SETTINGS.jitter + SETTINGS.even) * even:
        stamps = timestamps_of(record.t)
        if stamps is not None and stamps.even and not stamps.missing.any():
            beats = record.t[0] - stamps.off[0] + stamps.period * stamps.number
            channels = {  # a command at its beat, however late it was written
                name: y if name.endswith(".command") else np.interp(beats, record.t, y)
                for name, y in record.channels.items()
            }
            early, late = 1e3 * max(0.0, -stamps.off.min()), 1e3 * max(0.0, stamps.off.max())
            rate = f"{1.0 / stamps.period:.5g} Hz"
            note = message("preprocessing.jitter", early=early, late=late, rate=rate)
            return replace(record, t=beats, channels=channels), [note]
        at = int(np.argmax(np.abs(steps - tick)))
        fields = {"gap": 1e3 * steps[at], "time": record.t[at], "step": 1e3 * tick}
        raise LogError(message("preprocessing.not_even", log=name, **fields))
    t = np.linspace(record.t[0], record.t[-1], record.t.size)
    slack = (SETTINGS.jitter + SETTINGS.even) * even
    channels = resampled(record.channels, record.t, t, slack)
    fields = {"gap": 1e3 * steps[worst], "time": record.t[worst], "rate": 1.0 / even}
    return replace(record, t=t, channels=channels), [message("preprocessing.resampled", **fields)]


class LogPart(NamedTuple):
    """A part of a log: ``name`` and samples."""

    name: str
    record: Record


def parts_of(
    name: str, record: Record, *, driven: bool = False, within: tuple[float, float] | None = None
) -> tuple[list[LogPart], list[Message]]:
    """(the log, or its parts between gaps; messages on the gaps and on what is left out).

    A log of which nothing would be left, or whose time is wrong in another way, comes back as it
    is: `evened` says what is wrong with it.

    Args:
        name: of the log, which its parts have with their number.
        driven: leave out parts in which no command changes.
        within: [s] the span that counts; parts outside of it are left out."""
    whole = [LogPart(name, record)]
    if record.t.size < 3:
        return whole, []
    record, notes = _as_it_came(name, record)
    tick, steps = record.sample_time, np.diff(record.t)
    missing = missing_rows(record.t, tick, (2.0 * SETTINGS.jitter + SETTINGS.even) * tick)
    gaps = np.flatnonzero(missing >= 1.0)
    if gaps.size > SETTINGS.rare * steps.size or np.any(steps <= 0.0):
        return whole, []
    if not gaps.size:
        return [LogPart(name, record)], notes
    is_short = missing[gaps] <= RATES.bridged
    few, many = gaps[is_short], gaps[~is_short]
    edges = [0, *(many + 1).tolist(), record.t.size]
    spans = list(zip(edges[:-1], edges[1:], strict=True))
    retained = _retained(record, spans, driven, within or (-np.inf, np.inf))
    if not retained:
        return whole, []
    filled = record
    if few.size:
        new = [np.linspace(record.t[i], record.t[i + 1], int(missing[i]) + 2)[1:-1] for i in few]
        t = np.sort(np.concatenate([record.t, *new]))
        filled = replace(record, t=t, channels=resampled(record.channels, record.t, t))
    results = [
        LogPart(
            f"{name}_part{number}" if len(retained) > 1 else name,
            filled.between(record.t[start], record.t[stop - 1]),
        )
        for number, (start, stop) in enumerate(retained, 1)
    ]
    left_out = [span for span in spans if span not in retained]
    if few.size:
        shown = _gap_list(record, few, missing)
        share = float(missing[few].sum() / (record.t.size + missing[few].sum()))
        fields = {"share": share, "longest": float(steps[few].max())}
        notes.append(message("preprocessing.bridged", log=name, gaps=shown, **fields))
    if many.size:
        shown = _gap_list(record, many, missing)
        notes.append(message("preprocessing.cut", log=name, gaps=shown))
    if len(results) > 1 or left_out:
        ends = [(part.name, *part.record.t[[0, -1]]) for part in results]
        shown = ", ".join(f"{part} from {first:.6g} to {last:.6g} s" for part, first, last in ends)
        notes.append(message("preprocessing.parts", log=name, parts=shown))
    if left_out:
        ends = [record.t[[start, stop - 1]] for start, stop in left_out]
        shown = ", ".join(f"{first:.6g} to {last:.6g} s" for first, last in ends)
        notes.append(message("preprocessing.parts_left_out", log=name, spans=shown))
    return results, notes


def _as_it_came(name: str, record: Record) -> tuple[Record, list[Message]]:
    """A log without the rows in which no sample came, which repeat the one before; a message where
    that is its end."""
    if SEQUENCE not in record:
        return record, []
    came = np.diff(record[SEQUENCE], prepend=-np.inf) > 0.0
    heard, end = record.at(came), float(record.t[-1])
    if came[-1]:
        return heard, []
    fields = {"last": float(heard.t[-1]), "end": end}
    return heard, [message("preprocessing.none_came", log=name, **fields)]


def _retained(
    record: Record, spans: Sequence[tuple[int, int]], driven: bool, within: tuple[float, float]
) -> list[tuple[int, int]]:
    """The parts (first sample, one after the last) that are long enough, and ``driven`` if
    asked."""
    inside = [span for span in spans if record.at(slice(*span)).between(*within).t.size > 2]
    longest = max((stop - start for start, stop in inside), default=0)
    shortest = max(SETTINGS.shortest / record.sample_time, SETTINGS.share * longest)
    commands = [y for channel, y in record.channels.items() if channel.endswith(".command")]

    def moves(start: int, stop: int) -> bool:
        return any(np.ptp(y[start:stop]) > SETTINGS.change * np.ptp(y) for y in commands)

    long = [(start, stop) for start, stop in inside if stop - start >= shortest]
    return [span for span in long if not driven or moves(*span)]


def _gap_list(record: Record, gaps: np.ndarray, missing: np.ndarray) -> str:
    """The first of some gaps, and how many there are."""
    steps = 1e3 * np.diff(record.t)
    each = (f"{steps[i]:.4g} ms after t = {record.t[i]:.6g} s ({missing[i]:.0f})" for i in gaps)
    return listed(each, kind="gaps")
