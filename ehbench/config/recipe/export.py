"""The recipe of an export."""

from typing import Annotated, Literal

from pydantic import Field

from ehbench.config.recipe.base import Payload, Recipe
from ehbench.vocabulary.fields import Q, Value

Format = Literal["c", "fmu2", "fmu3", "matlab", "urdf", "mjcf"]
Target = Literal["linux64", "win64", "aarch64"]


class ExportRecipe(Recipe):
    """A validated rig as a model, and a tuned controller, for other programs and targets."""

    stage: Literal["export"]
    rig: str
    flow_maps: str | None = None
    controller: str | None = None
    parts: Literal["model", "controller", "both"] | None = None
    formats: tuple[Format, ...] = Field(default=("c",), min_length=1)
    payload: Payload = None
    posture: dict[str, str] = {}
    rate: Annotated[Value, Q("rate")] | None = None
    targets: tuple[Target, ...] = ()
