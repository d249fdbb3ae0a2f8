"""Every unit converts both ways, and every float field of a rig or recipe has a row."""

from typing import get_args

import pytest

from ehbench.config import recipe, rig
from ehbench.parts import sample
from ehbench.vocabulary.fields import FileModel, Q, Value
from ehbench.vocabulary.quantities import VOCABULARY, like_channel, quantity
from ehbench.vocabulary.units import from_si, to_si
from tools import reference


def test_every_row_says_what_it_is_and_units_convert_both_ways():
    wrong = [
        row.name
        for row in VOCABULARY.values()
        if to_si(from_si(1.234, row.display, row), row.display, row)
        != pytest.approx(1.234, rel=1e-12)
    ]
    assert not wrong
    wrong = [
        row.name
        for row in VOCABULARY.values()
        if not (row.meaning and row.symbol and row.lower < row.upper)
    ]
    assert not wrong


def test_a_sample_has_the_channels_that_the_vocabulary_says_are_measured():
    """A measured channel is a row with a sensor; this names what a new one still lacks."""
    measured = {
        place: tuple(row.name for row in VOCABULARY.values() if row.sensor == place)
        for place in ("cylinder", "supply")
    }
    assert measured == {"cylinder": sample.OF._fields, "supply": sample.LINE._fields}


def models():
    yield from reference.models([rig.Rig])
    for module in (rig, recipe):
        for item in vars(module).values():
            if (
                isinstance(item, type)
                and issubclass(item, FileModel)
                and item.__module__.startswith(module.__name__)
            ):
                yield item


def is_bare(field):
    """Whether a field holds values, but of no quantity."""
    kinds = (field.annotation, *get_args(field.annotation))
    if not (Value in kinds or any(Value in get_args(kind) for kind in kinds)):
        return False
    marks = list(field.metadata) + [m for kind in kinds for m in getattr(kind, "__metadata__", ())]
    return not any(isinstance(mark, Q) and mark.row for mark in marks)


def test_every_quantity_field_has_a_row():
    every = list(models())
    assert len(every) > 30
    wrong = [
        f"{model.__name__}.{name}"
        for model in every
        for name, field in model.model_fields.items()
        if is_bare(field)
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("channel", "said"),
    [
        ("press.servo", "; if 'servo' is a valve, its command is 'press.servo.command'"),
        ("press.p_haed", "; nearest is 'press.p_head'"),
        ("p_haed", "; nearest is 'p_head'"),
        ("zzz", ""),
    ],
)
def test_a_word_that_is_none_is_answered_with_what_may_be_meant(channel, said):
    with pytest.raises(KeyError) as caught:
        quantity(channel)
    assert caught.value.args[0] == f"no quantity '{channel.split('.')[-1]}'{said}"


def test_a_channel_that_a_log_lacks_is_answered_with_the_one_that_is_meant():
    there = ["press.x", "press.p_head", "press.servo.command"]
    for name in ("press.servo", "servo", "servo.command", "press.serv.command"):
        assert like_channel(name, there).startswith("did you mean 'press.servo.command'? it has ")
    assert like_channel("press", there) == f"it has {', '.join(there)}"
