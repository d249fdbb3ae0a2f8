"""One trial on the model or on the virtual bench → ``log.mcap`` and ``trial.json``; a limit stops
it with exit 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench.config.recipe import AnyTuning, ArcTuneRecipe, TrialRecipe, load_recipe
from ehbench.runs import rundir
from ehbench.stages.base import DONE, STOPPED, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, NamedFiles, RigState
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress

if TYPE_CHECKING:
    from ehbench.config.rig import Rig
    from ehbench.trial import Case
    from ehbench.trial.preparation import Prepared as Ready

_TUNED = ("washout", "ramp_washout", "off_gain", "low_pressure", "cross_drop")


@dataclass(frozen=True)
class PreparedOne(Prepared):
    """One trial before its first tick."""

    recipe: TrialRecipe
    state: RigState
    trial: Ready


class TrialStage(Stage[TrialRecipe, PreparedOne]):
    """`TrialRecipe`."""

    recipe = TrialRecipe
    name = "trial"
    command = "run-trial"
    writes = "log.mcap, trial.json, ledger.json, rig.toml, figures"

    def prepare(self, recipe: TrialRecipe, inputs: Inputs) -> PreparedOne:
        from ehbench import trial

        trial.refuse_code(recipe, inputs.allow_code)
        with inputs.findings.noting():
            trial.refuse_unknown(recipe)
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        _, files, prepared = prepared_case("", recipe, state, inputs)
        law = recipe.controller
        what = "open loop" if law is None else f"controller '{law.label}'"
        lengths = [prepared.duration] if time_is_known(recipe, state) else []
        does = (
            f"runs one trial, {what} on {place_of(recipe.on)}, "
            f"{length_of(lengths, float(recipe.rate))}, payload {recipe.payload or 'none'}"
        )
        seeds = {"trial": recipe.seed}
        return PreparedOne(recipe, (*state.inputs, *files), does, state, prepared, seeds=seeds)

    def work(self, prepared: PreparedOne, folder: Path, progress: Progress | None) -> Work:
        from ehbench import trial

        state = prepared.state
        result = trial.run(prepared.trial, log=folder / "log.mcap", progress=progress)
        write_rig(folder, state.rig, state.flow_maps)
        facts, ledger, doubts = trial.account(prepared.trial, result)
        if ledger is not None:
            rundir.write_json(folder / "ledger.json", ledger)
        rundir.write_json(folder / "trial.json", facts.as_json())
        about = {
            "rig": state.rig.name,
            "on": prepared.recipe.on,
            "stopped": facts.stopped,
            "warnings": [*facts.warnings, *doubts],
        }
        if facts.stopped:
            return Work(about, [facts.stopped], STOPPED)
        return Work(about, code=DONE)


def place_of(on: str) -> str:
    """What a trial runs on, in words."""
    return "the model" if on == "model" else "the virtual bench"


def length_of(lengths: list[float], rate: float) -> str:
    """How long trials of these lengths [s] are, in words; without any, the flow maps tell."""
    ends = [f"{length:.4g}" for length in sorted({min(lengths), max(lengths)})] if lengths else []
    return (" to ".join(ends) + " s" if ends else "as long as the motion") + f" at {rate:g} Hz"


def prepared_case(
    name: str, recipe: TrialRecipe, state: RigState, inputs: Inputs
) -> tuple[Case, NamedFiles, Ready]:
    """(one trial, its inputs beside the rig, the trial before its first tick)."""
    from ehbench.trial import Case

    files, gains = _behind(recipe, state.rig, inputs)
    case = Case(name, recipe, state.rig, state.flow_maps, gains)
    timed = time_is_known(recipe, state)
    if not timed:
        inputs.findings.say(
            "open",
            "whether the motion stays in the stroke: its speeds are shares of what the flow maps "
            "allow",
        )
    prepared = case.prepare(allow_code=inputs.allow_code, standing=not timed)
    _say_unknown(recipe, prepared, inputs)
    return case, files, prepared


def time_is_known(recipe: TrialRecipe, state: RigState) -> bool:
    """Whether the motion is known; not where its speeds hang on maps that a check does not have."""
    motion = recipe.motion
    if not state.blind or motion is None or motion.full_speed is not None:
        return True
    return not any("%" in level for level in motion.levels)


def _say_unknown(recipe: TrialRecipe, prepared: Ready, inputs: Inputs) -> None:
    """What only the run can tell of a trial."""
    from ehbench.machines.protocol import truth_of

    findings = inputs.findings
    if truth_of(prepared.machine) is None and recipe.limits != type(recipe.limits)():
        findings.say(
            "open", "whether a limit is reached at the start: the virtual bench settles first"
        )
    if recipe.controller is not None and (code := recipe.controller.code) is not None:
        findings.say("notes", f"'{code}' is Python code: it runs only with --allow-code")
        findings.say("open", f"what '{code}' does: code is not run here")


def _behind(
    recipe: TrialRecipe, rig: Rig, inputs: Inputs
) -> tuple[NamedFiles, Path | Mapping[str, Any] | None]:
    """(inputs of a trial beside its rig, where its gains lie or what is known of them): bench,
    files it plays, the user's code, tune run.
    """
    from ehbench import trial

    named = [("bench", recipe.bench), *(("command", c.file) for c in recipe.command)]
    named.append(("motion", recipe.motion.file if recipe.motion is not None else None))
    files = []
    for role, name in named:
        if name:
            files.append((role, inputs.existing(name)))
            inputs.findings.say("reads", name)
    gains = _gains(recipe, rig, inputs)
    for code in trial.code_files(recipe):
        files.append(("code", code))
        inputs.findings.say("reads", inputs.findings.shown(code))
    if isinstance(gains, Path):
        files.append(("gains", gains))
    return tuple(files), gains


def _gains(recipe: TrialRecipe, rig: Rig, inputs: Inputs) -> Path | Mapping[str, Any] | None:
    """Where the tune run lies that a trial takes its gains from; in a check of one that has not
    been run, what its recipe says.

    Raises:
        InputError: it is no tune run or recipe.
    """
    from ehbench import trial

    name, law, motion = trial.gains_file(recipe), recipe.controller, recipe.motion
    if name is None or law is None:
        return None
    place = inputs.existing(name)
    if not (place.is_file() and place.suffix == ".toml"):
        inputs.findings.say("reads", f"{name} (gains)")
        return place
    behind = load_recipe(place)
    if not isinstance(behind, AnyTuning):
        raise InputError(
            f"gains come from '{name}', a recipe of stage '{behind.stage_name}'",
            **recipe.at(*law.where, "gains"),
            hint="name a tune recipe or its run",
        )
    folder = inputs.run_folder(place)
    if folder is not None:
        inputs.findings.say("reads", f"{folder} (gains)")
        return folder
    inputs.findings.say("open", f"what hangs on the gains: '{name}' has not been run")
    given = {
        key: float(value) for key in _TUNED if (value := getattr(behind, key, None)) is not None
    }
    own = (motion.cylinder if motion is not None else None) or rig.cylinder[0].name
    wrong = inputs.runs.findings(place)
    tuned = own if wrong is not None and wrong.errors else behind.cylinder or own
    if isinstance(behind, ArcTuneRecipe):
        return {"cylinder": tuned}
    return {"cylinder": tuned, "feedback_gain": 0.0, **given}
