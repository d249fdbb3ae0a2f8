"""Files of the virtual bench, which no command runs: a bench, and a dataset recorded on it."""

from ehbench import trial
from ehbench.config.recipe import BenchRecipe, DatasetRecipe, TrialRecipe, load_rig
from ehbench.stages.base import Prepared, Stage
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary import message, plural
from ehbench.vocabulary.fields import Value


class BenchFile(Stage[BenchRecipe, Prepared]):
    """`BenchRecipe`."""

    def prepare(self, recipe: BenchRecipe, inputs: Inputs) -> Prepared:
        rig = load_rig(inputs.existing(recipe.rig))
        keys = {"on": "bench", "bench": recipe.path.name, "rig": recipe.rig, "path": recipe.path}
        trial.prepare(TrialRecipe(stage="trial", duration=Value(1.0), **keys), rig)
        inputs.notes.add("reads", f"{recipe.rig} (rig '{rig.name}')")
        return Prepared(recipe, None, message("stages.does_bench"))


class Dataset(Stage[DatasetRecipe, Prepared]):
    """`DatasetRecipe`, which ``python -m tools.datasets`` records."""

    def prepare(self, recipe: DatasetRecipe, inputs: Inputs) -> Prepared:
        bench = inputs.existing(recipe.bench)
        for error in inputs.check(bench).errors if inputs.check is not None else ():
            inputs.notes.add_error(error)
        inputs.notes.add("reads", f"{recipe.bench} (virtual bench)")
        does = message("stages.does_dataset", logs=plural(len(recipe.log), "log"))
        if recipe.flowmeter:
            edges = plural(len(recipe.flowmeter.edges), "edge")
            does += message("stages.does_flowmeter", edges=edges)
        return Prepared(recipe, None, does)
