"""Trials under a controller in words."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.cases import SLOW, Case, by_controller, damping, limits_of, payloads_carried
from ehbench.report.template import Template
from ehbench.report.words import words
from ehbench.vocabulary import codes

# channels of what an adaptive law has learnt, in the order of the figure: the payload, not its
# share
ESTIMATES = ("payload_estimate", *(word for word in codes.ESTIMATES if word != "payload_share"))


def case_caption(rig: Rig, case: Case) -> str:
    """What one trial came to."""
    law = words(case.row["controller"].removesuffix(f", {case.cylinder}"))
    limits = {name: share for name, share in limits_of(case.row).items() if share > 0.0}
    means = codes.LIMITS_MEAN | codes.STATUS_MEANS
    return Template("trial", rig).text("case", case=case, law=law, limits=limits, means=means)


def compared_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """What each controller came to on a motion, the best and worst; no stopped trial."""
    results = []
    for case in cases:
        values = [step.get("overshoot") for step in case.steps]
        values = values or [case.row["tracking"]["max_error"]]
        if None not in values and case.fit:
            results.append((max(values), case.row["controller"]))
    differ = len(results) > 1 and min(results)[0] != max(results)[0]
    best, worst = (min(results), max(results)) if differ else (None, None)
    return Template("trial", rig).text("compared", cases=cases, best=best, worst=worst)


def energy_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """By payload, who takes least and most from the pump, and how far off it ended."""
    pairs = []
    for payload in dict.fromkeys(case.row["payload"] for case in cases):
        fit = [case for case in cases if case.row["payload"] == payload and case.fit]
        fit.sort(key=lambda case: case.row["energy"]["pump"])
        pairs += [(payload, fit[0], fit[-1])] if fit else []
    stopped = [case for case in cases if case.row.get("stopped")]
    slow = [case for case in cases if not case.fit and case not in stopped]
    return Template("trial", rig).text(
        "energy",
        pairs=pairs,
        stopped=stopped,
        slow=list(dict.fromkeys(words(case.row["controller"]) for case in slow)),
        limit=SLOW,
        sources=list(dict.fromkeys(case.row["energy"]["source"] for case in cases)),
    )


def map_caption(panels: Sequence[tuple[str, np.ndarray]]) -> str:
    """How far each controller's energies, shape (loads, speeds), lie above the least of all."""
    minimum = np.fmin.reduce([energies for _, energies in panels])
    shares = []
    for name, energies in panels:
        above = 100.0 * (energies / minimum - 1.0)
        if np.isfinite(above).any():
            shares.append((name, [round(float(v), 1) for v in above[np.isfinite(above)]]))
    return Template("trial").text("map", shares=shares)


def trajectory_caption(rig: Rig, case: Case, record: Record) -> str:
    """How far, how fast and how sharply a motion is desired."""
    names = {word: f"{case.cylinder}.{word}_desired" for word in ("x", "v", "a")}
    tops = {w: float(np.abs(record[n]).max()) if n in record else None for w, n in names.items()}
    x = record[names["x"]]
    return Template("trial", rig).text(
        "trajectory", **tops | {"x": [float(x.min()), float(x.max())]}
    )


def estimates_caption(rig: Rig, case: Case, record: Record) -> str:
    """Where the estimates ended, beside what they should be where that is known."""
    within = 0.1  # share of a change of payload that an estimate may still miss
    since = 1.0  # [s] after a change of payload, before which an estimate is not judged
    first = f"{case.cylinder}."
    ends = {word: float(record[first + word][-1]) for word in ESTIMATES if first + word in record}
    bounds, outside, at_end = case.row.get("estimate_bounds", {}), [], []
    bounded = [word for word in ends if word in bounds]
    for word in bounded:
        values, (low, high) = record[first + word], bounds[word]
        room = 1e-9 * (high - low)  # of rounding
        if values.min() < low - room or values.max() > high + room:
            outside.append(words(word))
        elif values[-1] <= low + room or values[-1] >= high - room:
            at_end.append(words(word))
    fields: dict[str, Any] = {"row": case.row, "ends": ends, "within": within, "since": since}
    fields |= {"bounded": bounded, "outside": outside, "at_end": at_end, "bulk": None}
    bulk = record[first + "bulk_measured"] if first + "bulk_measured" in record else np.zeros(1)
    if np.ptp(bulk) > 0.0:
        fields["bulk"] = (float(bulk[0]), float(bulk[-1]))
    carried = payloads_carried(rig, case.row) if "payload_estimate" in ends else None
    fields["carried"] = carried
    if carried:
        t, estimate, learnt = record.t, record[first + "payload_estimate"], []
        stops = [*(time for time, _ in carried[2:]), math.inf]
        for (_, before), (time, mass), stop in zip(carried, carried[1:], stops, strict=False):
            part = (t >= time) & (t < stop)
            beyond = np.flatnonzero(np.abs(estimate[part] - mass) > within * abs(mass - before))
            late = beyond[-1] + 1 if beyond.size else 0
            never = beyond.size and late == part.sum()
            lasts = None if never else float((t[part] - time)[late]) if late else 0.0
            learnt.append((time, mass, lasts))  # of each change of payload, until learnt
        fields |= {
            "first": float(estimate[0]),
            "off": abs(float(estimate[-1]) - carried[-1][1]),
            "learnt": learnt,
            "weighed": _weighed(case, record, carried, since),
        }
    return Template("trial", rig).text("estimates", **fields)


def _weighed(
    case: Case, record: Record, carried: Sequence[tuple[float, float]], since: float
) -> dict[str, Any] | None:
    """How far off in motion [kg] the payload is that pressures and motion show, and which share of
    the time its interval holds the truth; None where the log has none of it."""
    names = [f"{case.cylinder}.payload_{word}" for word in ("measured", "low", "high")]
    if not all(name in record for name in names):
        return None
    measured, low, high = (record[name] for name in names)
    times, masses = zip(*carried, strict=True)
    last = np.searchsorted(times, record.t, side="right") - 1
    truth = np.array(masses)[last]
    news = (last > 0) & (record.t - np.array(times)[last] < since)
    moving = (np.abs(record[f"{case.cylinder}.v_desired"]) > 0.0) & ~news
    if not moving.any():
        return None
    return {
        "off": float(np.quantile(np.abs(measured - truth)[moving], 0.95)),
        "holds": float(np.mean((low <= truth) & (truth <= high))),
        "after": bool(news.any()),
    }


def trials_caption(cases: Sequence[Case]) -> str:
    """How many trials there are, of what."""
    machines, payloads, motions, controllers = (
        list(dict.fromkeys(case.row[key] for case in cases))
        for key in ("on", "payload", "motion", "controller")
    )
    fields = {"machines": machines, "payloads": payloads, "motions": motions}
    return Template("trial").text("trials", cases=cases, controllers=controllers, **fields)


def controller_captions(rig: Rig, cases: Sequence[Case]) -> Iterator[str]:
    """For each controller how it did over all payloads and motions."""
    for name, group in by_controller(cases).items():
        rows = [case.row for case in group]
        steps = [step for row in rows for step in row["steps"]]
        ringing = [damping(step) for step in steps]
        yield Template("trial", rig).text(
            "controller",
            name=name,
            rows=rows,
            steps=len(steps),
            errors=[100.0 * step["steady_error"] for step in steps],
            overshoots=[100.0 * s["overshoot"] for s in steps if s.get("overshoot") is not None],
            clear=[ratio for ratio, doubt in ringing if ratio is not None and not doubt],
            rough=[ratio for ratio, doubt in ringing if ratio is not None and doubt],
        )


def standstill_caption(rig: Rig, cases: Sequence[Case], records: Sequence[Record]) -> str:
    """Sentences on what trials do after a stop, at standstill and with their commands; empty if
    there is nothing to report: no swing beyond a tenth of the requested speed, fewer than four
    changes of function, no command that swings by a fifth of its largest."""
    window = 0.1  # [s], in which a command swings
    known = [(case, record) for case, record in zip(cases, records, strict=True) if case.fit]
    swings: list[tuple[float, float]] = []
    often: dict[str, int] = {}
    worst = (0.0, "", "")
    for case, record in known:
        law = words(case.row["controller"])
        seen = swing_after(case, record)
        requested = max((abs(step["speed"]) for step in case.steps), default=0.0)
        if seen is not None and requested > 0.0 and seen[0] > 0.1 * requested:
            swings.append(seen)
        names = f"{case.cylinder}.function", f"{case.cylinder}.v_desired"
        if all(name in record for name in names):
            function, idle = record[names[0]].round(), record[names[1]] == 0.0
            count = int(np.sum((np.diff(function) != 0.0) & idle[1:] & idle[:-1]))
            often |= {law: count} if count >= 4 else {}
        for name in () if case.steps else _command_names(case, record):
            size = _chatter(case, record, record[name], window)
            if size > max(worst[0], 0.2 * float(np.abs(record[name]).max())):
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


def swing_after(case: Case, record: Record) -> tuple[float, float] | None:
    """(largest speed after the last stop of the desired speed, largest in the last tenth of the
    time from there) [m/s], from 0.15 s after it on; None where the trial does not end at
    standstill."""
    name = f"{case.cylinder}.v"
    if name not in record or f"{name}_desired" not in record:
        return None
    moving = np.flatnonzero(np.abs(record[f"{name}_desired"]) > 0.0)
    if not moving.size or moving[-1] + 1 >= record.t.size:
        return None
    after = record.t > record.t[moving[-1]] + 0.15
    speed = np.abs(record[name][after])
    if speed.size < 10:
        return None
    return float(speed.max()), float(speed[-max(speed.size // 10, 5) :].max())


def _command_names(case: Case, record: Record) -> list[str]:
    first = f"{case.cylinder}."
    return [c for c in record.channels if c.startswith(first) and c.endswith(".command")]


def _chatter(case: Case, record: Record, values: np.ndarray, window: float) -> float:
    """A command's largest swing within a window [s], in one function and in motion."""
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
