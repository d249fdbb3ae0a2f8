"""A recipe over many samples → tables, ``study.json``, and the worst as whole runs."""

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ehbench import trial
from ehbench.config.recipe import Recipe, StudyRecipe, load_recipe
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.runtime.cores import cores
from ehbench.runtime.memory import refuse_beyond
from ehbench.sampling.cluster import Cluster
from ehbench.sampling.design import CASE, RECIPE, Design, Factor, Fitted
from ehbench.sampling.journal import Journal
from ehbench.sampling.keys import RIG
from ehbench.sampling.measures import refuse_unknown
from ehbench.sampling.outputs import MeasureColumn, write_tables
from ehbench.sampling.pools import Processes, in_threads
from ehbench.sampling.sample import STATUS, Run, Task, Workers
from ehbench.sampling.summary import Summary
from ehbench.stages import base
from ehbench.stages.inputs import Inputs
from ehbench.stages.sample_files import load_study, run_samples, write_sample
from ehbench.stages.samples import Plan, Sampler, upstream_recipes
from ehbench.stages.trial import PreparedOne
from ehbench.vocabulary import EhbenchError, InputError, Progress, message, placed, plural, setting
from ehbench.vocabulary.units import parse


@dataclass(frozen=True)
class StudySettings:
    """How a study is checked and made."""

    cells: int = setting(
        4, "", "numbers in memory for each of the table", "it, its point in the design, two at work"
    )
    outer_draws: tuple[float, float] = setting(
        (0.02, 0.98),
        "",
        "shares of each draw that are tried before the study",
        "rarer draws are few",
    )
    short: float = setting(
        10.0, "s", "work that is done in threads", "a process takes seconds to start"
    )


SETTINGS = StudySettings()


@dataclass(frozen=True)
class PreparedStudy(base.Prepared):
    """A study before its first sample.

    Attributes:
        key: what its samples depend on.
        versions: of all methods that make them.
        workers: where they are made.
        resume: whether to go on with those of an interrupted study; ``keep``: though nobody asks.
        journal: where they are stored until the study is complete.
        is_redesigned: whether controllers are designed on the rigs that are drawn.
        said: of the controllers of the recipes that it repeats.
    """

    recipe: StudyRecipe
    plan: Plan
    design: Design
    measures: tuple[MeasureColumn, ...]
    targets: tuple[dict[str, Any], ...]
    key: str
    versions: Versions
    workers: Workers = Workers()
    resume: bool = False
    keep: bool = False
    journal: Path = Path("study.samples.jsonl")
    is_redesigned: bool = False
    said: tuple[str, ...] = ()


class StudyStage(base.Stage[StudyRecipe, PreparedStudy]):
    """`StudyRecipe`."""

    name = "study"
    command = "study"
    writes = "samples.parquet, samples.csv, study.json, the worst samples as runs, figures"

    def prepare(self, recipe: StudyRecipe, inputs: Inputs) -> PreparedStudy:
        runs: dict[Path, Path] = {}

        def run_of(path: Path) -> Path | None:
            folder = inputs.run_of(path)
            return None if folder is None else runs.setdefault(path, folder)

        paths = tuple(inputs.existing(name) for name in recipe.recipe)
        files = [("recipe", path) for path in paths]
        prepared = [_inner(path, replace(inputs, run_of=run_of)) for path in paths]
        for _, item in prepared:
            files += [file for file in item.inputs or () if file not in files]
        fitted = None
        if recipe.identified is not None:
            fitted, run = _fitted(recipe, inputs)
            files += [("identified", run)] if run is not None else []
        upstream = dict.fromkeys(item for path in paths for item in upstream_recipes(path).values())
        files += [("upstream", path) for path in upstream]
        design = Design(recipe, fitted)
        columns = len(design.columns) + len(recipe.measures) + 2
        needed = 8.0 * SETTINGS.cells * columns * design.size
        with inputs.notes.collected(), placed(recipe.at("samples")):
            refuse_beyond(needed, message("stages.table_of", count=design.size))
        plan = Plan(recipe, paths, runs, inputs.allow_code, inputs.unvalidated)
        if not inputs.notes.errors:
            _try_keys(recipe, plan, design, inputs)
            for stage, item in prepared:
                with inputs.notes.collected():
                    _refuse_measures(recipe, item, stage)
        first = prepared[0][1]
        rig = getattr(first, "state", getattr(first, "base", None))
        measures = tuple(
            MeasureColumn.of(measure, None if rig is None else rig.rig)
            for measure in recipe.measures
        )
        targets = tuple(_target(recipe, index, measures) for index in range(len(recipe.target)))
        does = message(
            "stages.does_study",
            recipes=" and ".join(f"'{name}'" for name in recipe.recipe),
            times=design.size,
            measures=plural(len(measures), "measure"),
        )
        versions = Versions.of(self.name, (stage.versions(item) for stage, item in prepared))
        content = [*(rundir.sha256(path) for _, path in files), str(versions)]
        digest = hashlib.sha256("".join([*content, repr(recipe.model_dump())]).encode())
        return PreparedStudy(
            recipe,
            tuple(files),
            does,
            plan,
            design,
            measures,
            targets,
            digest.hexdigest()[:16],
            versions,
            seeds={"study": recipe.seed},
            is_redesigned=any(item.key.startswith(f"{RIG}.") for item in design.drawn)
            and any(getattr(item.recipe, "controller", None) for _, item in prepared),
            said=tuple(dict.fromkeys(note for _, item in prepared for note in item.notes)),
        )

    def versions(self, prepared: PreparedStudy) -> Versions:
        return prepared.versions

    def run(self, prepared: PreparedStudy, host: base.Host) -> base.Outcome:
        """As `Stage.run`; samples are stored next to the run until it is complete."""
        final = self.place(prepared, host)
        journal = final.with_name(f"{final.name}.samples.jsonl")
        asked = {"workers": host.workers, "resume": host.resume, "keep": host.keep}
        outcome = super().run(replace(prepared, journal=journal, **asked), host)
        journal.unlink(missing_ok=True)
        return outcome

    def work(self, prepared: PreparedStudy, folder: Path, progress: Progress | None) -> base.Work:
        design, recipe = prepared.design, prepared.recipe
        goes_on = prepared.resume or prepared.keep
        journal = Journal(prepared.journal, prepared.key, design.size, goes_on)
        try:
            _make(prepared, journal, progress)
            rows = write_tables(folder, design, prepared.measures, journal, prepared.key)
            summary = Summary(recipe, design, prepared.measures, prepared.targets, rows)
            retained = [
                item | summary.row(item["sample"])
                for item in run_samples(
                    prepared.plan, design, summary.worst(), folder / "samples", progress
                )
            ]
        finally:
            journal.close()
        counts = Counter(rows.status)
        about = {
            "recipe": [Path(name).stem for name in recipe.recipe],
            "samples": design.size,
            "combinations": design.combinations,
            "points": design.points,
            "design": recipe.design,
            "status": dict(counts),
            "key": prepared.key,
        }
        rundir.write_json(folder / "study.json", about | summary.as_json() | {"worst": retained})
        warnings = [
            message("stages.samples_with_status", count=n, size=design.size, status=status)
            for status, n in sorted(counts.items())
            if status != STATUS[0]
        ]
        if prepared.is_redesigned:
            warnings.append(message("stages.redesigned"))
        bad = sum(counts[status] for status in ("failed", "refused", "late"))
        facts = {"samples": design.size, "warnings": [*warnings, *prepared.said]}
        here = (message("stages.begun_anew"),) * (prepared.resume and not journal.taken)
        return base.Work(facts, code=base.INCOMPLETE if bad else base.DONE, here=here)


def sample_recipe(study: Path, index: int, root: Path, inputs: Callable[[Recipe], Inputs]) -> Path:
    """Write the recipe of a sample, counted from 0, with its files into a folder of its own below
    the ``root`` of all runs; the study is named by its recipe or by its run folder.

    Raises:
        InputError: no such study or sample.
    """
    recipe = load_recipe(load_study(study))
    if not isinstance(recipe, StudyRecipe):
        raise InputError(message("stages.no_study"), file=recipe.path)
    prepared = StudyStage().prepare(recipe, inputs(recipe))
    if not 0 <= index < prepared.design.size:
        text = message("stages.no_sample", index=index, last=prepared.design.size - 1)
        raise InputError(text, file=study)
    folder = root / f"{recipe.name}_{prepared.key[:8]}_{index}"
    folder.mkdir(parents=True, exist_ok=True)
    return write_sample(prepared.plan, prepared.design, index, folder)


# --- refusing what cannot be made


def _inner(path: Path, inputs: Inputs) -> tuple[base.Stage, base.Prepared]:
    """(stage, prepared) of a recipe that the study runs."""
    inner = load_recipe(path)
    stage = base.stage_of(inner)
    if not stage.command or stage.name in ("campaign", "study"):
        name = inputs.notes.name_of(path)
        text = message("stages.not_in_study", name=name, stage=inner.stage_name)
        raise InputError(text, **inputs.recipe.at("recipe"))
    inputs.notes.add("reads", inputs.notes.name_of(path))
    return stage, stage.prepare(inner, replace(inputs, recipe=inner))


def _fitted(recipe: StudyRecipe, inputs: Inputs) -> tuple[Fitted | None, Path | None]:
    """What was identified, and its run; nothing where a dry run has none."""
    assert recipe.identified is not None
    name = recipe.identified.run
    folder = inputs.run_folder(inputs.existing(name))
    if folder is None:
        inputs.notes.add("undecided", message("stages.fit_not_run", name=name))
        return None, None
    path = folder / "parameters.json"
    if not path.is_file():
        text = message("stages.no_parameters", name=name)
        raise InputError(text, **recipe.at("identified", "run"))
    return Fitted.of(rundir.read_json(path), recipe.identified.parameters, path), folder


def _try_keys(recipe: StudyRecipe, plan: Plan, design: Design, inputs: Inputs) -> None:
    """Try every key by itself, then its outer draws, whose refusal is a remark."""
    first = design.settings(0)
    names = [first[RECIPE]] if RECIPE in first else recipe.recipe
    with TemporaryDirectory() as scratch:
        sampler = Sampler(plan, Path(scratch))

        def refuse(settings: Mapping[str, Any]) -> None:
            for name in names:
                sampler.refuse({RECIPE: name, **settings})

        for where, settings in _single_keys(recipe, design, first):
            with inputs.notes.collected():
                try:
                    refuse(settings)
                except EhbenchError as error:
                    raise InputError(error.message, **recipe.at(*where), hint=error.hint) from None
        if inputs.notes.errors:
            return
        for item in design.drawn:
            for share in SETTINGS.outer_draws:
                settings = design.quantile(item, share)
                try:
                    refuse(settings)
                except EhbenchError as error:
                    value = settings[item.key]
                    drawn = f"{float(value):.4g} times" if isinstance(value, Factor) else value
                    fields = {"key": item.key, "value": drawn, "reason": error.message}
                    inputs.notes.add("remarks", message("stages.sample_refused", **fields))


def _single_keys(
    recipe: StudyRecipe, design: Design, first: Mapping[str, Any]
) -> Iterator[tuple[tuple[str | int, ...], dict[str, Any]]]:
    """(place in the study's file, what is set) of each key; ``first``: sample 0."""
    step = design.size
    for item in design.listed:
        step //= len(item.values)
        if item.key in (CASE, RECIPE):
            continue
        last = len(item.values) - 1
        keys = (item.key, *recipe.sweep[item.key].also)
        for index in range(last + 1) if recipe.sweep[item.key].values else (0, last):
            settings = design.settings(index * step)
            yield ("sweep", item.key), {key: settings[key] for key in keys}
    for item in design.drawn:
        where = next((t for t in ("draw", "sweep") if item.key in getattr(recipe, t)), "identified")
        yield (where, item.key), design.quantile(item, 0.5)
    for index, key in enumerate(recipe.seeds):
        yield ("seeds", index), {key: first[key]}
    for index, case in enumerate(recipe.case):
        yield ("case", index), {CASE: case.name}


def _refuse_measures(study: StudyRecipe, prepared: base.Prepared, stage: base.Stage) -> None:
    """Refuse measures that no sample will have; the channels of a user's class are not known."""
    roots = stage.results(prepared)
    for index, measure in enumerate(study.measures):
        where = study.at("measures", index)
        if measure.channel is not None:
            if not isinstance(prepared, PreparedOne):
                raise InputError(message("stages.not_a_trial", measure=measure.label), **where)
            law = prepared.recipe.controller
            names = () if law is not None and law.code else (measure.channel, measure.minus)
            known = trial.log_channels(prepared.trial) if names else ()
            for name in names:
                if name is not None and name not in known:
                    near = ", ".join(get_close_matches(name, known, 1, 0.3) or known)
                    raise InputError(message("stages.no_channel", name=name, near=near), **where)
        for name in (measure.result, measure.over):
            if name is not None and roots and name != "code":
                refuse_unknown(name, roots, where)


def _target(recipe: StudyRecipe, index: int, measures: tuple[MeasureColumn, ...]) -> dict[str, Any]:
    """A target in the unit of its measure's column.

    Raises:
        InputError: no such measure, or an end of another quantity.
    """
    item = recipe.target[index]
    column = next((column for column in measures if column.name == item.measure), None)
    if column is None:
        names = [column.name for column in measures]
        near = get_close_matches(item.measure, names, 1, 0.3)
        text = message("sampling.no_measure", name=item.measure, near=", ".join(near or names))
        raise InputError(text, **recipe.at("target", index, "measure"))
    ends = {}
    for key in ("at_most", "at_least"):
        raw, where = getattr(item, key), recipe.at("target", index, key)
        if isinstance(raw, str):
            if column.row is None:
                raise InputError(message("stages.no_unit", name=column.name), **where)
            with placed(where):
                ends[key] = float(column.shown(parse(raw, column.row)))
        elif raw is not None:
            ends[key] = float(raw)
    return {"measure": item.measure, "unit": column.unit, **ends}


# --- making


def _make(prepared: PreparedStudy, journal: Journal, progress: Progress | None) -> None:
    """Make every sample that the journal has not."""
    size, begun = prepared.design.size, None
    missing = (index for index in range(size) if not journal.done[index])
    tasks = ((index, prepared.design.settings(index)) for index in missing)
    for run, share in _pools(prepared, tasks):
        for samples in run(share):
            journal.add(samples)
            if progress is not None:
                done, now, left = int(journal.done.sum()), time.monotonic(), ""
                first, since = begun = begun or (done, now)  # which waited for compilers
                if done > first:
                    seconds = (size - done) * (now - since) / (done - first)
                    units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
                    long = (item for item in units if seconds >= 2.0 * item[0])
                    length, unit = next(long, (1.0, "s"))
                    left = f", {seconds / length:.0f} {unit} left"
                progress(f"{done} of {size} samples{left}", 0.9 * done / size)


def _pools(prepared: PreparedStudy, tasks: Iterator[Task]) -> Iterator[tuple[Run, Iterator[Task]]]:
    """Where the samples are made, and which: a short study in threads; the rest of a longer one in
    processes, which the interpreter's lock does not hold up; there from the start what may hang."""
    workers, plan, measures = prepared.workers, prepared.plan, len(prepared.measures)
    if workers.scheduler:
        yield Cluster(workers, plan.bundle(), measures, plan.limit).run, tasks
        return
    count = workers.count or cores()
    if plan.limit is None and not plan.allow_code:
        run = lambda some: in_threads(plan.opened(), some, count)
        ends = time.monotonic() + SETTINGS.short
        yield run, iter(lambda: next(tasks, None) if time.monotonic() < ends else None, None)
    yield Processes(plan.opened, count, measures, plan.limit).run, tasks
