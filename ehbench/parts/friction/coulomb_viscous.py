"""Coulomb and viscous friction, smoothed through zero speed.

A smoothing speed replaces sticking by fast creep: at rest the law acts as a damper of
coulomb/smoothing [N·s/m].
"""

from __future__ import annotations

from typing import Any

from ehbench.compiled import part_kernel
from ehbench.parts.friction.law import FrictionLaw
from ehbench.physics.friction import coulomb_viscous

COULOMB_SPEED = 2.0e-3  # [m/s]: over which Coulomb friction turns round


@part_kernel
def steady(row, v):
    """Resistance [N] at a steady speed v [m/s]."""
    if row.friction_coulomb == 0.0:
        return row.friction_viscous * v
    return coulomb_viscous(v, row.friction_viscous, row.friction_coulomb, COULOMB_SPEED)


@part_kernel
def steepness(row, v):
    """Largest slope of the resistance near speed v [N·s/m]."""
    steep = 0.0 if abs(v) > 4.0 * COULOMB_SPEED else row.friction_coulomb / COULOMB_SPEED
    return steep + row.friction_viscous


def pack(cylinder: Any) -> dict[str, float]:
    """Columns of a cylinder."""
    return {key: float(getattr(cylinder, key)) for key in ("friction_viscous", "friction_coulomb")}


LAW = FrictionLaw(
    name="coulomb_viscous",
    columns=(("friction_viscous", "f8"), ("friction_coulomb", "f8")),
    steady=steady,
    pack=pack,
    steepness=steepness,
)
