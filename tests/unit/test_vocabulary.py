"""Every unit of the vocabulary is one that pint knows, and every float field of a rig or recipe has
a row.
"""

from __future__ import annotations

from typing import get_args

import pytest

from ehbench import recipe, reference, rig
from ehbench.fields import FileModel, Q, Value
from ehbench.quantities import VOCABULARY, like_channel, quantity
from ehbench.units import from_si, to_si


@pytest.mark.parametrize("row", list(VOCABULARY.values()), ids=lambda r: r.name)
def test_units_convert_both_ways(row):
    assert to_si(from_si(1.234, row.display, row), row.display, row) == pytest.approx(
        1.234, rel=1e-12
    )
    assert row.meaning and row.symbol and row.lower < row.upper


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


@pytest.mark.parametrize("model", list(models()), ids=lambda m: m.__name__)
def test_every_quantity_field_has_a_row(model):
    for name, field in model.model_fields.items():
        kinds = (field.annotation, *get_args(field.annotation))
        if Value in kinds or any(Value in get_args(kind) for kind in kinds):
            marks = list(field.metadata) + [
                m for kind in kinds for m in getattr(kind, "__metadata__", ())
            ]
            assert any(isinstance(mark, Q) and mark.row for mark in marks), (
                f"{model.__name__}.{name}"
            )


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
