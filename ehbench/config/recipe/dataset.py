"""The recipe of a dataset that the virtual bench records."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ehbench.config.recipe.base import Payload, Recipe
from ehbench.config.recipe.trial import Command, Limits, refuse_fast_waves
from ehbench.vocabulary.fields import FileModel, Q, Value


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
    def _below_half_the_rate(self) -> DatasetLog:
        refuse_fast_waves(self)
        return self


class DatasetRecipe(Recipe):
    """What the virtual bench records for a dataset, into ``datasets/<name of this file>/``."""

    stage: Literal["dataset"]
    bench: str
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    flowmeter: Flowmeter | None = None
    log: tuple[DatasetLog, ...] = ()
