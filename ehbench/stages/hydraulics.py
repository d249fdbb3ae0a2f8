"""Step logs → identified rig: ``rig.toml`` with its maps, ``parameters.json``, a series for each
log.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench.config.recipe import HydraulicsRecipe, read_toml
from ehbench.config.recipe.base import data_file
from ehbench.runs import rundir
from ehbench.stages.base import (
    DONE,
    INCOMPLETE,
    Host,
    Outcome,
    Prepared,
    Stage,
    Work,
    recorded_on,
    write_rig,
    write_series,
)
from ehbench.stages.findings import counted
from ehbench.stages.fitted_sensors import tables_of
from ehbench.stages.inputs import Inputs, Logs, RigState
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    from ehbench.config.recipe.sensor import Sensor
    from ehbench.config.rig import Rig
    from ehbench.guidance.suggestions import Suggestions
    from ehbench.identification.hydraulics import HydraulicsFit, PreparedFit
    from ehbench.identification.journal import Journal


@dataclass(frozen=True)
class PreparedHydraulics(Prepared):
    """The fit, and one with each of the dynamics to compare; None without a log, in a check."""

    recipe: HydraulicsRecipe
    state: RigState
    logs: Logs
    fit: PreparedFit | None
    variants: dict[str, PreparedFit]
    journal: Journal | None = None


class HydraulicsStage(Stage[HydraulicsRecipe, PreparedHydraulics]):
    """`HydraulicsRecipe`."""

    recipe = HydraulicsRecipe
    name = "hydraulics"
    command = "identify"
    writes = "rig.toml, parameters.json, a series for each log, figures"

    def prepare(self, recipe: HydraulicsRecipe, inputs: Inputs) -> PreparedHydraulics:
        from ehbench.identification.hydraulics import with_each_dynamics
        from ehbench.identification.search import coordinates

        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        given = (recipe.start, recipe.lower, recipe.upper)
        coordinates(state.rig, recipe.parameters, *given, recipe.at, recipe.prior)
        logs = inputs.logs(recipe.data, driven=True)
        fit, variants = None, {}
        if logs.records:
            fit = _prepared_fit(recipe, state, logs, state.rig, recipe.sensor)
            inputs.findings.say("notes", *(text for log in fit.logs for text in log.warnings))
            compared = recipe.compare_dynamics
            rigs = with_each_dynamics(state.rig, compared) if compared else {}
            sensors = (*recipe.sensor, *recipe.compare_sensor)
            variants = {
                name: _prepared_fit(recipe, state, logs, rig, sensors) for name, rig in rigs.items()
            }
        way = "matching frequency and decay" if recipe.method == "thesis" else "output error"
        does = f"fits {', '.join(recipe.parameters)} to {counted(recipe.data, 'log')} by {way}"
        if recipe.compare_dynamics:
            does += f", with each of the dynamics {', '.join(recipe.compare_dynamics)}"
        inputs.findings.say("open", "whether the logs carry these parameters")
        return PreparedHydraulics(
            recipe, (*state.inputs, *logs.files, *logs.maps), does, state, logs, fit, variants
        )

    def run(self, prepared: PreparedHydraulics, host: Host) -> Outcome:
        from ehbench.identification.journal import journal_of

        path = prepared.recipe.path
        about = {
            "about": f"how far a search has come that was stopped: ehbench identify {path.name} "
            "--resume",
            "hash": rundir.hash_of(path, prepared.inputs or (), self.versions(prepared)),
        }
        with journal_of(self.place(prepared, host), about, host.resume) as journal:
            return super().run(replace(prepared, journal=journal), host)

    def work(self, prepared: PreparedHydraulics, folder: Path, progress: Progress | None) -> Work:
        from ehbench.identification.hydraulics import ranked, run_fit

        recipe, logs = prepared.recipe, prepared.logs

        def fitted(entry: PreparedFit) -> HydraulicsFit:
            return run_fit(entry, progress, prepared.journal)

        assert prepared.fit is not None  # a run has all its logs
        fit = fitted(prepared.fit)
        fits = {name: fitted(item) for name, item in prepared.variants.items()}
        compared = [variant.as_json() for variant in (ranked(fits) if fits else ())]
        write_rig(folder, fit.rig, prepared.state.flow_maps)
        additional = tables_of(recipe.sensor) | {"dynamics_comparison": compared}
        rundir.write_json(folder / "parameters.json", fit.as_json() | additional)
        write_series(folder / "series", fit.series())
        facts = {
            "rig": fit.rig.name,
            "method": recipe.method,
            "warnings": [*logs.losses, *fit.warnings],
            "recorded_on": recorded_on(logs.records),
            "fitted_on": [rundir.sha256(path) for _, path in logs.inputs],
        }
        return Work(facts, code=INCOMPLETE if logs.losses else DONE)


def suggested(
    prepared: PreparedHydraulics, progress: Progress | None, seconds: float
) -> Suggestions:
    """What would better a recipe's fit."""
    from ehbench.guidance.suggestions import suggest

    assert prepared.fit is not None  # a run has all its logs
    return suggest(prepared.fit, prepared.logs.records, progress, seconds)


def write_suggested(prepared: PreparedHydraulics, result: Suggestions, folder: Path) -> Path:
    """The first of some suggestions as files: ``rig.toml``, the recipe that fits it and
    ``suggestions.json``; returns the recipe's path.

    Raises:
        InputError: the folder is there and not empty.
    """
    import tomli_w

    from ehbench.config.rig import parameter_row

    if folder.exists() and any(folder.iterdir()):
        raise InputError("exists and is not empty; nothing was written", file=folder)
    folder.mkdir(parents=True, exist_ok=True)
    recipe, setup = prepared.recipe, result.setups[0]
    table, _ = read_toml(recipe.path)
    write_rig(folder, setup.rig, prepared.state.flow_maps)
    if prepared.state.flow_maps is not None:
        table["flow_maps"] = "."
    entries: list[dict[str, Any]] = [dict(data_file(item)) for item in table["data"]]
    others: list[dict[str, Any]] = []
    for entry in entries:
        if "beside" in entry:
            entry["beside"] = [dict(data_file(item)) for item in entry["beside"]]
            others += entry["beside"]
    for item in (*entries, *others):
        item["path"] = _from(folder, recipe, item["path"])
    for item in (table, *entries, *others):
        columns = item.get("columns")
        if isinstance(columns, str):
            item["columns"] = _from(folder, recipe, columns)
        elif columns is not None and "file" in columns:
            columns["file"] = _from(folder, recipe, columns["file"])
    table |= {"rig": "rig.toml", "data": entries, "parameters": list(setup.parameters)}
    table["start"] = {
        name: f"{float(value):.6g} {parameter_row(name).unit}".removesuffix(" dimensionless")
        for name, value in setup.options.start.items()
    }
    bounds = [(name, maximum) for change in setup.changes for name, maximum in change.upper.items()]
    if bounds:
        more = {name: setup.rig.shown(name, maximum, 5) for name, maximum in bounds}
        table["upper"] = table.get("upper", {}) | more
    if setup.options.sensors:
        table["sensor"] = [sensor.as_toml() for sensor in setup.options.sensors]
    path = folder / recipe.path.name
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    rundir.write_json(folder / "suggestions.json", [row.as_json() for row in result.rows])
    return path


def _from(folder: Path, recipe: HydraulicsRecipe, name: str) -> str:
    """A file of a recipe as a recipe in another folder names it."""
    if "$" in name:
        return name
    return os.path.relpath(recipe.file(name), folder.resolve())


def _prepared_fit(
    recipe: HydraulicsRecipe, state: RigState, logs: Logs, rig: Rig, sensors: Sequence[Sensor]
) -> PreparedFit:
    from ehbench.frequency_response.response import Averaging
    from ehbench.identification.hydraulics import FitOptions, prepare_fit

    response, given = None, recipe.response
    if given is not None:
        maximum = math.inf if given.frequency_max is None else float(given.frequency_max)
        length = None if given.segment is None else float(given.segment)
        response = given.input, Averaging(length, given.window, given.coherence_min, maximum)
    options = FitOptions(
        method=recipe.method,
        start=recipe.start,
        lower=recipe.lower,
        upper=recipe.upper,
        prior=recipe.prior,
        channels=recipe.channels,
        sensors=sensors,
        cutoff=None if recipe.cutoff is None else float(recipe.cutoff),
        response=response,
        decimate=recipe.decimate,
        max_iterations=recipe.max_iterations,
        workers=recipe.workers,
    )
    return prepare_fit(rig, logs.records, recipe.parameters, options, state.flow_maps, recipe.at)
