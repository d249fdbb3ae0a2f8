"""The recipe of flow maps."""

from typing import Annotated, Literal

from pydantic import Field

from ehbench.config.recipe.base import Recipe
from ehbench.config.recipe.columns import AnyColumns
from ehbench.vocabulary.fields import FileModel, Q, Value


class CalibrationPoint(FileModel):
    """A flow that a command is supposed to give, e.g. 2 gpm at 4 V, to be met within ``tolerance``
    of that flow.
    """

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
    data: Annotated[tuple[str, ...], Field(min_length=1)]
    columns: AnyColumns = None
    calibration: tuple[CalibrationPoint, ...] = ()
    calibration_drop: Annotated[Value, Q("pressure_drop")] | None = None
    meter_limit: Annotated[Value, Q("meter_limit")] = Value(0.0)
    settle: Annotated[Value, Q("settle")] = Value(0.2)
    pressure_error: Annotated[Value, Q("zero_error")] | None = None
    command_error: Annotated[Value, Q("hysteresis")] | None = None
    span: Annotated[Value, Q("span")] = Value(0.1)
