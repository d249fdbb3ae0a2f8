"""States that are tied to a recording: their rates are given, not found."""

from __future__ import annotations

from ehbench.compiled import part_kernel, record

# A tied ``state``, and where among the commands its rate [unit/s] stands.
TIE = record(("state", "i8"), ("command", "i8"))


@part_kernel
def tie(command, plant, dy):
    """Put the given rates of tied states into ``dy``."""
    for i in range(plant.ties.shape[0]):
        row = plant.ties[i]
        dy[row.state] = command[row.command]
