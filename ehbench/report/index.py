"""Which figures a run has: the index that grows as they are drawn, and the key by which a section
finds them again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from ehbench.runs.rundir import write_json

INDEX = "index.json"


@dataclass(frozen=True)
class FigureKey:
    """What a figure shows; None: does not apply. As a question, None takes any figure.

    ``counts`` is ``yes`` or ``no``: whether an operating point weighs in the choice of a gain.
    """

    kind: str | None = None
    valve: str | None = None
    direction: str | None = None
    log: str | None = None
    case: str | None = None
    payload: str | None = None
    motion: str | None = None
    function: str | None = None
    counts: str | None = None
    cylinder: str | None = None

    @classmethod
    def of(cls, about: Mapping[str, Any]) -> FigureKey:
        """The key that an index holds; words this version does not know are passed over."""
        return cls(**{item.name: about[item.name] for item in fields(cls) if item.name in about})

    def as_json(self) -> dict[str, str]:
        """What the index says of the figure."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def takes(self, other: FigureKey) -> bool:
        """Whether a figure answers this question."""
        offered = other.as_json()
        return all(offered.get(name) == value for name, value in self.as_json().items())


@dataclass(frozen=True)
class Figure:
    """A figure in a run's index. ``key`` is what a campaign names it by; ``about`` says what it
    shows, for the page.
    """

    file: str
    key: str
    title: str
    caption: str = ""
    about: dict[str, str] = field(default_factory=dict)


class FigureIndex:
    """The figures of a run folder as they are drawn: hands out file names that do not collide."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "figures"
        self.figures: list[Figure] = []

    def add(self, key: str, title: str, caption: str, about: FigureKey) -> Path:
        """The path to draw the figure ``key`` to."""
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", key)
        taken = {figure.file for figure in self.figures}
        file = next(
            name
            for i in range(len(taken) + 1)
            if (name := f"{stem}{f'_{i + 1}' if i else ''}.svg") not in taken
        )
        self.figures.append(Figure(file, key, title, caption, about.as_json()))
        return self.folder / file

    def save(self) -> None:
        """Write the index beside the figures."""
        write_json(self.folder / INDEX, {"figures": [asdict(figure) for figure in self.figures]})
