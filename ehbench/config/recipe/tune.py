"""The recipe of a tuning."""

from typing import Annotated, Literal

from pydantic import Field

from ehbench.config.recipe.base import Recipe
from ehbench.vocabulary.fields import Q, Value


class AnyTuning(Recipe):
    """What all tunings of one cylinder share: where it is linearised, and how late it is told.

    Operating points: ``postures`` strokes from 10 to 90 % (or those of ``strokes``) × ``payloads``
    (``none`` and all of the rig file by default) × ``functions`` (by default the thesis's six, as
    far as the valves are able) × ``speed_shares`` of the full speed there; other joints as in
    ``posture``, else at mid-stroke. Those that are ``also_moving`` are felt by a load-sensing pump
    at what they hold there. The chamber on its way to tank stands at ``low_pressure``, an edge
    between the chambers at ``cross_drop``. The samples come ``delay`` late."""

    stage: Literal["tune"]
    rig: str
    flow_maps: str | None = None
    cylinder: str | None = None
    payloads: tuple[str, ...] = ()
    postures: int = Field(default=5, ge=1, le=50)
    strokes: tuple[str, ...] = ()
    posture: dict[str, str] = {}
    also_moving: tuple[str, ...] = ()
    functions: tuple[str, ...] = ()
    speed_shares: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        default=(0.3, 0.7), min_length=1
    )
    low_pressure: Annotated[Value, Q("low_pressure")] | None = None
    cross_drop: Annotated[Value, Q("cross_drop")] | None = None
    rate: Annotated[Value, Q("rate")] = Value(1000.0)
    delay: Annotated[Value, Q("delay")] = Value(1.0e-3)


class TuneRecipe(AnyTuning):
    """A validated rig to the gain of the pressure feedback of one cylinder.

    ``delay`` lies between pressure and command: half a tick of hold, the rest for the sensor.
    ``washout`` (alone, or with an equal ``ramp_washout``) and ``off_gain`` are found where they are
    not given; ``washout = "0 rad/s"`` is none. ``one_gain = false`` lets each working function have
    its own gain. ``damping_ratio`` is the target that the share of ``draws`` is counted against."""

    washout: Annotated[Value, Q("washout")] | None = None
    ramp_washout: Annotated[Value, Q("ramp_washout")] | None = None
    off_gain: Annotated[Value, Q("off_gain")] | None = None
    one_gain: bool = True
    damping_ratio: Annotated[Value, Q("damping_ratio")] = Value(0.5)
    gain_margin: Annotated[Value, Q("gain_margin")] = Value(2.0)
    phase_margin: Annotated[Value, Q("phase_margin")] = Value(0.7853981633974483)
    bandwidth: Annotated[Value, Q("frequency")] = Value(0.5)
    draws: int = Field(default=200, ge=0, le=100000)
    seed: int = Field(default=0, ge=0, le=2**63 - 1)


class ArcTuneRecipe(AnyTuning):
    """A validated rig to the bandwidths of the adaptive robust controller of one cylinder.

    Pressures come behind a lag of ``pressure_lag`` as well, strokes in steps of
    ``stroke_resolution``, which bounds the observer. Chosen is the largest sum of bandwidths
    that keeps ``delay_margin``, as it is stated, ``gain_margin`` and ``phase_margin`` at every
    point."""

    what: Literal["arc"]
    postures: int = Field(default=3, ge=1, le=50)
    speed_shares: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        default=(0.06, 0.4), min_length=1
    )
    pressure_lag: Annotated[Value, Q("lag")] = Value(1.0e-3)
    delay_margin: Annotated[Value, Q("delay_margin")] = Value(5.0e-3)
    gain_margin: Annotated[Value, Q("gain_margin")] = Value(2.0)
    phase_margin: Annotated[Value, Q("phase_margin")] = Value(0.3490658503988659)
    stroke_resolution: Annotated[Value, Q("stroke_resolution")] = Value(2.5e-5)
