"""What a log must be: known channels with units, a time that goes on, plausible values."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from ehbench.data.record import Record
from ehbench.data.text import head_of
from ehbench.vocabulary import VOCABULARY, LogError, UnitError, from_si, message, quantity, to_si

TIME_NAMES = ("t", "time", "zeit", "timestamp", "seconds", "sec")  # what a time may be called
TIME_UNITS = ("s", "ms", "us", "ns", "min", "h", "d")


def check_record(
    record: Record,
    file: str | Path | None = None,
    *,
    lines: Sequence[int] | None = None,
    units: Mapping[str, str] | None = None,
) -> None:
    """Refuse data that no rig can have recorded; the message says the file that it came from, with
    the line of a sample of text, in the unit that the channel was written in.

    Raises:
        LogError: no samples, a time or value that is not finite, a time that stands still or goes
            back.
        UnitError: a value outside the plausible range of its quantity; says which unit would fit.
    """
    if not record.t.size:
        raise LogError(message("data.no_samples"), file=file)
    check_time(record.t, file=file, lines=lines)
    for name, values in record.channels.items():
        row, near = quantity(name), np.ascontiguousarray(values)  # twice as fast to scan
        low, high = near.min(), near.max()
        if row.lower <= low and high <= row.upper and np.isfinite(low) and np.isfinite(high):
            continue
        at = int(np.argmin((values >= row.lower) & (values <= row.upper) & np.isfinite(values)))
        line = lines[at] if lines is not None else None
        where = "" if line else f" at t = {record.t[at]:.9g} s"
        if not np.isfinite(values[at]):
            text = message("data.not_finite", name=name, value=values[at], where=where)
            raise LogError(text, file=file, line=line)
        unit = (units or {}).get(name, row.unit)
        value, low, high = (from_si(x, unit, row) for x in (values[at], row.lower, row.upper))
        fits = [
            other
            for other in (row.display, row.unit)
            if other != unit and row.lower <= to_si(value, other, row) <= row.upper
        ]
        key = "data.implausible_unit" if fits else "data.implausible"
        shown = "" if unit in ("1", "dimensionless") else f" {unit}"
        fields = {"unit": shown, "where": where, "fits": fits[0] if fits else ""}
        text = message(key, name=name, value=value, low=low, high=high, **fields)
        raise UnitError(text, file=file, line=line)


def inside(t: np.ndarray, window: tuple[float, float] | None) -> np.ndarray:
    """Which times [s] lie inside a window; all where none does."""
    keep = np.ones(t.size, bool) if window is None else (t >= window[0]) & (t <= window[1])
    return keep if keep.any() else ~keep


def check_time(
    t: np.ndarray,
    file: str | Path | None = None,
    lines: Sequence[int] | None = None,
    name: str = "the time",
) -> None:
    """Raise LogError unless ``t`` [s] is finite and increases strictly."""
    finite = np.isfinite(t)
    good = finite & np.concatenate([[True], np.diff(np.where(finite, t, 0.0)) > 0])
    if good.all():
        return
    at = int(np.argmin(good))
    before, now = float(t[at - 1]), float(t[at])
    if not finite[at]:
        text = message("data.not_finite", name=name, value=now, where="")
    else:
        key = "data.time_stands_still" if now == before else "data.time_goes_back"
        text = message(key, name=name, now=now, before=before)
    raise LogError(text, file=file, line=lines[at] if lines is not None else None)


def check_known(name: str, *, file: str | Path | None = None, line: int | None = None) -> None:
    """Raise LogError, naming the nearest name, unless ``name`` is a channel of the vocabulary."""
    *path, word = name.split(".")
    if word in VOCABULARY and all(path):
        return
    plain = word.strip().lower()
    near = ["t"] if plain in TIME_NAMES else get_close_matches(plain, VOCABULARY, 1, cutoff=0.5)
    key = "data.near_channel" if near else "data.no_near_channel"
    key = "data.near_time" if near == ["t"] else key
    hint = message(key, near=".".join([*path, *near]))
    if path and all(path) and near != ["t"] and plain.isidentifier():
        hint += message("data.if_valve", word=plain, name=name)
    raise LogError(message("data.unknown_channel", name=name, near=hint), file=file, line=line)


def label_of(text: str, *, file: str | Path, line: int | None = None) -> tuple[str, str]:
    """``boom.p_head [kPa]`` as (name, unit), both known."""
    name, unit = head_of(text)
    name = name if unit else name.partition("(")[0].strip()
    check_known(name, file=file, line=line)
    check_unit(text.strip(), name, unit, file=file, line=line)
    return name, unit


def check_unit(
    label: str, name: str, unit: str, *, file: str | Path, line: int | None = None
) -> None:
    """Raise UnitError unless ``unit`` is one of the quantity ``name``, as a ``label`` says."""
    row = quantity(name)
    if not unit and row.unit != "dimensionless":
        error = message("data.label_without_unit", label=label, name=name, display=row.display)
        raise UnitError(error, file=file, line=line)
    try:
        to_si(0.0, unit, row)
    except UnitError as error:
        reason = message("data.label_error", label=label, error=error.message)
        raise UnitError(reason, file=file, line=line, hint=error.hint) from None
