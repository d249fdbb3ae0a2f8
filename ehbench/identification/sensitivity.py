"""What a fit leans on: numbers that it holds, that its logs would have otherwise, and without which
its estimates would come out beyond their intervals.

An interval is of noise and starts. A held number that is wrong by Δ moves the estimates by
``−(JᵀJ)⁻¹ Jᵀj Δ``, J being their sensitivities and j that of the held number, whatever the noise;
where that is more than their intervals and the logs deny the number, they are surely wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.config.rig import Rig
from ehbench.identification.covariance import Block, Prior, gains_of, release_of
from ehbench.identification.descent import solve
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.identification.problem import (
    Problem,
    State,
    by_channel,
    cost,
    effects,
    evaluate,
    jacobian,
    prior_of,
)
from ehbench.identification.results import Lean, Moved
from ehbench.identification.search import Coordinate, coordinates
from ehbench.identification.uncertainty import Errors, errors_of
from ehbench.parts.edge import edge_law
from ehbench.plant.build import Maps, map_of
from ehbench.preprocessing.observations import position_of
from ehbench.preprocessing.sensors import Term
from ehbench.vocabulary.terms import BEYOND, Z95

# a held number is surely wrong if the logs would move it by so many standard errors, and to the
# benefit of this share of the squares that are left; a gain is named from this share of it on
SURELY, WORTH, GAIN_OFF = 4.0, 0.05, 0.01
NEAR = 0.9  # share of what the likeliest explains from which another is as likely
TRIED = 3  # suspects that are freed in a fit of their own, the likeliest first
LATE = 1.0e-4  # [s] by which a command is delayed for a difference
GAINS = ("flow_gain", "map_factor")
TIMES = ("natural_frequency", "damping_ratio", "lag", "corner", "delay")


@dataclass(frozen=True, eq=False)
class _Suspect:
    """A held number: its name and value ``here``, by how much a ``unit`` [SI] of it changes what is
    left of each log, shape (samples, channels), the line that frees it, where it can be searched
    its index, and the smallest that it may be.
    """

    name: str
    here: float
    columns: list[np.ndarray]
    unit: float
    cure: str
    index: int | None = None
    least: float = 0.0


def watched(rig: Rig, parameters: Sequence[str], flow_maps: Maps | None) -> list[Coordinate]:
    """Numbers of a rig that shape its motion and are not among the parameters: gains of metering
    edges or factors of their maps, what the dynamics of valves have, oil volumes, moving masses.
    """
    known, names = rig.parameters(), []
    for edge_name, edge in rig.all_edges().items():
        law = edge_law(edge.law)
        if map_of(flow_maps, edge_name) is not None:
            names.append(f"{edge_name}.map_factor")
        elif law.metering and law.needs:
            names.append(f"{edge_name}.{law.needs[0]}")
    for cylinder in rig.cylinder:
        names += [f"{item}.{key}" for v in cylinder.valve for item in v.series for key in TIMES]
        names += [f"{cylinder.name}.{key}" for key in ("volume_head", "volume_rod")]
        names += [f"{cylinder.name}.{line.name}.volume" for line in cylinder.line]
        names.append(f"{cylinder.joint}.mass")
    fixed = [
        name
        for name in dict.fromkeys(names)
        if name in known and name not in parameters and float(known[name]) > 0.0
    ]
    return coordinates(rig, fixed) if fixed else []


def doubts_of(fit: Problem, state: State, result: Errors) -> tuple[list[str], tuple[Lean, ...]]:
    """(a warning of the held gain whose release would better the fit most, if it is surely wrong:
    the recipe's line that frees it; what the fit leans on, the likeliest first).
    """
    live, total = state.live, cost(fit, state)
    prior, minimum = prior_of(fit, state, live), WORTH * total
    known = Prior(np.append(prior.sharpness, 0.0), np.append(prior.off, 0.0), prior.weight)
    gains, suspects = [], []
    every = [*_searched(fit, result), *_late_commands(fit, result), *_late_sensors(fit, result)]
    promised = gains_of(_with(result, every), prior)
    for one in [one for one, gain in zip(every, promised, strict=True) if gain >= minimum]:
        release = release_of(_with(result, [one]), known, minimum)
        there, share = one.here + one.unit * release.move, release.gain / total
        if not abs(release.move) > SURELY * release.std:
            continue
        if one.name.rpartition(".")[2] in GAINS and abs(there - one.here) > GAIN_OFF * one.here:
            gains.append(
                (share, one.name, there / one.here - 1.0, one.unit * release.std / one.here)
            )
        if there >= one.least:
            moved = _moved(fit, result, state.theta[list(live)] + release.follow, live)
            std = one.unit * release.std
            lean = Lean(one.name, one.here, there, std, share, moved, one.cure)
            suspects.append((lean, one.index))
    return _gain_warnings(gains), _leans(fit, result, suspects)


def _with(result: Errors, some: Sequence[_Suspect]) -> list[Block]:
    """What each log says, with some held numbers behind those that are fitted."""
    return [
        replace(
            block,
            jacobian=np.concatenate(
                [block.jacobian, *(item.columns[k][..., None] for item in some)], axis=-1
            ),
        )
        for k, block in enumerate(result.blocks)
    ]


def _leans(
    fit: Problem, result: Errors, suspects: Sequence[tuple[Lean, int | None]]
) -> tuple[Lean, ...]:
    """Those suspects that explain most and with which estimates come out beyond their intervals.

    Nothing is said where no suspect promises to move an estimate that far; else those that promise
    to explain most are freed in fits of their own."""
    promising = sorted(suspects, key=lambda pair: -pair[0].explains)[:TRIED]
    if not any(item.beyond > BEYOND for item, _ in suspects):
        return ()
    tried = [
        lean if index is None else _refitted(fit, result, lean, index) for lean, index in promising
    ]
    leans = sorted(filter(None, tried), key=lambda entry: -entry.explains)
    rig = fit.simulator.rig
    return tuple(
        replace(item, sentence=_sentence(rig, item))
        for item in leans
        if item.explains >= NEAR * leans[0].explains and item.beyond > BEYOND
    )


def _gain_warnings(gains: Sequence[tuple[float, str, float, float]]) -> list[str]:
    """What is said of the gain that would better the fit most."""
    if not gains:
        return []
    less, name, move, std = max(gains)
    return [
        f"{name} is held, and these logs would have it {100.0 * move:+.1f} ± "
        f"{100.0 * std:.1f} % off: what is left would fall by {100.0 * less:.0f} %. "
        f'Add "{name}" to parameters, with [prior] "{name}" = "3 %"'
    ]


def _searched(fit: Problem, result: Errors) -> Iterator[_Suspect]:
    """The held numbers of the rig that change something."""
    which = list(range(fit.fitted, len(fit.search)))
    names = {item.name for item in fit.simulator.rig.cylinder}
    state = result.state
    influence = state.influence.copy()
    for i in which:  # what belongs to a cylinder changes nothing where that stands
        owner = fit.search[i].name.partition(".")[0]
        influence[i] = [owner not in names or owner in log.asked for log in fit.simulator.logs]
    slopes = jacobian(fit, replace(state, influence=influence), which) if which else []
    sizes = effects(fit, state, slopes) if which else []
    for n, i in enumerate(which):
        c, theta = fit.search[i], float(state.theta[i])
        if sizes[n] >= PROBLEM.faint:
            columns = [part[..., n] for part in slopes]
            here = c.at(theta)
            cure = f'add "{c.name}" to parameters'
            yield _Suspect(c.name, here, columns, here if c.log else c.unit, cure, i, c.lower)


def _late_commands(fit: Problem, result: Errors) -> Iterator[_Suspect]:
    """A delay of the commands of each cylinder, of whose valves the rig file has none."""
    rig, logs, here = fit.simulator.rig, fit.simulator.logs, result.state.here
    known = rig.parameters()
    for cylinder in rig.cylinder:
        series = [item for valve in cylinder.valve for item in valve.series]
        given = [f"{cylinder.name}.{valve.name}.command" for valve in cylinder.valve]
        terms = {f"{term.channel}.{term.word}" for log in logs for term in log.start.terms}
        delays = {
            f"{item}.delay" for item in series if float(known.get(f"{item}.delay", 0.0)) > 0.0
        }
        if delays or not given or terms & {f"{item}.delay" for item in given}:
            continue
        late = tuple(Term(item, "delay", LATE, 1.0, 0.0, False) for item in given)
        moved = fit.simulator.over(
            [
                replace(log, start=replace(log.start, terms=(*log.start.terms, *late)))
                for log in logs
            ]
        )
        which = [k for k, log in enumerate(logs) if cylinder.name in log.asked]
        built = moved.each(
            [(fit.values(here.theta), k, here.shifts[k]) for k in which], here.mesh.steps
        )
        columns = [np.zeros_like(left) for left in here.residuals]
        for k, simulated in zip(which, built, strict=True):
            if simulated is not None:
                left = fit.residual(logs[k], simulated)
                columns[k] = (left - here.residuals[k]) / (
                    LATE * by_channel(result.state.scales, logs[k])
                )
        entry = f'add [[sensor]] channel = "{given[0]}", delay = "estimate"'
        several = f'put kind = "delay" among the dynamics of the valves of {cylinder.name}'
        about = given[0] if len(given) == 1 else f"{cylinder.name}.command"
        yield _Suspect(f"{about}.delay", 0.0, columns, 1.0, entry if len(given) == 1 else several)


def _late_sensors(fit: Problem, result: Errors) -> Iterator[_Suspect]:
    """A lag of the sensor of each channel that is compared, which the recipe does not have."""
    logs, here = fit.simulator.logs, result.state.here
    if any(log.band is not None for log in logs):
        return
    values = fit.values(here.theta)
    built = fit.simulator.each(
        [(values, k, shift) for k, shift in enumerate(here.shifts)], here.mesh.steps
    )
    known = {term.channel for log in logs for term in log.start.terms if term.word != "scale"}
    for channel in dict.fromkeys(name for log in logs for name in log.channels):
        if channel in known or position_of(channel) in known:
            continue
        columns = [np.zeros_like(left) for left in here.residuals]
        for k, (log, simulated) in enumerate(zip(logs, built, strict=True)):
            if simulated is not None and channel in log.channels:
                i = log.channels.index(channel)
                late = simulated.copy()
                late[:, i] -= LATE * np.gradient(simulated[:, i], log.sample_time)
                columns[k] = fit.residual(log, late) - fit.residual(log, simulated)
                columns[k] /= LATE * by_channel(result.state.scales, log)
        seen = channel if all(channel in log.record for log in logs) else position_of(channel)
        cure = f'add [[sensor]] channel = "{seen}", lag = "estimate"'
        yield _Suspect(f"{seen}.lag", 0.0, columns, 1.0, cure)


def _moved(
    fit: Problem, result: Errors, theta: np.ndarray, live: Sequence[int]
) -> tuple[Moved, ...]:
    """How far estimates would be off by their intervals with other search coordinates."""
    moved = []
    for i, there in zip(live, theta, strict=True):
        error, c = result.by_index[i], fit.search[i]
        if i >= fit.requested or error.kind == "not_excited" or error.std <= 0.0:
            continue
        here = float(result.state.theta[i])
        there = min(max(float(there), c.bounds[0]), c.bounds[1])
        halves = abs(there - here) / (error.quantile * error.std)
        moved.append(Moved(c.name, c.at(here), c.at(there), halves))
    return tuple(sorted(moved, key=lambda item: -item.halves))


def _refitted(fit: Problem, result: Errors, lean: Lean, index: int) -> Lean | None:
    """What a fit leans on by a fit in which it is free; None where that has it otherwise."""
    live = result.state.live
    state, _ = solve(fit, replace(result.state, free=(*live, index), at_bound=()), 1e-4)
    there = errors_of(fit, evaluate(fit, state))
    after, before = cost(fit, there.state), cost(fit, result.state)
    c, error = fit.search[index], there.by_index[index]
    moved = _moved(fit, result, there.state.theta[list(live)], live)
    off = abs(float(there.state.theta[index] - result.state.theta[index]))
    if off <= SURELY * error.std or before - after < WORTH * before:
        return None
    value = c.at(there.state.theta[index])
    std = (value if c.log else c.unit) * error.std
    return Lean(lean.name, lean.here, value, std, 1.0 - after / before, moved, lean.cure)


def _sentence(rig: Rig, item: Lean) -> str:
    """What a fit leans on, what becomes of its estimates without, and what to do."""
    maximum = item.moved[0]
    if item.name in rig.parameters():
        fixed = f"{item.name} is held at {rig.shown(item.name, item.here, 4)}"
        wide = 100.0 * Z95 * item.std / abs(item.there)
        would = f"{rig.shown(item.name, item.there, 4)} (± {wide:.2g} %)"
    else:
        channel, _, word = item.name.rpartition(".")
        fixed = f"{channel} is held to have no {word}"
        would = f"one of {1e3 * item.there:.2g} ± {1e3 * Z95 * item.std:.1g} ms"
    return (
        f"{fixed}, and these logs would have {would}: {maximum.name} would then come out "
        f"{rig.shown(maximum.name, maximum.there, 4)} in place of "
        f"{rig.shown(maximum.name, maximum.here, 4)}, "
        f"{maximum.halves:.2g} times as far off as its interval allows. Measure it, or {item.cure}"
    )
