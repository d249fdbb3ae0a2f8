"""The recipe of an identification from step logs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ehbench.fields import Q, Value
from ehbench.recipe.base import TIED, ByParameter, Recipe, ReplayedFiles, Tied
from ehbench.recipe.columns import AnyColumns
from ehbench.recipe.sensor import Sensors


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
    compare_dynamics: tuple[str, ...] = ()
    compare_sensor: Sensors = Field(
        default=(),
        description="`[[compare_sensor]]`: further `[[sensor]]` tables of the fits that compare, "
        "such as lags to estimate: a sensor's lag is easily taken for the valve's",
    )
    max_iterations: int = Field(default=100, ge=1, le=1000)
    workers: int = Field(default=0, ge=0, le=256)
