"""Step logs → identified rig: ``rig.toml``, maps, ``parameters.json``, series of the logs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tomli_w

from ehbench.config.recipe import HydraulicsRecipe, Recipe, read_toml
from ehbench.config.recipe.sensor import Sensor
from ehbench.config.rig import Rig
from ehbench.frequency_response.response import Averaging
from ehbench.guidance.comparison import comparison_of
from ehbench.guidance.suggestions import Suggestions
from ehbench.identification import hydraulics
from ehbench.identification.hydraulics import PreparedFit
from ehbench.identification.journal import Journal, journal_of
from ehbench.identification.results import FittedParameter, HydraulicsFit
from ehbench.identification.search import coordinates
from ehbench.runs import rundir
from ehbench.runtime.disk import filling, write_text
from ehbench.stages import base
from ehbench.stages.fitted_sensors import tables_of
from ehbench.stages.inputs import Inputs, Logs, RigState
from ehbench.stages.relocation import name_from, relocated
from ehbench.vocabulary import InputError, Progress, message, plural, quantity

_METHODS = {"thesis": "log decrement", "output_error": "output error"}
# options of a fit that a recipe says as they are
_OPTIONS = (
    *("method", "start", "lower", "upper", "prior", "channels"),
    *("decimate", "max_iterations", "workers"),
)


@dataclass(frozen=True)
class PreparedHydraulics(base.PreparedFromLogs):
    """The fit, and one with each of the dynamics to compare; None without a log, in a dry run."""

    recipe: HydraulicsRecipe
    fit: PreparedFit | None
    variants: dict[str, PreparedFit]
    journal: Journal | None = None


class HydraulicsStage(base.Stage[HydraulicsRecipe, PreparedHydraulics]):
    """`HydraulicsRecipe`."""

    name = "hydraulics"
    command = "identify"
    writes = "rig.toml, parameters.json, a series for each log, figures"

    def prepare(self, recipe: HydraulicsRecipe, inputs: Inputs) -> PreparedHydraulics:
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        bounds = (recipe.start, recipe.lower, recipe.upper)
        coordinates(state.rig, recipe.parameters, *bounds, recipe.at, recipe.prior)
        logs = inputs.logs(recipe.data, state.rig, driven=True)
        fit, variants = None, {}
        if logs.records:
            fit = _prepared_fit(recipe, state, logs, state.rig, recipe.sensor)
            inputs.notes.add("remarks", *(text for log in fit.logs for text in log.warnings))
            compared = recipe.compare_dynamics
            if compared and state.rig.model is not None:
                where = recipe.at("compare_dynamics")
                raise InputError(message("stages.fmu_no_laws"), **where)
            rigs = hydraulics.with_each_dynamics(state.rig, compared) if compared else {}
            sensors = (*recipe.sensor, *recipe.compare_sensor)
            variants = {
                name: _prepared_fit(recipe, state, logs, rig, sensors) for name, rig in rigs.items()
            }
        does = message(
            "stages.does_hydraulics",
            parameters=", ".join(recipe.parameters),
            logs=plural(len(recipe.data), "log"),
            method=_METHODS[recipe.method],
        )
        if recipe.compare_dynamics:
            does += message("stages.does_compare", dynamics=", ".join(recipe.compare_dynamics))
        inputs.notes.add("undecided", message("stages.sensitivity"))
        files = (*state.inputs, *logs.files)
        return PreparedHydraulics(recipe, files, does, state, logs, fit, variants)

    def results(self, prepared: PreparedHydraulics) -> list[Any]:
        return [dict.fromkeys(prepared.recipe.parameters, FittedParameter), HydraulicsFit]

    def run(self, prepared: PreparedHydraulics, host: base.Host) -> base.Outcome:
        path = prepared.recipe.path
        about = {
            "about": message("stages.journal", recipe=path.name),
            "hash": rundir.hash_of(path, prepared.inputs or (), self.versions(prepared)),
        }
        with journal_of(self.place(prepared, host), about, host.resume) as journal:
            here = (message("stages.begun_anew"),) * (host.resume and not journal.known)
            outcome = super().run(replace(prepared, journal=journal), host)
        return replace(outcome, notes=(*outcome.notes, *here))

    def work(
        self, prepared: PreparedHydraulics, folder: Path, progress: Progress | None
    ) -> base.Work:
        recipe, logs = prepared.recipe, prepared.logs
        assert prepared.fit is not None  # a run has all its logs
        fit = hydraulics.run_fit(prepared.fit, progress, prepared.journal)
        fits = {
            name: hydraulics.run_fit(item, progress, prepared.journal)
            for name, item in prepared.variants.items()
        }
        compared = [variant.as_json() for variant in (hydraulics.ranked(fits) if fits else ())]
        base.write_rig(folder, fit.rig, prepared.state.flow_maps)
        additional = tables_of(recipe.sensor) | {"dynamics_comparison": compared}
        advice = comparison_of(prepared.fit).steps
        additional["advice"] = [{"key": step.key, "fields": step.fields} for step in advice]
        rundir.write_json(folder / "parameters.json", fit.as_json() | additional)
        base.write_series(folder / "series", fit.recordings)
        fitted_on = [rundir.sha256(path) for _, path in logs.inputs]
        return prepared.done(fit.warnings, method=recipe.method, fitted_on=fitted_on)


def expect_hydraulics(recipe: Recipe) -> HydraulicsRecipe:
    """The recipe, which fits hydraulics.

    Raises:
        InputError: it does not."""
    if not isinstance(recipe, HydraulicsRecipe):
        raise InputError(message("stages.no_hydraulics"), file=recipe.path)
    return recipe


def write_suggested(prepared: PreparedHydraulics, result: Suggestions, folder: Path) -> Path:
    """The first of some suggestions as files: ``rig.toml``, the recipe that fits it and
    ``suggestions.json``; returns the recipe's path.

    Raises:
        InputError: the folder is there and not empty."""
    if folder.exists() and any(folder.iterdir()):
        raise InputError(message("stages.not_empty"), file=folder)
    recipe, setup = prepared.recipe, result.setups[0]
    table = relocated(read_toml(recipe.path)[0], partial(name_from, folder, recipe))
    if prepared.state.flow_maps is not None:
        table["flow_maps"] = "."
    table |= {"rig": "rig.toml", "parameters": list(setup.parameters)}
    table["start"] = {
        name: f"{float(value):.6g} {quantity(name).unit}".removesuffix(" dimensionless")
        for name, value in setup.options.start.items()
    }
    bounds = [(name, maximum) for change in setup.changes for name, maximum in change.upper.items()]
    if bounds:
        more = {name: setup.rig.shown(name, maximum, 5) for name, maximum in bounds}
        table["upper"] = table.get("upper", {}) | more
    if result.compared.lines:
        table["channels"] = list(result.compared.channels)
        table |= {"tied": "position"} if result.compared.tied else {}
    if setup.options.sensors:
        table["sensor"] = [sensor.as_toml() for sensor in setup.options.sensors]
    with filling(folder) as scratch:
        base.write_rig(scratch, setup.rig, prepared.state.flow_maps)
        write_text(scratch / recipe.path.name, tomli_w.dumps(table))
        rundir.write_json(scratch / "suggestions.json", [asdict(row) for row in result.rows])
    return folder / recipe.path.name


def _prepared_fit(
    recipe: HydraulicsRecipe, state: RigState, logs: Logs, rig: Rig, sensors: Sequence[Sensor]
) -> PreparedFit:
    given = recipe.response
    response = None if given is None else (given.input, Averaging.of(given))
    options = hydraulics.FitOptions(
        **{name: getattr(recipe, name) for name in _OPTIONS},
        sensors=sensors,
        cutoff=None if recipe.cutoff is None else float(recipe.cutoff),
        response=response,
    )
    return hydraulics.prepare_fit(
        rig, logs.records, recipe.parameters, options, state.flow_maps, recipe.at
    )
