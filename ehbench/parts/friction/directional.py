"""Coulomb friction that differs for extending and retracting, as seals of a rod and a piston do.

A rod seal under pressure from one side drags more when it moves with the pressure than against it.
Through zero speed both values are smoothed as in `coulomb_viscous`."""

import math
from typing import Annotated, Literal

from ehbench.parts.fault import Fault
from ehbench.parts.friction.law import SETTLING, FrictionLaw, FrictionTable
from ehbench.physics.friction import coulomb_slope
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value


class Directional(FrictionTable):
    """``F = viscous·v + C tanh(v/v_s)``: C is the cylinder's ``friction_coulomb`` while it extends
    and ``friction_retracting`` while it retracts."""

    law: Literal["directional"]
    friction_retracting: Annotated[Value, Q("friction_retracting")]


@part_kernel
def steady(row, v):
    """Resistance [N] at a steady speed v [m/s]."""
    coulomb = row.friction_coulomb if v >= 0.0 else row.friction_retracting
    return row.friction_viscous * v + coulomb * math.tanh(v / row.coulomb_speed)


@part_kernel
def slope(row, v):
    """Slope [N·s/m] of the resistance at speed v [m/s]."""
    coulomb = row.friction_coulomb if v >= 0.0 else row.friction_retracting
    return coulomb_slope(v, row.friction_viscous, coulomb, row.coulomb_speed)


@part_kernel
def fastest(row, v):
    """Fastest rate [1/s] near speed v: the largest slope there, on the lightest mass."""
    coulomb = max(row.friction_coulomb, row.friction_retracting)
    steep = coulomb / row.coulomb_speed if abs(v) <= 4.0 * row.coulomb_speed else 0.0
    return min(row.mobility * (steep + row.friction_viscous), 1.0 / SETTLING)


LAW = FrictionLaw(
    name="directional",
    table=Directional,
    columns=("friction_viscous", "friction_coulomb", "coulomb_speed", "friction_retracting"),
    steady=steady,
    slope=slope,
    fastest=fastest,
)

FAULTS = (Fault("friction", ("friction_retracting",), unit="force", step=0.01, high=30.0),)
