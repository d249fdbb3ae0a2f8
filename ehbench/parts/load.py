"""Forces from outside on a rod: constant, by direction, spring, cylinder, or played from a log."""

import math
from dataclasses import replace
from typing import Any

from ehbench.parts.fault import Amount, Fault
from ehbench.parts.friction.coulomb_viscous import COULOMB_SPEED
from ehbench.runtime.compiled import part_kernel, record

# A force on a rod, positive where it pushes it out. The number of its ``cylinder``; ``extending``
# and ``retracting`` [N] while the rod moves so; ``stiffness`` [N/m] of a spring that gives no force
# at stroke ``free_length`` [m]; where among the commands a force that is played stands
# (``played``, −1: none). Every kind is a sum of these.
FORCE = record(
    ("cylinder", "i8"),
    *((name, "f8") for name in ("extending", "retracting", "stiffness", "free_length")),
    ("played", "i8"),
)


@part_kernel
def _pushed(row, v, command):
    """Force [N] of a row but for its spring, turned round over COULOMB_SPEED."""
    force = row.extending
    if row.extending != row.retracting:
        turned = math.tanh(v / COULOMB_SPEED)
        force = 0.5 * ((1.0 + turned) * row.extending + (1.0 - turned) * row.retracting)
    return force if row.played < 0 else force + command[row.played]


@part_kernel
def push_on(c, v, command, plant):
    """Force [N] on the rod of cylinder ``c`` from outside, springs excepted, at speed v [m/s]."""
    force = 0.0
    for i in range(plant.forces.shape[0]):
        if plant.forces[i].cylinder == c:
            force += _pushed(plant.forces[i], v, command)
    return force


@part_kernel
def force_on(c, x, v, command, plant):
    """Force [N] on the rod of cylinder ``c`` from outside at stroke x [m] and speed v [m/s]."""
    force = push_on(c, v, command, plant)
    for i in range(plant.forces.shape[0]):
        row = plant.forces[i]
        if row.cylinder == c and row.stiffness != 0.0:
            force -= row.stiffness * (x - row.free_length)
    return force


@part_kernel
def force_slope(c, v, plant):
    """(slope of the forces at speed v [m/s], the largest near it) [N·s/m], as of a damper."""
    steep, turned = 0.0, math.tanh(v / COULOMB_SPEED)
    if abs(v) <= 4.0 * COULOMB_SPEED:
        for i in range(plant.forces.shape[0]):
            row = plant.forces[i]
            if row.cylinder == c:
                steep += 0.5 * abs(row.extending - row.retracting) / COULOMB_SPEED
    return steep * (1.0 - turned * turned), steep


@part_kernel
def spring_stored(c, x, plant):
    """Energy [J] in the springs on the rod of cylinder ``c`` at stroke x [m]."""
    fixed = 0.0
    for i in range(plant.forces.shape[0]):
        row = plant.forces[i]
        if row.cylinder == c:
            fixed += 0.5 * row.stiffness * (x - row.free_length) ** 2
    return fixed


def force_fields(item: Any) -> dict[str, float]:
    """Fields of a row from a rig file's ``[[cylinder.force]]``."""
    if item.kind == "spring":
        return {"stiffness": float(item.stiffness), "free_length": float(item.free_length)}
    if item.kind == "by_direction":
        both = float(item.force_extending), float(item.force_retracting)
    elif item.kind == "constant":
        both = float(item.force), float(item.force)
    elif item.kind == "cylinder":
        # it stands against the rod: its own head end pushes the rod in
        head = float(item.pressure_head) * float(item.area_head)
        rod = float(item.pressure_rod or 0.0) * float(item.area_rod or 0.0)
        both = rod - head, rod - head
    else:
        both = 0.0, 0.0
    return dict(zip(("extending", "retracting"), both, strict=True))


# a centre of mass may be off to either side, by as much as a cylinder is long
_CENTRE = Fault(
    "centre of mass",
    (),
    "stroke",
    0.01,
    -1.0,
    1.0,
    rank=4,
    upper=Amount((1.0,), "stroke"),
    wide=True,
)
# of what a cylinder moves, and of forces on its rod
FAULTS = (
    Fault("damping", ("joint_damping",), step=0.1, wide=True, start=Amount((1.0,), "unit")),
    Fault("damping", ("damping",), step=0.1, wide=True, start=Amount((1.0,), "unit")),
    Fault("load", ("mass",), step=0.05, trials=(-0.3, -0.15, 0.15, 0.4), rank=4, wide=True),
    *(replace(_CENTRE, keys=(f"com_{axis}",)) for axis in "xyz"),
    *(Fault("inertia", (f"inertia_{about}",), rank=4, wide=True) for about in ("yy", "zz")),
    Fault("force", ("force",), step=0.05, rank=5),
    Fault("force", ("force_extending", "force_retracting"), step=0.05, rank=5),
    Fault("spring", ("stiffness",), step=0.05, rank=5),
    Fault("spring", ("free_length",), step=0.05, rank=5),
)
# forces that the rig file leaves out: a constant one, and a spring, free at mid-stroke until a fit
# moves that
PUSH = Fault(
    "outer force",
    ("force.force",),
    unit="force",
    step=1.0e-3,
    low=-0.5,
    high=0.5,
    rank=5,
    table="force",
    adds={"kind": "constant", "force": Amount((0.0,), "force", "N")},
)
SPRING = Fault(
    "outer spring",
    ("force.stiffness", "force.free_length"),
    unit="spring",
    step=1.0e-3,
    low=0.0,
    high=0.5,
    trials=(0.003, 0.01, 0.03),
    rank=5,
    table="force",
    adds={
        "kind": "spring",
        "stiffness": Amount((0.01,), "spring", "N/m", (1.0e-3, 100.0)),
        "free_length": Amount((0.5,), "stroke", "m"),
    },
    moved=("force.stiffness",),
)
PAYLOAD = (
    Fault("payload", ("mass",), step=0.05, rank=4, wide=True),
    *(replace(_CENTRE, kind="payload centre of mass", keys=(f"com_{axis}",)) for axis in "xyz"),
)
