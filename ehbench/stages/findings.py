"""What is to be said of a recipe beside what it makes: what it reads, what is open or wrong."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sized
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ehbench.config.recipe import Recipe
from ehbench.vocabulary.errors import EhbenchError

STANDS = "which stands"


@dataclass
class Findings:
    """What preparing a recipe found; a run stops at the first mistake, a check (``collects``) keeps
    them all.

    ``first`` are recipes to be run before, ``open`` what only a run can tell, ``losses`` data that
    are gone, ``refused`` why a run of this recipe is refused unless the user insists, ``stands``
    whether its run is there."""

    recipe: Recipe
    collects: bool = False
    does: str = ""
    writes: str = ""
    refused: str = ""
    stands: bool = False
    reads: list[str] = field(default_factory=list)
    first: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    errors: list[EhbenchError] = field(default_factory=list)

    def say(self, kind: str, *texts: str) -> None:
        """Add sentences to ``reads``, ``first``, ``notes``, ``open`` or ``losses``, each once."""
        lines: list[str] = getattr(self, kind)
        lines += [text for text in dict.fromkeys(texts) if text not in lines]

    @contextmanager
    def noting(self) -> Iterator[None]:
        """A check keeps mistakes found inside and goes on behind; a run stops at them."""
        try:
            yield
        except EhbenchError as error:
            if not self.collects:
                raise
            self.mistake(error)

    def mistake(self, error: EhbenchError) -> None:
        """Keep a mistake, once; one that does not say where it stands is placed in this recipe."""
        if error.file is None or (error.line is None and error.file == str(self.recipe.path)):
            line = line_naming(self.recipe.path, error.message)
            error = type(error)(error.message, file=self.recipe.path, line=line, hint=error.hint)
        if str(error) not in map(str, self.errors):
            self.errors.append(error)

    def refuse(self, error: EhbenchError, why: str, note: str) -> None:
        """A run stops with ``error``; a check says ``note`` and goes on: the user may insist."""
        if not self.collects:
            raise error
        self.refused = why
        self.say("notes", note)

    def shown(self, path: Path) -> str:
        """A file as the recipe would name it; a run folder as the user would."""
        return shown_path(self.recipe, path)


def shown_path(recipe: Recipe, path: Path) -> str:
    """A file as ``recipe`` would name it; a run folder as the user would."""
    if path.is_dir():
        return str(path)
    return Path(os.path.relpath(path, recipe.path.parent)).as_posix()


def counted(items: Sized, word: str) -> str:
    """``3 logs``, ``1 log``."""
    return f"{len(items)} {word}{'s' * (len(items) != 1)}"


def line_naming(path: Path, message: str) -> int | None:
    """The first line of a recipe that has one of the quoted words of a message as a text or key,
    the last word first.
    """
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    for word in reversed(re.findall(r"'([^']+)'", message)):
        known = re.compile(rf"""["']{re.escape(word)}["']|(?<![\w.-]){re.escape(word)}\s*=""")
        for number, line in enumerate(lines, 1):
            if known.search(line.partition("#")[0]):
                return number
    return None
