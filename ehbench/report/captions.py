"""What captions and sentences are made of: values in the reader's units, spans, names."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ehbench.config.rig import Rig
from ehbench.report.saved import Table
from ehbench.report.words import (
    estimate,
    fixed,
    interval,
    number,
    pretty,
    shown,
    unit_of,
    with_error,
)

MODEL = "model"  # what a trial runs on that is no machine


def plus(rig: Rig, name: str, value: float | None, half: float | None) -> str:
    """An SI value with half the width of its 95 % interval, in the rig's unit of the quantity."""
    return with_error(*(shown(rig, name, v) for v in (value, half)))


def as_fitted(rig: Rig, name: str, item: Table) -> str:
    """What a fit found of a parameter, in the rig's unit: ``value`` with ± half its ``interval``
    where that lies about the value, else the value alone.
    """
    ends = (item.number("value"), *(item.get("interval") or (None, None)))
    return estimate(*(shown(rig, name, v) for v in ends))


def range_of(rig: Rig, name: str, ends: Sequence[float | None] | None) -> str:
    """An SI interval in the rig's unit of the quantity."""
    return interval(*(shown(rig, name, v) for v in (ends or (None, None))))


def capital(text: str) -> str:
    """A text that begins a sentence."""
    return text[:1].upper() + text[1:]


def span(values: Sequence[float], digits: int = 3) -> str:
    """``0.45 to 0.71``: from the least to the largest of some values."""
    low, high = number(min(values), digits), number(max(values), digits)
    return low if low == high else f"{low} to {high}"


def percent(share: float | None, digits: int = 2) -> str:
    """A share as percent."""
    return f"{number(None if share is None else 100.0 * share, digits)} %"


def ranged(
    text_of: Callable[[float | None], str], value: float | None, ends: Sequence[float] | None
) -> str:
    """A median with the ends of several runs, ``0.23 (0.2 to 0.31)``, or alone."""
    text = text_of(value)
    if value is None or ends is None:
        return text
    low, high = (text_of(end) for end in ends)
    return text if low == high == text else f"{text} ({low} to {high})"


def ranged_in(rig: Rig, case: Any, form: str, *path: str | int) -> str:
    """A number of a trial, by where it stands in its row, with its range over several runs.

    Args:
        form: ``percent:2`` of a share, ``number:2``, or a quantity and its digits, ``v:3``.
    """
    kind, _, digits = form.partition(":")
    value, ends = case.row, case.row.get("range")
    for key in path:
        value = value[key] if isinstance(key, int) or key != path[-1] else value.get(key)
        if ends is not None:
            ends = ends[key] if isinstance(key, int) else ends.get(key)

    def text_of(value: float | None) -> str:
        if value is not None and kind != "number":
            value = 100.0 * value if kind == "percent" else shown(rig, kind, value)
        return number(value, int(digits))

    return ranged(text_of, value, ends)


def sentence(text: str) -> str:
    return capital(text).rstrip(".") + "."


def load_name(payload: str) -> str:
    """A payload as people say it."""
    return "no load" if payload == "none" else payload


def stroke(rig: Rig, row: Table | None, value: float | None, digits: int = 3) -> str:
    """An error of stroke [m] in the rig's unit, no finer than the machine measured it."""
    if value is None:
        return number(None)
    measured = {} if row is None or row["on"] == MODEL else row.get("gains", {})
    finest = measured.get("stroke_resolution", 0.0)
    if not finest:
        return number(shown(rig, "x", value), digits)
    finest = shown(rig, "x", finest)
    if abs(shown(rig, "x", value)) < finest:
        return f"< {number(finest, 1)}"
    places = -math.floor(math.log10(finest))
    return fixed(shown(rig, "x", value), places)


def measure(rig: Rig, name: str, value: float | None, digits: int = 3) -> str:
    """An SI value in the rig's unit, with the unit."""
    if value is None:
        return number(None)
    unit = pretty(unit_of(rig, name))
    return f"{number(shown(rig, name, value), digits)}" + (
        f"{'' if unit == '°' else ' '}{unit}" if unit else ""
    )


def error_of(rig: Rig, row: Table, which: str, key: str) -> str:
    """An error of a trial's stroke, ``tracking`` or ``tracking_true``, with its range over several
    runs; none finer than what the machine measured it by.
    """
    ends = row.get("range") or {}
    text_of = partial(stroke, rig, row if which == "tracking" else None)
    return ranged(text_of, row[which][key], (ends.get(which) or {}).get(key))
