"""What preparing a recipe finds: what it reads, what a check leaves undecided, what is wrong."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ehbench.config.recipe import Recipe
from ehbench.stages.relocation import relative
from ehbench.vocabulary import EhbenchError


@dataclass
class Notes:
    """What preparing a recipe found; a run stops at the first error, a dry run collects them all.

    Attributes:
        recipe: prepared.
        dry_run: whether it is checked only.
        does: what the run does.
        writes: its folder and files.
        refused: why the run is refused unless the user insists.
        is_current: whether its run exists.
        reads: files and runs.
        required: recipes to be run before.
        remarks: what is worth knowing.
        undecided: what only a run can tell.
        losses: data that are lost.
        errors: what the run would stop at.
        options: of the command, without which the run is refused.
        tried: logs that were read, or could not be."""

    recipe: Recipe
    dry_run: bool = False
    does: str = ""
    writes: str = ""
    refused: EhbenchError | None = None
    is_current: bool = False
    reads: list[str] = field(default_factory=list)
    required: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    undecided: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    errors: list[EhbenchError] = field(default_factory=list)
    options: set[str] = field(default_factory=set)
    tried: set[Path] = field(default_factory=set)

    def add(self, kind: str, *texts: str) -> None:
        """Add texts to ``reads``, ``required``, ``remarks``, ``undecided``, ``losses``, once."""
        lines: list[str] = getattr(self, kind)
        lines += [text for text in dict.fromkeys(texts) if text not in lines]

    @contextmanager
    def collected(self) -> Iterator[None]:
        """A dry run collects the errors of the block and goes on after it; a run stops."""
        try:
            yield
        except EhbenchError as error:
            if not self.dry_run:
                raise
            self.add_error(error)

    def add_error(self, error: EhbenchError) -> None:
        """Add an error and those with it, once; without a place it gets its line of this recipe."""
        others = error.others
        if error.file is None or (error.line is None and error.file == str(self.recipe.path)):
            line = line_naming(self.recipe.path, error.message)
            error = type(error)(error.message, file=self.recipe.path, line=line, hint=error.hint)
        if str(error) not in map(str, self.errors):
            self.errors.append(error)
        for other in others:
            self.add_error(other)

    def refuse(self, error: EhbenchError, remark: str) -> None:
        """A run stops with ``error``; a dry run notes it and goes on: the user may insist."""
        if not self.dry_run:
            raise error
        self.refused = error
        self.add("remarks", remark)

    def name_of(self, path: Path) -> str:
        """A file as the recipe would name it; a run folder as the user would."""
        if path.is_dir():
            return str(path)
        return relative(path, self.recipe.path.parent)


def line_naming(path: Path, message: str) -> int | None:
    """The first line of a recipe that has a quoted word of a message, the last word first; None
    where none has, or the recipe is no file."""
    if not path.is_file():
        return None
    lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()
    for word in reversed(re.findall(r"'([^']+)'", message)):
        known = re.compile(rf"""["']{re.escape(word)}["']|(?<![\w.-]){re.escape(word)}\s*=""")
        for number, line in enumerate(lines, 1):
            if known.search(line.partition("#")[0]):
                return number
    return None
