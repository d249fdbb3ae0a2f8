"""What a study's key means: a dotted path into a rig, a recipe or a bench file, in their own words.

``rig.bulk_modulus`` and ``rig.boom.joint_damping`` are parameters as recipes name them,
``rig.payload.bucket.mass`` goes by the rig file; ``recipe.motion.speed`` by the recipe, whose lists
are entered by an entry's name or number; ``bench.delay`` by the bench file that it names. A ``*``
stands for any part of a parameter's name."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ehbench.config.recipe import validated
from ehbench.config.rig import Rig
from ehbench.sampling.design import Factor
from ehbench.vocabulary import InputError, UnitError, message, placed, quantity
from ehbench.vocabulary.errors import nearest
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.units import split_number

RIG, RECIPE, BENCH = "rig", "recipe", "bench"


def key_of(text: str, upstream: Sequence[str] = ()) -> tuple[str, str, str]:
    """(stem of the ``upstream`` recipe or '', file that it changes, path in it) of a study's key.

    Raises:
        InputError: it names no file."""
    stem = next((name for name in upstream if text.startswith(f"{name}.")), "")
    file, _, path = text.removeprefix(f"{stem}.").partition(".")
    if file in (RIG, RECIPE, BENCH) and path:
        return stem, file, path
    first = [RIG, RECIPE, BENCH, *upstream]
    near = [name for name in get_close_matches(file, first, 1) if name != file]
    hint = f"did you mean '{near[0]}.{path}'?" if near else None
    known = ", ".join(f"{name}." for name in first)
    raise InputError(message("sampling.no_key", key=text, first=known), hint=hint)


@dataclass
class Changes:
    """What a sample sets in a recipe's files, by path; values as in the file, or a `Factor`."""

    rig: dict[str, Any] = field(default_factory=dict)
    recipe: dict[str, Any] = field(default_factory=dict)
    bench: dict[str, Any] = field(default_factory=dict)


def changes_of(settings: Mapping[str, Any], upstream: Sequence[str] = ()) -> dict[str, Changes]:
    """The changes to each recipe by its stem, '' for the study's recipe.

    Raises:
        InputError: a key names no file."""
    results = {"": Changes()}
    for text, value in settings.items():
        stem, file, path = key_of(text, upstream)
        getattr(results.setdefault(stem, Changes()), file)[path] = value
    return results


# --- rigs


def changed_rig(rig: Rig, changes: Mapping[str, Any]) -> Rig:
    """A rig with some of its numbers set.

    Raises:
        InputError: no such number, with the nearest; or it cannot be set to that."""
    if not changes:
        return rig
    known, values, deeper = rig.parameters(), {}, {}
    for path, raw in changes.items():
        names = [path] if path in known else [n for n in known if fnmatchcase(n, path)]
        if not names:
            deeper[path] = raw
        for name in names:
            old, row, given = known[name], quantity(name), raw
            if isinstance(raw, Factor):
                given = float(raw) * float(old)
                given = given if row.unit == "dimensionless" else f"{given!r} {row.unit}"
            with placed({}, f"rig.{name}"):
                new = read_value(given, row)
            number = float(new)
            lower = old.lower if old.lower is not None and old.lower <= number else None
            upper = old.upper if old.upper is not None and old.upper >= number else None
            values[name] = replace(old, value=number, lower=lower, upper=upper, text=None)
    if deeper:
        table = rig.as_toml()
        for path in deeper:
            if path.partition(".")[0] not in table:
                raise nowhere(f"{RIG}.{path}", [*known, *leaves(table)])
        path = Path(f"rig '{rig.name}'")
        rig = validated(Rig, changed_table(table, deeper, RIG), "", path)
    return rig.with_values(values) if values else rig


# --- tables


def changed_table(table: Mapping[str, Any], changes: Mapping[str, Any], file: str) -> dict:
    """A file's table with some of its keys set; a key that the file leaves out may be set as well.

    Args:
        table: as TOML has it.
        changes: values by dotted path; the payload "none" is none.
        file: ``rig``, ``recipe`` or ``bench``, for messages.

    Raises:
        InputError: the path leads through what is no table, or a factor meets no number."""
    built = deepcopy(dict(table))
    for path, raw in changes.items():
        _put(built, path.split("."), raw, f"{file}.{path}", built)
    if built.get("payload") == "none":
        del built["payload"]
    return built


def nowhere(key: str, known: Iterable[str]) -> InputError:
    """There is no such key, ``<file>.<path>``; with the nearest path of those known."""
    file, _, path = key.partition(".")
    hint = nearest(path, known, f"nearest is '{file}.{{}}'", 0.4)
    return InputError(message("sampling.nowhere", key=key), hint=hint)


def leaves(table: Any, prefix: str = "") -> Iterator[str]:
    """The dotted paths of a table's plain values; entries of lists of tables by name or number."""
    if isinstance(table, Mapping) and "value" not in table:
        for name, item in table.items():
            yield from leaves(item, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(table, list | tuple) and any(isinstance(item, Mapping) for item in table):
        for name, item in zip(_names(table), table, strict=True):
            yield from leaves(item, f"{prefix}.{name}")
    else:
        yield prefix


def _put(here: Any, words: Sequence[str], raw: Any, text: str, table: Mapping[str, Any]) -> None:
    """Set what ``words`` lead to; a missing table is made, and the file's model judges it."""
    names = list(here) if isinstance(here, dict) else _names(here)
    sizes = range(len(words), 0, -1)  # names may have dots themselves
    size = next((n for n in sizes if ".".join(words[:n]) in names), 0)
    if not size and (isinstance(here, list) or isinstance(raw, Factor)):
        raise nowhere(text, leaves(table))
    name = ".".join(words[: size or 1])
    at = name if isinstance(here, dict) else names.index(name)
    rest = words[size or 1 :]
    old = here[at] if size else None
    if not rest:
        here[at] = _times(old, raw, text)
        return
    inner = {} if old is None else list(old) if isinstance(old, tuple) else old
    if isinstance(old, str) and at == "gains":
        inner = {"from": old}
    if not isinstance(inner, dict | list):
        raise nowhere(text, leaves(table))
    here[at] = inner
    _put(inner, rest, raw, text, table)


def _names(items: Sequence[Any]) -> list[str]:
    return [
        str(item.get("name", at)) if isinstance(item, Mapping) else str(at)
        for at, item in enumerate(items)
    ]


def _times(old: Any, raw: Any, text: str) -> Any:
    """A new value, or the old one times a factor, as the file would have it."""
    if not isinstance(raw, Factor):
        return raw
    old = old.get("value") if isinstance(old, Mapping) else old
    if isinstance(old, bool) or not isinstance(old, str | int | float):
        raise InputError(message("sampling.no_factor", key=text))
    if not isinstance(old, str):
        return old * float(raw)
    try:
        number, unit = split_number(old)
    except UnitError as error:
        raise InputError(f"'{text}': {error.message}") from None
    return f"{number * float(raw)!r} {unit}".strip()
