"""What becomes of trials on a served bench when something fails: how far the true stroke went, what
stopped the trial, whether its log can be read. Same packets as over UDP, on a virtual clock.

python -m tools.studies.link_study 10000     (two cores: a quarter of an hour)"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from ehbench.config.recipe import Fault, TrialRecipe, load_rig
from ehbench.data import read_log
from ehbench.links.client import LinkMachine
from ehbench.links.layout import Layout
from ehbench.links.responder import STOPPED, Target
from ehbench.links.serve import LINK_FAULTS, ServedTarget
from ehbench.links.transport import VirtualClock, vector
from ehbench.runs.rundir import shipped
from ehbench.runtime.cores import cores
from ehbench.trial import Prepared, prepare, run

RIG = load_rig(shipped("recipes") / "rigs" / "slide_servo.toml")
SENSORS = ("press.x", "press.p_head", "press.p_rod")
OF_MACHINE = ("nan", "stuck", "zero", "offset", "stuck_open", "stuck_closed", "supply_lost")
KINDS = (*OF_MACHINE, *LINK_FAULTS, "controller_late")
MOTION = {
    "kind": "point_to_point",
    "cylinder": "press",
    "waypoints": ["160 mm", "190 mm"],
    "hold": "0.1 s",
    "speed": "100 mm/s",
    "acceleration": "1 m/s^2",
    "jerk": "20 m/s^3",
}
MARGIN = 0.02  # [m]
QUIET, NONE = ("", "following_error"), ("",)
POSITION = ("position_mismatch", "stroke_margin", "following_error", "")
PRESSURE = ("pressure_range", "following_error", "machine", "")
# what may stop a trial on which something fails, "" for nothing
REASONS: dict[str, tuple[str, ...]] = {
    "nan": ("finite",),
    "supply_lost": QUIET,
    "stuck_closed": QUIET,
    "stuck_open": ("following_error", "stroke_margin", "machine", "speed_max"),
    "link_lost": ("sample_age",),
    "link_delayed": ("sample_age", ""),
    "link_reordered": NONE,
    "controller_late": QUIET,
}


class Outcome(NamedTuple):
    """What became of a trial: the ``limit`` that stopped it, the ``lowest`` and ``highest`` true
    stroke [m], whether the target is at ``rest`` and the log ``whole``."""

    fault: Fault
    limit: str
    lowest: float
    highest: float
    rest: bool
    whole: bool

    @property
    def right(self) -> bool:
        """Whether what stopped it fits the fault."""
        position = self.fault.target.endswith(".x")
        return self.limit in REASONS.get(self.fault.kind, POSITION if position else PRESSURE)

    @property
    def safe(self) -> bool:
        """Whether it went no farther than the motion and its margin; no command closes a valve that
        is stuck open."""
        near = 0.16 - MARGIN < self.lowest and self.highest < 0.19 + MARGIN
        return (near or self.fault.kind == "stuck_open") and self.rest and self.whole


def drawn(seed: int) -> Fault:
    """A fault at a drawn time, of a drawn kind and target."""
    draw = np.random.default_rng(seed)
    kind = str(draw.choice(KINDS))
    keys = {"kind": kind, "start": f"{draw.uniform(0.05, 0.45)!r} s"}
    if kind in ("nan", "stuck", "zero", "offset"):
        keys["target"] = str(draw.choice(SENSORS))
    if kind == "offset":
        keys["value"] = "-40 mm" if keys["target"] == "press.x" else "30 bar"
    if kind.startswith("stuck_"):
        keys["target"] = "press.servo"
    if kind in ("link_delayed", "controller_late"):
        keys["duration"] = f"{draw.choice([5, 20, 100])} ms"
    return Fault.model_validate(keys)


def trial(on: str = "bench", **keys) -> Prepared:
    """A short trial of the slide at 250 Hz."""
    given: dict[str, Any] = {"rate": "250 Hz", "motion": MOTION, "controller": {"kind": "position"}}
    given |= {"limits": {"stroke_margin": f"{MARGIN!r} m"}, **keys}
    path = shipped("recipes") / "trials" / "position.toml"
    return prepare(TrialRecipe(stage="trial", rig="x", on=on, path=path, **given), RIG)


class VirtualLink:
    """A target in this process, whose time the host's vectors drive: the same datagrams, as fast
    as they can be computed."""

    virtual = True

    def __init__(self, target: Target) -> None:
        self.target, self._clock, self._waiting = target, VirtualClock(target), b""

    def encode(self, numbers: np.ndarray) -> bytes:
        """As `Link.encode`."""
        return numbers.astype("<f8").tobytes()

    def send(self, numbers: np.ndarray) -> None:
        """As `Link.send`."""
        self._waiting = self._clock.answer(self.encode(numbers))

    def receive(self, timeout: float) -> list[np.ndarray]:
        """As `Link.receive`, at once."""
        taken, self._waiting = self._waiting, b""
        return [vector(taken)] if taken else []

    def close(self) -> None:
        """As `Link.close`."""


def outcome(base: Prepared, fault: Fault, seed: int, log: Path) -> Outcome:
    """Run a trial on a served bench on which something fails."""
    of_link = fault.kind in LINK_FAULTS
    served = trial("bench", fault=() if of_link else (fault,), seed=seed)
    item = ServedTarget(served, (fault,) if of_link else ())
    strokes, tick, row = [], item.machine.tick, np.empty(1)

    def seen(commands: list[float]) -> list[float]:
        values = tick(commands)
        served.machine.hidden.read(np.array(commands), row)  # type: ignore[attr-defined]
        strokes.append(float(row[0]))
        return values

    item.machine.tick = seen
    machine = LinkMachine(base, Layout.of(RIG), VirtualLink(item), "stream", "virtual")
    result = run(base, machine, log=log, fast=False)
    for _ in range(100):  # its watchdog and ramp
        item.tick(item.sequence / item.rate)
    whole = len(read_log(log)) == result.record.t.size
    log.unlink()
    stop, rest = result.facts.stop, item.applied == [0.0] and item.state == STOPPED
    return Outcome(fault, stop.limit if stop else "", min(strokes), max(strokes), rest, whole)


@cache
def base() -> Prepared:
    """The trial as its host prepares it, once a process."""
    return trial("model")


def outcome_of(seed: int, folder: str) -> Outcome:
    """The outcome of the trial of a seed, its log in a folder until it is read."""
    return outcome(base(), drawn(seed), seed, Path(folder) / f"{seed}.mcap")


def main(arguments: Sequence[str] = ()) -> None:
    """Run so many trials, a thousand by default, and print what stopped them."""
    count, table, wrong = int(arguments[0]) if arguments else 1000, Counter(), []
    memory = Path("/dev/shm")  # no disk for what is read once
    with (
        TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder,
        ProcessPoolExecutor(cores(), get_context("spawn")) as pool,
    ):
        run_one = partial(outcome_of, folder=folder)
        for seed, item in enumerate(pool.map(run_one, range(count), chunksize=20)):
            table[item.fault.kind, item.limit or "went on"] += 1
            wrong += [] if item.safe and item.right else [(seed, item)]
    for (kind, limit), number in sorted(table.items()):
        print(f"| {kind} | {limit} | {number} |")
    print(f"{count} trials; beyond the margin, without a log or stopped for another reason:")
    print(*([f"{seed} {item}" for seed, item in wrong] or ["none"]), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
