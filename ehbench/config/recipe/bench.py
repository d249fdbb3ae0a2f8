"""The files of a virtual bench: a machine with what no model knows, a dataset of it."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ehbench.config.recipe.base import ByParameter, Payload, Recipe
from ehbench.config.recipe.trial import Command, Limits, refuse_fast_waves
from ehbench.vocabulary.fields import FileModel, Q, Value


class BenchCylinder(FileModel):
    """Friction of a cylinder of the virtual bench; what is not given follows from the rig's supply
    and areas."""

    friction_coulomb: Annotated[Value, Q("friction_coulomb")] | None = None
    friction_static: Annotated[Value, Q("friction_static")] | None = None
    friction_viscous: Annotated[Value, Q("friction_viscous")] | None = None
    stribeck_speed: Annotated[Value, Q("stribeck_speed")] | None = None


class BenchValve(FileModel):
    """Driver and dynamics of a valve of the virtual bench: spool = driver_gain·(command after
    hysteresis) + driver_offset.

    Where the rig file gives the valve's ``calibration``, gain and offset are tuned to it unless
    given here."""

    driver_gain: Annotated[Value, Q("driver_gain")] | None = None
    driver_offset: Annotated[Value, Q("driver_offset")] | None = None
    hysteresis: Annotated[Value, Q("hysteresis")] | None = None
    natural_frequency: Annotated[Value, Q("natural_frequency")] | None = None
    damping_ratio: Annotated[Value, Q("damping_ratio")] | None = None


class BenchCurve(FileModel):
    """What an edge of the virtual bench does in one direction of flow."""

    onset: Annotated[Value, Q("onset")] | None = None
    softness: Annotated[Value, Q("softness")] | None = None
    saturation: Annotated[Value, Q("saturation")] | None = None
    gain_factor: Annotated[Value, Q("gain_factor")] | None = None
    compensation_drop: Annotated[Value, Q("compensation_drop")] | None = None
    compensator_opening: Annotated[Value, Q("compensator_opening")] | None = None
    flow_force: Annotated[Value, Q("flow_force")] | None = None


class BenchEdge(BenchCurve):
    """An edge of the virtual bench; ``reverse`` is what differs when oil flows back through it."""

    null_leakage: Annotated[Value, Q("null_leakage")] | None = None
    reverse: BenchCurve = BenchCurve()


class BenchSensors(FileModel):
    """Sensors of a cylinder of the virtual bench (or of all: ``sensors.all``; of the lines:
    ``sensors.supply``)."""

    pressure_noise: Annotated[Value, Q("pressure")] | None = None
    pressure_offset: Annotated[Value, Q("pressure")] | None = None
    pressure_resolution: Annotated[Value, Q("pressure")] | None = None
    pressure_lag: Annotated[Value, Q("lag")] | None = None
    position_noise: Annotated[Value, Q("x")] | None = None
    position_resolution: Annotated[Value, Q("x")] | None = None
    encoder_counts: int | None = Field(default=None, ge=0, le=10**9)


class BenchRecipe(Recipe):
    """A virtual bench: a machine like ``rig``, with what no model of it knows.

    ``truth`` replaces parameters of the rig by name (as a recipe names them); ``bulk_modulus`` is
    then that of oil and hose without air. In ``cylinder``, ``valve``, ``edge`` and ``sensors`` the
    entry ``all`` holds for every one that has no own value. What is given nowhere is drawn about a
    plausible value from ``seed``."""

    stage: Literal["bench"]
    rig: str
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    truth: ByParameter = {}
    air_fraction: Annotated[Value, Q("air_fraction")] = Value(0.003)
    polytropic_exponent: Annotated[Value, Q("polytropic_exponent")] = Value(1.3)
    droop: Annotated[Value, Q("droop")] | None = None
    pump_lag: Annotated[Value, Q("lag")] = Value(0.005)
    supply_relief: Annotated[Value, Q("relief_pressure")] | None = None
    calibration_drop: Annotated[Value, Q("pressure_drop")] = Value(2.0e6)
    delay: Annotated[Value, Q("delay")] = Value(0.001)
    velocity_cutoff: Annotated[Value, Q("frequency")] = Value(60.0)
    velocity_damping: Annotated[Value, Q("damping_ratio")] = Value(0.8)
    cylinder: dict[str, BenchCylinder] = {}
    valve: dict[str, BenchValve] = {}
    edge: dict[str, BenchEdge] = {}
    sensors: dict[str, BenchSensors] = {}


class Flowmeter(FileModel):
    """Flowmeter readings to record on the virtual bench, one CSV an edge and direction of
    ``edges``, e.g. ``boom.hect``.

    A needle valve sets each drop up to ``drop_scatter`` (a share). The turbine's noise is a share
    of the reading; below ``meter_limit`` the flow is taken from the cylinder's speed instead.
    ``outliers`` readings a file are spoilt."""

    edges: Annotated[tuple[str, ...], Field(min_length=1)]
    reverse: tuple[str, ...] = ()
    commands: Annotated[tuple[str, ...], Field(min_length=1)]
    pressure_drops: Annotated[tuple[str, ...], Field(min_length=1)]
    trials: int = Field(default=3, ge=1, le=1000)
    drop_scatter: float = Field(default=0.03, ge=0, lt=1)
    meter_noise: float = Field(default=0.007, ge=0, lt=1)
    repeat_scatter: float = Field(default=0.005, ge=0, lt=1)
    meter_limit: Annotated[Value, Q("meter_limit")] = Value(1.9e-5)
    cylinder_noise: Annotated[Value, Q("flow")] = Value(2.0e-7)
    outliers: int = Field(default=2, ge=0, le=10**6)


class DatasetLog(FileModel):
    """A log to record on the virtual bench, as a trial gives it."""

    name: str
    title: str = ""
    payload: Payload = None
    posture: dict[str, str] = {}
    duration: Annotated[Value, Q("duration")]
    rate: Annotated[Value, Q("rate")] = Value(1000.0)
    command: Annotated[tuple[Command, ...], Field(min_length=1)]
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _below_half_the_rate(self) -> Self:
        refuse_fast_waves(self.command, self.rate)
        return self


class DatasetRecipe(Recipe):
    """What the virtual bench records for a dataset, into ``datasets/<name of this file>/``."""

    stage: Literal["dataset"]
    bench: str
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    flowmeter: Flowmeter | None = None
    log: tuple[DatasetLog, ...] = ()
