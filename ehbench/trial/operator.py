"""Motions that a person commands while the trial runs: the speed of each cylinder by a lever."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ehbench.control.trajectory import ORDERS, A, V, X
from ehbench.data.record import Record
from ehbench.trial.lever import LEVER_CHANNELS, Lever
from ehbench.vocabulary import InputError, message

if TYPE_CHECKING:
    from ehbench.machines.rows import Checks
    from ehbench.trial.controllers import Compiled
    from ehbench.trial.preparation import Prepared
    from ehbench.trial.user_code import UserCode


class OperatorInput(Protocol):
    """Who says where the levers are: a joystick, a page, a test."""

    def read(self) -> Sequence[float] | None:
        """Deflections from −1 to 1, extension positive, in the order of the motions; None while
        the dead-man switch is open or nobody is there."""
        ...


class Operator:
    """Who moves the cylinders of a running trial, in whose references the motion is written row by
    row; ``parts`` are its controllers, in the order of the cylinders, ``checks`` those of its rows.
    """

    def __init__(
        self,
        source: OperatorInput,
        prepared: Prepared,
        parts: Sequence[Compiled | UserCode],
        checks: Checks,
    ) -> None:
        assert prepared.loop is not None and prepared.recipe.motion is not None  # it has levers
        self._source, self._checks, self._moved = source, checks, False
        self._ends = prepared.recipe.motion.release == "end"
        pairs = zip(prepared.loop.driven, parts, strict=True)
        levers = levers_of(prepared)
        self._levers = [
            (item, levers[item.cylinder], part) for item, part in pairs if item.cylinder in levers
        ]

    def write(self, row: int) -> bool:
        """Write what the levers say into a row of the references; whether the trial ends with it,
        all cylinders at rest after the dead-man switch was let go."""
        given, still = self._source.read(), True
        if given is not None and not all(map(math.isfinite, given)):
            given = None
        for number, (item, lever, part) in enumerate(self._levers):
            motion = item.references
            deflection = 0.0 if given is None else min(max(given[number], -1.0), 1.0)
            motion.inputs[row] = deflection, float(given is not None)
            if row > 0:
                x, v = motion.table[row - 1, : V + 1].tolist()
                motion.table[row, : A + 1] = lever.follow(x, v, deflection)
            part.references[row, :ORDERS] = motion.table[row]
            part.references[row, ORDERS:] = motion.table[row, V]  # speeds to come: the present one
            desired = self._checks.desired[row]
            if math.isfinite(desired[item.design.index]):
                desired[item.design.index] = motion.table[row, X]
            still &= motion.table[row, V] == 0.0
        self._moved |= given is not None
        return self._ends and self._moved and given is None and bool(still)


class Replayed:
    """Who holds the levers as a list says, an item for each `read`; after the last, the dead-man
    switch is let go."""

    def __init__(self, given: Iterable[Sequence[float] | None]) -> None:
        self._given = iter(given)

    def read(self) -> Sequence[float] | None:
        """As `OperatorInput.read`."""
        return next(self._given, None)


def both_ends(levers: Sequence[Lever]) -> list[list[float]]:
    """Full deflections, one lever after the other, each until its cylinder has gone to both ends:
    what a dry run does in place of the operator."""
    ticks = [
        round(((i.high - i.low) / i.speed + i.speed / i.acceleration) / i.tick) for i in levers
    ]
    each = np.repeat(np.arange(len(ticks)), 2 * np.array(ticks))
    way = np.concatenate([np.repeat([1.0, -1.0], count) for count in ticks])
    return np.where(each[:, None] == np.arange(len(ticks)), way[:, None], 0.0).tolist()


def logged(record: Record, cylinders: Iterable[str]) -> list[list[float] | None]:
    """What an operator gave in a log, for `Replayed`."""
    tables = [
        np.column_stack([record[f"{c}.{name}"] for c in cylinders]) for name in LEVER_CHANNELS
    ]
    rows = zip(*(table.tolist() for table in tables), strict=True)
    return [levers if all(held) else None for levers, held in rows]


def levers_of(prepared: Prepared) -> dict[str, Lever]:
    """The levers that an operator holds, by cylinder, in the order of the motions; those whose log
    is played are not among them."""
    levers = {}
    for item in () if prepared.loop is None else prepared.loop.driven:
        motion = item.recipe.motion
        if item.references.lever is not None and motion is not None and motion.file is None:
            levers[item.cylinder] = item.references.lever
    return levers


def refuse_unmanned(prepared: Prepared, source: OperatorInput | None) -> None:
    """Refuse a trial whose levers nobody holds.

    Raises:
        InputError: it has levers and no ``source``."""
    if source is None and levers_of(prepared):
        raise InputError(message("trial.unmanned"), **prepared.recipe.at("motion", "kind"))
