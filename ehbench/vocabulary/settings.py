"""Numbers of a method, each with its unit, meaning and origin.

A method keeps its numbers in one frozen dataclass whose fields are made by `setting`; the reference
pages of the docs list them all."""

from dataclasses import field, fields
from typing import Any, NamedTuple


class SettingRow(NamedTuple):
    """A number of a method; ``unit`` '' of a pure number, ``origin``: why this value."""

    name: str
    value: Any
    unit: str
    meaning: str
    origin: str


def setting(value: Any, unit: str, meaning: str, origin: str) -> Any:
    """A field of a frozen dataclass of settings.

    Args:
        value: in SI.
        unit: SI, empty for a pure number.
        meaning: what it decides, in one sentence.
        origin: a source, a measurement that anyone can repeat, or the reason for the choice."""
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "origin": origin})


def rows(settings: Any) -> list[SettingRow]:
    """The settings of a method as a table."""
    return [
        SettingRow(item.name, getattr(settings, item.name), **item.metadata)
        for item in fields(settings)
        if "meaning" in item.metadata
    ]
