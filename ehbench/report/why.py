"""Where a number of a run comes from, by which method and lines, and if that still holds."""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import product
from pathlib import Path
from typing import Any, TypeGuard

from ehbench.config.recipe import load_rig
from ehbench.config.recipe.toml import line_of, read_toml
from ehbench.report.blocks import Grid
from ehbench.report.provenance import Source, TracedRun
from ehbench.report.saved import Saved
from ehbench.report.terminal import Answer
from ehbench.report.words import estimate, interval, number, pretty, row_of, shown, unit_of, words
from ehbench.runs.rundir import SHIPPED, read_json
from ehbench.vocabulary import VOCABULARY, EhbenchError, InputError, Message, message
from ehbench.vocabulary.messages import templates

# run facts and what only pictures need
_SKIPPED = {"run.json", "volatile.json", "flow_maps.json"}
_NAMES = ("name", "channel", "cylinder", "joint", "valve", "direction", "controller")


@dataclass(frozen=True)
class NamedResult:
    """A number [SI] of a run: its ``file`` and dotted ``path`` there, its ``interval`` and ``unit``
    if its table has them, and the other entries of that table in ``about``."""

    file: str
    path: str
    value: float | bool
    unit: str
    interval: tuple[float, float] | None
    about: Mapping[str, Any] = field(default_factory=dict)


def named_result(run: Saved, name: str) -> NamedResult:
    """The number of a name: its dotted path, or as much of the path's end as is unique; a fitted
    parameter by its own name.

    Raises:
        InputError: no number has that name, or several do; names them."""
    results = [
        result
        for path in sorted(run.folder.glob("*.json"))
        if path.name not in _SKIPPED
        for result in _numbers(path.name, read_json(path), [])
    ]
    required = _pieces(name)
    near = []
    for result in results:
        remaining = iter(_pieces(result.path))
        if all(piece in remaining for piece in required):  # in this order
            near.append(result)
    exact = [item for item in near if _pieces(item.path)[-len(required) :] == required] or near
    # a parameter's value comes before the values of single logs
    depths = [len(_pieces(item.path)) for item in exact]
    short = [item for item, depth in zip(exact, depths, strict=True) if depth == min(depths)]
    if len(short) == 1:
        return short[0]
    if near:
        whole = [item for item in near if _pieces(item.path)[: len(required)] == required]
        short = whole or short  # the parts of a table of that name come before others' numbers
        paths = ", ".join(item.path for item in short[:8])
        text = message("report.several_numbers", count=len(short), name=name, paths=paths)
    else:
        known = sorted({result.path for result in results})
        close = get_close_matches(name, known, 3, 0.4) or known[:8]
        text = message("report.no_number", name=name, near=", ".join(close))
    raise InputError(text, file=run.folder)


def _pieces(name: str) -> list[str]:
    return [piece for piece in re.split(r"[.\s/]+", name) if piece]


def _numbers(file: str, value: Any, where: list[str]) -> Iterator[NamedResult]:
    if isinstance(value, Mapping):
        about = {k: v for k, v in value.items() if v is None or isinstance(v, str) or _is_number(v)}
        whole = value.get("value")
        if _is_number(whole):
            ends = value.get("interval") or [value.get("low"), value.get("high")]
            unit = unit if isinstance(unit := about.get("unit"), str) else _unit_of({}, where)
            yield NamedResult(file, ".".join(where), whole, unit, _pair(ends), about)
        for key, inside in value.items():
            if key in ("value", "correlation") or key.endswith("interval"):
                continue
            if not _is_number(inside):
                yield from _numbers(file, inside, [*where, key])
            elif not _is_number(whole):
                ends, path = _pair(value.get(f"{key}_interval")), ".".join([*where, key])
                yield NamedResult(file, path, inside, _unit_of(value, [*where, key]), ends, about)
    elif isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
        outer = where if where[-1:] != ["parameters"] else where[:-1]
        for index, item in enumerate(value):
            named = [str(item[key]) for key in _NAMES if isinstance(item.get(key), str)]
            yield from _numbers(file, item, [*outer, *(named or [str(index)])])


def _is_number(value: Any) -> TypeGuard[bool | int | float]:
    return isinstance(value, bool | int | float)


def _unit_of(table: Mapping[str, Any], where: Sequence[str]) -> str:
    """The unit of a number in a ``table``: that of its own name, else of the table's, unless the
    table is a row of what it is named by; none of a channel's, whose table says what it is."""
    *above, own = where or [""]
    if "." in own:
        return ""
    if any(word.endswith("_percent") for word in [*above, own]):
        return "%"
    heads = [table.get(key) for key in _NAMES]
    words = [own, *(word for word in above[-1:] if word not in heads)]
    return next((VOCABULARY[word].unit for word in words if word in VOCABULARY), "")


def _pair(value: Any) -> tuple[float, float] | None:
    if isinstance(value, list) and len(value) == 2 and all(_is_number(end) for end in value):
        return float(value[0]), float(value[1])
    return None


@dataclass(frozen=True)
class TextLine:
    """A line of a file; ``source``: the source that it names."""

    file: str
    line: int
    text: str
    source: str = ""


def origin(name: str, folder: Path, changes: Sequence[Message] | None = None) -> Answer:
    """Where the number ``name`` of a run comes from; of a report, that of its run that has it; of a
    run that carries the parameters of its rig, the fit that they are from. For scripts in SI.

    Args:
        name: of the number, as for `named_result`.
        folder: of the run.
        changes: what no longer supports it; by default what does not now.

    Raises:
        InputError: no run, no number of that name, or several."""
    traced, above = TracedRun(folder), list[Message]()
    if traced.run.stage == "report":
        above, report = traced.changes(), traced
        errors: list[EhbenchError] = []
        places = [item.place or report.folder.parent / item.name for item in report.sources]
        for place, carried in [(p, False) for p in places] + [(p, True) for p in places]:
            try:
                traced = TracedRun(place)
                result = _result(traced, name, carried)
                break
            except EhbenchError as error:
                errors.append(error)
        else:
            several = (error for error in errors if error.key == "report.several_numbers")
            none = InputError(message("report.no_runs"), file=report.folder)
            raise next(several, (errors or [none])[0])
    else:
        result = _result(traced, name, True)
    if changes is None:
        changes = list(dict.fromkeys([*above, *traced.changes()]))
    rig = next((source for source in traced.sources if source.role == "rig"), None)
    before, files = None, ("rig.toml", "parameters.json")
    if rig and result.file in (files if traced.run.stage != "identify" else files[:1]):
        if rig.run and (rig.run / result.file).is_file():
            before = rig.run
        elif result.about.get("status") == "identified":
            before = traced.fit_beside(rig, result.path, result.value)
    if before is not None:
        return origin(result.path, before, changes)
    return _answer(traced, result, rig, changes)


def _answer(
    traced: TracedRun, result: NamedResult, rig: Source | None, changes: Sequence[Message]
) -> Answer:
    """A row for each thing that a number comes from."""
    method, windows = _method(traced.run, result), tuple(_windows(traced.recipe))
    if result.file == "rig.toml":
        key = "no_fit" if result.about["status"] == "identified" else "from_rig"
        method, windows = (message(f"report.{key}", folder=traced.folder.parent),), ()
    recipe, line = _recipe_line(traced.recipe, result), _rig_line(rig, result)
    rows = [["file", f"{traced.folder}/{result.file}"]]
    rows += [["method", text] for text in method]
    rows += [["window", text] for text in windows]
    rows += [[item.role, f"{item.name}  SHA-256 {item.sha256}"] for item in traced.sources]
    for name, item in (("recipe line", recipe), ("rig line", line)):
        if item is not None:
            rows.append([name, f"{item.file}:{item.line}: {item.text}"])
    if line is not None and line.source:
        rows.append(["source", line.source])
    rows += [["changed", text] for text in changes]
    values = {
        "run": str(traced.folder),
        "name": result.path,
        **{key: item for key, item in vars(result).items() if key != "path"},
        "method": method,
        "windows": windows,
        "inputs": [source.as_json() for source in traced.sources],
        "recipe": recipe and vars(recipe),
        "rig": line and vars(line),
        "changes": changes,
    }
    key = "report.not_supported" if changes else "report.number"
    verdict = message(key, name=result.path, value=_value_text(traced.run, result))
    return Answer(verdict, [Grid(["from", "what"], rows)], values=values)


def _result(traced: TracedRun, name: str, carried: bool) -> NamedResult:
    """The number of a run; if ``carried``, else that parameter of the rig that the run was made on.

    Raises:
        InputError: as `named_result`."""
    try:
        return named_result(traced.run, name)
    except InputError as error:
        is_known = error.key == "report.no_number" and traced.run.has_rig
        value = traced.run.rig.parameters().get(name) if is_known and carried else None
        if value is None:
            raise
        about = {"status": value.sure, "source": value.source}
        return NamedResult("rig.toml", name, float(value), row_of(name).unit, None, about)


def _value_text(run: Saved, result: NamedResult) -> str:
    """The number with its interval, in the rig's units if it is one of the rig's parameters."""
    if isinstance(result.value, bool):
        return str(result.value).lower()
    values, unit, path = [result.value, *(result.interval or ())], result.unit, result.path
    path = path if row_of(path).unit == unit else path.rpartition(".")[0]  # its table's unit
    if unit and row_of(path).unit == unit and run.has_rig:
        with suppress(EhbenchError):  # in SI without a rig that can be read
            values = [shown(run.rig, path, value) for value in values]
            unit = unit_of(run.rig, path)
    value, *ends = values
    text = estimate(value, *ends) if ends else number(value)
    text = " ".join(part for part in (text, pretty(unit)) if part)
    text += f" (95 %: {interval(*ends)})" if ends else ""
    status = result.about.get("status")
    return text + (f", {words(status)}" if isinstance(status, str) else "")


def _method(run: Saved, result: NamedResult) -> tuple[str, ...]:
    """How a number was found, as far as the catalogue describes it."""
    names = [run.stage, words(str(run.what)), words(run.facts.get("method") or "")]
    texts: list[str] = [", ".join(filter(None, dict.fromkeys(names)))]
    about, known = result.about, templates("report")
    if f"method_{run.what}" in known:
        texts.append(message(f"report.method_{run.what}"))
    if f"error_{about.get('error_from')}" in known:
        texts.append(message(f"report.error_{about['error_from']}"))
    if about.get("prior") is not None:
        texts.append(message("report.prior", share=float(about.get("from_data", 1.0))))
    if about.get("from_fixed", 0.0) > 0.5:
        texts.append(message("report.from_fixed", share=float(about["from_fixed"])))
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


def _rig_line(source: Source | None, result: NamedResult) -> TextLine | None:
    """The line of the rig file that has the parameter, with the source it names."""
    place = None if source is None else source.place
    place = place / "rig.toml" if place is not None and place.is_dir() else place
    if source is None or place is None or not place.is_file():
        return None
    try:
        (table, text), rig = read_toml(place), load_rig(place)
    except EhbenchError:  # a rig that cannot be read says nothing
        return None
    owner, dot, key = result.path.rpartition(".")
    places = [part for prefix, part, _ in rig.parts() if prefix == owner + dot]
    ends = [(key,), ("rated", "flow")] if key.endswith("_gain") else [(key,)]
    for parts in ((*at, *end) for at, end in product(places, ends)):
        with suppress(LookupError, TypeError):  # it is not written there
            value: Any = table
            for part in parts:
                value = value[part]
            if (line := line_of(text, parts)) is not None:
                origin = value.get("source", "") if isinstance(value, Mapping) else ""
                name = place.name if SHIPPED in place.parents else source.name
                return TextLine(name, line, text.splitlines()[line - 1].strip(), str(origin))
    return None
