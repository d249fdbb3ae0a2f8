"""The supply: a pressure-compensated pump on a line of oil, an accumulator beside or instead.

Its pressure is constant, or follows the load (load sensing), or there is a second, lower one, from
which an edge takes where that is enough (two rails)."""

from ehbench.parts.accumulator import COLUMNS as ACCUMULATOR
from ehbench.parts.accumulator import gas_capacity
from ehbench.parts.fault import Amount, Fault
from ehbench.parts.oil import OIL_COLUMNS, bulk_of
from ehbench.runtime.compiled import part_kernel, record

RECOVERY_TIME = 0.02  # [s]
# share of its margin that a load-sensing pump is counted on to bring while it stands below
COUNTED = 0.5
BESIDE = 1.0  # [Pa] from the change of rails: what rounding leaves on its side

# ``pressure`` the set pressure [Pa], the highest of a load-sensing pump; ``flow_limit`` [m³/s],
# ``volume`` of the line [m³]; ``margin`` above the load's pressure [Pa] and ``lag`` [s] of load
# sensing, 0 for none; pressure of the low ``rail`` and what it must have above the chamber that it
# feeds, ``rail_margin`` [Pa], 0 for none; the column of the commands in which its rate of pressure
# stands when that is given (``tied``, −1); the OIL_COLUMNS of its oil, the columns of its
# accumulator
SUPPLY = record(
    *((name, "f8") for name in ("pressure", "flow_limit", "volume")),
    *((name, "f8") for name in ("margin", "lag", "rail", "rail_margin")),
    ("tied", "i8"),
    *OIL_COLUMNS,
    *ACCUMULATOR,
)


@part_kernel
def line_stiffness(p_supply, supply):
    """Rise of pressure per oil [Pa/m³] of the supply line at ``p_supply`` [Pa]."""
    bulk_modulus = bulk_of(supply, p_supply)
    if supply.gas_volume == 0.0:
        return bulk_modulus / supply.volume
    return 1.0 / (supply.volume / bulk_modulus + gas_capacity(p_supply, supply))


@part_kernel
def from_rail(chamber, supply):
    """Whether an edge to a ``chamber`` [Pa] takes from the low rail."""
    return supply.rail > 0.0 and chamber + supply.rail_margin <= supply.rail


@part_kernel
def beside_change(calm, chamber, supply):
    """A ``calm`` pressure [Pa] on the rail's side that the measured ``chamber`` pressure [Pa]
    chooses."""
    if supply.rail == 0.0:
        return calm
    change = supply.rail - supply.rail_margin
    if from_rail(chamber, supply):
        return min(calm, change - BESIDE)
    return max(calm, change + BESIDE)


@part_kernel
def rail_pressure(p_supply, chamber, supply):
    """Pressure [Pa] of the supply for an edge to a ``chamber`` [Pa]: the line's or the low
    rail's."""
    return supply.rail if from_rail(chamber, supply) else p_supply


@part_kernel
def sensed(load, supply):
    """Set pressure [Pa] of a pump; with load sensing the highest ``load`` [Pa] and the margin, up
    to it."""
    if supply.margin == 0.0:
        return supply.pressure
    return min(load + supply.margin, supply.pressure)


@part_kernel
def offered(p_supply, chamber, supply):
    """Pressure [Pa] that an edge to a ``chamber`` [Pa] will have: rail's, or soon the pump's."""
    if supply.margin == 0.0:
        return rail_pressure(p_supply, chamber, supply)
    return max(p_supply, sensed(chamber, supply))


@part_kernel
def metered_at(p_supply, chamber, supply):
    """Pressure [Pa] by which a controller opens an edge to a ``chamber`` [Pa]: the line's or
    rail's; of a load-sensing pump that is not up yet COUNTED of its margin above the chamber."""
    if supply.margin == 0.0:
        return rail_pressure(p_supply, chamber, supply)
    return max(p_supply, min(chamber + COUNTED * supply.margin, supply.pressure))


@part_kernel
def drawn_at(p_supply, chamber, supply):
    """Pressure [Pa] at which oil for a ``chamber`` [Pa] is paid in steady motion."""
    if supply.margin == 0.0:
        return rail_pressure(p_supply, chamber, supply)
    return sensed(chamber, supply)


@part_kernel
def pump_flow(p_supply, demand, set_pressure, supply):
    """Flow [m³/s] a pressure-compensated pump delivers at ``p_supply`` [Pa] and ``demand`` [m³/s].

    The compensator covers the demand exactly and brings the pressure to ``set_pressure`` [Pa] with
    time constant RECOVERY_TIME, or the ``lag`` of load sensing; both only from no flow to the flow
    limit: beyond it the pressure falls, and a pressure above is left until the valves draw it."""
    missing = set_pressure - p_supply
    time = RECOVERY_TIME if supply.margin == 0.0 else supply.lag
    required = demand + supply.volume / (supply.bulk_modulus * time) * missing
    if supply.gas_volume > 0.0:
        required += gas_capacity(p_supply, supply) / time * missing
    return min(max(required, 0.0), supply.flow_limit)


FAULTS = (
    Fault("supply", ("pressure",), rank=5, wide=True),
    Fault("tank", ("tank_pressure",), "pressure", 0.005, -0.1, 0.1, rank=1, wide=True),
    Fault("pump", ("flow_limit",), step=0.05, rank=5, wide=True),
    Fault("supply line", ("volume",), step=0.1, rank=5, wide=True),
    Fault("load margin", ("load_margin",), step=0.05, rank=0, wide=True),
    Fault("load lag", ("load_lag",), step=0.1, rank=0, wide=True),
    Fault(
        "load sensing",
        ("load_margin",),
        "pressure",
        step=0.1,
        low=0.0,
        high=0.9,
        rank=4,
        table="load_sensing",
        adds={"load_margin": Amount((0.1,), "pressure", "Pa"), "load_lag": "50 ms"},
        wide=True,
    ),
    Fault(
        "accumulator",
        ("gas_volume", "precharge"),
        "swept",
        step=0.05,
        low=0.0,
        trials=(0.2, 0.6),
        rank=4,
        table="accumulator",
        adds={
            "gas_volume": Amount((0.5,), "swept", "m^3"),
            "precharge": Amount((0.5,), "pressure", "Pa"),
        },
        moved=("gas_volume",),
        wide=True,
    ),
)
