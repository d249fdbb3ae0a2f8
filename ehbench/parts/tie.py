"""What is tied to a recording: rates of joints and of the supply's pressure."""

from __future__ import annotations

from ehbench.runtime.compiled import part_kernel


@part_kernel
def tie(command, plant, dy):
    """Put the given rates of joints [rad/s, rad/s²] and of the supply's pressure [Pa/s] into
    ``dy``."""
    for c in range(plant.cylinders.shape[0]):
        row = plant.cylinders[c]
        if row.tied_position >= 0:
            dy[row.joint] = command[row.tied_position]
        if row.tied_rate >= 0:
            dy[plant.at.rates + row.joint] = command[row.tied_rate]
    if plant.supply.tied >= 0:
        dy[plant.at.supply] = command[plant.supply.tied]
