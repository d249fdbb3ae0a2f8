"""The numbers of a run by name: every number that its own files hold, with the interval, unit and
status that stand beside it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ehbench.report.saved import Saved
from ehbench.runs.rundir import read_json
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.quantities import VOCABULARY

# run facts and what only pictures need
_SKIPPED = {"run.json", "volatile.json", "flow_maps.json"}
_ENDS = (("interval",), ("low", "high"))
_NAMES = ("name", "channel", "cylinder", "joint", "valve", "direction", "controller")


@dataclass(frozen=True)
class Claim:
    """A number [SI] of a run: the ``file`` and dotted ``path`` it stands at, its ``interval`` where
    one stands beside it, its ``unit`` and what else its table says.
    """

    file: str
    path: str
    value: float | bool
    unit: str
    interval: tuple[float, float] | None
    about: Mapping[str, Any] = field(default_factory=dict)


def claim_of(run: Saved, name: str) -> Claim:
    """The number that goes by a name: its dotted path, or as much of its end as tells it from all
    others; a fitted parameter by its own name.

    Raises:
        InputError: no number goes by it, or several do; names them.
    """
    claims = list(_claims(run))
    required = _pieces(name)
    near = [claim for claim in claims if _has(_pieces(claim.path), required)]
    exact = [item for item in near if _pieces(item.path)[-len(required) :] == required] or near
    best = min((len(_pieces(item.path)) for item in exact), default=0)
    # a parameter's own value comes before what a log says of it
    short = [item for item in exact if len(_pieces(item.path)) == best]
    if len(short) == 1:
        return short[0]
    if near:
        paths = ", ".join(item.path for item in short[:8])
        raise InputError(
            f"has {len(short)} numbers that go by '{name}'", file=run.folder, hint=f"say {paths}"
        )
    known = sorted({claim.path for claim in claims})
    close = get_close_matches(name, known, 3, 0.4)
    raise InputError(
        f"has no number that goes by '{name}'",
        file=run.folder,
        hint=("nearest: " if close else "it has ") + ", ".join(close or known[:8]),
    )


def _pieces(name: str) -> list[str]:
    return [piece for piece in re.split(r"[.\s/]+", name) if piece]


def _has(pieces: list[str], required: list[str]) -> bool:
    """Whether the wanted pieces stand in this order among the pieces."""
    rest = iter(pieces)
    return all(piece in rest for piece in required)


def _claims(run: Saved) -> Iterator[Claim]:
    for path in sorted(run.folder.glob("*.json")):
        if path.name not in _SKIPPED:
            yield from _numbers(path, read_json(path), [])


def _numbers(file: Path, value: Any, where: list[str]) -> Iterator[Claim]:
    if isinstance(value, Mapping):
        own = value.get("value")
        if isinstance(own, bool | int | float):
            yield Claim(
                file.name,
                ".".join(where),
                own,
                _unit(value, where),
                _interval(value),
                _plain(value),
            )
        for key, inside in value.items():
            if key == "value" or key.endswith("interval") or key in ("correlation",):
                continue
            if _is_number(inside) and not _is_number(own):
                yield Claim(
                    file.name,
                    ".".join([*where, key]),
                    inside,
                    _unit({}, [key]),
                    _pair(value.get(f"{key}_interval")),
                    _plain(value),
                )
            elif not _is_number(inside):
                yield from _numbers(file, inside, [*where, key])
    elif isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
        for index, item in enumerate(value):
            named = [str(item[key]) for key in _NAMES if isinstance(item.get(key), str)]
            outer = where if where[-1:] != ["parameters"] else where[:-1]
            yield from _numbers(file, item, [*outer, *(named or [str(index)])])


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float)


def _unit(table: Mapping[str, Any], where: list[str]) -> str:
    if isinstance(table.get("unit"), str):
        return table["unit"]
    row = VOCABULARY.get(where[-1]) if where else None
    return row.unit if row else ""


def _interval(table: Mapping[str, Any]) -> tuple[float, float] | None:
    for keys in _ENDS:
        result = _pair(table.get(keys[0]) if len(keys) == 1 else [table.get(key) for key in keys])
        if result:
            return result
    return None


def _pair(value: Any) -> tuple[float, float] | None:
    if isinstance(value, list) and len(value) == 2 and all(_is_number(end) for end in value):
        return float(value[0]), float(value[1])
    return None


def _plain(table: Mapping[str, Any]) -> dict[str, Any]:
    """What a table says beside its numbers' names, lists and tables left out."""
    return {k: v for k, v in table.items() if v is None or isinstance(v, str | bool | int | float)}
