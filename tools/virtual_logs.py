"""Logs that rigs would record of themselves: steps, sine, chirp, slow ramps, with sensor noise."""

import math
from collections.abc import Mapping

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.plant.model import simulate

NOISE = {"q": 4e-4, "qd": 2e-3, "x": 5e-5, "v": 1e-3, "p_head": 1.5e4, "p_rod": 1.5e4}
NOISE |= {"command": 0.0, "p_supply": 9e3, "p_tank": 8e3}
# by rig: (cylinder, valves driven by the positive part, by the negative part, start)
DRIVES = {
    "slide_servo": ({"press.servo": 3.0}, None, {"press": "200 mm"}),
    "crane_proportional": ({"lift.spool": 5.0}, None, {"lift": "300 mm"}),
    "boom_four_valve": (
        {"boom.sh": 4.0, "boom.rt": 5.0},
        {"boom.sr": 3.0, "boom.ht": 3.5},
        {"boom": "250 mm"},
    ),
    "pump_cylinder": ({"lift.drive": 5.0}, None, {"lift": "200 mm"}),
    "thesis_arm": ({"swing.servo": 3.0}, None, {}),
}


def shape(kind: str, t: np.ndarray) -> np.ndarray:
    """A command of size one that returns to rest; ``quick steps`` take half the time."""
    if kind in ("steps", "quick steps"):
        turns = [(0.3, 1.0), (0.9, 0.0), (1.5, -1.0), (2.1, 0.0), (2.7, 0.6), (3.3, 0.0)]
        made, share = np.zeros_like(t), 0.5 if kind == "quick steps" else 1.0
        for begin, level in turns:
            made[t >= share * begin] = level
        return made
    on = (t >= 0.3) & (t < t[-1] - 0.3)
    s = t - 0.3
    if kind == "sine":
        return np.where(on, np.sin(2.0 * math.pi * 0.8 * s), 0.0)
    if kind == "chirp":
        span = t[-1] - 0.6
        phase = 2.0 * math.pi * (0.5 * s + 0.5 * (15.0 - 0.5) / span * s**2)
        return np.where(on, np.sin(phase), 0.0)
    if kind == "ramps":
        return np.interp(t, [0.3, 1.5, 2.5, 4.0, 5.0], [0.0, 0.6, -0.4, 0.3, 0.0])
    raise ValueError(kind)


def commands_of(name: str, kind: str, t: np.ndarray, share: float = 1.0) -> dict[str, np.ndarray]:
    """Commands [V] by valve of a shipped rig."""
    up, down, _ = DRIVES[name]
    wave = share * shape(kind, t)
    if down is None:
        return {valve: amplitude * wave for valve, amplitude in up.items()}
    return {valve: amplitude * np.maximum(wave, 0.0) for valve, amplitude in up.items()} | {
        valve: amplitude * np.maximum(-wave, 0.0) for valve, amplitude in down.items()
    }


def noisy(
    made: Record, seed: int, payload: str | None = None, factor: float = 1.0, noise=NOISE
) -> Record:
    """What sensors say of a simulation: no openings or flows, white noise on what is measured."""
    rng, channels = np.random.default_rng(seed), {}
    for name, values in made.channels.items():
        size = noise.get(name.rsplit(".", 1)[-1])
        if size is not None:
            channels[name] = values + factor * size * rng.standard_normal(values.shape)
    return Record(made.t, channels, {"payload": payload or "none"})


def clean_log(
    name: str,
    rig: Rig,
    kind: str,
    duration: float = 4.0,
    share: float = 1.0,
    commands: Mapping[str, np.ndarray] | None = None,
) -> Record:
    """What ``rig``, of the shipped file ``name``, does under a command of ``kind``."""
    duration = max(duration, 6.0) if kind == "ramps" else duration
    t = np.arange(round(duration * 1000.0) + 1) * 1e-3
    given = commands_of(name, kind, t, share) if commands is None else commands
    return simulate(rig, given, duration, posture=DRIVES[name][2])


def virtual_log(
    name: str,
    rig: Rig,
    kind: str,
    seed: int,
    duration: float = 4.0,
    share: float = 1.0,
    commands: Mapping[str, np.ndarray] | None = None,
) -> Record:
    """A log of ``kind`` that ``rig``, of the shipped file ``name``, records of itself."""
    return noisy(clean_log(name, rig, kind, duration, share, commands), seed)
