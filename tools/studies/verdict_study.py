"""How often validation rejects a sound model and accepts a wrong one, by check: random rigs, logs
that they record of themselves in random waves, noise and sampling rates, judged by the rig itself,
by one that is a little off, as a fit leaves it, and by wrong ones.

python -m tools.studies.verdict_study               # three shipped rigs that ring, 10 draws
each
python -m tools.studies.verdict_study 50 slide_servo       # 50 draws of one, any of
`virtual_logs.DRIVES`

Wrong models are judged on steps alone, and where the recording rings clearly. A silent check is one
of a model that does not ring."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ehbench.config.recipe import Thresholds, load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.plant.model import simulate
from ehbench.validation import LogResult, validate_rig
from ehbench.vocabulary.errors import EhbenchError
from tests.shared import RIGS
from tools.virtual_logs import DRIVES, commands_of, noisy

CHANNELS = {"slide_servo": ("x", "v", "p_head", "p_rod"), "pump_cylinder": ("x", "v", "p_head")}
ASKED = Thresholds(natural_frequency_error=0.15, damping_ratio_error=0.5)
# kind of wave and its share of the usual amplitude
WAVES = (("steps", 1.0), ("steps", 0.15), ("quick steps", 0.4), ("sine", 1.0), ("chirp", 1.0))
WAVES += (("ramps", 1.0),)
RINGING = ("slide_servo", "crane_proportional", "boom_four_valve")
STEPS = tuple(wave for wave in WAVES if "steps" in wave[0])
NOISY = (1.0, 3.0, 10.0)  # times the usual noise
EACH = (1, 2, 5, 10)  # of the samples at 1 kHz, one in so many is kept
DRAWN = 0.8  # spread of the logarithm of what a rig is drawn by
CLOSE = 0.03  # and of what a fit leaves
DAMPING = (".damping", ".joint_damping", ".friction_viscous")
GAINS = ("flow_gain", "compensated_gain", "displacement", "orifice_gain")
DRAWN_TOO = (*DAMPING, *GAINS, "bulk_modulus", ".natural_frequency", ".friction_coulomb")
RUBS = 2.0e5  # [Pa]
# models that are wrong: by what the damping and the stiffness of the oil are multiplied
WRONG = {
    "damping ×3": (3.0, 1.0),
    "damping ÷3": (1.0 / 3.0, 1.0),
    "frequency +25 %": (1.0, 1.25**2),
    "frequency −25 %": (1.0, 0.75**2),
    "damping ×20": (20.0, 1.0),
    "oil 30 times as stiff": (1.0, 30.0),
    "oil 30 times as soft": (1.0, 1.0 / 30.0),
}


def several(rig: Rig, rng: np.random.Generator, spread: float) -> Rig:
    """A rig whose oil, damping, friction, gains and valves are drawn about those of another."""
    known = rig.parameters()
    some = [n for n in known if n.endswith(DRAWN_TOO)]
    return rig.with_values({n: float(known[n]) * np.exp(spread * rng.normal()) for n in some})


def rubbing(rig: Rig, rng: np.random.Generator) -> Rig:
    """A rig whose cylinders rub, with forces up to `RUBS` times their head area."""
    forces = {c.name: RUBS * float(rng.uniform()) * float(c.areas()[0]) for c in rig.cylinder}
    return rig.with_values({f"{name}.friction_coulomb": f for name, f in forces.items()})


def wrong_ones(rig: Rig) -> Iterator[tuple[str, Rig]]:
    """By what is wrong with them."""
    known = rig.parameters()
    for kind, (damping, stiffness) in WRONG.items():
        values = {n: damping * float(v) for n, v in known.items() if n.endswith(DAMPING)}
        values |= {n: stiffness * float(v) for n, v in known.items() if n.endswith("bulk_modulus")}
        yield kind, rig.with_values(values)


def log_of(name: str, rig: Rig, wave: tuple[str, float], seed: int) -> Record:
    """A log of a rig, its noise and sampling rate drawn."""
    rng = np.random.default_rng(seed)
    kind, share = wave
    seconds = 6.0 if kind == "ramps" else 4.0
    given = commands_of(name, kind, np.arange(round(1000.0 * seconds) + 1) * 1e-3, share)
    built = simulate(rig, given, seconds, posture=DRIVES[name][2])
    log = noisy(built, seed, factor=float(rng.choice(NOISY)))
    every = slice(None, None, int(rng.choice(EACH)))
    return replace(log, t=log.t[every], channels={n: y[every] for n, y in log.channels.items()})


def judged(name: str, rig: Rig, log: Record) -> LogResult:
    """The one log's verdict."""
    channels = CHANNELS.get(name, ("q", "qd", "p_head", "p_rod"))
    return validate_rig(rig, [("log", log)], channels, ASKED).logs[0]


def outcome(result: LogResult) -> set[str]:
    """The checks that reject, without the channel's name; and whether any of the ringing does."""
    message = {
        check.what.split(" ", 1)[1] + " (silent)" * (check.reached is None)
        for check in result.checks
        if not check.passed
    }
    ringing = any(item.startswith(("natural", "damping")) for item in message)
    return {"models", *message} | ({"rejected by its ringing"} if ringing else set())


def study(name: str, draws: int) -> Counter[tuple[str, str]]:
    """Counts by (kind of model, check that rejects); each draw counts a wave of each kind."""
    plain, counts = load_rig(RIGS / f"{name}.toml"), Counter()
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        for index, wave in enumerate(WAVES):
            try:
                rig = several(rubbing(plain, rng), rng, DRAWN)
                log = log_of(name, rig, wave, 1000 * seed + index)
                models = [("sound", rig), ("close", several(rig, rng, CLOSE))]
                models += wrong_ones(rig) if wave in STEPS else []
            except EhbenchError:
                counts["no such rig", ""] += 1
                continue
            for kind, model in models:
                result = judged(name, model, log)
                if kind in WRONG and not any(w.judged for w in result.transients):
                    break
                counts.update((kind, item) for item in outcome(result))
                if kind not in WRONG:
                    for check in result.checks:
                        if not check.passed:
                            print(name, seed, *wave, kind, check.sentence, flush=True)
    return counts


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    names = [word for word in sys.argv[1:] if not word.isdigit()] or RINGING
    total: Counter[tuple[str, str]] = Counter()
    for each in names:
        total += study(each, *(numbers or [10]))
    for (kind, check), count in sorted(total.items()):
        print(f"{count:5} {kind}: {check}")
