"""The constant-pressure supply."""

from __future__ import annotations

from ehbench.compiled import kernel

# set pressure, tank pressure, flow limit, volume, bulk modulus
P_SET, P_TANK, FLOW_LIMIT, VOLUME, BULK = 0, 1, 2, 3, 4
SUPPLY_FLOATS = 5
RECOVERY_TIME = 0.02


@kernel
def pump_flow(p_supply, demand, supply):
    """Flow [m³/s] a pressure-compensated pump delivers at ``p_supply`` [Pa] and ``demand`` [m³/s].

    The compensator covers the demand exactly and brings a lost pressure back with time constant
    RECOVERY_TIME, both only up to FLOW_LIMIT: below the limit the pressure is constant, above it
    the pressure falls."""
    wanted = demand + supply[VOLUME] / (supply[BULK] * RECOVERY_TIME) * (supply[P_SET] - p_supply)
    return min(max(wanted, 0.0), supply[FLOW_LIMIT])
