"""What becomes of fits whose rig files have another number wrong, which they hold: how far off the
estimates are by their intervals, what validation says, what fit and verdict say they lean on.

python -m tools.studies.held_study                        # every held number of every rig
python -m tools.studies.held_study slide_servo fatigue    # of some rigs
python -m tools.studies.held_study sound 10               # nothing wrong: draws of the noise a rig
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, HydraulicsFit, identify_hydraulics
from ehbench.validation import Validation, validate_rig
from tests.shared import RIGS
from tools.virtual_logs import DRIVES, virtual_log

FITTED, JUDGED = ("quick steps", "chirp"), "steps"
CHANNELS = ("v", "p_head", "p_rod")
BEGIN = 0.8  # of the truth, where the bulk modulus is begun
# the slide against a stiff specimen, its servo valve late, driven by noise up to 60 Hz; it records
# positions and speeds, and no pressures
FATIGUE = "fatigue"
DELAY, SPECIMEN, MASS = "1 ms", "20 kN/mm", "60 kg"
RIG_NAMES = (*DRIVES, FATIGUE)


class Held(NamedTuple):
    """What a rig file has wrong, in words, and the machine that makes the logs."""

    words: str
    machine: Rig


def rig_of(name: str) -> Rig:
    """A shipped rig, or the fatigue rig."""
    shipped = load_rig(RIGS / f"{drives_of(name)}.toml")
    if name != FATIGUE:
        return shipped
    tables = shipped.as_toml()
    tables["dynamics"]["late"] = {"kind": "delay", "delay": DELAY}
    tables["mechanism"]["mass"] = MASS
    press = dict(tables["cylinder"][0])
    spring = {"kind": "spring", "stiffness": SPECIMEN, "free_length": "200 mm"}
    valve = {**press["valve"][0], "dynamics": ["spool", "late"]}
    return Rig.model_validate(
        {**tables, "cylinder": [{**press, "force": [spring], "valve": [valve]}]}
    )


def drives_of(name: str) -> str:
    """The shipped rig whose start and commands a rig takes."""
    return "slide_servo" if name == FATIGUE else name


def moved_of(name: str, rig: Rig) -> tuple[str, str]:
    """(the cylinder that is driven, its joint)."""
    who = next(iter(DRIVES[drives_of(name)][0])).split(".")[0]
    return who, next(item.joint for item in rig.cylinder if item.name == who)


def held_wrong(name: str, rig: Rig) -> Iterator[Held]:
    """Numbers that logs feel, each held wrong by what is usual for it."""
    known, (who, joint) = rig.parameters(), moved_of(name, rig)
    cylinder = next(item for item in rig.cylinder if item.name == who)

    def scaled(by: float, *names: str) -> Rig:
        return rig.with_values({item: by * float(known[item]) for item in names})

    series = list(dict.fromkeys(item for valve in cylinder.valve for item in valve.series))
    delays = [f"{item}.delay" for item in series if f"{item}.delay" in known]
    for off in (0.5, 1.0, 1.5, 2.0) if delays else ():
        late = {delay: float(known[delay]) + 1e-3 * off for delay in delays}
        yield Held(f"valve's delay {off:g} ms short", rig.with_values(late))
    first = next((item for item in series if f"{item}.natural_frequency" in known), None)
    if first is not None:
        yield Held("valve's frequency 25 % high", scaled(0.8, f"{first}.natural_frequency"))
        yield Held("valve's damping ratio 20 % low", scaled(1.25, f"{first}.damping_ratio"))
    yield Held("oil volumes 20 % small", scaled(1.2, f"{who}.volume_head", f"{who}.volume_rod"))
    bored = f"{who}.bore" in known
    areas = (
        scaled(1.01, f"{who}.bore")
        if bored
        else scaled(1.02, f"{who}.area_head", f"{who}.area_rod")
    )
    yield Held("bore 1 % small", areas)
    if f"{joint}.mass" in known:
        yield Held("mass 10 % small", scaled(1.1, f"{joint}.mass"))


def late_logs(name: str) -> Iterator[tuple[str, str, float]]:
    """(in words, a channel's word, by how much it is late [s]) of what a rig file does not have."""
    if name != FATIGUE:
        yield "commands 2 ms late", "command", 0.002
        yield "head pressure 2 ms late", "p_head", 0.002
    yield "speed 2 ms late", "v", 0.002


def parameters_of(name: str, rig: Rig) -> list[str]:
    """What is fitted: bulk modulus, damping, and friction where it has bounds."""
    who, joint = moved_of(name, rig)
    known = rig.parameters()
    required = ("bulk_modulus", f"{joint}.damping", f"{joint}.joint_damping")
    bounded = (f"{who}.friction_coulomb",)
    return [item for item in required if item in known] + [
        item for item in bounded if item in known and known[item].upper is not None
    ]


def log_of(
    name: str,
    machine: Rig,
    kind: str,
    seed: int,
    late: tuple[str, float] = ("", 0.0),
    seconds: float = 4.0,
) -> Record:
    """A log of a machine, of which a channel may be late; of the test rig at most 3 s."""
    given = None
    if name == FATIGUE:
        seconds = min(seconds, 3.0)
        rng, t = np.random.default_rng(100 + seed), np.arange(round(seconds * 1e3) + 1) * 1e-3
        spectrum = np.fft.rfft(rng.standard_normal(t.size))
        spectrum[np.fft.rfftfreq(t.size, 1e-3) > 60.0] = 0.0
        given = {"press.servo": 1.6 * np.fft.irfft(spectrum, t.size) * (t > 0.2)}
    log = virtual_log(drives_of(name), machine, kind, seed, seconds, commands=given)
    out = ("qd",) if given is None else ("qd", "p_head", "p_rod")
    who, channels = moved_of(name, machine)[0], {}
    for channel, y in log.channels.items():
        cylinder, _, word = channel.rpartition(".")
        if word in out:
            continue
        if late[0] == word and cylinder.split(".")[0] == who:
            sign = -1.0 if word == "command" else 1.0  # late commands are written ahead of time
            y = np.interp(log.t - sign * late[1], log.t, y)
        channels[channel] = y
    return replace(log, channels=channels)


def fitted(
    name: str,
    rig: Rig,
    machine: Rig,
    seed: int = 7,
    late: tuple[str, float] = ("", 0.0),
    kinds: Sequence[str] = FITTED,
    seconds: float = 4.0,
) -> HydraulicsFit:
    """A rig fitted to logs of a machine, one a kind."""
    logs = [
        (kind, log_of(name, machine, kind, seed + i, late, seconds)) for i, kind in enumerate(kinds)
    ]
    start = {"bulk_modulus": BEGIN * float(rig.oil.bulk_modulus)}
    options = FitOptions(start=start, workers=1)
    return identify_hydraulics(rig, logs, parameters_of(name, rig), options)


def judged(
    name: str, rig: Rig, machine: Rig, seed: int = 77, late: tuple[str, float] = ("", 0.0)
) -> Validation:
    """A rig judged on a log of a machine that it was not fitted to."""
    return validate_rig(rig, [(JUDGED, log_of(name, machine, JUDGED, seed, late))], CHANNELS)


def off_by(fit: HydraulicsFit, rig: Rig) -> list[tuple[float, float, str]]:
    """(half widths that an estimate is off by, share of the truth, name), the worst first."""
    results = []
    for parameter in fit.parameters:
        if parameter.interval is not None:
            truth = float(rig.parameters()[parameter.name])
            low, high = parameter.interval
            half = max(abs(end - parameter.value) for end in (low, high)) or 1e-300
            side = (
                high - parameter.value if truth > parameter.value else parameter.value - low
            ) or half
            share = (parameter.value - truth) / truth if truth else float("nan")
            results.append((abs(parameter.value - truth) / side, share, parameter.name))
    return sorted(results, reverse=True)


def study(names: Sequence[str]) -> None:
    """Every held number of some rigs, a line each, and how often they are told."""
    counts: dict[str, Counter[str]] = {}
    for name in names:
        rig = rig_of(name)
        cases = [(item.words, item.machine, ("", 0.0)) for item in held_wrong(name, rig)]
        cases += [(words, rig, (word, late)) for words, word, late in late_logs(name)]
        for words, machine, late in cases:
            fit = fitted(name, rig, machine, late=late)
            verdict = judged(name, fit.rig, machine, late=late)
            halves, share, worst = off_by(fit, rig)[0]
            message = ", ".join(f"{lean.name} ({lean.explains:.2f})" for lean in fit.leans)
            fixed = any("is held" in text for text in fit.warnings)
            row = counts.setdefault(words, Counter())
            wrong = halves > 1.0
            row["fits"] += 1
            row["wrong"] += wrong
            row["wrong, accepted"] += wrong and verdict.accepted
            row["wrong, accepted, told"] += wrong and verdict.accepted and bool(fit.leans)
            row["right, told"] += not wrong and bool(fit.leans)
            print(
                f"{name} | {words} | {worst} {100.0 * share:+.1f} %, {halves:.2g} halves | "
                f"{verdict.verdict} | {message or '–'} | {'a gain' if fixed else ''} "
                f"{'left over' if fit.left_over else ''} "
                f"{'late' if any('behind the model' in t for t in fit.warnings) else ''}",
                flush=True,
            )
    for words, row in counts.items():
        print(words, dict(row))


def study_sound(seeds: int) -> None:
    """Rig files that have every number right."""
    cries = tries = missed = 0
    for name in RIG_NAMES:
        rig = rig_of(name)
        for seed in range(seeds):
            fit = fitted(name, rig, rig, 1000 + 10 * seed)
            tries, cries = tries + 1, cries + bool(fit.leans)
            missed += off_by(fit, rig)[0][0] > 1.0
            for lean in fit.leans:
                print(name, seed, lean.sentence, flush=True)
        print(
            f"{cries} told of {tries} up to {name}; {missed} have an estimate beyond its interval",
            flush=True,
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["sound"]:
        study_sound(int(sys.argv[2]))
    else:
        study(sys.argv[1:] or RIG_NAMES)
