"""A walk over a recipe and all recipes behind it, each prepared once and none run."""

from __future__ import annotations

from pathlib import Path

from ehbench.config.recipe import Recipe, load_recipe
from ehbench.runs import rundir
from ehbench.stages.base import Prepared, Stage, stage_of
from ehbench.stages.findings import STANDS, Findings
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary.errors import InputError


class Circle(InputError):
    """A recipe needs itself (exit 2)."""

    @classmethod
    def of(cls, walk: list[Path], path: Path) -> Circle:
        """The circle that a walk over recipes closes at ``path``."""
        names = " → ".join(item.name for item in [*walk[walk.index(path) :], path])
        hint = "name a rig file or a run folder where the circle shall end"
        return cls(f"needs itself: {names}", file=path, hint=hint)


class Look:
    """What a check finds, recipe by recipe; runs that stand under ``root`` are taken."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._findings: dict[Path, Findings] = {}
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
        if path in self._findings:
            return self._findings[path]
        findings = self._findings[path] = Findings(recipe, collects=True)
        stage, prepared = stage_of(recipe), None
        self._walk.append(path)
        with findings.noting():
            prepared = stage.prepare(recipe, Inputs(recipe, findings, self, allow_code=True))
            findings.does = prepared.does
        self._walk.pop()
        if isinstance(stage, Stage):
            findings.writes = f"{self._place(findings, prepared, stage)}: {stage.writes}"
        return findings

    def _place(self, findings: Findings, prepared: Prepared | None, stage: Stage) -> str:
        """The run folder of a recipe, as far as its name is known."""
        open_yet = findings.first or findings.errors or findings.refused
        if prepared is None or prepared.inputs is None or open_yet:
            return f"{self.root / findings.recipe.name}_<hash>"
        folder = stage.default_place(prepared, self.root)
        if rundir.is_whole(folder):
            findings.stands = True
            self._standing[findings.recipe.path] = folder
            return f"{folder}, {STANDS}"
        return str(folder)

    def findings(self, path: Path) -> Findings:
        """`Runs.findings`: what is to be said of a recipe file."""
        return self.at(load_recipe(path))

    def folder(self, path: Path, findings: Findings) -> Path | None:
        """`Runs.folder`: the run of a recipe that ``findings.recipe`` names; without one, that and
        its mistakes are noted.
        """
        behind = self.findings(path)
        if path in self._standing:
            return self._standing[path]
        for error in behind.errors:
            if isinstance(error, Circle):
                raise error
            findings.mistake(error)
        findings.say("losses", *behind.losses)
        shown = findings.shown(path)
        findings.say(
            "first", *(findings.shown(behind.recipe.file(name)) for name in behind.first), shown
        )
        if behind.refused:
            findings.say("notes", f"'{shown}' is refused as it stands: {behind.refused}")
        return None
