"""Whether 95 % intervals hold the truth: fits of random rigs to their own noisy logs, counted.
``python -m tools.coverage_study``.

Every rig is a slide, a crane or a boom with numbers, posture, load and steps of its own; its logs
are simulated by the model that is fitted, so that nothing but the noise and the estimation is on
trial, unless one flow gain of the fitted rig is made wrong (``gain``), or it goes by maps of noisy
readings of its edges (``maps``)."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.flow_maps.readings import readings_table
from ehbench.flow_maps.results import fit_flow_map
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.physics.flow_map import FlowMaps, collect
from ehbench.plant.model import simulate
from ehbench.runtime.blas import one_thread
from ehbench.vocabulary.errors import EhbenchError

RIGS = Path(__file__).resolve().parents[1] / "recipes" / "rigs"
NOISE = {
    "p_head": 15e3,
    "p_rod": 15e3,
    "p_supply": 15e3,
    "q": 1e-4,
    "x": 2e-5,
    "qd": 4e-3,
    "v": 2e-3,
}
POLE = 0.95  # of the coloured noise, at 1 kHz
SECONDS = 1.4
OFF = 1.6  # by which searches start off the truth
WRONG = 0.03  # of one flow gain
SCATTER = 0.01  # of a flowmeter's readings
VOLTS = (0.0, 0.6, 0.8, 1.0, 1.2, 1.4, 1.7, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
WORDS = {"": "", "gain": ", one gain 3 % off", "maps": ", maps of readings of 1 %"}
MINUTES = 1e-6 / 60.0 / 1e5  # 1 mL/min/bar [m³/(s·Pa)]


@dataclass(frozen=True)
class Kind:
    """A kind of rig: its file, cylinder, damping, payload, and the valves that drive it out and
    back."""

    file: str
    cylinder: str
    damping: str
    loads: tuple[str | None, ...]
    out: tuple[str, ...]
    back: tuple[str, ...]
    sign: float


KINDS = (
    Kind(
        "slide_servo", "press", "carriage.damping", (None, "100 kg"), ("servo",), ("servo",), -1.0
    ),
    Kind(
        "crane_proportional",
        "lift",
        "arm.joint_damping",
        (None, "200 kg"),
        ("spool",),
        ("spool",),
        -1.0,
    ),
    Kind(
        "boom_four_valve",
        "boom",
        "boom.joint_damping",
        (None, "bucket"),
        ("sh", "rt"),
        ("sr", "ht"),
        1.0,
    ),
)


@dataclass(frozen=True)
class Case:
    """One fit: the rig's seed, how many logs, the noise (``white``, ``ar1``), and what is ``off``:
    ``gain``, one flow gain is wrong and all are freed with a prior; ``maps``, those of readings."""

    seed: int
    logs: int
    noise: str
    off: str = ""


@dataclass(frozen=True)
class Outcome:
    """What a fit said: by parameter whether its interval holds the truth and its half-width as a
    share of the truth (or, where that is zero, nan); CPU seconds and simulations, or why it failed.
    """

    case: Case
    kind: str
    holds: dict[str, bool]
    width: dict[str, float]
    seconds: float = 0.0
    evaluations: int = 0
    failure: str = ""


def random_rig(kind: Kind, rng: np.random.Generator) -> tuple[Rig, dict[str, float]]:
    """(a rig with random numbers, the true values of what is to be fitted)."""
    rig = load_rig(RIGS / f"{kind.file}.toml")
    known = {name: float(v) for name, v in rig.parameters().items() if np.ndim(v.value) == 0}
    near = (f"{kind.cylinder}.volume_head", f"{kind.cylinder}.volume_rod", kind.damping)
    body = kind.damping.partition(".")[0]
    values = {name: known[name] * rng.uniform(0.8, 1.4) for name in (*near, f"{body}.mass")}
    values[f"{kind.cylinder}.volume_rod"] = known[near[1]] * rng.uniform(1.0, 1.4)
    values[kind.damping] = known[kind.damping] * math.exp(rng.uniform(-0.7, 0.9))
    values["bulk_modulus"] = math.exp(rng.uniform(math.log(2e8), math.log(1.6e9)))
    (dynamics,) = rig.dynamics
    values[f"{dynamics}.natural_frequency"] = 2.0 * math.pi * rng.uniform(15.0, 80.0)
    leaks, rubs = rng.random(2) < 0.6
    leakage = math.exp(rng.uniform(0.0, math.log(60.0))) * MINUTES
    values[f"{kind.cylinder}.leakage_internal"] = leakage if leaks else 0.0
    values[f"{kind.cylinder}.friction_coulomb"] = rng.uniform(50.0, 600.0) if rubs else 0.0
    requested = ["bulk_modulus", kind.damping, f"{kind.cylinder}.leakage_internal"]
    if rng.random() < 0.5:
        requested.append(f"{kind.cylinder}.friction_coulomb")
    if rng.random() < 0.3:
        requested.append(f"{dynamics}.natural_frequency")
    return rig.with_values(values), {name: values[name] for name in requested}


def random_log(kind: Kind, rig: Rig, index: int, pole: float, rng: np.random.Generator) -> Record:
    """A noisy log of steps out and back from a random posture, half of them without a rate."""
    t = np.arange(round(SECONDS * 1000.0) + 1) * 1e-3
    first, second = rng.uniform(0.1, 0.2), rng.uniform(0.65, 0.8)
    out = (t >= first) & (t < first + rng.uniform(0.25, 0.45))
    back = (t >= second) & (t < second + rng.uniform(0.25, 0.45))
    commands: dict[str, np.ndarray | float] = {}
    for valves, span, sign in ((kind.out, out, 1.0), (kind.back, back, kind.sign)):
        for valve in valves:
            name = f"{kind.cylinder}.{valve}"
            commands[name] = commands.get(name, 0.0) + sign * rng.uniform(2.5, 5.0) * span
    stroke = float(rig.cylinder_named(kind.cylinder).stroke)
    posture = {kind.cylinder: f"{stroke * rng.uniform(0.35, 0.6)!r} m"}
    load = kind.loads[index % len(kind.loads)]
    built = simulate(rig, commands, SECONDS, posture=posture, payload=load)
    dropped = ("qd", "v") if rng.random() < 0.5 else ()
    channels = {}
    for name, y in built.channels.items():
        word = name.rsplit(".", 1)[-1]
        if word not in ("flow", "opening", "flow_supply", *dropped):
            channels[name] = y + NOISE.get(word, 0.0) * _noise(y.size, pole, rng)
    return Record(built.t, channels, built.meta)


def read_maps(rig: Rig, rng: np.random.Generator) -> FlowMaps:
    """Maps of two trials of noisy readings of every edge, all of them orifices."""
    grid = np.array(VOLTS), np.geomspace(3e5, 150e5, 8), np.arange(2)
    command, drop, trial = map(np.ravel, np.meshgrid(*grid, indexing="ij"))
    maps = []
    for cylinder, valve, edge in rig.edges():
        gain, start = (float(number or 0.0) for number in (edge.flow_gain, edge.deadband))
        flow = gain * np.maximum(command - start, 0.0) * np.sqrt(drop)
        noise = SCATTER * flow + 0.1 * SCATTER**2 * flow.max() * (flow > 0.0)
        read = readings_table(
            command, drop, flow + noise * rng.standard_normal(flow.size), trial=trial
        )
        name = f"{cylinder.name}.{valve.edge_name(edge)}"
        maps.append(fit_flow_map(name, "forward", read).map)
    return collect(maps)


def _noise(count: int, pole: float, rng: np.random.Generator) -> np.ndarray:
    from scipy.signal import lfilter

    raw = rng.standard_normal(count + 300)
    return np.asarray(lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], raw))[300:]


@one_thread()
def fitted(case: Case) -> Outcome:
    """One fit, from its seed."""
    rng = np.random.default_rng([case.seed, case.logs])
    kind = KINDS[case.seed % len(KINDS)]
    rig, truth = random_rig(kind, rng)
    pole = POLE if case.noise == "ar1" else 0.0
    logs = [(f"log {i}", random_log(kind, rig, i, pole, rng)) for i in range(case.logs)]
    start = {
        name: value * OFF ** rng.choice([-1.0, 1.0]) if value > 0.0 else 5.0 * MINUTES
        for name, value in truth.items()
    }
    for name in start:
        if name.endswith("friction_coulomb"):
            start[name] = 200.0
    start["bulk_modulus"] = min(start["bulk_modulus"], 1.7e9)
    requested, prior = list(truth), {}
    maps = read_maps(rig, rng) if case.off == "maps" else None
    if case.off == "gain":
        gains = {n: float(v) for n, v in rig.parameters().items() if n.endswith(".flow_gain")}
        wrong = rng.choice(sorted(gains))
        rig = rig.with_values({wrong: gains[wrong] * (1.0 + WRONG * rng.choice([-1.0, 1.0]))})
        requested += list(gains)
        prior = dict.fromkeys(gains, f"{100.0 * WRONG:g} %")
    began = time.process_time()
    try:
        given = FitOptions(start=start, prior=prior, workers=1)
        fit = identify_hydraulics(rig, logs, requested, given, maps)
    except EhbenchError as error:
        return Outcome(case, kind.file, {}, {}, failure=str(error))
    seconds = time.process_time() - began
    intervals = {name: fit[name].interval for name in truth}
    holds = {name: low <= truth[name] <= high for name, (low, high) in _known(intervals)}
    width = {
        name: 0.5 * (high - low) / truth[name] if truth[name] else math.nan
        for name, (low, high) in _known(intervals)
    }
    return Outcome(case, kind.file, holds, width, seconds, fit.evaluations)


def _known(
    intervals: dict[str, tuple[float, float] | None],
) -> Iterator[tuple[str, tuple[float, float]]]:
    return ((name, ends) for name, ends in intervals.items() if ends is not None)


def cases(rigs: int) -> list[Case]:
    """All cases of a study of so many rigs in each group: two, three and six logs, white and
    coloured noise, two logs with a wrong gain, and two with maps: there the rigs are those of the
    first group, else none comes twice."""
    groups = [
        *((logs, noise, "") for logs, noise in product((2, 3, 6), ("white", "ar1"))),
        (2, "white", "gain"),
        (2, "white", "maps"),
    ]
    return [
        Case((len(groups) - 1) * index + group, *about)
        for index in range(rigs)
        for group, about in enumerate(groups)
    ]


def study(rigs: int, workers: int = 2) -> list[Outcome]:
    """The outcome of every case, in order."""
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(fitted, cases(rigs), chunksize=4))


def table(outcomes: Sequence[Outcome]) -> str:
    """Coverage by number of logs and noise, as a Markdown table."""
    lines = [
        "| logs | noise | fits | intervals | hold the truth | bulk modulus ± | simulations | CPU |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple[int, str, str], list[Outcome]] = {}
    for outcome in outcomes:
        case = outcome.case
        groups.setdefault((case.logs, case.noise, case.off), []).append(outcome)
    for (logs, noise, off), some in groups.items():
        done = [item for item in some if not item.failure]
        holds = [hold for item in done for hold in item.holds.values()]
        widths = [item.width["bulk_modulus"] for item in done if "bulk_modulus" in item.width]
        share, n = 100.0 * float(np.mean(holds)), len(holds)
        lines.append(
            f"| {logs} | {noise}{WORDS[off]} | {len(done)} | {n} | "
            f"{share:.1f} ± {100.0 * math.sqrt(share * (100.0 - share) / n) / 100.0:.1f} % | "
            f"{100.0 * float(np.median(widths)):.3f} % | "
            f"{np.median([item.evaluations for item in done]):.0f} | "
            f"{np.median([item.seconds for item in done]):.2f} s |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] = ()) -> int:
    """Print the table; the only argument is how many rigs a group has, by default 50."""
    rigs = int(arguments[0]) if arguments else 50
    outcomes = study(rigs, int(os.environ.get("CORES", "2")))
    print(table(outcomes))
    for outcome in outcomes:
        if outcome.failure:
            print(
                f"rig {outcome.case.seed}, {outcome.case.logs} logs, {outcome.case.noise}: "
                f"{outcome.failure}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
