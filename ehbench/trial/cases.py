"""Trials with their energies, many of them side by side, and one table over them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.config.rig import Rig
from ehbench.ledger import Accuracy, bounds, ledger_of_log, ledger_of_model
from ehbench.plant.many import map_threads
from ehbench.sampling.measures import lookup
from ehbench.trial.preparation import Prepared, prepare
from ehbench.trial.running import SELDOM, Facts, Result, run
from ehbench.vocabulary import VOCABULARY, Message, from_si, message
from ehbench.vocabulary.errors import EhbenchError, InsufficientData, SimulationError
from ehbench.vocabulary.text import numbered, quoted

if TYPE_CHECKING:
    from ehbench.plant.build import Maps


MODEL = "edge flows of the model"
LOG = "estimated: measured pressures and commands through the design model's maps"


class Account(NamedTuple):
    """A trial's facts with its energies, its ledger with its bounds as plain values, and why there
    is none."""

    facts: Facts
    ledger: dict[str, Any] | None
    notes: tuple[Message, ...] = ()


def account(prepared: Prepared, result: Result, intervals: bool = True) -> Account:
    """The account of a trial: exact where the machine gives its states, else as measured.

    ``intervals`` adds those of what was measured, which take longer than the trial."""
    recipe, record, facts = prepared.recipe, result.record, result.facts
    if (cycle := facts.measures.get("cycle")) is not None:  # the last of several
        record = record.between(cycle["start"], cycle["stop"])
    try:
        if result.model is not None:
            ledger = ledger_of_model(result.model, record)
        else:
            accuracy = Accuracy() if intervals else None
            ledger = ledger_of_log(
                prepared.rig, prepared.maps, record, payload=recipe.payload, accuracy=accuracy
            )
    except EhbenchError as error:
        note = message("trial.no_ledger", problem=error.message)
        unknown = dict.fromkeys(("pump", "cylinder_work", "oil_drawn"))
        unknown |= {"source": note, "supply": prepared.rig.supply.kind}
        if facts.cylinder:
            facts = facts.with_energy(dict.fromkeys(facts.cylinders, unknown))
        return Account(facts, None, (note,))
    limits = []
    if facts.cylinder:
        shared = {
            "oil_drawn": ledger.oil_drawn,
            "source": MODEL if ledger.source == "model" else LOG,
            "supply": prepared.rig.supply.kind,
        }
        rail = {} if ledger.low_rail is None else {"low_rail": ledger.low_rail}
        energies = {
            name: {"pump": ledger.pump}
            | rail
            | {"cylinder_work": ledger[f"{name}.work"].energy}
            | shared
            for name in facts.cylinders
        }
        facts = facts.with_energy(energies)
        with suppress(InsufficientData):  # it did not move, or its supply has not one pressure
            limits = [asdict(bounds(prepared.rig, record, facts.cylinder, ledger))]
    return Account(facts, ledger.as_json() | {"bounds": limits})


# measures that noise moves; the others are what the controller was made of
_MOVED = ("steps", "tracking", "tracking_true", "tip", "speed_rms_error", "energy", "limits")


def middle_of(runs: Sequence[Facts]) -> int:
    """The first run that a limit stopped; else that of the median largest error, the lower one of
    two."""
    for index, facts in enumerate(runs):
        if facts.stopped:
            return index
    errors = [facts.measures["tracking"]["max_error"] for facts in runs]
    return int(np.argsort(errors, kind="stable")[(len(runs) - 1) // 2])


def over_runs(runs: Sequence[Facts], middle: int) -> Facts:
    """The facts of the ``middle`` run, with the measures of all that came to their end.

    A number is the median of the runs that have it, None where most have not; ``range`` has the
    least and the largest of each, ``seeds`` says how many runs there are. ``limit_cycle`` is the
    worst of all, and what is warned of it. A run that a limit stopped stands for itself."""
    retained = runs[middle]
    if retained.stopped:
        count = sum(1 for run in runs if run.stopped)
        stopped = message("trial.stopped_runs", count=count, runs=len(runs))
        return replace(retained, warnings=(*retained.warnings, stopped))
    results = [facts.measures for facts in runs]
    moved = [{name: item[name] for name in _MOVED if name in item} for item in results]
    of_all = _joined(moved, middle, lambda values: float(np.median(values)))
    worst = max(runs, key=lambda entry: (entry.measures["limit_cycle"] or {}).get("amplitude", 0.0))
    measures = retained.measures | of_all | {"limit_cycle": worst.measures["limit_cycle"]}
    measures |= {
        "range": _joined(moved, middle, lambda values: [min(values), max(values)]),
        "seeds": len(runs),
    }
    return replace(retained, measures=measures, warnings=worst.warnings or retained.warnings)


def _joined(trees: Sequence[Any], middle: int, fold: Callable[[list[float]], Any]) -> Any:
    """One tree of as many, each number the ``fold`` of theirs; texts and lists of unequal length
    are those of the middle one."""
    chosen = trees[middle]
    if isinstance(chosen, dict):
        return {name: _joined([tree.get(name) for tree in trees], middle, fold) for name in chosen}
    if isinstance(chosen, list):
        same = [tree for tree in trees if len(tree) == len(chosen)]
        index = next(i for i, item in enumerate(same) if item is chosen)
        return [_joined([item[i] for item in same], index, fold) for i in range(len(chosen))]
    known = [float(tree) for tree in trees if isinstance(tree, int | float)]
    if isinstance(chosen, str) or not known:
        return chosen
    return fold(known) if 2 * len(known) > len(trees) else None


@dataclass(frozen=True)
class Case:
    """One trial of a set: its name, what `run_trial` needs, and how many runs it makes, each with
    other noise of the sensors."""

    name: str
    recipe: TrialRecipe
    rig: Rig
    maps: Maps | None
    gains: Path | Mapping[str, Any] | None = None
    seeds: int = 1

    def prepare(self, *, allow_code: bool = False, standing: bool = False) -> Prepared:
        """This trial before its first tick: `ehbench.trial.prepare`."""
        return prepare(self.recipe, self.rig, self.maps, self.gains, allow_code, standing)

    def run(self, prepared: Prepared, log: Path | None = None) -> Account:
        """Its account, with the case's name on what goes wrong; of several runs the log and the
        ledger of the middle one, and the measures of all.

        Raises:
            EhbenchError: as `ehbench.trial.run`."""
        if self.seeds == 1:
            return self._once(prepared, log)
        runs = [prepared.seeded(self.recipe.seed + more) for more in range(self.seeds)]
        facts = [self._once(item, intervals=False).facts for item in runs]
        middle = middle_of(facts)
        return self._once(runs[middle], log)._replace(facts=over_runs(facts, middle))

    def _once(self, prepared: Prepared, log: Path | None = None, intervals: bool = True) -> Account:
        try:
            result = run(prepared, log=log)
        except SimulationError as error:
            problem = message("trial.case_failed", case=self.name, problem=error.message)
            raise type(error)(problem, file=error.file, hint=error.hint) from None
        return account(prepared, result, intervals)

    @property
    def motion(self) -> str:
        """Name of its motion."""
        motion = self.recipe.motion
        return "" if motion is None else motion.name or motion.kind


def run_cases(
    cases: Sequence[Case],
    prepared: Sequence[Prepared],
    *,
    logs: Path | None = None,
    workers: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> list[Account]:
    """Run trials on threads; results in the order of ``cases``.

    Args:
        cases: what to run.
        prepared: what `Case.prepare` gave for each.
        logs: the folder of their logs, each under its `file_names`; none are written by default.
        workers: threads; by default one a core.
        progress: told which case is done and the share done.

    Raises:
        EhbenchError: a case fails; those that have not begun are given up."""
    names, done = file_names(cases), count(1)

    def run_case(index: int) -> Account:
        log = None if logs is None else logs / f"{names[index]}.mcap"
        result = cases[index].run(prepared[index], log)
        if progress is not None:
            progress(cases[index].name, next(done) / len(cases))
        return result

    return map_threads(run_case, range(len(cases)), workers)


def file_names(cases: Sequence[Case]) -> list[str]:
    """A name for each case's log that any file system takes."""
    stems = (re.sub(r"[^a-z0-9]+", "_", case.name.lower()).strip("_") for case in cases)
    return numbered(stem or "case" for stem in stems)


def table_rows(cases: Sequence[Case], results: Sequence[Account]) -> list[dict[str, Any]]:
    """One table a case, SI: what it was, where its log lies, what stopped it, and its measures."""
    facts_of = [result.facts for result in results]
    return [
        {
            "case": case.name,
            "payload": facts.payload,
            "motion": case.motion,
            "controller": facts.controller,
            "on": facts.on,
            "rig": facts.rig,
            "cylinder": facts.cylinder,
            "log": f"logs/{file}.mcap",
            "duration": facts.duration,
            "stopped": facts.stopped,
            **{name: fact for name in SELDOM if (fact := getattr(facts, name))},
            **facts.measures,
        }
        for case, file, facts in zip(cases, file_names(cases), facts_of, strict=True)
    ]


_ERRORS = ("max_error", "rms_error", "final_error")
# (column, quantity whose display unit it has, or a unit, where it lies)
_COLUMNS = (
    ("speed", "v", "step.speed"),
    ("share", "%", "step.share"),
    ("steady_speed", "v", "step.steady_speed"),
    ("steady_error", "%", "step.steady_error"),
    ("overshoot", "%", "step.overshoot"),
    ("settling_time", "t", "step.settling_time"),
    ("speed_rms_error", "v", "step.rms_error"),
    ("damping_ratio", "damping_ratio", "step.damping_ratio"),
    ("damping_ratio_fitted", "damping_ratio", "step.damping_ratio_fitted"),
    ("natural_frequency", "natural_frequency", "step.natural_frequency"),
    *((name, "x", f"cylinder.tracking.{name}") for name in _ERRORS),
    *((f"{name}_true", "x", f"cylinder.tracking_true.{name}") for name in _ERRORS),
    ("pump_energy", "energy", "row.energy.pump"),
    ("tip_max_error", "tip_error", "row.tip.max_error"),
    ("tip_rms_error", "tip_error", "row.tip.rms_error"),
    ("swing", "x", "cylinder.limit_cycle.amplitude"),
    ("swing_period", "t", "cylinder.limit_cycle.period"),
    ("speed_desired", "v", "cylinder.short.desired"),
    ("speed_reached", "v", "cylinder.short.reached"),
)
_RARE = ("tracking_true", "tip", "limit_cycle", "short")  # columns where a row has them


def table_csv(rows: Sequence[dict[str, Any]], rig: Rig) -> str:
    """The table as CSV in the units of the rig file: a row a step of speed, or a row a case without
    steps; empty where there is nothing. Of cases that move several cylinders a row each, with the
    tip's error."""
    met = [name for name in _RARE if any(row.get(name) for row in rows)]
    columns = [
        (name, word, word if word == "%" else rig.unit_of(word), place.split("."))
        for name, word, place in _COLUMNS
        if (table := place.split(".")[1]) not in _RARE or table in met
    ]
    front = ["case", "payload", "motion", "controller", "on"]
    heads = [*front, "step", *(["cylinder"] if "tip" in met else [])]
    heads += [n if unit == "dimensionless" else f"{n} [{unit}]" for n, _, unit, _ in columns]
    lines = [",".join([*heads, "stopped"])]

    def cell(value: float | None, word: str, unit: str) -> str:
        if value is None:
            return ""
        return f"{100.0 * value if unit == '%' else from_si(value, unit, VOCABULARY[word]):.6g}"

    for row in rows:
        for cylinder, item in {row["cylinder"]: row, **row.get("also", {})}.items():
            for number, step in enumerate(item["steps"] or [{}], 1):
                cells = [str(number) if step else "", *([cylinder] if "tip" in met else [])]
                tables = {"step": step, "cylinder": item, "row": row}
                cells += [cell(lookup(tables, at), word, unit) for _, word, unit, at in columns]
                line = [*(row[name] for name in front), *cells, row["stopped"]]
                lines.append(",".join(quoted(text) for text in line))
    return "\n".join(lines) + "\n"
