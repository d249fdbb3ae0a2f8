"""What an adaptive law learnt of its flow maps in a trial, beside what its machine knows of
itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.machines.protocol import Machine, static_flow_of
from ehbench.parts.edge import edge_flows, edge_onset
from ehbench.trial.controllers import Design

USED = 0.05  # of the largest flow of an edge: what is more counts as use
OPENINGS = np.linspace(0.15, 1.0, 12)  # of the largest that was asked for, beyond the onset
SHIFTS = np.linspace(-1.0, 1.0, 401)  # [V] of deadband that are tried against the truth


class _Use(NamedTuple):
    """How an edge was used: ``commands`` [V] from near its onset up to the largest, and the median
    ``drop`` [Pa] along it.
    """

    commands: np.ndarray
    drop: float


def learnt_maps(design: Design, machine: Machine, record: Record, rows: int) -> dict[str, Any]:
    """Of each edge that passed oil the correction at the end, and where the machine can tell, the
    true one.

    ``gain`` [1] and ``shift`` of the deadband [V]; ``true_gain``, ``true_shift`` fit the machine's
    own flow at the openings that were used; ``error_before`` and ``error_after`` [1] are the
    largest errors of the map there, of its largest flow, without and with the correction."""
    results: dict[str, Any] = {}
    for number, edge in enumerate(design.edges):
        name = f"{edge}.map_gain"
        if name not in record:
            continue
        use = _use(design, number, record, rows)
        if use is None:
            continue
        gain, shift = (float(record[f"{edge}.map_{word}"][rows - 1]) for word in ("gain", "shift"))
        results[edge] = {"gain": gain, "shift": shift}
        flow = static_flow_of(machine)
        if flow is not None:
            true = np.asarray(flow(edge, use.commands, np.full(use.commands.size, use.drop)))
            results[edge] |= _against(design, number, use, true, (gain, shift))
    return results


def _use(design: Design, number: int, record: Record, rows: int) -> _Use | None:
    edge, row = design.edges[number], design.circuit.edges[design.circuit.first + number]
    flow = np.abs(record[f"{edge}.flow_desired"][:rows])
    used = flow > USED * flow.max(initial=0.0)
    command = row.sign * record[f"{design.valves[row.valve]}.command"][:rows]
    onset = abs(float(edge_onset(row, design.circuit.maps)))
    used &= command > onset
    if not used.any():
        return None
    own = design.cylinder
    nodes = {"supply": "p_supply", "tank": "p_tank"} | {
        end: f"{own}.p_{end}" for end in ("head", "rod")
    }
    item = design.rig.all_edges()[edge]
    pressures = [record[nodes[end]][:rows][used] for end in (item.from_, item.to)]
    drop = float(np.median(pressures[0] - pressures[1]))
    maximum = float(command[used].max())
    return None if drop == 0.0 else _Use(row.sign * (onset + OPENINGS * (maximum - onset)), drop)


def _against(
    design: Design, number: int, use: _Use, true: np.ndarray, learnt: tuple[float, float]
) -> dict[str, float]:
    row, maps = design.circuit.edges[design.circuit.first + number], design.circuit.maps

    def mapped(shift: float) -> np.ndarray:
        moved = use.commands - row.sign * shift
        flows = np.empty(moved.size)
        edge_flows(np.full(moved.size, use.drop), moved, row, maps, flows)
        return flows

    tried = []
    for shift in SHIFTS.tolist():
        flow = mapped(shift)
        gain = float(flow @ true) / max(float(flow @ flow), 1e-300)
        tried.append((float(np.sum((gain * flow - true) ** 2)), gain, shift))
    _, gain, shift = min(tried)
    largest = float(np.abs(true).max()) or 1.0
    before, after = mapped(0.0) - true, learnt[0] * mapped(learnt[1]) - true
    return {
        "true_gain": gain,
        "true_shift": shift,
        "error_before": float(np.abs(before).max()) / largest,
        "error_after": float(np.abs(after).max()) / largest,
    }
