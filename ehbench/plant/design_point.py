"""What a controller is designed for, made from a model of the rig without payload."""

import math
from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Cylinder, Rig
from ehbench.control.axis import Mechanism, axis_of, inertias
from ehbench.control.functions import Circuit, circuit
from ehbench.control.law import DesignPoint
from ehbench.parts.cylinder import linkage_arrays
from ehbench.parts.nodes import SUPPLY
from ehbench.parts.valve import valve_lag
from ehbench.physics.arm import work_size
from ehbench.plant.build import Maps, map_of
from ehbench.plant.model import Model


def circuit_of(
    model: Model, cylinder: int, maps: Maps | None = None, unused: Sequence[int] = ()
) -> Circuit:
    """The `Circuit` of a cylinder, from a model and the measured maps it was built on, without the
    edges of valves that are ``unused``, by their numbers.

    Raises:
        InputError: no edge is left at the cylinder."""
    plant, edges = model.plant, model.plant.edges_at_chambers
    off = np.isin(edges.valve, unused)
    edges.from_node[off] = edges.to_node[off] = SUPPLY  # which is on no path
    measured, row = [map_of(maps, name) for name in model.layout.edges], plant.cylinders[cylinder]
    reach = np.column_stack([plant.valves.lowest, plant.valves.highest])
    areas = row.area_head, row.area_rod
    return circuit(cylinder, *areas, edges, plant.maps, reach, measured, plant.supply)


def design_point_of(
    model: Model, circuit: Circuit, q: np.ndarray, tick: float, still: Sequence[int] = ()
) -> DesignPoint:
    """The `DesignPoint` of one cylinder.

    Args:
        model: without payload.
        circuit: the cylinder's.
        q: posture in which gains are scaled [rad or m], shape (joints,).
        tick: between samples [s].
        still: numbers of valves that the controller shall not use."""
    plant, row = model.plant, model.plant.cylinders[circuit.cylinder]
    mechanism = Mechanism(plant.kind, plant.gravity, plant.links, plant.cylinders.joint, q)
    axis = axis_of(circuit, mechanism, row, plant.forces)
    numbers = range(circuit.first, circuit.first + circuit.count)
    shut = np.isin(plant.edges.valve[numbers.start : numbers.stop], still)
    axis = axis._replace(onset=np.where(shut, 0.0, axis.onset))  # they stay shut
    limit = float(plant.supply.flow_limit)
    if not math.isfinite(limit):
        limit = 0.5 * circuit.area_head  # half a metre a second
    used = {int(circuit.edges[e].valve) for e in numbers if e in circuit.paths}
    lag = max((valve_lag(plant.valves[i], plant) for i in used), default=0.0)
    unmodelled = unmodelled_of(model.rig, model.rig.cylinder[circuit.cylinder])
    x = float(linkage_arrays(row, q[int(row.joint) : int(row.joint) + 1])[0][0])
    # masses at the end of the last link with the inertia that the payloads add about the joint
    room, masses = np.zeros(work_size(len(plant.links)) + len(plant.links)), [0.0]
    bare, tip = inertias(axis, q, room)
    for name in model.rig.payload:
        loaded = axis._replace(mechanism=mechanism._replace(links=model.links(name)))
        masses.append(float((inertias(loaded, q, room)[0] - bare) / tip))
    return DesignPoint(
        axis, tick, float(plant.supply.pressure), limit, lag, x, unmodelled, max(masses)
    )


def unmodelled_of(rig: Rig, cylinder: Cylinder) -> tuple[str, ...]:
    """Tables and keys of a rig file that an axis with a cylinder has nothing of."""
    air = ("air_fraction of [oil]",) if rig.oil.air_fraction is not None else ()
    return (*cylinder.unmodelled, *air)
