"""Whether a number of a method decides an outcome."""

import math
from contextlib import contextmanager

from ehbench.vocabulary.errors import EhbenchError


@contextmanager
def at(settings, name, value):
    """Within the block a number of a frozen settings object is another one."""
    before = getattr(settings, name)
    object.__setattr__(settings, name, value)
    try:
        yield
    finally:
        object.__setattr__(settings, name, before)


def refusal(work) -> str:
    """The key of what is refused; '' for nothing."""
    try:
        work()
    except EhbenchError as error:
        return error.key
    return ""


def shows(settings, name, scenario, outcome):
    """An outcome is as stated with a number of ``settings``, another with a third more or less."""
    assert scenario() == outcome
    value = getattr(settings, name)
    for factor in (4.0 / 3.0, 2.0 / 3.0):
        other = value * factor
        if isinstance(value, int):
            other = math.ceil(other) if factor > 1.0 else math.floor(other)
        with at(settings, name, other):
            assert scenario() != outcome, (name, other)
