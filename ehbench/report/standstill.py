"""What a trial does where no motion is desired: how it swings after a stop, how often its working
function changes, how its commands chatter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import Case
from ehbench.report.template import Template
from ehbench.report.words import words


def standstill_caption(
    rig: Rig,
    cases: Sequence[Case],
    records: Sequence[Record],
    swing: float = 0.1,
    chatter: float = 0.2,
    window: float = 0.1,
    changes: int = 4,
) -> str:
    """Sentences on what trials do after a stop, at standstill and with their commands; empty if
    there is nothing to report.

    Args:
        swing: share of the requested speed from which a swing after a stop is reported.
        chatter: share of the largest command from which its swinging is reported.
        window: [s] in which a command swings.
        changes: of the working function at standstill from which they are reported.
    """
    known = [(case, record) for case, record in zip(cases, records, strict=True) if case.fit]
    swings: list[tuple[float, float]] = []
    often: dict[str, int] = {}
    worst = (0.0, "", "")
    for case, record in known:
        law = words(case.row["controller"])
        seen = swing_after(case, record)
        requested = max((abs(step["speed"]) for step in case.steps), default=0.0)
        if seen is not None and requested > 0.0 and seen[0] > swing * requested:
            swings.append(seen)
        names = f"{case.cylinder}.function", f"{case.cylinder}.v_desired"
        if all(name in record for name in names):
            function, idle = record[names[0]].round(), record[names[1]] == 0.0
            count = int(np.sum((np.diff(function) != 0.0) & idle[1:] & idle[:-1]))
            often |= {law: count} if count >= changes else {}
        for name in () if case.steps else _command_names(case, record):
            size = _chatter(case, record, record[name], window)
            if size > max(worst[0], chatter * float(np.abs(record[name]).max())):
                worst = (size, name.removesuffix(".command").rpartition(".")[2], law)
    return Template("trial", rig).text(
        "standstill",
        swings=[list(ends) for ends in zip(*swings, strict=True)],
        still=not any(
            np.ptp(record[name][record.t > record.t[-1] - 0.15]) > 0.0
            for case, record in known
            for name in _command_names(case, record)
        ),
        often=often,
        worst=worst,
        window=window,
    )


def swing_after(case: Case, record: Record, soon: float = 0.15) -> tuple[float, float] | None:
    """(largest speed after the last stop of the desired speed, largest in the last tenth of the
    time from there) [m/s], from ``soon`` [s] after it on; None where the trial does not end at
    standstill.
    """
    name = f"{case.cylinder}.v"
    if name not in record or f"{name}_desired" not in record:
        return None
    moving = np.flatnonzero(np.abs(record[f"{name}_desired"]) > 0.0)
    if not moving.size or moving[-1] + 1 >= record.t.size:
        return None
    after = record.t > record.t[moving[-1]] + soon
    speed = np.abs(record[name][after])
    if speed.size < 10:
        return None
    return float(speed.max()), float(speed[-max(speed.size // 10, 5) :].max())


def _command_names(case: Case, record: Record) -> list[str]:
    first = f"{case.cylinder}."
    return [c for c in record.channels if c.startswith(first) and c.endswith(".command")]


def _chatter(case: Case, record: Record, values: np.ndarray, window: float) -> float:
    """The largest swing there and back of a command within a window [s], one function at work
    all the time and a speed desired.
    """
    names = f"{case.cylinder}.function", f"{case.cylinder}.v_desired"
    size = round(window / record.sample_time) if record.t.size > 1 else 0
    if any(name not in record for name in names) or size < 4:
        return 0.0
    count = record.t.size // size
    function, desired, command = (
        item[: count * size].reshape(count, size)
        for item in (record[names[0]].round(), record[names[1]], values)
    )
    working = (np.ptp(function, axis=1) == 0.0) & (np.abs(desired) > 0.0).all(axis=1)
    early, late = command[:, : size // 2], command[:, size - size // 2 :]
    drift = 2.0 * np.abs(late.mean(axis=1) - early.mean(axis=1))  # that of a ramp
    swing = np.where(working, np.ptp(command, axis=1) - drift, 0.0)
    return float(swing.max(initial=0.0))
