"""Sensitivity to fixed parameters: what a fit took as known, what the logs favour instead, and the
estimates that would then leave their intervals.

Every row of the fault table that the fit does not estimate is asked. An interval is of noise,
initial states and stated errors. A fixed number that is wrong by Δ moves the estimates by
``−(JᵀJ)⁻¹ Jᵀj Δ``, J being their sensitivities and j that of the number (Ljung, System
Identification, 2nd ed., 9.4). Where the logs favour another value, and an estimate would leave its
interval for it, the number is freed in a further fit before it is reported."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ehbench.diagnosis.faults import Hypothesis, hypotheses
from ehbench.identification.covariance import Block, Prior, Release, gains_of, release_of
from ehbench.identification.descent import solve
from ehbench.identification.problem import (
    Problem,
    State,
    above_noise,
    by_channel,
    cost,
    evaluate,
    initial,
    prior_of,
    problem_of,
    scaled,
    start_jacobian,
)
from ehbench.identification.results import Doubts, Lean, Moved
from ehbench.identification.search import coordinates
from ehbench.identification.simulator import Effort, Log, Simulator
from ehbench.identification.uncertainty import Errors, errors_of
from ehbench.plant.ties import position_channel, tied_words
from ehbench.preprocessing.sensors import VAGUE, Term
from ehbench.signals.series import lowpass
from ehbench.vocabulary import Z95, EhbenchError, Message, message, setting
from ehbench.vocabulary.terms import BEYOND

IMPOSSIBLE = (EhbenchError, ValueError, ArithmeticError, np.linalg.LinAlgError)


@dataclass(frozen=True)
class SensitivitySettings:
    """Numbers of the sensitivity to fixed parameters."""

    surely: float = setting(
        4.0,
        "",
        "standard errors by which the logs must favour another value",
        "one in 16 000 by chance: fifty rows are asked of each fit",
    )
    worth: float = setting(
        0.05,
        "",
        "share of the squares above the readings' noise that another value must explain",
        "less does not show in a fit percentage",
    )
    alike: float = setting(
        0.5,
        "",
        "share of what the best explains from which another is reported",
        "the machine may lack both: leakage past the piston and to the outside",
    )
    looked: int = setting(
        8, "", "rows that promise most, which are asked of every log", "some of each kind"
    )
    effort: float = setting(
        0.2, "", "share of the fit's simulations that this may take", "what people would wait for"
    )
    quick: float = setting(
        600.0, "", "simulations that a fit of fewer counts as", "no row of a cylinder is left out"
    )
    first: float = setting(
        0.6, "", "share of these that ask each row of one log", "the rest asks the best of all"
    )


SETTINGS = SensitivitySettings()


@dataclass(frozen=True, eq=False)
class _Suspect:
    """A row with by how much δ changes the scaled residuals of some logs (``logs``, by index),
    shape (samples, channels), the share of the squares that its best δ explains, that δ, the steps
    of what is live that follow it and the estimates that would move.
    """

    row: Hypothesis
    columns: list[np.ndarray]
    logs: tuple[int, ...]
    explains: float = math.nan
    delta: float = math.nan
    follow: np.ndarray = field(default_factory=lambda: np.array([]))
    moved: tuple[Moved, ...] = ()

    @property
    def beyond(self) -> float:
        return self.moved[0].halves if self.moved else 0.0


def doubts_of(fit: Problem, state: State, result: Errors) -> Doubts:
    """What a fit took as known, and the logs deny. It takes a share of the simulations that the fit
    took: the least sure numbers are asked first, each of the log that is followed worst, the most
    promising of all logs, and these are freed while the share lasts.
    """
    above = above_noise(fit, state)
    if above < SETTINGS.worth:
        return Doubts()
    effort, took = Effort(), max(fit.simulator.effort.evaluations, SETTINGS.quick)
    limit = SETTINGS.effort * took
    screened, unasked = _screened(fit, state, effort, round(SETTINGS.first * limit))
    suspects = _promising(fit, result, screened, effort, above)
    warnings = []
    for item in [item for item in suspects if item.row.kind == "gain"][:1]:
        std = _release(fit, result, item, 0.0).std
        if abs(item.delta) > SETTINGS.surely * std:
            fields = {
                "name": ", ".join(item.row.parameters),
                "move": 100.0 * item.delta,
                "half": 100.0 * Z95 * std,
                "share": item.explains,
                "remedy": item.row.remedy(fit.simulator.rig, item.delta),
            }
            warnings.append(message("identification.gain_fixed", **fields))
    confirmed: list[tuple[Hypothesis, Lean]] = []
    # to first order about a wrong fit half of what a number moves is easily missed
    for item in [item for item in suspects if 2.0 * item.beyond > BEYOND]:
        if effort.evaluations >= limit:
            unasked = (*unasked, item.row.name)
            continue
        pair = _confirmed(fit, result, item, effort, above)
        within = pair is not None and pair[1].beyond <= BEYOND and effort.evaluations < limit
        if within and state.ranges:
            # a wrong model may have taken these to where no slope leads away: from their start
            freed = result.with_ranges()
            back = {i: fit.search[i].begin - state.theta[i] for i in state.ranges}
            follow = np.array([back.get(i, 0.0) for i in freed.state.live])
            again = _confirmed(fit, freed, replace(item, follow=follow), effort, above)
            pair = max(filter(None, (pair, again)), key=lambda pair: pair[1].explains)
        confirmed += [] if pair is None else [pair]
    explained = [item.explains for item in (*suspects, *(i for _, i in confirmed))]
    likely = [
        (row, item)
        for row, item in confirmed
        if item.explains >= SETTINGS.alike * max(explained) and item.beyond > BEYOND
    ]
    left = 1.0 - max((item.explains for _, item in likely), default=0.0)
    likely.sort(
        key=lambda pair: (
            (False, pair[0].certainty, -pair[1].explains)
            if SETTINGS.alike * (1.0 - pair[1].explains) <= left
            else (True, -pair[1].explains)
        )
    )
    leans = tuple(replace(i, sentence=_sentence(fit, row, i)) for row, i in likely)
    return Doubts(tuple(warnings), leans, unasked)


def _fixed_rows(fit: Problem, state: State) -> list[Hypothesis]:
    """The rows of the fault table that a fit takes as known."""
    simulator, logs = fit.simulator, fit.logs
    values = {n: v for n, v in fit.by_name(state.theta).items() if n in simulator.known}
    cylinders = list(dict.fromkeys(name for log in logs for name in log.commanded))
    tied = [position_channel(log.record, name) for log in logs for name in log.commanded]
    tied = [name for name in tied if name and all(tied_words(log.record) for log in logs)]
    channels = list(dict.fromkeys([*(name for log in logs for name in log.channels), *tied]))
    records, rig = [log.record for log in logs], simulator.rig.with_values(values)
    terms = {(t.channel, t.word) for log in logs for t in log.start.terms if t.std > 0.0}
    spectra = any(log.band is not None for log in logs)
    rows = hypotheses(rig, cylinders, channels, records, simulator.maps)
    return [
        row
        for row in (row.without(simulator.names, ()) if row.edits else row for row in rows)
        if row.row.step != 0.0
        and (not row.alike or row.kind == "gain")
        and row.kind != "drift"
        and (row.numbers or row.readings)
        and not {*row.parameters} & {*simulator.names}
        and not {(channel, word) for channel, word, _ in row.readings} & terms
        and not (spectra and row.readings)
    ]


def _terms(
    rows: Sequence[Hypothesis], std: bool = False, logs: Sequence[Log] = ()
) -> tuple[Term, ...]:
    """What is asked of sensors, from what ``logs`` know of it, with a wide prior where it is to be
    fitted."""
    every = {(c, w): unit for row in rows for c, w, unit in row.readings}
    known = {(t.channel, t.word): t.known for log in logs for t in log.start.terms}
    terms = []
    for (c, w), unit in every.items():
        wide = VAGUE[w] * (4.0 * unit if w == "offset" else 1.0)
        terms.append(Term(c, w, known.get((c, w), 0.0), 1.0, wide * std, False))
    return tuple(terms)


def _with_terms(logs: Sequence[Log], terms: Sequence[Term]) -> list[Log]:
    """Logs with these terms, in place of what they have of the same names."""
    names, results = {term.name for term in terms}, []
    for log in logs:
        others = (term for term in log.start.terms if term.name not in names)
        results.append(replace(log, start=replace(log.start, terms=(*others, *terms))))
    return results


def _screened(
    fit: Problem, state: State, effort: Effort, count: int
) -> tuple[list[_Suspect], tuple[str, ...]]:
    """(the rows that change something in the log that is followed worst of those that show them, or
    in all logs where no simulation is needed for it; the names of rows beyond ``count``).
    """
    rows, left = _fixed_rows(fit, state), [float(np.sum(r**2)) for r in scaled(fit, state)]
    shown = {row: _read_off(fit, state, row) for row in rows}
    simulated = [row for row in rows if shown[row] is None]
    simulated.sort(key=lambda row: row.certainty)
    worst = {
        row: max(_logs_of(fit, row), key=left.__getitem__, default=0) for row in simulated[:count]
    }
    every = tuple(range(len(fit.logs)))
    suspects = [_Suspect(row, parts, every) for row, parts in shown.items() if parts is not None]
    columns = _columns(fit, state, {row: [k] for row, k in worst.items()}, effort)
    for row, parts in columns.items():  # nothing changes in the logs that do not show it
        known = {worst[row], *every} - {k for k in _logs_of(fit, row) if k != worst[row]}
        suspects.append(_Suspect(row, parts, tuple(sorted(known))))
    suspects = [item for item in suspects if any(map(np.any, item.columns))]
    return suspects, tuple(row.name for row in simulated[count:])


def _logs_of(fit: Problem, row: Hypothesis) -> list[int]:
    """Logs, by index, in which a row may show."""
    loads = {log.payload for log in fit.logs if log.payload}
    load = next((load for load in loads if row.about.startswith(f"{load}.")), None)
    return [
        k
        for k, log in enumerate(fit.logs)
        if row.cylinder in ("", *log.commanded) and load in (None, log.payload)
    ]


def _read_off(fit: Problem, state: State, row: Hypothesis) -> list[np.ndarray] | None:
    """What a row of a compared channel's sensor changes, to first order, for which nothing is
    simulated: its reading, and with it the pressure at which a log begins; None for other rows.
    """
    if row.numbers or len(row.readings) != 1:
        return None
    ((channel, word, unit),) = row.readings
    if not all(channel in log.channels for log in fit.logs):
        return None
    results, begun = [], start_jacobian(fit, state)
    for log, residual, slopes in zip(fit.logs, state.here.residuals, begun, strict=True):
        i, size = log.channels.index(channel), by_channel(state.scales, log)
        seen = log.recorded[:, i] + residual[:, i]
        by = {"offset": np.full_like(seen, unit), "scale": unit * seen}.get(word)
        change = np.zeros_like(residual)
        change[:, i] = -unit * np.gradient(seen, log.sample_time) if by is None else by
        change = lowpass(change, log.sample_time, fit.cutoff) if fit.cutoff else change
        change = change * log.counts / size
        if by is not None:
            moved = [n.std for n in log.start.uncertain if n.name == channel]
            at = [j for j, n in enumerate(log.start.uncertain) if n.name == channel]
            change -= slopes[..., at] @ (by[0] / np.array(moved))
        results.append(change)
    return results


def _columns(
    fit: Problem, state: State, rows: Mapping[Hypothesis, Sequence[int]], effort: Effort
) -> dict[Hypothesis, list[np.ndarray]]:
    """What rows change in some logs each, none in the others: those of numbers that the rig has at
    once, those of sensors at once, each of those that alter the rig by itself.
    """
    numbers = [row for row in rows if not row.edits and row.numbers]
    sensors = [row for row in rows if row.readings and row not in numbers]
    results: dict[Hypothesis, list[np.ndarray]] = {}
    for group in [numbers, sensors, *([row] for row in rows if row.edits and not row.readings)]:
        if not group:
            continue
        simulator, here, alters = fit.simulator, state.here, group not in (numbers, sensors)
        each = {n.name: n for row in group for n in row.numbers if group is not sensors}
        terms = _terms(group, logs=fit.logs) if group is sensors else ()
        logs = _with_terms(fit.logs, terms)
        names = [*simulator.names, *each, *(term.name for term in terms)]
        try:
            rig = group[0].altered(simulator.rig) if alters else simulator.rig
        except IMPOSSIBLE:
            continue
        built = Simulator(rig, logs, names, simulator.maps, simulator.workers, simulator.step)
        built.effort = effort
        points, keys = [], []
        for row in group:
            changed = {n.name: n.at(row.inside) for n in row.numbers}
            changed |= {f"{c}.{w}": row.inside * unit for c, w, unit in row.readings}
            vector = [
                *fit.values(here.theta),
                *(changed.get(name, number.here) for name, number in each.items()),
                *(changed.get(term.name, 0.0) for term in terms),
            ]
            points += [(vector, k, here.shifts[k]) for k in rows[row]]
            keys += [(row, k) for k in rows[row]]
        steps = None if alters else here.mesh.steps
        some = {row: [np.zeros_like(left) for left in here.residuals] for row in group}
        for (row, k), simulated in zip(keys, built.each(points, steps)[0], strict=True):
            if simulated is None:
                some.pop(row, None)
            elif row in some:
                change = fit.residual(fit.logs[k], simulated) - here.residuals[k]
                some[row][k] = change / (row.inside * by_channel(state.scales, fit.logs[k]))
        results |= some
    return results


def _promising(
    fit: Problem, result: Errors, every: Sequence[_Suspect], effort: Effort, above: float
) -> list[_Suspect]:
    """Those by which the logs would be followed better, to first order: the likeliest first, of
    those that are as likely the less sure number first. ``above`` is the share above noise.
    """
    state = result.state
    live, total = list(state.live), cost(fit, state)
    prior, minimum = prior_of(fit, state, live), SETTINGS.worth * above * total
    gains: list[tuple[float, _Suspect]] = []
    for which in dict.fromkeys(item.logs for item in every):
        alike = [item for item in every if item.logs == which]
        gains += zip(gains_of(_with(result, alike), prior), alike, strict=True)
    gains = [pair for pair in gains if pair[0] > minimum / len(fit.logs)]
    best = [item for _, item in sorted(gains, key=lambda pair: -pair[0])[: SETTINGS.looked]]
    rest = {i.row: [k for k in _logs_of(fit, i.row) if k not in i.logs] for i in best}
    more = _columns(fit, state, {row: which for row, which in rest.items() if which}, effort)
    suspects = []
    for item in best:
        if rest[item.row] and item.row not in more:
            continue
        parts = zip(item.columns, more.get(item.row, item.columns), strict=True)
        columns = [old if k in item.logs else new for k, (old, new) in enumerate(parts)]
        item = replace(item, columns=columns, logs=tuple(range(len(columns))))
        release = _release(fit, result, item, math.inf)
        delta = min(max(release.move, item.row.bounds[0]), item.row.bounds[1])
        if delta == 0.0 or release.gain < minimum:
            continue
        follow = release.follow * delta / release.move
        known = {"explains": release.gain / total, "delta": delta, "follow": follow}
        moved = _moved(fit, result, state.theta[live] + follow)
        suspects.append(replace(item, moved=moved, **known))
    likely = SETTINGS.alike * max((item.explains for item in suspects), default=math.nan)
    return sorted(
        suspects,
        key=lambda s: (
            (False, s.row.certainty, -s.explains) if s.explains >= likely else (True, -s.explains)
        ),
    )


def _release(fit: Problem, result: Errors, item: _Suspect, minimum: float) -> Release:
    """What freeing a row would do, to first order; arguments as of `release_of`."""
    prior = prior_of(fit, result.state, list(result.state.live))
    sharpness, off = (np.append(item, 0.0) for item in (prior.sharpness, prior.off))
    known = Prior(sharpness, off, prior.weight)
    return release_of(_with(result, [item]), known, minimum)


def _with(result: Errors, some: Sequence[_Suspect]) -> list[Block]:
    """What each log that they were asked of says, with some fixed numbers after those that are
    fitted.
    """
    return [
        replace(
            result.blocks[k],
            jacobian=np.concatenate(
                [result.blocks[k].jacobian, *(item.columns[k][..., None] for item in some)],
                axis=-1,
            ),
        )
        for k in some[0].logs
    ]


def _moved(fit: Problem, result: Errors, theta: np.ndarray) -> tuple[Moved, ...]:
    """How far estimates would be off by their intervals with other search coordinates of what is
    live.
    """
    moved = []
    for i, there in zip(result.state.live, theta, strict=True):
        error, c = result.by_index[i], fit.search[i]
        if i >= fit.requested or error.kind == "not_excited" or error.std <= 0.0:
            continue
        here = float(result.state.theta[i])
        there = min(max(float(there), c.bounds[0]), c.bounds[1])
        halves = abs(there - here) / (error.quantile * error.std)
        moved.append(Moved(c.name, c.at(here), c.at(there), halves))
    return tuple(sorted(moved, key=lambda item: -item.halves))


def _confirmed(
    fit: Problem, result: Errors, item: _Suspect, effort: Effort, above: float
) -> tuple[Hypothesis, Lean] | None:
    """A row by a fit in which it is free; None where that has it otherwise. ``above`` as above."""
    row, state = item.row, result.state
    try:
        freed, begin, new = _freed(fit, state, item, effort)
        if cost(freed, begin) > cost(fit, state):  # slopes may not reach so far
            back = [result.by_index[i].source == "range" for i in state.live]
            alone = replace(item, follow=np.where(back, item.follow, 0.0))
            starts = ((freed, begin, new), _freed(fit, state, alone, effort))
            freed, begin, new = min(starts, key=lambda start: cost(start[0], start[1]))
        end, _ = solve(freed, begin, 1e-3, secant=True)
        there = errors_of(freed, evaluate(freed, end))
    except IMPOSSIBLE:
        return None
    index = {c.name: i for i, c in enumerate(freed.search)}
    after, before = cost(freed, there.state), cost(fit, state)
    number = next((n for n in row.numbers if n.unit != 0.0 and n.name in index), None)
    at = new[0] if number is None else index[number.name]
    c, terms = freed.search[at], freed.logs[0].start.terms
    known = next((term.known for term in terms if term.name == c.name), 0.0)
    here, unit = (number.here, number.unit) if number is not None else (known, row.readings[0][2])
    value = known + c.at(there.state.theta[at])
    std = (value if c.log else c.unit) * there.by_index[at].std
    worth = SETTINGS.worth * above * before
    if abs(value - here) <= SETTINGS.surely * std or before - after < worth:
        return None
    live = [index[fit.search[i].name] for i in state.live]
    moved = _moved(fit, result, there.state.theta[live])
    found, rig = freed.by_name(there.state.theta), fit.simulator.rig
    rig = rig.with_values({n: v for n, v in found.items() if n in fit.simulator.known})
    remedy = row.remedy(rig, (value - here) / unit)
    return row, Lean(c.name, here, value, std, 1.0 - after / before, moved, remedy)


def _freed(
    fit: Problem, state: State, item: _Suspect, effort: Effort
) -> tuple[Problem, State, list[int]]:
    """(the problem in which a row is free, where its descent begins, with all derivatives that are
    known, and which of its parameters are new).

    Raises:
        EhbenchError, ValueError, ArithmeticError: there is no such rig.
    """
    row, old = item.row, fit.simulator
    sensor = bool(row.readings) and (bool(row.edits) or not row.numbers)
    terms = _terms([row], True, fit.logs) if sensor else ()
    starts = {} if sensor else {n.name: n.begin(item.delta) for n in row.numbers}
    rig = old.rig if sensor else row.altered(old.rig)
    more = coordinates(rig, [*starts], starts, upper=row.upper) if starts else []
    names = [*old.names[: fit.requested], *starts, *old.names[fit.requested :]]
    names += [term.name for term in terms]
    simulator = Simulator(rig, _with_terms(fit.logs, terms), names, old.maps, old.workers, old.step)
    simulator.effort = effort
    search = [*fit.search[: fit.requested], *more]
    freed = problem_of(simulator, search, None, fit.max_iterations, fit.cutoff)
    index = {c.name: i for i, c in enumerate(freed.search)}
    units = {n.name: n.unit for n in row.numbers} if starts else {}
    units |= {f"{c}.{w}": unit for c, w, unit in (row.readings if sensor else ())}
    begin = initial(freed)
    for c, theta in zip(fit.search, state.theta, strict=True):
        begin.theta[index[c.name]] = theta
    for i, by in zip(state.live, item.follow, strict=True):
        c = fit.search[i]
        begin.theta[index[c.name]] = min(max(state.theta[i] + by, c.bounds[0]), c.bounds[1])
    for term in terms:
        at = index[term.name]
        begin.theta[at] = item.delta * units[term.name] / freed.search[at].unit
    new = [index[name] for name in units]
    begin = replace(
        begin,
        shifts=state.shifts,
        scales=state.scales,
        free=tuple(sorted((*(index[fit.search[i].name] for i in state.live), *new))),
        prior_weight=state.prior_weight,
        coarse=False,
    )
    point = evaluate(freed, begin).here
    point.start_columns.update(state.here.start_columns)
    for (i, k), column in state.here.columns.items():
        point.columns[index[fit.search[i].name], k] = column
    if len(new) == 1:  # of several that δ moves together each is simulated
        c, (unit,) = freed.search[new[0]], units.values()
        per = (c.at(begin.theta[new[0]]) if c.log else c.unit) / unit
        for k, column in enumerate(item.columns):
            point.columns[new[0], k] = column * by_channel(state.scales, fit.logs[k]) * per
    return freed, replace(begin, point=point), new


def _sentence(fit: Problem, row: Hypothesis, item: Lean) -> Message:
    """A fixed number, what the logs favour, what becomes of the estimates, and what to do."""
    rig, maximum = fit.simulator.rig, item.moved[0]
    channel, _, word = item.name.rpartition(".")
    fields = {
        "estimate": maximum.name,
        "instead": rig.shown(maximum.name, maximum.there, 4),
        "here": rig.shown(maximum.name, maximum.here, 4),
        "halves": maximum.halves,
        "remedy": item.remedy,
        "share": item.explains,
        "known": row.certainty > 0,
    }
    offset = word == "offset" and item.name not in row.parameters
    if offset or item.name in row.parameters:
        shown = channel if offset else item.name
        fields["value"] = rig.shown(shown, item.there, 4)
        fields["half"] = rig.shown(shown, Z95 * item.std, 2)
        if not offset and item.name not in rig.parameters():
            return message("identification.absent_fixed", name=row.name, **fields)
        alike = [n.name for n in row.numbers if n.here == item.here]
        name, fixed = ", ".join(alike) or item.name, rig.shown(shown, item.here, 4)
        return message("identification.number_fixed", name=name, fixed=fixed, **fields)
    timed = word in ("lag", "delay")
    channel = ", ".join(name for name, _, _ in row.readings) or channel
    fields |= {"channel": channel, "word": word, "value": item.there * (1e3 if timed else 1.0)}
    fields["half"] = Z95 * item.std * (1e3 if timed else 1.0)
    if timed:
        return message("identification.time_fixed", fixed=1e3 * item.here, **fields)
    return message("identification.sensor_fixed", **fields)
