"""A gas-charged accumulator on the supply line.

``p V_gas^n = const``, p absolute: oil at line pressure p has pressed the gas from its own volume
``gas_volume`` at ``precharge`` down to ``V_gas = gas_volume (precharge/p)^(1/n)``. Below the
precharge the accumulator holds no oil."""

import math

import numpy as np

from ehbench.parts.fault import Fault
from ehbench.physics.cylinder import ATMOSPHERE
from ehbench.runtime.compiled import part_kernel

# ``gas_volume`` [m³], 0 for no accumulator; ``precharge`` [Pa], gauge; ``polytropic_exponent``
COLUMNS = (("gas_volume", "f8"), ("precharge", "f8"), ("polytropic_exponent", "f8"))
_POINTS, _WEIGHTS = (tuple(float(v) for v in half) for half in np.polynomial.legendre.leggauss(12))


@part_kernel
def gas_capacity(pressure, row):
    """Oil [m³/Pa] that the accumulator takes for a rise of pressure [Pa]: ``V_gas/(n p)``."""
    if row.gas_volume == 0.0 or pressure <= row.precharge:
        return 0.0
    p, n = pressure + ATMOSPHERE, row.polytropic_exponent
    gas = row.gas_volume * ((row.precharge + ATMOSPHERE) / p) ** (1.0 / n)
    return gas / (n * p)


@part_kernel
def gas_energy(pressure, row):
    """Energy [J] that oil of the supply line brought into the accumulator up to a pressure [Pa].

    ``∫ (p + u) V_gas/(n p_abs) dp`` from the precharge: the work on the gas against the atmosphere,
    and the oil's own compression energy u per volume. Gauss–Legendre in ln p, exact to rounding."""
    if row.gas_volume == 0.0 or pressure <= row.precharge:
        return 0.0
    first = math.log(row.precharge + ATMOSPHERE)
    half = 0.5 * (math.log(pressure + ATMOSPHERE) - first)
    fixed = 0.0
    for i in range(len(_POINTS)):
        p = math.exp(first + half * (1.0 + _POINTS[i])) - ATMOSPHERE
        carried = row.bulk_modulus * math.expm1(p / row.bulk_modulus)
        fixed += _WEIGHTS[i] * carried * gas_capacity(p, row) * (p + ATMOSPHERE)
    return half * fixed


FAULTS = (
    Fault("gas volume", ("gas_volume",), step=0.05, trials=(-0.5, 1.0), rank=4, wide=True),
    Fault("precharge", ("precharge",), step=0.02, high=1.0, rank=5, wide=True),
)
