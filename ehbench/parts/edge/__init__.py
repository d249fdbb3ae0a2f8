"""Metering edges: how much oil passes from one node to another at a drop and an opening, a law a
file.

To add a law: write its file after ``orifice.py``, name it in LAWS and its keys in LawFields."""

from typing import TYPE_CHECKING, Literal

from ehbench.parts.edge import check, compensated, flow_control, measured, orifice, pump, saturating
from ehbench.parts.edge.check import CheckFields
from ehbench.parts.edge.compensated import CompensatedFields
from ehbench.parts.edge.law import EdgeLaw
from ehbench.parts.edge.measured import leaks
from ehbench.parts.edge.orifice import OrificeFields
from ehbench.parts.edge.preload import FAULTS as PRELOAD
from ehbench.parts.edge.preload import metered, preload
from ehbench.parts.edge.pump import FixedPumpFields, PumpFields
from ehbench.parts.edge.saturating import SaturatingFields
from ehbench.parts.fault import Amount, Fault
from ehbench.parts.nodes import node_pressure
from ehbench.runtime.compiled import choice, kernel, part_kernel, record

_FILES = (orifice, compensated, measured, saturating, flow_control, pump, check)
LAWS = tuple(file.LAW for file in _FILES)
FAULTS = (
    *(row for file in _FILES for row in file.FAULTS),
    Fault(
        "deadband",
        ("deadband",),
        unit="command",
        step=0.01,
        high=0.4,
        start=Amount((0.01,), "reach"),
        upper=Amount((0.5,), "reach"),
        joined=True,
    ),
    Fault("underlap", ("underlap",), unit="command", step=0.01, high=0.4, joined=True),
    *PRELOAD,
)
BY_NAME = {law.name: number for number, law in enumerate(LAWS)}
MAP, PUMP, CHECK = (BY_NAME[name] for name in ("map", "pump", "check"))
if TYPE_CHECKING:
    LawName = FixedLawName = str
else:
    LawName = Literal[tuple(law.name for law in LAWS if law.commanded)]
    FixedLawName = Literal[tuple(law.name for law in LAWS if not law.metering)]


class LawFields(PumpFields, SaturatingFields, CompensatedFields, OrificeFields):
    """What the laws add to an edge of the rig file; the last one's keys come first in it."""


class FixedLawFields(FixedPumpFields, CheckFields):
    """What the laws add to an edge without a command; the last one's keys come first in it."""


def edge_law(name: str) -> EdgeLaw:
    """The law of that name."""
    return LAWS[BY_NAME[name]]


# An edge. ``from_node, to_node`` it joins, flow positive from → to; the number of its ``valve``, −1
# where it has no command; ``sign`` ±1 of the commands that open it; ``law`` its number in LAWS;
# ``blocked`` 1 where nothing passes against its direction; ``unmetered`` 1 where no command has to
# open it; then the columns of the laws: ``gain`` [m³/(s·V·√Pa)] of an orifice,
# [m³/(s·V)] of a compensated edge, ``deadband`` [V], negative of an underlap,
# ``compensation_drop`` [Pa], where the ``forward`` and the ``reverse`` map begin (−1: none),
# ``opening_max, saturation_softness`` [V];
# of a pump ``displacement`` [m³/rad], ``speed_gain`` [rad/(s·V)], ``pump_speed`` [rad/s], ``slip``
# [m³/(s·Pa)]; of a check valve ``gain`` [m³/(s·√Pa)], ``cracking_pressure, opening_range`` [Pa],
# its ``pilot`` node (−1: none) and ``pilot_ratio``; ``cracking_pressure`` [Pa] also of what is held
# shut by a spring in series with a metering edge.
EDGE = record(
    *((name, "i8") for name in ("from_node", "to_node", "valve", "law", "blocked", "unmetered")),
    ("sign", "f8"),
    *dict.fromkeys(column for law in LAWS for column in law.columns),
)

_flow = choice("flow", [law.flow for law in LAWS], "drop, reach, edge, maps")
_opening = choice("opening", [law.opening for law in LAWS], "drop, flow, edge, maps")
_known = choice("known", [law.known for law in LAWS], "drop, edge, maps")
_slope = choice("slope", [law.slope for law in LAWS], "drop, flow, reach, edge")


@part_kernel
def edge_flow(drop, opening, edge, maps):
    """Flow [m³/s] along an edge, positive from → to, at a pressure drop [Pa] of either sign and a
    valve opening [V]; on the other side of rest, what its map has of a leak, or its underlap.

    Args:
        edge: its row.
        maps: the plant's packed flow maps.
    """
    reach = edge.sign * opening
    drop = metered(drop, edge)
    if edge.unmetered == 0:
        if drop == 0.0 or (drop < 0.0 and edge.blocked == 1):
            return 0.0
        if reach <= 0.0 and not edge_leaks(edge, maps):
            return 0.0
    return _flow(edge.law, drop, reach, edge, maps)


@kernel
def edge_flows(drops, openings, edge, maps, flows):
    """Write `edge_flow` at each of some drops [Pa] and openings [V] into ``flows`` [m³/s]."""
    for i in range(drops.shape[0]):
        flows[i] = edge_flow(drops[i], openings[i], edge, maps)


@part_kernel
def edge_leaks(edge, maps):
    """Whether an edge passes oil when its valve is at rest: by its map's leak, or an underlap."""
    return edge.deadband < 0.0 or (edge.law == MAP and leaks(edge, maps))


@part_kernel
def edge_command(drop, flow, edge, maps):
    """Command [V] at which an edge passes ``flow`` [m³/s] at ``drop`` [Pa]: the exact inverse of
    ``edge_flow``.

    Flow and drop must have one sign, but for a pump; where they have not, or the edge is blocked,
    no opening gives that flow and the valve's closed command 0 is returned; so it is where an
    underlap passes more. The result is not limited to the driver's range by the analytic laws."""
    drop = metered(drop, edge)
    if edge.unmetered == 0 and (flow * drop <= 0.0 or (drop < 0.0 and edge.blocked == 1)):
        return 0.0
    return edge.sign * _opening(edge.law, drop, flow, edge, maps)


@kernel
def edge_onset(edge, maps):
    """Command [V] at which an edge begins to pass oil, 1 MPa beyond what cracks it."""
    return edge_command(1.0e6 + preload(edge), 1.0e-12, edge, maps)


@part_kernel
def edge_known(drop, edge, maps):
    """Largest opening [V] that an edge's law knows at a drop [Pa]; inf for an analytic law."""
    return _known(edge.law, metered(drop, edge), edge, maps)


@part_kernel
def edge_slope(drop, flow, opening, edge):
    """Bound of the slope of a flow [m³/s] other than zero over either pressure [m³/(s·Pa)]."""
    return _slope(edge.law, metered(drop, edge), flow, edge.sign * opening, edge)


@part_kernel
def edge_opening(y, plant, edge, openings):
    """What opens an edge: its valve's opening [V], or its pilot's pressure above the upstream node
    [Pa]."""
    if edge.valve >= 0:
        return openings[edge.valve]
    if edge.pilot < 0:
        return 0.0
    from_pressure = node_pressure(y, plant, edge.from_node)
    return max(node_pressure(y, plant, edge.pilot) - from_pressure, 0.0)
