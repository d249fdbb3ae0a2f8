"""The recipe of a validation."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from ehbench.errors import InputError
from ehbench.fields import FileModel, read_value
from ehbench.quantities import VOCABULARY
from ehbench.recipe.base import DataFiles, Recipe


def _share(raw: Any) -> Any:
    if raw is True:
        raise ValueError("a share of the recorded value such as 0.15, or false to ask for none")
    return None if raw is False else raw


_Share = Annotated[Annotated[float, Field(gt=0)] | None, BeforeValidator(_share)]


class Thresholds(FileModel):
    """What a model must reach on every held-out log to be accepted; a quantity not named is only
    reported.

    ``fit_percent`` is the least NRMSE fit by quantity (100 exact, 0 no better than the mean),
    ``max_error`` the largest error by quantity, with unit. ``natural_frequency_error`` and
    ``damping_ratio_error`` are shares of the recorded value; ``false`` asks for none. ``whiteness``
    and ``independence`` ask that at most ``outside_percent`` of the lags of the residual's
    autocorrelation, and of its correlation with earlier commands, lie outside of their 95 % bands.
    """

    fit_percent: dict[str, float] = {"qd": 50.0, "p_head": 30.0, "p_rod": 30.0}
    max_error: dict[str, Any] = {}
    natural_frequency_error: _Share = 0.15
    damping_ratio_error: _Share = None
    whiteness: bool = False
    independence: bool = False
    outside_percent: float = Field(default=15.0, gt=0, lt=100)

    @field_validator("fit_percent", "max_error")
    @classmethod
    def _quantities(cls, asked: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        for name, value in asked.items():
            if name not in VOCABULARY:
                near = get_close_matches(name, VOCABULARY, 1)
                raise ValueError(
                    f"no quantity '{name}'" + (f"; nearest is '{near[0]}'" if near else "")
                )
            if info.field_name == "fit_percent" and not value < 100.0:
                raise ValueError(f"{name} = {value:g} cannot be reached: 100 % is an exact match")
        if info.field_name == "fit_percent":
            return asked
        try:
            return {name: read_value(value, VOCABULARY[name]) for name, value in asked.items()}
        except InputError as error:
            raise ValueError(str(error)) from None


class ValidateRecipe(Recipe):
    """An identified rig against logs it was not fitted to."""

    stage: Literal["validate"]
    rig: str
    flow_maps: str | None = None
    data: DataFiles
    channels: tuple[str, ...] = ("q", "qd", "p_head", "p_rod")
    thresholds: Thresholds = Thresholds()
