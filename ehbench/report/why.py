"""Where a number of a run comes from: interval, method, windows, logs with SHA-256, recipe line,
rig line and source, and whether all of it still stands as it was."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ehbench.config.recipe.toml import line_of, read_toml
from ehbench.config.rig import Rig
from ehbench.report.bearing import Made, Source
from ehbench.report.claims import Claim, claim_of
from ehbench.report.saved import Saved
from ehbench.report.words import (
    estimate,
    interval,
    number,
    pretty,
    row_of,
    shown,
    unit_of,
    words,
)
from ehbench.runs.rundir import SHIPPED
from ehbench.vocabulary.errors import EhbenchError, InputError

# how each kind of run comes to its numbers, and the page of the docs that says it in full
_METHODS = {
    "flow_map": (
        "penalised splines through the means of repeated readings",
        "explanation/flow_maps.md",
    ),
    "hydraulics": (
        "the model simulated along the logs, fitted to them",
        "explanation/identification.md",
    ),
    "profile": ("fits of all else with the parameter held", "explanation/identification.md"),
    "response": ("averaged spectra of the logs", "explanation/frequency_response.md"),
    "validation": (
        "the identified rig simulated along logs it was not fitted to",
        "explanation/validation.md",
    ),
    "tuning": ("root loci over postures, loads and functions", "explanation/tuning.md"),
    "trial": ("measured on the trial's own log", "howto/run_trials.md"),
    "trials": ("measured on the logs of the trials", "howto/run_trials.md"),
}
_ERRORS = {
    "hac": "intervals from the covariance of correlated residuals",
    "acf": "intervals from the residuals' own autocovariance",
    "jackknife": "intervals from leaving out one log at a time",
    "range": "the interval is what the logs do not deny of the range; within it all is one to them",
}


@dataclass(frozen=True)
class Place:
    """A line of a file, and what stands there; ``source``: where its number is from."""

    file: str
    line: int
    text: str
    source: str = ""


@dataclass(frozen=True)
class Why:
    """Where a number comes from; ``marks`` say what no longer bears it."""

    run: str
    claim: Claim
    shown: str
    method: tuple[str, ...]
    windows: tuple[str, ...]
    sources: tuple[Source, ...]
    recipe: Place | None
    rig: Place | None
    marks: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values for scripts, numbers in SI."""
        return {
            "run": self.run,
            "name": self.claim.path,
            "file": self.claim.file,
            "value": self.claim.value,
            "unit": self.claim.unit,
            "interval": self.claim.interval,
            "about": dict(self.claim.about),
            "method": list(self.method),
            "windows": list(self.windows),
            "inputs": [
                {
                    "role": source.role,
                    "path": source.name,
                    "place": None if source.place is None else str(source.place),
                    "sha256": source.sha256,
                    "same": source.is_same,
                }
                for source in self.sources
            ],
            "recipe": None if self.recipe is None else vars(self.recipe),
            "rig": None if self.rig is None else vars(self.rig),
            "marks": list(self.marks),
        }

    def lines(self) -> Iterator[str]:
        """The same to read."""
        state = "NO LONGER BORNE: " if self.marks else ""
        yield f"{state}{self.claim.path} = {self.shown}"
        yield f"  stands in   {self.run}/{self.claim.file}"
        for label, texts in (("method", self.method), ("window", self.windows)):
            yield from (f"  {label:11} {text}" for text in texts)
        for item in self.sources:
            state = "" if item.is_same else "  (not as it was read)"
            yield f"  {item.role:11} {item.name}  SHA-256 {item.sha256}{state}"
        for label, place in (("recipe line", self.recipe), ("rig line", self.rig)):
            if place is not None:
                source = f"  source: {place.source}" if place.source else ""
                yield f"  {label:11} {place.file}:{place.line}: {place.text}{source}"
        yield from (f"  mark        {mark}" for mark in self.marks)


def why(name: str, folder: Path) -> Why:
    """Where the number ``name`` of a run comes from; of a report, that of the run in it which has
    it.

    Raises:
        InputError: no run, no number of that name, or several.
    """
    built, marks = Made(folder), []
    if built.run.stage == "report":
        marks = built.marks()
        built = _run_with(name, built)
    claim = claim_of(built.run, name)
    rig = next((source for source in built.sources if source.role == "rig"), None)
    return Why(
        run=str(built.folder),
        claim=claim,
        shown=_shown(built.run, claim),
        method=tuple(_method(built.run, claim)),
        windows=tuple(_windows(built)),
        sources=tuple(built.sources),
        recipe=_recipe_line(built, claim),
        rig=None if rig is None else _rig_line(rig, claim),
        marks=tuple(dict.fromkeys([*marks, *built.marks()])),
    )


def _run_with(name: str, report: Made) -> Made:
    """The run of a report that has a number of that name.

    Raises:
        InputError: none has, or it is not there.
    """
    refusal: EhbenchError | None = None
    for source in report.sources:
        try:
            built = Made(source.place or report.folder.parent / source.name)
            claim_of(built.run, name)
            return built
        except EhbenchError as error:
            refusal = refusal if refusal and "several" in refusal.message else error
    raise refusal or InputError("holds no runs", file=report.folder)


def _shown(run: Saved, claim: Claim) -> str:
    """The number with its interval, in the rig's units where it is one of the rig's parameters."""
    if isinstance(claim.value, bool):
        return str(claim.value).lower()
    value, ends, unit = claim.value, claim.interval, claim.unit
    rig = _rig(run)
    if rig is not None and unit and row_of(claim.path).unit == unit:
        value, unit = float(shown(rig, claim.path, value)), unit_of(rig, claim.path)
        ends = ends and (
            float(shown(rig, claim.path, ends[0])),
            float(shown(rig, claim.path, ends[1])),
        )
    text = number(value) if ends is None else estimate(value, *ends)
    text = " ".join(part for part in (text, pretty(unit)) if part)
    if ends is not None:
        text += f"  (95 % interval {interval(*ends)})"
    status = claim.about.get("status")
    return text + (f", {words(status)}" if isinstance(status, str) else "")


def _rig(run: Saved) -> Rig | None:
    try:
        return run.rig
    except EhbenchError:
        return None


def _method(run: Saved, claim: Claim) -> Iterator[str]:
    text, page = _METHODS.get(str(run.what), ("", ""))
    message = run.facts.get("method")
    yield f"{run.stage} {words(str(run.what))}" + (f", {words(message)}" if message else "")
    if text:
        yield f"{text} (docs/{page})"
    about = claim.about
    if (kind := about.get("error_from")) in _ERRORS:
        yield _ERRORS[str(kind)]
    if about.get("prior") is not None:
        yield f"with a prior; {100 * float(about.get('from_data', 1.0)):.0f} % known from the data"
    if "samples" in about:
        yield f"from {about['samples']} samples"


def _windows(built: Made) -> Iterator[str]:
    """Which part of each log was read, by the recipe."""
    recipe = _table(built.recipe)
    data = recipe.get("data", ())
    for item in data if isinstance(data, list) else ():
        if isinstance(item, Mapping) and ("start" in item or "stop" in item):
            ends = [str(item.get(key, word)) for key, word in (("start", "begin"), ("stop", "end"))]
            yield f"{item.get('path', '?')}: {ends[0]} to {ends[1]}"
        else:
            yield f"{item.get('path', '?') if isinstance(item, Mapping) else item}: all of it"


def _table(source: Source) -> dict[str, Any]:
    """The table of a TOML file that is there as it was read; else empty."""
    if source.place is None or not source.is_same or source.place.suffix != ".toml":
        return {}
    try:
        return read_toml(source.place)[0]
    except (EhbenchError, tomllib.TOMLDecodeError):
        return {}


def _recipe_line(built: Made, claim: Claim) -> Place | None:
    """The line of the recipe that names the number, else the one that names its data."""
    source = built.recipe
    if source.place is None or not source.place.is_file():
        return None
    text = source.place.read_text(encoding="utf-8", errors="replace")
    rows = text.splitlines()
    tokens = [claim.path, f'"{claim.path.rpartition(".")[2]}"']
    for index, row in enumerate(rows, 1):
        if any(f'"{token.strip(chr(34))}"' in row.partition("#")[0] for token in tokens):
            return Place(source.name, index, row.strip())
    line = line_of(text, ("data",)) or line_of(text, ("stage",))
    return None if line is None else Place(source.name, line, rows[line - 1].strip())


def _rig_line(source: Source, claim: Claim) -> Place | None:
    """The line of the rig file that has the parameter, with the source it names."""
    place = source.place
    place = place / "rig.toml" if place is not None and place.is_dir() else place
    if place is None or not place.is_file():
        return None
    try:
        table, text = read_toml(place)
    except EhbenchError:
        return None
    required = claim.path.split(".")
    best: tuple[Any, ...] = ()
    result: Any = None
    for location, names, value in _leaves(table, (), ()):
        rated = required[-1].endswith("_gain") and names[-2:] == ("rated", "flow")
        if (rated or names[-1] == required[-1]) and set(required[:-1]) <= set(names):
            best, result = location, value
            break
    line = line_of(text, best) if best else None
    if line is None:
        return None
    message = result.get("source", "") if isinstance(result, Mapping) else ""
    name = place.name if SHIPPED in place.parents else source.name
    return Place(name, line, text.splitlines()[line - 1].strip(), str(message))


def _leaves(
    value: Any, location: tuple[Any, ...], names: tuple[str, ...]
) -> Iterator[tuple[tuple[Any, ...], tuple[str, ...], Any]]:
    """(location, names of the tables about it and its key, value) of every value of a rig file; a
    table with a value is one.
    """
    if isinstance(value, Mapping) and "value" not in value:
        own = (*names, value["name"]) if isinstance(value.get("name"), str) else names
        if own == names and names[-1:] == ("edge",):  # goes by its valve's name and its nodes
            own = (*names, f"{names[-2]}_{value.get('from')}_{value.get('to')}")
        for key, inside in value.items():
            yield from _leaves(inside, (*location, key), (*own, key))
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for index, inside in enumerate(value):
            yield from _leaves(inside, (*location, index), names)
    elif names:
        yield location, names, value
