"""The linear model of an operating point once more, from central differences of the compiled plant:
what the equations of `ehbench.tune.linear` are held against, and what they leave out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ehbench.parts.cylinder import joint_of, linkage_of
from ehbench.parts.friction import friction_settle
from ehbench.physics.arm import mass_matrix, work_size
from ehbench.plant.derivatives import derivatives
from ehbench.plant.model import Model
from ehbench.tune.linear import LinearModel, part_states, states_of, with_delays
from ehbench.tune.operating_point import Aim, OperatingPoint, equivalent, operating_point, state_of
from ehbench.vocabulary.codes import FUNCTIONS

# steps of differences over states by what their names contain, of others 1e-4 V
STEPS = {".rate": 1e-2, ".p_line_": 30.0, "p_supply": 30.0, ".mount_deflection": 1e-8}
STEPS |= {".sway_speed": 1e-5, ".sway": 1e-6}


@dataclass(frozen=True)
class _Offsets:
    """The plant moved by offsets z of (x, v, p_head, p_rod, valves' states, commands)."""

    model: Model
    point: OperatingPoint
    held: bool
    y: np.ndarray
    command: np.ndarray

    @property
    def index(self) -> int:
        """The cylinder's number."""
        return self.model.layout.cylinders.index(self.point.cylinder)

    def mass(self, y: np.ndarray) -> np.ndarray:
        """Mass matrix at a state."""
        plant = self.model.plant
        n = plant.at.joints
        mass = np.empty((n, n))
        mass_matrix(plant.kind, plant.links, y[:n], mass, np.empty(work_size(n)))
        return mass

    def rates(self, z: np.ndarray, valves: Sequence[int], picks: Sequence[int]) -> np.ndarray:
        """Rates of (x, v, p_head, p_rod, states ``picks``)."""
        plant, point = self.model.plant, self.point
        row, at = plant.cylinders[self.index], plant.at
        joint, own = int(row.joint), int(at.rates + row.joint)
        y, u = self.y.copy(), self.command.copy()
        if z[0]:
            y[joint] = joint_of(row, point.x + z[0])
        _, lever, bend = linkage_of(row, y[joint])
        y[own] = (point.v + z[1]) / lever
        friction_settle(row, point.v + z[1], y)
        nodes: Any = plant.nodes
        ends = [nodes[node].state for node in (row.node_head, row.node_rod)]
        y[ends] += z[2:4]
        y[list(picks)] += z[4 : 4 + len(picks)]
        u[list(valves)] += z[4 + len(picks) :]
        dy = np.empty(at.states)
        derivatives(y, u, plant, dy, np.empty(at.work))
        acceleration = dy[own]
        if self.held:
            mass = self.mass(y)
            acceleration = mass[joint] @ dy[at.rates : at.rates + at.joints] / mass[joint, joint]
        moved = [point.v + z[1], lever * acceleration + bend * y[own] ** 2]
        return np.array([*moved, *dy[ends], *dy[list(picks)]])


def plant_model(
    model: Model,
    point: OperatingPoint,
    *,
    others: Literal["held", "free"] = "held",
    position: bool = False,
) -> LinearModel:
    """The same linear model from central differences of the compiled plant, its friction steady.

    With the other joints held their acceleration is zero, ``q̈_j = (D q̈)_j/D_jj`` with q̈ of the
    free plant; ``free`` leaves them to the reaction forces at this instant. ``position`` adds the
    stroke ``x`` as first state: what the development model leaves out."""
    valves, moving, names = states_of(model, point)
    names = (("x",) if position else ()) + names
    picks = [*part_states(model, point), *(k for block in moving.values() for k in block.states)]
    kinds = [model.layout.state_names[k] for k in picks]
    about = _Offsets(model, point, others == "held", *state_of(model, point))
    steps = np.concatenate(
        [
            [1e-5, 1e-5 * max(1.0, abs(point.v) / 0.01), 30.0, 30.0],
            [next((h for word, h in STEPS.items() if word in k), 1e-4) for k in kinds],
            [1e-4] * len(valves),
        ]
    )
    columns = []
    for k, h in enumerate(steps):
        z = np.zeros(steps.size)
        z[k] = h
        ahead, behind = about.rates(z, valves, picks), about.rates(-z, valves, picks)
        columns.append((ahead - behind) / (2 * h))
    table = np.array(columns).T
    first, size = (0 if position else 1), 4 + len(picks)
    e = np.zeros(size - first)
    e[1 - first] = 1.0 / point.mass
    if others == "free":
        joint = int(model.plant.cylinders[about.index].joint)
        mass = about.mass(about.y)
        e[1 - first] = point.lever**2 * np.linalg.inv(mass)[joint, joint]
    linear = LinearModel(names, valves, table[first:, first:size], table[first:, size:], e)
    return with_delays(linear, model)


def points(model, index, circuit, shares=(0.2, 0.8), strokes=(0.15, 0.5, 0.85)):
    """Every possible operating point of every working function."""
    here = equivalent(model, index, np.array(strokes) * model.plant.cylinders[index].stroke)
    for function in range(1, len(FUNCTIONS)):
        for at in range(len(strokes) if circuit.able[function] else 0):
            for share in shares:
                low = model.plant.supply.pressure / 20
                aim = Aim(low, low, share=share)
                point = operating_point(model, circuit, function, here, at, aim)
                if point.possible and point.v:
                    yield point


def steady_rates(model, point):
    """Rates of the states of a steady motion, each chamber's below 1e-6 of what shutting one of
    its two flows would give; a common opening is found to 1e-3 Pa."""
    plant, layout = model.plant, model.layout
    rate, index = np.empty(layout.states), layout.cylinders.index(point.cylinder)
    derivatives(*state_of(model, point), plant, rate, np.empty(plant.at.work))
    row = plant.cylinders[index]
    for key, area, volume in (
        ("p_head", row.area_head, point.volume_head),
        ("p_rod", row.area_rod, point.volume_rod),
    ):
        whole = row.bulk_modulus / volume * area * abs(point.v)
        assert abs(rate[layout.state(key, index)]) < 1e-6 * whole, point.name
    return rate
