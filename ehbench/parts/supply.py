"""The supply: a pressure-compensated pump on a line of oil, an accumulator beside or instead."""

from __future__ import annotations

from ehbench.compiled import part_kernel, record
from ehbench.parts.accumulator import COLUMNS as ACCUMULATOR
from ehbench.parts.accumulator import gas_capacity
from ehbench.parts.oil import OIL_COLUMNS, bulk_of

RECOVERY_TIME = 0.02  # [s]

# ``pressure`` the set pressure [Pa], ``flow_limit`` [m³/s], ``volume`` of the line [m³], the
# OIL_COLUMNS of its oil, the columns of its accumulator
SUPPLY = record(
    ("pressure", "f8"), ("flow_limit", "f8"), ("volume", "f8"), *OIL_COLUMNS, *ACCUMULATOR
)


@part_kernel
def line_stiffness(p_supply, supply):
    """Rise of pressure per oil [Pa/m³] of the supply line at ``p_supply`` [Pa]."""
    bulk_modulus = bulk_of(supply, p_supply)
    if supply.gas_volume == 0.0:
        return bulk_modulus / supply.volume
    return 1.0 / (supply.volume / bulk_modulus + gas_capacity(p_supply, supply))


@part_kernel
def pump_flow(p_supply, demand, supply):
    """Flow [m³/s] a pressure-compensated pump delivers at ``p_supply`` [Pa] and ``demand`` [m³/s].

    The compensator covers the demand exactly and brings a lost pressure back with time constant
    RECOVERY_TIME, both only up to the flow limit: below it the pressure is constant, above it the
    pressure falls."""
    missing = supply.pressure - p_supply
    wanted = demand + supply.volume / (supply.bulk_modulus * RECOVERY_TIME) * missing
    if supply.gas_volume > 0.0:
        wanted += gas_capacity(p_supply, supply) / RECOVERY_TIME * missing
    return min(max(wanted, 0.0), supply.flow_limit)
