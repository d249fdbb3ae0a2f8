"""The recipe of a validation."""

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from ehbench.config.recipe.base import Recipe, ReplayedFile, Supplied, Tied
from ehbench.config.recipe.columns import AnyColumns
from ehbench.config.recipe.sensor import Channel, Sensors
from ehbench.config.recipe.toml import as_table
from ehbench.vocabulary import VOCABULARY, InputError, message, quantity
from ehbench.vocabulary.fields import FileModel, Q, Value, read_value
from ehbench.vocabulary.quantities import meant


def _or_false(expected: str) -> BeforeValidator:
    """``false`` for none; ``expected`` is the message to ``true``."""

    def checked(raw: Any) -> Any:
        if raw is True:
            raise ValueError(message(expected))
        return None if raw is False else raw

    return BeforeValidator(checked)


_Share = Annotated[Annotated[float, Field(gt=0)] | None, _or_false("config.share_expected")]


class Thresholds(FileModel):
    """What a model must reach on every held-out log to be accepted; a quantity not named is only
    reported.

    ``fit_percent`` is the least NRMSE fit by quantity (100 exact, 0 no better than the mean),
    ``max_error`` the largest error by quantity, with unit. ``natural_frequency_error`` and
    ``damping_ratio_error`` are shares of the recorded value; ``false`` asks for none. The keys of
    the ``response`` hold where a command sweeps. ``whiteness``
    and ``independence`` ask that at most ``outside_percent`` of the lags of the residual's
    autocorrelation, and of its correlation with earlier commands, lie outside of their 95 % bands.
    """

    fit_percent: dict[str, float] = {"qd": 50.0, "p_head": 30.0, "p_rod": 30.0}
    max_error: dict[str, Any] = {}
    natural_frequency_error: _Share = 0.15
    damping_ratio_error: _Share = None
    response_gain_error: _Share = 0.25
    response_phase_error: Annotated[
        Annotated[Value, Q("phase")] | None, _or_false("config.value_expected")
    ] = read_value("20 deg", VOCABULARY["phase"])
    response_delay_error: Annotated[
        Annotated[Value, Q("delay")] | None, _or_false("config.value_expected")
    ] = read_value("5 ms", VOCABULARY["delay"])
    response_coherence: float = Field(default=0.8, gt=0, lt=1)
    whiteness: bool = False
    independence: bool = False
    outside_percent: float = Field(default=15.0, gt=0, lt=100)

    @field_validator("fit_percent", "max_error")
    @classmethod
    def _quantities(cls, requested: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        for name, value in requested.items():
            if name not in VOCABULARY:
                word = name.rpartition(".")[2]
                of_all = f"; it is asked of all cylinders alike: '{word}'"
                hint = of_all if word in VOCABULARY else meant(name)
                raise ValueError(f"no quantity '{name}'{hint}")
            if info.field_name == "fit_percent" and not value < 100.0:
                raise ValueError(message("config.fit_too_high", name=name, value=value))
        if info.field_name == "fit_percent":
            return requested
        try:
            return {name: read_value(value, VOCABULARY[name]) for name, value in requested.items()}
        except InputError as error:
            raise ValueError(str(error)) from None


class JudgedFile(ReplayedFile):
    """A log to judge on; the model runs from ``start`` on, and what it does from ``score_start`` to
    ``score_stop`` counts."""

    score_start: Annotated[Value, Q("start")] | None = None
    score_stop: Annotated[Value, Q("stop")] | None = None

    @property
    def scored(self) -> tuple[float, float] | None:
        """The part of the log that counts [s]; None for all of it."""
        if self.score_start is None and self.score_stop is None:
            return None
        start, stop = self.score_start, self.score_stop
        first = -math.inf if start is None else float(start)
        return first, math.inf if stop is None else float(stop)


class Reference(FileModel):
    """A figure that others reached on the same recording, to stand beside this model's in the
    report. It decides nothing."""

    name: str = Field(min_length=1)
    channel: Channel
    measure: Literal["rms_error", "fit_percent"] = "rms_error"
    value: Any
    source: str = Field(min_length=1)

    @field_validator("value")
    @classmethod
    def _read(cls, raw: Any, info: ValidationInfo) -> Value | None:
        if "channel" not in info.data or "measure" not in info.data:
            return None
        if info.data["measure"] == "fit_percent":
            if isinstance(raw, bool) or not isinstance(raw, int | float) or not raw <= 100.0:
                raise ValueError(message("config.no_percentage", raw=raw))
            return Value(float(raw))
        try:
            value = read_value(raw, quantity(info.data["channel"]))
        except InputError as error:
            raise ValueError(str(error)) from None
        if not 0.0 <= float(value) < math.inf:
            raise ValueError(message("config.no_rms_error", raw=raw))
        return value

    def as_json(self) -> dict[str, Any]:
        """Plain values [SI]."""
        return self.model_dump(exclude={"value"}) | {"value": float(self.value)}


JudgedFiles = Annotated[tuple[Annotated[JudgedFile, as_table("path")], ...], Field(min_length=1)]


class ValidateRecipe(Recipe):
    """An identified rig against logs it was not fitted to."""

    stage: Literal["validate"]
    rig: str
    flow_maps: str | None = None
    data: JudgedFiles
    tied: Tied = "none"
    supply: Supplied = "model"
    columns: AnyColumns = None
    sensor: Sensors = ()
    channels: tuple[str, ...] = ("q", "qd", "p_head", "p_rod")
    structure: bool = True
    thresholds: Thresholds = Thresholds()
    reference: tuple[Reference, ...] = ()
