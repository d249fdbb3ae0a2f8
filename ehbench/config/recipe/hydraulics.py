"""The recipe of an identification from step logs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from ehbench.config.recipe.base import (
    SUPPLIED,
    TIED,
    ByParameter,
    Recipe,
    ReplayedFiles,
    Supplied,
    Tied,
)
from ehbench.config.recipe.columns import AnyColumns
from ehbench.config.recipe.sensor import Channel, Sensors
from ehbench.vocabulary.fields import FileModel, Q, Value
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.text import shortened


def _samples(given: object) -> object:
    whole = isinstance(given, int) and not isinstance(given, bool) and given >= 1
    if not whole and given != "auto":
        raise ValueError(message("config.no_sample_count", given=shortened(given, 40)))
    return given


class ComparedResponse(FileModel):
    """The frequency response that logs are compared by, in place of their samples: of a cylinder's
    rate and pressures to a command that sweeps.
    """

    input: Channel = Field(description="the command that sweeps, such as `ram.pa.command`")
    segment: Annotated[Value, Q("duration")] | None = Field(
        default=None, description="length of a segment; none averages 8 of each log"
    )
    window: Literal["hann", "boxcar"] = Field(
        default="hann",
        description="of a segment: `hann`, half overlapping; `boxcar`, end to end, for an input "
        "that repeats with the segment",
    )
    coherence_min: float = Field(
        default=0.8, gt=0, lt=1, description="of the recording, from which a frequency counts"
    )
    frequency_max: Annotated[Value, Q("frequency")] | None = Field(
        default=None, description="what lies above is not looked at; none is half the log's rate"
    )


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
    tied: Tied = TIED
    supply: Supplied = SUPPLIED
    columns: AnyColumns = Field(
        default=None,
        description="which column of a file is which channel: `[columns]`, or the name of a map",
    )
    parameters: Annotated[tuple[str, ...], Field(min_length=1)]
    start: ByParameter = {}
    lower: ByParameter = {}
    upper: ByParameter = {}
    prior: ByParameter = {}
    sensor: Sensors = Field(
        default=(), description="`[[sensor]]`: what is known of sensors and drivers, or estimated"
    )
    channels: tuple[str, ...] = ("qd", "p_head", "p_rod")
    cutoff: Annotated[Value, Q("frequency")] | None = None
    decimate: Annotated[Literal["auto"] | int, BeforeValidator(_samples)] = Field(
        default="auto",
        description="samples of which the mean is compared with that of the simulation: a number, "
        '1 for each by itself, or `"auto"`: of logs from 3 kHz on as many as cost next to '
        "nothing of what they tell",
    )
    response: ComparedResponse | None = Field(
        default=None,
        description="`[response]`: logs are compared by their frequency response to a command that "
        "sweeps, in place of their samples",
    )
    compare_dynamics: tuple[str, ...] = ()
    compare_sensor: Sensors = Field(
        default=(),
        description="`[[compare_sensor]]`: further `[[sensor]]` tables of the fits that compare, "
        "such as lags to estimate: a sensor's lag is easily taken for the valve's",
    )
    max_iterations: int = Field(default=100, ge=1, le=1000)
    workers: int = Field(default=0, ge=0, le=256)
