"""Metering edges: how much oil passes from one node to another at a drop and an opening, a law a
file.

To add a law: write its file after ``orifice.py``, name it in LAWS and its keys in LawFields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from ehbench.compiled import choice, part_kernel, record
from ehbench.parts.edge import compensated, flow_control, measured, orifice, saturating
from ehbench.parts.edge.compensated import CompensatedFields
from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.orifice import OrificeFields
from ehbench.parts.edge.saturating import SaturatingFields

LAWS = (orifice.LAW, compensated.LAW, measured.LAW, saturating.LAW, flow_control.LAW)
BY_NAME = {law.name: number for number, law in enumerate(LAWS)}
ORIFICE, COMPENSATED, MAP = (BY_NAME[name] for name in ("orifice", "compensated", "map"))
if TYPE_CHECKING:
    LawName = str
else:
    LawName = Literal[tuple(BY_NAME)]


class LawFields(SaturatingFields, CompensatedFields, OrificeFields):
    """What the laws add to an edge of the rig file; the last one's keys come first in it."""


def edge_law(name: str) -> EdgeLaw:
    """The law of that name."""
    return LAWS[BY_NAME[name]]


# An edge. ``from_node, to_node`` it joins, flow positive from → to; the number of its ``valve``;
# ``sign`` ±1 of the commands that open it; ``law`` its number in LAWS; ``blocked`` 1 where nothing
# passes against its direction; then the columns of the laws: ``gain`` [m³/(s·V·√Pa)] of an orifice,
# [m³/(s·V)] of a compensated edge, ``deadband`` [V], ``compensation_drop`` [Pa], where the
# ``forward`` and the ``reverse`` map begin (−1: none), ``opening_max, saturation_softness`` [V].
EDGE = record(
    ("from_node", "i8"),
    ("to_node", "i8"),
    ("valve", "i8"),
    ("law", "i8"),
    ("blocked", "i8"),
    ("sign", "f8"),
    *dict.fromkeys(column for law in LAWS for column in law.columns),
)

_flow = choice("flow", [law.flow for law in LAWS], "drop, reach, edge, maps")
_opening = choice("opening", [law.opening for law in LAWS], "drop, flow, edge, maps")
_known = choice("known", [law.known for law in LAWS], "drop, edge, maps")


@part_kernel
def edge_flow(drop, opening, edge, maps):
    """Flow [m³/s] along an edge, positive from → to, at a pressure drop [Pa] of either sign and a
    valve opening [V].

    Args:
        edge: its row.
        maps: the plant's packed flow maps.
    """
    reach = edge.sign * opening
    if reach <= 0.0 or drop == 0.0:
        return 0.0
    if drop < 0.0 and edge.blocked == 1:
        return 0.0
    return _flow(edge.law, drop, reach, edge, maps)


@part_kernel
def edge_command(drop, flow, edge, maps):
    """Command [V] at which an edge passes ``flow`` [m³/s] at ``drop`` [Pa]: the exact inverse of
    ``edge_flow``.

    Flow and drop must have one sign; where they have not, or the edge is blocked, no opening gives
    that flow and the valve's closed command 0 is returned. The result is not limited to the
    driver's range by the analytic laws."""
    if flow * drop <= 0.0 or (drop < 0.0 and edge.blocked == 1):
        return 0.0
    return edge.sign * _opening(edge.law, drop, flow, edge, maps)


@part_kernel
def edge_known(drop, edge, maps):
    """Largest opening [V], counted in the direction that opens the edge, that its law speaks of at
    a drop [Pa]; inf for an analytic law.
    """
    return _known(edge.law, drop, edge, maps)
