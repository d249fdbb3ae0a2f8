"""A row of the fault table, as data. Files of parts declare ``FAULTS``; `ehbench.diagnosis.faults`
collects them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Amount(NamedTuple):
    """A number as ``factors`` of a ``scale`` of the machine, such as 0.3 of a cylinder's force; of
    several factors a search begins at each.

    ``unit`` is the SI unit in which a rig file has it; ``span`` says by which factors it may be
    smaller and larger than where a search begins, None for any."""

    factors: tuple[float, ...]
    scale: str
    unit: str = ""
    span: tuple[float, float] | None = None


@dataclass(frozen=True)
class Fault:
    """What may be wrong with a part, a law or a sensor.

    A fault of size δ moves numbers of its part, all by the same: by δ times themselves (``unit``
    ``share``), or by δ times a scale of the machine.

    Args:
        kind: its name, and that of its messages in ``messages/faults.toml``.
        keys: the numbers that it moves together.
        unit: what δ counts.
        step: δ of a difference; 0 where a slope says nothing.
        low, high: bounds of δ.
        trials: δ to try where a slope says little.
        rank: of two faults that explain alike the one of lower rank comes first.
        law: of the edge that it applies to, empty for any.
        start: from which a search begins at least.
        upper: where a search ends.
        table: a table or key of the rig file that the part does not have, and that the fault adds.
        adds: what is in that table.
        moved: which of the keys δ moves, all by default.
        neutral: what a number that it adds is where δ is 0.
        joined: whether several parts of a cylinder may have it together.
        costly: whether it is only tried where nothing else helps.
        wide: whether it concerns the logs of other cylinders too.
    """

    kind: str
    keys: tuple[str, ...] = ()
    unit: str = "share"
    step: float = 0.02
    low: float = -0.8
    high: float = 4.0
    trials: tuple[float, ...] = ()
    rank: int = 3
    law: str = ""
    start: Amount | None = None
    upper: Amount | None = None
    table: str = ""
    adds: Mapping[str, Amount | str | bool] = field(default_factory=dict)
    moved: tuple[str, ...] = ()
    neutral: Amount = Amount((0.0,), "unit")
    joined: bool = False
    costly: bool = False
    wide: bool = False
