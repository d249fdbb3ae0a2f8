"""Friction laws of a cylinder, a file each.

To add one: write its file after ``stribeck.py`` (``lugre.py`` has a state) and name it in LAWS."""

from __future__ import annotations

from ehbench.parts.friction import coulomb_viscous, directional, lugre, stribeck
from ehbench.runtime.compiled import choice, part_kernel

LAWS = (coulomb_viscous.LAW, stribeck.LAW, lugre.LAW, directional.LAW)
TABLES = tuple(law.table for law in LAWS)
FAULTS = (*coulomb_viscous.FAULTS, *stribeck.FAULTS, *lugre.FAULTS)
COLUMNS = tuple(dict.fromkeys(column for law in LAWS for column in law.columns))

_steady = choice("steady", [law.steady for law in LAWS], "row, v")
_slope = choice("slope", [law.slope for law in LAWS], "row, v")
_fastest = choice("fastest", [law.fastest for law in LAWS], "row, v")
_force = choice("force", [law.resistance() for law in LAWS], "row, v, y")
_loss = choice("loss", [law.heat() for law in LAWS], "row, v, y")
_rates = choice("rates", [law.rates for law in LAWS], "row, v, y, dy")
_settle = choice("settle", [law.settle for law in LAWS], "row, v, y")
_advance = choice("advance", [law.advance for law in LAWS], "row, v, dt, y")
_held = choice("held", [law.held for law in LAWS], "row, y")


@part_kernel
def friction_steady(row, v):
    """Resistance [N] of a cylinder's friction, of the sign of v, once speed v [m/s] has lasted."""
    return _steady(row.friction, row, v)


@part_kernel
def friction_slope(row, v):
    """Slope [N·s/m] of a cylinder's steady friction at speed v [m/s]."""
    return _slope(row.friction, row, v)


@part_kernel
def friction_fastest(row, v):
    """Fastest rate [1/s] that a cylinder's friction makes near speed v [m/s]."""
    return _fastest(row.friction, row, v)


@part_kernel
def friction_force(row, v, y):
    """Resistance [N] of a cylinder's friction at speed v [m/s] and plant state y."""
    return _force(row.friction, row, v, y)


@part_kernel
def friction_loss(row, v, y):
    """Power [W] that a cylinder's friction turns to heat."""
    return _loss(row.friction, row, v, y)


@part_kernel
def friction_rates(row, v, y, dy):
    """Write the rates of the friction's own states into ``dy``."""
    _rates(row.friction, row, v, y, dy)


@part_kernel
def friction_settle(row, v, y):
    """Put the friction's own states where a lasting speed v [m/s] does."""
    _settle(row.friction, row, v, y)


@part_kernel
def friction_advance(row, v, dt, y):
    """Bring the friction's own states on by ``dt`` [s] at a held speed v [m/s]."""
    _advance(row.friction, row, v, dt, y)


@part_kernel
def friction_held(row, y):
    """Energy [J] in the friction's own states."""
    return _held(row.friction, row, y)
