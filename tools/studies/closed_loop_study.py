"""What a fit to logs of a position controller comes to, with the motion free and tied in.

A sliding mass whose oil, damping, leakage, friction and gains are not the rig file's is moved by a
controller that sees its position with noise. ``sound``: the model lacks nothing, gains are freed
with their prior. ``load``: the machine also stands at a slope that the model does not know.
``neutral``: its driver adds 0.15 V that no one knows, over 20 s, gains known.

python -m tools.studies.closed_loop_study sound 10        # case, seeds
python -m tools.studies.closed_loop_study sound 3 20     # and 20 times the position's noise of 5 µm
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, HydraulicsFit, identify_hydraulics
from ehbench.parts.valve.delay import line_of
from ehbench.plant.integrate import run
from ehbench.plant.model import Model
from ehbench.plant.ties import TIED
from ehbench.vocabulary.fields import Value
from tests.shared import RIGS

MINUTES = 1e-6 / 60.0 / 1e5  # mL/min/bar [m^3/(s·Pa)]
TRUE = {
    "bulk_modulus": 720e6,
    "carriage.damping": 1500.0,
    "press.leakage_internal": 20.0 * MINUTES,
    "press.friction_coulomb": 150.0,
}
GAINS = tuple(
    f"press.servo_{edge}.flow_gain"
    for edge in ("supply_head", "rod_tank", "supply_rod", "head_tank")
)
OFF = (1.03, 0.97, 1.03, 1.03)  # of the gains
SLOPE = 0.15  # [rad]
NEUTRAL = 0.15  # [V]
NOISE = {"press.x": 5e-6, "press.v": 2e-3, "press.p_head": 15e3, "press.p_rod": 15e3}
NOISE |= {"p_supply": 15e3}
TICK, GAIN = 1e-3, 60.0  # [s], [V/m]


def rigs(case: str) -> tuple[Rig, Rig]:
    """(the rig as its file has it, the machine)."""
    known = load_rig(RIGS / "slide_servo.toml")
    machine = known.with_values(TRUE)
    if case != "neutral":
        own = {
            name: float(known.parameters()[name]) * k for name, k in zip(GAINS, OFF, strict=True)
        }
        machine = machine.with_values(own)
    if case == "load":
        slope = Value(SLOPE)
        body = machine.mechanism.model_copy(update={"incline": slope})
        machine = machine.model_copy(update={"mechanism": body})
    return known, machine


def reference(case: str, seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Desired positions [m], one a tick: smoothed steps."""
    t = np.arange(round(seconds / TICK) + 1) * TICK
    at = np.arange(0.1, seconds - 0.2, 0.8 if case == "neutral" else 0.6)
    levels = 0.15 + rng.uniform(-0.05, 0.08, at.size)
    if case == "neutral":
        levels = 0.3 + 0.06 * (-1.0) ** np.arange(at.size) * rng.uniform(0.5, 1.0, at.size)
    desired = np.full(t.size, levels.mean())
    for when, level in zip(at, levels, strict=True):
        desired[t >= when] = level
    keep = np.exp(-TICK / 0.06)
    for i in range(1, t.size):
        desired[i] = keep * desired[i - 1] + (1.0 - keep) * desired[i]
    return desired


def closed_loop_log(
    case: str, seed: int, payload: str | None = None, seconds: float = 3.0, noise: float = 1.0
) -> Record:
    """A log of a proportional controller of the position, which sees it with its noise.

    Args:
        case: of the study.
        seed: of motion and noise.
        payload: carried.
        seconds: that it lasts.
        noise: of the position, in units of its NOISE."""
    rng = np.random.default_rng(seed)
    desired = reference(case, seconds, rng)
    model = Model.of(rigs(case)[1], None, payload)
    y, plant = model.trim(model.posture({"press": float(desired[0])})), model.plant
    t = np.arange(desired.size) * TICK
    states, command, seen = np.empty((t.size, y.size)), np.zeros(t.size), np.empty(t.size)
    line, log = line_of(plant, TICK), np.empty((2, y.size + plant.edges.shape[0] + 1))
    for i in range(t.size):
        states[i] = y
        seen[i] = y[0] + noise * NOISE["press.x"] * rng.standard_normal()
        if t[i] >= 0.1:
            command[i] = np.clip(GAIN * (desired[i] - seen[i]), -9.5, 9.5)
        run(y, np.full((2, 1), command[i]), plant, line, 2, log)
    built = model.record(t, command[:, None], states, {"rig": "slide_servo"})
    message = command - NEUTRAL * (t >= 0.1) if case == "neutral" else command
    channels = {"press.servo.command": message}
    for name, size in NOISE.items():
        channels[name] = built[name] + size * rng.standard_normal(t.size)
    channels |= {"press.x": seen, "press.x_desired": desired}
    return Record(t, channels, {"rig": "slide_servo", "payload": payload or "none"})


def fitted(
    case: str, logs: Sequence[Record], tied: str, parameters: Sequence[str] = tuple(TRUE)
) -> HydraulicsFit:
    """A fit to logs, with what is tied of their motion; gains are freed if not known."""
    known, _ = rigs(case)
    gains = () if case == "neutral" else GAINS
    start = {"press.leakage_internal": 5.0 * MINUTES, "press.friction_coulomb": 200.0}
    options = FitOptions(
        start={name: value for name, value in start.items() if name in parameters},
        prior=dict.fromkeys(gains, "3 %"),
        channels=("v", "p_head", "p_rod"),
    )
    given = [(f"log {i}", replace(log, meta=log.meta | {TIED: tied})) for i, log in enumerate(logs)]
    return identify_hydraulics(known, given, [*parameters, *gains], options)


def main(case: str, seeds: int, noise: float = 1.0) -> None:
    """Print, by what is tied, how often each interval holds the truth, and the errors."""
    truth = {name: float(value) for name, value in rigs(case)[1].parameters().items() if value}
    print(f"{'tied':9} {'parameter':34} {'holds':>7} {'error':>8} {'interval':>9}")
    for tied in ("none", "position", "motion"):
        results: dict[str, list[tuple[bool, float, float]]] = {}
        for seed in range(seeds):
            seconds = 20.0 if case == "neutral" else 3.0
            loads = (None, "100 kg")
            logs = [
                closed_loop_log(case, 10 * seed + i, load, seconds, noise)
                for i, load in enumerate(loads)
            ]
            for parameter in fitted(case, logs, tied).parameters:
                if parameter.interval is None:
                    continue
                (low, high), true = parameter.interval, truth[parameter.name]
                row = (low <= true <= high, parameter.value / true - 1.0, (high - low) / 2.0 / true)
                results.setdefault(parameter.name, []).append(row)
        for name, rows in results.items():
            fixed, error, half = np.array(rows).T
            print(
                f"{tied:9} {name:34} {fixed.sum():3.0f}/{len(rows):<3} {100 * error.mean():+7.2f} "
                f"% ± {100 * np.median(half):.2f} %",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 1.0)
