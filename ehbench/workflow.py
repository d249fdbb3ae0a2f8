"""The main path, in the order of the data. Read this first.

    recipe → rig → record (log) → identified rig → validated rig → tuned controller → record (trial)
    → report

Each arrow is one function here. It takes a recipe file, names its inputs by hash, does its one job
with floor-5 methods, writes one run folder, and returns an `Outcome`. A recipe may name a rig, a
flow map or a log by the file, by the run folder or by the recipe that makes it; in the last case
that recipe is run first, unless its run is there."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ehbench import rundir
from ehbench.blas import one_thread
from ehbench.errors import InputError, ModelRejected
from ehbench.notebook import label, plural, shown, table
from ehbench.recipe import (
    Campaign,
    DataFile,
    FlowMapRecipe,
    HydraulicsRecipe,
    Recipe,
    TrialRecipe,
    TrialSetRecipe,
    TuneRecipe,
    ValidateRecipe,
    kind_of,
    load_recipe,
    load_rig,
)

if TYPE_CHECKING:
    import pandas as pd

    from ehbench.physics.flow_map import FlowMaps
    from ehbench.record import Record
    from ehbench.rig import Rig

DONE, INCOMPLETE, REJECTED, STOPPED = 0, 3, 4, 5
ROOT = Path("reports")
Progress = Callable[[str, float], None]  # (what, share done from 0 to 1)


@dataclass(frozen=True)
class Outcome:
    """What a workflow function leaves: the run folder, the exit code, and what to tell the user."""

    folder: Path
    code: int = DONE
    notes: tuple[str, ...] = ()

    @property
    def rig(self) -> Rig:
        """The rig that the run leaves behind."""
        return load_rig(self.folder)

    @property
    def flow_maps(self) -> FlowMaps | None:
        """The flow maps that the run leaves behind, if any."""
        return _maps_in(self.folder)

    @property
    def parameters(self) -> pd.DataFrame:
        """Identified parameters by name [SI]: value, standard error ``std``, 95 % interval ``low``
        and ``high``, unit, status.
        """
        import pandas as pd

        rows = {
            one["name"]: {
                "value": one["value"],
                "std": one["std"],
                "low": one["interval"] and one["interval"][0],
                "high": one["interval"] and one["interval"][1],
                "unit": one["unit"],
                "status": one["status"],
            }
            for one in self.json("parameters")["parameters"]
        }
        return pd.DataFrame.from_dict(rows, orient="index")

    def json(self, name: str) -> Any:
        """A JSON result of the run, by its name without ending, such as ``parameters`` or
        ``validation``.

        Raises:
            InputError: the run left none of that name; says which it left.
        """
        path = self.folder / f"{name}.json"
        if not path.is_file():
            there = ", ".join(sorted(file.stem for file in self.folder.glob("*.json")))
            raise InputError(f"has no {path.name}", file=self.folder, hint=f"it has {there}")
        return rundir.read_json(path)

    def __repr__(self) -> str:
        notes = plural(len(self.notes), "note")
        return f"<Outcome '{self.folder}': code {self.code}, {notes}>"

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        head = f"<p><code>{escape(str(self.folder))}</code>, code {self.code}</p><ul>{notes}</ul>"
        if not (self.folder / "parameters.json").is_file():
            return head
        rig, rows = self.rig, []
        for one in self.json("parameters")["parameters"]:
            name = one["name"]
            unit = rig.unit_of(name)
            value, error = (shown(one[key], name, unit) for key in ("value", "std"))
            interval = " … ".join(shown(end, name, unit) for end in one["interval"] or ())
            rows.append((name, value, error, interval, label(unit), one["status"]))
        header = ("parameter", "value", "standard error", "95 % interval", "unit", "status")
        return head + table(header, rows)


@dataclass(frozen=True)
class Machine:
    """A rig as a stage receives it: its numbers, its measured maps, how far it has come, and the
    inputs behind it.
    """

    rig: Rig
    flow_maps: FlowMaps | None
    stage: str
    inputs: tuple[tuple[str, Path], ...]
    origin: Path


@dataclass(frozen=True)
class ValidatedMachine(Machine):
    """A machine that a validation accepted; only `machine_of` makes one, from a validate run."""


@dataclass(frozen=True)
class Desk:
    """Where a session works: the folder that runs go to, how progress is told, which runs stand,
    and what was allowed aloud.

    ``allow_code`` lets recipes run Python code, ``unvalidated`` lets a controller be tuned on a rig
    that no validation accepted. ``keep`` leaves a run alone that stands with the very same inputs;
    dependencies and campaigns work so. ``under_way`` are the recipes that wait for the one at work.
    """

    root: Path = ROOT
    out: Path | None = None
    progress: Progress | None = None
    done: dict[Path, Outcome] = field(default_factory=dict)
    allow_code: bool = False
    unvalidated: bool = False
    keep: bool = False
    under_way: tuple[Path, ...] = ()

    def tell(self, what: str) -> Progress | None:
        """A progress callback labelled with the recipe at work."""
        if self.progress is None:
            return None
        return lambda text, share: self.progress(f"{what}: {text}" if text else what, share)

    def place(self, recipe: Recipe, inputs: Sequence[tuple[str, Path]]) -> Path:
        """The folder of a recipe's run."""
        return self.out if self.out is not None else rundir.place(recipe.path, inputs, self.root)


@one_thread()
def run(path: Path | str, desk: Desk | None = None) -> Outcome:
    """Run a recipe of any stage.

    Raises:
        EhbenchError: bad input, data that do not support the claim, and so on; nothing is left
            behind then.
    """
    recipe = load_recipe(path)
    desk = desk or Desk()
    place = recipe.path.resolve()
    if place in desk.under_way:
        circle = " → ".join(
            one.name for one in (*desk.under_way[desk.under_way.index(place) :], place)
        )
        raise InputError(
            f"needs itself: {circle}",
            file=path,
            hint="name a rig file or a run folder where the circle shall end",
        )
    desk = replace(desk, under_way=(*desk.under_way, place))
    for kind, stage in (
        (FlowMapRecipe, identify_flow_map),
        (HydraulicsRecipe, identify_hydraulics),
        (ValidateRecipe, validate),
        (TuneRecipe, tune),
        (TrialRecipe, run_trial),
        (TrialSetRecipe, run_trials),
        (Campaign, run_campaign),
    ):
        if isinstance(recipe, kind):
            return stage(recipe, desk)
    raise InputError(f"no stage for {type(recipe).__name__}", file=path)


def expect_stage(path: Path, *stages: str) -> None:
    """Refuse a recipe of another stage than the command's.

    Raises:
        InputError: with the command that takes it.
    """
    found = load_recipe(path).stage
    if found not in stages:
        command = {"trial": "run-trial", "trials": "run-trial", "campaign": "reproduce"}.get(
            found, found
        )
        raise InputError(
            f"is a recipe of stage '{found}'",
            file=path,
            hint=f"run it with: ehbench {command} {path}",
        )


def identify_flow_map(recipe: FlowMapRecipe, desk: Desk) -> Outcome:
    """Flowmeter readings → flow maps: ``flow_maps.json``, ``summary.json``, ``points.csv`` and a
    table for each map.
    """
    from ehbench.identification import readings
    from ehbench.physics.flow_map import collect, save_flow_maps, table
    from ehbench.readers import read_flowmeter

    machine = machine_of(recipe, recipe.rig, None, desk)
    files = [existing(recipe, name) for name in recipe.data]
    inputs = [*machine.inputs, *(("data", path) for path in files)]
    supply = float(machine.rig.supply.pressure)

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        fits = readings.fit_readings(
            machine.rig,
            [read_flowmeter(path, supply_pressure=supply) for path in files],
            [
                (float(point.command), float(point.flow), point.tolerance)
                for point in recipe.calibration
            ],
            None if recipe.calibration_drop is None else float(recipe.calibration_drop),
            desk.tell(recipe.name),
            meter_limit=float(recipe.meter_limit),
        )
        maps = collect([one.fit.map for one in fits])
        save_flow_maps(maps, made.path / "flow_maps.json")
        rundir.write_json(made.path / "summary.json", readings.summary(fits, machine.rig))
        (made.path / "points.csv").write_text(
            readings.points_table(fits, machine.rig), encoding="utf-8"
        )
        units = {
            "flow_unit": machine.rig.unit_of("flow"),
            "pressure_unit": machine.rig.unit_of("pressure_drop"),
        }
        (made.path / "flow_maps.csv").write_text(
            table(maps, **units, signs=readings.signs(fits)), encoding="utf-8"
        )
        _write_rig(made.path, machine.rig, None)
        warnings = [
            f"{one.fit.map.valve} {one.fit.map.direction}: {text}"
            for one in fits
            for text in one.fit.warnings
        ]
        made.facts |= {
            "what": "flow_map",
            "title": recipe.title,
            "rig": machine.rig.name,
            "warnings": warnings,
        }
        return DONE, warnings

    return _run(recipe, desk, inputs, work)


def identify_hydraulics(recipe: HydraulicsRecipe, desk: Desk) -> Outcome:
    """Step logs → identified rig: ``rig.toml`` with its maps, ``parameters.json``, a series for
    each log.
    """
    from ehbench.identification import hydraulics

    machine = machine_of(recipe, recipe.rig, recipe.flow_maps, desk)
    logs, inputs, losses = logs_of(recipe, recipe.data, desk)
    inputs = [*machine.inputs, *inputs]
    options = hydraulics.FitOptions(
        method=recipe.method,
        start=recipe.start,
        lower=recipe.lower,
        upper=recipe.upper,
        channels=recipe.channels,
        cutoff=None if recipe.cutoff is None else float(recipe.cutoff),
        max_iterations=recipe.max_iterations,
        workers=recipe.workers,
    )
    given = (options, machine.flow_maps, desk.tell(recipe.name), recipe.at)

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        fit = hydraulics.identify_hydraulics(machine.rig, logs, recipe.parameters, *given)
        variants = ()
        if recipe.compare_dynamics:
            variants = hydraulics.compare_dynamics(
                machine.rig, logs, recipe.parameters, recipe.compare_dynamics, *given
            )
        compared = [variant.as_json() for variant in variants]
        _write_rig(made.path, fit.rig, machine.flow_maps)
        rundir.write_json(
            made.path / "parameters.json", fit.as_json() | {"dynamics_comparison": compared}
        )
        _write_series(made.path / "series", fit.series())
        warnings = [*losses, *fit.warnings]
        made.facts |= {
            "what": "hydraulics",
            "title": recipe.title,
            "rig": fit.rig.name,
            "method": recipe.method,
            "warnings": warnings,
            "recorded_on": _recorded_on(logs),
            "fitted_on": [rundir.sha256(path) for role, path in inputs if role == "log"],
        }
        return (INCOMPLETE if losses else DONE), warnings

    return _run(recipe, desk, inputs, work)


def validate(recipe: ValidateRecipe, desk: Desk) -> Outcome:
    """Held-out logs → validated rig: ``validation.json`` with the verdict, a series for each log,
    the rig judged.
    """
    from ehbench import validation

    machine = machine_of(recipe, recipe.rig, recipe.flow_maps, desk)
    logs, inputs, losses = logs_of(recipe, recipe.data, desk)
    used = _fitted_on(machine.inputs)
    seen = [
        name
        for (name, _), (_, path) in zip(logs, inputs, strict=True)
        if rundir.sha256(path) in used
    ]
    inputs = [*machine.inputs, *inputs]

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        verdict = validation.validate_rig(
            machine.rig,
            logs,
            channels=recipe.channels,
            thresholds=recipe.thresholds,
            flow_maps=machine.flow_maps,
            fitted_on=seen,
            progress=desk.tell(recipe.name),
            where=recipe.at,
        )
        _write_rig(made.path, machine.rig, machine.flow_maps)
        rundir.write_json(made.path / "validation.json", verdict.as_json())
        if (
            machine.origin / "parameters.json"
        ).is_file():  # the intervals travel with the rig they belong to
            shutil.copyfile(machine.origin / "parameters.json", made.path / "parameters.json")
        _write_series(made.path / "series", verdict.series())
        warnings = [*losses, *verdict.warnings]
        made.facts |= {
            "what": "validation",
            "title": recipe.title,
            "rig": machine.rig.name,
            "accepted": verdict.accepted,
            "warnings": warnings,
            "recorded_on": _recorded_on(logs),
        }
        if not verdict.accepted:
            return REJECTED, [*warnings, *verdict.reasons]
        return (INCOMPLETE if losses else DONE), warnings

    return _run(recipe, desk, inputs, work)


def tune(recipe: TuneRecipe, desk: Desk) -> Outcome:
    """Validated rig → controller gains: ``tuning.json`` with what was promised at every operating
    point.
    """
    from ehbench.tune.gains import tune_pressure_feedback

    machine = machine_of(recipe, recipe.rig, recipe.flow_maps, desk)
    if not desk.unvalidated and not isinstance(machine, ValidatedMachine):
        raise ModelRejected(
            f"rig '{machine.rig.name}' is not validated ({machine.stage}), so no controller is tuned on it",
            file=recipe.path,
            hint="name the recipe or run of its validation as rig, or add --unvalidated",
        )
    found = machine.origin / "parameters.json"
    known = rundir.read_json(found) if machine.origin.is_dir() and found.is_file() else None
    correlation = (
        (known["correlated_names"], known["correlation"])
        if known and known["correlation"]
        else None
    )

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        tuning = tune_pressure_feedback(
            machine, recipe, correlation=correlation, progress=desk.tell(recipe.name)
        )
        _write_rig(made.path, machine.rig, machine.flow_maps)
        rundir.write_json(made.path / "tuning.json", tuning.as_json())
        warnings = list(tuning.warnings)
        if not isinstance(machine, ValidatedMachine):
            warnings.insert(0, "tuned on a rig that no validation accepted (--unvalidated)")
        made.facts |= {
            "what": "tuning",
            "title": recipe.title,
            "rig": machine.rig.name,
            "validated": machine.stage == "validated",
            "warnings": warnings,
        }
        return DONE, warnings

    return _run(recipe, desk, machine.inputs, work, {"draws": recipe.seed})


def run_trial(recipe: TrialRecipe, desk: Desk) -> Outcome:
    """One trial on the model or on the virtual bench → ``log.mcap`` and ``trial.json``; a limit
    stops it with exit 5.
    """
    from ehbench import trial

    trial.refuse_code(recipe, desk.allow_code)
    machine = machine_of(recipe, recipe.rig, recipe.flow_maps, desk)
    extra, gains = _behind(recipe, desk)
    inputs = [*machine.inputs, *extra]

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        prepared = trial.prepare(recipe, machine.rig, machine.flow_maps, gains, desk.allow_code)
        result = trial.run(prepared, log=made.path / "log.mcap", progress=desk.tell(recipe.name))
        _write_rig(made.path, machine.rig, machine.flow_maps)
        facts, ledger, doubts = trial.account(prepared, result)
        if ledger is not None:
            rundir.write_json(made.path / "ledger.json", ledger)
        rundir.write_json(made.path / "trial.json", facts.as_json())
        made.facts |= {
            "what": "trial",
            "title": recipe.title,
            "rig": machine.rig.name,
            "on": recipe.on,
            "stopped": facts.stopped,
            "warnings": [*facts.warnings, *doubts],
        }
        if facts.stopped:
            return STOPPED, [*facts.warnings, *doubts, facts.stopped]
        return DONE, [*facts.warnings, *doubts]

    return _run(recipe, desk, inputs, work, {"trial": recipe.seed})


def run_trials(recipe: TrialSetRecipe, desk: Desk) -> Outcome:
    """Payloads × motions × controllers → ``logs/<case>.mcap`` and one table over all,
    ``table.json`` and ``table.csv``.
    """
    from ehbench import trial

    planned = recipe.cases()
    for _, _, one in planned:
        trial.refuse_code(one, desk.allow_code)
    base = machine_of(recipe, recipe.rig, recipe.flow_maps, desk)
    machines = {(recipe.rig, recipe.flow_maps): base}
    cases, inputs = [], list(base.inputs)
    for name, _, one in planned:
        key = (one.rig, one.flow_maps)
        if key not in machines:
            other = machine_of(one, *key, desk)
            machines[key] = replace(other, rig=with_identified(other.rig, base.rig))
        extra, gains = _behind(one, desk)
        inputs += [item for item in (*machines[key].inputs, *extra) if item not in inputs]
        cases.append(trial.Case(name, one, machines[key].rig, machines[key].flow_maps, gains))

    def work(made: rundir.Run) -> tuple[int, list[str]]:
        (made.path / "logs").mkdir()
        (made.path / "ledgers").mkdir()
        results = trial.run_cases(
            cases,
            logs=made.path / "logs",
            allow_code=desk.allow_code,
            progress=desk.tell(recipe.name),
        )
        _write_rig(made.path, base.rig, base.flow_maps)
        named = [(case.name, result.account) for case, result in zip(cases, results, strict=True)]
        for file, (_, account) in zip(trial.file_names(cases), named, strict=True):
            if account.ledger is not None:
                rundir.write_json(made.path / "ledgers" / f"{file}.json", account.ledger)
        rows = trial.table_rows(cases, results)
        rundir.write_json(made.path / "table.json", {"rows": rows})
        (made.path / "table.csv").write_text(trial.table_csv(rows, base.rig), encoding="utf-8")
        stopped = [f"{name}: {one.facts.stopped}" for name, one in named if one.facts.stopped]
        warnings = [f"{name}: {text}" for name, one in named for text in one.facts.warnings]
        warnings += [f"{name}: {text}" for name, one in named for text in one.doubts]
        made.facts |= {
            "what": "trials",
            "title": recipe.title,
            "rig": base.rig.name,
            "on": recipe.on,
            "stopped": "; ".join(stopped),
            "warnings": warnings,
        }
        return (STOPPED if stopped else DONE), [*warnings, *stopped]

    return _run(recipe, desk, inputs, work, {"trial": recipe.seed})


def with_identified(rig: Rig, source: Rig) -> Rig:
    """A variant of a machine with the numbers that were identified on ``source``, by name."""
    known = rig.parameters()
    return rig.with_values(
        {
            name: value
            for name, value in source.parameters().items()
            if value.sure == "identified" and name in known
        }
    )


def _behind(recipe: TrialRecipe, desk: Desk) -> tuple[list[tuple[str, Path]], Path | None]:
    """(inputs of a trial beside its rig, where its gains lie): bench, files it plays, tune run, the
    user's code.
    """
    from ehbench import trial

    inputs = [("bench", existing(recipe, recipe.bench))] if recipe.bench else []
    inputs += [("command", existing(recipe, c.file)) for c in recipe.command if c.file]
    if recipe.motion is not None and recipe.motion.file:
        inputs.append(("motion", existing(recipe, recipe.motion.file)))
    if (code := trial.code_file(recipe)) is not None:
        inputs.append(("code", code))
    name = trial.gains_file(recipe)
    if name is None:
        return inputs, None
    gains = existing(recipe, name)
    if gains.is_file() and gains.suffix == ".toml":
        gains = make(gains, desk).folder
    return [*inputs, ("gains", gains)], gains


def report(folders: Sequence[Path], desk: Desk, campaign: Campaign | None = None) -> Outcome:
    """Run folders → one self-contained ``report.html``; reads saved files only."""
    from ehbench.report import build

    for folder in folders:
        if not rundir.is_whole(folder):
            raise InputError(
                "is no whole run folder",
                file=folder,
                hint="name folders that hold a run.json and all outputs it lists",
            )
    inputs = [("run", folder) for folder in folders]
    source = campaign.path if campaign else folders[0] / "run.json"
    final = (
        desk.out
        or desk.root
        / f"{campaign.name if campaign else 'report'}_{rundir.run_hash(source, inputs)}"
    )
    _tell(desk, campaign, "writing the report", 0.5)
    with rundir.open_run(final, "report", source, inputs) as made:
        (made.path / "report.html").write_text(build(folders, campaign), encoding="utf-8")
    return Outcome(made.final, DONE)


def run_campaign(recipe: Campaign, desk: Desk) -> Outcome:
    """Several recipes in order, then one report over their runs. A rejected or stopped run is
    shown, not dropped.
    """
    inner = replace(desk, out=None, keep=True)
    outcomes = []
    for index, name in enumerate(recipe.recipes):
        _tell(desk, recipe, name, index / len(recipe.recipes))
        outcomes.append(make(recipe.file(name), inner))
    page = report([outcome.folder for outcome in outcomes], desk, recipe)
    worst = max((outcome.code for outcome in outcomes), default=DONE)
    notes = tuple(
        f"{outcome.folder.name}: {note}" for outcome in outcomes for note in outcome.notes
    )
    return Outcome(page.folder, worst, notes)


def make(path: Path, desk: Desk) -> Outcome:
    """The outcome of a recipe, run only if it has not been run with these very inputs; dependencies
    go to ``desk.root``.
    """
    path = path.resolve()
    if path not in desk.done:
        desk.done[path] = run(path, replace(desk, out=None, keep=True))
    return desk.done[path]


def machine_of(recipe: Recipe, rig: str, flow_maps: str | None, desk: Desk) -> Machine:
    """The rig that a recipe names, with its maps: from a rig file, a run folder, or a recipe that
    makes one.
    """
    path = existing(recipe, rig)
    inputs: list[tuple[str, Path]] = []
    stage = "file"
    if path.is_file() and kind_of(path) == "recipe":
        path = make(path, desk).folder
    if path.is_dir():
        facts = rundir.read_json(path / "run.json")
        stage = {"identify": "identified", "validate": "validated"}.get(
            facts["stage"], facts["stage"]
        )
        if stage == "validated" and not facts["accepted"]:
            stage = "rejected"
    inputs.append(("rig", path))
    maps = _maps_in(path) if path.is_dir() else None
    if flow_maps is not None:
        source = existing(recipe, flow_maps)
        if source.is_file() and source.suffix == ".toml":
            source = make(source, desk).folder
        inputs.append(("flow_maps", source))
        maps = _maps_in(source)
        if maps is None:
            raise InputError(
                "holds no flow maps", file=source, hint="name a run of what = 'flow_map'"
            )
    kind = ValidatedMachine if stage == "validated" else Machine
    return kind(load_rig(path), maps, stage, tuple(inputs), path)


def logs_of(
    recipe: Recipe, data: Sequence[DataFile], desk: Desk
) -> tuple[list[tuple[str, Record]], list[tuple[str, Path]], list[str]]:
    """(name and record of each log, inputs, losses). Data may be a log, or the recipe or run folder
    of a trial.
    """
    from ehbench.preprocessing import distinct_names
    from ehbench.logs import read_record

    places = []
    for item in data:
        path = existing(recipe, item.path)
        places.append(
            make(path, desk).folder if path.is_file() and path.suffix == ".toml" else path
        )
    logs, inputs, losses = [], [], []
    for item, place, name in zip(data, places, distinct_names(places), strict=True):
        path = place / "log.mcap" if place.is_dir() else place
        record = read_record(path)
        losses += [f"{path.name}: {loss}" for loss in record.losses]
        logs.append((name, _window(record, item, path)))
        inputs.append(("log", path))
    return logs, inputs, losses


def _window(record: Record, item: DataFile, path: Path) -> Record:
    """The part of a record between the data entry's start and stop, with the payload it names."""
    import numpy as np

    low = -np.inf if item.start is None else float(item.start)
    high = np.inf if item.stop is None else float(item.stop)
    keep = (record.t >= low) & (record.t <= high)
    if keep.sum() < 3 <= record.t.size:
        raise InputError(
            f"has no samples between {low:g} and {high:g} s",
            file=path,
            hint=f"it runs from {record.t[0]:g} to {record.t[-1]:g} s",
        )
    meta = dict(record.meta) | ({"payload": item.payload} if item.payload else {})
    channels = {name: values[keep] for name, values in record.channels.items()}
    return type(record)(record.t[keep], channels, meta, record.attachments, record.losses)


def existing(recipe: Recipe, name: str) -> Path:
    """The file or folder that a recipe names.

    Raises:
        InputError: it is not there; names the nearest.
    """
    path = recipe.file(name)
    if not path.exists():
        from difflib import get_close_matches

        near = (
            get_close_matches(path.name, [p.name for p in path.parent.iterdir()], 1)
            if path.parent.is_dir()
            else []
        )
        raise InputError(
            f"names '{name}', which is not there",
            file=recipe.path,
            hint=f"did you mean '{near[0]}'?" if near else f"looked for {path}",
        )
    return path


def _maps_in(folder: Path) -> FlowMaps | None:
    from ehbench.physics.flow_map import load_flow_maps

    return load_flow_maps(folder) if (folder / "flow_maps.json").is_file() else None


def _recorded_on(logs: Sequence[tuple[str, Record]]) -> list[str]:
    """What the logs say they were recorded on, such as the virtual bench."""
    return sorted({record.meta["on"] for _, record in logs if "on" in record.meta})


def _fitted_on(inputs: Sequence[tuple[str, Path]]) -> set[str]:
    """SHA-256 of the logs that the runs behind these inputs were fitted on."""
    runs = [path for _, path in inputs if path.is_dir()]
    return {
        digest
        for folder in runs
        for digest in rundir.read_json(folder / "run.json").get("fitted_on", [])
    }


def _write_rig(folder: Path, rig: Rig, maps: FlowMaps | None) -> None:
    import tomli_w

    from ehbench.physics.flow_map import save_flow_maps

    (folder / "rig.toml").write_text(tomli_w.dumps(rig.as_toml()), encoding="utf-8")
    if maps is not None:
        save_flow_maps(maps, folder / "flow_maps.json")


def _write_series(folder: Path, series: dict[str, Record]) -> None:
    """One CSV log for each recording: ``<name>.csv`` with recorded and simulated channels."""
    folder.mkdir()
    for name, columns in series.items():
        header = ",".join(columns)
        import numpy as np

        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack(list(columns.values())),
            "%.9g",
            ",",
            header=header,
            comments="",
        )


def _run(
    recipe: Recipe,
    desk: Desk,
    inputs: Sequence[tuple[str, Path]],
    work: Callable[[rundir.Run], tuple[int, list[str]]],
    seeds: dict[str, int] | None = None,
) -> Outcome:
    """Open the run's folder, do the work in it, draw its figures. A run that stands with these very
    inputs is kept if it may.
    """
    from ehbench.report import draw

    final = desk.place(recipe, inputs)
    if desk.keep and rundir.is_whole(final):
        facts = rundir.read_json(final / "run.json")
        return Outcome(final, facts["code"], tuple(facts["notes"]))
    with rundir.open_run(final, recipe.stage, recipe.path, inputs, seeds) as made:
        code, notes = work(made)
        made.facts |= {"code": code, "notes": notes}
        _tell(desk, recipe, "drawing figures", 0.95)
        made.save()
        draw(made.path)
    return Outcome(final, code, tuple(notes))


def _tell(desk: Desk, recipe: Recipe | None, what: str, share: float) -> None:
    if desk.progress is not None:
        desk.progress(f"{recipe.name}: {what}" if recipe else what, share)


def find_campaign(name: str) -> Path:
    """The campaign file of a name such as ``thesis``: ``recipes/<name>/campaign.toml`` here or
    beside the package, or a file.

    Raises:
        InputError: there is none.
    """
    for candidate in (
        Path(name),
        Path("recipes") / name / "campaign.toml",
        rundir.PACKAGE.parent / "recipes" / name / "campaign.toml",
    ):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"no campaign '{name}'",
        hint="give a campaign's TOML file, or a name for recipes/<name>/campaign.toml",
    )


def init(folder: Path) -> Outcome:
    """A new workspace: a commented rig file and recipes that run as they are.

    Raises:
        InputError: the folder exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "exists and is not empty; nothing was written", file=folder, hint="name a new folder"
        )
    try:
        shutil.copytree(rundir.PACKAGE / "workspace", folder, dirs_exist_ok=True)
    except (OSError, shutil.Error) as error:
        raise InputError(
            f"cannot be made: {getattr(error, 'strerror', None) or error}", file=folder
        ) from None
    return Outcome(folder)
