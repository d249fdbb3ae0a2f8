"""A walk over a recipe and all recipes behind it, each prepared once and none run."""

from __future__ import annotations

from pathlib import Path

from ehbench import rundir
from ehbench.errors import InputError
from ehbench.recipe import Recipe, load_recipe
from ehbench.stages import stage_of
from ehbench.stages.base import Prepared, Stage
from ehbench.stages.findings import STANDS, Findings
from ehbench.stages.inputs import Inputs


class Circle(InputError):
    """A recipe needs itself (exit 2)."""

    @classmethod
    def of(cls, walk: list[Path], path: Path) -> Circle:
        """The circle that a walk over recipes closes at ``path``."""
        names = " → ".join(one.name for one in [*walk[walk.index(path) :], path])
        hint = "name a rig file or a run folder where the circle shall end"
        return cls(f"needs itself: {names}", file=path, hint=hint)


class Look:
    """What a check finds, recipe by recipe; runs that stand under ``root`` are taken."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._found: dict[Path, Findings] = {}
        self._standing: dict[Path, Path] = {}
        self._walk: list[Path] = []

    def at(self, recipe: Recipe) -> Findings:
        """What is to be said of a recipe.

        Raises:
            InputError: it needs itself.
        """
        path = recipe.path
        if path in self._walk:
            raise Circle.of(self._walk, path)
        if path in self._found:
            return self._found[path]
        found = self._found[path] = Findings(recipe, collects=True)
        stage, prepared = stage_of(recipe), None
        self._walk.append(path)
        with found.noting():
            prepared = stage.prepare(recipe, Inputs(recipe, found, self, allow_code=True))
            found.does = prepared.does
        self._walk.pop()
        if isinstance(stage, Stage):
            found.writes = f"{self._place(found, prepared)}: {stage.writes}"
        return found

    def _place(self, found: Findings, prepared: Prepared | None) -> str:
        """The run folder of a recipe, as far as its name is known."""
        open_yet = found.first or found.errors or found.refused
        if prepared is None or prepared.inputs is None or open_yet:
            return f"{self.root / found.recipe.name}_<hash>"
        folder = rundir.place(found.recipe.path, prepared.inputs, self.root)
        if rundir.is_whole(folder):
            found.stands = True
            self._standing[found.recipe.path] = folder
            return f"{folder}, {STANDS}"
        return str(folder)

    def findings(self, path: Path) -> Findings:
        """`Runs.findings`: what is to be said of a recipe file."""
        return self.at(load_recipe(path))

    def folder(self, path: Path, found: Findings) -> Path | None:
        """`Runs.folder`: the run of a recipe that ``found.recipe`` names; without one, that and its
        mistakes are noted.
        """
        behind = self.findings(path)
        if path in self._standing:
            return self._standing[path]
        for error in behind.errors:
            if isinstance(error, Circle):
                raise error
            found.mistake(error)
        found.say("losses", *behind.losses)
        shown = found.shown(path)
        found.say("first", *(found.shown(behind.recipe.file(name)) for name in behind.first), shown)
        if behind.refused:
            found.say("notes", f"'{shown}' is refused as it stands: {behind.refused}")
        return None
