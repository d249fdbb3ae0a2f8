"""The recipe of a frequency response."""

from typing import Annotated, Literal

from pydantic import Field

from ehbench.config.recipe.base import DataFiles, Recipe
from ehbench.config.recipe.columns import AnyColumns
from ehbench.vocabulary.fields import Q, Value


class ResponseRecipe(Recipe):
    """The frequency response from one channel of the logs to another."""

    stage: Literal["response"]
    rig: str = Field(description="whose units the report uses, and whose logs these are")
    data: DataFiles
    columns: AnyColumns = Field(
        default=None,
        description="which column of a file is which channel: `[columns]`, or the name of a map",
    )
    input: str = Field(description="channel, such as `boom.hect.command`")
    output: str = Field(description="channel, such as `boom.v`")
    segment: Annotated[Value, Q("duration")] | None = Field(
        default=None,
        description="length of a segment; none takes an eighth of the shortest log. "
        "Its inverse is the resolution in frequency",
    )
    window: Literal["hann", "boxcar"] | None = Field(
        default=None, description="of former versions; has no effect"
    )
    coherence_min: float = Field(
        default=0.8, gt=0, lt=1, description="from which a frequency counts"
    )
    transfer: bool = Field(
        default=False,
        description="whether plain transfer functions (one pole, two, or a pair with a damping "
        "ratio, with and without delay; a pair, a pole and delay) are fitted in time and compared",
    )
    frequency_max: Annotated[Value, Q("frequency")] | None = Field(
        default=None, description="what lies above is not looked at; none is half the logs' rate"
    )
