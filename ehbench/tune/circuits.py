"""What each working function does with the edges of a circuit, in plain values for reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ehbench.config.rig import Rig
from ehbench.control.functions import (
    CROSS,
    DIRECTION,
    METERED,
    METERING,
    OVERRUNNING,
    PATH_FLOWS,
    PATHS,
    Circuit,
    supply_draw,
)
from ehbench.vocabulary.codes import FUNCTIONS


@dataclass(frozen=True)
class EdgeUse:
    """An edge under a working function: ``way`` +1 where oil flows from its first node to its
    second, −1 back, 0 shut; ``meters`` where it sets the motion; ``shares`` of A1 |v| and A2 |v|
    that it then carries.
    """

    name: str
    ends: tuple[str, str]
    way: int
    meters: bool
    shares: tuple[int, int]


@dataclass(frozen=True)
class FunctionUse:
    """A working function on a circuit: ``direction`` of motion ±1, ``along`` where the load is,
    ``cross`` the path between the two ends that it uses or '', ``metered`` the chamber that sets
    the motion, ``draws`` oil from the supply for a way made [m²].
    """

    name: str
    direction: int
    along: bool
    cross: str
    metered: str
    draws: float
    edges: tuple[EdgeUse, ...]


def functions_of(rig: Rig, circuit: Circuit) -> tuple[FunctionUse, ...]:
    """The working functions that a cylinder's circuit can do, hold left out."""
    return tuple(_use(rig, circuit, f) for f in range(1, len(FUNCTIONS)) if circuit.able[f])


def _use(rig: Rig, circuit: Circuit, function: int) -> FunctionUse:
    paths = np.flatnonzero(PATH_FLOWS[function].any(axis=1)).tolist()
    by_edge = {int(circuit.paths[path]): path for path in paths}
    edges = []
    for at, (_, valve, edge) in enumerate(rig.edges()):
        if not circuit.first <= at < circuit.first + circuit.count:
            continue
        path = by_edge.get(at, -1)
        label = valve.title if valve.title and len(valve.edge) == 1 else valve.edge_name(edge)
        shares = (0, 0)
        if path >= 0:
            head, rod = (int(DIRECTION[function] * share) for share in PATH_FLOWS[function, path])
            shares = (head, rod)
        edges.append(
            EdgeUse(
                label,
                (edge.from_, edge.to),
                int(circuit.along[path]) if path >= 0 else 0,
                path == METERING[function],
                shares,
            )
        )
    cross = int(CROSS[function])
    return FunctionUse(
        FUNCTIONS[function],
        int(DIRECTION[function]),
        bool(OVERRUNNING[function]),
        PATHS[cross] if cross >= 0 else "",
        ("", "head", "rod")[METERED[function]],
        float(supply_draw(function, circuit)),
        tuple(edges),
    )
