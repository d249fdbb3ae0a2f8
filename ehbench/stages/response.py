"""Logs → frequency response: ``response.json``, ``response.csv``."""

from dataclasses import asdict, dataclass
from pathlib import Path

from ehbench.config.recipe import ResponseRecipe
from ehbench.frequency_response.response import Averaging, Signals, estimate, prepare_signals
from ehbench.frequency_response.transfer import notes_of, transfers
from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.stages.base import PreparedFromLogs, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary import Progress, message, plural, quantity


@dataclass(frozen=True)
class PreparedResponse(PreparedFromLogs):
    """Input and output of the logs; None without a log, in a dry run."""

    recipe: ResponseRecipe
    signals: Signals | None


class ResponseStage(Stage[ResponseRecipe, PreparedResponse]):
    """`ResponseRecipe`."""

    name = "response"
    command = "response"
    writes = "response.json, response.csv, rig.toml, figures"

    def prepare(self, recipe: ResponseRecipe, inputs: Inputs) -> PreparedResponse:
        state = inputs.rig_state(recipe.rig)
        logs = inputs.logs(recipe.data, state.rig)
        signals, choice = None, Averaging.of(recipe)
        with inputs.notes.collected():
            if logs.records:
                signals = prepare_signals(logs.records, (recipe.input, recipe.output), choice)
        inputs.notes.add("undecided", message("stages.coherence"))
        does = message(
            "stages.does_response",
            output=recipe.output,
            input=recipe.input,
            logs=plural(len(recipe.data), "log"),
        )
        return PreparedResponse(recipe, (*state.inputs, *logs.files), does, state, logs, signals)

    def work(self, prepared: PreparedResponse, folder: Path, progress: Progress | None) -> Work:
        recipe = prepared.recipe
        assert prepared.signals is not None  # a run has all its logs
        signals, result = prepared.signals, estimate(prepared.signals)
        unused = () if recipe.window is None else (message("frequency_response.window"),)
        held = recipe.input.endswith(".command")
        forms = transfers(signals.pairs, signals.rate, held) if recipe.transfer else ()
        warnings = (*unused, *result.warnings, *(notes_of(forms) if recipe.transfer else ()))
        unit = f"({quantity(recipe.output).unit})/({quantity(recipe.input).unit})"
        table = {
            "input": recipe.input,
            "output": recipe.output,
            "gain_unit": unit,
            "coherence_min": recipe.coherence_min,
            "logs": [name for name, _ in prepared.logs.records],
            **result.as_json(),
            "warnings": warnings,
        }
        if recipe.transfer:
            table["transfers"] = [asdict(form) for form in forms]
        rundir.write_json(folder / "response.json", table)
        write_text(folder / "response.csv", result.table(unit))
        write_rig(folder, prepared.state.rig, None)
        return prepared.done(warnings)
