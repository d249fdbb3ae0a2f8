"""How often the residual questions name a built fault, and how often they cry at a sound model.

python -m tests.structure_study [seeds]
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ehbench.plant.model import Model, simulate
from ehbench.recipe import load_rig
from ehbench.record import Record
from ehbench.rig import Rig
from ehbench.structure import Case, Structure, ask, commanded
from tests.virtual_logs import DRIVES, RIGS, commands_of, noisy

KINDS = ("steps", "chirp", "sine")
LONG = 4.0  # [s] of each log
# what may be answered to a fault beside its own name: not to be told apart by these logs
ALIASES = {"gain": {"gain", "supply"}, "delay": {"delay", "lag"}, "lag": {"lag", "delay"}}


def log_of(name: str, rig: Rig, kind: str, seed: int, change=lambda u, t: u) -> Record:
    """A log that a rig records of itself; ``change`` alters what the valve gets of the command."""
    t = np.arange(round(LONG * 1000.0) + 1) * 1e-3
    given = commands_of(name, kind, t, 0.8)
    made = simulate(rig, {v: change(u, t) for v, u in given.items()}, LONG, posture=DRIVES[name][2])
    told = {f"{valve}.command": u for valve, u in given.items()}
    return noisy(replace(made, channels=made.channels | told), seed)


def cases_of(rig: Rig, logs: list[Record]) -> list[Case]:
    """The logs as the questions are asked of them."""
    model = Model.of(rig)
    return [Case(f"log{i}", log, model, commanded(model, log)) for i, log in enumerate(logs)]


def asked(name: str, model: Rig, machine: Rig, seed: int, change=lambda u, t: u) -> Structure:
    """What the residuals say where ``machine`` recorded the logs and ``model`` is to follow."""
    logs = [log_of(name, machine, kind, seed + i, change) for i, kind in enumerate(KINDS[:2])]
    return ask(cases_of(model, logs))


def spoilt(log: Record, channel: str, change) -> Record:
    """A log with a channel altered."""
    return replace(log, channels=log.channels | {channel: change(log[channel])})


def faults(name: str, rig: Rig) -> Iterator[tuple[str, str, Rig]]:
    """(kind, words, the machine) of each fault that can be built into a rig's parameters."""
    known = rig.parameters()
    cylinder = next(c for c in rig.cylinder if c.name == next(iter(DRIVES[name][0])).split(".")[0])
    valves = [v for v in cylinder.valve]
    gains = [
        n
        for n in known
        if n.startswith(f"{cylinder.name}.")
        and n.endswith(("flow_gain", "compensated_gain", "displacement"))
    ]
    force = cylinder.areas()[0] * float(rig.supply.pressure)

    def scaled(names, by):
        return rig.with_values({n: by * float(known[n]) for n in names})

    yield "gain", "every gain 5 % down", scaled(gains, 0.95)
    if len(gains) > 1:
        yield "gain", "one gain 8 % down", scaled(gains[:1], 0.92)
    lags = [f"{one}.natural_frequency" for v in valves for one in v.series]
    yield "lag", "valve at half its frequency", scaled(dict.fromkeys(lags), 0.5)
    bands = [n for n in known if n.startswith(f"{cylinder.name}.") and n.endswith(".deadband")]
    if name != "pump_cylinder":
        wide = {n: float(known[n]) + 0.3 for n in bands}
        yield "deadband", "0.3 V more dead band", rig.with_values(wide)
    leak = f"{cylinder.name}.leakage_internal"
    pressure = max(float(rig.supply.pressure), 5e6)
    yield (
        "leakage",
        "leakage",
        rig.with_values({leak: float(known[leak]) + cylinder.areas()[0] * 0.03 / pressure}),
    )
    friction = f"{cylinder.name}.friction_coulomb"
    yield (
        "friction",
        "Coulomb friction",
        rig.with_values({friction: float(known[friction]) + max(0.03 * force, 200.0)}),
    )
    yield "load", "20 % more mass", scaled([f"{cylinder.joint}.mass"], 1.2)
    yield "bulk modulus", "20 % softer oil", scaled(["bulk_modulus"], 0.8)
    damping = next(
        n for n in (f"{cylinder.joint}.damping", f"{cylinder.joint}.joint_damping") if n in known
    )
    yield "damping", "twice the damping", scaled([damping], 2.0)


def of_logs(name: str, rig: Rig) -> Iterator[tuple[str, str, object, object]]:
    """(kind, words, change of the command, change of the log) of faults outside the parameters."""
    cylinder = next(iter(DRIVES[name][0])).split(".")[0]
    p, v = (
        f"{cylinder}.p_head",
        f"{cylinder}.v" if name in ("slide_servo", "pump_cylinder") else f"{cylinder}.v",
    )
    keep = lambda log: log
    same = lambda u, t: u
    yield (
        "saturation",
        "valve shut at 60 %",
        lambda u, t: np.clip(u, -0.6 * np.abs(u).max(), 0.6 * np.abs(u).max()),
        keep,
    )
    yield "delay", "15 ms late", lambda u, t: np.interp(t - 0.015, t, u), keep
    yield (
        "sensor offset",
        "pressure 3 bar high",
        same,
        lambda log: spoilt(log, p, lambda y: y + 3e5),
    )
    yield "sensor scale", "pressure 10 % high", same, lambda log: spoilt(log, p, lambda y: 1.1 * y)
    yield (
        "sensor lag",
        "speed 10 ms late",
        same,
        lambda log: spoilt(log, v, lambda y: lagged(y, 0.01)),
    )
    yield "sensor sign", "speed turned", same, lambda log: spoilt(log, v, lambda y: -y)


def lagged(y: np.ndarray, time: float) -> np.ndarray:
    from scipy.signal import lfilter

    pole = float(np.exp(-1e-3 / time))
    return lfilter([1.0 - pole], [1.0, -pole], y)


def main(seeds: int) -> None:
    import time

    hits, tries, cries, sound = Counter(), Counter(), 0, 0
    for name in DRIVES:
        rig = load_rig(RIGS / f"{name}.toml")
        for seed in range(seeds):
            begun = time.time()
            found = asked(name, rig, rig, 10 * seed)
            sound += 1
            cries += bool(found.findings)
            if found.findings or seed == 0:
                print(
                    name,
                    "sound",
                    seed,
                    round(time.time() - begun, 1),
                    [(f.kind, f.about, round(f.explains, 2), f.size) for f in found.findings],
                    flush=True,
                )
        for kind, words, machine in faults(name, rig):
            report(name, kind, words, asked(name, rig, machine, 7), hits, tries)
        for kind, words, change, spoil in of_logs(name, rig):
            logs = [spoil(log_of(name, rig, k, 7 + i, change)) for i, k in enumerate(KINDS[:2])]
            report(name, kind, words, ask(cases_of(rig, logs)), hits, tries)
    print({kind: f"{hits[kind]}/{tries[kind]}" for kind in tries}, "alarms", cries, "of", sound)


def report(name, kind, words, found, hits, tries) -> None:
    ok = bool({f.kind for f in found.findings[:2]} & ALIASES.get(kind, {kind}))
    tries[kind] += 1
    hits[kind] += ok
    print(
        "ok  " if ok else "MISS",
        name,
        words,
        [(f.kind, f.about, round(f.explains, 3), round(f.size, 4)) for f in found.findings],
        flush=True,
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
