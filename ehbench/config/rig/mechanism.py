"""What moves: a chain of joints or a slide, what a payload changes, how a cylinder drives it."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ehbench.config.rig.names import Misplaced, Name
from ehbench.vocabulary import message
from ehbench.vocabulary.fields import FileModel, Q, Value, Vector

_ROUNDED = 1e-2  # of an inertia that a drawing gives in two or three digits


def _solid(body: Any) -> Any:
    """Refuses an inertia that no body has: with that of half its polar moment in each direction it
    is the spread of its mass, and no spread is negative (the triangle inequality among others).
    """
    if body.inertia is None:
        return body
    xx, yy, zz, xy, xz, yz = body.inertia.value
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    spread = 0.5 * np.trace(tensor) * np.eye(3) - tensor
    rounded = _ROUNDED * abs(tensor).max()
    if min(xx, yy, zz) < 0.0 or np.linalg.eigvalsh(spread)[0] < -rounded:
        raise Misplaced(message("config.no_inertia"), "inertia")
    return body


Com = Annotated[Vector, Q("com", "x y z")]
Inertia = Annotated[Vector, Q("inertia", "xx yy zz xy xz yz")]


class Joint(FileModel):
    """A revolute joint and the link it carries; frame i sits at the end of link i (standard
    Denavit–Hartenberg).
    """

    name: Name
    dh_a: Annotated[Value, Q("dh_a")] = Value(0.0)
    dh_d: Annotated[Value, Q("dh_d")] = Value(0.0)
    dh_alpha: Annotated[Value, Q("dh_alpha")] = Value(0.0)
    dh_theta: Annotated[Value, Q("dh_theta")] = Value(0.0)
    mass: Annotated[Value, Q("mass")]
    com: Com
    inertia: Inertia
    joint_damping: Annotated[Value, Q("joint_damping")] = Value(0.0)

    _inertia_of_a_body = model_validator(mode="after")(_solid)


class Chain(FileModel):
    """A serial chain of revolute joints, base first.

    The first joint's axis z0 is vertical (pointing up), or horizontal with y0 pointing up.
    """

    kind: Literal["chain"]
    first_axis: Literal["vertical", "horizontal"] = "vertical"
    joint: tuple[Joint, ...] = Field(min_length=1)


class Slide(FileModel):
    """A mass on a slide, moved directly by one cylinder; ``incline`` is positive where extension
    goes uphill.
    """

    kind: Literal["slide"]
    name: Name
    mass: Annotated[Value, Q("mass")]
    damping: Annotated[Value, Q("damping")] = Value(0.0)
    incline: Annotated[Value, Q("incline")] = Value(0.0)


class LinkLoad(FileModel):
    """What a payload changes of one link (or of the slide); what is not named stays."""

    mass: Annotated[Value, Q("mass")] | None = None
    com: Com | None = None
    inertia: Inertia | None = None

    _inertia_of_a_body = model_validator(mode="after")(_solid)


class Pins(FileModel):
    """Cylinder between two pins: c² = l_A² + l_B² − 2 l_A l_B cos θ, θ = sign·q + phase, x = c −
    retracted_length (SPEC 1).
    """

    l_a: Annotated[Value, Q("l_a")]
    l_b: Annotated[Value, Q("l_b")]
    retracted_length: Annotated[Value, Q("retracted_length")]
    sign: Literal[1, -1] = 1
    phase: Annotated[Value, Q("phase")] = Value(0.0)


class Rack(FileModel):
    """Cylinder that turns its joint by a constant lever, a rack on a pinion or the vane of a rotary
    actuator: x = sign·radius·(q − retracted_angle).
    """

    radius: Annotated[Value, Q("radius")]
    sign: Literal[1, -1] = 1
    retracted_angle: Annotated[Value, Q("retracted_angle")] = Value(0.0)
