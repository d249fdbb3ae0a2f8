"""A load that sways: a mass on a spring with a damper beside it, along the cylinder, as the end of
a long arm that bends, or what hangs on it.

    dz/dt = w − v,    m dw/dt = −(k z + c (w − v))

v is the speed of the rod, w that of the mass, z how far it is ahead, positive where the rod moves
out; k z + c (w − v) pulls on the rod. Its weight counts as the mechanism's, not here."""

import math
from typing import Annotated

from pydantic import Field, field_validator

from ehbench.parts.fault import Amount, Fault
from ehbench.runtime.compiled import part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value, scalars


class Sway(FileModel):
    """What sways at a cylinder's rod: ``mass·dw/dt = −stiffness·z − damping·(w − v)``."""

    mass: Annotated[Value, Q("mass")] = Field(
        description="that sways, beside those of the mechanism; without weight"
    )
    stiffness: Annotated[Value, Q("stiffness")] = Field(description="of what holds it")
    damping: Annotated[Value, Q("damping")] = Field(Value(0.0), description="beside the stiffness")

    @field_validator("mass", "stiffness")
    @classmethod
    def _above_zero(cls, value: Value) -> Value:
        if float(value) <= 0.0:
            raise ValueError("must be above 0")
        return value

    def row(self) -> dict[str, float]:
        """Its columns of a cylinder."""
        return {f"sway_{name}": float(value) for name, value in scalars(self)}


SWAY = ("sway", "sway_speed")  # its states, z [m] and w [m/s]


@part_kernel
def sway_pull(row, v, y, dy):
    """Force [N] on the rod, positive pulls it out; rates of its states into ``dy``."""
    at = row.sway_state
    ahead = y[at + 1] - v
    pull = row.sway_stiffness * y[at] + row.sway_damping * ahead
    dy[at], dy[at + 1] = ahead, -pull / row.sway_mass
    return pull


@part_kernel
def sway_rate(row):
    """No less than its fastest rate [1/s]: √(k/m) + c/m."""
    return math.sqrt(row.sway_stiffness / row.sway_mass) + row.sway_damping / row.sway_mass


@part_kernel
def sway_settle(row, v, y):
    """Let the mass go along with a rod at a speed v [m/s]."""
    if row.sway_state >= 0:
        y[row.sway_state], y[row.sway_state + 1] = 0.0, v


@part_kernel
def sway_stored(row, y):
    """Energy [J] in spring and mass: k z²/2 + m w²/2."""
    z, w = y[row.sway_state], y[row.sway_state + 1]
    return 0.5 * (row.sway_stiffness * z * z + row.sway_mass * w * w)


@part_kernel
def sway_loss(row, v, y):
    """Power [W] that its damper takes: c (w − v)²."""
    ahead = y[row.sway_state + 1] - v
    return row.sway_damping * ahead * ahead


# part of the load on a spring that is as stiff as the oil, or by some softer or stiffer; a stiffer
# spring and a lighter mass would only move with the rest, in ever shorter steps
FAULTS = (
    Fault(
        "sway",
        ("sway.mass", "sway.stiffness", "sway.damping"),
        step=0.0,
        table="sway",
        adds={
            "mass": Amount((0.3,), "load", "kg", (0.1, 1.0e3)),
            "stiffness": Amount((1.0, 0.3, 3.0), "spring", "N/m", (1.0e-3, 10.0)),
            "damping": Amount((0.11, 0.06, 0.19), "damper", "N*s/m", (1.0e-3, 10.0)),
        },
        costly=True,
    ),
    Fault("sway", ("sway.stiffness",), step=0.05, rank=5),
)
