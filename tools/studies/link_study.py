"""What becomes of trials on a served bench when something fails: how far the true stroke went, what
stopped the trial, whether its log can be read. Same packets as over UDP, on a virtual clock.

python -m tools.studies.link_study 10000
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ehbench.config.recipe import Fault, TrialRecipe, load_rig
from ehbench.data import read_log
from ehbench.links.client import LinkMachine
from ehbench.links.layout import Layout
from ehbench.links.responder import STOPPED
from ehbench.links.serve import LINK_FAULTS, ServedTarget
from ehbench.links.transport import VirtualLink
from ehbench.runs.rundir import shipped
from ehbench.trial import Prepared, prepare, run

RIG = load_rig(shipped("recipes") / "rigs" / "slide_servo.toml")
SENSORS = ("press.x", "press.p_head", "press.p_rod")
OF_MACHINE = ("nan", "stuck", "zero", "offset", "stuck_open", "stuck_closed", "supply_lost")
KINDS = (*OF_MACHINE, *LINK_FAULTS, "controller_late")
MOTION = {
    "kind": "point_to_point",
    "cylinder": "press",
    "waypoints": ["160 mm", "190 mm"],
    "speed": "100 mm/s",
    "acceleration": "1 m/s^2",
    "jerk": "20 m/s^3",
}
MARGIN = 0.02  # [m]


class Outcome(NamedTuple):
    """What became of a trial: the ``limit`` that stopped it, the ``lowest`` and ``highest`` true
    stroke [m], whether the target is at ``rest`` and the log ``whole``.
    """

    fault: Fault
    limit: str
    lowest: float
    highest: float
    rest: bool
    whole: bool

    @property
    def safe(self) -> bool:
        """Whether it went no farther than the motion and its margin; no command closes a valve that
        is stuck open.
        """
        near = 0.16 - MARGIN < self.lowest and self.highest < 0.19 + MARGIN
        return (near or self.fault.kind == "stuck_open") and self.rest and self.whole


def drawn(seed: int) -> Fault:
    """A fault at a drawn time, of a drawn kind and target."""
    draw = np.random.default_rng(seed)
    kind = str(draw.choice(KINDS))
    keys = {"kind": kind, "start": f"{draw.uniform(0.1, 0.7)!r} s"}
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
    given = {"rate": "250 Hz", "motion": MOTION, "controller": {"kind": "position"}}
    given |= {"limits": {"stroke_margin": f"{MARGIN!r} m"}, **keys}
    path = shipped("recipes") / "trials" / "position.toml"
    return prepare(TrialRecipe(stage="trial", rig="x", on=on, path=path, **given), RIG)


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


def main(arguments: Sequence[str] = ()) -> None:
    """Run so many trials, a thousand by default, and print what stopped them."""
    count, base, table = int(arguments[0]) if arguments else 1000, trial("model"), Counter()
    unsafe = []
    with TemporaryDirectory() as folder:
        for seed in range(count):
            item = outcome(base, drawn(seed), seed, Path(folder) / "log.mcap")
            table[item.fault.kind, item.limit or "went on"] += 1
            unsafe += [] if item.safe else [(seed, item)]
    for (kind, limit), number in sorted(table.items()):
        print(f"{kind:16} {limit:18} {number:6}")
    print(f"{count} trials, {len(unsafe)} of them beyond the margin or without a log")
    for seed, item in unsafe:
        print(seed, item)


if __name__ == "__main__":
    main(sys.argv[1:])
