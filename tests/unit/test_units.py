"""Conversion at the door, against numbers known from elsewhere."""

import inspect
import math
import re
import time
from typing import get_args

import pytest

from ehbench.config import recipe, rig
from ehbench.parts import sample
from ehbench.vocabulary.errors import UnitError
from ehbench.vocabulary.fields import FileModel, Q, Value
from ehbench.vocabulary.quantities import VOCABULARY, like_channel, quantity
from ehbench.vocabulary.units import from_si, is_of, named_unit, parse, to_si
from tests.shared import refused
from tools import reference


@pytest.mark.parametrize(
    ("text", "name", "si"),
    [
        ("1000 psi", "pressure", 6894757.2932),
        ("8 gpm", "flow", 8 * 3.785411784e-3 / 60),
        ("8 gallon/minute", "flow", 8 * 3.785411784e-3 / 60),
        ("60 L/min", "flow", 1e-3),
        ("2 in", "bore", 0.0508),
        ("90 deg", "q", math.pi / 2),
        ("30 Hz", "natural_frequency", 60 * math.pi),
        ("0.03 kHz", "natural_frequency", 60 * math.pi),
        ("60 rad/s", "natural_frequency", 60.0),
        ("60 rad/s", "frequency", 30 / math.pi),
        ("600 rpm", "frequency", 10.0),
        ("2 kHz", "rate", 2000.0),
        ("40 degC", "temperature", 313.15),
        ("140 degF", "temperature", 333.15),
        ("0.7", "damping_ratio", 0.7),
        ("5 mm/s", "v", 0.005),
        ("1e3 mm", "x", 1.0),
        ("3.59e-8 m^3/(s*V*Pa^0.5)", "flow_gain", 3.59e-8),
        ("2 cm\t^2", "area_head", 2e-4),
        ("2 cm\r\n^2", "area_head", 2e-4),
        ("50 ksi", "relief_pressure", None),
    ],
)
def test_parse(text, name, si):
    if si is None:
        with pytest.raises(UnitError, match="lies outside"):
            parse(text, VOCABULARY[name])
        return
    row = VOCABULARY[name]
    value = parse(text, row)
    # conversion factors are exact to more digits than this
    assert value == pytest.approx(si, rel=1e-9)
    unit = text.split(" ", 1)[1] if " " in text else "dimensionless"
    assert to_si(from_si(value, unit, row), unit, row) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(("text", "gauge"), [("40 psia", "psi"), ("9 bara", "bar")])
def test_an_absolute_pressure_is_refused_with_its_gauge_unit(text, gauge):
    with pytest.raises(UnitError) as error:
        parse(text, VOCABULARY["pressure"])
    assert f"write {gauge}" in str(error.value.hint)


@pytest.mark.parametrize("text", ["12", "kPa", "", "12 kg", "12 furlongz", "12 kPa kPa(", "nan Pa"])
def test_refused(text):
    with pytest.raises(UnitError):
        parse(text, VOCABULARY["pressure"])


NO_UNITS = """
m*9**9**9 9**9**9*s m**9 m^99 m^2^2 (m^6)^6^6 ((m)) m*1e9 m^^2 m/ /m m() m(s) m**-9**9 m^0.25
__import__('os') m\0 ² m^² m2^2 m2**9
""".split()
NO_UNITS += ["m 2", "2 m", "m;import os", "m\n*9**9", "m" * 5000, "(" * 5000, "m*" * 39 + "m*m"]


@pytest.mark.parametrize("unit", NO_UNITS)
def test_a_unit_is_made_of_words_and_small_powers_only(unit):
    """Nothing of a text is evaluated: each is refused at once."""
    begun = time.monotonic()
    for row in ("x", "t", "pressure"):
        with pytest.raises(UnitError) as error:
            to_si(1.0, unit, VOCABULARY[row])
        assert len(str(error.value)) < 400
        with pytest.raises(UnitError):
            parse(f"5 {unit}", VOCABULARY[row])
    assert time.monotonic() - begun < 2.0


@pytest.mark.parametrize(
    ("unit", "name", "si"),
    [
        ("cm²", "area_head", 1e-4),
        ("m³/(s·Pa)", "leakage_internal", 1.0),
        ("m^3 / (s * Pa)", "leakage_internal", 1.0),
        ("L/min/√bar", "orifice_gain", 1e-3 / 60 / math.sqrt(1e5)),
        ("(L/min)/(V*bar^0.5)", "flow_gain", 1e-3 / 60 / math.sqrt(1e5)),
        ("L/min/V/bar**0.5", "flow_gain", 1e-3 / 60 / math.sqrt(1e5)),
        ("m s^-1", "v", 1.0),
        ("cubic inch", "volume", 0.0254**3),
        ("cc", "volume", 1e-6),
        ("in^3", "volume", 0.0254**3),
        ("cc/rev", "displacement", 1e-6 / (2 * math.pi)),
        ("1/V", "flow_force", 1.0),
        ("°", "q", math.pi / 180),
        ("%", "air_fraction", 0.01),
        ("µm", "x", 1e-6),
        ("(kg)*(m^2)", "inertia", 1.0),
        ("kN/cm2", "pressure", 1e7),
        ("kg*m2", "inertia", 1.0),
        ("m3/h", "flow", 1 / 3600),
    ],
)
def test_units_as_people_write_them(unit, name, si):
    assert to_si(1.0, unit, VOCABULARY[name]) == pytest.approx(si, rel=1e-9)


def test_digits_of_other_scripts_and_decimal_commas_are_no_number():
    for text in ("１２ mm", "١٢ mm", "3,0 in", "30,5 mm", "1,000 mm"):
        with pytest.raises(UnitError, match="no number"):
            parse(text, VOCABULARY["x"])


UNITS = """
% 1/V 1/s A C GPa Hz J K L L/min L/min/V L/min/V/MPa^0.5 L/min/V/bar^0.5 L/min/bar L/min/mA L/s/V
MPa/s N*m N*m*s/rad N*s/m N/mm Pa*s Pa*s/m^3 Pa/V V/mA W bar bar*min/L bar/mA cc/rev cm/s cm^2 daN
deg/V deg/s^2 degC degF ft/s g gpm gpm/V/MPa^0.5 h hp in/s in^3 kHz kN*m*s/rad kN/mm kPa/s kW
kg*m^2 ksi km lb lbf lpm m/V m/rad m^3/(s*V*Pa^0.5) m^3/h mL/rev mL/s mV mbar min mm/rad mm/s^2 ms
ns psi psi/V rad/(s*V) rad/s^2 rpm rpm/mA t turn um us µm/s atm mmHg cP cSt kgf inch/second
kilopascal newtons kelvin gallon/minute kN/cm**2 1/min
"""
IN_PINT = {"%": "percent", "gpm": "gallon/minute", "lpm": "liter/minute", "cc": "cm**3"}


def test_units_are_as_pint_has_them():
    """Factor and zero of every unit; pint counts a cycle and a radian alike as one."""
    import pint

    registry = pint.UnitRegistry()
    registry.define("@alias turn = rev")
    for unit in UNITS.split():
        text = re.sub(r"\b(gpm|lpm|cc)\b|%", lambda match: f"({IN_PINT[match[0]]})", unit)
        for row in {row.unit: row for row in VOCABULARY.values()}.values():
            try:
                # pyrefly: ignore[bad-argument-count]
                zero, one = (registry.Quantity(x, text).to(row.unit).magnitude for x in (0.0, 1.0))
            except pint.DimensionalityError:
                assert not is_of(unit, row), (unit, row.unit)
                continue
            cycles = 2 * math.pi if "Hz" in unit and "rad" in row.unit else 1.0
            cycles = 0.5 / math.pi if "Hz" == row.unit and "rpm" == unit else cycles
            if row.unit == "m^3/rad" and "rev" not in unit:
                assert not is_of(unit, row), unit
            else:
                ends = to_si(0.0, unit, row), to_si(1.0, unit, row)
                expected = pytest.approx((zero, zero + cycles * (one - zero)), rel=1e-12)
                assert ends == expected, (unit, row.unit)


@pytest.mark.parametrize(
    "unit", ["degC/V", "1/degF", "kPaa", "kmin", "mrpm", "csv", "rod", "a", "B"]
)
def test_what_is_no_unit(unit):
    assert named_unit(unit) == ""
    with refused("vocabulary.unit_for_quantity", UnitError):
        to_si(1.0, unit, VOCABULARY["pressure"])


# --- every unit converts both ways, and every float field of a rig or recipe has a row


def test_every_row_says_what_it_is_and_units_convert_both_ways():
    for row in VOCABULARY.values():
        back = to_si(from_si(1.234, row.display, row), row.display, row)
        assert back == pytest.approx(1.234, rel=1e-12), row.name
        assert row.meaning and row.symbol and row.lower < row.upper, row.name


def test_a_sample_has_the_channels_that_the_vocabulary_says_are_measured():
    """A measured channel is a row with a sensor; this names what a new one still lacks."""
    measured = {
        place: tuple(row.name for row in VOCABULARY.values() if row.sensor == place)
        for place in ("cylinder", "supply")
    }
    assert measured == {"cylinder": sample.OF._fields, "supply": sample.LINE._fields}


def models():
    yield from reference.models([rig.Rig])
    for module in (rig, recipe):
        for item in filter(inspect.isclass, vars(module).values()):
            if issubclass(item, FileModel) and item.__module__.startswith(module.__name__):
                yield item


def is_bare(field):
    """Whether a field holds values, but of no quantity."""
    kinds = (field.annotation, *get_args(field.annotation))
    if not (Value in kinds or any(Value in get_args(kind) for kind in kinds)):
        return False
    marks = list(field.metadata) + [m for kind in kinds for m in getattr(kind, "__metadata__", ())]
    return not any(isinstance(mark, Q) and mark.row for mark in marks)


def test_every_quantity_field_has_a_row():
    every = list(models())
    assert len(every) > 30
    for model in every:
        bare = [name for name, field in model.model_fields.items() if is_bare(field)]
        assert not bare, model.__name__


@pytest.mark.parametrize(
    ("channel", "said"),
    [
        ("press.servo", "; if 'servo' is a valve, its command is 'press.servo.command'"),
        ("press.p_haed", "; nearest is 'press.p_head'"),
        ("p_haed", "; nearest is 'p_head'"),
        ("zzz", ""),
    ],
)
def test_a_word_that_is_none_is_answered_with_what_may_be_meant(channel, said):
    with pytest.raises(KeyError) as caught:
        quantity(channel)
    assert caught.value.args[0] == f"no quantity '{channel.split('.')[-1]}'{said}"


def test_a_channel_that_a_log_lacks_is_answered_with_the_one_that_is_meant():
    there = ["press.x", "press.p_head", "press.servo.command"]
    for name in ("press.servo", "servo", "servo.command", "press.serv.command"):
        assert like_channel(name, there).startswith("did you mean 'press.servo.command'? it has ")
    assert like_channel("press", there) == f"it has {', '.join(there)}"
