"""Every parameter of a rig as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ehbench.config.rig import Rig, Slide
from ehbench.report.blocks import Block, Bullets, Cell, Grid
from ehbench.report.captions import as_fitted, plus
from ehbench.report.content import num
from ehbench.report.saved import Table, grouped
from ehbench.report.words import number, pretty, row_of, shown, unit_of
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.terms import Z95


def rig_table(rig: Rig, fits: Sequence[Table] = ()) -> list[Block]:
    """Every parameter of a rig, with value, unit, how sure it is, and source; the notes on its
    valve dynamics before.

    Args:
        rig: the rig.
        fits: rows of ``parameters.json``, whose interval a value has that came from one of them;
            the others have 1.96 of their standard error.
    """
    known: dict[tuple[str, Any], Table] = {(fit["name"], fit.number("value")): fit for fit in fits}
    # centres of mass, inertias, and what payloads change, besides what the rig counts as parameters
    bodies = [rig.mechanism] if isinstance(rig.mechanism, Slide) else rig.mechanism.joint
    vectors: dict[str, Value] = {
        f"{body.name}.{key}": getattr(body, key)
        for body in bodies
        for key in ("com", "inertia")
        if hasattr(body, key)
    }
    for load, links in rig.payload.items():
        for link, change in links.items():
            for key in ("mass", "com", "inertia"):
                if getattr(change, key) is not None:
                    vectors[f"payload {load}: {link}.{key}"] = getattr(change, key)
    every = [*rig.parameters().items(), *vectors.items()]
    groups = grouped(every, lambda item: item[0].rpartition(".")[0])
    rows = [
        [group, *_value_row(rig, name, value, known.get((name, value.value)))]
        for group, members in groups.items()
        for name, value in members
    ]
    notes = [f"{name}: {dynamics.note}" for name, dynamics in rig.dynamics.items() if dynamics.note]
    head = ["of", "parameter", "value", "unit", "how sure", "source"]
    return [*([Bullets(notes)] if notes else []), Grid(head, rows)]


def _value_row(rig: Rig, name: str, value: Value, fit: Table | None) -> list[Cell | str]:
    if isinstance(value.value, tuple):
        text: Cell | str = f"({', '.join(number(shown(rig, name, v), 5) for v in value.value)})"
    elif fit is not None:
        text = num(as_fitted(rig, name, fit))
    elif value.std:
        text = num(plus(rig, name, value.value, Z95 * value.std))
    else:
        text = num(number(shown(rig, name, value.value), 6))
    source = value.source.removeprefix(value.sure).lstrip(":, ")
    label = Cell(name.rsplit(".", 1)[-1], "code", hint=row_of(name).meaning)
    return [label, text, pretty(unit_of(rig, name)), value.sure, source]
