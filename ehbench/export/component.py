"""A part that can be exported: a compiled kernel with the memory that it works on, and the
variables by which people know what lies there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import Any, Literal, NamedTuple

import numpy as np

from ehbench.config.rig.names import ascii_words
from ehbench.vocabulary import VOCABULARY

WORD = 8  # bytes of a number


def identifier(text: str) -> str:
    """A text as a name in C and MATLAB: letters, digits and _ of ASCII, a letter first."""
    plain = ascii_words(text)
    return plain if plain[:1].isalpha() else f"c{plain}"


def distinct(names: Iterable[str]) -> list[str]:
    """Names with numbers behind those that an earlier one has too, whatever their case."""
    result: list[str] = []
    for name in names:
        taken = {item.upper() for item in result}
        tries = (f"{name}_{i}" if i > 1 else name for i in count(1))
        result.append(next(item for item in tries if item.upper() not in taken))
    return result


class Variable(NamedTuple):
    """An input, output or parameter.

    Attributes:
        name: such as ``boom.p_head``.
        role: what it is to who uses the part.
        places: where its number stands, as members of the part's memory in C.
        start: its value before the first step [unit].
        unit: SI.
        lower, upper: its range [unit]; an input or parameter takes no value beyond.
        about: meaning, and of a parameter its source and interval."""

    name: str
    role: Literal["input", "output", "parameter"]
    places: tuple[str, ...]
    start: float
    unit: str = ""
    lower: float = -np.inf
    upper: float = np.inf
    about: str = ""

    @classmethod
    def of(cls, name: str, role: Any, place: str, start: float, **more: Any) -> Variable:
        """A variable with unit, range and meaning of the vocabulary's row of its last word."""
        row = VOCABULARY.get(name.rsplit(".", 1)[-1])
        known: dict[str, Any] = {}
        if row is not None:
            known = {"unit": row.unit, "about": row.meaning}
            known |= {"lower": row.lower, "upper": row.upper}
        return cls(name, role, (place,), float(start), **{**known, **more})


class Leaf(NamedTuple):
    """A number, array or record among a kernel's arguments, and its name in C."""

    name: str
    value: Any


def leaves(name: str, value: Any) -> Iterator[Leaf]:
    """What an argument is of, in the order in which compiled code takes it."""
    if isinstance(value, tuple):
        fields = getattr(value, "_fields", range(len(value)))
        for field, item in zip(fields, value, strict=True):
            yield from leaves(f"{name}_{field}", item)
    else:
        yield Leaf(name, value)


def members(
    text: str, layout: np.dtype, shape: tuple[int, ...] = ()
) -> Iterator[tuple[str, np.dtype]]:
    """(name in C, type) of the numbers of an array or record, in the order of memory."""
    if shape:
        for i in range(shape[0]):
            yield from members(f"{text}[{i}]", layout, shape[1:])
    elif layout.names is None:
        yield text, layout
    else:
        for field in layout.names:
            inner, size = layout[field].subdtype or (layout[field], ())
            yield from members(f"{text}.{field}", inner, size)


@dataclass(frozen=True)
class Component:
    """A part to export.

    Attributes:
        name: in C.
        about: what it is, a sentence.
        kernel: does one step.
        arguments: of the kernel by name, as they are before the first step.
        variables: inputs first, then outputs, then parameters.
        rate: steps a second [Hz].
        rows: inputs and outputs of each step of a trial, shape (steps, inputs + outputs)."""

    name: str
    about: str
    kernel: Callable[..., Any]
    arguments: Mapping[str, Any]
    variables: tuple[Variable, ...]
    rate: float
    rows: np.ndarray

    @cached_property
    def leaves(self) -> tuple[Leaf, ...]:
        """All that the kernel takes."""
        return tuple(leaf for item in self.arguments.items() for leaf in leaves(*item))

    @property
    def memory(self) -> tuple[Leaf, ...]:
        """The leaves that an instance has in its memory; plain numbers stand in the code."""
        return tuple(leaf for leaf in self.leaves if isinstance(leaf.value, (np.ndarray, np.void)))

    def role(self, role: str) -> tuple[Variable, ...]:
        """The variables of a role."""
        return tuple(item for item in self.variables if item.role == role)


def numbers(leaf: Leaf) -> dict[str, int]:
    """The bits of each number of a leaf, by its name in C; nothing of arrays of yes and no."""
    value = leaf.value
    if value.dtype.itemsize % WORD:
        return {}
    words = np.frombuffer(np.ascontiguousarray(value).tobytes(), np.int64)
    names = (name for name, _ in members(leaf.name, value.dtype, value.shape))
    return dict(zip(names, words.tolist(), strict=True))
