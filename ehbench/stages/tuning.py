"""Validated rig → ``tuning.json``: gains, and what they promise at operating points."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from ehbench.config.recipe import AnyTuning, ArcTuneRecipe, TuneRecipe
from ehbench.control.arc_gains import check_modelled
from ehbench.plant.design_point import unmodelled_of
from ehbench.runs import rundir
from ehbench.stages.base import DONE, REJECTED, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, ValidatedRig
from ehbench.tune.arc import ArcTuning, tune_arc
from ehbench.tune.gains import tune_pressure_feedback
from ehbench.tune.results import Tuning
from ehbench.tune.study import Study, prepare_tuning
from ehbench.vocabulary import InsufficientData, Progress, message, plural
from ehbench.vocabulary.errors import ModelRejected

R = TypeVar("R", bound=AnyTuning)


@dataclass(frozen=True)
class PreparedTuning(Prepared, Generic[R]):
    """The operating points; None where a dry run without flow maps finds none."""

    recipe: R
    state: ValidatedRig
    study: Study[R] | None


class _AnyTuningStage(Stage[R, PreparedTuning[R]]):
    command = "tune"
    writes = "tuning.json, rig.toml, figures"

    def _prepared(self, recipe: R, inputs: Inputs, **seeds: int) -> PreparedTuning[R]:
        state, study = inputs.rig_state(recipe.rig, recipe.flow_maps), None
        if not isinstance(state, ValidatedRig):
            if not inputs.unvalidated:
                text = message("stages.not_validated", rig=state.rig.name, stage=state.stage)
                remark = message("stages.needs_unvalidated", stage=state.stage)
                inputs.notes.refuse(ModelRejected(text, file=recipe.path), remark)
            state = ValidatedRig(**vars(state))  # the user insists
        factors = {
            "stroke": recipe.strokes or range(recipe.postures),
            "payload": recipe.payloads or (None, *state.rig.payload),
            "speed": recipe.speed_shares,
        }
        points = " × ".join(plural(len(items), word) for word, items in factors.items())
        fields = {"cylinder": recipe.cylinder or state.rig.cylinder[0].name, "points": points}
        does = message("stages.does_arc_tuning", **fields)
        if isinstance(recipe, TuneRecipe):
            does = message("stages.does_tuning", draws=recipe.draws, **fields)
        try:
            study = prepare_tuning(state.rig, state.flow_maps, recipe)
        except InsufficientData:
            if not state.without_maps:
                raise
        return PreparedTuning(recipe, state.inputs, does, state, study, seeds=seeds)

    def _written(
        self, prepared: PreparedTuning[R], folder: Path, tuning: Tuning | ArcTuning
    ) -> Work:
        state = prepared.state
        write_rig(folder, state.rig, state.flow_maps)
        rundir.write_json(folder / "tuning.json", tuning.as_json())
        validated, warnings = state.stage == "validated", list(tuning.warnings)
        if not validated:
            warnings.insert(0, message("stages.tuned_unvalidated"))
        facts = {"rig": state.rig.name, "validated": validated, "warnings": warnings}
        # under which a validation accepted the rig
        reservations = state.saved("validation").get("reservations", [])
        if reservations:
            warnings.insert(0, message("stages.tuned_with_reservation", reason=reservations[0]))
        reasons = [] if tuning.met else [message("stages.demands_missed")]
        return Work(
            facts | {"reservations": reservations}, reasons, DONE if tuning.met else REJECTED
        )


class TuningStage(_AnyTuningStage[TuneRecipe]):
    """`TuneRecipe`."""

    name = "tuning"

    def results(self, prepared: PreparedTuning[TuneRecipe]) -> list[Any]:
        return [Tuning]

    def prepare(self, recipe: TuneRecipe, inputs: Inputs) -> PreparedTuning[TuneRecipe]:
        return self._prepared(recipe, inputs, draws=recipe.seed)

    def work(
        self, prepared: PreparedTuning[TuneRecipe], folder: Path, progress: Progress | None
    ) -> Work:
        assert prepared.study is not None  # a run without operating points is refused
        if progress is not None:
            progress("operating points", 0.0)
        known, correlation = prepared.state.saved("parameters"), None
        if known.get("correlation"):
            correlation = known["correlated_names"], known["correlation"]
        tuning = tune_pressure_feedback(prepared.study, correlation, progress)
        return self._written(prepared, folder, tuning)


class ArcTuningStage(_AnyTuningStage[ArcTuneRecipe]):
    """`ArcTuneRecipe`."""

    name = "arc_tuning"

    def results(self, prepared: PreparedTuning[ArcTuneRecipe]) -> list[Any]:
        return [ArcTuning]

    def prepare(self, recipe: ArcTuneRecipe, inputs: Inputs) -> PreparedTuning[ArcTuneRecipe]:
        prepared = self._prepared(recipe, inputs)
        rig = prepared.state.rig
        cylinder = recipe.cylinder or rig.cylinder[0].name
        for item in rig.cylinder:
            if item.name == cylinder:
                check_modelled(unmodelled_of(rig, item), **recipe.at("what"))
        return prepared

    def work(
        self, prepared: PreparedTuning[ArcTuneRecipe], folder: Path, progress: Progress | None
    ) -> Work:
        assert prepared.study is not None  # a run without operating points is refused
        return self._written(prepared, folder, tune_arc(prepared.study, progress))
