"""Numbers and names as people read them: display units, sensible digits, a value with its error."""

import math
import re
from collections.abc import Callable, Sequence
from decimal import ROUND_FLOOR, Context
from functools import partial
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report.saved import Table
from ehbench.vocabulary import VOCABULARY, Quantity, from_si

DASH = "–"
SKEW = 0.1  # share of its half width by which a value may stand off an interval's middle for ±
_TITLES = {
    "q": "Joint angle",
    "qd": "Joint velocity",
    "x": "Stroke",
    "v": "Cylinder speed",
    "p_head": "Head-end pressure",
    "p_rod": "Rod-end pressure",
    "load_pressure": "Load pressure",
    "load_force": "Cylinder force",
    "rod_force": "Rod force",
    "command": "Commands",
}
_UNIT_WORDS = {"degC": "°C", "degF": "°F", "deg": "°", "us": "µs", "um": "µm", "ohm": "Ω"}
_SUPERSCRIPT = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def row_of(name: str) -> Quantity:
    """The vocabulary row of a name; an unknown word stands for itself, without unit."""
    word = name.rsplit(".", 1)[-1]
    return VOCABULARY.get(word) or Quantity(
        word, word, "dimensionless", "dimensionless", word.replace("_", " ")
    )


def unit_of(rig: Rig | None, name: str) -> str:
    """The unit in which people see a channel or parameter: this rig's, or any without a rig."""
    row = row_of(name)
    return row.display if rig is None or row.name not in VOCABULARY else rig.unit_of(name)


def symbol_of(rig: Rig, name: str) -> str:
    """The symbol of a channel or parameter: f for an ω that this rig's people see in Hz."""
    symbol = row_of(name).symbol
    return symbol.replace("ω", "f") if unit_of(rig, name).endswith("Hz") else symbol


def shown(rig: Rig | None, name: str, value: Any) -> Any:
    """An SI value, array or difference of values in that unit; None stays None."""
    if value is None:
        return None
    result = from_si(value, unit_of(rig, name), row_of(name))
    return np.asarray(result, float) if np.ndim(value) else float(result)


def pretty(unit: str) -> str:
    """A unit with real powers: ``m^3/(s*Pa)`` → ``m³/(s·Pa)``; empty for a pure number."""
    if unit in ("dimensionless", "1", ""):
        return ""
    unit = re.sub(r"(\w+)(?:\^|\*\*)0\.5", r"√\1", unit)
    unit = re.sub(r"(?:\^|\*\*)(-?\d+)", lambda result: result[1].translate(_SUPERSCRIPT), unit)
    return re.sub(
        r"[A-Za-z]+", lambda result: _UNIT_WORDS.get(result[0], result[0]), unit.replace("*", "·")
    )


def axis(rig: Rig, name: str, text: str = "") -> str:
    """``joint angle [°]``: an axis label or table head, with the unit if there is one."""
    unit = pretty(unit_of(rig, name))
    return (text or words(name)) + (f" [{unit}]" if unit else "")


def rounded_down(value: float) -> float:
    """The largest number of two significant digits that is not above a value."""
    return float(Context(prec=2, rounding=ROUND_FLOOR).create_decimal(repr(float(value))))


def number(value: float | None, digits: int = 4) -> str:
    """A number to some significant digits; with powers of ten outside of 1e-3 … 1e5."""
    if value is None or not math.isfinite(value):
        return DASH if value is None or math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == 0.0:
        return "0"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    size, times = int(power), ""
    if -4 < size < 6:
        mantissa = f"{mantissa}e{power}"
    else:
        times = f" × 10{str(size).translate(_SUPERSCRIPT)}"
    text = np.format_float_positional(float(mantissa), trim="-")
    return f"{text}{times}".replace("-", "−")


def fixed(value: float, places: int) -> str:
    """A number to so many decimals (negative: rounded to tens, hundreds…)."""
    nought_without_minus = round(value, places) + 0.0
    return f"{nought_without_minus:.{max(places, 0)}f}".replace("-", "−")


def places_of(half: float) -> int:
    """Decimals that show an error to two significant digits."""
    return 1 - math.floor(math.log10(float(f"{half:.1e}")))


def with_error(value: float | None, half: float | None) -> str:
    """``271.3 ± 2.4``: half the 95 % interval to two digits; without it four digits."""
    if (
        value is None
        or half is None
        or not (math.isfinite(value) and math.isfinite(half))
        or half <= 0.0
    ):
        return number(value)
    size = math.floor(math.log10(max(abs(value), half)))
    if not -4 < size < 6:
        power = 10.0**size
        inner = with_error(value / power, half / power)
        return f"({inner}) × 10{str(size).translate(_SUPERSCRIPT)}"
    places = min(places_of(half), 9)
    return f"{fixed(value, places)} ± {fixed(half, places)}"


def estimate(value: float | None, low: float | None, high: float | None) -> str:
    """``271.3 ± 2.4`` in the middle of its 95 % interval, else the value alone."""
    ends = (value, low, high)
    if any(end is None or not math.isfinite(end) for end in ends):
        return number(value)
    assert value is not None and low is not None and high is not None
    half = 0.5 * (high - low)
    if half <= 0.0 or abs(value - 0.5 * (low + high)) <= SKEW * half:
        return with_error(value, half)
    size = math.floor(math.log10(max(abs(value), half)))
    return number(value, min(max(size + 1 + places_of(half), 1), 9))


def interval(low: float | None, high: float | None) -> str:
    """``266.5 … 276.1``, to three digits of its width."""
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return DASH
    width = abs(high - low)
    if width == 0.0 or not -4 < math.floor(math.log10(max(abs(low), abs(high), 1e-300))) < 6:
        return f"{number(low, 3)} … {number(high, 3)}"
    places = min(places_of(width), 9)
    return f"{fixed(low, places)} … {fixed(high, places)}"


def with_interval(value: float | None, low: float | None, high: float | None) -> str:
    """As `estimate`, with the interval in brackets where it is not even about the value."""
    text = estimate(value, low, high)
    if "±" in text or None in (value, low, high):
        return text
    return f"{text} ({interval(low, high)})"


def words(name: str) -> str:
    """A key or status word as prose: ``not_excited`` → ``not excited``."""
    return name.replace("_", " ")


def title_of(channel: str) -> str:
    """A channel's quantity as a panel title."""
    word = channel.rsplit(".", 1)[-1]
    return (
        _TITLES.get(word)
        or row_of(channel).meaning.split(",")[0].split("(")[0].strip().capitalize()
    )


MODEL = "model"  # what a trial runs on that is no machine


def plus(rig: Rig, name: str, value: float | None, half: float | None) -> str:
    """An SI value with half the width of its 95 % interval, in the rig's unit of the quantity."""
    return with_error(*(shown(rig, name, v) for v in (value, half)))


def as_fitted(rig: Rig, name: str, item: Table) -> str:
    """A fitted parameter in the rig's unit, ± half its interval where that is even."""
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
        form: ``percent:2`` of a share, ``number:2``, or a quantity and its digits, ``v:3``."""
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
    """An error of a trial's stroke with its range, no finer than it was measured."""
    ends = row.get("range") or {}
    text_of = partial(stroke, rig, row if which == "tracking" else None)
    return ranged(text_of, row[which][key], (ends.get(which) or {}).get(key))
