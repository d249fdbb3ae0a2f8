"""Plants of one layout as one plant in lanes, and tables of numbers alike."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from ehbench.parts.valve.delay import Line, line_of
from ehbench.plant.build import Plant
from ehbench.plant.lanes.vectors import LANES
from ehbench.runtime.compiled import Row, table


@lru_cache(maxsize=64)
def _wide(layout: np.dtype) -> np.dtype:
    """The layout of a row with lanes for each of its floats."""
    names = layout.names or ()
    columns = [
        (name, "f8", (LANES,)) if layout[name] == np.float64 else (name, layout[name])
        for name in names
    ]
    return np.dtype((Row, columns), align=True)


@lru_cache(maxsize=64)
def _whole(layout: np.dtype) -> np.ndarray:
    """Which of the eight-byte words of a row are integers."""
    names = [name for name in layout.names or () if layout[name].base != np.float64]
    words = [layout.fields[name][1] // 8 for name in names]  # type: ignore[index]
    return np.array(words, dtype=np.intp)


@lru_cache(maxsize=64)
def _floats(layout: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Which of the eight-byte words of a row are floats, and of a wide row, shape (floats, LANES),
    where these go.
    """
    names = [name for name in layout.names or () if layout[name] == np.float64]
    wide = _wide(layout)
    own = [layout.fields[name][1] // 8 for name in names]  # type: ignore[index]
    to = [wide.fields[name][1] // 8 for name in names]  # type: ignore[index]
    return np.array(own, dtype=np.intp), np.array(to, dtype=np.intp)[:, None] + np.arange(LANES)


def _words(rows: np.ndarray) -> np.ndarray:
    """Rows as eight-byte words, bits that are copied whatever they mean; shape (rows, words)."""
    return rows.view(np.int64).reshape(rows.size, -1)


def _tables(plant: Plant) -> dict[str, np.ndarray]:
    """A plant's tables by name, the supply as one of one row."""
    results = {
        name: value.view(np.ndarray)
        for name, value in plant._asdict().items()
        if isinstance(value, np.recarray)
    }
    return results | {"supply": np.array([plant.supply], plant.supply.dtype)}


def layout_of(plant: Plant) -> tuple[Any, ...]:
    """What must be the same of plants that go side by side: all their integers, and so the sizes of
    their tables and maps, and whether a valve is late.
    """
    parts: list[Any] = [plant.kind, plant.at, plant.maps.shape, bool(plant.valves["delay"].any())]
    for rows in _tables(plant).values():
        parts.append(_words(rows)[:, _whole(rows.dtype)].tobytes() if rows.size else rows.size)
    return tuple(parts)


def filled(items: Sequence[Any]) -> list[Any]:
    """As many items as there are lanes, the last one again where there are fewer."""
    return [*items, *([items[-1]] * (LANES - len(items)))]


def side_by_side(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of one shape, at most as many as lanes, with a last axis of lanes."""
    return np.stack(filled(arrays), axis=-1)


def in_lanes(plants: Sequence[Plant]) -> Plant:
    """Plants of one `layout_of`, at most as many as lanes, as one with lanes for each of its
    floats.
    """
    packed, first = [_tables(plant) for plant in plants], plants[0]
    built: dict[str, Any] = {}
    for name, rows in packed[0].items():
        built[name] = wide = table(len(rows), _wide(rows.dtype))
        if rows.size:
            floats, to = _floats(rows.dtype)
            each = side_by_side([_words(item[name])[:, floats] for item in packed])
            words, whole = _words(wide.view(np.ndarray)), _whole(rows.dtype)
            words[:, to] = each
            words[:, _whole(wide.dtype)] = _words(rows)[:, whole]
    built["supply"] = built["supply"][0]
    built["gravity"] = side_by_side([plant.gravity for plant in plants])
    built["maps"] = side_by_side([plant.maps for plant in plants])
    return first._replace(**built)


def line_in_lanes(plants: Sequence[Plant], tick: float, columns: int) -> Line:
    """The lines of past commands of plants of one layout (`line_of`), as deep as the deepest."""
    lines = [line_of(plant, tick, columns) for plant in plants]
    depth = max(line.past.shape[0] for line in lines)
    past = [np.resize(line.past, (depth, line.past.shape[1])) for line in lines]
    fixed = side_by_side([line.held for line in lines])
    return Line(float(tick), side_by_side(past), np.zeros(1, np.int64), fixed)
