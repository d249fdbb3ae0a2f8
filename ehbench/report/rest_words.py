"""What a trial does where nothing is asked of it: how it swings after a stop, how often its working
function changes at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.captions import measure, span
from ehbench.report.cases import Case
from ehbench.report.words import pretty, shown, unit_of, words

Known: TypeAlias = Sequence[tuple[Case, Record]]
SEEN = 0.1  # share of the speed asked from which a swing after a stop is told
RESTLESS = 0.2  # share of the largest command from which its swinging is told
WINDOW = 0.1  # [s] in which a command swings
SOON = 0.15  # [s] in which a cylinder may come to rest
OFTEN = 4  # changes of the working function at rest from which they are told


def rest_caption(rig: Rig, cases: Sequence[Case], records: Sequence[Record]) -> str:
    """Sentences on what trials do after a stop, at rest and by way of their commands; empty if
    there is nothing to tell.
    """
    known = [(case, record) for case, record in zip(cases, records, strict=True) if case.fit]
    sentences = (_swings(rig, known), _hunting(known), _restless(rig, known))
    return "".join(f" {text}" for text in sentences if text)


def swing_after(case: Case, record: Record) -> tuple[float, float] | None:
    """(largest speed after the last stop of the desired speed, largest in the last tenth of the
    time from there) [m/s]; None where the trial does not end at rest.
    """
    name = f"{case.cylinder}.v"
    if name not in record or f"{name}_desired" not in record:
        return None
    moving = np.flatnonzero(np.abs(record[f"{name}_desired"]) > 0.0)
    if not moving.size or moving[-1] + 1 >= record.t.size:
        return None
    after = record.t > record.t[moving[-1]] + SOON
    speed = np.abs(record[name][after])
    if speed.size < 10:
        return None
    return float(speed.max()), float(speed[-max(speed.size // 10, 5) :].max())


def _swings(rig: Rig, known: Known) -> str:
    first: list[float] = []
    last: list[float] = []
    for case, record in known:
        result, requested = swing_after(case, record), _asked(case)
        if result is not None and requested > 0.0 and result[0] > SEEN * requested:
            first.append(float(shown(rig, "v", result[0])))
            last.append(float(shown(rig, "v", result[1])))
    if not first:
        return ""
    unit = pretty(unit_of(rig, "v"))
    text = f"After the stop it swings by up to {span(first, 2)} {unit}"
    text += f", and still by {span(last, 2)} {unit} where the log ends"
    if all(_still(case, record) for case, record in known):
        text += "; all commands stand still then, so that no feedback damps it"
    return text + "."


def _asked(case: Case) -> float:
    """The largest speed of its steps [m/s]."""
    return max((abs(step["speed"]) for step in case.steps), default=0.0)


def _still(case: Case, record: Record) -> bool:
    """Whether the commands of a cylinder stand still at the end of its log."""
    last = record.t > record.t[-1] - SOON
    return not any(np.ptp(record[name][last]) > 0.0 for name in _commands(case, record))


def _commands(case: Case, record: Record) -> list[str]:
    own = f"{case.cylinder}."
    return [c for c in record.channels if c.startswith(own) and c.endswith(".command")]


def _hunting(known: Known) -> str:
    """How often the working function changes while the desired speed is zero."""
    often: dict[str, int] = {}
    for case, record in known:
        names = f"{case.cylinder}.function", f"{case.cylinder}.v_desired"
        if any(name not in record for name in names):
            continue
        function, rest = record[names[0]].round(), record[names[1]] == 0.0
        changes = int(np.sum((np.diff(function) != 0.0) & rest[1:] & rest[:-1]))
        if changes >= OFTEN:
            often[words(case.row["controller"])] = changes
    if not often:
        return ""
    each = ", ".join(f"{changes} times ({name})" for name, changes in often.items())
    return (
        f"While no speed is asked, the working function changes {each}: "
        "it holds, and corrects the stroke in between."
    )


def _restless(rig: Rig, known: Known) -> str:
    """The command that swings most in a short time while one function is at work."""
    worst = (0.0, "", "")
    for case, record in known:
        for name in () if case.steps else _commands(case, record):
            swing = _within(case, record, record[name])
            if swing > max(worst[0], RESTLESS * float(np.abs(record[name]).max())):
                valve = name.removesuffix(".command").rpartition(".")[2]
                worst = (swing, valve, words(case.row["controller"]))
    swing, valve, who = worst
    if not swing:
        return ""
    much = measure(rig, "command", swing, 2)
    return f"In motion the command of {valve} swings by up to {much} within {WINDOW} s ({who})."


def _within(case: Case, record: Record, values: np.ndarray) -> float:
    """The largest swing there and back of a command within a window of WINDOW, one function at
    work all the time and a speed asked.
    """
    names = f"{case.cylinder}.function", f"{case.cylinder}.v_desired"
    size = round(WINDOW / record.sample_time) if record.t.size > 1 else 0
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
