"""A hose or line between the valves of one end of a cylinder and its chamber: a volume of oil, and
what resists the flow from it into the chamber. The oil's inertia is left out."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from ehbench.parts.cylinder import chamber_slope
from ehbench.parts.edge.orifice import ORIFICE_DROP
from ehbench.parts.fault import Fault
from ehbench.parts.nodes import node_pressure
from ehbench.parts.oil import OIL_COLUMNS, bulk_of
from ehbench.physics.cylinder import chamber_rate
from ehbench.runtime.compiled import part_kernel, record
from ehbench.vocabulary.fields import FileModel, Q, Value


class Line(FileModel):
    """A hose or line at one end of a cylinder: the edges of that end join it, and what goes through
    ``resistance`` (laminar) and ``orifice_gain`` (turbulent), one behind the other, reaches the
    chamber. ``bulk_modulus`` of oil and hose together is the cylinder's where it has none."""

    end: Literal["head", "rod"] = Field(description="of the cylinder that it leads to")
    volume: Annotated[Value, Q("volume")]
    resistance: Annotated[Value, Q("resistance")] | None = None
    orifice_gain: Annotated[Value, Q("orifice_gain")] | None = Field(
        None, description="flow per root of drop, of what is turbulent in it"
    )
    bulk_modulus: Annotated[Value, Q("bulk_modulus")] | None = Field(
        None, description="effective, of the oil in this hose; by default the cylinder's"
    )

    @field_validator("volume", "resistance", "orifice_gain")
    @classmethod
    def _above_zero(cls, value: Value | None) -> Value | None:
        if value is not None and float(value) <= 0.0:
            raise ValueError("must be above 0")
        return value

    @model_validator(mode="after")
    def _resists(self) -> Line:
        if self.resistance is None and self.orifice_gain is None:
            raise ValueError("a line needs 'resistance', 'orifice_gain' or both")
        return self

    @property
    def name(self) -> str:
        """What its parameters, its rows of a ledger and its pressure are called by."""
        return f"line_{self.end}"


# A line. Its own ``node``, and that of the ``chamber`` which it leads to; the number of its
# ``cylinder``; ``volume`` [m³]; ``resistance`` [Pa·s/m³]; ``choke`` [Pa·s²/m⁶], 1/orifice_gain², 0
# for none; the OIL_COLUMNS of its oil; the pressures of a chamber's row that has no relief valve.
LINE = record(
    *(("node", "i8"), ("chamber", "i8"), ("cylinder", "i8")),
    *(("volume", "f8"), ("resistance", "f8"), ("choke", "f8")),
    *OIL_COLUMNS,
    *(("relief_pressure", "f8"), ("cavitation_pressure", "f8")),
)


@part_kernel
def line_conductance(drop, row):
    """Flow over drop [m³/(s·Pa)] of a line at a drop [Pa]; no slope of its flow is larger.

    ``Δp = R Q + Q²/k²`` solved for Q/Δp, with √(Δp² + δ²) for Δp in its root, so that without R it
    is the regularised orifice of `ehbench.parts.edge.orifice`."""
    wide = math.sqrt(drop * drop + ORIFICE_DROP * ORIFICE_DROP)
    return 2.0 / (row.resistance + math.sqrt(row.resistance**2 + 4.0 * row.choke * wide))


@part_kernel
def line_drop(y, plant, row):
    """Drop [Pa] from a line to its chamber at plant state y."""
    return node_pressure(y, plant, row.node) - node_pressure(y, plant, row.chamber)


@part_kernel
def line_flow(y, plant, row):
    """Flow [m³/s] from a line into its chamber."""
    drop = line_drop(y, plant, row)
    return drop * line_conductance(drop, row)


@part_kernel
def line_rates(y, plant, dy, work):
    """Pressure rates of the lines; what they bring to the chambers is added to ``work``.

    Returns the fastest rate [1/s]: what the valves and the line itself do to its little oil."""
    net, steep, fastest = plant.at.net, plant.at.slope, 0.0
    for i in range(plant.lines.shape[0]):
        row = plant.lines[i]
        drop, p = line_drop(y, plant, row), node_pressure(y, plant, row.node)
        slope, bulk = line_conductance(drop, row), bulk_of(row, p)
        work[net + row.chamber] += slope * drop
        work[steep + row.chamber] += slope
        inflow = work[net + row.node] - slope * drop
        rate = chamber_rate(inflow, p, row.volume, bulk, row.cavitation_pressure)
        dy[plant.nodes[row.node].state] = rate
        slope = chamber_slope(row, p, inflow, work[steep + row.node] + slope)
        fastest = max(fastest, bulk / row.volume * slope)
    return fastest


def drop_for(flow: float, row) -> float:
    """Drop [Pa] at which a line passes a flow [m³/s]: the inverse of its law."""
    if flow == 0.0:
        return 0.0
    drop = flow * row.resistance + flow * abs(flow) * row.choke
    for _ in range(200):  # flow/conductance(drop) rises less than half as fast as the drop
        result = flow / line_conductance(drop, row)
        if abs(result - drop) <= 1e-15 * abs(result):
            break
        drop = result
    return drop


FAULTS = (
    Fault("bulk modulus", ("bulk_modulus",), rank=4),
    Fault("volume", ("volume",), step=0.05, rank=5),
    Fault("line", ("resistance",), step=0.1, rank=5),
    Fault("line", ("orifice_gain",), step=0.05, rank=5),
)
