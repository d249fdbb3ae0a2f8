"""The numbers of a run by name: every number that its JSON files hold, with the interval, unit and
status in the same table."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, TypeGuard

from ehbench.report.saved import Saved
from ehbench.runs.rundir import read_json
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY

# run facts and what only pictures need
_SKIPPED = {"run.json", "volatile.json", "flow_maps.json"}
_NAMES = ("name", "channel", "cylinder", "joint", "valve", "direction", "controller")


@dataclass(frozen=True)
class NamedResult:
    """A number [SI] of a run: its ``file`` and dotted ``path`` there, its ``interval`` and ``unit``
    if its table has them, and the other entries of that table in ``about``.
    """

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
        InputError: no number has that name, or several do; names them.
    """
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
    depth = min((len(_pieces(item.path)) for item in exact), default=0)
    short = [item for item in exact if len(_pieces(item.path)) == depth]
    if len(short) == 1:
        return short[0]
    if near:
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
            yield NamedResult(
                file, ".".join(where), whole, _unit_of(value, where), _pair(ends), about
            )
        for key, inside in value.items():
            if key in ("value", "correlation") or key.endswith("interval"):
                continue
            if not _is_number(inside):
                yield from _numbers(file, inside, [*where, key])
            elif not _is_number(whole):
                ends, path = _pair(value.get(f"{key}_interval")), ".".join([*where, key])
                yield NamedResult(file, path, inside, _unit_of({}, [key]), ends, about)
    elif isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
        outer = where if where[-1:] != ["parameters"] else where[:-1]
        for index, item in enumerate(value):
            named = [str(item[key]) for key in _NAMES if isinstance(item.get(key), str)]
            yield from _numbers(file, item, [*outer, *(named or [str(index)])])


def _is_number(value: Any) -> TypeGuard[bool | int | float]:
    return isinstance(value, bool | int | float)


def _unit_of(table: Mapping[str, Any], where: Sequence[str]) -> str:
    if isinstance(table.get("unit"), str):
        return table["unit"]
    row = VOCABULARY.get(where[-1]) if where else None
    return row.unit if row else ""


def _pair(value: Any) -> tuple[float, float] | None:
    if isinstance(value, list) and len(value) == 2 and all(_is_number(end) for end in value):
        return float(value[0]), float(value[1])
    return None
