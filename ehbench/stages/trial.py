"""One trial → ``log.mcap``, ``trial.json``; a limit stops it with exit 5."""

from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from ehbench import trial
from ehbench.config.recipe import AnyTuning, ArcTuneRecipe, TrialRecipe, load_recipe
from ehbench.config.rig import Rig
from ehbench.live.view import View
from ehbench.machines.paced import PacedMachine
from ehbench.machines.protocol import truth_of
from ehbench.runs import rundir
from ehbench.stages.base import DONE, STOPPED, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, NamedFiles, RigState
from ehbench.trial import Case, Facts
from ehbench.trial.limit_cycle import LimitCycle
from ehbench.trial.measures import StepMeasures
from ehbench.trial.preparation import Prepared as Ready
from ehbench.vocabulary import InputError, Progress, message
from ehbench.vocabulary.codes import LIMITS

_TUNED = ("washout", "ramp_washout", "off_gain", "low_pressure", "cross_drop")


@dataclass(frozen=True)
class PreparedOne(Prepared):
    """One trial before its first tick."""

    recipe: TrialRecipe
    state: RigState
    trial: Ready
    ask: Callable[[str, str], str] | None = None
    live: Callable[[str], bool] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        return self.trial.notes


class TrialStage(Stage[TrialRecipe, PreparedOne]):
    """`TrialRecipe`."""

    name = "trial"
    command = "run-trial"
    writes = "log.mcap, trial.json, ledger.json, rig.toml, figures"

    def prepare(self, recipe: TrialRecipe, inputs: Inputs) -> PreparedOne:
        trial.refuse_code(recipe, inputs.allow_code)
        with inputs.notes.collected():
            trial.refuse_unknown(recipe)
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        _, files, prepared = prepared_case("", recipe, state, inputs)
        law = recipe.controller
        lengths = [prepared.duration] if time_is_known(recipe, state) else []
        does = message(
            "stages.does_trial",
            control="open loop" if law is None else f"controller '{law.label}'",
            place=PLACES.get(recipe.on, recipe.on),
            length=length_of(lengths, float(recipe.rate)),
            payload=recipe.payload or "none",
        )
        seeds, named = {"trial": recipe.seed}, (*state.inputs, *files)
        ask, live = inputs.ask, inputs.live
        return PreparedOne(recipe, named, does, state, prepared, ask, live, seeds=seeds)

    def default_place(self, prepared: PreparedOne, root: Path) -> Path:
        """As `Stage.default_place`; each trial of a machine has a folder by its time."""
        place = super().default_place(prepared, root)
        if prepared.recipe.on in PLACES:
            return place
        return place.with_name(f"{place.name}_{datetime.now():%Y%m%d_%H%M%S}")

    def results(self, prepared: PreparedOne) -> list[Any]:
        loop, others = prepared.trial.loop, [Facts, {"ledger": Any}]
        if loop is None:
            return others
        first, *more = (
            {**measure_types(), **(part.used if part is not None else {})}
            for part in loop.laws or (None,)
        )
        names = (item.cylinder for item in loop.driven[1:])
        also = {"also": dict(zip(names, more, strict=True))} if more else {}
        return [first | also, *others]

    def work(self, prepared: PreparedOne, folder: Path, progress: Progress | None) -> Work:
        state, ready, live = prepared.state, prepared.trial, prepared.live
        log, on, more, late = folder / "log.mcap", prepared.recipe.on, {}, []
        with nullcontext() if live is None else closing(View(ready, live)) as view:
            if on in PLACES:
                machine = ready.machine if view is None else PacedMachine.of(ready.machine)
                result = trial.run(ready, machine, log, progress, True, view, view)
            else:
                from ehbench.links.arming import run_remote

                remote = run_remote(ready, on, prepared.ask, log, progress, view, view)
                result, late = remote.result, remote.warnings
                more = {"link": remote.link, "dry_run": remote.dry_run}
        write_rig(folder, state.rig, state.flow_maps)
        facts, ledger, warnings = trial.account(prepared.trial, result)
        if ledger is not None:
            rundir.write_json(folder / "ledger.json", ledger)
        rundir.write_json(folder / "trial.json", facts.as_json() | more)
        about = {
            "rig": state.rig.name,
            "on": on,
            "stopped": facts.stopped,
            "warnings": [*facts.warnings, *warnings, *late],
        }
        if facts.stopped:
            return Work(about, [facts.stopped], STOPPED)
        return Work(about, code=DONE)


@cache
def measure_types() -> dict[str, Any]:
    """The measures of a trial with what they hold."""
    return {
        "steps": tuple[StepMeasures, ...],
        "tracking": dict.fromkeys(("max_error", "rms_error", "final_error"), float),
        "tracking_true": dict.fromkeys(("max_error", "rms_error", "final_error"), float),
        "speed_rms_error": float,
        "limit_cycle": LimitCycle,
        "limits": dict.fromkeys(LIMITS.values(), float),
        "energy": dict.fromkeys(("pump", "cylinder_work", "oil_drawn"), float),
    }


PLACES = {"model": "the model", "bench": "the virtual bench"}


def length_of(lengths: list[float], rate: float) -> str:
    """The duration of trials of these lengths [s], in words; without any, flow maps decide it."""
    ends = [f"{length:.4g}" for length in sorted({min(lengths), max(lengths)})] if lengths else []
    return (" to ".join(ends) + " s" if ends else "as long as the motion") + f" at {rate:g} Hz"


def prepared_case(
    name: str, recipe: TrialRecipe, state: RigState, inputs: Inputs
) -> tuple[Case, NamedFiles, Ready]:
    """(one trial, its inputs without the rig, the trial before its first tick)."""
    notes, files = inputs.notes, []
    named = [("bench", recipe.bench), *(("command", c.file) for c in recipe.command)]
    motions = () if recipe.motion is None else recipe.motion.each
    named += [("motion", motion.file) for motion in motions]
    for role, file in named:
        if file:
            files.append((role, inputs.existing(file)))
            notes.add("reads", file)
    gains = _gains(recipe, state.rig, inputs)
    for code in trial.code_files(recipe):
        files.append(("code", code))
        notes.add("reads", notes.name_of(code))
    if isinstance(gains, Path):
        files.append(("gains", gains))
    case = Case(name, recipe, state.rig, state.flow_maps, gains)
    timed = time_is_known(recipe, state)
    if not timed:
        notes.add("undecided", message("stages.stroke_unknown"))
    prepared = case.prepare(allow_code=inputs.allow_code, standing=not timed)
    notes.add("remarks", *prepared.notes)
    if truth_of(prepared.machine) is None and recipe.limits != type(recipe.limits)():
        notes.add("undecided", message("stages.bench_settles"))
    if recipe.controller is not None and (code := recipe.controller.code) is not None:
        notes.add("remarks", message("stages.is_code", name=code))
        notes.options.add("--allow-code")
        notes.add("undecided", message("stages.code_not_run", name=code))
    return case, tuple(files), prepared


def time_is_known(recipe: TrialRecipe, state: RigState) -> bool:
    """Whether the motion is known; not where its speeds depend on maps that a dry run lacks."""
    motion = recipe.motion
    if not state.without_maps or motion is None or motion.full_speed is not None:
        return True
    return not any("%" in level for level in motion.levels)


def _gains(recipe: TrialRecipe, rig: Rig, inputs: Inputs) -> Path | Mapping[str, Any] | None:
    """Where the tune run lies that a trial takes its gains from; in a dry run without that
    run, what its recipe says.

    Raises:
        InputError: it is no tune run or recipe.
    """
    name, law, motion = trial.gains_file(recipe), recipe.controller, recipe.motion
    if name is None or law is None:
        return None
    place = inputs.existing(name)
    if not (place.is_file() and place.suffix == ".toml"):
        inputs.notes.add("reads", f"{name} (gains)")
        return place
    tuning = load_recipe(place)
    if not isinstance(tuning, AnyTuning):
        text = message("stages.no_gains", name=name, stage=tuning.stage_name)
        raise InputError(text, **recipe.at(*law.where, "gains"))
    folder = inputs.run_folder(place)
    if folder is not None:
        inputs.notes.add("reads", f"{folder} (gains)")
        return folder
    inputs.notes.add("undecided", message("stages.gains_not_run", name=name))
    gains = {
        key: float(value) for key in _TUNED if (value := getattr(tuning, key, None)) is not None
    }
    moved = (motion.cylinder if motion is not None else None) or rig.cylinder[0].name
    refused = inputs.check is not None and inputs.check(place).errors
    cylinder = moved if refused else tuning.cylinder or moved
    if isinstance(tuning, ArcTuneRecipe):
        return {"cylinder": cylinder}
    return {"cylinder": cylinder, "feedback_gain": 0.0, **gains}
