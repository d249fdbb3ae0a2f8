"""Payloads × motions × controllers → ``logs/<case>.mcap``, ``table.json`` and ``.csv``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ehbench import trial
from ehbench.config.recipe import TrialSetRecipe
from ehbench.config.rig import Rig
from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.stages.base import DONE, STOPPED, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, RigState
from ehbench.stages.trial import PLACES, length_of, measure_types, prepared_case, time_is_known
from ehbench.trial import Case
from ehbench.trial.preparation import Prepared as Ready
from ehbench.vocabulary import InputError, Progress, message, plural


@dataclass(frozen=True)
class PreparedSet(Prepared):
    """All trials of a set before their first tick."""

    recipe: TrialSetRecipe
    base: RigState
    cases: list[Case]
    trials: list[Ready]

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(note for item in self.trials for note in item.notes))


class TrialsStage(Stage[TrialSetRecipe, PreparedSet]):
    """`TrialSetRecipe`."""

    name = "trials"
    command = "run-trial"
    writes = "a log and a ledger for each trial, table.json, table.csv, rig.toml, figures"

    def prepare(self, recipe: TrialSetRecipe, inputs: Inputs) -> PreparedSet:
        if inputs.live is not None:
            raise InputError(message("stages.live_of_set"), file=recipe.path)
        planned = recipe.cases()
        for entry in planned:
            trial.refuse_code(entry, inputs.allow_code)
            with inputs.notes.collected():
                trial.refuse_unknown(entry)
        base = inputs.rig_state(recipe.rig, recipe.flow_maps)
        states = {(recipe.rig, recipe.flow_maps): base}
        files = list(base.inputs)
        cases, trials, lengths = [], [], []
        for entry in planned:
            with inputs.notes.collected():
                key = (entry.rig, entry.flow_maps)
                if key not in states:
                    other = inputs.rig_state(*key)
                    states[key] = replace(other, rig=with_identified(other.rig, base.rig))
                case, inside, prepared = prepared_case(entry.title, entry, states[key], inputs)
                case = replace(case, seeds=recipe.seeds)
                files += [item for item in (*states[key].inputs, *inside) if item not in files]
                cases.append(case)
                trials.append(prepared)
                if time_is_known(entry, states[key]):
                    lengths.append(prepared.duration)
        factors = {
            "payload": recipe.payloads,
            "motion": recipe.motion,
            **({"machine": recipe.machine} if recipe.machine else {}),
            "controller": recipe.controller,
        }
        does = message(
            "stages.does_trials",
            trials=plural(len(planned), "trial"),
            factors=" × ".join(plural(len(items), word) for word, items in factors.items()),
            place=PLACES[recipe.on],
            length=length_of(lengths, float(recipe.rate)),
        )
        if recipe.seeds > 1:
            does += message("stages.does_seeds", count=recipe.seeds)
        seeds = {"trial": recipe.seed}
        return PreparedSet(recipe, tuple(files), does, base, cases, trials, seeds=seeds)

    def results(self, prepared: PreparedSet) -> list[Any]:
        item = {**measure_types(), "duration": float, "stopped": str}
        return [{case.name: item for case in prepared.cases}]

    def work(self, prepared: PreparedSet, folder: Path, progress: Progress | None) -> Work:
        cases, rig = prepared.cases, prepared.base.rig
        (folder / "logs").mkdir()
        (folder / "ledgers").mkdir()
        results = trial.run_cases(cases, prepared.trials, logs=folder / "logs", progress=progress)
        write_rig(folder, rig, prepared.base.flow_maps)
        named = [(case.name, result) for case, result in zip(cases, results, strict=True)]
        for file, result in zip(trial.file_names(cases), results, strict=True):
            if result.ledger is not None:
                rundir.write_json(folder / "ledgers" / f"{file}.json", result.ledger)
        rows = trial.table_rows(cases, results)
        rundir.write_json(folder / "table.json", {"rows": rows})
        write_text(folder / "table.csv", trial.table_csv(rows, rig))
        stopped = [f"{name}: {item.facts.stopped}" for name, item in named if item.facts.stopped]
        warnings = [f"{name}: {text}" for name, item in named for text in item.facts.warnings]
        warnings += [f"{name}: {text}" for name, item in named for text in item.notes]
        about = {
            "rig": rig.name,
            "on": prepared.recipe.on,
            "stopped": "; ".join(stopped),
            "warnings": warnings,
        }
        return Work(about, stopped, STOPPED if stopped else DONE)


def with_identified(rig: Rig, source: Rig) -> Rig:
    """A variant of a machine with the numbers that were identified on ``source``, by name."""
    known = rig.parameters()
    return rig.with_values(
        {
            name: value
            for name, value in source.parameters().items()
            if value.sure == "identified" and name in known
        }
    )
