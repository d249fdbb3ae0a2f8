"""The child process in which the binary of an FMU runs: ``python -m ehbench.runtime.fmu_child``.

It takes frames from standard input and answers on standard output: `HEAD`, then float64."""

import json
import math
import os
import resource
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.runtime.confined import Bounds, confine
from ehbench.runtime.landlock import restrict, system_paths

# START or STEP, rows, tick [s]; of an answer: DONE or FAILED, bytes, nothing
HEAD = struct.Struct("<qqd")
START, STEP = 0, 1
DONE, FAILED = 0, 1


class Instance:
    """One FMU at work, by value references: what it takes at its start, commands, channels."""

    def __init__(self, folder: Path, references: dict[str, list[int]]) -> None:
        from fmpy import read_model_description

        self.folder = str(folder)
        self.description = read_model_description(self.folder, validate=False)
        self.references = references
        self.third = str(self.description.fmiVersion).startswith("3")
        self.fmu: Any = None
        self.time, self.count = 0.0, 0

    def put(self, which: str, values: np.ndarray) -> None:
        """Set variables."""
        names = self.references[which]
        if names:
            (self.fmu.setFloat64 if self.third else self.fmu.setReal)(names, list(values))

    def get(self) -> list[float]:
        """The channels."""
        names = self.references["channels"]
        return list((self.fmu.getFloat64 if self.third else self.fmu.getReal)(names))

    def start(self, values: np.ndarray) -> list[float]:
        """A new instance at t = 0, of the values of its start and then the commands."""
        from fmpy import instantiate_fmu

        if self.fmu is not None:
            self.fmu.terminate()
            self.fmu.freeInstance()
            self.fmu = None
        self.fmu = instantiate_fmu(
            self.folder, self.description, "CoSimulation", require_functions=False
        )
        if not self.third:
            self.fmu.setupExperiment(startTime=0.0)
        first = len(self.references["start"])
        self.put("start", values[:first])
        self.fmu.enterInitializationMode()
        self.put("commands", values[first:])
        self.fmu.exitInitializationMode()
        self.count = 0
        return self.get()

    def steps(self, table: np.ndarray, tick: float) -> list[list[float]]:
        """The channels after each of some commands has acted for a tick [s]."""
        rows = []
        for command in table:
            self.put("commands", command)
            done = self.fmu.doStep(self.count * tick, tick)
            if done and any(done[1:3]):  # of FMI 3: it ends, or has done a part of the step
                end = "terminateSimulation" if done[1] else "earlyReturn"
                raise RuntimeError(f"fmi3DoStep: {end} at {done[3]:g} s")
            self.count += 1
            rows.append(self.get())
            if not all(map(math.isfinite, rows[-1])):
                break
        return rows


def main() -> None:
    """Serve until nobody asks any more."""
    folder, given = Path(sys.argv[1]), json.loads(sys.argv[2])
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    instance = Instance(folder, given["references"])
    work = folder.parent / "work"
    os.chdir(work)
    confine(Bounds(given["memory"], given["seconds"], given["seconds"]))
    restrict([*system_paths(), folder], work)
    while head := requests.read(HEAD.size):
        kind, rows, tick = HEAD.unpack(head)
        width = len(instance.references["commands"])
        width += len(instance.references["start"]) if kind == START else 0
        table = np.frombuffer(requests.read(8 * rows * width)).reshape(rows, width)
        # each answer has so much time of its own
        spent = resource.getrusage(resource.RUSAGE_SELF)
        limit = int(spent.ru_utime + spent.ru_stime + given["seconds"]) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        try:
            result = instance.start(table[0]) if kind == START else instance.steps(table, tick)
            status, body = DONE, np.array(result, dtype=float).tobytes()
        except Exception as error:  # whatever an FMU reports
            status, body = FAILED, str(error)[:500].encode()
        answers.write(HEAD.pack(status, len(body), 0.0) + body)
        answers.flush()


if __name__ == "__main__":
    main()
