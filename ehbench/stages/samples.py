"""One sample of a study: its recipe, rig and bench file as the sample has them, run, and the
measures taken. What a sample gives hangs on nothing but the files and what it sets.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast
from weakref import finalize

from ehbench.config.recipe import (
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
from ehbench.runtime.disk import impossible
from ehbench.sampling.cluster import Bundle, file_name
from ehbench.sampling.design import CASE, RECIPE
from ehbench.sampling.keys import Changes, changed_bench, changed_rig, changed_table, changes_of
from ehbench.sampling.measures import lookup, of_channels, refuse_unknown, value_of
from ehbench.sampling.sample import LATE, STATUS, Make, Sample
from ehbench.stages.base import Prepared, Stage, stage_of
from ehbench.stages.findings import Findings
from ehbench.stages.inputs import Inputs, RigState, Runs
from ehbench.stages.trial import PreparedOne
from ehbench.vocabulary.errors import EhbenchError, InputError


def open_sampler(plan: Plan) -> Make:
    """What makes the samples of a plan in this process, with a scratch folder that goes with it."""
    scratch = TemporaryDirectory(prefix="ehbench_samples_")
    sampler = Sampler(plan, Path(scratch.name))
    finalize(sampler, scratch.cleanup)
    return sampler


def open_elsewhere(plan: Plan, root: Path) -> Make:
    """As `open_sampler`, with all files below another root."""

    def there(path: Path) -> Path:
        return root / file_name(path)

    study = plan.study.model_copy(update={"path": there(plan.study.path)})
    recipes = tuple(there(path) for path in plan.recipes)
    runs = {there(path): there(folder) for path, folder in plan.runs.items()}
    return open_sampler(replace(plan, study=study, recipes=recipes, runs=runs))


def bundle_of(plan: Plan) -> Bundle:
    """All files that the samples of a plan may read: recipes with what they and their rigs and
    benches name, and the runs behind them.
    """
    files: dict[str, bytes] = {}
    waiting = [*plan.recipes, *plan.runs.values()]
    for path in plan.recipes:
        recipe = load_recipe(path)
        if isinstance(recipe, TrialRecipe) and plan.allow_code:
            from ehbench import trial

            waiting += trial.code_files(recipe)
    seen: set[Path] = set()
    while waiting:
        path = waiting.pop().resolve()
        if path in seen:
            continue
        seen.add(path)
        if path.is_dir():
            inside = (
                item for item in sorted(path.iterdir()) if item.name not in ("figures", "logs")
            )
            waiting += inside if (path / "run.json").is_file() else ()
            continue
        files[file_name(path)] = path.read_bytes()
        if path.suffix == ".toml":
            named = (path.parent / text for text in _texts(read_toml(path)[0]) if _is_path(text))
            waiting += [item for item in named if item.exists()]
    return Bundle(files, partial(open_elsewhere, plan))


def _is_path(text: str) -> bool:
    return 0 < len(text) < 400 and "$" not in text and not impossible(Path(text))


class Late(EhbenchError):
    """A sample took longer than its time limit (exit 5)."""

    exit_code = 5


@dataclass(frozen=True)
class Plan:
    """All that makes the samples of a study, wherever: the study, its recipes' files, the run
    folders of recipes behind them, and what the user allowed.
    """

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


class Sampler:
    """Makes samples of a plan.

    Args:
        plan: of the study.
        scratch: a folder for what a sample writes and drops.
    """

    def __init__(self, plan: Plan, scratch: Path) -> None:
        self.plan, self.scratch = plan, scratch
        self._bases = {
            name: _Base.of(path) for name, path in zip(plan.study.recipe, plan.recipes, strict=True)
        }
        self._cases = {case.name: case.set for case in plan.study.case}
        self._states: dict[Any, RigState] = {}
        self._warm = False

    def __call__(self, index: int, settings: Mapping[str, Any]) -> Sample:
        """As `sample`."""
        return self.sample(index, settings)

    def sample(self, index: int, settings: Mapping[str, Any]) -> Sample:
        """One sample, whatever becomes of it."""
        began = time.monotonic()
        blank = tuple(float("nan") for _ in self.plan.study.measures)
        try:
            code, message, measures = self._made(settings, began)
            status = STATUS.get(code, STATUS[1])
        except Late as error:
            code, status, message, measures = error.exit_code, LATE, error.message, blank
        except EhbenchError as error:
            code, message, measures = error.exit_code, error.message, blank
            status = STATUS.get(code, STATUS[1])
        except Exception as error:
            code, status, measures = 1, STATUS[1], blank
            message = f"{type(error).__name__}: {error}"
        return Sample(index, code, status, message, measures, time.monotonic() - began)

    def prepared(self, settings: Mapping[str, Any], folder: Path) -> tuple[Stage, Prepared]:
        """(the stage of a sample's recipe, the recipe prepared); ``folder`` takes its own files.

        Raises:
            EhbenchError: as the stage.
        """
        base, changes = self.changes(settings)
        recipe = base.changed(changes[""], folder)
        stage = stage_of(recipe)
        assert isinstance(stage, Stage)  # the study was refused else
        return stage, stage.prepare(recipe, self.inputs(recipe, base, changes, folder))

    def refuse(self, settings: Mapping[str, Any], folder: Path) -> None:
        """Refuse what a recipe, rig or bench file does not take; a single trial is prepared whole,
        since that costs next to nothing.

        Raises:
            EhbenchError: with the nearest key, or as the trial's stage.
        """
        base, changes = self.changes(settings)
        for stem, change in changes.items():
            here = base if not stem else _Base.of(base.behind[stem])
            recipe = here.changed(change, folder)
            inputs = self.inputs(recipe, base, changes, folder)
            if change.rig:
                name = getattr(recipe, "rig", None)
                if name is None:
                    raise InputError(f"a {recipe.stage_name} has no rig to change")
                state = Inputs.rig_state(inputs, name, getattr(recipe, "flow_maps", None))
                changed_rig(state.rig, change.rig)
            if isinstance(recipe, TrialRecipe) and set(changes) == {""}:
                findings = Findings(recipe, collects=True)
                stage_of(recipe).prepare(recipe, replace(inputs, findings=findings))
                for error in findings.errors:
                    raise error

    def changes(self, settings: Mapping[str, Any]) -> tuple[_Base, dict[str, Changes]]:
        """(the recipe of a sample as its file has it, what the sample changes in it and behind)."""
        base = self._bases[settings.get(RECIPE, self.plan.study.recipe[0])]
        own = {key: value for key, value in settings.items() if key not in (CASE, RECIPE)}
        own |= self._cases.get(settings.get(CASE, ""), {})
        return base, changes_of(own, list(base.behind))

    def inputs(
        self, recipe: Recipe, base: _Base, changes: Mapping[str, Changes], folder: Path
    ) -> SampleInputs:
        """What a sample's recipe takes in."""
        runs = SampleRuns(self, base, changes, folder)
        return SampleInputs(
            recipe,
            Findings(recipe),
            runs,
            allow_code=self.plan.allow_code,
            unvalidated=self.plan.unvalidated,
            changes=changes.get(base.stem_of(recipe), Changes()),
            states={} if set(changes) > {""} else self._states,
        )

    def _made(
        self, settings: Mapping[str, Any], began: float
    ) -> tuple[int, str, tuple[float, ...]]:
        progress = self._watch(began)
        with self._folder(settings) as name:
            folder = Path(name)
            stage, prepared = self.prepared(settings, folder)
            if isinstance(prepared, PreparedOne):
                return self._trial(prepared, settings, progress)
            out = folder / "out"
            out.mkdir()
            work = stage.work(prepared, out, progress)
            facts = {**work.facts, "code": work.code}
            results = roots_of(out, facts)
        message = "; ".join(work.reasons)
        return work.code, message, self._measured(results, settings)

    def _folder(self, settings: Mapping[str, Any]) -> AbstractContextManager[Path | str]:
        """A folder for a sample's own files; where it has none, only the one that all share."""
        if self._is_trial(settings):
            return nullcontext(self.scratch)
        return TemporaryDirectory(dir=self.scratch)

    def _is_trial(self, settings: Mapping[str, Any]) -> bool:
        """Whether a sample is a single trial without files of its own."""
        base, changes = self.changes(settings)
        alone = set(changes) == {""} and not changes[""].bench
        return isinstance(base.model, TrialRecipe) and alone

    def _trial(
        self, prepared: PreparedOne, settings: Mapping[str, Any], progress: Callable | None
    ) -> tuple[int, str, tuple[float, ...]]:
        """A single trial, of which nothing is written."""
        from ehbench import trial

        result, measures = trial.run(prepared.trial, progress=progress), self.plan.study.measures
        facts, ledger = result.facts, None
        if any(
            (measure.result or "").split(".")[0] in ("energy", "ledger") for measure in measures
        ):
            facts, ledger, _ = trial.account(prepared.trial, result)
        roots = trial_roots(facts.as_json(), ledger)
        stop = None if facts.stop is None else facts.stop.t
        code = 5 if facts.stopped else 0
        taken = tuple(
            of_channels(measure, result.record, stop)
            if measure.channel is not None
            else self._one(measure, roots, settings)
            for measure in measures
        )
        return code, facts.stopped, taken

    def _measured(self, roots: Sequence[Any], settings: Mapping[str, Any]) -> tuple[float, ...]:
        return tuple(self._one(measure, roots, settings) for measure in self.plan.study.measures)

    @staticmethod
    def _one(item: Measure, roots: Sequence[Any], settings: Mapping[str, Any]) -> float:
        words = (item.result or "").split(".")
        root = next((root for root in roots if lookup(root, words) is not None), {})
        numbers = {} if item.inside is None else {item.inside: si_of(settings[item.inside], item)}
        value = value_of(item, root, numbers)
        if item.over is None:
            return value
        other = Sampler._one(Measure(result=item.over), roots, settings)
        return value / other if other else float("nan")

    def _watch(self, began: float) -> Callable[[str, float], None] | None:
        """A progress callback that ends a sample beyond its time limit; not the first, which has to
        load compiled code, or make it.
        """
        limit, warm = self.plan.limit, self._warm
        self._warm = True
        if limit is None or not warm:
            return None

        def watch(what: str, share: float) -> None:
            if time.monotonic() - began > limit:
                raise Late(f"it took longer than {limit:g} s")

        return watch


def si_of(raw: Any, item: Measure) -> float:
    """A number of a study in SI, by the words of the key that it is of."""
    from ehbench.config.rig import parameter_row
    from ehbench.vocabulary.units import parse

    return parse(raw, parameter_row(item.inside or "")) if isinstance(raw, str) else float(raw)


def trial_roots(facts: Mapping[str, Any], ledger: Mapping[str, Any] | None) -> list[Any]:
    """Where the measures of a trial are looked up; a swing that there is not has no height."""
    measures = dict(facts["measures"])
    if measures.get("limit_cycle", 0) is None:
        measures["limit_cycle"] = {"amplitude": 0.0, "duration": 0.0}
    return [measures, facts, {"ledger": ledger or {}}]


def roots_of(folder: Path, facts: Mapping[str, Any]) -> list[Any]:
    """Where the measures of a run are looked up: its tables of named rows, its JSON files, what it
    says of itself.
    """
    files = {path.stem: rundir.read_json(path) for path in sorted(folder.glob("*.json"))}
    files.pop("run", None)
    named = [
        file[key]
        for file in files.values()
        for key in ("parameters", "rows")
        if isinstance(file, Mapping) and isinstance(file.get(key), list)
    ]
    return [*named, *files.values(), facts, files]


# --- what a sample reads
# -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Base:
    """A recipe as its file has it: its table and text, and the recipes behind it by their stems."""

    path: Path
    table: Mapping[str, Any]
    text: str
    model: Recipe
    behind: Mapping[str, Path]

    @classmethod
    def of(cls, path: Path) -> _Base:
        table, text = read_toml(path)
        return cls(path, table, text, load_recipe(path), recipes_behind(path))

    def stem_of(self, recipe: Recipe) -> str:
        """The name by which keys call a recipe: '' the study's own."""
        return "" if recipe.path == self.model.path else recipe.path.stem

    def changed(self, changes: Changes, folder: Path) -> Recipe:
        """The recipe as a sample has it; a bench file of its own goes to ``folder``.

        Raises:
            InputError: a key or value that it does not take.
        """
        recipe = self.model
        if changes.recipe:
            table = changed_table(self.table, changes.recipe, RECIPE)
            built = validated(type(recipe), table, self.text, self.path)
            recipe = built.model_copy(update={"path": recipe.path})
        if changes.bench:
            name = write_bench(recipe, changes.bench, folder)
            recipe = recipe.model_copy(update={"bench": name})
        return recipe


def write_bench(recipe: Recipe, changes: Mapping[str, Any], folder: Path) -> str:
    """The bench file of a recipe with some of its keys set; its path.

    Raises:
        InputError: the recipe has no bench, or that has no such key.
    """
    import tomli_w

    if "bench" not in type(recipe).model_fields:
        raise InputError(f"'bench.{next(iter(changes))}': a {recipe.stage_name} has no bench file")
    own = cast(TrialRecipe, recipe)
    if own.bench is None:
        source, table = own.path, {"stage": "bench", "rig": own.rig}
    else:
        source = own.file(own.bench)
        table, _ = read_toml(source)
    table["rig"] = str((source.parent / str(table["rig"])).resolve())
    built = changed_bench(table, changes, source)
    path = folder / "bench.toml"
    path.write_text(tomli_w.dumps(built), encoding="utf-8")
    return str(path.resolve())


def recipes_behind(path: Path) -> dict[str, Path]:
    """The recipes that a recipe names, and those behind them, by their stems."""
    results: dict[str, Path] = {}
    waiting = [path]
    while waiting:
        here = waiting.pop(0)
        table, _ = read_toml(here)
        for text in _texts(table):
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
    inner = value.values() if isinstance(value, Mapping) else value
    return (
        [text for item in inner for text in _texts(item)]
        if isinstance(value, Mapping | list)
        else []
    )


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


class SampleRuns:
    """`Runs` of a sample: those of the study, but of recipes that the sample changes, or that stand
    on such ones, runs of its own.
    """

    def __init__(
        self, sampler: Sampler, base: _Base, changes: Mapping[str, Changes], folder: Path
    ) -> None:
        self._sampler, self._base = sampler, base
        self._changes, self._folder = changes, folder
        self._made: dict[Path, Path] = {}

    def folder(self, path: Path, findings: Findings) -> Path | None:
        """As `Runs.folder`."""
        changed = set(self._changes) - {""}
        if changed.isdisjoint({path.stem, *recipes_behind(path)}):
            return self._sampler.plan.runs.get(path)
        if path not in self._made:
            self._made[path] = self._run(path)
        return self._made[path]

    def findings(self, path: Path) -> None:
        """As `Runs.findings`: nothing, in a run."""

    def _run(self, path: Path) -> Path:
        behind = _Base.of(path)
        folder = self._folder / f"behind_{path.stem}"
        folder.mkdir()
        recipe = behind.changed(self._changes.get(path.stem, Changes()), folder)
        stage = stage_of(recipe)
        assert isinstance(stage, Stage)  # a run of it was made for the study
        inputs = self._sampler.inputs(recipe, self._base, self._changes, self._folder)
        out = folder / "run"
        out.mkdir()
        work = stage.work(stage.prepare(recipe, inputs), out, None)
        about = {"stage": recipe.stage_name, "name": recipe.name, "what": stage.name}
        facts = {**about, **work.facts, "code": work.code, "outputs": {}}
        rundir.write_json(out / "run.json", facts)
        return out


class RecordedRuns:
    """`Runs` that notes which run folder each recipe has."""

    def __init__(self, runs: Runs) -> None:
        self._runs = runs
        self.folders: dict[Path, Path] = {}

    def folder(self, path: Path, findings: Findings) -> Path | None:
        """As `Runs.folder`."""
        result = self._runs.folder(path, findings)
        if result is not None:
            self.folders[path] = result
        return result

    def findings(self, path: Path) -> Findings | None:
        """As `Runs.findings`."""
        return self._runs.findings(path)


# --- what results there will be
# -------------------------------------------------------------------------------------------------


def refuse_measures(study: StudyRecipe, prepared: Prepared, stage: Stage) -> None:
    """Refuse measures that no sample will have.

    Raises:
        InputError: names the nearest.
    """
    roots = promised(prepared, stage)
    for at, measure in enumerate(study.measures):
        if measure.channel is not None:
            _refuse_channels(measure, prepared, study.at("measures", at))
        for name in (measure.result, measure.over):
            if name is not None and roots and name != "code":
                refuse_unknown(name, roots, study.at("measures", at))


def _refuse_channels(item: Measure, prepared: Prepared, where: Mapping[str, Any]) -> None:
    """Refuse channels that no trial's log will have; those of a user's class are not known."""
    if not isinstance(prepared, PreparedOne):
        message = f"'{item.label}' is taken of a channel, which only one trial has"
        raise InputError(message, **where)
    law = prepared.recipe.controller
    if law is not None and law.code is not None:
        return
    from ehbench import trial

    there = trial.log_channels(prepared.trial)
    for name in (item.channel, item.minus):
        if name is not None and name not in there:
            near = get_close_matches(name, there, 1, 0.3)
            raise InputError(
                f"no channel of the log is called '{name}'",
                **where,
                hint=f"nearest is '{near[0]}'" if near else "there are " + ", ".join(there),
            )


def promised(prepared: Prepared, stage: Stage) -> list[Any]:
    """What the results of a stage look like, as `refuse_unknown` takes them; nothing where that is
    not known.
    """
    if isinstance(prepared, PreparedOne):
        return _of_trial(prepared)
    if stage.name == "hydraulics":
        from ehbench.identification.results import FittedParameter, HydraulicsFit

        names = getattr(prepared.recipe, "parameters", ())
        return [dict.fromkeys(names, FittedParameter), HydraulicsFit]
    if stage.name == "validation":
        from ehbench.validation.results import Validation

        return [Validation, {"accepted": bool}]
    if stage.name in ("tuning", "arc_tuning"):
        from ehbench.tune.arc import ArcTuning
        from ehbench.tune.results import Tuning

        return [Tuning if stage.name == "tuning" else ArcTuning]
    if stage.name == "trials":
        cases = getattr(prepared, "cases", ())
        item = {**_trial_measures(), "duration": float, "stopped": str}
        return [{case.name: item for case in cases}]
    return []


@lru_cache(maxsize=1)
def _trial_measures() -> dict[str, Any]:
    from ehbench.trial.measures import StepMeasures
    from ehbench.trial.swing import LimitCycle
    from ehbench.vocabulary.codes import LIMITS

    return {
        "steps": tuple[StepMeasures, ...],
        "tracking": dict.fromkeys(("max_error", "rms_error", "final_error"), float),
        "speed_rms_error": float,
        "limit_cycle": LimitCycle,
        "limits": dict.fromkeys(LIMITS.values(), float),
        "energy": dict.fromkeys(("pump", "cylinder_work", "oil_drawn"), float),
    }


def _of_trial(prepared: PreparedOne) -> list[Any]:
    from ehbench.trial import Facts

    loop = prepared.trial.loop
    if loop is None:
        return [Facts, {"ledger": Any}]
    parts = loop.laws.parts if loop.laws is not None else (None,)
    first, *others = (
        {**_trial_measures(), **(part.used if part is not None else {})} for part in parts
    )
    names = (item.cylinder for item in loop.driven[1:])
    also = {"also": dict(zip(names, others, strict=True))} if others else {}
    return [first | also, Facts, {"ledger": Any}]
