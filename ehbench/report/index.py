"""Which figures a run has: the index that grows as they are drawn."""

import re
from pathlib import Path
from typing import Any

from ehbench.runs.rundir import write_json
from ehbench.vocabulary.text import unlike

INDEX = "index.json"


class FigureIndex:
    """The figures of a run folder as they are drawn: hands out file names that do not collide.

    A figure's ``key`` is what a campaign names it by; ``about`` says what it shows: by these words
    a section finds it again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "figures"
        self.figures: list[dict[str, Any]] = []

    def add(self, key: str, title: str, caption: str, kind: str, **about: str) -> Path:
        """The path to draw the figure ``key`` to."""
        taken = {figure["file"].removesuffix(".svg") for figure in self.figures}
        file = unlike(re.sub(r"[^A-Za-z0-9_.-]+", "_", key), taken) + ".svg"
        shows = {"kind": kind, **about}
        row = {"file": file, "key": key, "title": title, "caption": caption, "about": shows}
        self.figures.append(row)
        return self.folder / file

    def save(self) -> None:
        """Write the index beside the figures."""
        write_json(self.folder / INDEX, {"figures": self.figures})
