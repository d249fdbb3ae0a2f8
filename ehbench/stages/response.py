"""Logs → frequency response: ``response.json``, ``response.csv``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from ehbench.config.recipe import AnyColumns, DataFiles, Recipe
from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.stages.base import PreparedFromLogs, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary import Progress, message, plural, quantity
from ehbench.vocabulary.fields import Q, Value

if TYPE_CHECKING:
    from ehbench.frequency_response.response import Signals


class ResponseRecipe(Recipe):
    """The frequency response from one channel of the logs to another."""

    stage: Literal["response"]
    rig: str = Field(description="whose units the report uses, and whose logs these are")
    data: DataFiles
    columns: AnyColumns = Field(
        default=None,
        description="which column of a file is which channel: `[columns]`, or the name of a map",
    )
    input: str = Field(description="channel, such as `boom.hect.command`")
    output: str = Field(description="channel, such as `boom.v`")
    segment: Annotated[Value, Q("duration")] | None = Field(
        default=None,
        description="length of a segment; none takes an eighth of the shortest log. "
        "Its inverse is the resolution in frequency",
    )
    window: Literal["hann", "boxcar"] | None = Field(
        default=None, description="of former versions; has no effect"
    )
    coherence_min: float = Field(
        default=0.8, gt=0, lt=1, description="from which a frequency counts"
    )
    transfer: bool = Field(
        default=False,
        description="whether plain transfer functions (one pole, two, or a pair with a damping "
        "ratio, with and without delay; a pair, a pole and delay) are fitted in time and compared",
    )
    frequency_max: Annotated[Value, Q("frequency")] | None = Field(
        default=None, description="what lies above is not looked at; none is half the logs' rate"
    )


@dataclass(frozen=True)
class PreparedResponse(PreparedFromLogs):
    """Input and output of the logs; None without a log, in a dry run."""

    recipe: ResponseRecipe
    signals: Signals | None


class ResponseStage(Stage[ResponseRecipe, PreparedResponse]):
    """`ResponseRecipe`."""

    recipe = ResponseRecipe
    name = "response"
    command = "response"
    writes = "response.json, response.csv, rig.toml, figures"

    def prepare(self, recipe: ResponseRecipe, inputs: Inputs) -> PreparedResponse:
        from ehbench.frequency_response.response import Averaging, prepare_signals

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
        from ehbench.frequency_response.response import estimate
        from ehbench.frequency_response.transfer import notes_of, transfers

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
