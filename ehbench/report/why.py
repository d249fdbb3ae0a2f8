"""Where a number of a run comes from: interval, method, windows, logs with SHA-256, recipe line,
rig line and source, and whether all of it is unchanged."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ehbench.config.recipe.toml import line_of, read_toml
from ehbench.report.blocks import Grid
from ehbench.report.named_results import NamedResult, named_result
from ehbench.report.provenance import Source, TracedRun
from ehbench.report.saved import Saved
from ehbench.report.words import estimate, interval, number, pretty, row_of, shown, unit_of, words
from ehbench.runs.rundir import SHIPPED
from ehbench.vocabulary.errors import EhbenchError, InputError
from ehbench.vocabulary.messages import Message, message, templates


@dataclass(frozen=True)
class TextLine:
    """A line of a file; ``source``: the source that it names."""

    file: str
    line: int
    text: str
    source: str = ""


@dataclass(frozen=True)
class Origin:
    """Where a number comes from; ``shown``: it with its unit; ``changes``: what no longer supports
    it.
    """

    run: str
    result: NamedResult
    shown: str
    method: tuple[str, ...]
    windows: tuple[str, ...]
    sources: tuple[Source, ...]
    recipe: TextLine | None
    rig: TextLine | None
    changes: tuple[Message, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values for scripts, numbers in SI."""
        return {
            "run": self.run,
            "name": self.result.path,
            "file": self.result.file,
            "value": self.result.value,
            "unit": self.result.unit,
            "interval": self.result.interval,
            "about": self.result.about,
            "method": self.method,
            "windows": self.windows,
            "inputs": [source.as_json() for source in self.sources],
            "recipe": self.recipe and vars(self.recipe),
            "rig": self.rig and vars(self.rig),
            "changes": self.changes,
        }

    @property
    def headline(self) -> Message:
        """The number, and whether it is still supported."""
        key = "report.not_supported" if self.changes else "report.number"
        return message(key, name=self.result.path, value=self.shown)

    def table(self) -> Grid:
        """A row for each thing it comes from."""
        rows = [["file", f"{self.run}/{self.result.file}"]]
        rows += [["method", text] for text in self.method]
        rows += [["window", text] for text in self.windows]
        rows += [[item.role, f"{item.name}  SHA-256 {item.sha256}"] for item in self.sources]
        for name, line in (("recipe line", self.recipe), ("rig line", self.rig)):
            if line is not None:
                rows.append([name, f"{line.file}:{line.line}: {line.text}"])
        if self.rig is not None and self.rig.source:
            rows.append(["source", self.rig.source])
        rows += [["changed", text] for text in self.changes]
        return Grid(["from", "what"], rows)


def origin(name: str, folder: Path) -> Origin:
    """Where the number ``name`` of a run comes from; of a report, that of its run that has it; of a
    run that carries the parameters of its rig, the fit that they are from.

    Raises:
        InputError: no run, no number of that name, or several.
    """
    traced, changes = TracedRun(folder), []
    if traced.run.stage == "report":
        changes, report = traced.changes(), traced
        errors: list[EhbenchError] = []
        for source in report.sources:
            try:
                traced = TracedRun(source.place or report.folder.parent / source.name)
                named_result(traced.run, name)
                break
            except EhbenchError as error:
                errors.append(error)
        else:
            several = (error for error in errors if error.key == "report.several_numbers")
            none = InputError(message("report.no_runs"), file=report.folder)
            raise next(several, (errors or [none])[0])
    result = named_result(traced.run, name)
    rig = next((source for source in traced.sources if source.role == "rig"), None)
    if rig and rig.run and result.file == "parameters.json" and (rig.run / result.file).is_file():
        fitted = origin(result.path, rig.run)
        return replace(fitted, changes=tuple(dict.fromkeys([*changes, *traced.changes()])))
    return Origin(
        run=str(traced.folder),
        result=result,
        shown=_value_text(traced.run, result),
        method=_method(traced.run, result),
        windows=tuple(_windows(traced.recipe)),
        sources=tuple(traced.sources),
        recipe=_recipe_line(traced.recipe, result),
        rig=None if rig is None else _rig_line(rig, result),
        changes=tuple(dict.fromkeys([*changes, *traced.changes()])),
    )


def _value_text(run: Saved, result: NamedResult) -> str:
    """The number with its interval, in the rig's units if it is one of the rig's parameters."""
    if isinstance(result.value, bool):
        return str(result.value).lower()
    values, unit = [result.value, *(result.interval or ())], result.unit
    if unit and row_of(result.path).unit == unit and (run.folder / "rig.toml").is_file():
        try:
            values = [shown(run.rig, result.path, value) for value in values]
            unit = unit_of(run.rig, result.path)
        except EhbenchError:
            pass  # in SI without a rig that can be read
    value, *ends = values
    text = estimate(value, *ends) if ends else number(value)
    text = " ".join(part for part in (text, pretty(unit)) if part)
    text += f" (95 %: {interval(*ends)})" if ends else ""
    status = result.about.get("status")
    return text + (f", {words(status)}" if isinstance(status, str) else "")


def _method(run: Saved, result: NamedResult) -> tuple[str, ...]:
    """How a number was found, as far as the catalogue describes it."""
    names = [run.stage, words(str(run.what)), words(run.facts.get("method") or "")]
    texts: list[str] = [", ".join(filter(None, names))]
    about, known = result.about, templates("report")
    if f"method_{run.what}" in known:
        texts.append(message(f"report.method_{run.what}"))
    if f"error_{about.get('error_from')}" in known:
        texts.append(message(f"report.error_{about['error_from']}"))
    if about.get("prior") is not None:
        texts.append(message("report.prior", share=float(about.get("from_data", 1.0))))
    if "samples" in about:
        texts.append(message("report.samples", count=about["samples"]))
    return tuple(texts)


def _windows(recipe: Source) -> Iterator[str]:
    """Which part of each log was read, by the recipe as it was read."""
    table: Mapping[str, Any] = {}
    if recipe.place is not None and recipe.is_same and recipe.place.suffix == ".toml":
        try:
            table, _ = read_toml(recipe.place)
        except (EhbenchError, tomllib.TOMLDecodeError):
            return
    data = table.get("data", ())
    for entry in data if isinstance(data, list) else ():
        item = entry if isinstance(entry, Mapping) else {"path": entry}
        ends = [str(item.get(key, word)) for key, word in (("start", "start"), ("stop", "end"))]
        yield f"{item.get('path', '?')}: {' to '.join(ends)}"


def _recipe_line(recipe: Source, result: NamedResult) -> TextLine | None:
    """The line of the recipe that names the number, else the line that names its data."""
    if recipe.place is None or not recipe.place.is_file():
        return None
    text = recipe.place.read_text(encoding="utf-8", errors="replace")
    rows = text.splitlines()
    tokens = {f'"{result.path}"', f'"{result.path.rpartition(".")[2]}"'}
    naming = (i for i, row in enumerate(rows, 1) if any(t in row.partition("#")[0] for t in tokens))
    line = next(naming, None) or line_of(text, ("data",)) or line_of(text, ("stage",))
    return None if line is None else TextLine(recipe.name, line, rows[line - 1].strip())


def _rig_line(source: Source, result: NamedResult) -> TextLine | None:
    """The line of the rig file that has the parameter, with the source it names."""
    place = source.place
    place = place / "rig.toml" if place is not None and place.is_dir() else place
    if place is None or not place.is_file():
        return None
    try:
        table, text = read_toml(place)
    except EhbenchError:
        return None
    *parts, last = result.path.split(".")
    for location, names, value in _leaves(table, (), ()):
        rated = last.endswith("_gain") and names[-2:] == ("rated", "flow")
        if not ((rated or names[-1] == last) and set(parts) <= set(names)):
            continue
        line = line_of(text, location)
        if line is None:
            return None
        origin = value.get("source", "") if isinstance(value, Mapping) else ""
        name = place.name if SHIPPED in place.parents else source.name
        return TextLine(name, line, text.splitlines()[line - 1].strip(), str(origin))
    return None


def _leaves(
    value: Any, location: tuple[Any, ...], names: tuple[str, ...]
) -> Iterator[tuple[tuple[Any, ...], tuple[str, ...], Any]]:
    """(location, names of the tables about it and its key, value) of every value of a rig file; a
    table with a value is one.
    """
    if isinstance(value, Mapping) and "value" not in value:
        inner = (*names, value["name"]) if isinstance(value.get("name"), str) else names
        if inner == names and names[-1:] == ("edge",):  # named by its valve and its nodes
            inner = (*names, f"{names[-2]}_{value.get('from')}_{value.get('to')}")
        for key, inside in value.items():
            yield from _leaves(inside, (*location, key), (*inner, key))
    elif isinstance(value, list) and value and isinstance(value[0], Mapping):
        for index, inside in enumerate(value):
            yield from _leaves(inside, (*location, index), names)
    elif names:
        yield location, names, value
