"""Whether a run is still supported by its files, recipe, inputs and method versions."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import isclose, nan
from pathlib import Path
from typing import Any

from ehbench.report.saved import Saved
from ehbench.runs import rundir
from ehbench.runs.rundir import read_json, sha256
from ehbench.runs.versions import outdated, read_versions
from ehbench.vocabulary import EhbenchError, Message, message


@dataclass(frozen=True)
class Source:
    """What a run read: role, name in ``run.json``, where it is now, its SHA-256 then."""

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

    def as_json(self) -> dict[str, Any]:
        """Plain values for scripts."""
        place = self.place and str(self.place)
        about = {"role": self.role, "path": self.name, "place": place}
        return about | {"sha256": self.sha256, "same": self.is_same}

    @property
    def run(self) -> Path | None:
        """The folder of the run that wrote it, if one did."""
        if self.place is None:
            return None
        folder = self.place if self.place.is_dir() else self.place.parent
        return folder if (folder / "run.json").is_file() else None


class TracedRun:
    """A run folder with the files it was made from, located again.

    Raises:
        InputError: the folder holds no run."""

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
        facts = self.run.facts.get("recipe", {})
        name, digest = facts.get("path", ""), facts.get("sha256", "")
        places = [*self._noted("recipe"), *self._noted("argv")]
        places = [place for place in places if place.name == name]
        return Source("recipe", name, _existing([*places, self.folder.parent / name]), digest)

    @cached_property
    def sources(self) -> list[Source]:
        """The files it read, in order."""
        noted = self._noted("inputs")
        base = self.recipe.place.parent if self.recipe.place else self.folder.parent
        sources = []
        for index, item in enumerate(self.run.facts.get("inputs", [])):
            name = item["path"]
            places = [*noted[index : index + 1], base / name, self.folder.parent / name]
            sources.append(Source(item["role"], name, _existing(places), item["sha256"]))
        return sources

    def _noted(self, key: str) -> list[Path]:
        value = self._volatile.get(key)
        values = value if isinstance(value, list) else [value]
        return [Path(text) for text in values if isinstance(text, str)]

    def fit_beside(self, rig: Source, name: str, value: float) -> Path | None:
        """The fit in the same folder of runs that a parameter's value [SI] is from where the rig
        file may be a copy; before others one that left the same file."""
        fits = []
        for path in self.folder.parent.glob("*/parameters.json"):
            try:
                run = Saved(path.parent)
                rows = {row["name"]: row["value"] for row in run.json(path.name)["parameters"]}
                if run.stage == "identify" and isclose(rows.get(name, nan), value):
                    same = run.facts["outputs"].get("rig.toml") == rig.sha256
                    fits.append((not same, path.parent))
            except (EhbenchError, TypeError):
                continue  # what is no run of this version has fitted nothing
        return min(fits)[1] if fits else None

    def changes(self) -> list[Message]:
        """What no longer supports the results of this run and of the runs that it read."""
        return list(dict.fromkeys(_changes(self, set())))


def unsupported(folder: Path) -> list[Message]:
    """What no longer supports a run, by the checksums that can be taken."""
    changes = TracedRun(folder).changes()
    return [change for change in changes if change.key != "report.input_missing"]


def _existing(places: Iterable[Path]) -> Path | None:
    return next((place for place in places if place.is_file() or place.is_dir()), None)


def _changes(traced: TracedRun, seen: set[Path]) -> Iterator[Message]:
    seen.add(traced.folder.resolve())
    facts, name = traced.run.facts, traced.folder.name
    plain = dict(facts)
    inputs = [(item["role"], item["sha256"]) for item in facts["inputs"]]
    digest = rundir.run_hash(facts["recipe"]["sha256"], inputs, read_versions(plain))
    old = outdated(plain)
    if digest != facts["hash"] or plain.pop("checksum", None) != rundir.checksum(plain):
        yield message("report.output_changed", run=name, file="run.json")
    for file, digest in rundir.outputs_of(traced.folder / "run.json").items():
        path = traced.folder / file
        if not path.is_file() or sha256(path) != digest:
            yield message("report.output_changed", run=name, file=file)
    if old:
        yield message("report.methods_changed", run=name, methods=", ".join(old))
    for source in (traced.recipe, *traced.sources):
        fields = {"run": name, "role": source.role, "name": source.name}
        if source.place is None:
            yield message("report.input_missing", **fields)
        elif not source.is_same:
            yield message("report.input_changed", **fields)
        folder = source.run
        if folder is not None and folder.resolve() not in seen:
            try:
                yield from _changes(TracedRun(folder), seen)
            except EhbenchError as error:
                yield message("report.input_unreadable", **fields, reason=error.message)
