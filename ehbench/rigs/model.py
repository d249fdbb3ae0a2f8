"""The identified model behind the protocol of a real machine, with perfect sensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ehbench.compiled import kernel
from ehbench.errors import InputError, SimulationError
from ehbench.parts.cylinder import linkage_of
from ehbench.parts.nodes import SUPPLY, TANK, node_pressure
from ehbench.parts.sample import LINE, OF, entry, line_entry, sample_channels
from ehbench.plant.integrate import STEP, rk4
from ehbench.plant.model import Model

NAME = "model"


@kernel
def model_sample(y, plant, sample):
    """Write what perfect sensors say of state ``y`` into ``sample``."""
    cylinders = plant.cylinders.shape[0]
    for c in range(cylinders):
        row = plant.cylinders[c]
        q, rate = y[row.joint], y[plant.at.rates + row.joint]
        x, lever, _ = linkage_of(row, q)
        sample[entry(c, OF.q)] = q
        sample[entry(c, OF.qd)] = rate
        sample[entry(c, OF.x)] = x
        sample[entry(c, OF.v)] = lever * rate
        sample[entry(c, OF.p_head)] = node_pressure(y, plant, row.node_head)
        sample[entry(c, OF.p_rod)] = node_pressure(y, plant, row.node_rod)
    sample[line_entry(cylinders, LINE.p_supply)] = node_pressure(y, plant, SUPPLY)
    sample[line_entry(cylinders, LINE.p_tank)] = node_pressure(y, plant, TANK)


@kernel
def model_tick(y, command, plant, tick, steps, k, work, sample):
    """Let ``command`` [V] act for one ``tick`` [s] on state ``y``, in place, then write the sample
    at its end.

    ``k`` is a (5, states) scratch and ``work`` the workspace of the plant; ``steps`` integration
    steps a tick."""
    for _ in range(steps):
        rk4(y, command, plant, tick / steps, k, work)
    model_sample(y, plant, sample)


class ModelRig:
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
        self.channels = sample_channels(model.layout.cylinders)
        self.steps = max(1, round(1.0 / (self.rate * step)))
        self.state = np.zeros(model.layout.states)
        self._k = np.empty((5, model.layout.states))
        self._work = np.empty(model.plant.at.work)

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
