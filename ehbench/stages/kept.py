"""Samples of a study as runs of their own: recipe, rig and bench file written out, so that they can
be opened, run again and changed.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ehbench.config.recipe import Recipe, TrialRecipe, load_recipe, read_toml
from ehbench.sampling.design import Design, label_of
from ehbench.sampling.keys import Changes, changed_bench, changed_table
from ehbench.stages.base import Outcome, Stage, stage_of
from ehbench.stages.findings import Findings
from ehbench.stages.inputs import Inputs
from ehbench.stages.samples import Plan, Sampler, _Base
from ehbench.vocabulary.errors import EhbenchError
from ehbench.vocabulary.progress import Progress

# keys of a recipe that name files
_FILES = ("rig", "flow_maps", "bench", "file", "path", "from", "gains", "columns")
_LISTS = ("data", "beside")


def keep(
    plan: Plan, design: Design, indices: Sequence[int], folder: Path, progress: Progress | None
) -> list[dict[str, Any]]:
    """Run samples once more, each into a folder of its own below ``folder``; what became of each:
    its number, folder, and why there is none.
    """
    retained = []
    for index in indices:
        if progress is not None:
            progress(f"keeping sample {index}", 0.9)
        place, message = folder / str(index), ""
        place.mkdir(parents=True)
        try:
            recipe = write_sample(plan, design, index, place)
            run_sample(plan, recipe, place / "run")
        except EhbenchError as error:
            message = error.message
        retained.append(
            {"sample": index, "folder": f"{folder.name}/{index}/run", "message": message}
        )
    return retained


def write_sample(plan: Plan, design: Design, index: int, folder: Path) -> Path:
    """The files of a sample: its recipe, whose path comes back, the recipes behind it that it
    changes, rigs and bench files with its numbers.

    Raises:
        EhbenchError: they cannot be made, as the sample itself.
    """
    with TemporaryDirectory() as scratch:
        sampler = Sampler(plan, Path(scratch))
        base, changes = sampler.changes(design.settings(index))
        place = folder / f"sample_{index}.toml"
        writer = _Writer(sampler, base, changes, place, Path(scratch))
        note = ", ".join(
            f"{column.key} = {label_of(value)}"
            for column, value in zip(design.columns, design.inputs(index), strict=True)
        )
        return writer.write(base, f"sample {index} of a study: {note}")


def run_sample(plan: Plan, path: Path, out: Path) -> Outcome:
    """Run a sample's recipe.

    Raises:
        EhbenchError: as the run.
    """
    recipe = load_recipe(path)
    stage = stage_of(recipe)
    assert isinstance(stage, Stage)  # a study is of such ones only
    host = _Host(plan, out)
    allowed = {"allow_code": plan.allow_code, "unvalidated": True}
    prepared = stage.prepare(recipe, Inputs(recipe, Findings(recipe), host, **allowed))
    built = stage.run(prepared, host)
    (out / "volatile.json").unlink()
    return built


@dataclass(frozen=True)
class _Host:
    """Where a kept sample runs; recipes behind it that are its own run beside it."""

    plan: Plan
    out: Path
    keep: bool = False
    resume: bool = False
    made: dict[Path, Path] = field(default_factory=dict)

    @property
    def root(self) -> Path:
        return self.out.parent

    def tell(self, name: str) -> Progress | None:
        """Nothing is told."""

    def outcome_of(self, path: Path) -> Outcome:
        """As `Host.outcome_of`."""
        return Outcome(self.folder(path, Findings(load_recipe(path))))

    def folder(self, path: Path, findings: Findings) -> Path:
        """As `Runs.folder`."""
        if path in self.plan.runs:
            return self.plan.runs[path]
        if path not in self.made:
            self.made[path] = run_sample(self.plan, path, self.root / f"{path.stem}_run").folder
        return self.made[path]

    def findings(self, path: Path) -> None:
        """As `Runs.findings`: nothing, in a run."""


class _Writer:
    """Writes the files of one sample."""

    def __init__(
        self,
        sampler: Sampler,
        base: _Base,
        changes: Mapping[str, Changes],
        place: Path,
        scratch: Path,
    ) -> None:
        self._sampler, self._base, self._changes = sampler, base, changes
        self._folder, self._name, self._scratch = place.parent, place.stem, scratch
        self._written: dict[Any, str] = {}

    def write(self, base: _Base, note: str = "") -> Path:
        """A recipe as the sample has it, with all that it names."""
        import tomli_w

        stem = base.stem_of(base.model)
        changes = self._changes.get(stem, Changes())
        table = changed_table(base.table, changes.recipe, "recipe")
        if changes.bench and "bench" not in table:
            table["bench"] = ""
        table = self._moved(table, base.model, changes)
        if note:
            table["note"] = note
        path = self._folder / f"{stem or self._name}.toml"
        path.write_text(tomli_w.dumps(table), encoding="utf-8")
        for code in _code_of(base, self._sampler.plan):
            shutil.copyfile(code, self._folder / code.name)
        return path

    def _moved(self, here: Any, recipe: Recipe, changes: Changes, key: str = "") -> Any:
        """A table of a recipe as it names its files from the sample's folder."""
        if isinstance(here, dict):
            moved = {name: self._moved(v, recipe, changes, name) for name, v in here.items()}
            if "rig" in here and changes.rig:
                moved |= self._rig(here["rig"], here.get("flow_maps"), recipe, changes)
            if "bench" in here and changes.bench:
                moved["bench"] = self._bench(recipe, here, changes)
            return moved
        if isinstance(here, list):
            inner = key if key in _LISTS else ""
            return [self._moved(item, recipe, changes, inner) for item in here]
        if isinstance(here, str) and key in (*_FILES, *_LISTS) and "$" not in here:
            return self._named(here, recipe)
        return here

    def _named(self, name: str, recipe: Recipe) -> str:
        """A file of a recipe as it is named from the sample's folder; a recipe behind that is not
        as its file any more is written there.
        """
        path = recipe.file(name) if name else None
        if path is None or not path.exists():
            return name
        changed = set(self._changes) - {""}
        if path.suffix == ".toml" and path in self._base.behind.values():
            behind = _Base.of(path)
            if not changed.isdisjoint({path.stem, *behind.behind}):
                if path not in self._written:
                    self._written[path] = self.write(behind).name
                return self._written[path]
        return Path(os.path.relpath(path, self._folder.resolve())).as_posix()

    def _rig(self, rig: str, maps: str | None, recipe: Recipe, changes: Changes) -> dict[str, str]:
        """A rig with the sample's numbers, and where its flow maps are."""
        from ehbench.stages.base import write_rig

        inputs = self._sampler.inputs(recipe, self._base, self._changes, self._scratch)
        state = inputs.rig_state(rig, maps)
        name = self._written.setdefault((rig, maps), f"rig{len(self._written) or ''}")
        place = self._folder / name
        place.mkdir(exist_ok=True)
        write_rig(place, state.rig, state.flow_maps)
        moved = {"rig": f"{name}/rig.toml"}
        return moved | ({"flow_maps": name} if state.flow_maps is not None else {})

    def _bench(self, recipe: Recipe, here: Mapping[str, Any], changes: Changes) -> str:
        """A bench file with the sample's numbers."""
        import tomli_w

        given = here["bench"]
        source = recipe.file(given) if given else recipe.path
        table = read_toml(source)[0] if given else {"stage": "bench", "rig": here["rig"]}
        table["rig"] = os.path.relpath(
            (source.parent / str(table["rig"])).resolve(), self._folder.resolve()
        )
        built = changed_bench(table, changes.bench, source)
        (self._folder / "bench.toml").write_text(tomli_w.dumps(built), encoding="utf-8")
        return "bench.toml"


def _code_of(base: _Base, plan: Plan) -> tuple[Path, ...]:
    from ehbench import trial

    if not isinstance(base.model, TrialRecipe):
        return ()
    additional = [code for code in trial.code_files(base.model) if code.parent == base.path.parent]
    return tuple(additional)
