"""Friction laws of a cylinder, a file each.

To add one: write its file after ``stribeck.py`` (``lugre.py`` has a state) and name it in LAWS."""

from ehbench.parts.friction import coulomb_viscous, directional, lugre, stribeck
from ehbench.runtime.compiled import choice

LAWS = (coulomb_viscous.LAW, stribeck.LAW, lugre.LAW, directional.LAW)
TABLES = tuple(law.table for law in LAWS)
FAULTS = (
    *(*coulomb_viscous.FAULTS, *stribeck.FAULTS),
    *(*lugre.FAULTS, *directional.FAULTS),
)
COLUMNS = tuple(dict.fromkeys(column for law in LAWS for column in law.columns))

BY = "row.friction"
# of a cylinder's row, its speed v [m/s] and the plant's state y:
# resistance [N], of the sign of v, once that speed has lasted; its slope [N·s/m]; the fastest rate
# [1/s] that it makes near that speed; the resistance now; the power that turns to heat [W]
friction_steady = choice("friction_steady", [law.steady for law in LAWS], "row, v", BY)
friction_slope = choice("friction_slope", [law.slope for law in LAWS], "row, v", BY)
friction_fastest = choice("friction_fastest", [law.fastest for law in LAWS], "row, v", BY)
friction_force = choice("friction_force", [law.resistance() for law in LAWS], "row, v, y", BY)
friction_loss = choice("friction_loss", [law.heat() for law in LAWS], "row, v, y", BY)
# the rates of its own states into ``dy``; puts them where a lasting speed does, or on by ``dt`` [s]
# at a constant speed; the energy in them [J]
friction_rates = choice("friction_rates", [law.rates for law in LAWS], "row, v, y, dy", BY)
friction_settle = choice("friction_settle", [law.settle for law in LAWS], "row, v, y", BY)
friction_advance = choice("friction_advance", [law.advance for law in LAWS], "row, v, dt, y", BY)
friction_stored = choice("friction_stored", [law.stored for law in LAWS], "row, y", BY)
