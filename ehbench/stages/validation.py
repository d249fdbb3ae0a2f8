"""Held-out logs → validated rig: ``validation.json`` with the verdict, a series for each log, the
rig judged.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ehbench.config.recipe import (
    DataFile,
    HydraulicsRecipe,
    JudgedFile,
    Recipe,
    ValidateRecipe,
    kind_of,
    load_recipe,
)
from ehbench.runs import rundir
from ehbench.stages.base import (
    DONE,
    INCOMPLETE,
    REJECTED,
    Prepared,
    Stage,
    Work,
    recorded_on,
    write_rig,
    write_series,
)
from ehbench.stages.findings import counted
from ehbench.stages.fitted_sensors import inherited
from ehbench.stages.inputs import Inputs, Logs, NamedFiles, RigState
from ehbench.vocabulary.progress import Progress
from ehbench.vocabulary.quantities import quantity
from ehbench.vocabulary.units import from_si

if TYPE_CHECKING:
    from ehbench.config.rig import Rig
    from ehbench.validation import PreparedValidation
    from ehbench.validation.held_out import Rows


@dataclass(frozen=True)
class PreparedJudgement(Prepared):
    """The logs as the judge takes them."""

    recipe: ValidateRecipe
    state: RigState
    logs: Logs
    validation: PreparedValidation
    inherited: tuple[str, ...] = ()


class ValidationStage(Stage[ValidateRecipe, PreparedJudgement]):
    """`ValidateRecipe`."""

    recipe = ValidateRecipe
    name = "validation"
    command = "validate"
    writes = "validation.json, rig.toml, a series for each log, figures"

    def prepare(self, recipe: ValidateRecipe, inputs: Inputs) -> PreparedJudgement:
        from ehbench.preprocessing.observations import payload_of
        from ehbench.validation import PreparedValidation, models_of, prepare_log
        from ehbench.validation.held_out import overlaps

        findings = inputs.findings
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        logs = inputs.logs(recipe.data)
        used, fitted = _fitted_on(state.inputs)
        read = [set(record.channels) for _, record in logs.records]
        every = set.intersection(*read) if read else set()
        sensors, result = inherited(state.origin, recipe.sensor, every, state.rig)
        judged = []
        models = {}
        if logs.records:
            models = models_of(state.rig, logs.records, recipe.channels, state.flow_maps, recipe.at)
        for (name, record), (_, path), index in zip(*logs[:2], logs.entries, strict=True):
            digest = rundir.sha256(path)
            seen = partial(overlaps, fitted=fitted, digest=digest)
            known = digest in used - {rows.digest for rows in fitted}
            scored = recipe.data[index].scored
            with findings.noting():
                model = models[payload_of(record) or ""]
                log = prepare_log(name, record, model, known, scored, seen, sensors)
                judged.append(log)
                findings.notes += [f"{name}: {text}" for text in log.log.notes]
                if log.failure is not None:
                    findings.mistake(log.failure)
        _say_fitted(recipe, inputs)
        findings.notes += result
        requested = ", ".join(_asked(recipe, state.rig)) or "nothing is asked"
        does = f"judges the rig on {counted(recipe.data, 'log')}: {requested}"
        return PreparedJudgement(
            recipe,
            (*state.inputs, *logs.files, *logs.maps),
            does,
            state,
            logs,
            PreparedValidation(state.rig, recipe.channels, tuple(judged), state.flow_maps),
            result,
        )

    def work(self, prepared: PreparedJudgement, folder: Path, progress: Progress | None) -> Work:
        from ehbench.diagnosis import ask
        from ehbench.validation import run_validation

        state, losses = prepared.state, prepared.logs.losses
        verdict = run_validation(prepared.validation, prepared.recipe.thresholds, progress)
        if prepared.recipe.structure:
            if progress is not None:
                progress("asking the residuals what they follow", 0.5)
            verdict = verdict.with_structure(ask(prepared.validation.cases(verdict.logs)))
        intervals = state.origin / "parameters.json"
        if intervals.is_file():  # they travel with the rig they belong to
            shutil.copyfile(intervals, folder / "parameters.json")
            leans = rundir.read_json(intervals).get("leans", [])
            sentences = tuple(lean["sentence"] for lean in leans)
            verdict = replace(verdict, reservations=(*sentences, *verdict.reservations))
        write_rig(folder, state.rig, state.flow_maps)
        others = [item.as_json() for item in prepared.recipe.reference]
        additional = {"references": others} if others else {}
        rundir.write_json(folder / "validation.json", verdict.as_json() | additional)
        write_series(folder / "series", verdict.series())
        facts = {
            "rig": state.rig.name,
            "accepted": verdict.accepted,
            "reservations": list(verdict.reservations),
            "warnings": [*losses, *prepared.inherited, *verdict.warnings],
            "recorded_on": recorded_on(prepared.logs.records),
        }
        if not verdict.accepted:
            cures = [
                f"{finding.sentence}; {finding.cure}" for finding in verdict.structure.findings[:2]
            ]
            return Work(facts, [*verdict.reasons, *cures], REJECTED)
        return Work(facts, code=INCOMPLETE if losses else DONE)


def _asked(recipe: ValidateRecipe, rig: Rig) -> list[str]:
    """What a model must reach, in words."""
    requested = recipe.thresholds
    words = [
        f"fit of {name} at least {minimum:g} %" for name, minimum in requested.fit_percent.items()
    ]
    words += [
        f"error of {name} at most {in_rig_unit(rig, name, float(maximum))}"
        for name, maximum in requested.max_error.items()
    ]
    for name in ("natural_frequency", "damping_ratio"):
        if share := getattr(requested, f"{name}_error"):
            words.append(f"{name.replace('_', ' ')} within {100.0 * share:g} %")
    for name in ("gain", "phase", "delay"):
        highest = getattr(requested, f"response_{name}_error")
        if highest is not None:
            shown = (
                f"{100.0 * highest:g} %"
                if name == "gain"
                else in_rig_unit(rig, name, float(highest))
            )
            words.append(f"{name} of the response to a sweep within {shown}")
    return words + [word for word in ("whiteness", "independence") if getattr(requested, word)]


def in_rig_unit(rig: Rig, name: str, value: float) -> str:
    """An SI value in the rig file's unit of its quantity."""
    unit = rig.unit_of(name)
    return f"{float(f'{from_si(value, unit, quantity(name)):.4g}'):g} {unit}"


def _fitted_on(inputs: NamedFiles) -> tuple[set[str], list[Rows]]:
    """(SHA-256 of the logs that the runs behind these inputs were fitted on, their samples as far
    as the runs have them).
    """
    from ehbench.report.saved import read_series
    from ehbench.validation.held_out import Rows

    digests, result = set(), []
    for folder in (path for _, path in inputs if path.is_dir()):
        fitted_on = rundir.read_json(folder / "run.json").get("fitted_on", [])
        digests.update(fitted_on)
        if not fitted_on or not (folder / "parameters.json").is_file():
            continue
        names = rundir.read_json(folder / "parameters.json").get("recordings", [])
        for name, digest in zip(names, fitted_on, strict=False):
            path = folder / "series" / f"{name}.csv"
            if path.is_file():
                series = read_series(path)
                result.append(Rows(name, series.t, series.recorded, digest))
    return digests, result


def _say_fitted(recipe: ValidateRecipe, inputs: Inputs) -> None:
    """Note the logs of this recipe that the recipes behind it fit its rig to."""
    fits = [(by, entry, rundir.sha256(log)) for by, entry, log in _fit_logs(recipe)]
    for item in recipe.data:
        path = recipe.file(item.path)
        if not path.is_file():
            continue
        digest = rundir.sha256(path)
        by = [by for by, entry, used in fits if used == digest and _shared(item, entry)]
        if by:
            who = inputs.findings.shown(by[0])
            inputs.findings.say("notes", f"{item.path} does not count: {who} fits the rig to it")


def _shared(judged: JudgedFile, fitted: DataFile) -> bool:
    """Whether two windows of one log have samples in common."""

    def span(entry: DataFile) -> tuple[float, float]:
        return (
            -math.inf if entry.start is None else float(entry.start),
            math.inf if entry.stop is None else float(entry.stop),
        )

    spans = [span(judged), span(fitted)]
    if judged.scored is not None:
        spans.append(judged.scored)
    return max(low for low, _ in spans) < min(high for _, high in spans)


def _fit_logs(recipe: ValidateRecipe) -> Iterator[tuple[Path, DataFile, Path]]:
    """(recipe, its entry, log) of every log that the recipes behind this one fit its rig to."""
    behind: Recipe = recipe
    while (rig := getattr(behind, "rig", None)) is not None:
        path = behind.file(rig)
        if not path.is_file() or kind_of(path) != "recipe":
            return
        behind = load_recipe(path)
        if isinstance(behind, HydraulicsRecipe):
            logs = ((item, behind.file(item.path)) for item in behind.data)
            yield from (
                (path, item, log) for item, log in logs if log.is_file() and log.suffix != ".toml"
            )
