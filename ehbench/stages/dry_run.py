"""A dry run prepares a recipe and all recipes that it needs, each once, and runs none."""

from functools import partial
from pathlib import Path
from typing import Self

from ehbench.config.recipe import DataFile, Recipe, load_recipe
from ehbench.runs import rundir
from ehbench.stages.base import Prepared, Stage, stage_of
from ehbench.stages.inputs import Inputs
from ehbench.stages.notes import Notes
from ehbench.vocabulary import InputError, message


class CircularRecipes(InputError):
    """A recipe needs itself (exit 2)."""

    @classmethod
    def of(cls, walk: list[Path], path: Path) -> Self:
        """The circle that a walk over recipes closes at ``path``."""
        names = " → ".join(item.name for item in [*walk[walk.index(path) :], path])
        return cls(message("stages.circle", names=names), file=path)


class DryRun:
    """The notes of each recipe; finished runs under ``root`` are used."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._notes: dict[Path, Notes] = {}
        self._finished: dict[Path, Path] = {}
        self._walk: list[Path] = []

    def check(self, recipe: Recipe | Path) -> Notes:
        """What a run of a recipe would find.

        Raises:
            InputError: it needs itself."""
        recipe = load_recipe(recipe) if isinstance(recipe, Path) else recipe
        path = recipe.path
        if path in self._walk:
            raise CircularRecipes.of(self._walk, path)
        if path in self._notes:
            return self._notes[path]
        notes = self._notes[path] = Notes(recipe, dry_run=True)
        stage, prepared = stage_of(recipe), None
        self._walk.append(path)
        with notes.collected():
            prepared = stage.prepare(recipe, self.inputs(notes))
            notes.does = prepared.does
        if prepared is None and getattr(recipe, "method", None) != "flowmeter":  # these are no logs
            entries = [e for e in getattr(recipe, "data", ()) if isinstance(e, DataFile)]
            with notes.collected():
                self.inputs(notes).try_files(entries)
        self._walk.pop()
        if stage.command:
            notes.writes = f"{self._place(notes, prepared, stage)}: {stage.writes}"
        return notes

    def inputs(self, notes: Notes) -> Inputs:
        """What the recipe of some notes takes in."""
        return Inputs(notes.recipe, notes, partial(self._run_of, notes), self.check, True)

    def _place(self, notes: Notes, prepared: Prepared | None, stage: Stage) -> str:
        """The run folder of a recipe, as far as its name is known."""
        incomplete = notes.required or notes.errors or notes.refused
        if prepared is None or prepared.inputs is None or incomplete:
            return f"{self.root / notes.recipe.name}_<hash>"
        folder = stage.default_place(prepared, self.root)
        if not rundir.is_whole(folder):
            return str(folder)
        notes.is_current = True
        self._finished[notes.recipe.path] = folder
        return message("stages.folder_is_current", name=str(folder))

    def _run_of(self, notes: Notes, path: Path) -> Path | None:
        """The run of a recipe that ``notes`` name; without one, that and its errors are noted."""
        upstream = self.check(path)
        if path in self._finished:
            return self._finished[path]
        for error in upstream.errors:
            if isinstance(error, CircularRecipes):
                raise error
            notes.add_error(error)
        notes.add("losses", *upstream.losses)
        notes.options |= upstream.options
        name = notes.name_of(path)
        required = (notes.name_of(upstream.recipe.file(item)) for item in upstream.required)
        notes.add("required", *required, name)
        if upstream.refused:
            notes.add_error(upstream.refused)
        return None
