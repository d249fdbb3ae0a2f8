"""Validated rig and tuned controller → C, functional mock-up units and files for other programs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w

from ehbench.config.recipe import (
    AnyTrial,
    AnyTuning,
    ArcTuneRecipe,
    ExportRecipe,
    Recipe,
    TrialRecipe,
    TrialSetRecipe,
    kind_of,
    load_recipe,
)
from ehbench.config.rig import Rig
from ehbench.export import FORMATS, Export
from ehbench.export.compiler import compiler
from ehbench.report.provenance import TracedRun
from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.stages.base import Host, Prepared, Stage, Work, write_rig
from ehbench.stages.inputs import Inputs, RigState, ValidatedRig
from ehbench.stages.relocation import relative
from ehbench.stages.trial import prepared_case
from ehbench.vocabulary import EhbenchError, InputError, Progress, message
from ehbench.vocabulary.errors import ModelRejected


@dataclass(frozen=True)
class PreparedExport(Prepared):
    """What is exported of a rig that is known."""

    recipe: ExportRecipe
    state: RigState
    export: Export


class ExportStage(Stage[ExportRecipe, PreparedExport]):
    """`ExportRecipe`."""

    name = "export"
    command = "export"
    writes = "export.json, rig.toml, and a folder or file of each format"

    def prepare(self, recipe: ExportRecipe, inputs: Inputs) -> PreparedExport:
        for target in recipe.targets:
            if compiler(target) is None:
                text = message("export.no_compiler", target=target)
                raise InputError(text, **recipe.at("targets"))
        state = inputs.rig_state(recipe.rig, recipe.flow_maps)
        for channel in (force.channel for item in state.rig.cylinder for force in item.force):
            if channel is not None:
                raise InputError(
                    message("export.played_force", channel=channel), **recipe.at("rig")
                )
        # or of a tuning on a validated rig
        validated = isinstance(state, ValidatedRig) or state.saved("run").get("validated", False)
        fields = {"rig": state.rig.name, "stage": state.stage}
        _refuse(inputs, not validated, "unvalidated", **fields)
        source, trial = _trial_of(recipe, inputs, state)
        law = trial.controller
        if recipe.parts != "model" and law is not None:
            name = law.gains_from
            place = None if name is None else inputs.run_folder(source.file(name))
            facts = None if place is None else place / "run.json"
            # of a dry run none has been tuned yet
            tuned = name is not None and (
                facts is None or facts.is_file() and rundir.read_json(facts).get("validated")
            )
            _refuse(inputs, not tuned, "untuned")
        at_trial = replace(inputs, recipe=source)
        _, files, prepared = prepared_case("", trial, state, at_trial)
        contents = recipe.parts or ("model" if law is None else "both")
        laws = {"c", "fmu2", "fmu3"} & {*recipe.formats}
        if state.rig.model is not None and laws and contents != "controller":
            text = message("export.is_fmu", fmu=state.rig.model.fmu)
            raise InputError(text, **recipe.at("parts" if recipe.parts else "rig"))
        does = message(
            "export.does",
            parts={"both": "model and controller"}.get(contents, contents),
            rig=state.rig.name,
            formats=", ".join(recipe.formats),
        )
        fitted = {row["name"]: row for row in state.saved("parameters").get("parameters", [])}
        export = Export(recipe, state.rig, state.flow_maps, state.origin, prepared, fitted)
        return PreparedExport(recipe, (*state.inputs, *files), does, state, export)

    def work(self, prepared: PreparedExport, folder: Path, progress: Progress | None) -> Work:
        state, formats = prepared.state, prepared.recipe.formats
        written = []
        for i, name in enumerate(formats):
            if progress is not None:
                progress(name, i / len(formats))
            written += FORMATS[name](prepared.export, folder)
        write_rig(folder, state.rig, state.flow_maps)
        rows, times = [], {}
        for item in written:
            check, _, time = item.check.partition("; ")  # two runs hold the same bytes
            rows.append(item._replace(check=check)._asdict())
            times |= {Path(item.file).stem: f"{Path(item.file).stem}: {time}"} if time else {}
        rundir.write_json(folder / "export.json", {"written": rows})
        warnings = [item.note for item in written if item.note]
        if prepared.recipe.parts != "model":
            warnings += prepared.export.trial.notes
        here = [message("export.times", times="; ".join(times.values()))] if times else []
        return Work({"rig": state.rig.name, "warnings": warnings}, here=here)


def _refuse(inputs: Inputs, wrong: bool, key: str, **fields: str) -> None:
    """Refuse what the user may insist on."""
    if wrong and not inputs.unvalidated:
        text = message(f"export.{key}", **fields)
        inputs.notes.refuse(ModelRejected(text, file=inputs.recipe.path), text)


def _trial_of(recipe: ExportRecipe, inputs: Inputs, state: RigState) -> tuple[Recipe, TrialRecipe]:
    """(the recipe whose paths it has, the trial on the model that is exported and checked by).

    Raises:
        InputError: no controller that can be exported; another rate than that of its tuning.
    """
    source: Recipe = recipe
    if recipe.controller is None:
        if recipe.parts not in (None, "model"):
            raise InputError(message("export.without_controller"), **recipe.at("parts"))
        command: Any = []  # each valve opens halfway and shuts at a frequency of its own
        for i, (cylinder, valve) in enumerate(state.rig.valves()):
            low, high = (0.5 * (valve.rest + end) for end in valve.given)
            item = {"valve": f"{cylinder.name}.{valve.name}", "kind": "sine"}
            item |= {"offset": f"{0.5 * (low + high)!r} V", "frequency": f"{0.5 + 0.1 * i!r} Hz"}
            command.append(item | {"amplitude": f"{0.5 * (high - low)!r} V"})
        known: dict[str, Any] = {"path": recipe.path, "rig": recipe.rig, "duration": "2 s"}
        trial = TrialRecipe(stage="trial", command=command, **known)
    else:
        item, run = _named(recipe, inputs)
        if isinstance(item, TrialRecipe):
            source = trial = item
        else:
            trial = _tuned(recipe, item, run, state.rig)
        law, where = trial.controller, recipe.at("controller")
        if law is None:
            raise InputError(message("export.open_loop"), **where)
        if law.code is not None:
            raise InputError(message("export.is_code", name=law.code), **where)
    changes = {"on": "model", "bench": None, "machine": None, "fault": (), "payload_change": ()}
    changes |= {"rig": recipe.rig, "flow_maps": recipe.flow_maps}
    shared = recipe.model_fields_set & {"payload", "rate", "posture"}
    changes |= {key: getattr(recipe, key) for key in shared}
    if trial.step == "auto":
        changes["step"] = TrialRecipe.model_fields["step"].default
    trial = trial.model_copy(update=changes)
    gains = trial.controller.gains_from if trial.controller is not None else None
    if gains is not None:
        place = source.file(gains)
        if place.is_dir():
            place = TracedRun(place).recipe.place or place
        tuning = load_recipe(place) if place.is_file() and place.suffix == ".toml" else None
        if isinstance(tuning, AnyTuning) and float(tuning.rate) != float(trial.rate):
            rates = {"tuned": float(tuning.rate), "rate": float(trial.rate)}
            raise InputError(message("export.other_rate", **rates), **recipe.at("rate"))
    return source, trial


def _named(recipe: ExportRecipe, inputs: Inputs) -> tuple[Recipe, Path]:
    """(the recipe of a trial or tuning, the file or run folder) that ``controller`` names."""
    place = source = inputs.existing(recipe.controller or "")
    if place.is_dir():
        source = TracedRun(place).recipe.place or place
    item = load_recipe(source) if source.suffix == ".toml" else None
    if isinstance(item, TrialSetRecipe):
        raise InputError(message("export.several_trials"), **recipe.at("controller"))
    if not isinstance(item, TrialRecipe | AnyTuning):
        text = message("export.no_controller", name=recipe.controller)
        raise InputError(text, **recipe.at("controller"))
    return item, place


def _tuned(recipe: ExportRecipe, item: Recipe, place: Path, rig: Rig) -> TrialRecipe:
    """A trial of a tuned controller: out and back over a fifth of the stroke."""
    assert isinstance(item, AnyTuning)
    known = {cylinder.name: float(cylinder.stroke) for cylinder in rig.cylinder}
    name = item.cylinder or next(iter(known))
    motion = {
        "kind": "point_to_point",
        "cylinder": name,
        "waypoints": [f"{share * known[name]!r} m" for share in (0.4, 0.6, 0.4)],
        "speed": f"{0.2 * known[name]!r} m/s",
    }
    kind = "arc" if isinstance(item, ArcTuneRecipe) else "pressure_feedback"
    trial: dict[str, Any] = {"stage": "trial", "rig": recipe.rig, "rate": item.rate}
    trial |= {"posture": item.posture}
    trial |= {"motion": motion, "controller": {"kind": kind, "gains": str(place)}}
    return TrialRecipe(path=recipe.path, **trial)


HEADER = "# written by ehbench export\n"


def recipe_for(source: Path, options: Mapping[str, Any], host: Host) -> Recipe:
    """The recipe that exports a source: that recipe itself, or a new file beside the run's folder.

    Raises:
        InputError: no such file, nothing to export, or a file of the user's in its place.
    """
    given = {key: value for key, value in options.items() if value}
    if not source.exists():
        raise InputError(message("report.no_file"), file=source)
    recipe = None
    if source.is_file() and kind_of(source) == "recipe":
        recipe = load_recipe(source)
    elif source.is_dir():
        place = TracedRun(source).recipe.place
        recipe = None if place is None else load_recipe(place)
    if isinstance(recipe, ExportRecipe):
        if given:
            raise InputError(message("export.has_options", names=", ".join(given)), file=source)
        return recipe
    path = host.out or host.root / f"{source.resolve().stem}_export"
    path = path.with_name(f"{path.name}.toml")
    rig, folder = source, path.resolve().parent
    if isinstance(recipe, AnyTrial):
        rig = recipe.file(recipe.rig)
        if recipe.flow_maps is not None:
            given["flow_maps"] = relative(recipe.file(recipe.flow_maps).resolve(), folder)
    if isinstance(recipe, AnyTuning) and source.is_file():
        rig = recipe.file(recipe.rig)
    if isinstance(recipe, AnyTrial | AnyTuning):
        given["controller"] = relative(source.resolve(), folder)
        if isinstance(recipe, AnyTuning):
            given.setdefault("parts", "controller")
    table = {"stage": "export", "rig": relative(rig.resolve(), folder), **given}
    if path.exists() and not path.read_text(errors="replace").startswith(HEADER):
        raise InputError(message("stages.exists"), file=path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, f"{HEADER}#   ehbench export {path.name}\n\n{tomli_w.dumps(table)}")
    try:
        return load_recipe(path)
    except EhbenchError as error:
        withdraw(path, None, error)  # an option is wrong
        raise


def withdraw(path: Path, source: Path | None, error: EhbenchError) -> None:
    """Delete the recipe of an export that failed; its error names the source instead, if any."""
    path.unlink(missing_ok=True)
    if error.file == str(path):
        error.file, error.line = str(source) if source else None, None
