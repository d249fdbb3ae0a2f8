"""The recipes of flow maps, and of hydraulics from step logs."""

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from ehbench.config.recipe.base import ByParameter, DataFiles, Recipe, ReplayedFiles, Supplied, Tied
from ehbench.config.recipe.columns import AnyColumns
from ehbench.config.recipe.sensor import Channel, Sensors
from ehbench.vocabulary import message, shortened
from ehbench.vocabulary.fields import FileModel, Q, Value


def _samples(given: object) -> object:
    whole = isinstance(given, int) and not isinstance(given, bool) and given >= 1
    if not whole and given != "auto":
        raise ValueError(message("config.no_sample_count", given=shortened(given, 40)))
    return given


class ComparedResponse(FileModel):
    """The frequency response that logs are compared by, in place of their samples: of a cylinder's
    rate and pressures to a command that sweeps."""

    input: Channel
    segment: Annotated[Value, Q("duration")] | None = None
    window: Literal["hann", "boxcar"] | None = None
    coherence_min: float = Field(default=0.8, gt=0, lt=1)
    frequency_max: Annotated[Value, Q("frequency")] | None = None


class HydraulicsRecipe(Recipe):
    """Step logs to bulk modulus, damping, friction and whatever else ``parameters`` names.

    ``compare_dynamics`` names valve dynamics of the rig file; the logs are fitted with each in
    turn, so that the data decide where they can. ``prior`` is what is known of a parameter beside
    the data: a standard deviation about the rig file's value, with unit or as a share such as "3
    %"."""

    stage: Literal["identify"]
    what: Literal["hydraulics"]
    method: Literal["thesis", "output_error"] = "output_error"
    rig: str
    flow_maps: str | None = None
    data: ReplayedFiles
    tied: Tied = "none"
    supply: Supplied = "model"
    columns: AnyColumns = None
    parameters: Annotated[tuple[str, ...], Field(min_length=1)]
    start: ByParameter = {}
    lower: ByParameter = {}
    upper: ByParameter = {}
    prior: ByParameter = {}
    sensor: Sensors = ()
    channels: tuple[str, ...] = ("qd", "p_head", "p_rod")
    cutoff: Annotated[Value, Q("frequency")] | None = None
    decimate: Annotated[Literal["auto"] | int, BeforeValidator(_samples)] = "auto"
    response: ComparedResponse | None = None
    compare_dynamics: tuple[str, ...] = ()
    compare_sensor: Sensors = ()
    max_iterations: int = Field(default=100, ge=1, le=1000)
    workers: int = Field(default=0, ge=0, le=256)


class CalibrationPoint(FileModel):
    """A flow that a command is supposed to give, e.g. 2 gpm at 4 V, to be met within ``tolerance``
    of that flow."""

    command: Annotated[Value, Q("command")]
    flow: Annotated[Value, Q("flow")]
    tolerance: float = Field(default=0.1, gt=0, lt=1)


class FlowMapRecipe(Recipe):
    """Flowmeter readings, or step logs without a flowmeter (``method`` "steps"), to flow maps.

    From logs, an edge's flow is what the chamber that it alone feeds or drains takes: area times
    speed, compression and leakage, from ``settle`` after a change of a command on, over pieces of
    ``span``.

    ``calibration`` is checked on every map at ``calibration_drop``. A flowmeter reading below
    ``meter_limit`` only says that the flow lies below it; readings of the method ``cylinder`` have
    no such limit."""

    stage: Literal["identify"]
    what: Literal["flow_map"]
    method: Literal["flowmeter", "steps"] = "flowmeter"
    rig: str
    data: DataFiles
    columns: AnyColumns = None
    calibration: tuple[CalibrationPoint, ...] = ()
    calibration_drop: Annotated[Value, Q("pressure_drop")] | None = None
    meter_limit: Annotated[Value, Q("meter_limit")] = Value(0.0)
    settle: Annotated[Value, Q("settle")] = Value(0.2)
    pressure_error: Annotated[Value, Q("zero_error")] | None = None
    command_error: Annotated[Value, Q("hysteresis")] | None = None
    span: Annotated[Value, Q("span")] = Value(0.1)

    @model_validator(mode="after")
    def _readings_have_no_time(self) -> Self:
        given = {key for item in self.data for key in item.model_fields_set}
        if self.method == "flowmeter" and (odd := given - {"path", "columns", "note"}):
            raise ValueError(message("config.readings_entry", key=min(odd)))
        return self
