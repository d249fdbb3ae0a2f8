"""Validated rig → controller gains: ``tuning.json`` with what was promised at every operating
point.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench import rundir
from ehbench.errors import InsufficientData, ModelRejected
from ehbench.recipe import TuneRecipe
from ehbench.stages.base import Prepared, Progress, Stage, Work, write_rig
from ehbench.stages.findings import counted
from ehbench.stages.inputs import Inputs, ValidatedRig

if TYPE_CHECKING:
    from ehbench.tune.study import Study


@dataclass(frozen=True)
class PreparedTuning(Prepared):
    """The operating points; None where a check without flow maps finds none."""

    recipe: TuneRecipe
    state: ValidatedRig
    study: Study | None


class TuningStage(Stage[TuneRecipe, PreparedTuning]):
    """`TuneRecipe`."""

    recipe = TuneRecipe
    name = "tuning"
    command = "tune"
    writes = "tuning.json, rig.toml, figures"

    def prepare(self, recipe: TuneRecipe, inputs: Inputs) -> PreparedTuning:
        state = _validated(recipe, inputs)
        cylinder = recipe.cylinder or state.rig.cylinder[0].name
        factors = {
            "stroke": recipe.strokes or range(recipe.postures),
            "payload": recipe.payloads or (None, *state.rig.payload),
            "speed": recipe.speed_shares,
        }
        points = " × ".join(
            [*(counted(items, word) for word, items in factors.items()), "working functions"]
        )
        does = (
            f"chooses the pressure feedback of '{cylinder}' over {points}, "
            f"and tries {recipe.draws} draws"
        )
        return PreparedTuning(
            recipe,
            state.inputs,
            does,
            state,
            _study(recipe, state),
            seeds={"draws": recipe.seed},
        )

    def work(self, prepared: PreparedTuning, folder: Path, progress: Progress | None) -> Work:
        from ehbench.tune.gains import tune_prepared

        state = prepared.state
        assert prepared.study is not None  # a run without operating points is refused
        correlation = _correlation(state)
        if progress is not None:
            progress("operating points", 0.0)
        tuning = tune_prepared(prepared.study, correlation=correlation, progress=progress)
        write_rig(folder, state.rig, state.flow_maps)
        rundir.write_json(folder / "tuning.json", tuning.as_json())
        validated, warnings = state.stage == "validated", list(tuning.warnings)
        if not validated:
            warnings.insert(0, "tuned on a rig that no validation accepted (--unvalidated)")
        return Work({"rig": state.rig.name, "validated": validated, "warnings": warnings})


def _validated(recipe: TuneRecipe, inputs: Inputs) -> ValidatedRig:
    """The rig of the recipe, which a validation must have accepted unless the user insists."""
    state = inputs.rig_state(recipe.rig, recipe.flow_maps)
    if isinstance(state, ValidatedRig):
        return state
    if not inputs.unvalidated:
        refusal = ModelRejected(
            f"rig '{state.rig.name}' is not validated ({state.stage}), "
            "so no controller is tuned on it",
            file=recipe.path,
            hint="name the recipe or run of its validation as rig, or add --unvalidated",
        )
        inputs.findings.refuse(
            refusal,
            "its rig is not validated",
            f"the rig is not validated ({state.stage}): tune refuses it without --unvalidated",
        )
    return ValidatedRig.insisted(state)


def _study(recipe: TuneRecipe, state: ValidatedRig) -> Study | None:
    from ehbench.tune.study import prepare_tuning

    try:
        return prepare_tuning(state, recipe)
    except InsufficientData:
        if not state.blind:
            raise
        return None


def _correlation(state: ValidatedRig) -> tuple[list[str], Any] | None:
    """(names, matrix) of the identified parameters behind the rig."""
    path = state.origin / "parameters.json"
    if not (state.origin.is_dir() and path.is_file()):
        return None
    known = rundir.read_json(path)
    return (known["correlated_names"], known["correlation"]) if known["correlation"] else None
