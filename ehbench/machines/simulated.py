"""The identified model behind the protocol of a real machine, with perfect sensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ehbench.compiled import kernel
from ehbench.errors import InputError, SimulationError
from ehbench.physics.cylinder import linkage
from ehbench.plant import GEOMETRY, L_A, L_B, PHASE, RETRACTED, SIDE, Layout, workspace_size
from ehbench.simulation import STEP, Model, rk4

NAME = "model"


def sample_channels(names: Layout) -> tuple[str, ...]:
    """Channel names of a sample: ``q, qd, x, v, p_head, p_rod`` of each cylinder, then ``p_supply,
    p_tank``.
    """
    own = tuple(
        f"{name}.{key}"
        for name in names.cylinders
        for key in ("q", "qd", "x", "v", "p_head", "p_rod")
    )
    return (*own, "p_supply", "p_tank")


@kernel
def model_sample(y, plant, sample):
    """Write what perfect sensors say of state ``y`` into ``sample``, shape (6·cylinders + 2,)."""
    n, nc, nv = plant.links.shape[0], plant.cylinders.shape[0], plant.valves.shape[0]
    for c in range(nc):
        row, j = plant.cylinders[c], plant.joints[c]
        x, lever, _ = linkage(
            int(row[GEOMETRY]), row[L_A], row[L_B], row[SIDE], row[PHASE], row[RETRACTED], y[j]
        )
        sample[6 * c] = y[j]
        sample[6 * c + 1] = y[n + j]
        sample[6 * c + 2] = x
        sample[6 * c + 3] = lever * y[n + j]
        sample[6 * c + 4] = y[2 * n + 2 * c]
        sample[6 * c + 5] = y[2 * n + 2 * c + 1]
    sample[6 * nc] = y[2 * n + 2 * nc + 2 * nv]
    sample[6 * nc + 1] = plant.supply[1]


@kernel
def model_tick(y, command, plant, tick, steps, k, work, sample):
    """Let ``command`` [V] act for one ``tick`` [s] on state ``y``, in place, then write the sample
    at its end.

    ``k`` is a (5, states) scratch and ``work`` the workspace of the plant; ``steps`` integration
    steps a tick."""
    for _ in range(steps):
        rk4(y, command, plant, tick / steps, k, work)
    model_sample(y, plant, sample)


class SimulatedMachine:
    """A model as a rig: ``start`` puts it at rest in a posture, ``tick`` lets a command act;
    samples are exact.

    Args:
        model: with its payload and flow maps.
        rate: ticks a second [Hz].
        step: integration step [s].
    """

    name = NAME

    def __init__(self, model: Model, rate: float = 1000.0, step: float = STEP) -> None:
        self.model, self.layout, self.rate = model, model.layout, float(rate)
        self.channels = sample_channels(model.layout)
        self.steps = max(1, round(1.0 / (self.rate * step)))
        plant = model.plant
        self.state = np.zeros(model.layout.states)
        self._k = np.empty((5, model.layout.states))
        self._work = np.empty(
            workspace_size(plant.links.shape[0], plant.cylinders.shape[0], plant.edges.shape[0])
        )

    def start(
        self,
        posture: Mapping[str, str | float] | None = None,
        payload: str | None = None,
        low_side: float | None = None,
    ) -> np.ndarray:
        """Come to rest in a posture (as `Model.posture` reads it), valves at rest; returns the
        sample at t = 0.

        The unloaded chambers stand at ``low_side`` [Pa], as in `Model.trim`.

        Raises:
            InputError: a posture outside the stroke; a payload, which belongs to the model.
        """
        if payload is not None:
            raise InputError(
                "a model carries the payload it was made with",
                hint="make it with Model.of(rig, maps, payload)",
            )
        self.state = self.model.trim(self.model.posture(posture), low_side)
        sample = np.empty(len(self.channels))
        model_sample(self.state, self.model.plant, sample)
        return sample

    def tick(self, command: np.ndarray) -> np.ndarray:
        """Let ``command`` [V], shape (valves,), act for one tick; returns the sample at its end.

        Raises:
            SimulationError: the numbers left the finite range.
        """
        sample = np.empty(len(self.channels))
        held = np.asarray(command, dtype=float)
        model_tick(
            self.state,
            held,
            self.model.plant,
            1.0 / self.rate,
            self.steps,
            self._k,
            self._work,
            sample,
        )
        if not np.isfinite(self.state).all():
            raise SimulationError("the simulation left finite numbers", hint="take a smaller step")
        return sample
