"""Stribeck friction, smoothed through zero speed: more at break-away than in motion.

Like Coulomb friction it creeps at rest instead of sticking; its peak comes close to
``friction_static`` where ``stribeck_speed`` lies well above ``coulomb_speed``."""

from typing import Annotated, Literal

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.friction.law import SETTLING, FrictionLaw, FrictionTable
from ehbench.physics.friction import stribeck, stribeck_slope
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value


class Stribeck(FrictionTable):
    """``F = viscous·v + (C + (S − C) e^−(v/v_st)²) tanh(v/v_s)``, with the cylinder's
    ``friction_viscous`` and ``friction_coulomb``."""

    law: Literal["stribeck"]
    friction_static: Annotated[Value, Q("friction_static")]
    stribeck_speed: Annotated[Value, Q("stribeck_speed")]

    def misfit(self, coulomb: float) -> tuple[str, str] | None:
        """Break-away friction below Coulomb friction."""
        if float(self.friction_static) < coulomb:
            return "friction_static", "must not lie below friction_coulomb"
        return None


@part_kernel
def steady(row, v):
    """Resistance [N] at a steady speed v [m/s]."""
    speeds = row.stribeck_speed, row.coulomb_speed
    return stribeck(v, row.friction_viscous, row.friction_coulomb, row.friction_static, *speeds)


@part_kernel
def slope(row, v):
    """Slope [N·s/m] of the resistance at speed v [m/s]."""
    speeds = row.stribeck_speed, row.coulomb_speed
    viscous, static = row.friction_viscous, row.friction_static
    return stribeck_slope(v, viscous, row.friction_coulomb, static, *speeds)


@part_kernel
def fastest(row, v):
    """Fastest rate [1/s] near speed v: the largest slope there, on the lightest mass."""
    maximum = max(row.friction_static, row.friction_coulomb)
    steep = maximum / row.coulomb_speed if abs(v) <= 4.0 * row.coulomb_speed else 0.0
    dip = 0.86 * abs(row.friction_static - row.friction_coulomb) / row.stribeck_speed
    return min(row.mobility * (max(steep, dip) + row.friction_viscous), 1.0 / SETTLING)


LAW = FrictionLaw(
    name="stribeck",
    table=Stribeck,
    columns=(
        *("friction_viscous", "friction_coulomb", "coulomb_speed"),
        *("friction_static", "stribeck_speed"),
    ),
    steady=steady,
    slope=slope,
    fastest=fastest,
)

# break-away friction above the friction in motion
BREAKING = Fault(
    "friction law",
    ("friction_coulomb", "friction_static"),
    unit="force",
    step=0.01,
    low=0.0,
    high=1.0,
    trials=(0.02,),
    start=Amount((0.006,), "force"),
    upper=Amount((0.3,), "force"),
    table="friction",
    adds={
        "law": "stribeck",
        "friction_static": Amount((1.5,), "friction", "N"),
        "stribeck_speed": "20 mm/s",
    },
    moved=("friction_static",),
    neutral=Amount((1.0,), "coulomb"),
)
FAULTS = (
    BREAKING,
    # numbers of a law that is there
    Fault("breakaway", ("friction_static",), step=0.1, rank=5),
    Fault("breakaway", ("stribeck_speed",), step=0.1, rank=5),
)
