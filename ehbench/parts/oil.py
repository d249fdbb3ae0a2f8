"""The oil: its stiffness at a pressure, with free air or without, and its energy."""

import math

import numpy as np

from ehbench.parts.fault import Amount, Fault
from ehbench.physics.cylinder import ATMOSPHERE
from ehbench.runtime.compiled import part_kernel

LEAST = 500.0  # [Pa], absolute: below it the air grows no further
EXPONENT = 1.4  # of air that is compressed without heat
# the columns of a record of oil: bulk modulus of oil alone [Pa], share of free air, its exponent
OIL_COLUMNS = (("bulk_modulus", "f8"), ("air", "f8"), ("polytropic", "f8"))
_NODES, _WEIGHTS = (tuple(map(float, side)) for side in np.polynomial.legendre.leggauss(16))


@part_kernel
def bulk(pressure, solid, air, exponent):
    """Bulk modulus [Pa] of oil with free air: ``1/β = 1/β_solid + α/(n p) (p0/p)^(1/n)``, p
    absolute.

    The air is compressed polytropically from its share α at atmospheric pressure p0, so a chamber
    gets softer as its pressure falls and cannot be drawn below vacuum."""
    if air == 0.0:
        return solid
    p = max(pressure + ATMOSPHERE, LEAST)
    return 1.0 / (1.0 / solid + air / (exponent * p) * (ATMOSPHERE / p) ** (1.0 / exponent))


@part_kernel
def bulk_of(row, pressure):
    """Bulk modulus [Pa] at a pressure [Pa] of the oil of a row that has OIL_COLUMNS."""
    return bulk(pressure, row.bulk_modulus, row.air, row.polytropic)


@part_kernel
def compressed(pressure, bulk_modulus):
    """Energy [J/m³] in oil compressed to gauge pressure p: ``u = β (e^(p/β) − 1) − p ≈ p²/2β``."""
    return bulk_modulus * math.expm1(pressure / bulk_modulus) - pressure


@part_kernel
def _squeezed(pressure, solid, air, exponent):
    """``G = ∫_0^p dp/β`` [1]: the logarithm of how much denser the oil is than at zero gauge."""
    p = max(pressure + ATMOSPHERE, LEAST)
    return pressure / solid + air * (1.0 - (ATMOSPHERE / p) ** (1.0 / exponent))


@part_kernel
def stored(row, pressure):
    """Energy [J/m³] in the oil of a row compressed to gauge pressure p, by its own β(p).

    It obeys ``β du/dp = p + u``, u(0) = 0, with which flow work closes against the chamber law
    (see `ehbench.ledger`): ``u = e^G(p) ∫_0^p s/β(s) e^−G(s) ds``, G = ∫ dp/β. Without air that is
    `compressed`; with it the integral is taken over the logarithm of the absolute pressure, by 16
    points of Gauss and Legendre: to rounding."""
    if row.air == 0.0:
        return compressed(pressure, row.bulk_modulus)
    solid, air, exponent = row.bulk_modulus, row.air, row.polytropic
    half = 0.5 * math.log(max(pressure + ATMOSPHERE, LEAST) / ATMOSPHERE)
    top, total = _squeezed(pressure, solid, air, exponent), 0.0
    for i in range(len(_NODES)):
        p = ATMOSPHERE * math.exp(half * (1.0 + _NODES[i]))
        s = p - ATMOSPHERE
        dense = math.exp(top - _squeezed(s, solid, air, exponent))
        total += _WEIGHTS[i] * p * s / bulk(s, solid, air, exponent) * dense
    return half * total


FAULTS = (
    Fault("bulk modulus", ("bulk_modulus",), trials=(-0.3, -0.15, 0.15, 0.4), rank=2, wide=True),
    Fault(
        "air",
        ("air_fraction",),
        step=0.0,
        wide=True,
        upper=Amount((0.1,), "unit"),
        table="air_fraction",
        adds={"air_fraction": Amount((0.005,), "unit")},
    ),
    Fault("air fraction", ("air_fraction",), step=0.1, wide=True, rank=5),
)
