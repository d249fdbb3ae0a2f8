"""Coulomb and viscous friction, smoothed through zero speed.

The cylinder's ``coulomb_speed`` replaces sticking by fast creep: at rest the law acts as a damper
of coulomb/coulomb_speed [N·s/m]."""

import math
from typing import Literal

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.friction.law import SETTLING, FrictionLaw, FrictionTable
from ehbench.physics.friction import coulomb_slope
from ehbench.runtime.compiled import part_kernel

COULOMB_SPEED = 2.0e-3  # [m/s]: over which dry friction turns round, unless its owner says another


class CoulombViscous(FrictionTable):
    """The default law, by the cylinder's ``friction_viscous`` and ``friction_coulomb``."""

    law: Literal["coulomb_viscous"]


@part_kernel
def steady(row, v):
    """Resistance [N] at a steady speed v [m/s]: ``viscous·v + coulomb·tanh(v/v_s)``."""
    if row.friction_coulomb == 0.0:
        return row.friction_viscous * v
    return row.friction_viscous * v + row.friction_coulomb * math.tanh(v / row.coulomb_speed)


@part_kernel
def slope(row, v):
    """Slope [N·s/m] of the resistance at speed v [m/s]."""
    return coulomb_slope(v, row.friction_viscous, row.friction_coulomb, row.coulomb_speed)


@part_kernel
def fastest(row, v):
    """Fastest rate [1/s] near speed v: the largest slope there, on the lightest mass."""
    turning = abs(v) <= 4.0 * row.coulomb_speed
    steep = row.friction_coulomb / row.coulomb_speed if turning else 0.0
    return min(row.mobility * (steep + row.friction_viscous), 1.0 / SETTLING)


LAW = FrictionLaw(
    name="coulomb_viscous",
    table=CoulombViscous,
    columns=("friction_viscous", "friction_coulomb", "coulomb_speed"),
    steady=steady,
    slope=slope,
    fastest=fastest,
)

FAULTS = (
    Fault(
        "friction",
        ("friction_coulomb",),
        unit="force",
        step=0.01,
        high=30.0,
        start=Amount((0.006,), "force"),
        upper=Amount((0.3,), "force"),
    ),
    # dry friction turns round over a smaller or larger speed
    Fault("turning speed", ("coulomb_speed",), low=-0.98, high=30.0, trials=(-0.9,), rank=4),
    Fault(
        "viscous friction",
        ("friction_viscous",),
        unit="damper",
        step=0.01,
        high=30.0,
        rank=4,
        upper=Amount((1.0,), "damper"),
    ),
)
