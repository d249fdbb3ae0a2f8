"""Trials under a controller in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.captions import (
    capital,
    error_of,
    load_name,
    measure,
    percent,
    sentence,
    span,
)
from ehbench.report.cases import SLOW, Case, damping, payloads_carried
from ehbench.report.saved import Table
from ehbench.report.trial_tables import limits_of
from ehbench.report.words import count, number, pretty, shown, unit_of, words
from ehbench.vocabulary import codes

# channels of what an adaptive law has learnt, in the order of the figure: the payload, not its
# share
ESTIMATES = ("payload_estimate", *(word for word in codes.ESTIMATES if word != "payload_share"))
SINCE = 1.0  # [s] after a change of payload, before which an estimate is not judged
_OF = {"v": "speed", "a": "acceleration"}
LEARNT = 0.1  # of a change of payload that an estimate may still miss
ROUNDING = 1e-9  # share of its bounds by which a logged estimate may lie outside


def step_caption(rig: Rig, item: Table) -> str:
    """What came of a step, with what could not be read off."""
    share = f" ({percent(item['share'], 3)})" if item.get("share") is not None else ""
    requested = f"asked for {measure(rig, 'v', item['speed'])}{share}"
    steady = (
        f"steady at {measure(rig, 'v', item['steady_speed'])} ({percent(item['steady_error'])})"
    )
    ringing = _damping_caption(item)
    if item.get("natural_frequency") is not None:
        ringing += f" at {measure(rig, 'natural_frequency', item['natural_frequency'], 2)}"
    overshoot = _overshoot_caption(item, "overshoot not to be told")
    return ", ".join([requested, steady, overshoot, _settling_caption(item), ringing])


def _overshoot_caption(item: Table, unknown: str) -> str:
    return unknown if item.get("overshoot") is None else f"overshoot {percent(item['overshoot'])}"


def _settling_caption(item: Table) -> str:
    if item.get("settling_time") is None:
        return "not settled"
    return f"settled after {number(item['settling_time'], 2)} s"


def tracking_caption(rig: Rig, row: Table) -> str:
    """How well a motion was tracked."""
    unit = pretty(unit_of(rig, "x"))
    largest, rms, final = (
        f"{error_of(rig, row, 'tracking', key)} {unit}"
        for key in ("max_error", "rms_error", "final_error")
    )
    text = f"largest error {largest}, rms {rms}, at the end {final}"
    if row.get("tracking_true"):
        text += f"; of the true stroke {error_of(rig, row, 'tracking_true', 'max_error')} {unit}"
    text += f" (medians and ranges of {row['seeds']} runs)" if row.get("seeds") else ""
    if not row.get("tip"):
        return text
    return f"{tip_caption(rig, row)}; {row['cylinder']}: {text}"


def tip_caption(rig: Rig, row: Table) -> str:
    """How near the tip kept to where it should be."""
    largest, rms, across = (
        measure(rig, "tip_error", row["tip"][key])
        for key in ("max_error", "rms_error", "max_across")
    )
    return f"the tip: largest error {largest}, rms {rms}, across its way {across}"


def sharing_caption(rig: Rig, row: Table) -> str:
    """Whether the pump had enough for all cylinders, and what came of it."""
    share = row["sharing"]
    desired, limit = share["flow_demand"], share.get("flow_limit")
    text = f"As it is desired, the motion draws {measure(rig, 'flow', desired)} at the most"
    if limit is None:
        return f"{text}."
    text += f", of {measure(rig, 'flow', limit)} that the pump gives"
    if share["slowed"] > 0.0:
        return (
            f"{text}: so it ran slower for {number(share['slowed'], 3)} s, at "
            f"{percent(share['pace'])} of its pace at the least, and took "
            f"{number(share['longer'], 3)} s longer; all cylinders by one proportion, so that the "
            "tip keeps to its way."
        )
    short = "; it was not slowed down for it" if desired > limit else ""
    return f"{text}{short}."


def trajectory_words(rig: Rig, case: Case, record: Record) -> str:
    """How far, how fast and how sharply a motion is asked for."""
    own = case.cylinder
    maximum = {
        word: float(np.abs(record[f"{own}.{word}_desired"]).max())
        for word in _OF
        if f"{own}.{word}_desired" in record
    }
    x = record[f"{own}.x_desired"]
    ends = span([float(shown(rig, "x", float(end))) for end in (x.min(), x.max())])
    parts = [f"{ends} {pretty(unit_of(rig, 'x'))}"]
    parts += [f"{_OF[word]} up to {measure(rig, word, top)}" for word, top in maximum.items()]
    return ", ".join(parts)


def limits_caption(row: Table) -> str:
    """Share of the time that edges were at each limit; nothing where they never were."""
    met, means = limits_of(row), codes.LIMITS_MEAN | codes.STATUS_MEANS
    met = {name: share for name, share in met.items() if share > 0.0}
    shares = [
        f"{words(name)} {percent(share)} of the time ({means.get(name, 'a limit')})"
        for name, share in met.items()
    ]
    return "; at a limit: " + ", ".join(shares) if shares else ""


def gave(rig: Rig, energy: Table) -> str:
    """What the pump gave and, of two rails, what of it was the low one's."""
    whole = measure(rig, "energy", energy["pump"], 4)
    if "low_rail" not in energy:
        return f"the pump gave {whole}"
    low = measure(rig, "energy", energy["low_rail"], 4)
    return f"the pumps gave {whole}, that of the low rail {low}"


def case_caption(rig: Rig, case: Case) -> str:
    """What one trial came to."""
    row = case.row
    steps = "; ".join(step_caption(rig, step) for step in case.steps)
    law = words(row["controller"].removesuffix(f", {case.cylinder}"))
    text = (
        f"{load_name(row['payload'])}, {law}, on the {row['on']}: "
        f"{steps or tracking_caption(rig, row)}"
        f"; {gave(rig, row['energy'])}"
    )
    stopped = f". Stopped: {row['stopped']}" if row.get("stopped") else ""
    return sentence(text + limits_caption(row) + stopped)


def compared_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """What each controller came to on one motion."""
    sentences = []
    for case in cases:
        text = "; ".join(_step_in_short(step) for step in case.steps)
        stopped = ", stopped by a limit" if case.row.get("stopped") else ""
        result = text or tracking_caption(rig, case.row)
        sentences.append(capital(f"{words(case.row['controller'])}: {result}{stopped}"))
    return sentence(". ".join(sentences)) + _best(cases)


def _step_in_short(item: Table) -> str:
    overshoot = _overshoot_caption(item, "no overshoot to be told")
    steady = f"steady error {percent(item['steady_error'])}"
    return f"{overshoot}, {steady}, {_settling_caption(item)}, {_damping_caption(item)}"


def _damping_caption(item: Table) -> str:
    ratio, doubt = damping(item)
    if ratio is None:
        return "no damping ratio" + (f": {doubt}" if doubt else "")
    if doubt:
        return f"damping ratio about {number(ratio, 2)} ({doubt})"
    return f"damping ratio {number(ratio, 2)}"


def _best(cases: Sequence[Case]) -> str:
    """Which controller does best and which worst by one number, where they differ; one that was
    stopped is no match.
    """
    results = []
    for case in cases:
        values = [step.get("overshoot") for step in case.steps] or [
            case.row["tracking"]["max_error"]
        ]
        if None not in values and case.fit:
            results.append((max(values), case.row["controller"]))
    if len(results) < 2 or min(results)[0] == max(results)[0]:
        return ""
    (low, best), (high, worst) = min(results), max(results)
    what = "overshoot" if cases[0].steps else "largest error"
    times = f", {number(high / low, 3)} times as much" if low > 0.0 else ""
    return f" Best by {what}: {words(best)}; worst: {words(worst)}{times}."


def energy_caption(rig: Rig, cases: Sequence[Case]) -> str:
    """For each payload, who takes least and most from the pump, and how far from where it should be
    it ended.
    """
    sentences = []
    for payload in dict.fromkeys(case.row["payload"] for case in cases):
        fit = [case for case in cases if case.row["payload"] == payload and case.fit]
        fit.sort(key=lambda case: case.row["energy"]["pump"])
        if fit:
            sentences.append(capital(_least_and_most(rig, payload, fit[0], fit[-1])))
    if any(case.row.get("stopped") for case in cases):
        sentences.append("Trials that a limit stopped are left out")
    slow = dict.fromkeys(
        words(case.row["controller"])
        for case in cases
        if not case.fit and not case.row.get("stopped")
    )
    if slow:
        names = ", ".join(slow)
        sentences.append(f"Left out, more than {percent(SLOW)} off the speed asked: {names}")
    sources = dict.fromkeys(case.row["energy"]["source"] for case in cases)
    return ". ".join([*sentences, f"Source: {'; '.join(sources)}"]) + "."


def map_caption(panels: Sequence[tuple[str, np.ndarray]]) -> str:
    """How far each controller's energies, shape (loads, speeds), lie above the least of all."""
    minimum = np.fmin.reduce([energies for _, energies in panels])
    parts = []
    for name, energies in panels:
        above = 100.0 * (energies / minimum - 1.0)
        above = above[np.isfinite(above)]
        if above.size:
            parts.append(f"{name} {span([round(float(v), 1) for v in above])} %")
    return f"Above the least that any takes at that load and speed: {', '.join(parts)}."


def _least_and_most(rig: Rig, payload: str, least: Case, maximum: Case) -> str:
    low, high = (case.row["energy"]["pump"] for case in (least, maximum))
    text = f"least from the pump, {load_name(payload)}: {_energy_of(rig, least)}"
    if high > low:
        text += f"; {percent(1.0 - low / high)} less than the most, {_energy_of(rig, maximum)}"
    return text


def _energy_of(rig: Rig, case: Case) -> str:
    off = measure(rig, "x", case.row["tracking"]["final_error"], 2)
    energy = measure(rig, "energy", case.row["energy"]["pump"], 4)
    return f"{words(case.row['controller'])}, {energy} (ended {off} from the desired stroke)"


def estimates_caption(rig: Rig, case: Case, record: Record) -> str:
    """Where the estimates ended, beside what they should be where that is known."""
    ends = {
        word: float(record[name][-1])
        for word in ESTIMATES
        if (name := f"{case.cylinder}.{word}") in record
    }
    values = ", ".join(f"{words(word)} {measure(rig, word, end)}" for word, end in ends.items())
    text = f"At the end: {values}"
    carried = payloads_carried(rig, case.row)
    if carried and "payload_estimate" in ends:
        text += _payload_caption(rig, case, record, carried)
    felt = f"{case.cylinder}.bulk_measured"
    if felt in record and np.ptp(record[felt]) > 0.0:
        first, last = (measure(rig, "bulk_modulus", float(record[felt][i])) for i in (0, -1))
        text += f". Pressures and flows tell an oil of {last}, the design's has {first}"
    return text + _bounds_caption(case, record) + "."


def _payload_caption(
    rig: Rig, case: Case, record: Record, carried: Sequence[tuple[float, float]]
) -> str:
    """What the payload estimate said at the first tick, how it followed each change, and where it
    ended.
    """
    t, estimate = record.t, record[f"{case.cylinder}.payload_estimate"]
    (_, first), (_, last) = carried[0], carried[-1]
    pressures = (
        "the wrong first pressures" if case.row.get("first_pressure_error") else "the pressures"
    )
    text = (
        f". The payload has the moment of {measure(rig, 'mass', first)} at the end of the last "
        f"link. At the first tick, before any adaptation, {pressures} at rest say "
        f"{measure(rig, 'mass', float(estimate[0]))}"
    )
    ends = [*(at for at, _ in carried[2:]), math.inf]
    for (_, before), (at, mass), until in zip(carried, carried[1:], ends, strict=False):
        own = (t >= at) & (t < until)
        text += f". From {number(at, 3)} s on it is {measure(rig, 'mass', mass)}, "
        text += _followed(t[own] - at, estimate[own] - mass, LEARNT * abs(mass - before))
    off = measure(rig, "mass", abs(float(estimate[-1]) - last))
    text += f". The estimate ends {off} from it"
    return text + _weighed_caption(rig, case, record, carried)


def _weighed_caption(
    rig: Rig, case: Case, record: Record, carried: Sequence[tuple[float, float]]
) -> str:
    """How far off in motion the payload is that pressures and motion tell, and how often its
    interval holds the truth.
    """
    names = [f"{case.cylinder}.payload_{word}" for word in ("measured", "low", "high")]
    if not all(name in record for name in names):
        return ""
    measured, low, high = (record[name] for name in names)
    times, masses = zip(*carried, strict=True)
    last = np.searchsorted(times, record.t, side="right") - 1
    truth = np.array(masses)[last]
    news = (last > 0) & (record.t - np.array(times)[last] < SINCE)
    moving = (np.abs(record[f"{case.cylinder}.v_desired"]) > 0.0) & ~news
    if not moving.any():
        return ""
    off = np.abs(measured - truth)[moving]
    fixed = float(np.mean((low <= truth) & (truth <= high)))
    message = measure(rig, "mass", float(np.quantile(off, 0.95)))
    after = f", from {number(SINCE)} s after a change on" if news.any() else ""
    return (
        f". By least squares over pressures and motion it is known to {message} for 95 % of the "
        f"time in motion{after}; the interval holds it {percent(fixed, 3)} of all time"
    )


def _followed(since: np.ndarray, off: np.ndarray, least: float) -> str:
    """When an estimate came to stay within ``least`` of the truth, by how far it is ``off``."""
    beyond = np.flatnonzero(np.abs(off) > least)
    share = percent(LEARNT)
    if beyond.size and beyond[-1] + 1 == off.size:
        return f"not learnt to within {share} of the change"
    after = since[beyond[-1] + 1] if beyond.size else 0.0
    return f"learnt to within {share} of the change in {number(float(after), 2)} s"


def _bounds_caption(case: Case, record: Record) -> str:
    """Whether the estimates kept to their bounds, and which ended at one."""
    bounds, outside, at_end = case.row.get("estimate_bounds", {}), [], []
    known = [word for word in ESTIMATES if word in bounds and f"{case.cylinder}.{word}" in record]
    for word in known:
        values, (low, high) = record[f"{case.cylinder}.{word}"], bounds[word]
        room = ROUNDING * (high - low)
        if values.min() < low - room or values.max() > high + room:
            outside.append(words(word))
        elif values[-1] <= low + room or values[-1] >= high - room:
            at_end.append(words(word))
    if not known:
        return ""
    text = ". All estimates stay within their bounds"
    if outside:
        text = f". Not within its bounds all the time: {', '.join(outside)}"
    return text + (f"; at its bound in the end: {', '.join(at_end)}" if at_end else "")


def sankey_caption(ledger: Table) -> str:
    """How far a ledger closes."""
    share = ledger.get("residual_share")
    from_model = ledger["source"] == "model"
    source = "the model's own flows" if from_model else "measured channels and the rig file's maps"
    rest = "" if share is None else f"; {percent(share)} of the pump's energy is not accounted for"
    return f"From {source}{rest}."


def trials_caption(cases: Sequence[Case]) -> str:
    """How many trials there are, of what."""
    if not cases:
        return "No trial."
    machines = ", ".join(dict.fromkeys(case.row["on"] for case in cases))
    payloads = count(len({case.row["payload"] for case in cases}), "payload")
    motions = count(len({case.row["motion"] for case in cases}), "motion")
    controllers = count(len({case.row["controller"] for case in cases}), "controller")
    trials = count(len(cases), "trial")
    return f"{trials} on the {machines}: {controllers}, {payloads}, {motions}."


def controller_captions(rig: Rig, cases: Sequence[Case]) -> Iterator[str]:
    """For each controller how it did over all payloads and motions."""
    for controller in dict.fromkeys(case.row["controller"] for case in cases):
        own = [case for case in cases if case.row["controller"] == controller]
        steps = [step for case in own for step in case.steps]
        if steps:
            text = _steps_in_all(steps)
        elif len(own) == 1:
            text = tracking_caption(rig, own[0].row)
        else:
            text = _motions_in_all(rig, own)
        yield f"{capital(words(controller))}: {text}."


def _steps_in_all(steps: Sequence[Table]) -> str:
    """Spans of steady error, overshoot and damping ratio over some steps."""
    overshoots = [100.0 * step["overshoot"] for step in steps if step.get("overshoot") is not None]
    overshoot = "no overshoot to read"
    if overshoots:
        overshoot = f"overshoot {span(overshoots, 2)} %{_of(overshoots, steps)}"
    ringing = [(ratio, doubt) for step in steps for ratio, doubt in [damping(step)]]
    clear = [ratio for ratio, doubt in ringing if ratio is not None and not doubt]
    rough = [ratio for ratio, doubt in ringing if ratio is not None and doubt]
    ratios = [f"{span(clear, 2)}{_of(clear, steps)}"] if clear else []
    if rough:
        ratios.append(f"about {span(rough, 2)} where it hardly rings{_of(rough, steps)}")
    damped = f"damping ratio {', '.join(ratios)}" if ratios else "no damping ratio to read"
    steady = f"steady error {span([100.0 * step['steady_error'] for step in steps], 2)} %"
    return f"{steady}, {overshoot}, {damped}"


def _of(some: Sequence[float], steps: Sequence[Table]) -> str:
    """How many of the steps a range is of, where not of all."""
    return f" ({len(some)} of {len(steps)})" if len(some) < len(steps) else ""


def _motions_in_all(rig: Rig, cases: Sequence[Case]) -> str:
    maximum = span([float(shown(rig, "x", case.row["tracking"]["max_error"])) for case in cases])
    energy = span([float(shown(rig, "energy", case.row["energy"]["pump"])) for case in cases], 4)
    return (
        f"largest error {maximum} {pretty(unit_of(rig, 'x'))}, "
        f"{energy} {pretty(unit_of(rig, 'energy'))} from the pump"
    )
