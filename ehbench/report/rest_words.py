"""What a trial does where nothing is asked of it: how it swings after a stop, how often its working
function changes at rest.
"""

from __future__ import annotations

import numpy as np

from ehbench.record import Record
from ehbench.report.captions import measure
from ehbench.report.cases import Case
from ehbench.report.words import number
from ehbench.rig import Rig

SEEN = 0.05  # share of the speed asked from which a swing after a stop is told
SOON = 0.15  # [s] in which a cylinder may come to rest
OFTEN = 4  # changes of the working function at rest from which they are told


def rest_caption(rig: Rig, case: Case, record: Record) -> str:
    """Sentences on what one trial does after a stop and at rest; empty if there is nothing to
    tell.
    """
    told = [text for text in (_swing(rig, case, record), _hunting(case, record)) if text]
    return " ".join(["", *told])


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


def _swing(rig: Rig, case: Case, record: Record) -> str:
    found = swing_after(case, record)
    asked = max((abs(one["speed"]) for one in case.steps), default=0.0)
    if found is None or asked == 0.0 or found[0] < SEEN * asked:
        return ""
    first, last = found
    text = f"After the stop it swings by up to {measure(rig, 'v', first, 2)}"
    if last > SEEN * asked:
        text += f", and still by {measure(rig, 'v', last, 2)} where the log ends"
    if _still(case, record):
        text += "; all commands stand still then, so that no feedback damps it"
    return text + "."


def _still(case: Case, record: Record) -> bool:
    """Whether the commands of a cylinder stand still at the end of its log."""
    names = [c for c in record.channels if c.startswith(f"{case.cylinder}.")]
    last = record.t > record.t[-1] - SOON
    commands = [record[name][last] for name in names if name.endswith(".command")]
    return bool(commands) and not any(np.ptp(command) > 0.0 for command in commands)


def _hunting(case: Case, record: Record) -> str:
    """How often the working function changes while the desired speed is zero."""
    own = case.cylinder
    if f"{own}.function" not in record or f"{own}.v_desired" not in record:
        return ""
    function = record[f"{own}.function"].round()
    rest = record[f"{own}.v_desired"] == 0.0
    changes = int(np.sum((np.diff(function) != 0.0) & rest[1:] & rest[:-1]))
    if changes < OFTEN:
        return ""
    time = float(np.sum(np.diff(record.t)[rest[1:]]))
    return (
        f"While no speed is asked ({number(time, 2)} s), the working function changes "
        f"{changes} times: it holds, and corrects the stroke in between."
    )
