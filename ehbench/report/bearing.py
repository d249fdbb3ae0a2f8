"""Whether what a run says still stands on what it was made from: its own files, its recipe, the
files and runs it read, and the code."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ehbench.report.saved import Saved
from ehbench.runs import rundir
from ehbench.runs.rundir import read_json, sha256
from ehbench.runs.versions import outdated, read_versions
from ehbench.vocabulary.errors import EhbenchError


@dataclass(frozen=True)
class Source:
    """A file or run folder that a run read: its role, the name it goes by, where it is now (None:
    not found), and its SHA-256 at the time.
    """

    role: str
    name: str
    place: Path | None
    sha256: str

    @cached_property
    def is_same(self) -> bool:
        """Whether it is there as it was read."""
        try:
            return self.place is not None and sha256(self.place) == self.sha256
        except (EhbenchError, OSError):
            return False

    @property
    def run(self) -> Path | None:
        """The run folder behind it, if a run made it."""
        if self.place is None:
            return None
        folder = self.place if self.place.is_dir() else self.place.parent
        return folder if (folder / "run.json").is_file() else None


class Made:
    """A run folder with what it was made from, found again.

    Raises:
        InputError: the folder holds no run.
    """

    def __init__(self, folder: Path) -> None:
        self.run = Saved(folder)
        self.folder = self.run.folder
        try:
            volatile = read_json(self.folder / "volatile.json")
        except EhbenchError:
            volatile = {}
        self._volatile: dict[str, Any] = volatile if isinstance(volatile, dict) else {}

    @cached_property
    def recipe(self) -> Source:
        """Its recipe."""
        message = self.run.facts.get("recipe", {})
        name, digest = message.get("path", ""), message.get("sha256", "")
        typed = self._volatile.get("argv")
        typed = [text for text in typed if isinstance(text, str)] if isinstance(typed, list) else []
        places = [self._noted("recipe"), *(Path(text) for text in typed if Path(text).name == name)]
        places += [self.folder.parent / name] if name else []
        return Source("recipe", name, _first(places), digest)

    @cached_property
    def sources(self) -> list[Source]:
        """What it read, in order."""
        noted = self._volatile.get("inputs")
        noted = noted if isinstance(noted, list) else []
        base = self.recipe.place.parent if self.recipe.place else self.folder.parent
        results = []
        for index, item in enumerate(self.run.facts.get("inputs", [])):
            name = item["path"]
            places = [base / name, self.folder.parent / name]
            if index < len(noted) and isinstance(noted[index], str):
                places.insert(0, Path(noted[index]))
            results.append(Source(item["role"], name, _first(places), item["sha256"]))
        return results

    def _noted(self, key: str) -> Path | None:
        path = self._volatile.get(key)
        return Path(path) if isinstance(path, str) else None

    def marks(self) -> list[str]:
        """What no longer bears what the run says, a sentence each, runs behind it included."""
        return list(dict.fromkeys(_marks(self, set())))


def no_longer_bears(folder: Path) -> list[str]:
    """Which inputs of a run lie where they were and are not what it read, a sentence each."""
    there = [source for source in Made(folder).sources if source.place is not None]
    return [text for source in there for text in _changed(folder.name, source)]


def _first(places: list[Path | None]) -> Path | None:
    return next((place for place in places if place is not None and place.exists()), None)


def _marks(built: Made, seen: set[Path]) -> Iterator[str]:
    seen.add(built.folder.resolve())
    name = built.folder.name
    yield from _own(built)
    if old := outdated(built.run.facts.plain()):
        yield f"{name}: its results are of other versions of methods: {', '.join(old)}"
    for source in (built.recipe, *built.sources):
        yield from _changed(name, source)
        folder = source.run
        if folder is not None and folder.resolve() not in seen:
            try:
                yield from _marks(Made(folder), seen)
            except EhbenchError as error:
                yield f"{name}: the run behind its {source.role} cannot be read: {error.message}"


def _changed(name: str, source: Source) -> Iterator[str]:
    if source.place is None:
        yield f"{name}: its {source.role} '{source.name}' is not found: nothing shows that it bears"
    elif not source.is_same:
        yield (
            f"{name}: its {source.role} '{source.name}' is not what the run read "
            f"(SHA-256 was {source.sha256[:12]}…)"
        )


def _own(built: Made) -> Iterator[str]:
    """What in the run folder is not as the run wrote it."""
    facts, name = built.run.facts, built.folder.name
    plain = dict(facts.plain())
    inputs = [(item["role"], item["sha256"]) for item in facts["inputs"]]
    digest = rundir.run_hash(facts["recipe"]["sha256"], inputs, read_versions(plain))
    if digest != facts["hash"]:
        yield f"{name}: run.json names other inputs or versions than its hash"
    if plain.pop("checksum", None) != rundir.checksum(plain):
        yield f"{name}: run.json is not as the run wrote it"
    for file, wrote in rundir.outputs_of(built.folder / "run.json").items():
        path = built.folder / file
        if not path.is_file():
            yield f"{name}: '{file}' is gone"
        elif sha256(path) != wrote:
            yield f"{name}: '{file}' is not as the run wrote it"
