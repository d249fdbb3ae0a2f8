"""Units: a table of base factors (``units.toml`` beside this file), one grammar over it, and
conversion to and from SI.

A unit is made of words, products, quotients and small powers: ``m^3/(s*V*Pa^0.5)``, ``L/min/√bar``,
``kg·m²``. Nothing else of a text is read and nothing is evaluated. Pressures are gauge. Angles
count in radians or in cycles; a unit that names neither, such as ``1/s``, fits both."""

from __future__ import annotations

import math
import re
import tomllib
import unicodedata
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ehbench.vocabulary.errors import UnitError
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.quantities import Quantity
from ehbench.vocabulary.text import shortened

_DIMENSIONS = ("kg", "m", "s", "A", "K", "rad", "cycle")
_ANGLE, _CYCLE = _DIMENSIONS.index("rad"), _DIMENSIONS.index("cycle")
with Path(__file__).with_suffix(".toml").open("rb") as _file:
    _TABLE: dict[str, Any] = tomllib.load(_file)
_ZEROS = {"degC": 273.15, "°C": 273.15, "degF": 459.67 / 1.8, "°F": 459.67 / 1.8}  # [K]

_NUMBER = re.compile(
    r"\s*((?>[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?))(?!,)\s*(.*?)\s*$", re.S
)
_LONGEST = 80  # characters of a unit
_WORD = r"(?:%|°[CF]?|[^\W\d_]\w*)"
_SUPERSCRIPT = re.compile("[²³⁴⁵⁶]")
_POWER = r"\s*(?:\*\*|\^)\s*[-+]?(?:0?\.5|[1-6](?:\.[05])?)(?![0-9.])"
_JOIN = r"(?:\s*[*·⋅/]\s*|\s+)"
_FACTOR = rf"(?:√{_WORD}|(?:{_WORD}|1(?![0-9.]))(?:{_POWER})?)"
_PRODUCT = rf"{_FACTOR}(?:{_JOIN}{_FACTOR})*"
_GROUP = rf"(?:{_FACTOR}|\(\s*{_PRODUCT}\s*\)(?:{_POWER})?)"
_UNIT = re.compile(rf"{_GROUP}(?:{_JOIN}{_GROUP})*")
_PIECE = re.compile(
    rf"(?P<join>{_JOIN})?(?:\(\s*(?P<group>{_PRODUCT})\s*\)|(?P<root>√)?(?P<word>{_WORD}|1))"
    rf"(?P<power>{_POWER})?"
)
_BARE_POWER = re.compile(r"\b([kcdm]?m|in|ft)([23])\b(?!\s*(?:\^|\*\*))")  # cm2, m3/h
_CUBIC = re.compile(rf"\bcubic ({_WORD})")
MIXED: dict[str, list[str]] = _TABLE["mixed"]
_NO_UNIT = ("", "-", "1")

_SPOKEN = {word: unit for unit, words in _TABLE["spoken"].items() for word in words}
_ABSOLUTE = re.compile(r"(m?bar|psi|[km]?pa)[\s_]*\(?a(?:bs(?:ol\w*)?)?\.?\)?", re.I)
_GAUGE = {unit.lower(): unit for unit in ("mbar", "bar", "psi", "Pa", "kPa", "MPa")}

_GERMAN = {"Grad": "deg", "GRAD": "deg"}
_TWO_MEANINGS = ("grad", "mPa")  # a degree or a gon; MPa, as nobody measures oil in mPa

# how else to give a quantity that a data sheet has in another form
_INSTEAD = {
    "V": "vocabulary.instead_volts",
    "m^3/(s*V*Pa^0.5)": "vocabulary.instead_rated_drop",
    "m^3/(s*V)": "vocabulary.instead_rated_flow",
}


class _Unit(NamedTuple):
    """``factor`` of SI units to ``powers`` of the dimensions, counting from ``zero`` [SI]."""

    factor: float
    powers: tuple[float, ...]
    zero: float = 0.0

    def times(self, other: _Unit, power: float) -> _Unit:
        """This unit times a power of another.

        Raises:
            KeyError: the other counts from a zero of its own."""
        if other.zero:
            raise KeyError
        # a division and a root round once where a negative or broken power rounds twice
        scale = math.sqrt(other.factor) if abs(power) == 0.5 else other.factor ** abs(power)
        factor = self.factor / scale if power < 0.0 else self.factor * scale
        return _Unit(factor, tuple(a + power * b for a, b in zip(self.powers, other.powers)))


_ONE = _Unit(1.0, (0.0,) * len(_DIMENSIONS))


@lru_cache(maxsize=1)
def _words() -> dict[str, _Unit]:
    """The units of the table by each of their words, with prefixes and in the plural."""
    results = {
        name: _Unit(1.0, tuple(float(name == other) for other in _DIMENSIONS))
        for name in _DIMENSIONS
    }
    scaled: dict[str, _Unit] = {}
    for words, factor, of, takes_prefixes in _TABLE["base"]:
        base = _product(of, results)
        unit = _Unit(factor * base.factor, base.powers)
        for word in words.split():
            results.setdefault(word, unit)
            prefixes = _TABLE["prefixes"] if takes_prefixes else {}
            scaled |= {p + word: _Unit(x * unit.factor, unit.powers) for p, x in prefixes.items()}
    scale = {"K": 1.0, "C": 1.0, "F": 1.0 / 1.8}
    kelvin = results["K"].powers
    zeros = {word: _Unit(scale[word[-1]], kelvin, zero) for word, zero in _ZEROS.items()}
    results = {**scaled, **results, **zeros}
    return {**{f"{word}s": unit for word, unit in results.items() if len(word) > 3}, **results}


def _product(text: str, words: dict[str, _Unit]) -> _Unit:
    """A product of words as one unit.

    Raises:
        KeyError: a word that is no unit."""
    result, pieces = _ONE, list(_PIECE.finditer(text))
    for piece in pieces:
        part = words[piece["word"]] if piece["word"] else _product(piece["group"], words)
        power = 0.5 if piece["root"] else float(re.sub(r"[*^\s]", "", piece["power"] or "1"))
        power = -power if "/" in (piece["join"] or "") else power
        if len(pieces) == 1 and power == 1.0:
            return part
        result = result.times(part, power)
    return result


@lru_cache(maxsize=1024)
def _unit(text: str) -> _Unit | None:
    """A unit as it is written; None of a text that is none."""
    plain = _SUPERSCRIPT.sub(lambda match: f"^{unicodedata.digit(match[0])}", text.strip())
    plain = _BARE_POWER.sub(r"\1^\2", _CUBIC.sub(r"\1^3", plain))
    if plain in _NO_UNIT:
        return _ONE
    if len(plain) > _LONGEST or not _UNIT.fullmatch(plain):
        return None
    try:
        result = _product(plain, _words())
    except (KeyError, OverflowError, ZeroDivisionError):
        return None
    return result if 0.0 < result.factor < math.inf else None


@lru_cache(maxsize=1024)
def _conversion(unit: str, si: str) -> tuple[float, float] | Message:
    """(factor, offset) with value_si = factor·value + offset, or why there is none."""
    given, target = _unit(unit), _unit(si)
    if given is None or target is None:
        return message("vocabulary.unknown_unit", unit=shortened(unit, 60))
    if given.powers[:_ANGLE] != target.powers[:_ANGLE]:
        return message("vocabulary.unit_of_another_kind", unit=unit, si=si)
    angle, cycle = given.powers[_ANGLE], given.powers[_CYCLE]
    if si == "m^3/rad" and not (angle or cycle):  # a turn or a radian is a factor of 6.28
        return message("vocabulary.unit_without_angle", unit=unit)
    turns = cycle if target.powers[_ANGLE] else -angle if target.powers[_CYCLE] else 0.0
    return (2.0 * math.pi) ** turns * given.factor / target.factor, given.zero


def factor(unit: str, si: str) -> float:
    """How many ``si`` one ``unit`` is, for units without offset.

    Raises:
        UnitError: no unit, or not of that dimension."""
    result = _conversion(unit, si)
    if isinstance(result, Message):
        raise UnitError(result)
    return result[0]


def product(first: str, second: str, si: str) -> float:
    """How many ``si`` one ``first`` times one ``second`` is: 1 of V/mA, mA and V.

    Raises:
        UnitError: no units, or not of that dimension together."""
    each = [item.strip() if item.strip() not in _NO_UNIT else "1" for item in (first, second)]
    return factor("*".join(f"({item})" if item != "1" else item for item in each), si)


def exponents(unit: str) -> dict[str, int]:
    """Powers of kg, m, s, A, K and rad of an SI unit, without zeros; empty of a unit with roots."""
    result = _unit(unit)
    if result is None or result.factor != 1.0 or result.powers[_CYCLE]:
        return {}
    if not all(power.is_integer() for power in result.powers):
        return {}
    return {name: int(power) for name, power in zip(_DIMENSIONS, result.powers) if power}


def is_of(unit: str, row: Quantity) -> bool:
    """Whether a unit is one of a row's quantity."""
    return not isinstance(_conversion(unit, row.unit), Message)


def is_share(unit: str) -> bool:
    """Whether a unit has no dimension: counts, percents."""
    result = _unit(unit)
    return result is not None and not any(result.powers)


def _unwrapped(text: str) -> str:
    plain = text.strip()
    while len(plain) > 1 and plain[0] + plain[-1] in ("[]", "()", "{}", '""', "''"):
        plain = plain[1:-1].strip()
    return plain


@lru_cache(maxsize=512)
def named_unit(text: str) -> str:
    """The unit a foreign text means: ``bar`` of ``[bar(g)]``; '' of one that is no unit."""
    plain = _unwrapped(text)
    if plain in _TWO_MEANINGS:
        return ""
    if spoken := _GERMAN.get(plain) or _SPOKEN.get(plain.lower()):
        return spoken
    if plain in (*_NO_UNIT, "dimensionless") or plain[:1].isdigit():
        return ""
    return plain if _unit(plain) else ""


def absolute_unit(text: str) -> str:
    """The unit of an absolute pressure in a foreign text: ``bar`` of ``bara``; '' else."""
    match = _ABSOLUTE.fullmatch(_unwrapped(text))
    return _GAUGE[match[1].lower()] if match else ""


def split_number(text: str) -> tuple[float, str]:
    """``"0.625 V/mA"`` as (0.625, "V/mA"); the unit may be ''.

    Raises:
        UnitError: it does not begin with a number."""
    match = _NUMBER.match(text) if len(text) <= 3 * _LONGEST else None
    if not match or not math.isfinite(float(match[1])):
        raise UnitError(message("vocabulary.no_number_with_unit", text=shortened(text, 60)))
    return float(match[1]), match[2]


def to_si(value, unit: str, row: Quantity):
    """``value`` (number or array) in ``unit`` as SI of ``row``.

    Raises:
        UnitError: unknown unit or wrong dimension; says which units would be right."""
    if unit.strip() == row.unit:
        return value
    result = _conversion(unit, row.unit)
    if isinstance(result, Message):
        usual = ", ".join(dict.fromkeys((row.unit, row.display)))
        instead = _INSTEAD.get(row.unit, "")
        hint = message("vocabulary.usual_units", name=row.name, usual=usual)
        more = message(instead) if instead else ""
        if gauge := absolute_unit(unit):
            more = message("vocabulary.instead_gauge", gauge=gauge)
        text = message("vocabulary.unit_for_quantity", reason=result, name=row.name)
        raise UnitError(text, hint="; ".join(filter(None, (hint, more))))
    scale, offset = result
    return value * scale + offset if offset else value * scale


def from_si(value, unit: str, row: Quantity):
    """SI ``value`` of ``row`` in ``unit``.

    Raises:
        UnitError: no unit, or not of the row's dimension."""
    if unit == row.unit:
        return value
    result = _conversion(unit, row.unit)
    if isinstance(result, Message):
        raise UnitError(result)
    scale, offset = result
    return (value - offset) / scale


def parse(text: str, row: Quantity) -> float:
    """``"1000 psi"`` as an SI number of ``row``, checked against the row's plausible range.

    Raises:
        UnitError: no number, no unit, wrong unit, or a value that is surely a slip."""
    match = _NUMBER.match(text) if len(text) <= 3 * _LONGEST else None
    fields = {"text": shortened(text, 60), "name": row.name, "display": row.display}
    if not match:
        raise UnitError(message("vocabulary.no_number_for", **fields))
    if not match[2] and row.unit != "dimensionless":
        raise UnitError(message("vocabulary.no_unit", number=match[1][:20], **fields))
    value = float(to_si(float(match[1]), match[2], row))
    plausible(value, row, text.strip(), match[2].strip())
    return value


def unit_of(text: object) -> str:
    """The unit of a text such as ``"1000 psi"``; nothing for a number, or where there is none."""
    match = _NUMBER.match(text) if isinstance(text, str) else None
    return match[2].strip() if match else ""


def zero_of(text: str, row: Quantity) -> float:
    """What "0" of the unit of a text is in SI of ``row``: 273.15 of ``"2 degC"``, else mostly 0."""
    return float(to_si(0.0, unit_of(text) or row.unit, row))


def plausible(value: float, row: Quantity, shown: str, given: str = "") -> None:
    """Refuse an SI value outside the row's range, ``shown`` as it was ``given`` in a unit.

    Raises:
        UnitError: names the range in that unit, else in the row's display unit."""
    if not row.lower <= value <= row.upper:
        unit = given or row.display
        low, high = (
            from_si(v, unit, row) if math.isfinite(v) else v for v in (row.lower, row.upper)
        )
        unit = "" if unit == "dimensionless" else f" {unit}"
        key = "vocabulary.implausible" if unit else "vocabulary.implausible_number"
        fields = {"name": row.name, "shown": shown, "low": low, "high": high, "unit": unit}
        raise UnitError(message(key, fits=fitting(value, given, row), **fields))


def fitting(value: float, unit: str, row: Quantity) -> str:
    """The units in which the number of an SI ``value`` in ``unit`` would be usual for a row, as the
    end of a sentence; '' of none."""
    low, high = row.usual
    units = [other for other in MIXED.get(row.unit, ()) if other != unit]
    number = from_si(value, unit, row) if math.isfinite(low) else math.nan
    fits = [other for other in units if low <= to_si(number, other, row) <= high]
    return message("vocabulary.fits", units=" or ".join(fits)) if fits else ""
