"""Held-out logs → the rig judged: ``validation.json`` with the verdict, series."""

import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ehbench.config.recipe import (
    DataFile,
    HydraulicsRecipe,
    Recipe,
    ValidateRecipe,
    kind_of,
    load_recipe,
)
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.preprocessing.observations import payload_of
from ehbench.report.provenance import TracedRun
from ehbench.report.saved import read_series
from ehbench.runs import rundir
from ehbench.stages.base import REJECTED, PreparedFromLogs, Stage, Work, write_rig, write_series
from ehbench.stages.fitted_sensors import inherited
from ehbench.stages.inputs import Inputs, RigState, span_of
from ehbench.stages.notes import Notes
from ehbench.stages.planning import recipe_of
from ehbench.validation import (
    PreparedValidation,
    models_of,
    prepare_log,
    run_validation,
    speaking_against,
)
from ehbench.validation.held_out import FittedSamples, overlaps
from ehbench.validation.results import Validation
from ehbench.vocabulary import EhbenchError, Progress, message, plural
from ehbench.vocabulary.messages import of_log


@dataclass(frozen=True)
class PreparedJudgement(PreparedFromLogs):
    """The logs as the judge takes them, and what the rig's fit knows of their sensors."""

    recipe: ValidateRecipe
    validation: PreparedValidation
    sensors: tuple[str, ...] = ()


class ValidationStage(Stage[ValidateRecipe, PreparedJudgement]):
    """`ValidateRecipe`."""

    name = "validation"
    command = "validate"
    writes = "validation.json, rig.toml, a series for each log, figures"

    def prepare(self, recipe: ValidateRecipe, inputs: Inputs) -> PreparedJudgement:
        notes = inputs.notes
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        logs = inputs.logs(recipe.data, state.rig)
        used, fitted = set(), []
        for folder in (path for _, path in state.inputs if path.is_dir()):
            fitted_on = rundir.read_json(folder / "run.json").get("fitted_on", [])
            used.update(fitted_on)
            if not fitted_on or not (folder / "parameters.json").is_file():
                continue
            names = rundir.read_json(folder / "parameters.json").get("recordings", [])
            for name, digest in zip(names, fitted_on, strict=False):
                path = folder / "series" / f"{name}.csv"
                if path.is_file():
                    series = read_series(path)
                    fitted.append(FittedSamples(name, series.t, series.recorded, digest))
        channels = [set(record.channels) for _, record in logs.records]
        shared = set.intersection(*channels) if channels else set()
        sensors, texts = inherited(state.origin, recipe.sensor, shared, state.rig)
        judged, models = [], {}
        if logs.records:
            models = models_of(state.rig, logs.records, recipe.channels, state.flow_maps, recipe.at)
        for (name, record), (_, path), index in zip(
            logs.records, logs.inputs, logs.entries, strict=True
        ):
            digest = rundir.sha256(path)
            seen = partial(overlaps, fitted=fitted, digest=digest)
            known = digest in used - {rows.digest for rows in fitted}
            scored = recipe.data[index].scored
            with notes.collected():
                model = models[payload_of(record) or ""]
                log = prepare_log(name, record, model, known, scored, seen, sensors)
                judged.append(log)
                notes.remarks += [of_log(name, text) for text in log.log.notes]
                if log.failure is not None:
                    notes.add_error(log.failure)
        _note_fitted(recipe, inputs)
        notes.remarks += texts
        does = message(
            "stages.does_validation",
            logs=plural(len(recipe.data), "log"),
            limits=", ".join(_limits(recipe, state.rig)) or "no limit is set",
        )
        validation = PreparedValidation(
            state.rig, recipe.channels, tuple(judged), state.flow_maps, _training(state, inputs)
        )
        files = (*state.inputs, *logs.files)
        return PreparedJudgement(recipe, files, does, state, logs, validation, texts)

    def results(self, prepared: PreparedJudgement) -> list[Any]:
        return [Validation, {"accepted": bool}]

    def work(self, prepared: PreparedJudgement, folder: Path, progress: Progress | None) -> Work:
        state, recipe, validation = prepared.state, prepared.recipe, prepared.validation
        intervals = state.origin / "parameters.json"
        if intervals.is_file():  # they travel with the rig they belong to
            shutil.copyfile(intervals, folder / "parameters.json")
        validation = replace(validation, leans=speaking_against(state.saved("parameters")))
        verdict = run_validation(validation, recipe.thresholds, progress, diagnose=recipe.structure)
        write_rig(folder, state.rig, state.flow_maps)
        others = [item.as_json() for item in recipe.reference]
        additional = {"references": others} if others else {}
        rundir.write_json(folder / "validation.json", verdict.as_json() | additional)
        write_series(folder / "series", [(log.name, log.series) for log in verdict.logs])
        work = prepared.done(
            [*prepared.sensors, *verdict.warnings],
            accepted=verdict.accepted,
            verdict=verdict.verdict,
            reservations=list(verdict.reservations),
        )
        if verdict.accepted:
            return work
        reported = " ".join(verdict.reasons)
        causes = [
            f"{item.sentence}; {item.remedy}"
            for item in verdict.structure.findings[:2]
            if item.sentence not in reported
        ]
        return Work(work.facts, [*verdict.reasons, *causes], REJECTED)


def _limits(recipe: ValidateRecipe, rig: Rig) -> list[str]:
    limits = recipe.thresholds
    texts: list[str] = [
        message("stages.limit_fit", name=name, minimum=minimum)
        for name, minimum in limits.fit_percent.items()
    ]
    texts += [
        message("stages.limit_error", name=name, maximum=rig.shown(name, float(maximum)))
        for name, maximum in limits.max_error.items()
    ]
    for name in ("natural_frequency", "damping_ratio"):
        if share := getattr(limits, f"{name}_error"):
            texts.append(f"{name.replace('_', ' ')} within {100.0 * share:g} %")
    for name in ("gain", "phase", "delay"):
        limit = getattr(limits, f"response_{name}_error")
        if limit is not None:
            shown = f"{100.0 * limit:g} %" if name == "gain" else rig.shown(name, float(limit))
            texts.append(message("stages.limit_response", name=name, limit=shown))
    return texts + [word for word in ("whiteness", "independence") if getattr(limits, word)]


def _training(state: RigState, inputs: Inputs) -> tuple[tuple[str, Record], ...]:
    """The logs that the run behind a rig fitted it to, none where they are not as they were."""
    try:
        fit = TracedRun(state.origin)
        recipe = recipe_of(fit)
        same = all(source.is_same for source in fit.sources if source.role == "log")
        fitting = replace(inputs, recipe=recipe, notes=Notes(recipe))
        return tuple(fitting.logs(recipe.data, state.rig).records) if same else ()
    except EhbenchError:
        return ()


def _note_fitted(recipe: ValidateRecipe, inputs: Inputs) -> None:
    """Note the logs of this recipe that the recipes upstream fit its rig to."""
    fits: list[tuple[Path, DataFile, str]] = []
    upstream: Recipe = recipe
    while (rig := getattr(upstream, "rig", None)) is not None:
        by = upstream.file(rig)
        if not by.is_file() or kind_of(by) != "recipe":
            break
        upstream = load_recipe(by)
        for entry in upstream.data if isinstance(upstream, HydraulicsRecipe) else ():
            log = upstream.file(entry.path)
            if log.is_file() and log.suffix != ".toml":
                fits.append((by, entry, rundir.sha256(log)))
    for item in recipe.data:
        path = recipe.file(item.path)
        if not path.is_file():
            continue
        digest = rundir.sha256(path)
        judged = [span_of(item)] if item.scored is None else [span_of(item), item.scored]
        for by, entry, used in fits:
            starts, stops = zip(*judged, span_of(entry), strict=True)
            if used == digest and max(starts) < min(stops):  # samples in common
                fit = inputs.notes.name_of(by)
                inputs.notes.add("remarks", message("stages.fitted_to", name=item.path, recipe=fit))
                break
