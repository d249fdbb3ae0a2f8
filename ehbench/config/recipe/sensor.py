"""What a recipe says of a log's sensors and of the commands as they were recorded."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ValidationInfo, field_validator

from ehbench.config.recipe.toml import as_list
from ehbench.config.rig.names import second
from ehbench.vocabulary import VOCABULARY, InputError, Quantity, message, quantity
from ehbench.vocabulary.fields import FileModel, Value, read_value, write_value

ESTIMATE = "estimate"
WORDS = ("offset", "scale", "lag", "delay")


def reading_row(channel: str, word: str) -> Quantity:
    """The vocabulary row of what may be wrong with a channel's sensor: that of the channel for its
    ``offset``, rows of their own for ``scale``, ``lag`` and ``delay``, which is negative of a
    command that was written late."""
    if word == "offset":
        return quantity(channel)
    if word == "delay" and channel.endswith(".command"):
        return VOCABULARY["command_delay"]
    return VOCABULARY["sensor_scale" if word == "scale" else word]


def _known(channel: str) -> str:
    try:
        quantity(channel)
    except KeyError as error:
        raise ValueError(str(error.args[0])) from None
    return channel


Channel = Annotated[str, AfterValidator(_known)]  # full name of a channel of the vocabulary


class Sensor(FileModel):
    """A channel as its sensor gives it: ``reading = scale · late(sign · true) + offset``, ``late``
    a first-order lag and a delay. Of a command, ``offset`` is the neutral and ``sign`` the
    polarity of the driver.

    Each of ``offset``, ``scale``, ``lag`` and ``delay`` is a value that is known, one with a
    standard error, ``{ value, std }``, or ``"estimate"``. What has a standard error, or is to be
    estimated, is estimated with the fit and held by that error."""

    channel: Channel
    per_log: bool = False
    sign: Literal[1, -1] = 1
    pressure: Literal["gauge", "absolute"] = "gauge"
    offset: Any = None
    scale: Any = None
    lag: Any = None
    delay: Any = None

    @field_validator("pressure")
    @classmethod
    def _of_a_pressure(cls, kind: str, info: ValidationInfo) -> str:
        channel = info.data.get("channel", "p_head")
        if kind == "absolute" and quantity(channel).unit != "Pa":
            raise ValueError(message("config.not_a_pressure", channel=channel))
        return kind

    @field_validator(*WORDS)
    @classmethod
    def _read(cls, raw: Any, info: ValidationInfo) -> Value | Literal["estimate"] | None:
        if raw is None or raw == ESTIMATE or "channel" not in info.data:
            return raw
        word = str(info.field_name)
        try:
            value = read_value(raw, reading_row(info.data["channel"], word))
        except InputError as error:
            more = f'; or "{ESTIMATE}"' if isinstance(raw, str) else ""
            raise ValueError(f"{error}{more}") from None
        if word == "scale" and float(value) <= 0.0:
            raise ValueError(message("config.not_positive", word=word, raw=raw))
        return value

    def __getitem__(self, word: str) -> Value | str | None:
        """What is said of ``offset``, ``scale``, ``lag`` or ``delay``."""
        return getattr(self, word)

    def as_toml(self) -> dict[str, Any]:
        """The table as a TOML writer takes it."""
        plain = self.model_dump(exclude_defaults=True, exclude=set(WORDS))
        for word in WORDS:
            given = self[word]
            if given is not None:
                row = reading_row(self.channel, word)
                plain[word] = write_value(given, row) if isinstance(given, Value) else given
        return plain


def _each_once(sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    names = [sensor.channel for sensor in sensors]
    if (at := second(names)) is not None:
        raise ValueError(message("config.channel_twice", name=names[at]))
    return sensors


Sensors = Annotated[tuple[Sensor, ...], BeforeValidator(as_list), AfterValidator(_each_once)]
