"""A sample of a study: its recipe, rig and bench file, run and measured."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self, cast
from weakref import finalize

import tomli_w

from ehbench import trial
from ehbench.config.recipe import (
    AnyTrial,
    BenchRecipe,
    Measure,
    Recipe,
    StudyRecipe,
    TrialRecipe,
    kind_of,
    load_recipe,
    read_toml,
    validated,
)
from ehbench.runs import rundir
from ehbench.runtime.disk import impossible, write_text
from ehbench.sampling.cluster import Bundle, file_name
from ehbench.sampling.design import CASE, RECIPE
from ehbench.sampling.keys import BENCH, Changes, changed_rig, changed_table, changes_of
from ehbench.sampling.measures import lookup, of_channels, value_of
from ehbench.sampling.sample import LATE, STATUS, Make, Sample
from ehbench.stages.base import stage_of
from ehbench.stages.inputs import Inputs, RigState
from ehbench.stages.notes import Notes
from ehbench.stages.relocation import relative
from ehbench.stages.trial import PreparedOne
from ehbench.vocabulary import EhbenchError, InputError, Progress, message, quantity
from ehbench.vocabulary.units import parse


@dataclass(frozen=True)
class Plan:
    """All that makes samples: study, recipe files, upstream runs, what is allowed."""

    study: StudyRecipe
    recipes: tuple[Path, ...]
    runs: Mapping[Path, Path]
    allow_code: bool = False
    unvalidated: bool = False

    @property
    def limit(self) -> float | None:
        """Time [s] that a sample may take."""
        limit = self.study.time_limit
        return None if limit is None else float(limit)

    def opened(self) -> Make:
        """What makes the samples in this process, with a scratch folder that goes with it."""
        scratch = TemporaryDirectory(prefix="ehbench_samples_")
        sampler = Sampler(self, Path(scratch.name))
        finalize(sampler, scratch.cleanup)
        return sampler

    def opened_below(self, root: Path) -> Make:
        """As `opened`, with all files below another root."""

        def moved(path: Path) -> Path:
            return root / file_name(path)

        study = self.study.model_copy(update={"path": moved(self.study.path)})
        recipes = tuple(moved(path) for path in self.recipes)
        runs = {moved(path): moved(folder) for path, folder in self.runs.items()}
        return replace(self, study=study, recipes=recipes, runs=runs).opened()

    def bundle(self) -> Bundle:
        """All files that samples may read: recipes, rigs, benches, upstream runs."""
        files: dict[str, bytes] = {}
        waiting = [*self.recipes, *self.runs.values()]
        for path in self.recipes:
            recipe = load_recipe(path)
            if isinstance(recipe, TrialRecipe) and self.allow_code:
                waiting += trial.code_files(recipe)
        seen: set[Path] = set()
        while waiting:
            path = waiting.pop().resolve()
            if path in seen:
                continue
            seen.add(path)
            if path.is_dir():
                if (path / "run.json").is_file():
                    waiting += [p for p in path.iterdir() if p.name not in ("figures", "logs")]
                continue
            files[file_name(path)] = path.read_bytes()
            if path.suffix == ".toml":
                texts = (
                    text
                    for text in _texts(read_toml(path)[0])
                    if 0 < len(text) < 400 and "$" not in text and not impossible(Path(text))
                )
                waiting += [item for text in texts if (item := path.parent / text).exists()]
        return Bundle(dict(sorted(files.items())), self.opened_below)


class Late(EhbenchError):
    """A sample took longer than its time limit (exit 5)."""

    exit_code = 5


@dataclass(frozen=True)
class RecipeFile:
    """A recipe's table, text and upstream recipes; without ``step`` it is adaptive."""

    path: Path
    table: Mapping[str, Any]
    text: str
    model: Recipe
    upstream: Mapping[str, Path]

    @classmethod
    def of(cls, path: Path) -> Self:
        """The recipe of a file."""
        (table, text), model = read_toml(path), load_recipe(path)
        if isinstance(model, AnyTrial) and "step" not in table:
            table, model = table | {"step": "auto"}, model.model_copy(update={"step": "auto"})
        return cls(path, table, text, model, upstream_recipes(path))

    def changed(self, changes: Changes, folder: Path) -> Recipe:
        """The recipe as a sample has it; its changed bench file goes to ``folder``.

        Raises:
            InputError: a key or value that it does not take."""
        recipe = self.model
        if changes.recipe:
            table = changed_table(self.table, changes.recipe, RECIPE)
            built = validated(type(recipe), table, self.text, self.path)
            recipe = built.model_copy(update={"path": recipe.path})
        if changes.bench:
            path = folder / "bench.toml"
            write_bench(recipe, changes.bench, path)
            recipe = recipe.model_copy(update={"bench": str(path.resolve())})
        return recipe


@dataclass(frozen=True)
class SampleFiles:
    """What a sample changes: its recipe as the file has it, the changes in it and upstream by stem
    ('' for the study's recipe), the folder of its files, and the runs it has made upstream."""

    base: RecipeFile
    changes: Mapping[str, Changes]
    folder: Path
    runs: dict[Path, Path] = field(default_factory=dict)

    def changes_of(self, recipe: Recipe) -> Changes:
        """The changes in a recipe."""
        stem = "" if recipe.path == self.base.model.path else recipe.path.stem
        return self.changes.get(stem, Changes())

    def is_changed(self, path: Path) -> bool:
        """Whether an upstream recipe, or one of its own upstream, is changed."""
        stems = {path.stem, *upstream_recipes(path)}
        return not stems.isdisjoint(set(self.changes) - {""})


@dataclass(frozen=True)
class SampleInputs(Inputs):
    """What a sample takes in: rigs with its numbers; those of files are read once."""

    changes: Changes = field(default_factory=Changes)
    states: dict[Any, RigState] = field(default_factory=dict)

    def rig_state(self, rig: str, flow_maps: str | None = None) -> RigState:
        """As `Inputs.rig_state`, with what the sample changes."""
        key = (self.recipe.path, rig, flow_maps)
        if key not in self.states:
            self.states[key] = super().rig_state(rig, flow_maps)
        state = self.states[key]
        return replace(state, rig=changed_rig(state.rig, self.changes.rig))


class Sampler:
    """Makes samples of a plan; ``scratch`` is a folder for what a sample writes and drops."""

    def __init__(self, plan: Plan, scratch: Path) -> None:
        self.plan, self.scratch = plan, scratch
        self._files = {
            name: RecipeFile.of(path)
            for name, path in zip(plan.study.recipe, plan.recipes, strict=True)
        }
        self._cases = {case.name: case.set for case in plan.study.case}
        self._states: dict[Any, RigState] = {}
        self._warm = False

    def __call__(self, index: int, settings: Mapping[str, Any]) -> Sample:
        """One sample, whatever becomes of it."""
        began = time.monotonic()
        status, measures = "", (float("nan"),) * len(self.plan.study.measures)
        try:
            code, text, measures = self._run(settings, self._watch(began))
        except EhbenchError as error:
            code, text = error.exit_code, error.message
            status = LATE if isinstance(error, Late) else ""
        except Exception as error:
            code, text = 1, f"{type(error).__name__}: {error}"
        status = status or STATUS.get(code, STATUS[1])
        return Sample(index, code, status, text, measures, time.monotonic() - began)

    def files(self, settings: Mapping[str, Any], folder: Path) -> SampleFiles:
        """What a sample changes."""
        base = self._files[settings.get(RECIPE, self.plan.study.recipe[0])]
        changes = {key: value for key, value in settings.items() if key not in (CASE, RECIPE)}
        changes |= self._cases.get(settings.get(CASE, ""), {})
        return SampleFiles(base, changes_of(changes, list(base.upstream)), folder)

    def inputs(self, recipe: Recipe, files: SampleFiles) -> SampleInputs:
        """What a recipe of a sample takes in."""
        return SampleInputs(
            recipe,
            Notes(recipe),
            partial(self._run_of, files),
            allow_code=self.plan.allow_code,
            unvalidated=self.plan.unvalidated,
            changes=files.changes_of(recipe),
            states={} if set(files.changes) > {""} else self._states,
        )

    def refuse(self, settings: Mapping[str, Any]) -> None:
        """Refuse what a recipe, rig or bench file does not take; a single trial is prepared whole,
        since that costs next to nothing.

        Raises:
            EhbenchError: with the nearest key, or as the trial's stage."""
        files = self.files(settings, self.scratch)
        for stem, change in files.changes.items():
            file = RecipeFile.of(files.base.upstream[stem]) if stem else files.base
            recipe = file.changed(change, self.scratch)
            inputs = self.inputs(recipe, files)
            if change.rig:
                name = getattr(recipe, "rig", None)
                if name is None:
                    raise InputError(message("stages.no_rig_to_change", stage=recipe.stage_name))
                inputs.rig_state(name, getattr(recipe, "flow_maps", None))
            if isinstance(recipe, TrialRecipe) and set(files.changes) == {""}:
                notes = Notes(recipe, dry_run=True)
                stage_of(recipe).prepare(recipe, replace(inputs, notes=notes))
                for error in notes.errors:
                    raise error

    def _run(
        self, settings: Mapping[str, Any], progress: Progress | None
    ) -> tuple[int, str, tuple[float, ...]]:
        """(exit code, message, measures) of a sample."""
        measures = self.plan.study.measures
        with TemporaryDirectory(dir=self.scratch) as folder:
            files = self.files(settings, Path(folder))
            recipe = files.base.changed(files.changes[""], files.folder)
            stage = stage_of(recipe)  # others are refused
            prepared = stage.prepare(recipe, self.inputs(recipe, files))
            if isinstance(prepared, PreparedOne):  # of which nothing is written
                result = trial.run(prepared.trial, progress=progress)
                facts, ledger = result.facts, None
                if {(item.result or "").split(".")[0] for item in measures} & {"energy", "ledger"}:
                    facts, ledger, _ = trial.account(prepared.trial, result)
                roots = trial_roots(facts.as_json(), ledger)
                stop = None if facts.stop is None else facts.stop.t
                values = tuple(
                    of_channels(item, result.record, stop)
                    if item.channel is not None
                    else _measured(item, roots, settings)
                    for item in measures
                )
                return 5 if facts.stopped else 0, facts.stopped, values
            out = files.folder / "out"
            out.mkdir()
            work = stage.work(prepared, out, progress)
            roots = roots_of(out, {**work.facts, "code": work.code})
        values = tuple(_measured(item, roots, settings) for item in measures)
        return work.code, "; ".join(work.reasons), values

    def _watch(self, began: float) -> Progress | None:
        """Progress that ends a sample beyond its limit; not the first, which compiles."""
        limit, warm = self.plan.limit, self._warm
        self._warm = True
        if limit is None or not warm:
            return None

        def watch(activity: str, share: float) -> None:
            if time.monotonic() - began > limit:
                raise Late(message("stages.late", limit=limit))

        return watch

    def _run_of(self, files: SampleFiles, path: Path) -> Path | None:
        """The run of an upstream recipe: that of the study, or of the sample where it changes."""
        if not files.is_changed(path):
            return self.plan.runs.get(path)
        if path not in files.runs:
            folder = files.folder / f"upstream_{path.stem}"
            folder.mkdir()
            file = RecipeFile.of(path)
            recipe = file.changed(files.changes_of(file.model), folder)
            stage = stage_of(recipe)  # the study has run it
            out = folder / "run"
            out.mkdir()
            work = stage.work(stage.prepare(recipe, self.inputs(recipe, files)), out, None)
            about = {"stage": recipe.stage_name, "name": recipe.name, "what": stage.name}
            facts = {**about, **work.facts, "code": work.code, "outputs": {}}
            rundir.write_json(out / "run.json", facts)
            files.runs[path] = out
        return files.runs[path]


def _measured(item: Measure, roots: Sequence[Any], settings: Mapping[str, Any]) -> float:
    words = (item.result or "").split(".")
    root = next((root for root in roots if lookup(root, words) is not None), {})
    numbers = {} if item.inside is None else {item.inside: _si(settings[item.inside], item.inside)}
    value = value_of(item, root, numbers)
    if item.over is None:
        return value
    other = _measured(Measure(result=item.over), roots, settings)
    return value / other if other else float("nan")


def _si(value: Any, key: str) -> float:
    return parse(value, quantity(key)) if isinstance(value, str) else float(value)


def trial_roots(facts: Mapping[str, Any], ledger: Mapping[str, Any] | None) -> list[Any]:
    """Where the measures of a trial are looked up; no limit cycle has the amplitude 0."""
    measures = dict(facts["measures"])
    if measures.get("limit_cycle", 0) is None:
        measures["limit_cycle"] = {"amplitude": 0.0, "duration": 0.0}
    return [measures, facts, {"ledger": ledger or {}}]


def roots_of(folder: Path, facts: Mapping[str, Any]) -> list[Any]:
    """Where measures of a run are looked up: named rows, JSON files, facts."""
    files = {path.stem: rundir.read_json(path) for path in sorted(folder.glob("*.json"))}
    files.pop("run", None)
    named = [
        file[key]
        for file in files.values()
        for key in ("parameters", "rows")
        if isinstance(file, Mapping) and isinstance(file.get(key), list)
    ]
    return [*named, *files.values(), facts, files]


def write_bench(recipe: Recipe, changes: Mapping[str, Any], path: Path) -> None:
    """Write the bench file of a recipe with some of its keys set.

    Raises:
        InputError: the recipe has no bench, or that has no such key."""

    if "bench" not in type(recipe).model_fields:
        name, stage = next(iter(changes)), recipe.stage_name
        raise InputError(message("stages.no_bench", key=name, stage=stage))
    trial = cast(TrialRecipe, recipe)
    source = trial.file(trial.bench) if trial.bench else trial.path
    table: Any = read_toml(source)[0] if trial.bench else {"stage": "bench", "rig": trial.rig}
    rig = (source.parent / str(table["rig"])).resolve()
    table["rig"] = relative(rig, path.parent.resolve())
    table = changed_table(table, changes, BENCH)
    validated(BenchRecipe, table, "", source)
    write_text(path, tomli_w.dumps(table))


def upstream_recipes(path: Path) -> dict[str, Path]:
    """The recipes that a recipe names, and those that they name, by their stems."""
    results: dict[str, Path] = {}
    waiting = [path]
    while waiting:
        here = waiting.pop(0)
        for text in _texts(read_toml(here)[0]):
            if not text.endswith(".toml") or "$" in text:
                continue
            other = (here.parent / text).resolve()
            known = other in results.values() or other == path.resolve()
            if not known and other.is_file() and kind_of(other) == "recipe":
                results.setdefault(other.stem, other)
                waiting.append(other)
    return results


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    if not isinstance(value, Mapping | list):
        return []
    inner = value.values() if isinstance(value, Mapping) else value
    return [text for item in inner for text in _texts(item)]
