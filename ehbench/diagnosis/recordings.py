"""What a log says by itself: whether its payload and channels are those that its recipe states,
whether stroke and angle agree with the pins, and what each channel's residual goes along with."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ehbench.data.record import Record
from ehbench.diagnosis.cases import DOMINANT, QUIET, Case, counts, total
from ehbench.plant.foreign import model_of
from ehbench.plant.ties import RECORDED, SUPPLY, supplied
from ehbench.preprocessing.observations import column, payload_of
from ehbench.preprocessing.plausibility import off_pins
from ehbench.signals.series import correlation_band
from ehbench.vocabulary import EhbenchError, Message, message
from ehbench.vocabulary.quantities import GAUGES

NONE = "none"
Otherwise = tuple[Case, str, dict[str, str]]  # a log as it may be, its message and fields
EXCHANGED = 0.8  # share that an exchange must explain, more than where a sign is turned
ASTRAY = 0.5  # rms residual, share of the spread, from which channels may be exchanged
_KEYS = {
    "pins": ("phase", "retracted_length", "l_a", "l_b"),
    "rack": ("radius", "retracted_angle"),
}
STILL = 0.05  # share of the largest speed below which no direction is told


def misread(case: Case, before: Case | None = None) -> Iterator[Message]:
    """A note on a log that is followed much better with another payload, its own supply pressure,
    or two channels exchanged, with what to write.

    Args:
        case: the log and its model.
        before: the same with the model before it was fitted, which exchanged channels spoil.
    """
    if case.model.rig.model is not None or not case.channels:
        return
    case = replace(case, refined=False)
    left = _left(case)
    astray = left is None or is_astray(case, left)
    others = (*_set_up(case), *(_exchanged(case) if astray else ()))
    best = _best(case, left, others)
    if best is None and astray and before is not None:
        before = replace(before, refined=False)
        best = _best(before, _left(before), _exchanged(before))
    if best is None or not best[1]:
        return
    share, key, fields = best
    cause = message(f"diagnosis.{key}", log=case.name, share=share, **fields)
    remedy = message(f"diagnosis.write_{key}", log=case.name, **fields)
    yield message("diagnosis.misread", cause=cause, remedy=remedy, share=share)


def is_astray(case: Case, left: np.ndarray) -> bool:
    """Whether what a model leaves of a cylinder is a good part of what the log shows of it."""
    sums: dict[str, np.ndarray] = {}
    for (name, y), part in zip(
        case.recorded.items(), np.split(left, len(case.recorded)), strict=True
    ):
        spread = y.size * (np.std(y) / case.scales[name]) ** 2
        owner, dot, _ = name.partition(".")
        if dot:  # a supply that stays shows no more than its noise
            sums[owner] = sums.get(owner, 0.0) + np.array([total([part]), spread])
    return any(rest > ASTRAY**2 * spread for rest, spread in sums.values())


def _left(case: Case) -> np.ndarray | None:
    """What the model leaves of a log; None where it cannot be simulated."""
    try:
        return case.left(case.simulated())
    except EhbenchError:
        return None


def _best(
    case: Case, left: np.ndarray | None, others: Iterable[Otherwise]
) -> tuple[float, str, dict[str, str]] | None:
    """The share of the residual ``left`` that the best of some explains, if that is most of it,
    with its message and fields.
    """
    if left is None or total([left]) < QUIET * left.size:
        return None
    now, noise, best = total([left]), case.noise_squares, None
    for other, key, fields in others:
        rest = _left(other)
        share = 0.0 if rest is None else min(1.0, (now - total([rest])) / (now - noise))
        if share > (best[0] if best else DOMINANT if key == "carried" else EXCHANGED):
            best = (share, key, fields)
    if best is None or not counts(best[0] * (now - noise), now, noise, case.independent(left)):
        return None
    return best


def _set_up(case: Case) -> Iterator[Otherwise]:
    """A log with each other payload of the rig, or with its supply's recorded pressure."""
    rig, said = case.model.bare, payload_of(case.record) or NONE
    for load in (NONE, *rig.payload):
        if load != said:
            model = model_of(rig, case.maps, None if load == NONE else load)
            yield replace(case, model=model), "carried", {"load": load, "said": said}
    if "p_supply" in case.record and not supplied(case.record):
        record = replace(case.record, meta={**case.record.meta, SUPPLY: RECORDED})
        yield replace(case, record=record), "supplied", {}


def _exchanged(case: Case) -> Iterator[Otherwise]:
    """A log with two of its channels exchanged: pressures of a cylinder, or of one end of two, or
    the commands of two valves, of two cylinders those of one name. A turned motion is tried beside
    them, which the preparation of a log tells.
    """
    record, rig = case.record, case.model.rig
    valves = [(cylinder.name, valve.name) for cylinder, valve in rig.valves()]
    pairs = [(f"{name}.p_head", f"{name}.p_rod") for name in case.cylinders]
    pairs += [
        (f"{one.name}.{end}", f"{other.name}.{end}")
        for one, other in combinations(rig.cylinder, 2)
        for end in ("p_head", "p_rod")
        if {one.name, other.name} & {*case.cylinders}
    ]
    pairs += [
        (f"{owner}.{first}.command", f"{other}.{second}.command")
        for (owner, first), (other, second) in combinations(valves, 2)
        if owner == other or first == second
    ]
    motions = [f"{name}.{word}" for name in case.cylinders for word in ("x", "q", "v", "qd")]
    changes = [("", {name: -record[name]}) for name in motions if name in record]
    changes += [
        ("exchanged", {first: record[second], second: record[first]})
        for first, second in pairs
        if first in record and second in record
    ]
    for key, given in changes:
        other = replace(case, record=replace(record, channels=record.channels | given))
        yield other, key, dict(zip(("first", "second"), given, strict=False))


def disagreements(cases: Sequence[Case]) -> Iterator[tuple[str, str, str, float]]:
    """(cylinder, sentence, remedy, error [m]) of each that disagrees, the worst log of each."""
    worst: dict[str, tuple[float, Case]] = {}
    for case in cases:
        for name, apart in off_pins(case.record, case.model).items():
            if name not in worst or abs(apart) > abs(worst[name][0]):
                worst[name] = (apart, case)
    for name, (off, case) in worst.items():
        rig = case.model.rig
        shown, by = rig.shown("x", abs(off), 3), rig.cylinder_named(name).linkage_word
        yield (
            name,
            f"{name}.x and {name}.q of {case.name} disagree with the {by} by {shown}",
            f"check the {by} of {name} ({', '.join(_KEYS[by])}) and the offset and sign "
            f"of {name}.x and {name}.q",
            off,
        )


@dataclass(frozen=True)
class Follows:
    """A channel of a log whose residual goes along with ``what`` more than chance lets it: their
    ``correlation``, and the half-width ``band`` within which it stays by chance in 95 %.
    """

    log: str
    channel: str
    what: str
    correlation: float
    band: float


def followed(case: Case, simulated: Record) -> Iterator[Follows]:
    """What the residuals of a case follow, channel by channel."""
    for channel in case.channels:
        values = column(simulated, channel, case.record)
        assert values is not None
        error = case.blocks(values) - case.recorded[channel]
        for what, cause in _causes(case, channel.rpartition(".")[0]).items():
            if 0.0 in (np.ptp(cause), np.ptp(error)):
                continue
            result = float(np.corrcoef(error, cause)[0, 1])
            band = correlation_band(error, cause)
            if abs(result) > band:
                yield Follows(case.name, channel, what, result, band)


def _causes(case: Case, cylinder: str) -> dict[str, np.ndarray]:
    """What an error may follow, in blocks."""
    record = case.record
    results = {
        f"command of {name.removesuffix('.command')}": case.blocks(record[name])
        for name in record.channels
        if name.startswith(f"{cylinder}.") and name.endswith(".command")
    }
    for word in ("v", "qd"):
        speed = column(record, f"{cylinder}.{word}", record)
        if speed is not None:
            slow = case.blocks(speed)
            moving = np.abs(slow) > STILL * float(np.max(np.abs(slow)))
            results |= {"speed": slow, "direction": np.where(moving, np.sign(slow), 0.0)}
            break
    for what, words in (("position", ("x", "q")), ("pressure", ("p_head", "p_rod", *GAUGES))):
        name = next((f"{cylinder}.{w}" for w in words if f"{cylinder}.{w}" in record), None)
        if name is not None:
            results[what] = case.blocks(record[name])
    return results | {"time": case.blocks(record.t)}
