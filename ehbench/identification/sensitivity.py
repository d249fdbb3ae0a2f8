"""Sensitivity to fixed parameters: what a fit took as known, what the logs favour instead, and the
estimates that would then leave their intervals.

Every row of the fault table that the fit does not estimate is asked. An interval is of noise and
initial states. A fixed number that is wrong by Δ moves the estimates by ``−(JᵀJ)⁻¹ Jᵀj Δ``, J being
their sensitivities and j that of the number (Ljung, System Identification, 2nd ed., 9.4). Where the
logs favour another value, and an estimate would leave its interval for it, the number is freed in a
further fit before it is reported."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.diagnosis.faults import Hypothesis, hypotheses
from ehbench.identification.covariance import Block, Prior, gains_of, release_of
from ehbench.identification.descent import solve
from ehbench.identification.problem import (
    Problem,
    State,
    by_channel,
    cost,
    evaluate,
    initial,
    prior_of,
    problem_of,
    squares,
)
from ehbench.identification.results import Lean, Moved
from ehbench.identification.search import coordinates
from ehbench.identification.simulator import Effort, Log, Simulator
from ehbench.identification.uncertainty import Errors, errors_of
from ehbench.plant.ties import position_channel, tied_words
from ehbench.preprocessing.sensors import VAGUE, Term
from ehbench.signals.series import white_noise
from ehbench.vocabulary.errors import EhbenchError
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.settings import setting
from ehbench.vocabulary.terms import BEYOND, Z95

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
        "share of the squares that another value must explain",
        "less does not show in a fit percentage",
    )
    alike: float = setting(
        0.5,
        "",
        "share of what the best explains from which another is reported",
        "the machine may lack both: leakage past the piston and to the outside",
    )
    looked: int = setting(
        8,
        "",
        "rows that promise most, of which a standard error is asked",
        "an error costs as much as ten simulations",
    )
    effort: float = setting(
        0.2,
        "",
        "share of the fit's simulations after which no further row is freed",
        "one row is freed whatever it takes",
    )


SETTINGS = SensitivitySettings()


@dataclass(frozen=True, eq=False)
class _Suspect:
    """A row with by how much δ changes the scaled residuals of each log, shape (samples,
    channels), the share of the squares that its best δ explains, that δ and its standard error, and
    the estimates that would move.
    """

    row: Hypothesis
    columns: list[np.ndarray]
    explains: float = 0.0
    delta: float = 0.0
    std: float = 0.0
    moved: tuple[Moved, ...] = ()

    @property
    def beyond(self) -> float:
        return self.moved[0].halves if self.moved else 0.0


def doubts_of(fit: Problem, state: State, result: Errors) -> tuple[list[str], tuple[Lean, ...]]:
    """(a warning of the fixed gain that the logs deny most; the fixed numbers with which estimates
    would leave their intervals, the likeliest first).
    """
    if _only_noise(fit, state):
        return [], ()
    effort = Effort()
    suspects = _promising(fit, result, list(_columns(fit, state, _fixed_rows(fit, state), effort)))
    rig = fit.simulator.rig
    warnings: list[str] = [
        message(
            "identification.gain_fixed",
            name=", ".join(item.row.parameters),
            move=100.0 * item.delta,
            half=100.0 * Z95 * item.std,
            share=item.explains,
            remedy=item.row.remedy(rig, item.delta),
        )
        for item in [item for item in suspects if item.row.kind == "gain"][:1]
    ]
    if not any(item.beyond > BEYOND for item in suspects):
        return warnings, ()
    suspects.sort(key=lambda item: item.beyond <= BEYOND)
    confirmed: list[tuple[Hypothesis, Lean]] = []
    for item in suspects:
        pair = _confirmed(fit, result, item, effort)
        confirmed += [] if pair is None else [pair]
        if effort.evaluations > SETTINGS.effort * fit.simulator.effort.evaluations:
            break
    best = max((item.explains for _, item in confirmed), default=0.0)
    likely = [
        (row, item)
        for row, item in confirmed
        if item.explains >= SETTINGS.alike * best and item.beyond > BEYOND
    ]
    likely.sort(key=lambda pair: (pair[0].certainty, -pair[1].explains))
    return warnings, tuple(replace(i, sentence=_sentence(fit, row, i)) for row, i in likely)


def _only_noise(fit: Problem, state: State) -> bool:
    """Whether white noise of the readings makes so much of the residual that nothing else can
    explain what is worth a report.
    """
    if fit.cutoff or any(log.band is not None for log in fit.logs):
        return False
    noise = 0.0
    for log in fit.logs:
        noises = [white_noise(y) for y in log.recorded.T] / by_channel(state.scales, log)
        noise += float(np.sum(noises**2 * np.count_nonzero(log.counts, axis=0)))
    left = squares(fit, state)
    return left - noise < SETTINGS.worth * left


def _fixed_rows(fit: Problem, state: State) -> list[Hypothesis]:
    """The rows of the fault table that a fit takes as known."""
    simulator, logs = fit.simulator, fit.logs
    values = {n: v for n, v in fit.by_name(state.theta).items() if n in simulator.known}
    cylinders = list(dict.fromkeys(name for log in logs for name in log.asked))
    tied = [position_channel(log.record, name) for log in logs for name in log.asked]
    tied = [name for name in tied if name and all(tied_words(log.record) for log in logs)]
    channels = list(dict.fromkeys([*(name for log in logs for name in log.channels), *tied]))
    records, rig = [log.record for log in logs], simulator.rig.with_values(values)
    terms = {(term.channel, term.word) for log in logs for term in log.start.terms}
    spectra = any(log.band is not None for log in logs)
    rows = hypotheses(rig, cylinders, channels, records, simulator.maps)
    given = None if rig.model is None else {*rig.model.parameters}
    return [
        row
        for row in (row.without(simulator.names, ()) if row.edits else row for row in rows)
        if row.row.step != 0.0
        and (row.level > 0 or row.kind == "gain")
        and row.kind != "drift"
        and (row.numbers or row.readings)
        and not {*row.parameters} & {*simulator.names}
        and not {(channel, word) for channel, word, _ in row.readings} & terms
        and not (spectra and row.readings)
        # of an FMU nobody knows more than its parameters and the sensors about it
        and (given is None or len(row.readings) == 1 or not row.edits)
        and (given is None or {number.name for number in row.numbers} <= given)
    ]


def _terms(rows: Sequence[Hypothesis], std: bool = False) -> tuple[Term, ...]:
    """What is asked of sensors, with a wide prior where it is to be fitted."""
    every = {(c, w): unit for row in rows for c, w, unit in row.readings}
    return tuple(
        Term(c, w, 0.0, 1.0, (VAGUE[w] * (4.0 * unit if w == "offset" else 1.0)) * std, False)
        for (c, w), unit in every.items()
    )


def _with_terms(logs: Sequence[Log], terms: Sequence[Term]) -> list[Log]:
    return [
        replace(log, start=replace(log.start, terms=(*log.start.terms, *terms))) for log in logs
    ]


def _columns(
    fit: Problem, state: State, rows: Sequence[Hypothesis], effort: Effort
) -> Iterator[_Suspect]:
    """The rows that change something: those of numbers that the rig has at once, those of sensors
    at once, each of those that alter the rig by itself.
    """
    numbers = [row for row in rows if not row.edits and row.numbers]
    sensors = [row for row in rows if row.readings and row not in numbers]
    for group in [numbers, sensors, *([row] for row in rows if row.edits and not row.readings)]:
        if not group:
            continue
        simulator, here, alters = fit.simulator, state.here, group not in (numbers, sensors)
        each = {n.name: n for row in group for n in row.numbers if group is not sensors}
        terms = _terms(group) if group is sensors else ()
        names = [*simulator.names, *each, *(term.name for term in terms)]
        logs = _with_terms(fit.logs, terms)
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
            which = [k for k, log in enumerate(logs) if row.cylinder in ("", *log.asked)]
            points += [(vector, k, here.shifts[k]) for k in which]
            keys += [(row, k) for k in which]
        steps = None if alters else here.mesh.steps
        columns = {row: [np.zeros_like(left) for left in here.residuals] for row in group}
        for (row, k), simulated in zip(keys, built.each(points, steps)[0], strict=True):
            if simulated is None:
                columns.pop(row, None)
            elif row in columns:
                change = fit.residual(fit.logs[k], simulated) - here.residuals[k]
                columns[row][k] = change / (row.inside * by_channel(state.scales, fit.logs[k]))
        yield from (_Suspect(r, parts) for r, parts in columns.items() if any(map(np.any, parts)))


def _promising(fit: Problem, result: Errors, every: Sequence[_Suspect]) -> list[_Suspect]:
    """Those by which the logs surely would be followed better, to first order: the likeliest first,
    of those that are as likely the less sure number first.
    """
    if not every:
        return []
    state = result.state
    live, total = list(state.live), cost(fit, state)
    prior, minimum = prior_of(fit, state, live), SETTINGS.worth * total
    known = Prior(np.append(prior.sharpness, 0.0), np.append(prior.off, 0.0), prior.weight)
    suspects = []
    for k in np.argsort(-gains_of(_with(result, every), prior))[: SETTINGS.looked]:
        item, release = every[k], release_of(_with(result, [every[k]]), known, minimum)
        low, high = item.row.bounds
        delta = min(max(release.move, low), high)
        if delta == 0.0 or not abs(release.move) > SETTINGS.surely * release.std:
            continue
        moved, share = _moved(fit, result, state.theta[live] + release.follow), release.gain / total
        suspects.append(replace(item, explains=share, delta=delta, std=release.std, moved=moved))
    best = SETTINGS.alike * max((item.explains for item in suspects), default=0.0)
    return sorted(
        suspects,
        key=lambda s: (
            (0, s.row.certainty, -s.explains) if s.explains >= best else (1, 0, -s.explains)
        ),
    )


def _with(result: Errors, some: Sequence[_Suspect]) -> list[Block]:
    """What each log says, with some fixed numbers after those that are fitted."""
    return [
        replace(
            block,
            jacobian=np.concatenate(
                [block.jacobian, *(item.columns[k][..., None] for item in some)], axis=-1
            ),
        )
        for k, block in enumerate(result.blocks)
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
    fit: Problem, result: Errors, item: _Suspect, effort: Effort
) -> tuple[Hypothesis, Lean] | None:
    """A row by a fit in which it is free; None where that has it otherwise."""
    row, old, state = item.row, fit.simulator, result.state
    fit.journal.search = row.name
    sensor = len(row.readings) == 1 and (bool(row.edits) or not row.numbers)
    terms = _terms([row], True) if sensor else ()
    starts = {} if sensor else {n.name: n.begin(item.delta) for n in row.numbers}
    try:
        rig = old.rig if sensor else row.altered(old.rig)
        more = coordinates(rig, [*starts], starts, upper=row.upper) if starts else []
        names = [*old.names[: fit.requested], *starts, *old.names[fit.requested :]]
        names += [term.name for term in terms]
        logs = _with_terms(fit.logs, terms)
        simulator = Simulator(rig, logs, names, old.maps, old.workers, old.step)
        simulator.effort = effort
        search = [*fit.search[: fit.requested], *more]
        given = None, fit.max_iterations, fit.cutoff, fit.journal
        freed = problem_of(simulator, search, *given)
        index = {c.name: i for i, c in enumerate(freed.search)}
        live = [index[fit.search[i].name] for i in state.live]
        new = [index[name] for name in (*starts, *(term.name for term in terms))]
        begin = initial(freed)
        for c, theta in zip(fit.search, state.theta, strict=True):
            begin.theta[index[c.name]] = theta
        if sensor:
            begin.theta[new[0]] = freed.search[new[0]].of(item.delta * row.readings[0][2])
        begin = replace(
            begin,
            shifts=state.shifts,
            scales=state.scales,
            free=tuple(sorted((*live, *new))),
            prior_weight=state.prior_weight,
            coarse=False,
        )
        end, _ = solve(freed, begin, 1e-3)
        there = errors_of(freed, evaluate(freed, end))
    except IMPOSSIBLE:
        return None
    after, before = cost(freed, there.state), cost(fit, state)
    number = next((n for n in row.numbers if n.unit != 0.0), None)
    at = new[0] if sensor or number is None else index[number.name]
    c, here = freed.search[at], 0.0 if sensor or number is None else number.here
    value = c.at(there.state.theta[at])
    std = (value if c.log else c.unit) * there.by_index[at].std
    if abs(value - here) <= SETTINGS.surely * std or before - after < SETTINGS.worth * before:
        return None
    moved = _moved(fit, result, there.state.theta[live])
    remedy = row.remedy(old.rig, item.delta)
    return row, Lean(c.name, here, value, std, 1.0 - after / before, moved, remedy)


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
        "half": 100.0 * Z95 * item.std / abs(item.there),
    }
    if item.name in row.parameters:
        fields["value"] = rig.shown(item.name, item.there, 4)
        if item.name not in rig.parameters():
            return message("identification.absent_fixed", name=row.name, **fields)
        name, fixed = ", ".join(row.parameters), rig.shown(item.name, item.here, 4)
        return message("identification.number_fixed", name=name, fixed=fixed, **fields)
    timed = word in ("lag", "delay")
    fields |= {"channel": channel, "word": word, "value": item.there * (1e3 if timed else 1.0)}
    fields["half"] = Z95 * item.std * (1e3 if timed else 1.0)
    if timed:
        return message("identification.time_fixed", **fields)
    return message("identification.sensor_fixed", **fields)
