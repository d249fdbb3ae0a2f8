"""A mount that gives way: the pin or bracket that a cylinder's base sits on, as a spring with a
damper beside it and no mass.

    c dδ/dt = F − k δ,    x_piston = x + δ,    v_piston = v + dδ/dt

F is what the piston pushes the rod with: pressures, less the cylinder's friction and end stops. δ
is how far the base has gone back from the rod, positive where the rod pushes; x, v are the stroke
and speed that the linkage has, which position channels measure. Oil, friction and end stops see the
piston in its barrel instead. As friction hangs on v_piston, the law is solved for it; where that
falls with speed more steeply than c, the solution is not the only one, and the piston jumps."""

from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from ehbench.parts.cylinder import chamber_of
from ehbench.parts.end_stop import stop_force
from ehbench.parts.fault import Amount, Fault
from ehbench.parts.nodes import node_pressure
from ehbench.runtime.compiled import generic, kernel, part_kernel
from ehbench.vocabulary.fields import FileModel, Q, Value

YIELDING = 1.0e-3  # [s]: damping over stiffness where none is given
QUICKEST = 2.0e-5  # [s]: the least that a rig file may have
_ROUNDING = 1.0e-13  # share of the forces down to which their balance is solved
_TRIES = 60

# forces of friction, which each type of plant has its own law for: ``resistance(row, v, y, plant)``
# [N] of a cylinder at the speed v [m/s] of its piston
any_resistance = generic("resistance", "row, v, y, plant")


class Mount(FileModel):
    """What a cylinder's base gives way by: ``damping·dδ/dt = F − stiffness·δ``, F the rod's force.
    Without ``damping`` it is 1 ms times the stiffness: a loss factor of 6 % at 10 Hz."""

    stiffness: Annotated[Value, Q("stiffness")] = Field(
        description="of pin, bracket and frame, along the cylinder"
    )
    damping: Annotated[Value, Q("damping")] | None = Field(
        None, description="beside the stiffness, from 20 µs times that on; by default 1 ms times it"
    )

    @field_validator("stiffness")
    @classmethod
    def _is_stiff(cls, value: Value) -> Value:
        if float(value) <= 0.0:
            raise ValueError("must be above 0")
        return value

    @field_validator("damping")
    @classmethod
    def _is_damped(cls, value: Value | None, info: ValidationInfo) -> Value | None:
        minimum = QUICKEST * float(info.data.get("stiffness", 0.0))
        if value is not None and float(value) < (1.0 - 1e-9) * minimum:
            raise ValueError(
                f"a mount without mass needs damping: {minimum:g} N*s/m at the least, 20 us times "
                "its stiffness"
            )
        return value

    def row(self) -> dict[str, float]:
        """Its columns of a cylinder."""
        stiff = float(self.stiffness)
        damping = YIELDING * stiff if self.damping is None else float(self.damping)
        return {"mount_stiffness": stiff, "mount_damping": damping}


@part_kernel
def push_of(row, y, plant):
    """Force [N] of the oil on the piston, positive pushes the rod out."""
    force = 0.0
    for side in range(2):
        node, area, _, _ = chamber_of(row, side)
        force += node_pressure(y, plant, node) * area
    return force


@part_kernel
def _left(row, x, v, push, slip, y, plant):
    """Rod force at piston speed ``slip`` and stroke x less the damper's [N]; falls as ``slip``
    rises."""
    force = push - any_resistance(row, slip, y, plant) - row.mount_stiffness * y[row.mount_state]
    return force + stop_force(row, x, slip) - row.mount_damping * (slip - v)


@part_kernel
def piston_of(row, x, v, y, plant):
    """(stroke [m], speed [m/s]) of the piston in its barrel, where the linkage has x and v."""
    if row.mount_state < 0:
        return x, v
    return x + y[row.mount_state], _slip(row, x + y[row.mount_state], v, y, plant)


@kernel
def _slip(row, x, v, y, plant):
    """Speed [m/s] of the piston in its barrel at its stroke x, where the linkage has v.

    The balance of forces is solved for it by false position (Illinois), from v to where the damper
    alone would take what is left over there: friction takes its share of that."""
    push = push_of(row, y, plant)
    minimum = _ROUNDING * (abs(push) + row.mount_stiffness * abs(y[row.mount_state]))
    a, f_a = v, _left(row, x, v, push, v, y, plant)
    if abs(f_a) <= minimum:
        return v
    step = f_a / row.mount_damping
    b, f_b = v + step, _left(row, x, v, push, v + step, y, plant)
    for _ in range(_TRIES):
        if abs(f_b) <= minimum or f_a == f_b:
            break
        if f_a * f_b > 0.0:  # friction that falls with speed: further on
            step *= 2.0
            a, f_a, slip = b, f_b, b + step
        else:
            slip = b - f_b * (b - a) / (f_b - f_a)
        left = _left(row, x, v, push, slip, y, plant)
        if left * f_b < 0.0:
            a, f_a = b, f_b
        elif f_a * f_b < 0.0:
            f_a *= 0.5
        b, f_b = slip, left
    return b


@part_kernel
def mount_rate(row, spring):
    """Fastest rate [1/s] of a mount, beside the spring of oil and end stops [N/m] and bristles."""
    return (row.mount_stiffness + spring + row.bristle_stiffness) / row.mount_damping


@part_kernel
def mount_settle(row, v, y, plant):
    """Put the deflection where a lasting speed v [m/s] does."""
    if row.mount_state >= 0:
        force = push_of(row, y, plant) - any_resistance(row, v, y, plant)
        y[row.mount_state] = force / row.mount_stiffness


@part_kernel
def mount_stored(row, y):
    """Energy [J] in a mount's spring: k δ²/2."""
    return 0.5 * row.mount_stiffness * y[row.mount_state] * y[row.mount_state]


@part_kernel
def mount_loss(row, slip, v):
    """Power [W] that a mount takes where piston and linkage have speeds [m/s]: c (dδ/dt)²."""
    return row.mount_damping * (slip - v) * (slip - v)


# a mount that is stiffer than the oil behind it by some
FAULTS = (
    Fault(
        "mount",
        ("mount.stiffness",),
        step=0.0,
        table="mount",
        adds={"stiffness": Amount((4.0,), "spring", "N/m", (1.0e-3, 10.0))},
        costly=True,
    ),
    Fault("mount", ("mount.stiffness",), step=0.05, rank=5),
)
