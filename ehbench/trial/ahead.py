"""Open-loop trials on the model, simulated side by side before they run: each then finds what its
machine will do, to the bit, and has only to check it, log it and stop at a limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ehbench.machines.simulated import SimulatedMachine
from ehbench.plant.lanes.many import LEAST, Job, go_together, has_lanes, run_together
from ehbench.plant.lanes.steps import run_lanes
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary.errors import EhbenchError

MOST = 2.0e7  # numbers that the logs of one look may have


def can_foresee(trials: int) -> bool:
    """Whether so many trials are worth it, and the kernel for it is there."""
    return trials >= LEAST and has_lanes(run_lanes)


def foresee(trials: Sequence[Prepared]) -> None:
    """Let the machines of trials that may go side by side know what they will do; of at most LANES
    trials, those that go with the first that is open loop on the model in fixed steps.
    """
    results: list[tuple[SimulatedMachine, Job]] = []
    for trial in trials:
        machine = trial.machine
        if not isinstance(machine, SimulatedMachine) or not machine.looks_ahead:
            continue
        if trial.loop is not None or trial.payloads:
            continue
        try:
            machine.start(trial.posture, trial.low_side)
        except EhbenchError:
            continue  # the trial will say so
        table = np.concatenate([trial.table, trial.table[-1:]])
        job = Job(machine.model, machine.state.copy(), table)
        if not results or (
            _paces(machine) == _paces(results[0][0]) and go_together(results[0][1], job)
        ):
            results.append((machine, job))
    if len(results) < LEAST:
        return
    first, job = results[0]
    if len(results) * job.commands.shape[0] * first.truth.width > MOST:
        return
    logs = run_together([job for _, job in results], 1.0 / first.rate, first.steps)
    for (machine, _), log in zip(results, logs, strict=True):
        machine.foreseen = log


def _paces(machine: SimulatedMachine) -> tuple[float, int]:
    return machine.rate, machine.steps
