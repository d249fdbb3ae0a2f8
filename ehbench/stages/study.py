"""A recipe over many samples → ``samples.parquet``, ``samples.csv``, ``study.json`` and the worst
samples as whole runs.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe import StudyRecipe, load_recipe
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.runtime.cores import cores
from ehbench.runtime.memory import refuse_beyond
from ehbench.sampling import statistics
from ehbench.sampling.cluster import Cluster
from ehbench.sampling.design import CASE, RECIPE, Design, Factor, Fitted, label_of
from ehbench.sampling.journal import Journal
from ehbench.sampling.outputs import MeasureColumn, Rows, write_tables
from ehbench.sampling.pools import Pool, Processes, Threads
from ehbench.sampling.sample import STATUS, WHOLE, Task
from ehbench.stages.base import DONE, INCOMPLETE, Host, Outcome, Prepared, Stage, Work, stage_of
from ehbench.stages.findings import counted
from ehbench.stages.inputs import Inputs
from ehbench.stages.kept import keep
from ehbench.stages.samples import (
    Plan,
    RecordedRuns,
    Sampler,
    bundle_of,
    open_sampler,
    recipes_behind,
    refuse_measures,
)
from ehbench.vocabulary.errors import EhbenchError, InputError
from ehbench.vocabulary.progress import Progress
from ehbench.vocabulary.text import shortened
from ehbench.vocabulary.units import parse

CELLS = 4  # of memory for each number of the table: it, its point in the design, two at work
OUTER = (0.02, 0.98)  # shares of a draw: what lies beyond is too rare to say
SHORT = 10.0  # [s] of work below which other processes would start too late to help


@dataclass(frozen=True)
class Where:
    """Where and how a study's samples are made: the address of a Dask ``scheduler``, '' for this
    machine; how many ``workers``, 0 for one a core.
    """

    scheduler: str = ""
    workers: int = 0

    @classmethod
    def of(cls, message: str) -> Where:
        """What ``--workers`` says: how many here, or a scheduler's address; '' is one a core.

        Raises:
            InputError: it is neither.
        """
        if ":" in message:
            return cls(scheduler=message)
        if message and not (message.isdecimal() and int(message) > 0):
            raise InputError(
                f"--workers is {shortened(message, 40)}",
                hint="it takes a number from 1 on, or the address of a Dask scheduler: "
                "tcp://host:8786",
            )
        return cls(workers=int(message or 0))


@dataclass(frozen=True)
class PreparedStudy(Prepared):
    """A study before its first sample. ``key`` says what its samples hang on; ``journal`` is where
    they are kept until it is whole, ``resume`` whether to go on with those of a killed study.
    """

    recipe: StudyRecipe
    plan: Plan
    design: Design
    measures: tuple[MeasureColumn, ...]
    targets: tuple[dict[str, Any], ...]
    key: str
    versions: Versions
    where: Where = field(default_factory=Where)
    resume: bool = False
    journal: Path = Path("study.samples.jsonl")


class StudyStage(Stage[StudyRecipe, PreparedStudy]):
    """`StudyRecipe`."""

    recipe = StudyRecipe
    name = "study"
    command = "study"
    writes = "samples.parquet, samples.csv, study.json, the worst samples as runs, figures"

    def prepare(self, recipe: StudyRecipe, inputs: Inputs) -> PreparedStudy:
        runs = RecordedRuns(inputs.runs)
        paths = tuple(inputs.existing(name) for name in recipe.recipe)
        files = [("recipe", path) for path in paths]
        prepared = [self._inner(path, at, inputs, runs) for at, path in enumerate(paths)]
        for item in prepared:
            files += [file for file in item[1].inputs or () if file not in files]
        fitted = None
        if recipe.identified is not None:
            fitted, result = _fitted(recipe, inputs)
            files += [("identified", result)] if result is not None else []
        for behind in (item for path in paths for item in recipes_behind(path).values()):
            files += [("behind", behind)] if ("behind", behind) not in files else []
        design = Design(recipe, fitted)
        with inputs.findings.noting():
            _refuse_size(recipe, design)
        allowed = {"allow_code": inputs.allow_code, "unvalidated": inputs.unvalidated}
        plan = Plan(recipe, paths, runs.folders, **allowed)
        if not inputs.findings.errors:
            _refuse_keys(recipe, plan, design, inputs)
            for stage, item in prepared:
                with inputs.findings.noting():
                    refuse_measures(recipe, item, stage)
        rig = getattr(prepared[0][1], "state", getattr(prepared[0][1], "base", None))
        measures = tuple(
            MeasureColumn.of(measure, None if rig is None else rig.rig)
            for measure in recipe.measures
        )
        targets = tuple(_target(recipe, at, measures) for at in range(len(recipe.target)))
        names = " and ".join(f"'{name}'" for name in recipe.recipe)
        does = f"runs {names} {design.size} times and takes {counted(measures, 'measure')} of each"
        versions = Versions.of(self.name, (stage.versions(item) for stage, item in prepared))
        content = [rundir.sha256(path) for _, path in files] + [str(versions)]
        key = hashlib.sha256("".join([*content, repr(recipe.model_dump())]).encode())
        seeds = {"study": recipe.seed}
        return PreparedStudy(
            recipe,
            tuple(files),
            does,
            plan,
            design,
            measures,
            targets,
            key.hexdigest()[:16],
            versions,
            seeds=seeds,
        )

    def versions(self, prepared: PreparedStudy) -> Versions:
        return prepared.versions

    @staticmethod
    def _inner(path: Path, at: int, inputs: Inputs, runs: RecordedRuns) -> tuple[Stage, Prepared]:
        """(stage, prepared) of a recipe that the study runs."""
        inner = load_recipe(path)
        stage = stage_of(inner)
        if not isinstance(stage, Stage) or stage.name in ("campaign", "study"):
            raise InputError(
                f"'{inputs.findings.shown(path)}' is of stage '{inner.stage_name}', "
                "of which there are no studies",
                **inputs.recipe.at("recipe"),
                hint="name a recipe of a trial, identify, validate or tune",
            )
        inputs.findings.say("reads", inputs.findings.shown(path))
        return stage, stage.prepare(inner, replace(inputs, recipe=inner, runs=runs))

    def run(self, prepared: PreparedStudy, host: Host) -> Outcome:
        """As `Stage.run`; samples are kept beside the run's place until it is whole."""
        final = self.place(prepared, host)
        journal = final.with_name(f"{final.name}.samples.jsonl")
        where = getattr(host, "where", None) or Where()
        resume = host.resume or host.keep
        built = super().run(replace(prepared, where=where, journal=journal, resume=resume), host)
        journal.unlink(missing_ok=True)
        return built

    def work(self, prepared: PreparedStudy, folder: Path, progress: Progress | None) -> Work:
        design, recipe = prepared.design, prepared.recipe
        journal = Journal(prepared.journal, prepared.key, design.size, prepared.resume)
        try:
            _make(prepared, journal, progress)
            columns = write_tables(folder, design, prepared.measures, journal, prepared.key)
            worst = _worst(prepared, columns)
            retained = [
                item | _row(prepared, columns, item["sample"])
                for item in keep(prepared.plan, design, worst, folder / "samples", progress)
            ]
        finally:
            journal.close()
        counts = Counter(columns.status)
        messages = [
            f"{n} of {design.size} samples {word}"
            for word, n in sorted(counts.items())
            if word != STATUS[0]
        ]
        rundir.write_json(
            folder / "study.json",
            {
                "recipe": [Path(name).stem for name in recipe.recipe],
                "samples": design.size,
                "combinations": design.combinations,
                "points": design.points,
                "design": recipe.design,
                "status": dict(counts),
                "key": prepared.key,
                "inputs": list(_inputs(design)),
                "measures": _summaries(prepared, columns),
                "targets": _targets(prepared, columns),
                "groups": _groups(prepared, columns),
                "sensitivity": _sensitivity(prepared, columns),
                "worst": retained,
            },
        )
        facts = {"samples": design.size, "warnings": messages}
        bad = sum(n for word, n in counts.items() if word in ("failed", "refused", "late"))
        return Work(facts, code=INCOMPLETE if bad else DONE)


def _refuse_size(recipe: StudyRecipe, design: Design) -> None:
    """Refuse a table that memory does not hold, before its first sample is made."""
    needed = 8.0 * CELLS * (len(design.columns) + len(recipe.measures) + 2) * design.size
    try:
        refuse_beyond(needed, f"a table of {design.size} samples")
    except InputError as error:
        raise InputError(error.message, **recipe.at("samples"), hint=error.hint) from None


def _fitted(recipe: StudyRecipe, inputs: Inputs) -> tuple[Fitted | None, Path | None]:
    """What was identified, and its run; nothing where a check finds that it has not been run."""
    assert recipe.identified is not None
    folder = inputs.run_folder(inputs.existing(recipe.identified.run))
    if folder is None:
        inputs.findings.say("open", f"what is drawn: '{recipe.identified.run}' has not been run")
        return None, None
    path = folder / "parameters.json"
    if not path.is_file():
        raise InputError(
            f"'{recipe.identified.run}' has identified no parameters",
            **recipe.at("identified", "run"),
            hint="name an identify recipe of hydraulics or its run",
        )
    return Fitted.of(rundir.read_json(path), recipe.identified.parameters, path), folder


def _refuse_keys(recipe: StudyRecipe, plan: Plan, design: Design, inputs: Inputs) -> None:
    """Try every key by itself: every listed value, the ends of a grid, the middle of a draw; then
    its outer draws, where a refusal is no mistake but worth knowing.
    """
    from tempfile import TemporaryDirectory

    first = design.settings(0)
    names = [first[RECIPE]] if RECIPE in first else recipe.recipe
    with TemporaryDirectory() as scratch:
        sampler = Sampler(plan, Path(scratch))
        for where, settings in _alone(recipe, design, first):
            with inputs.findings.noting():
                try:
                    for name in names:
                        sampler.refuse({RECIPE: name, **settings}, Path(scratch))
                except EhbenchError as error:
                    message = error.message
                    raise InputError(message, **recipe.at(*where), hint=error.hint) from None
        if inputs.findings.errors:
            return
        for item in design.drawn:
            for settings in (design.quantile(item, share) for share in OUTER):
                try:
                    for name in names:
                        sampler.refuse({RECIPE: name, **settings}, Path(scratch))
                except EhbenchError as error:
                    end = settings[item.key]
                    drawn = f"{float(end):.4g} times" if isinstance(end, Factor) else end
                    said = f"a sample with {item.key} = {drawn} is refused: {error.message}"
                    inputs.findings.say("notes", said)


def _alone(
    recipe: StudyRecipe, design: Design, first: Mapping[str, Any]
) -> Iterator[tuple[tuple[str | int, ...], dict[str, Any]]]:
    """(place in the study's file, what is set) of each key by itself; ``first`` is the first
    sample's.
    """
    for item in design.listed:
        if item.key in (CASE, RECIPE):
            continue
        last = len(item.values) - 1
        for at in range(last + 1) if recipe.sweep[item.key].values else (0, last):
            those = design.settings(_index_of(design, item.key, at))
            keys = (item.key, *recipe.sweep[item.key].also)
            yield ("sweep", item.key), {key: those[key] for key in keys}
    for item in design.drawn:
        where = next((t for t in ("draw", "sweep") if item.key in getattr(recipe, t)), "identified")
        yield (where, item.key), design.quantile(item, 0.5)
    for at, key in enumerate(recipe.seeds):
        yield ("seeds", at), {key: first[key]}
    for at, case in enumerate(recipe.case):
        yield ("case", at), {CASE: case.name}


def _index_of(design: Design, key: str, at: int) -> int:
    """A sample with the ``at``-th value of a listed key."""
    step = design.points
    for item in reversed(design.listed):
        if item.key == key:
            return at * step
        step *= len(item.values)
    raise KeyError(key)


def _target(recipe: StudyRecipe, at: int, measures: tuple[MeasureColumn, ...]) -> dict[str, Any]:
    """A target in the unit of its measure's column.

    Raises:
        InputError: no such measure, or an end that is none of its quantity.
    """
    item, where = recipe.target[at], recipe.at("target", at, "measure")
    names = [column.name for column in measures]
    if item.measure not in names:
        from difflib import get_close_matches

        near = get_close_matches(item.measure, names, 1, 0.3)
        raise InputError(
            f"'{item.measure}' is no measure of this study",
            **where,
            hint=f"did you mean '{near[0]}'?" if near else "it has " + ", ".join(names),
        )
    column = measures[names.index(item.measure)]
    ends = {}
    for key in ("at_most", "at_least"):
        raw = getattr(item, key)
        if raw is not None:
            ends[key] = _end(raw, column, recipe, at, key)
    return {"measure": item.measure, "unit": column.unit, **ends}


def _end(raw: Any, column: MeasureColumn, recipe: StudyRecipe, at: int, key: str) -> float:
    if not isinstance(raw, str):
        return float(raw)
    if column.row is None:
        raise InputError(
            f"'{column.name}' has no unit that is known",
            **recipe.at("target", at, key),
            hint="write a plain number",
        )
    try:
        return float(column.shown(parse(raw, column.row)))
    except EhbenchError as error:
        raise InputError(error.message, **recipe.at("target", at, key), hint=error.hint) from None


# --- making
# -------------------------------------------------------------------------------------------------


def _make(prepared: PreparedStudy, journal: Journal, progress: Progress | None) -> None:
    """Make every sample that the journal has not."""
    design, tell = prepared.design, _Teller(journal, prepared.design.size, progress)
    left = (index for index in range(design.size) if not journal.done[index])
    tasks = ((index, design.settings(index)) for index in left)
    for pool, share in _pools(prepared, tasks):
        for samples in pool.run(share):
            journal.add(samples)
            tell()


def _pools(prepared: PreparedStudy, tasks: Iterator[Task]) -> Iterator[tuple[Pool, Iterator[Task]]]:
    """Where the samples are made, and which: a short study in threads; what is left after SHORT in
    processes, which the interpreter's lock does not hold up; at once there what may hang.
    """
    where, plan, measures = prepared.where, prepared.plan, len(prepared.measures)
    if where.scheduler:
        yield Cluster(where.scheduler, bundle_of(plan), measures, plan.limit), tasks
        return
    opener, workers = partial(open_sampler, plan), where.workers or cores()
    if plan.limit is None and not plan.allow_code:
        yield Threads(opener, workers), _until(time.monotonic() + SHORT, tasks)
    yield Processes(opener, workers, measures, plan.limit), tasks


def _until(end: float, tasks: Iterator[Task]) -> Iterator[Task]:
    """Tasks that are taken before ``end`` on the monotonic clock."""
    while time.monotonic() < end and (task := next(tasks, None)) is not None:
        yield task


class _Teller:
    """Tells how far a study is, and how long it will take still."""

    def __init__(self, journal: Journal, size: int, progress: Progress | None) -> None:
        self._journal, self._size, self._progress = journal, size, progress
        self._begun = time.monotonic()

    def __call__(self) -> None:
        if self._progress is None:
            return
        done, taken = int(self._journal.done.sum()), self._journal.taken
        left = (time.monotonic() - self._begun) * (self._size - done) / max(done - taken, 1)
        self._progress(
            f"{done} of {self._size} samples, {spoken(left)} left", 0.9 * done / self._size
        )


def spoken(seconds: float) -> str:
    """A time as people say it."""
    for size, word in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2.0 * size:
            return f"{seconds / size:.0f} {word}"
    return f"{seconds:.0f} s"


# --- what they say together
# -------------------------------------------------------------------------------------------------


def _inputs(design: Design) -> Iterator[dict[str, Any]]:
    """Of each input: its column, how it is varied, whether its numbers are factors."""
    listed = {item.key: [label_of(value) for value in item.values] for item in design.listed}
    laws = {item.key: item.spoken for item in design.drawn}
    factors = {item.key for item in (*design.listed, *design.drawn) if item.relative}
    for column in design.columns:
        key = column.key
        about = {"values": listed.get(key, []), "law": laws.get(key, ""), "factor": key in factors}
        yield asdict(column) | about


def _row(prepared: PreparedStudy, rows: Rows, index: int) -> dict[str, Any]:
    """What a sample set, what became of it, and its measures."""
    design = prepared.design
    return {
        "status": rows.status[index],
        "inputs": design.cells(design.inputs(index)),
        "measures": rows.measures[index].tolist(),
    }


def _counted(prepared: PreparedStudy, rows: Rows, at: int) -> np.ndarray:
    """The samples whose measure counts: it is there, and of a whole sample or of a stop."""
    there = np.isfinite(rows.measures[:, at])
    whole = np.isin(rows.codes, WHOLE) | prepared.measures[at].of_stops
    return there & whole


def _summaries(prepared: PreparedStudy, rows: Rows) -> list[dict[str, Any]]:
    """Of each measure: how many samples have it, mean, spread, ends, quantiles with limits."""
    results = []
    for at, column in enumerate(prepared.measures):
        y = rows.measures[_counted(prepared, rows, at), at]
        about = {"name": column.name, "unit": column.unit, "samples": int(y.size)}
        if y.size:
            about |= {"mean": y.mean(), "std": y.std(ddof=1) if y.size > 1 else None}
            about |= {"least": y.min(), "most": y.max()}
            about["quantiles"] = [
                statistics.quantile(y, share)._asdict() for share in statistics.QUANTILES
            ]
        results.append(about)
    return results


def _met(prepared: PreparedStudy, rows: Rows, target: Mapping[str, Any]) -> np.ndarray:
    """The samples that keep to a target; one without the measure does not."""
    at = [column.name for column in prepared.measures].index(target["measure"])
    y = np.where(_counted(prepared, rows, at), rows.measures[:, at], np.nan)
    with np.errstate(invalid="ignore"):
        return (y <= target.get("at_most", math.inf)) & (y >= target.get("at_least", -math.inf))


def _targets(prepared: PreparedStudy, rows: Rows) -> list[dict[str, Any]]:
    size = rows.codes.size
    return [
        {**target, **statistics.share(int(_met(prepared, rows, target).sum()), size)._asdict()}
        for target in prepared.targets
    ]


MOST_GROUPS = 400


def _groups(prepared: PreparedStudy, rows: Rows) -> list[dict[str, Any]]:
    """Of each combination of listed values: medians, upper quantiles, shares that keep to targets;
    nothing where there is one combination, or too many to read.
    """
    design = prepared.design
    if not 1 < design.combinations <= MOST_GROUPS:
        return []
    keys, result = [item.key for item in design.listed], []
    met = [_met(prepared, rows, target) for target in prepared.targets]
    for g in range(design.combinations):
        span = slice(g * design.points, (g + 1) * design.points)
        inputs = design.inputs(g * design.points)[: len(keys)]
        measures = []
        for at in range(len(prepared.measures)):
            y = rows.measures[span, at][_counted(prepared, rows, at)[span]]
            ends = np.quantile(y, (0.5, 0.95)).tolist() if y.size else [None, None]
            maximum = float(y.max()) if y.size else None
            mean = float(y.mean()) if y.size else None
            measures.append(
                {
                    "samples": int(y.size),
                    "mean": mean,
                    "median": ends[0],
                    "q95": ends[1],
                    "most": maximum,
                }
            )
        result.append(
            {
                "values": dict(zip(keys, map(label_of, inputs), strict=True)),
                "cells": design.cells(design.inputs(g * design.points))[: len(keys)],
                "samples": design.points,
                "whole": int(np.isin(rows.codes[span], WHOLE).sum()),
                "measures": measures,
                "targets": [
                    statistics.share(int(item[span].sum()), design.points)._asdict() for item in met
                ],
            }
        )
    return result


def _sensitivity(prepared: PreparedStudy, rows: Rows) -> list[dict[str, Any]]:
    """Of each measure, how much each input moves it."""
    design, recipe = prepared.design, prepared.recipe
    varied = [
        i
        for i, item in enumerate(design.columns)
        if item.varied != "seed" and np.ptp(rows.inputs[:, i]) > 0.0
    ]
    results = []
    for at, column in enumerate(prepared.measures):
        mask = _counted(prepared, rows, at)
        y, keys = rows.measures[mask, at], [design.columns[i].key for i in varied]
        if not keys or y.size < 10 or np.ptp(y) == 0.0:
            continue
        explained, way = None, "rank"
        if recipe.design == "saltelli" and design.combinations == 1 and mask.all():
            drawn = [item.key for item in design.drawn]
            table = statistics.sobol(drawn, y, recipe.samples, recipe.seed)
            way = "sobol"
        else:
            x = rows.inputs[mask]
            columns = [
                statistics.scores(x[:, i], y) if design.columns[i].is_text else x[:, i]
                for i in varied
            ]
            table, explained = statistics.rank_regression(keys, np.stack(columns, axis=1), y)
        results.append(
            {
                "measure": column.name,
                "way": way,
                "explained": explained,
                "inputs": [item._asdict() for item in table],
            }
        )
    return results


def _worst(prepared: PreparedStudy, rows: Rows) -> list[int]:
    """The samples to keep: the worst by the measure that decides, and the first of each that did
    not come to its end.
    """
    recipe = prepared.recipe
    names = [column.name for column in prepared.measures]
    first = prepared.targets[0]["measure"] if prepared.targets else names[0]
    name = recipe.worst or first
    if name not in names:
        raise InputError(
            f"'{name}' is no measure of this study",
            **recipe.at("worst"),
            hint="it has " + ", ".join(names),
        )
    at = names.index(name)
    low = any(
        t["measure"] == name and "at_least" in t and "at_most" not in t for t in prepared.targets
    )
    y = np.where(_counted(prepared, rows, at), rows.measures[:, at], np.nan)
    order = np.argsort(y if low else -y, kind="stable")
    picked = [int(i) for i in order[: recipe.keep] if np.isfinite(y[i])]
    for word in (STATUS[5], STATUS[2], STATUS[1]):
        if recipe.keep and word in rows.status and (i := rows.status.index(word)) not in picked:
            picked.append(i)
    return picked
