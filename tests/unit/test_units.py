"""Conversion at the door, against numbers known from elsewhere."""

from __future__ import annotations

import math

import pytest

from ehbench.errors import UnitError
from ehbench.quantities import VOCABULARY
from ehbench.units import from_si, parse, to_si


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
        ("50 ksi", "relief_pressure", None),
    ],
)
def test_parse(text, name, si):
    if si is None:
        with pytest.raises(UnitError, match="lies outside"):
            parse(text, VOCABULARY[name])
        return
    value = parse(text, VOCABULARY[name])
    assert value == pytest.approx(
        si, rel=1e-9
    )  # conversion factors are exact to more digits than this
    unit = text.split(" ", 1)[1] if " " in text else "dimensionless"
    assert to_si(from_si(value, unit, VOCABULARY[name]), unit, VOCABULARY[name]) == pytest.approx(
        value, rel=1e-12
    )


@pytest.mark.parametrize("text", ["12", "kPa", "", "12 kg", "12 furlongz", "12 kPa kPa(", "nan Pa"])
def test_refused(text):
    with pytest.raises(UnitError):
        parse(text, VOCABULARY["pressure"])
