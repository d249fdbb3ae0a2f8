"""How often the residual questions name a built fault, and how often they cry at a sound model.

python -m tools.studies.structure_study faults
python -m tools.studies.structure_study sound 40      # seeds a rig, 200 logs in all"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis import Case, Structure, ask
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.observations import commanded
from tests.shared import RIGS
from tools.virtual_logs import DRIVES, commands_of, noisy

KINDS = ("steps", "chirp")
LONG = 4.0  # [s] of each log
# a delay and a lag, a leakage and what else creeps, are told together; either leads to the other
# an overlap of a spool is a dead band of each of its edges
ALSO = {"delay": {"lag"}, "lag": {"delay"}, "deadband": {"overlap"}}
Change = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Fault(NamedTuple):
    """One fault of a machine: its kind, the machine's rig, what its valve gets of a command, and
    what its sensors make of a log."""

    kind: str
    words: str
    machine: Rig
    command: Change = lambda u, t: u
    sensors: Callable[[Record], Record] = lambda log: log

    def named(self, result: Structure) -> bool:
        """Whether it is the first or the second that is told."""
        return bool(
            {finding.kind for finding in result.findings[:2]}
            & {self.kind, *ALSO.get(self.kind, ())}
        )


def log_of(name: str, fault: Fault, kind: str, seed: int, seconds: float = LONG) -> Record:
    """A log that a faulty machine records."""
    t = np.arange(round(seconds * 1000.0) + 1) * 1e-3
    given = commands_of(name, kind, t, 0.8)
    got = {valve: fault.command(u, t) for valve, u in given.items()}
    built = simulate(fault.machine, got, seconds, posture=DRIVES[name][2])
    told = {f"{valve}.command": u for valve, u in given.items()}
    return fault.sensors(noisy(replace(built, channels=built.channels | told), seed))


def asked(
    name: str,
    rig: Rig,
    fault: Fault,
    seed: int,
    kinds: tuple[str, ...] = KINDS,
    seconds: float = LONG,
) -> Structure:
    """What the residuals say of a rig's model on logs of a faulty machine."""
    model = Model.of(rig)
    logs = [log_of(name, fault, kind, seed + i, seconds) for i, kind in enumerate(kinds)]
    return ask([Case(f"log{i}", log, model, commanded(model, log)) for i, log in enumerate(logs)])


def faults(name: str, rig: Rig) -> Iterator[Fault]:
    """Every fault that can be built into a shipped rig and shows in these logs."""
    known = rig.parameters()
    who = next(iter(DRIVES[name][0])).split(".")[0]
    cylinder = next(c for c in rig.cylinder if c.name == who)
    own = [n for n in known if n.startswith(f"{who}.")]
    gains = [n for n in own if n.endswith(("flow_gain", "compensated_gain", "displacement"))]
    bands = [n for n in own if n.endswith(".deadband")]
    lags = {f"{item}.natural_frequency" for v in cylinder.valve for item in v.series}
    damping = [f"{cylinder.joint}.{word}" for word in ("damping", "joint_damping")]
    area, pressure = cylinder.areas()[0], max(float(rig.supply.pressure), 7e6)

    def scaled(names, by: float) -> Rig:
        return rig.with_values({n: by * float(known[n]) for n in names if n in known})

    def more(name: str, by: float) -> Rig:
        return rig.with_values({f"{who}.{name}": float(known[f"{who}.{name}"]) + by})

    yield Fault("gain", "every gain 5 % down", scaled(gains, 0.95))
    if len(gains) > 1:
        yield Fault("gain", "one gain 8 % down", scaled(gains[:1], 0.92))
    yield Fault("lag", "valve at half its frequency", scaled(lags, 0.5))
    if name != "pump_cylinder":
        wide = {n: float(known[n]) + 0.3 for n in bands}
        yield Fault("deadband", "0.3 V more dead band", rig.with_values(wide))
    back = [n for n, e in rig.all_edges().items() if (e.from_, e.to) == ("rod", "tank")]
    if name != "pump_cylinder":
        fixed = {f"{n}.cracking_pressure": 3e6 for n in back if n.startswith(f"{who}.")}
        yield Fault("preload", "30 bar of preload in the rod's way back", rig.with_values(fixed))
    yield Fault("leakage", "leakage of 30 mm/s", more("leakage_internal", area * 0.03 / pressure))
    yield Fault("friction", "friction", more("friction_coulomb", 0.03 * area * pressure))
    if name != "thesis_arm":  # its other bodies make up the inertia
        yield Fault("load", "20 % more mass", scaled([f"{cylinder.joint}.mass"], 1.2))
    yield Fault("bulk modulus", "20 % softer oil", scaled(["bulk_modulus"], 0.8))
    yield Fault("damping", "twice the damping", scaled(damping, 2.0))
    yield Fault("saturation", "valve full at 60 %", rig, shut_at_60)
    yield Fault("delay", "15 ms late", rig, lambda u, t: np.interp(t - 0.015, t, u))
    yield Fault("late command", "15 ms early", rig, lambda u, t: np.interp(t + 0.015, t, u))
    for kind, words, word, change in (
        ("sensor offset", "pressure 3 bar high", "p_head", lambda y: y + 3e5),
        ("sensor scale", "pressure 10 % high", "p_head", lambda y: 1.1 * y),
        ("sensor lag", "speed 10 ms late", "v", late),
        ("sensor sign", "speed turned", "v", np.negative),
    ):
        if (name, kind) != ("pump_cylinder", "sensor offset"):  # its check valves shut otherwise
            yield Fault(kind, words, rig, sensors=spoilt(f"{who}.{word}", change))


def shut_at_60(u: np.ndarray, t: np.ndarray) -> np.ndarray:
    """A command of which the last 40 % open nothing."""
    maximum = 0.6 * np.abs(u).max()
    return np.clip(u, -maximum, maximum)


def spoilt(channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Record], Record]:
    """What a faulty sensor makes of a log."""
    return lambda log: replace(log, channels=log.channels | {channel: change(log[channel])})


def late(y: np.ndarray) -> np.ndarray:
    """A reading behind a first-order lag of 10 ms."""
    from scipy.signal import lfilter

    pole = float(np.exp(-0.1))
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], y))


def told(result: Structure) -> str:
    """The findings in short."""
    return (
        ", ".join(f"{f.kind} of {f.about} {f.explains:.2f}" for f in result.findings) or "nothing"
    )


def study_faults() -> None:
    """Every fault of every rig, a line each."""
    hits: Counter[str] = Counter()
    tries: Counter[str] = Counter()
    for name in DRIVES:
        rig = load_rig(RIGS / f"{name}.toml")
        for fault in faults(name, rig):
            result = asked(name, rig, fault, 7)
            tries[fault.kind] += 1
            hits[fault.kind] += fault.named(result)
            print("named " if fault.named(result) else "MISSED", name, fault.words, told(result))
    print({kind: f"{hits[kind]} of {count}" for kind, count in tries.items()})


def study_sound(seeds: int) -> None:
    """Sound models of every rig."""
    cries = 0
    for name in DRIVES:
        rig = load_rig(RIGS / f"{name}.toml")
        for seed in range(seeds):
            result = asked(name, rig, Fault("none", "", rig), 1000 + 10 * seed)
            cries += bool(result.findings)
            if result.findings:
                print(name, seed, told(result), flush=True)
        print(f"{cries} alarms up to {name}", flush=True)
    print(f"{cries} alarms at {seeds * len(DRIVES)} sound models")


if __name__ == "__main__":
    if sys.argv[1:2] == ["sound"]:
        study_sound(int(sys.argv[2]))
    else:
        study_faults()
