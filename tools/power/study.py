"""Right and wrong models of random machines, judged by `ehbench.validation` on logs of the plant of
this folder: how often a wrong one passes, and a right one does not."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tools.power.machine import (
    QUIET,
    WAVES,
    Machine,
    NotDriven,
    Test,
    channels,
    draw,
    log_text,
    rig_text,
    scaled,
    simulated,
    test_of,
)

KINDS = (("slide", 1), ("crane", 1), ("slide", 4), ("crane", 4))
NOISES = (0.3, 1.0, 3.0)  # times `QUIET`
TRAINING = ("steps", "multisine")  # logs that the black box is fitted to
LIKELY = 100.0  # squares, in those of noise, that an error must move a log by to be in it
Change = Callable[[Machine], Machine]


class Error(NamedTuple):
    """A single error: what the machine has beside its draw, what its model has instead, and a
    pattern of the line that names it."""

    model: Change
    cause: str
    machine: Change = lambda machine: machine


def _deadband(by: float) -> Change:
    return lambda m: replace(m, deadband=m.deadband + by) if m.deadband + by > 0.0 else m


ERRORS = {
    "bulk modulus +20 %": Error(partial(scaled, bulk_modulus=1.2), "bulk_modulus"),
    "bulk modulus −20 %": Error(partial(scaled, bulk_modulus=0.8), "bulk_modulus"),
    "damping × 2": Error(partial(scaled, damping=2.0), "damping|friction_viscous"),
    "damping ÷ 2": Error(partial(scaled, damping=0.5), "damping|friction_viscous"),
    "mass +10 %": Error(partial(scaled, mass=1.1), r"\.mass|payload|weight"),
    "mass −10 %": Error(partial(scaled, mass=0.9), r"\.mass|payload|weight"),
    "leakage missing": Error(partial(scaled, leakage_internal=0.0), "leakage"),
    "valve frequency ÷ 1.5": Error(partial(scaled, omega=1.0 / 1.5), "natural_frequency|delay"),
    "valve frequency × 1.5": Error(partial(scaled, omega=1.5), "natural_frequency|delay"),
    "dead band +0.2 V": Error(_deadband(0.2), "deadband"),
    "dead band −0.2 V": Error(_deadband(-0.2), "deadband"),
    "all gains +10 %": Error(
        lambda m: replace(m, gain=tuple(1.1 * gain for gain in m.gain)), "flow_gain"
    ),
    "no friction": Error(partial(scaled, coulomb=0.0, static=0.0), "friction"),
    "Stribeck 1.8 missing": Error(
        lambda m: replace(m, static=m.coulomb), "friction|stribeck", partial(scaled, static=1.8)
    ),
    "bore +0.5 %": Error(partial(scaled, bore=1.005), "bore|area"),
}


@dataclass(frozen=True)
class Trial:
    """One model judged on one log; ``error`` is empty for an exact one."""

    seed: int
    wave: str
    noise: float
    error: str = ""


@dataclass(frozen=True)
class Outcome:
    """What a validation says of a trial: its ``verdict``, what was ``blamed``, the likeliest first,
    and whether one of the first two is the cause; ``shows`` whether the error moves the log by more
    than its noise. ``skipped`` says why there is no such trial."""

    trial: Trial
    verdict: str = ""
    blamed: tuple[str, ...] = ()
    named: bool = False
    shows: bool = True
    reasons: tuple[str, ...] = ()
    fits: dict[str, float] = field(default_factory=dict)
    skipped: str = ""


class Case(NamedTuple):
    """The files of a trial as texts, whether its error shows in the log, and further logs of the
    machine for the black box beside the model."""

    rig: str
    log: str
    shows: bool
    training: tuple[str, ...]


def case_of(trial: Trial) -> Case | str:
    """A trial's rig file and log, or why there is none."""
    drawn, error = _drawn(trial.seed), ERRORS.get(trial.error, Error(lambda m: m, ""))
    machine = error.machine(drawn)
    model = error.model(machine)
    if trial.error and model == machine:
        return "the machine has no such number"
    tests = _tests(trial.seed, trial.wave, machine)
    if isinstance(tests, str):
        return tests
    rng = np.random.default_rng([trial.seed, WAVES.index(trial.wave), NOISES.index(trial.noise)])
    rate = bool(rng.random() < 0.6)
    shows = not trial.error or _shows(model, tests[0], rate, trial.noise)
    log, *training = (_noisy_log(item, rate, trial.noise, rng) for item in tests)
    return Case(rig_text(model), log, shows, tuple(training))


class Recording(NamedTuple):
    """What a machine does in a test."""

    machine: Machine
    test: Test
    states: np.ndarray


def _drawn(seed: int) -> Machine:
    return draw(np.random.default_rng(seed), *KINDS[seed % len(KINDS)])


@lru_cache(4)  # all errors of a machine share it
def _tests(seed: int, wave: str, machine: Machine) -> list[Recording] | str:
    """A test in a wave and those in `TRAINING`, or why there is none."""
    rng = np.random.default_rng([seed, WAVES.index(wave)])
    try:
        return [Recording(machine, *test_of(machine, name, rng)) for name in (wave, *TRAINING)]
    except NotDriven as reason:
        return str(reason)


def _noisy_log(done: Recording, rate: bool, noise: float, rng: np.random.Generator) -> str:
    signals = channels(done.machine, done.states, rate)
    draws = {name: noise * QUIET[name] * rng.standard_normal(len(y)) for name, y in signals.items()}
    return log_text(done.machine, done.test, signals, draws)


def _shows(model: Machine, done: Recording, rate: bool, noise: float) -> bool:
    there = channels(done.machine, done.states, rate)
    here = channels(model, simulated(model, done.test), rate)
    return LIKELY < sum(
        float(np.sum(((here[name] - y) / (noise * QUIET[name])) ** 2)) for name, y in there.items()
    )


def miss(trial: Trial) -> float:
    """By how much the model, with the machine's numbers and start, differs from the plant, as the
    largest share of a channel's range: what is not the verdict's doing."""
    from ehbench import load_rig
    from ehbench.data import read
    from ehbench.plant.model import Model

    drawn = _drawn(trial.seed)
    test, states = test_of(drawn, trial.wave, np.random.default_rng(trial.seed))
    signals = channels(drawn, states)
    with tempfile.TemporaryDirectory() as name:
        rig, log = Path(name) / "rig.toml", Path(name) / "log.csv"
        rig.write_text(rig_text(drawn), encoding="utf-8")
        quiet = {name: np.zeros(len(y)) for name, y in signals.items()}
        log.write_text(log_text(drawn, test, signals, quiet), encoding="utf-8")
        model, record = Model.of(load_rig(rig)), read(log)
    start, plant = model.rest_start(record), model.plant
    chambers = (plant.cylinders[0].node_head, plant.cylinders[0].node_rod)
    places = (0, plant.at.rates, *(int(plant.nodes.state[node]) for node in chambers))
    for place, value in zip(places, test.start, strict=False):
        start.y[place] = value
    run = model.replay(record, start=start)
    del signals["p_supply"]
    return max(float(np.max(np.abs(run[f"ram.{n}"] - y)) / np.ptp(y)) for n, y in signals.items())


def judged(trial: Trial) -> Outcome:
    """What `ehbench.validation` says of a trial."""
    from ehbench import load_rig
    from ehbench.data import read
    from ehbench.validation import prepare_validation, run_validation

    case = case_of(trial)
    if isinstance(case, str):
        return Outcome(trial, skipped=case)
    with tempfile.TemporaryDirectory() as name:
        rig = Path(name) / "rig.toml"
        rig.write_text(case.rig, encoding="utf-8")
        records = []
        for number, text in enumerate((case.log, *case.training)):
            log = Path(name) / f"log{number}.csv"
            log.write_text(text, encoding="utf-8")
            records.append((log.stem, read(log)))
        crane = KINDS[trial.seed % len(KINDS)][0] == "crane"
        words = (*(("q", "qd") if crane else ("x", "v")), "p_head", "p_rod")
        prepared = prepare_validation(load_rig(rig), records[:1], words)
    prepared = replace(prepared, training=tuple(records[1:]))
    result = run_validation(prepared, workers=1)
    findings = [f"{item.sentence} → {item.remedy}" for item in result.structure.findings]
    pattern = ERRORS[trial.error].cause if trial.error else "$^"
    return Outcome(
        trial,
        result.verdict,
        tuple(findings),
        any(re.search(pattern, text) for text in findings[:2]),
        case.shows,
        (*result.reasons, *result.reservations),
        {item.channel: item.fit_percent or 0.0 for item in result.logs[0].channels},
    )


def wrong_trials(rigs: int) -> list[Trial]:
    """Every error of so many machines in every wave, with each noise in turn."""
    return [
        Trial(seed, wave, NOISES[(seed + i) % len(NOISES)], error)
        for seed, (i, wave), error in product(range(rigs), enumerate(WAVES), ERRORS)
    ]


def exact_trials(rigs: int) -> list[Trial]:
    """Exact models of so many machines, none of `wrong_trials`, in every wave and noise."""
    return [
        Trial(1000 + seed, wave, noise) for seed, wave, noise in product(range(rigs), WAVES, NOISES)
    ]


def outcomes(trials: Sequence[Trial], workers: int = 0) -> Iterator[Outcome]:
    """Of each trial that there is, in order."""
    from ehbench.runtime.blas import one_thread

    judged(Trial(0, "steps", 1.0))  # compiles what the workers share
    with one_thread(), ProcessPoolExecutor(workers or os.cpu_count() or 1) as pool:
        yield from pool.map(judged, trials, chunksize=len(ERRORS))


def _share(some: Sequence[bool]) -> str:
    return f"{100.0 * sum(some) / len(some):.1f} %" if some else "–"


def wrong_table(results: Sequence[Outcome]) -> str:
    """Errors and what became of them, as Markdown."""
    head = "| error | models | not accepted plainly | rejected | cause among first two | of those "
    lines = [head + "that show: not accepted plainly |", "| --- | --- | --- | --- | --- | --- |"]
    groups = {name: [r for r in results if r.trial.error == name] for name in ERRORS}
    for name, group in [*groups.items(), ("all", list(results))]:
        shown = [r for r in group if r.shows]
        cells = (
            _share([r.verdict != "accepted" for r in group]),
            _share([r.verdict == "rejected" for r in group]),
            _share([r.named for r in group]),
            f"{_share([r.verdict != 'accepted' for r in shown])} of {len(shown)}",
        )
        lines.append(f"| {name} | {len(group)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def exact_table(results: Sequence[Outcome]) -> str:
    """Exact models by wave, as Markdown."""
    lines = ["| wave | models | not accepted plainly | rejected | blamed |"]
    lines.append("| --- | --- | --- | --- | --- |")
    groups = {name: [r for r in results if r.trial.wave == name] for name in WAVES}
    for name, group in [*groups.items(), ("all", list(results))]:
        counts = (
            sum(r.verdict != "accepted" for r in group),
            sum(r.verdict == "rejected" for r in group),
            sum(bool(r.blamed) for r in group),
        )
        lines.append(f"| {name} | {len(group)} | {' | '.join(map(str, counts))} |")
    return "\n".join(lines)
