"""Which parameters come back from far starts: each that a rig offers, alone, from half and from
twice its true value (where no such rig is possible, from as far as one is), or from zero where the
rig file has zero, on two noisy logs that its model makes.

python -m tools.studies.recovery_study                         # every rig, shipped or with other
parts
python -m tools.studies.recovery_study slide_servo             # one of them
python -m tools.studies.recovery_study slide_servo supply.flow_limit spool.damping_ratio
python -m tools.studies.recovery_study "slide, lugre" seeds=20   # as many draws of noise, one start

Of what lies beside the truth stands where the noise alone would have it, in standard errors: by the
sensitivities at the truth, all else known. Where the fit is as far off as that, it is the draw."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import product
from typing import Any

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.identification.problem import SETTINGS as PROBLEM
from ehbench.plant.model import Model, simulate
from ehbench.signals.series import rms
from ehbench.vocabulary.errors import EhbenchError, InputError, InsufficientData
from tests.shared import RIGS
from tools.virtual_logs import DRIVES, NOISE, commands_of, noisy, shape

SHIPPED = (
    "slide_servo",
    "pump_cylinder",
    "crane_proportional",
    "boom_four_valve",
    "thesis_arm",
    "thesis_arm_standard",
)
# [s], and share of the amplitudes: no chamber empties, of which the model knows a floor only
KINDS = {"quick steps": (2.0, 1.0), "chirp": (2.5, 0.6)}
# of an arm, all cylinders at once, amplitudes [V] as in `virtual_logs.DRIVES`
ARMS = {
    "thesis_arm": (
        {"swing.servo": 1.2, "stick.servo": -1.2},
        {"boom.hepc": 3.2, "boom.rect": 3.2},
        {"boom.repc": 3.2, "boom.hect": 2.6},
    ),
    "thesis_arm_standard": ({"swing.servo": 1.2, "stick.servo": -1.2, "boom.spool": 1.2}, {}, {}),
}
# what a rig file gives as zero is, on trial, so many of: supply pressure times flow, and so on
SEEN = 0.05
FELT = (0.5, 0.97)  # limits on trial, as shares of what the logs reach without
# [s] of the integration that makes logs: in the usual steps, laws with a corner (Stribeck's, a
# check's) are off by up to half of the noise, of which no interval knows
FINE = 5.0e-5
COMPARED = ("v", "qd", "p_head", "p_rod")
NEARBY = 1e-5  # share of a parameter over which a sensitivity is taken
REST = 500  # samples before a log begins, in which what a simulation starts with dies out
TOLD = 3.84  # rise of -2 log likelihood over a range that tells something of a parameter
ELSEWHERE = (0.25, 0.5, 0.8, 1.25, 2.0, 4.0)  # shares of the truth that are asked then
STEPS = (2.0, 1.5, 1.2, 1.1, 1.05, 1.02, 1.01)  # how far off a start is tried, until there is a rig


@dataclass(frozen=True, eq=False)
class Bed:
    """A rig on trial: where its cylinders stand at first, and commands [V] by log."""

    name: str
    rig: Rig
    posture: Mapping[str, str]
    commands: Sequence[Mapping[str, np.ndarray]]

    def logs(self, rig: Rig) -> list[Record]:
        """What the rig does once it has come to rest, without noise."""
        built = []
        for given in self.commands:
            begun = {valve: np.concatenate([np.zeros(REST), u]) for valve, u in given.items()}
            seconds = 1e-3 * (len(next(iter(begun.values()))) - 1)
            log = simulate(rig, begun, seconds, posture=self.posture, step=FINE)
            log = log.at(slice(REST, None))
            built.append(replace(log, t=log.t - log.t[0]))
        return built


@dataclass(frozen=True)
class Trial:
    """A parameter, its true value, where a fit starts, and an upper bound where it starts at
    zero."""

    name: str
    truth: float
    start: float
    upper: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of a trial: ``back``, ``wide`` (the interval holds the truth, but is wider than a
    quarter of it), ``beside`` (missed by less than the interval's width, as one in twenty is),
    ``twin`` (missed by more, but the logs are the same there), ``untold`` (refused, and the logs
    are the same from a quarter to four times the truth), ``inert`` (refused before anything is
    simulated) or ``MISSED``; and in words."""

    kind: str
    words: str


# --- rigs with the parts that no shipped one has


def with_tables(table: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """A table with others put into it, level by level."""
    built = dict(table)
    for key, value in own.items():
        old = built.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            value = with_tables(old, value)
        built[key] = value
    return built


def slide(cylinder: Mapping[str, Any], rest: Mapping[str, Any], edge: Mapping[str, Any]) -> Rig:
    """The slide with more in its cylinder, in the rest of its file, and in each metering edge."""
    plain = load_rig(RIGS / "slide_servo.toml").as_toml()
    (own,) = plain["cylinder"]
    (valve,) = own["valve"]
    more = dict(cylinder)
    changed = [{**item, **edge} for item in valve["edge"]]
    valve = valve | {"edge": changed} | more.pop("valve", {})
    own = own | {"valve": [valve]} | more
    return Rig.model_validate(with_tables(plain, {**rest, "cylinder": [own]}))


SEALS = {"friction_viscous": "300 N*s/m", "friction_coulomb": "200 N"}
STRIBECK = {"friction_static": "400 N", "stribeck_speed": "20 mm/s"}
BRISTLES = {"bristle_stiffness": "2000 N/mm", "bristle_damping": "8000 N*s/m"}
LINES = [
    {"end": "head", "volume": "0.4 L", "resistance": "0.3 bar*min/L", "bulk_modulus": "600 MPa"},
    {"end": "rod", "volume": "0.25 L", "orifice_gain": "15 L/min/bar^0.5"},
]
FORCES = [
    {"name": "dead", "kind": "constant", "force": "-2 kN"},
    {
        "name": "rub",
        "kind": "by_direction",
        "force_extending": "-600 N",
        "force_retracting": "400 N",
    },
    {"name": "coil", "kind": "spring", "stiffness": "20 N/mm", "free_length": "150 mm"},
    {
        "name": "brake",
        "kind": "cylinder",
        "area_head": "6 cm^2",
        "pressure_head": "20 bar",
        "area_rod": "4 cm^2",
        "pressure_rod": "10 bar",
    },
]
WAY = {
    "amplifier": {"kind": "first_order", "lag": "8 ms"},
    "bus": {"kind": "delay", "delay": "7 ms"},
}
CORNER = {"amplifier": {"kind": "first_order", "corner": "25 Hz"}}
COMPENSATED = {"flow_gain": None, "compensated_gain": "4 L/min/V"}
CHECKS = [
    {
        "name": "anti_void",
        "from": "tank",
        "to": "head",
        "law": "check",
        "orifice_gain": "3 L/min/bar^0.5",
    },
    {
        "name": "bleed",
        "from": "head",
        "to": "tank",
        "law": "check",
        "orifice_gain": "1 L/min/bar^0.5",
        "cracking_pressure": "50 bar",
        "opening_range": "20 bar",
    },
]
PUMP = [
    {
        "name": "feed",
        "from": "tank",
        "to": "head",
        "law": "pump",
        "displacement": "2 mL/rev",
        "pump_speed": "500 rpm",
        "slip": "2 mL/min/bar",
    }
]
# by name: what the cylinder, the rest of the file, and each metering edge has besides
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "slide, stribeck": ({**SEALS, "friction": {"law": "stribeck", **STRIBECK}}, {}, {}),
    "slide, directional": (
        {**SEALS, "friction": {"law": "directional", "friction_retracting": "300 N"}},
        {},
        {},
    ),
    "slide, lugre": ({**SEALS, "friction": {"law": "lugre", **STRIBECK, **BRISTLES}}, {}, {}),
    "slide, lines": ({"line": LINES, "bulk_modulus": "850 MPa"}, {}, {}),
    "slide, mount": ({"mount": {"stiffness": "12 kN/mm", "damping": "15 kN*s/m"}}, {}, {}),
    "slide, sway": (
        {"sway": {"mass": "120 kg", "stiffness": "0.4 kN/mm", "damping": "900 N*s/m"}},
        {},
        {},
    ),
    "slide, forces": ({"force": FORCES}, {}, {}),
    "slide, air": ({}, {"oil": {"air_fraction": 0.02, "polytropic_exponent": 1.3}}, {}),
    "slide, accumulator": (
        {},
        {
            "supply": {
                "flow_limit": "10 L/min",
                "accumulator": {"gas_volume": "0.4 L", "precharge": "60 bar"},
            }
        },
        {},
    ),
    "slide, load sensing": (
        {},
        {"supply": {"load_sensing": {"load_margin": "30 bar", "load_lag": "15 ms"}}},
        {},
    ),
    "slide, two rails": (
        {},
        {"supply": {"low_rail": {"rail_pressure": "80 bar", "rail_margin": "10 bar"}}},
        {},
    ),
    "slide, valve in series": (
        {"valve": {"dynamics": ["bus", "amplifier", "spool"], "drive_limit": "2.4 V"}},
        {"dynamics": WAY},
        {},
    ),
    "slide, corner": ({"valve": {"dynamics": ["amplifier"]}}, {"dynamics": CORNER}, {}),
    "slide, saturating": (
        {},
        {},
        {"law": "saturating", "opening_max": "1.8 V", "saturation_softness": "0.4 V"},
    ),
    "slide, compensated": ({}, {}, {"law": "compensated", **COMPENSATED}),
    "slide, flow control": (
        {},
        {},
        {"law": "flow_control", **COMPENSATED, "compensation_drop": "40 bar"},
    ),
    "slide, checks": ({"edge": CHECKS}, {}, {}),
    "slide, pump": ({"edge": PUMP}, {}, {}),
    "slide, underlap": ({}, {}, {"underlap": "0.15 V"}),
}


def rack() -> Rig:
    """The crane's boom, its cylinder on a rack."""
    plain = load_rig(RIGS / "crane_proportional.toml").as_toml()
    (own,) = plain["cylinder"]
    del own["pins"]
    own["rack"] = {"radius": "0.5 m", "retracted_angle": "-0.4 rad"}
    return Rig.model_validate(plain)


BEDS = (*SHIPPED, *VARIANTS, "crane, rack")


@cache
def bed(name: str) -> Bed:
    """A rig on trial, by its name of `BEDS`."""
    file = {"slide": "slide_servo", "crane": "crane_proportional"}.get(name.partition(",")[0], name)
    if name in VARIANTS:
        rig = slide(*VARIANTS[name])
    else:
        rig = rack() if name == "crane, rack" else load_rig(RIGS / f"{file}.toml")
    commands = []
    for kind, (seconds, share) in KINDS.items():
        t = np.arange(round(1000.0 * seconds) + 1) * 1e-3
        if file in ARMS:
            commands.append(swinging(file, share * shape(kind, t)))
        else:
            commands.append(commands_of(file, kind, t, share))
    return Bed(name, rig, DRIVES.get(file, ({}, None, {}))[2], commands)


def swinging(file: str, wave: np.ndarray) -> dict[str, np.ndarray]:
    """Commands [V] of all valves of an arm under a wave of size one: those that have others for the
    way back get its positive part."""
    both, out, back = ARMS[file]
    return (
        {valve: size * wave for valve, size in both.items()}
        | {valve: size * np.maximum(wave, 0.0) for valve, size in out.items()}
        | {valve: size * np.maximum(-wave, 0.0) for valve, size in back.items()}
    )


@lru_cache(maxsize=4)
def logs_of(name: str, **values: float) -> list[Record]:
    """What the rig of a bed does, with some values in place of its own; starts from below and above
    go by the same logs."""
    item = bed(name)
    return item.logs(item.rig.with_values(values))


# --- what is tried


@dataclass(frozen=True)
class Scale:
    """What a rig's logs reach: drop [Pa], area [m²], flow of the fastest cylinder [m³/s], speed
    [m/s], command [V], the highest pressure [Pa] of a chamber, and flow of the supply [m³/s]."""

    pressure: float
    area: float
    flow: float
    speed: float
    command: float
    peak: float
    drawn: float


@cache
def scale(name: str) -> Scale:
    """Of a bed."""
    item = bed(name)
    built = logs_of(name)

    def most(word: str) -> float:
        results = [log[c] for log in built for c in log.channels if c.rpartition(".")[2] == word]
        return max((float(np.abs(y).max()) for y in results), default=0.0)

    peak = max(most("p_head"), most("p_rod"))
    area = max(c.areas()[0] for c in item.rig.cylinder)
    drop = max(float(item.rig.supply.pressure), 0.5 * peak)
    speed = most("v")
    return Scale(drop, area, area * speed, speed, most("command"), peak, most("flow_supply"))


def truths_of(name: str, parameter: str, given: float) -> tuple[float, ...]:
    """Values that the logs can show: the rig file's, but of what is zero there; of a limit that is
    never reached there, one that is well and one that is hardly felt."""
    s, word = scale(name), parameter.rpartition(".")[2]
    if word in ("relief_pressure", "flow_limit"):
        reached = s.peak if word == "relief_pressure" else s.drawn or 0.6 * s.flow
        return tuple(share * reached for share in FELT)
    if given != 0.0:
        return (given,)
    force = SEEN * s.pressure * s.area
    flow = SEEN * s.flow / s.pressure
    pressure = SEEN * s.pressure
    return (
        {
            **dict.fromkeys(("leakage_internal", "leakage_head", "leakage_rod", "slip"), flow),
            **dict.fromkeys(("cracking_pressure", "tank_pressure"), pressure),
            **dict.fromkeys(("friction_viscous", "damping"), force / s.speed),
            "friction_coulomb": force,
            "deadband": 2.0 * SEEN * s.command,
        }.get(word, 2.0 * SEEN),
    )


def possible(item: Bed, values: Mapping[str, float]) -> bool:
    """Whether there is such a rig, and it can stand where the logs begin."""
    try:
        model = Model.of(Rig.model_validate(item.rig.with_values(values).as_toml()))
        model.trim(model.posture(item.posture))
    except (EhbenchError, ValueError, ArithmeticError):
        return False
    return True


def trials(name: str, parameter: str) -> Iterator[Trial]:
    """From below and from above, as far off as there is a rig."""
    item = bed(name)
    given = float(item.rig.parameters()[parameter])
    for truth in truths_of(name, parameter, given):
        if given == 0.0:
            yield Trial(parameter, truth, 0.0, 8.0 * truth)
            yield Trial(parameter, truth, 2.0 * truth, 8.0 * truth)
            continue
        for way in (-1.0, 1.0):
            starts = (truth * off**way for off in STEPS)
            start = next((value for value in starts if possible(item, {parameter: value})), None)
            if start is not None:
                yield Trial(parameter, truth, start)


def tried(name: str, trial: Trial, seed: int = 7) -> Outcome:
    """A fit of one parameter, judged."""
    item, truth = bed(name), trial.truth
    rig = item.rig.with_values({trial.name: truth})
    built = logs_of(name, **{trial.name: truth})
    logs = [(f"log {i}", told_apart(noisy(log, seed + i), trial)) for i, log in enumerate(built)]
    upper = {} if trial.upper is None else {trial.name: trial.upper}
    given = FitOptions(start={trial.name: trial.start}, upper=upper, workers=1)
    try:
        result = identify_hydraulics(rig, logs, [trial.name], given)[trial.name]
        refused = result.status
    except InputError as error:
        return Outcome("inert", error.message)
    except InsufficientData as error:
        result, refused = None, error.message
    if result is None or result.interval is None:
        values = [share * truth for share in ELSEWHERE]
        rise = rise_of(item, rig, built, trial.name, values, PROBLEM.faint)
        return Outcome("untold" if rise < TOLD else "MISSED", f"{refused}, rise {rise:.3g}")
    low, high = result.interval
    if result.unit == "rad":  # whole turns are one
        turns = math.tau * round((truth - 0.5 * (low + high)) / math.tau)
        low, high = low + turns, high + turns
    words = f"{result.value:.5g} ({low:.5g} … {high:.5g}) {result.status}"
    if low <= truth <= high:
        return Outcome("back" if high - low < 0.5 * abs(truth) else "wide", words)
    off = max(low - truth, truth - high)
    stands = (result.value - truth) / result.std if result.std else math.nan
    words += (
        f", {stands:+.1f} errors, by the noise alone {drawn(item, rig, built, logs, trial):+.1f}"
    )
    if off < 0.5 * (high - low):
        return Outcome("beside", words)
    rise = rise_of(item, rig, built, trial.name, [result.value])
    return Outcome("twin" if rise < TOLD else "MISSED", f"{words}, rise {rise:.3g}")


def drawn(
    item: Bed, rig: Rig, built: Sequence[Record], logs: Sequence[tuple[str, Record]], trial: Trial
) -> float:
    """Where the noise of the logs alone would have a parameter, in standard errors off its truth:
    ``Σ Jᵀe/σ² / √(Σ JᵀJ/σ²)`` by the sensitivities J at the truth, all else known."""
    step = NEARBY * trial.truth
    others = item.logs(rig.with_values({trial.name: trial.truth + step}))
    pull = known = 0.0
    for true, other, (_, seen) in zip(built, others, logs, strict=True):
        for channel, y in seen.channels.items():
            if (word := channel.rpartition(".")[2]) in COMPARED:
                slope = (other[channel] - true[channel]) / (step * NOISE[word])
                pull += float(slope @ (y - true[channel])) / NOISE[word]
                known += float(slope @ slope)
    return pull / math.sqrt(known) if known > 0.0 else math.nan


def told_apart(log: Record, trial: Trial) -> Record:
    """A log without the channel that a fit takes in the place of the parameter on trial."""
    given = {"supply.pressure": "p_supply", "supply.tank_pressure": "p_tank"}.get(trial.name)
    return replace(log, channels={n: y for n, y in log.channels.items() if n != given})


def rise_of(
    item: Bed,
    rig: Rig,
    built: Sequence[Record],
    parameter: str,
    values: Sequence[float],
    faint: float = 0.0,
) -> float:
    """How much −2 log likelihood of what a rig made rises at most at other values of a parameter,
    everything begun where the logs begin; a channel that changes by no more than a share ``faint``
    of its spread does not count."""
    maximum = 0.0
    for value in values:
        if not possible(item, {parameter: value}):
            continue
        others = item.logs(rig.with_values({parameter: value}))
        rise = 0.0
        for log, other in zip(built, others, strict=True):
            for channel, y in log.channels.items():
                word = channel.rpartition(".")[2]
                off = other[channel] - y
                if word in COMPARED and rms(off) > faint * np.std(y):
                    rise += float(np.sum((off / NOISE[word]) ** 2))
        maximum = max(maximum, rise)
    return maximum


def offered(name: str) -> list[str]:
    """What a bed is for: every parameter of a shipped rig, of another what no shipped one has."""
    every = bed(name).rig.parameters()
    if name in SHIPPED:
        return list(every)
    known = bed({"slide": "slide_servo"}.get(name.partition(",")[0], "crane_proportional"))
    return [item for item in every if item not in known.rig.parameters()]


def seed_of(name: str, parameter: str, draw: int = 0) -> int:
    """Of a noise of its own for every parameter of a bed: shipped rigs differ in their channels,
    beds with other parts have those of the slide or the crane."""
    own = max(0, BEDS.index(name) - len(SHIPPED) + 1)
    return 100_000 * own + 1_000 * draw + 10 * list(bed(name).rig.parameters()).index(parameter)


def study(name: str, requested: Sequence[str] = (), draws: int = 1) -> Counter[str]:
    """What a bed is for, or what is asked of it, a line a fit; how often each came of it. Of more
    draws of the noise than one, fits start from the first place alone."""
    counts: Counter[str] = Counter()
    for parameter in requested or offered(name):
        every = list(trials(name, parameter))
        some = every if draws == 1 else every[:1]
        for draw, trial in product(range(draws), some):
            begun = time.process_time()
            result = tried(name, trial, seed_of(name, parameter, draw))
            counts[result.kind] += 1
            share = f"{trial.start / trial.truth:.3g} of {trial.truth:.5g}"
            seconds = f"{time.process_time() - begun:.1f} s"
            print(
                f"{result.kind:7}", name, parameter, share, "→", result.words, seconds, flush=True
            )
    print(name, dict(counts), flush=True)
    return counts


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if not word.startswith("seeds=")]
    seeds = [int(word.removeprefix("seeds=")) for word in sys.argv[1:] if word not in words]
    total: Counter[str] = Counter()
    for each in [words[0]] if words else BEDS:
        total += study(each, words[1:], *seeds)
    print("all", dict(total))
