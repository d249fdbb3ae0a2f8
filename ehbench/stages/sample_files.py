"""Samples of a study as runs, with all files, to be opened, run again and changed."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import tomli_w

from ehbench import trial
from ehbench.config.recipe import Recipe, TrialRecipe, load_recipe
from ehbench.report.provenance import TracedRun
from ehbench.runtime.disk import write_text
from ehbench.sampling.design import RECIPE, Design, label_of
from ehbench.sampling.keys import Changes, changed_table
from ehbench.stages.base import Host, Outcome, stage_of, write_rig
from ehbench.stages.inputs import Inputs
from ehbench.stages.notes import Notes
from ehbench.stages.relocation import name_from, relocated
from ehbench.stages.samples import Plan, RecipeFile, SampleFiles, Sampler, write_bench
from ehbench.vocabulary import EhbenchError, InputError, Progress, message


def run_samples(
    plan: Plan, design: Design, indices: Sequence[int], folder: Path, progress: Progress | None
) -> list[dict[str, Any]]:
    """Run samples again, each in a folder; (number, folder, why there is none) of each."""
    rows = []
    for index in indices:
        if progress is not None:
            progress(f"keeping sample {index}", 0.9)
        place, text = folder / str(index), ""
        place.mkdir(parents=True)
        try:
            _run(plan, write_sample(plan, design, index, place), place / "run", {})
        except EhbenchError as error:
            text = error.message
        name = f"{folder.name}/{index}/run"
        rows.append({"sample": index, "folder": name, "message": text})
    return rows


def _run(plan: Plan, path: Path, out: Path, runs: dict[Path, Path]) -> Outcome:
    """Run a written recipe; upstream recipes that were written with it run next to it."""

    def run_of(upstream: Path) -> Path:
        if upstream in plan.runs:
            return plan.runs[upstream]
        if upstream not in runs:
            place = out.parent / f"{upstream.stem}_run"
            runs[upstream] = _run(plan, upstream, place, runs).folder
        return runs[upstream]

    recipe = load_recipe(path)
    stage = stage_of(recipe)  # a study is of such only
    inputs = Inputs(recipe, Notes(recipe), run_of, allow_code=plan.allow_code, unvalidated=True)
    prepared = stage.prepare(recipe, inputs)
    outcome = stage.run(prepared, Host(root=out.parent, out=out))
    (out / "volatile.json").unlink()
    return outcome


def write_sample(plan: Plan, design: Design, index: int, folder: Path) -> Path:
    """The files of a sample: its recipe, whose path comes back, the upstream recipes that it
    changes, rigs and bench files with its numbers.

    Raises:
        EhbenchError: they cannot be created, as the sample itself."""
    with TemporaryDirectory() as scratch:
        sampler = Sampler(plan, Path(scratch))
        files = sampler.files(design.settings(index), Path(scratch))
        note = ", ".join(
            f"{column.key} = {label_of(value)}"
            for column, value in zip(design.columns, design.inputs(index), strict=True)
        )
        place = folder / f"sample_{index}.toml"
        writer = _Writer(sampler, files, folder)
        writer.write(files.base, place, f"sample {index} of a study: {note}")
        return place


@dataclass(frozen=True)
class _Writer:
    """Writes the files of one sample; ``written`` are the names of rigs and upstream recipes."""

    sampler: Sampler
    files: SampleFiles
    folder: Path
    written: dict[Any, str] = field(default_factory=dict)

    def write(self, file: RecipeFile, path: Path, note: str = "") -> None:
        """A recipe as the sample has it, with all that it names."""
        changes = self.files.changes_of(file.model)
        recipe = file.changed(Changes(recipe=changes.recipe), self.folder)
        before = changed_table(file.table, changes.recipe, RECIPE)
        table = relocated(before, lambda name: self._name(name, recipe))
        if changes.rig:
            self._put_rigs(table, before, recipe)
        if changes.bench:
            write_bench(recipe, changes.bench, self.folder / "bench.toml")
            table["bench"] = "bench.toml"
        if note:
            table["note"] = note
        write_text(path, tomli_w.dumps(table))
        if isinstance(recipe, TrialRecipe):
            for code in trial.code_files(recipe):
                if code.parent == file.path.parent:
                    shutil.copyfile(code, self.folder / code.name)

    def _name(self, name: str, recipe: Recipe) -> str:
        """A file as named from the sample's folder; a changed upstream recipe is written."""
        path = recipe.file(name) if name else None
        if path and path in self.files.base.upstream.values() and self.files.is_changed(path):
            if path not in self.written:
                self.written[path] = path.name
                self.write(RecipeFile.of(path), self.folder / path.name)
            return self.written[path]
        return name_from(self.folder, recipe, name)

    def _put_rigs(self, table: Any, before: Any, recipe: Recipe) -> None:
        """Write each rig that a table names with the sample's numbers, and its flow maps."""
        if isinstance(table, list):
            for item, old in zip(table, before, strict=True):
                self._put_rigs(item, old, recipe)
        if not isinstance(table, dict):
            return
        for name, inner in table.items():
            self._put_rigs(inner, before[name], recipe)
        if "rig" in table:
            rig, maps = before["rig"], before.get("flow_maps")
            state = self.sampler.inputs(recipe, self.files).rig_state(rig, maps)
            name = self.written.setdefault((rig, maps), f"rig{len(self.written) or ''}")
            (self.folder / name).mkdir(exist_ok=True)
            write_rig(self.folder / name, state.rig, state.flow_maps)
            table["rig"] = f"{name}/rig.toml"
            if state.flow_maps is not None:
                table["flow_maps"] = name


def load_study(study: Path) -> Path:
    """The recipe of a study or of its run folder.

    Raises:
        InputError: the run's recipe has changed since."""
    if not study.is_dir():
        return study
    run = TracedRun(study)
    if run.recipe.place is None or not run.recipe.is_same:
        raise InputError(message("stages.study_changed"), file=study)
    return run.recipe.place
