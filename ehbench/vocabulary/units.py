"""Conversion between what people write and SI. Pressures are gauge; pint is imported only when a
unit is met that `ehbench.vocabulary.usual_units` does not have.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING

from ehbench.vocabulary.errors import UnitError
from ehbench.vocabulary.quantities import Quantity
from ehbench.vocabulary.text import shortened
from ehbench.vocabulary.usual_units import IN_SI, SI

if TYPE_CHECKING:
    import pint

_NUMBER = re.compile(
    r"\s*([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*(.*?)\s*$", re.S
)
_CYCLES = re.compile(r"(hz|hertz|cps)\b", re.I)
_ANGLES = re.compile(r"rad|deg|turn|rev|rpm", re.I)
_ALIASES = {
    "gpm": "(gallon / minute)",
    "lpm": "(liter / minute)",
    "in": "inch",
    "cc": "(cm**3)",
    "%": "percent",
    "°": "degree",
    "°C": "degC",
    "°F": "degF",
    "duty": "dimensionless",
    "counts": "dimensionless",
    "digits": "dimensionless",
}
# as instruments and spreadsheets have them; absolute pressures are not among them
_SPOKEN = {
    **dict.fromkeys(("volt", "volts", "vdc"), "V"),
    **dict.fromkeys(("amp", "amps", "ampere", "adc"), "A"),
    **dict.fromkeys(("barg", "bard", "bar(d)", "bar(g)", "bar g", "bar_g", "bars"), "bar"),
    **dict.fromkeys(("psig", "psid", "psi(g)", "psi(d)", "psi g", "lbf/in2"), "psi"),
    **dict.fromkeys(("kpa", "kpag", "kpa(g)"), "kPa"),
    **dict.fromkeys(("mpa", "mpag", "mpa(g)"), "MPa"),
    **dict.fromkeys(("pag", "pascal", "pascals"), "Pa"),
    **dict.fromkeys(("sec", "secs", "second", "seconds", "sekunden"), "s"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "µs", "μs", "microseconds"), "us"),
    **dict.fromkeys(("°/s", "deg/sec", "deg/s", "degrees/s", "dps"), "deg/s"),
    **dict.fromkeys(("degrees", "grad", "°"), "deg"),
    **dict.fromkeys(("mm/sec", "mm s-1"), "mm/s"),
    **dict.fromkeys(("m/sec", "m s-1"), "m/s"),
    **dict.fromkeys(("l/min", "ltr/min", "l/m", "lit/min", "slpm"), "L/min"),
    **dict.fromkeys(("gal/min", "usgpm", "us gpm", "gpm us", "gpm (us)", "us gal/min"), "gpm"),
    **dict.fromkeys(("u/min", "1/min", "r/min", "rev/min"), "rpm"),
    **dict.fromkeys(("percent", "pct", "prozent"), "%"),
    **dict.fromkeys(("count", "cts", "digit", "lsb", "raw", "inc"), "counts"),
    **dict.fromkeys(("deg c", "°c", "celsius", "degc"), "degC"),
    **dict.fromkeys(("deg f", "°f", "fahrenheit", "degf"), "degF"),
}
_ABSOLUTE = re.compile(r"(m?bar|psi|[km]?pa)[\s_]*\(?a(?:bs(?:ol\w*)?)?\.?\)?", re.I)
_GAUGE = {one.lower(): one for one in ("mbar", "bar", "psi", "Pa", "kPa", "MPa")}
_NO_UNIT = ("", "-", "1")
_LONGEST = 80  # characters of a unit
_WORD = r"(?:%|°[CF]?|[^\W\d_]\w*)"
_POWER = r"\s*(?:[²³]|(?:\*\*|\^)\s*[-+]?(?:0?\.5|[1-6](?:\.[05])?)(?![0-9.]))"
_JOIN = r"(?:\s*[*·⋅/]\s*|\s+)"
_FACTOR = rf"(?:√{_WORD}|(?:{_WORD}|1(?![0-9.]))(?:{_POWER})?)"
_PRODUCT = rf"{_FACTOR}(?:{_JOIN}{_FACTOR})*"
_GROUP = rf"(?:{_FACTOR}|\(\s*{_PRODUCT}\s*\)(?:{_POWER})?)"
_AREA = re.compile(
    r"\b([kcdm]?m|in|ft)([23])\b(?!\s*(?:\^|\*\*))"
)  # cm2, m3/h: a power without its sign
_UNIT = re.compile(rf"{_GROUP}(?:{_JOIN}{_GROUP})*")


# what else helps who gives a quantity in a unit that it cannot have
_INSTEAD = {
    "V": "; where a valve is driven in mA or %, count in volts of your own, as 1 V for 100 mA, "
    'here and in the map of columns, scale = "0.01 V/mA"',
    "m^3/(s*V*Pa^0.5)": "; a data sheet's flow at a drop goes in as "
    "rated = { flow, command, drop }",
    "m^3/(s*V)": "; a data sheet's flow goes in as rated = { flow, command }",
}


@lru_cache(maxsize=1)
def _registry() -> pint.UnitRegistry:
    import pint

    registry = pint.UnitRegistry(cache_folder=":auto:")
    registry.define("lb_mass = pound = lbm")
    registry.define("@alias turn = rev")
    return registry


def _checked(unit: str) -> str:
    """A unit as the registry takes it: words, products, quotients and small powers, nothing else.
    The registry by itself would evaluate any number and power in a text, however large.

    Raises:
        UnitError: it is made of anything else.
    """
    text = unit.strip()
    if text in _NO_UNIT:
        return "dimensionless"
    if len(text) > _LONGEST or not _UNIT.fullmatch(text):
        raise UnitError(f"unknown unit {shortened(unit, 60)}")
    text = re.sub("[·⋅]", "*", text).replace("²", "**2").replace("³", "**3")
    text = re.sub(rf"√({_WORD})", r"\1**0.5", text)
    text = _AREA.sub(r"\1**\2", text)
    return re.sub(_WORD, lambda result: _ALIASES.get(result[0], result[0]), text)


def _affine(unit: str, si: str) -> tuple[float, float]:
    """(factor, offset) with value_si = factor·value + offset.

    Raises:
        UnitError: no unit, or not of that dimension.
    """
    result = _tried(unit, si)
    if isinstance(result, str):
        raise UnitError(result)
    return result


@lru_cache(maxsize=512)
def _tried(unit: str, si: str) -> tuple[float, float] | str:
    """What `_affine` gives, or why it gives nothing: a text that may be an angle or a length is
    tried as both, again and again.
    """
    usual = IN_SI.get(unit)
    if usual is None or si not in SI:
        return asked(unit, si)
    return usual.get(si) or _cannot(unit, si)


def asked(unit: str, si: str) -> tuple[float, float] | str:
    """What the registry says of a unit: (factor, offset) with value_si = factor·value + offset, or
    why there is none.
    """
    try:
        return _converted(unit, si)
    except UnitError as error:
        return error.message


def _cannot(unit: str, si: str) -> str:
    return f"'{unit}' cannot be turned into {si}"


def _converted(unit: str, si: str) -> tuple[float, float]:
    text = _checked(unit)
    import pint

    registry = _registry()
    try:
        zero = registry.Quantity(0.0, text).to(si).magnitude
        item = registry.Quantity(1.0, text).to(si).magnitude
    except pint.DimensionalityError as error:
        raise UnitError(_cannot(unit, si)) from error
    except (
        Exception
    ) as error:  # pint raises tokenizer, attribute and assertion errors on malformed text
        raise UnitError(f"unknown unit '{unit}'") from error
    if not (math.isfinite(item) and math.isfinite(zero) and item != zero):
        raise UnitError(f"unknown unit '{unit}'")
    if si == "m^3/rad" and not _ANGLES.search(text):  # a turn or a radian is a factor of 6.28
        raise UnitError(f"'{unit}' says no angle")
    turns = 1.0
    if _CYCLES.search(text) and "rad" in si:  # the registry counts a cycle and a radian alike as 1
        turns = 2 * math.pi
    elif si == "Hz" and _ANGLES.search(text):
        turns = 0.5 / math.pi
    return turns * (item - zero), zero


@lru_cache(maxsize=512)
def named_unit(text: str) -> str:
    """The unit that a text of a foreign file means, as it is written here: ``bar`` of ``[bar(g)]``;
    '' of one that is no unit.
    """
    plain = text.strip()
    while len(plain) > 1 and plain[0] + plain[-1] in ("[]", "()", "{}", '""', "''"):
        plain = plain[1:-1].strip()
    if spoken := _SPOKEN.get(plain.lower()):
        return spoken
    if plain in (*_NO_UNIT, "dimensionless") or plain[:1].isdigit():
        return ""
    if plain in IN_SI:
        return plain
    try:
        known = _checked(plain)
        _registry().Unit(known)
    except Exception:  # pint raises all kinds on a text that is no unit
        return ""
    return plain


def absolute_unit(text: str) -> str:
    """The unit of an absolute pressure that a text of a foreign file means: ``bar`` of ``bar(a)``
    or ``bara``; '' of any other.
    """
    plain = text.strip()
    while len(plain) > 1 and plain[0] + plain[-1] in ("[]", "()", "{}", '""', "''"):
        plain = plain[1:-1].strip()
    match = _ABSOLUTE.fullmatch(plain)
    return _GAUGE[match[1].lower()] if match else ""


def split_number(text: str) -> tuple[float, str]:
    """``"0.625 V/mA"`` as (0.625, "V/mA"); the unit may be ''.

    Raises:
        UnitError: it does not begin with a number.
    """
    match = _NUMBER.match(text) if len(text) <= 3 * _LONGEST else None
    if not match or not math.isfinite(float(match[1])):
        raise UnitError(f"{shortened(text, 60)} is no number with a unit")
    return float(match[1]), match[2]


def product(first: str, second: str, si: str) -> float:
    """How many ``si`` one ``first`` times one ``second`` is: 1 of V/mA, mA and V.

    Raises:
        UnitError: no units, or not of that dimension together.
    """
    each = [item.strip() if item.strip() not in _NO_UNIT else "1" for item in (first, second)]
    return factor("*".join(f"({item})" if item != "1" else item for item in each), si)


def ratio(unit: str, other: str) -> float:
    """How many ``other`` one ``unit`` is, of whatever quantity.

    Raises:
        UnitError: no units, or not of one quantity.
    """
    return factor(unit, _checked(other))


def is_of(unit: str, row: Quantity) -> bool:
    """Whether a unit is one of a row's quantity."""
    return not isinstance(_tried(unit, row.unit), str)


def factor(unit: str, si: str) -> float:
    """How many ``si`` one ``unit`` is, for units without offset."""
    return _affine(unit, si)[0]


def to_si(value, unit: str, row: Quantity):
    """``value`` (number or array) in ``unit`` as SI of ``row``.

    Raises:
        UnitError: unknown unit or wrong dimension; says which units would be right.
    """
    if unit.strip() == row.unit:
        return value
    try:
        scale, offset = _affine(unit, row.unit)
    except UnitError as error:
        usual = ", ".join(dict.fromkeys((row.unit, row.display)))
        raise UnitError(
            f"{error.message} for {row.name}",
            hint=f"{row.name} is in {usual} or the like{_INSTEAD.get(row.unit, '')}",
        ) from None
    return value * scale + offset if offset else value * scale


def from_si(value, unit: str, row: Quantity):
    """SI ``value`` of ``row`` in ``unit``."""
    if unit == row.unit:
        return value
    scale, offset = _affine(unit, row.unit)
    return (value - offset) / scale


def parse(text: str, row: Quantity) -> float:
    """``"1000 psi"`` as an SI number of ``row``, checked against the row's plausible range.

    Raises:
        UnitError: no number, no unit, wrong unit, or a value that is surely a slip.
    """
    match = _NUMBER.match(text) if len(text) <= 3 * _LONGEST else None
    if not match:
        raise UnitError(
            f"{shortened(text, 60)} is no number with a unit for {row.name}",
            hint=f'write it like "1.5 {row.display}"',
        )
    number, unit = float(match[1]), match[2]
    if not unit and row.unit != "dimensionless":
        raise UnitError(
            f"{shortened(text, 60)} has no unit for {row.name}",
            hint=f'write it like "{match[1][:20]} {row.display}"',
        )
    value = float(to_si(number, unit, row))
    plausible(value, row, text.strip())
    return value


def unit_of(text: object) -> str:
    """The unit of a text such as ``"1000 psi"``; nothing for a number, or where there is none."""
    match = _NUMBER.match(text) if isinstance(text, str) else None
    return match[2].strip() if match else ""


def zero_of(text: str, row: Quantity) -> float:
    """What "0" of the unit of a text is in SI of ``row``: 273.15 of ``"2 degC"``, else mostly 0."""
    match = _NUMBER.match(text)
    unit = match[2] if match else ""
    return 0.0 if unit in ("", row.unit) else _affine(unit, row.unit)[1]


def plausible(value: float, row: Quantity, shown: str) -> None:
    """Refuse an SI value outside the row's range.

    Raises:
        UnitError: names the range in the row's display unit.
    """
    if not row.lower <= value <= row.upper:
        low, high = (
            from_si(v, row.display, row) if abs(v) != float("inf") else v
            for v in (row.lower, row.upper)
        )
        unit = "" if row.display == "dimensionless" else f" {row.display}"
        raise UnitError(
            f"{row.name} = {shown} lies outside {low:g} to {high:g}{unit}",
            hint="check the unit and the sign" if unit else "check the number and its sign",
        )
