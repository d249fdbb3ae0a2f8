"""Validated rig → controller gains: ``tuning.json`` with what was promised at every operating
point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ehbench.config.recipe import AnyTuning, ArcTuneRecipe, TuneRecipe
from ehbench.runs import rundir
from ehbench.stages.base import Prepared, Stage, Work, write_rig
from ehbench.stages.findings import counted
from ehbench.stages.inputs import Inputs, ValidatedRig
from ehbench.vocabulary.errors import InsufficientData, ModelRejected
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    from ehbench.tune.study import Study

R = TypeVar("R", bound=AnyTuning)


@dataclass(frozen=True)
class PreparedTuning(Prepared, Generic[R]):
    """The operating points; None where a check without flow maps finds none."""

    recipe: R
    state: ValidatedRig
    study: Study[R] | None


class TuningStage(Stage[TuneRecipe, PreparedTuning[TuneRecipe]]):
    """`TuneRecipe`."""

    recipe = TuneRecipe
    name = "tuning"
    command = "tune"
    writes = "tuning.json, rig.toml, figures"

    def prepare(self, recipe: TuneRecipe, inputs: Inputs) -> PreparedTuning[TuneRecipe]:
        state = _validated(recipe, inputs)
        cylinder = recipe.cylinder or state.rig.cylinder[0].name
        does = (
            f"chooses the pressure feedback of '{cylinder}' over {_points(recipe, state)}, "
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

    def work(
        self, prepared: PreparedTuning[TuneRecipe], folder: Path, progress: Progress | None
    ) -> Work:
        from ehbench.tune.gains import tune_prepared

        state = prepared.state
        assert prepared.study is not None  # a run without operating points is refused
        correlation = _correlation(state)
        if progress is not None:
            progress("operating points", 0.0)
        tuning = tune_prepared(prepared.study, correlation=correlation, progress=progress)
        write_rig(folder, state.rig, state.flow_maps)
        rundir.write_json(folder / "tuning.json", tuning.as_json())
        return _work(state, tuning.warnings)


class ArcTuningStage(Stage[ArcTuneRecipe, PreparedTuning[ArcTuneRecipe]]):
    """`ArcTuneRecipe`."""

    recipe = ArcTuneRecipe
    name = "arc_tuning"
    command = "tune"
    writes = "tuning.json, rig.toml, figures"

    def prepare(self, recipe: ArcTuneRecipe, inputs: Inputs) -> PreparedTuning[ArcTuneRecipe]:
        from ehbench.control.arc_gains import check_modelled
        from ehbench.plant.site import unmodelled_of

        state = _validated(recipe, inputs)
        cylinder = recipe.cylinder or state.rig.cylinder[0].name
        does = (
            f"chooses the bandwidths of adaptive robust control of '{cylinder}' over "
            f"{_points(recipe, state)}"
        )
        for item in state.rig.cylinder:
            if item.name == cylinder:
                check_modelled(unmodelled_of(state.rig, item), **recipe.at("what"))
        return PreparedTuning(recipe, state.inputs, does, state, _study(recipe, state))

    def work(
        self, prepared: PreparedTuning[ArcTuneRecipe], folder: Path, progress: Progress | None
    ) -> Work:
        from ehbench.tune.arc import tune_arc

        state = prepared.state
        assert prepared.study is not None  # a run without operating points is refused
        tuning = tune_arc(prepared.study, progress)
        write_rig(folder, state.rig, state.flow_maps)
        rundir.write_json(folder / "tuning.json", tuning.as_json())
        return _work(state, tuning.warnings)


def _points(recipe: AnyTuning, state: ValidatedRig) -> str:
    """What operating points are made of, in words."""
    factors = {
        "stroke": recipe.strokes or range(recipe.postures),
        "payload": recipe.payloads or (None, *state.rig.payload),
        "speed": recipe.speed_shares,
    }
    return " × ".join(
        [*(counted(items, word) for word, items in factors.items()), "working functions"]
    )


def _work(state: ValidatedRig, warnings: Sequence[str]) -> Work:
    """What is said of a tuning in its run."""
    validated, message = state.stage == "validated", list(warnings)
    if not validated:
        message.insert(0, "tuned on a rig that no validation accepted (--unvalidated)")
    return Work({"rig": state.rig.name, "validated": validated, "warnings": message})


def _validated(recipe: AnyTuning, inputs: Inputs) -> ValidatedRig:
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


def _study(recipe: R, state: ValidatedRig) -> Study[R] | None:
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
