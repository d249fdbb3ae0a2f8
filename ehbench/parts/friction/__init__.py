"""Friction laws of a cylinder, a file each.

To add one: write its file after ``coulomb_viscous.py`` and name it in LAWS.
"""

from __future__ import annotations

from ehbench.compiled import choice, part_kernel
from ehbench.parts.friction import coulomb_viscous

LAWS = (coulomb_viscous.LAW,)
COLUMNS = tuple(dict.fromkeys(column for law in LAWS for column in law.columns))

_steady = choice("steady", [law.steady for law in LAWS], "row, v")
_steepness = choice("steepness", [law.steepness for law in LAWS], "row, v")
_force = choice("force", [law.resistance() for law in LAWS], "row, v, y")
_rates = choice("rates", [law.rates for law in LAWS], "row, v, y, dy")
_held = choice("held", [law.held for law in LAWS], "row, y")


@part_kernel
def friction_steady(row, v):
    """Resistance [N] of a cylinder's friction, of the sign of v, once speed v [m/s] has lasted."""
    return _steady(row.friction, row, v)


@part_kernel
def friction_steepness(row, v):
    """Largest slope [N·s/m] of a cylinder's friction near speed v [m/s]."""
    return _steepness(row.friction, row, v)


@part_kernel
def friction_force(row, v, y):
    """Resistance [N] of a cylinder's friction at speed v [m/s] and plant state y."""
    return _force(row.friction, row, v, y)


@part_kernel
def friction_rates(row, v, y, dy):
    """Write the rates of the friction's own states into ``dy``."""
    _rates(row.friction, row, v, y, dy)


@part_kernel
def friction_held(row, y):
    """Energy [J] in the friction's own states."""
    return _held(row.friction, row, y)
