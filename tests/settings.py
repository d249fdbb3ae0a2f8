"""Whether a number of a method decides an outcome."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NamedTuple

import pytest

from ehbench.vocabulary.errors import EhbenchError


class OfKernels(NamedTuple):
    """Numbers that kernels of a module read as constants, by its name of them: another one shows in
    their Python functions alone (`inspect.unwrap`)."""

    module: ModuleType
    table: str


def value_of(settings: Any, name: str) -> Any:
    """A number of settings."""
    if isinstance(settings, OfKernels):
        settings = getattr(settings.module, settings.table)
    return getattr(settings, name)


@contextmanager
def at(settings: Any, name: str, value: Any) -> Iterator[None]:
    """Within the block a number of a frozen settings object is another one."""
    before = value_of(settings, name)

    def put(value: Any) -> None:
        if isinstance(settings, OfKernels):
            module, table = settings
            setattr(module, table, getattr(module, table)._replace(**{name: value}))
        else:
            object.__setattr__(settings, name, value)

    put(value)
    try:
        yield
    finally:
        put(before)


@contextmanager
def answers(module: Any, **values: Any) -> Iterator[None]:
    """Within the block functions of a module answer with a value, or are another function; what is
    no function is the value."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            if callable(getattr(module, name)) and not callable(value):
                patch.setattr(module, name, lambda *_, value=value, **__: value)
            else:
                patch.setattr(module, name, value)
        yield


class Ended(Exception):
    """Work is over where a test has seen enough."""


def first_call(module: Any, name: str, work: Any) -> tuple:
    """What a function of a module is given when ``work`` first asks for it, and ends there."""

    def asked(*given: Any, **more: Any):
        raise Ended(*given, *more.values())

    with answers(module, **{name: asked}), pytest.raises(Ended) as call:
        work()
    return call.value.args


def refusal(work) -> str:
    """The key of what is refused; '' for nothing."""
    try:
        work()
    except EhbenchError as error:
        return error.key
    return ""


def _off(value: Any, factor: float) -> Any:
    """A number times a factor, an integer at least one off."""
    other = value * factor
    if isinstance(value, int):
        return math.ceil(other) if factor > 1.0 else math.floor(other)
    return other


def shows(settings, name, scenario, outcome):
    """An outcome is as stated with a number of ``settings``, another with a third more or less; of
    several numbers with any of them."""
    assert scenario() == outcome
    value = value_of(settings, name)
    for factor in (4.0 / 3.0, 2.0 / 3.0):
        others = [_off(value, factor)] if not isinstance(value, tuple) else []
        for i, item in enumerate(value if isinstance(value, tuple) else ()):
            others.append((*value[:i], _off(item, factor), *value[i + 1 :]))
        for other in others:
            with at(settings, name, other):
                assert scenario() != outcome, (name, other)


def each(settings: Any, names: str, scenario: Any, outcome: Any) -> list[tuple]:
    """Rows of a table of several numbers that decide the same outcome."""
    return [(settings, name, scenario, outcome) for name in names.split()]


def each_shows(rows):
    """The test of a table of settings, names, scenarios and their outcomes; with inputs before the
    outcomes, of a scenario of each."""

    @pytest.mark.parametrize("row", rows, ids=lambda row: f"{str(row[0])[:16]}-{row[1]}")
    def test(row):
        settings, name, scenario, *inputs, outcome = row
        over = (lambda: [scenario(x) for x in inputs[0]]) if inputs else scenario
        shows(settings, name, over, outcome)

    return test
