"""LuGre friction: bristles that bend before the rod slides, so that it sticks at rest.

    ż = v − σ0 |v|/g(v) z,    F = σ0 z + σ1 ż + viscous v,    g = C + (S − C) e^−(v/v_st)²

Canudas de Wit, Olsson, Åström & Lischinsky 1995. At rest the bristles are a spring of stiffness
σ0; once a speed has lasted they bear g. What they hold is σ0 z²/2, what they lose ``F v − σ0 z ż``;
that is ≥ 0 where σ1 |v| < 4 g."""

import math
from dataclasses import replace
from typing import Annotated, Literal

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.friction.law import FrictionLaw, FrictionTable
from ehbench.parts.friction.stribeck import BREAKING
from ehbench.parts.friction.stribeck import LAW as STRIBECK
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import Q, Value

LEAST = 1.0e-3  # share of the break-away friction below which the bristles never bear


class LuGre(FrictionTable):
    """Bristles that bend by z: ``ż = v − σ0 |v|/g z``, ``F = σ0 z + σ1 ż + viscous v``, with g of
    Stribeck's form from the cylinder's ``friction_coulomb``."""

    law: Literal["lugre"]
    friction_static: Annotated[Value, Q("friction_static")]
    stribeck_speed: Annotated[Value, Q("stribeck_speed")]
    bristle_stiffness: Annotated[Value, Q("bristle_stiffness")]
    bristle_damping: Annotated[Value, Q("bristle_damping")] = Value(0.0)

    def misfit(self, coulomb: float) -> tuple[str, str] | None:
        """No Coulomb friction, or break-away friction below it."""
        if coulomb <= 0.0:
            return "law", "'lugre' needs a friction_coulomb above 0 of the cylinder"
        if float(self.friction_static) < coulomb:
            return "friction_static", "must not lie below friction_coulomb"
        return None


@part_kernel
def level(row, v):
    """What the bristles bear once speed v [m/s] has lasted: g [N]."""
    ratio = v / row.stribeck_speed
    dip = (row.friction_static - row.friction_coulomb) * math.exp(-ratio * ratio)
    return max(row.friction_coulomb + dip, LEAST * row.friction_static)


@part_kernel
def bending(row, v, y):
    """Rate ż [m/s] of the bristles."""
    return v - row.bristle_stiffness * abs(v) / level(row, v) * y[row.friction_state]


@part_kernel
def steady(row, v):
    """Resistance [N] once speed v [m/s] has lasted."""
    if v == 0.0:
        return 0.0
    return math.copysign(level(row, v), v) + row.friction_viscous * v


@part_kernel
def slope(row, v):
    """Slope [N·s/m] of the steady resistance, at rest that of the least motion."""
    ratio = v / row.stribeck_speed
    dip = (row.friction_static - row.friction_coulomb) * math.exp(-ratio * ratio)
    return row.friction_viscous - 2.0 * abs(ratio) / row.stribeck_speed * dip


@part_kernel
def fastest(row, v):
    """Fastest rate [1/s]: the bristles' own, their spring and their damper on the lightest mass."""
    bristles = row.bristle_stiffness * abs(v) / level(row, v)
    spring = math.sqrt(row.mobility * row.bristle_stiffness)
    return bristles + spring + row.mobility * (row.bristle_damping + row.friction_viscous)


@part_kernel
def force(row, v, y):
    """Resistance [N]."""
    bent = row.bristle_stiffness * y[row.friction_state]
    return bent + row.bristle_damping * bending(row, v, y) + row.friction_viscous * v


@part_kernel
def loss(row, v, y):
    """Power [W] that turns to heat: ``F v − σ0 z ż``."""
    bent = row.bristle_stiffness * y[row.friction_state]
    return force(row, v, y) * v - bent * bending(row, v, y)


@part_kernel
def rates(row, v, y, dy):
    """Write ż."""
    dy[row.friction_state] = bending(row, v, y)


@part_kernel
def settle(row, v, y):
    """The bristles bear g; straight at rest."""
    y[row.friction_state] = 0.0
    if v != 0.0:
        y[row.friction_state] = math.copysign(level(row, v) / row.bristle_stiffness, v)


@part_kernel
def advance(row, v, dt, y):
    """The exact answer over ``dt`` [s] at a stored speed."""
    if v != 0.0:
        at, bear = row.friction_state, level(row, v)
        there = math.copysign(bear / row.bristle_stiffness, v)
        left = math.exp(-row.bristle_stiffness * abs(v) / bear * dt)
        y[at] = there + left * (y[at] - there)


@part_kernel
def stored(row, y):
    """Energy [J] of the bent bristles: σ0 z²/2."""
    return 0.5 * row.bristle_stiffness * y[row.friction_state] * y[row.friction_state]


LAW = FrictionLaw(
    name="lugre",
    table=LuGre,
    columns=(*STRIBECK.columns, "bristle_stiffness", "bristle_damping"),
    steady=steady,
    slope=slope,
    fastest=fastest,
    states=("bristle",),
    force=force,
    loss=loss,
    rates=rates,
    settle=settle,
    advance=advance,
    stored=stored,
)

# bristles that bend by a tenth of a millimetre before the rod slides
_BRISTLES = {"law": "lugre", "bristle_stiffness": Amount((1.0e4,), "friction", "N/m")}
FAULTS = (
    replace(
        BREAKING,
        kind="sticking",
        trials=(),
        rank=4,
        adds={**BREAKING.adds, **_BRISTLES},
        costly=True,
    ),
    Fault("breakaway", ("bristle_stiffness",), step=0.1, rank=5),
    Fault("breakaway", ("bristle_damping",), unit="damper", step=0.01, rank=5),
)
