"""Files of the virtual bench, which no command runs: a bench, and a dataset recorded on it."""

from __future__ import annotations

from ehbench.config.recipe import BenchRecipe, DatasetRecipe, TrialRecipe, load_rig
from ehbench.stages.base import Checked, Prepared
from ehbench.stages.findings import counted
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary.fields import Value


class BenchFile(Checked[BenchRecipe]):
    """`BenchRecipe`."""

    recipe = BenchRecipe

    def prepare(self, recipe: BenchRecipe, inputs: Inputs) -> Prepared:
        from ehbench import trial

        rig = load_rig(inputs.existing(recipe.rig))
        own = {"on": "bench", "bench": recipe.path.name, "rig": recipe.rig, "path": recipe.path}
        trial.prepare(TrialRecipe(stage="trial", duration=Value(1.0), **own), rig)
        inputs.findings.say("reads", f"{recipe.rig} (rig '{rig.name}')")
        return Prepared(recipe, None, 'is a virtual bench for trials with on = "bench"')


class Dataset(Checked[DatasetRecipe]):
    """`DatasetRecipe`, which ``python -m tools.datasets`` records."""

    recipe = DatasetRecipe

    def prepare(self, recipe: DatasetRecipe, inputs: Inputs) -> Prepared:
        behind = inputs.runs.findings(inputs.existing(recipe.bench))
        for error in behind.errors if behind is not None else ():
            inputs.findings.mistake(error)
        inputs.findings.say("reads", f"{recipe.bench} (virtual bench)")
        does = f"is recorded on the virtual bench: {counted(recipe.log, 'log')}"
        if recipe.flowmeter:
            does += f", flowmeter readings of {counted(recipe.flowmeter.edges, 'edge')}"
        return Prepared(recipe, None, does)
