"""What is taken of a sample: numbers of its results by name, or of its log's channels."""

import dataclasses
import math
import types
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from ehbench.config.recipe import Measure
from ehbench.data.record import Record
from ehbench.vocabulary import VOCABULARY, InputError, Quantity, message

ANY, ENTRY = "*", "0"
# words of results that are quantities under another name
_SPOKEN = {
    "max_error": "x",
    "rms_error": "x",
    "final_error": "x",
    "speed_rms_error": "v",
    "steady_speed": "v",
    "pump": "energy",
    "cylinder_work": "energy",
    "settling_time": "t",
    "amplitude": "x",
    "period": "t",
    "seconds": "t",
}


def row_of(item: Measure) -> Quantity | None:
    """The vocabulary row of what a measure is, as far as its words tell."""
    words = (item.channel or item.result or "").split(".")
    if item.inside is not None or item.over is not None:
        return None
    if words[-1] in ("value", "std", "low", "high") or words[-1].isdigit():
        known = [word for word in words[:-1] if word in VOCABULARY]
        return VOCABULARY[known[-1]] if known else None
    return VOCABULARY.get(_SPOKEN.get(words[-1], words[-1]))


def value_of(item: Measure, results: Mapping[str, Any], settings: Mapping[str, float]) -> float:
    """A measure of results, plain values as JSON has them; nan where they do not have it.
    ``settings`` are the sample's numbers [SI] by key, for ``inside``."""
    result = lookup(results, (item.result or "").split("."))
    if item.inside is not None:
        if not (isinstance(result, list | tuple) and len(result) == 2 and None not in result):
            return math.nan
        return float(result[0] <= settings[item.inside] <= result[1])
    if isinstance(result, list | tuple):
        return float(len(result))
    if isinstance(result, str):
        return float(bool(result))
    return math.nan if result is None or isinstance(result, Mapping) else float(result)


def lookup(here: Any, words: Sequence[str]) -> Any:
    """What a dotted name leads to in plain values, or None; list entries by name or number."""
    if not words:
        return here
    for size in range(len(words), 0, -1):
        name = ".".join(words[:size])
        if isinstance(here, Mapping) and name in here:
            return lookup(here[name], words[size:])
        if isinstance(here, list | tuple):
            for at, item in enumerate(here):
                keys = (item.get("name"), item.get("case")) if isinstance(item, Mapping) else ()
                if name in keys or name == str(at):
                    return lookup(item, words[size:])
    return None


def of_channels(item: Measure, record: Record, stop: float | None) -> float:
    """A measure of a trial's log [SI]; nan since a ``stop`` [s] by a limit that never was.

    Raises:
        LogError: no such channel; names those there are."""
    y = record[item.channel or ""]
    y = y if item.minus is None else y - record[item.minus]
    if item.since == "stop":
        if stop is None:
            return math.nan
        y = y[record.t >= stop - 1e-9]
    takes = {
        "max": np.max,
        "min": np.min,
        "mean": np.mean,
        "range": np.ptp,
        "final": lambda y: y[-1],
        "rms": lambda y: np.sqrt(np.mean(y * y)),
        "largest": lambda y: np.max(np.abs(y)),
    }
    return float(takes[item.take](y))


# --- what results there will be


def refuse_unknown(name: str, roots: Sequence[Any], file: Any) -> None:
    """Refuse a measure that no result will have.

    Args:
        name: dotted.
        roots: what results look like: dataclasses, or plain values with types as their leaves; the
            name leads through one of them.
        file: ``file`` and ``line`` of the study's key.

    Raises:
        InputError: names the nearest."""
    if not any(_leads(root, name.split(".")) for root in roots):
        known = [item for root in roots for item in names_in(root)]
        near = get_close_matches(name, known, 1, 0.3)
        text = message("sampling.no_result", name=name, near=", ".join(near or known))
        raise InputError(text, **file)


def _leads(kind: Any, words: Sequence[str]) -> bool:
    """Whether a name leads somewhere in results that look like ``kind``; names may have dots."""
    if not words or kind is Any:
        return True
    names = [".".join(words[:size]) for size in range(1, len(words) + 1)]
    return any(
        _leads(inner, words[size:])
        for name, inner in _parts(kind)
        for size, start in enumerate(names, 1)
        if name in (start, ANY, ENTRY)
    )


def names_in(kind: Any, prefix: str = "", depth: int = 4) -> Iterator[str]:
    """The names that results of a kind have, entries of lists by number 0."""
    parts = [(name, inner) for name, inner in _parts(kind) if name != ANY]
    if not parts and prefix and depth:
        yield prefix
    for name, inner in parts if depth else ():
        yield from names_in(inner, f"{prefix}.{name}" if prefix else name, depth - 1)


def _parts(kind: Any) -> list[tuple[str, Any]]:
    """(name, what it holds) of each part of results of a kind: ANY of a table with any names, ENTRY
    of a list."""
    if isinstance(kind, Mapping):
        return [(str(name), inner) for name, inner in kind.items()]
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        try:
            return list(get_type_hints(kind).items())
        except NameError:  # its module does not say
            return [(field.name, Any) for field in dataclasses.fields(kind)]
    origin, inside = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return [part for item in inside for part in _parts(item)]
    name = {dict: ANY, tuple: ENTRY, list: ENTRY}.get(origin)  # type: ignore[arg-type]
    return [(name, inside[-1 if name == ANY else 0])] if name else []
