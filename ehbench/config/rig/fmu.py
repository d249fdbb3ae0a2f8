"""A user's FMU in place of a rig's laws: what its variables are called."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from ehbench.vocabulary.fields import FileModel, Q, Value


class ForeignNumber(FileModel):
    """A number that an FMU has and the laws do not, the parameter ``<name>.number``."""

    variable: str
    number: Annotated[Value, Q("number")]


class ForeignModel(FileModel):
    """An FMU for co-simulation that takes the place of the rig's laws where a recipe simulates.

    Controllers are still designed on the laws. Every table is by the name that ehbench has, with
    the name of the FMU's variable."""

    fmu: str
    channels: dict[str, str] = Field(min_length=1)
    commands: dict[str, str] = Field(min_length=1)
    parameters: dict[str, str] = {}
    numbers: dict[str, ForeignNumber] = {}
    start: dict[str, str] = {}
    place: Path = Field(default=Path(), exclude=True, repr=False)

    @property
    def settable(self) -> dict[str, str]:
        """The FMU's variable of each parameter that it takes."""
        return self.parameters | {f"{name}.number": i.variable for name, i in self.numbers.items()}
