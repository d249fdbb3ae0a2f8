"""How often `identify --suggest` puts the cure of a built fault first, and how often it has one for
a sound model.

python -m tools.studies.suggestion_study slide_servo      # every fault of a rig, and none
python -m tools.studies.suggestion_study slide_servo "valve full at 60 %" friction    # some of them
python -m tools.studies.suggestion_study slide_servo rounds=1      # nothing tried on top of one
another
python -m tools.studies.suggestion_study slide_servo seeds=3       # each on three draws of the
noise
python -m tools.studies.suggestion_study sound 40         # seeds a rig, 200 in all"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.guidance.suggestions import ROUNDS, Suggestions, suggest
from ehbench.identification.hydraulics import PreparedFit, prepare_fit
from ehbench.vocabulary.fields import Value
from tests.shared import RIGS
from tools.studies.structure_study import ALSO, KINDS, LONG, Fault, faults, log_of
from tools.virtual_logs import DRIVES

# parameters of the recipe itself
OWN = ("bulk modulus", "damping")
OPTIONS = ("rounds=", "seeds=")
ENOUGH = 600.0  # [s] of the clock, so that a machine with other work ends no sooner


def recipe_of(
    name: str, rig: Rig, fault: Fault, seed: int, kinds: Sequence[str], length: float
) -> tuple[PreparedFit, list[tuple[str, Record]]]:
    """A recipe of bulk modulus and damping, and logs of a faulty machine, each of a ``length``
    [s]."""
    who = next(iter(DRIVES[name][0])).split(".")[0]
    joint = next(item.joint for item in rig.cylinder if item.name == who)
    required = ("bulk_modulus", f"{joint}.damping", f"{joint}.joint_damping")
    parameters = [item for item in required if item in rig.parameters()]
    logs = [
        (f"log{i}", without_joints(log_of(name, fault, kind, seed + i, length)))
        for i, kind in enumerate(kinds)
    ]
    return prepare_fit(rig, logs, parameters), logs


def suggested(
    name: str,
    rig: Rig,
    fault: Fault,
    seed: int = 7,
    kinds: Sequence[str] = KINDS,
    seconds: float = ENOUGH,
    rounds: int = ROUNDS,
    length: float = LONG,
) -> Suggestions:
    """What is suggested for `recipe_of` these."""
    prepared, logs = recipe_of(name, rig, fault, seed, kinds, length)
    return suggest(prepared, logs, seconds=seconds, rounds=rounds)


def without_joints(log: Record) -> Record:
    """A log of cylinders alone: speeds are compared where the faults are, not joint rates."""
    retained = {name: y for name, y in log.channels.items() if not name.endswith(".qd")}
    return replace(log, channels=retained)


def right(result: Suggestions, fault: Fault) -> bool:
    """Whether the first row cures the fault by what it is, or by nothing where there is none."""
    kinds = {name.partition(" of ")[0] for name in result.rows[0].changes}
    if fault.kind in ("none", *OWN):
        return not kinds
    also = {fault.kind, *ALSO.get(fault.kind, ())}
    return bool(kinds & also)


def built(name: str, rig: Rig) -> Iterator[Fault]:
    """Every fault of a rig, and none; with air in the oil, which no residual is asked for."""
    yield Fault("none", "nothing wrong", rig)
    yield from faults(name, rig)
    airy = rig.oil.model_copy(update={"air_fraction": Value(0.04)})
    yield Fault("air", "4 % of air in the oil", rig.model_copy(update={"oil": airy}))


def study(name: str, requested: Sequence[str] = (), rounds: int = ROUNDS, seeds: int = 1) -> None:
    """Every fault of a rig, or those ``asked`` by their words, on some draws of the noise, a line
    each with the processor's seconds."""
    rig, hits, tries = load_rig(RIGS / f"{name}.toml"), Counter(), Counter()
    for fault in built(name, rig):
        for seed in range(seeds if not requested or fault.words in requested else 0):
            begun = time.process_time()
            result = suggested(name, rig, fault, 7 + 10 * seed, rounds=rounds)
            tries[fault.kind] += 1
            hits[fault.kind] += right(result, fault)
            first, seconds = result.rows[0], time.process_time() - begun
            message = f"{first.words}, {100.0 * first.misfit:.3g} %, {seconds:.0f} s"
            how = "first " if right(result, fault) else "MISSED"
            print(how, name, fault.words, "→", message, flush=True)
    print({kind: f"{hits[kind]} of {count}" for kind, count in tries.items()})


def study_sound(seeds: int) -> None:
    """Sound models of every rig."""
    cries = 0
    for name in DRIVES:
        rig = load_rig(RIGS / f"{name}.toml")
        for seed in range(seeds):
            result = suggested(name, rig, Fault("none", "", rig), 1000 + 10 * seed)
            if result.rows[0].changes:
                cries += 1
                print(name, seed, result.rows[0].words, flush=True)
        print(f"{cries} alarms up to {name}", flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "sound":
        study_sound(int(sys.argv[2]))
    else:
        words = [one for one in sys.argv[2:] if not one.startswith(OPTIONS)]
        given = dict(one.split("=") for one in sys.argv[2:] if one not in words)
        study(sys.argv[1], words, **{key: int(value) for key, value in given.items()})
