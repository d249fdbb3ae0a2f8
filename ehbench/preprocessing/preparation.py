"""What a log must be before a rig is identified or judged on it: of this rig, evenly sampled, and
in the units it says.

A slip of a unit or a name gives a fit that looks like one. So every log passes here first: what
cannot be right is refused with what would be right, what is merely odd comes back as a warning."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ehbench.config.recipe.sensor import Sensor
from ehbench.config.rig import Cylinder, Rig
from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of, linkage_arrays
from ehbench.plant.ties import TIED, position_channel, supplied, tied_words
from ehbench.preprocessing.sensors import Term, known_taken_out, terms_of
from ehbench.signals.series import white_noise
from ehbench.signals.timestamps import Stamps, stamps_of
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError
from ehbench.vocabulary.quantities import GAUGES, VOCABULARY
from ehbench.vocabulary.units import factor, from_si

if TYPE_CHECKING:
    from ehbench.plant.model import Model

LEAST_SAMPLES = 3
EVEN = 0.01  # share of the sample time by which time may be off and still count as even
JITTER = 0.25  # share of the sample time by which a sample may be early or late and be put right
COARSE, FINE = 0.05, 1.0e-5  # [s]: no rig is logged slower, or faster
MOST_PERIODS = 5.0  # a sample time of more periods of a valve shows nothing of it
APART = 5.0  # factor between recorded and expected pressure beyond which the unit is wrong
FAR_APART = 50.0  # the same where only the supply is known: chambers may well stand far below it
LOADED = (
    0.03  # share of the supply's force beyond which a load is heavy enough to check pressures by
)
OVERSHOOT = 0.01  # share of a driver's range that a recorded command may lie outside of it
# share of the stroke within which a position stands still, of the supply by which pressures push
STILL, PUSHED = 1.0e-4, 0.1
ON = 0.01  # share of a command's range beyond which a valve is commanded
TRAVEL = 0.02  # share of the stroke beyond which a cylinder has surely moved
FIRST = 0.02  # [s] over which the first samples tell a speed
OFF_PINS = 0.005  # share of the stroke by which stroke and angle may disagree by the pins …
NOISES = 6.0  # … or so many of the standard deviations of their difference's noise
WORTH = 0.1  # share of a pressure's spread that a tied position's noise may be worth
ONGOING = 0.1  # share of the largest speed above which a log begins mid-motion
AGAINST = -0.5  # correlation of a gauge with what pressures push, below which it is turned
LIMITED = ("Pa", "N")  # units of what is asked whether its sensor was at its end
LIMIT_RUN = 4  # readings in a row at a sensor's limit …
LIMIT_SHARE = 2.0  # … so many times as many as at any other value …
LIMIT_RISE = 2  # … reached within so many samples …
LIMIT_STEPS = 5.0  # … over so many of its least steps
_MIXED = ("Pa", "kPa", "psi", "bar", "MPa")


@dataclass(frozen=True)
class PreparedLog:
    """A log as identification and validation take it: evenly sampled, what is known of its sensors
    taken out, for the rig of ``model``, which carries its payload. ``terms`` are the numbers of its
    sensors that are estimated, and known lags and delays; ``notes`` say what is odd about it.
    """

    name: str
    record: Record
    model: Model
    terms: tuple[Term, ...] = ()
    notes: tuple[str, ...] = ()


def prepare(name: str, record: Record, model: Model, sensors: Sequence[Sensor] = ()) -> PreparedLog:
    """A log prepared for a model.

    Args:
        name: of the log.
        record: as it was read.
        model: with the log's payload.
        sensors: what is known of its sensors and drivers, or estimated.

    Raises:
        InputError, LogError: as `preprocess`; a sensor of no channel of the log.
    """
    record = known_taken_out(name, record, sensors)
    terms = terms_of(sensors, [record])
    record, notes = preprocess(name, record, model)
    return PreparedLog(name, record, model, terms, notes)


def preprocess(name: str, record: Record, model: Model) -> tuple[Record, tuple[str, ...]]:
    """(the log, evenly sampled; what is odd about it) for a rig carrying the log's payload.

    Raises:
        LogError: not evenly sampled, with the worst gap.
        InputError: too few or too coarse samples, a sample that is no number, no channel of the
            rig, a command outside its valve's range, pressures that cannot be in the unit they say.
    """
    count = record.t.size
    if count < LEAST_SAMPLES:
        raise InputError(
            f"{name}: the log has only {count} sample{'s' * (count != 1)}",
            hint=f"at least {LEAST_SAMPLES} are needed",
        )
    for channel, values in record.channels.items():
        if not np.isfinite(values).all():
            when = record.t[int(np.argmin(np.isfinite(values)))]
            raise InputError(f"{name}: channel '{channel}' is not a number at t = {when:g} s")
    notes = list(_foreign(name, record, model.rig))
    _sample_time(name, record, model.rig)
    record, jitter = evened(name, record)
    notes += jitter
    if model.rig.payload and not record.meta.get("payload"):
        notes.append(
            "the log names no payload: taken as unloaded (the rig has "
            f"{', '.join(model.rig.payload)})"
        )
    _commands(name, record, model.rig)
    rest = model.rest_samples(model.commands_of(record))
    begun = _begun(record, model.rig, rest)
    _pressures(name, record, model, rest, still=not begun)
    notes += [
        *begun,
        *_stuck(record, model.rig),
        *_limited(record, model.rig),
        *_apart(record, model),
        *_against(record, model.rig),
        *_backwards(record, model.rig),
    ]
    notes += outside_stroke(record, model.rig)
    return record, (*notes, *_tied(name, record, model))


def _tied(name: str, record: Record, model: Model) -> list[str]:
    """What is to be said of a log whose motion is tied in.

    Raises:
        InputError: it has no position to tie to, or not all that a given motion needs.
    """
    words, rig = tied_words(record), model.rig
    fed = ["the supply's pressure is the recording's: nothing is told of the supply"]
    fed = fed if supplied(record) else []
    if not words:
        return fed
    seen = {c.name: position_channel(record, c.name) for c in rig.cylinder}
    message = record.meta[TIED]
    if not any(seen.values()):
        needed = " or ".join(f"{rig.cylinder[0].name}.{word}" for word in ("x", "q"))
        raise InputError(
            f'{name}: tied = "{message}", and the log has no position of a cylinder',
            hint=f"it needs one such as {needed}",
        )
    tied = {c.joint for c in rig.cylinder if seen[c.name]}
    lacking = [joint for joint in model.layout.joints if joint not in tied]
    if "qd" in words and lacking:
        raise InputError(
            f'{name}: tied = "{message}" gives the motion of every joint, and the log has no '
            f"position that tells that of {', '.join(lacking)}",
            hint='tied = "position" needs none of them',
        )
    channels = ", ".join(filter(None, seen.values()))
    if "qd" not in words:
        return [*fed, f"the simulation is tied to {channels}: no position is judged"]
    return [
        *fed,
        f"the simulation is tied to the motion of {channels}: pressures are judged, and no "
        "position, rate or ringing; nothing is told of masses, loads, damping and friction",
        *_coarse(record, model),
    ]


def _coarse(record: Record, model: Model) -> list[str]:
    """Warnings of positions whose noise, given as motion, is worth much pressure."""
    results = []
    for index, row in enumerate(model.plant.cylinders):
        cylinder = model.layout.cylinders[index]
        channel = position_channel(record, cylinder)
        noise = white_noise(record[channel]) if channel else 0.0
        x = 0.5 * float(row.stroke)
        lever = linkage_arrays(row, np.array([joint_of(row, x)]))[1][0]
        noise *= 1.0 if channel == f"{cylinder}.x" else abs(float(lever))
        for side, area, volume in (
            ("head", row.area_head, row.volume_head + row.area_head * x),
            ("rod", row.area_rod, row.volume_rod + row.area_rod * (row.stroke - x)),
        ):
            pressure = f"{cylinder}.p_{side}"
            spread = float(np.std(record[pressure])) if pressure in record else 0.0
            worth = float(row.bulk_modulus * area / volume) * noise
            if worth > WORTH * spread > 0.0:
                results.append(
                    f"the noise of {channel} is worth {_shown(model.rig, worth)} of {pressure}, "
                    f"{100.0 * worth / spread:.0f} % of its spread, so the bulk modulus comes out "
                    'too low: tied = "position" does not'
                )
    return results


def evened(name: str, record: Record) -> tuple[Record, list[str]]:
    """The record on an even time base, and a sentence if that took resampling: readings
    interpolated, commands held.

    Raises:
        LogError: samples are missing, or their stamps are not those of one rate, early and late.
    """
    steps = np.diff(record.t)
    tick = record.sample_time
    if np.abs(steps - tick).max() <= EVEN * tick:
        return record, []
    even = (record.t[-1] - record.t[0]) / (record.t.size - 1)
    off = np.abs(steps - even)
    worst = int(np.argmax(off))
    if (
        off[worst] > (2.0 * JITTER + EVEN) * even
    ):  # a step ends in two samples, one early and one late
        stamps = stamps_of(record.t)
        if stamps is not None and stamps.even and not stamps.missing.any():
            return _on_beats(record, stamps)
        at = int(np.argmax(np.abs(steps - tick)))
        raise LogError(
            f"{name}: not evenly sampled: {steps[at] * 1e3:.4g} ms pass after t = "
            f"{record.t[at]:.6g} s, "
            f"{tick * 1e3:.4g} ms elsewhere",
            hint="use a window without gaps (start, stop), or, where only its stamps are not even, "
            'write rate = "…" in the map of its columns',
        )
    t = np.linspace(record.t[0], record.t[-1], record.t.size)
    fixed = np.searchsorted(record.t, t + (JITTER + EVEN) * even, side="right") - 1
    channels = {
        channel: values[fixed] if channel.endswith(".command") else np.interp(t, record.t, values)
        for channel, values in record.channels.items()
    }
    warning = (
        f"not evenly sampled: {steps[worst] * 1e3:.4g} ms after t = {record.t[worst]:.6g} s; "
        f"resampled to {1.0 / even:.5g} Hz"
    )
    return replace(record, t=t, channels=channels), [warning]


def _on_beats(record: Record, stamps: Stamps) -> tuple[Record, list[str]]:
    """A record with stamps that jitter on the beats of their rate, and a sentence on it: readings
    by straight lines between their stamps, commands each at its beat.
    """
    beats = record.t[0] - stamps.off[0] + stamps.period * stamps.number
    channels = {
        name: y if name.endswith(".command") else np.interp(beats, record.t, y)
        for name, y in record.channels.items()
    }
    early, late = 1e3 * max(0.0, -stamps.off.min()), 1e3 * max(0.0, stamps.off.max())
    rate = f"{1.0 / stamps.period:.5g} Hz"
    message = (
        f"its time stamps are up to {early:.3g} ms early and {late:.3g} ms late of an even {rate}: "
        "resampled as if they told when a sample was taken; where a recorder took it on time and "
        f'wrote it late, rate = "{rate}" in the map of columns says so'
    )
    return replace(record, t=beats, channels=channels), [message]


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """A name for each log: its file's stem, with the folder before it where others have the same,
    numbered if need be.
    """
    names = [Path(path.name.removesuffix(".gz")).stem for path in paths]
    crowd = Counter(names)
    names = [
        f"{path.parent.name}_{name}" if crowd[name] > 1 else name
        for path, name in zip(paths, names, strict=True)
    ]
    return numbered(names)


def numbered(names: Sequence[str]) -> list[str]:
    """The names, those that come again numbered from the second on."""
    seen: Counter[str] = Counter()
    results = []
    for name in names:
        seen[name] += 1
        results.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return results


def _foreign(name: str, record: Record, rig: Rig) -> list[str]:
    """Warnings of channels that belong to nothing on the rig; refuses a log of which no cylinder
    has any.
    """
    cylinders = {c.name for c in rig.cylinder}
    valves = {f"{c.name}.{v.name}" for c, v in rig.valves()}
    known = cylinders | set(rig.joint_names) | valves | set(rig.all_edges())
    odd: dict[str, list[str]] = {}
    for channel in record.channels:
        head = channel.rpartition(".")[0]
        if head and head not in known:
            owner = head.partition(".")[0]
            odd.setdefault(head if owner in cylinders else owner, []).append(channel)
    sentences = []
    for owner, channels in odd.items():
        near = get_close_matches(owner, valves if "." in owner else cylinders, 1)
        what = (
            "a valve" if all(channel.endswith(".command") for channel in channels) else "a cylinder"
        )
        some = ", ".join(f"'{channel}'" for channel in channels[:3]) + ", …" * (len(channels) > 3)
        sentences.append(
            f"the log has {some}, {what} that rig '{rig.name}' does not have"
            + (f"; nearest is '{near[0]}'" if near else "")
        )
    if not any(channel.partition(".")[0] in cylinders for channel in record.channels):
        raise InputError(
            f"{name}: no channel is of a cylinder of rig '{rig.name}'"
            + (f": {sentences[0]}" if sentences else ""),
            hint="it has "
            + ", ".join(c.name for c in rig.cylinder)
            + "; the log has "
            + ", ".join(record.channels),
        )
    return sentences


def _sample_time(name: str, record: Record, rig: Rig) -> None:
    """Refuse a time that can only be in another unit than it says."""
    tick = record.sample_time
    used = {item for _, valve in rig.valves() for item in valve.series}
    periods = [rig.dynamics[item].period() for item in used]
    maximum = min([COARSE, *(MOST_PERIODS * period for period in periods)])
    if tick > maximum:
        raise InputError(
            f"{name}: {tick:g} s pass between samples, too long to see this rig move; at most "
            f"{maximum * 1e3:.3g} ms would do",
            hint="is the time in ms?",
        )
    if tick < FINE:
        raise InputError(
            f"{name}: only {tick:.3g} s pass between samples, {np.ptp(record.t):.3g} s in all",
            hint="is the time in s, not in ms?",
        )


def _commands(name: str, record: Record, rig: Rig) -> None:
    """Refuse commands that no driver of the rig takes."""
    for cylinder, valve in rig.valves():
        channel = f"{cylinder.name}.{valve.name}.command"
        if channel not in record:
            continue
        low, high = float(valve.command_min), float(valve.command_max)
        slack = OVERSHOOT * (high - low)
        out = np.flatnonzero((record[channel] < low - slack) | (record[channel] > high + slack))
        if out.size:
            raise InputError(
                f"{name}: {channel} = {record[channel][out[0]]:g} V at t = {record.t[out[0]]:g} s "
                f"lies outside {low:g} to {high:g} V",
                hint="check the unit, and command_min and command_max of the rig file",
            )


def _shown(rig: Rig, pressure: float) -> str:
    unit = rig.unit_of("p_head")
    return f"{from_si(pressure, unit, VOCABULARY['p_head']):.3g} {unit}"


def _right(ratio: float) -> str:
    """A hint which mistake of units makes a pressure ``ratio`` times as large as it should be."""
    pairs = [
        (abs(math.log(ratio * factor(b, "Pa") / factor(a, "Pa"))), a, b)
        for a in _MIXED
        for b in _MIXED
        if a != b
    ]
    miss, a, b = min(pairs)
    return "is the unit right?" + (
        f" it looks like {b} labelled {a}" if miss < math.log(1.3) else ""
    )


def _pressures(name: str, record: Record, model: Model, rest: int, still: bool) -> None:
    """Refuse pressures that neither the supply nor the load can have made."""
    rig, plant, names = model.rig, model.plant, model.layout
    supply = float(plant.supply.pressure)
    if "p_supply" in record:
        seen = float(np.percentile(record["p_supply"], 90))
        minimum = float(plant.supply.margin) or supply  # which a load-sensing pump may stand at
        if not minimum / APART <= seen <= supply * APART:
            raise InputError(
                f"{name}: p_supply is {_shown(rig, seen)}, while the supply of rig '{rig.name}' "
                f"holds {_shown(rig, supply)}",
                hint=_right(max(seen, 1.0) / supply),
            )
    try:
        start = model.start_of(record, rest)
    except EhbenchError:
        return  # a posture outside the stroke: the simulation says so
    for index, cylinder in enumerate(rig.cylinder):
        ends = {"p_head": f"{cylinder.name}.p_head", "p_rod": f"{cylinder.name}.p_rod"}
        seen = {word: record[channel] for word, channel in ends.items() if channel in record}
        if not seen:
            continue
        areas = dict(zip(ends, cylinder.areas(), strict=True))
        force = (
            start[names.state("p_head", index)] * areas["p_head"]
            - start[names.state("p_rod", index)] * areas["p_rod"]
        )
        carrying, other = ("p_head", "p_rod") if force > 0 else ("p_rod", "p_head")
        need = abs(force) / areas[carrying]
        peak = _peak(name, rig, cylinder, seen, supply, need)
        if len(seen) == 2 and peak < supply / FAR_APART and _fed(cylinder, record):
            raise InputError(
                f"{name}: {cylinder.name} is fed from a supply of {_shown(rig, supply)}, "
                f"and its pressures stay below {_shown(rig, peak)}",
                hint="is the unit right?",
            )
        light = need < LOADED * supply
        if not still or carrying not in seen or light or _at_end(record, cylinder, rest):
            continue
        back = 0.0
        if other in seen:
            back = float(np.mean(seen[other][:rest])) * areas[other] / areas[carrying]
        fixed = float(np.mean(seen[carrying][:rest])) - back
        # dry friction may hold a light load without oil, but not keep the pressures down in motion
        if (fixed < need / APART and peak < supply / APART) or (
            other in seen and fixed > need * APART
        ):
            raise InputError(
                f"{name}: at rest {cylinder.name}.{carrying} holds {_shown(rig, fixed)} against "
                f"its other end, while the load of rig '{rig.name}' asks for {_shown(rig, need)}",
                hint="is the unit right? and does the load hang free?",
            )


def _peak(
    name: str,
    rig: Rig,
    cylinder: Cylinder,
    seen: Mapping[str, np.ndarray],
    supply: float,
    need: float,
) -> float:
    """The largest pressure seen in a cylinder [Pa]; refuses one that nothing can have made.

    Args:
        supply: its pressure [Pa].
        need: pressure [Pa] that carries the load.
    """
    relief = 0.0 if cylinder.relief_pressure is None else float(cylinder.relief_pressure)
    peaks = {word: float(np.percentile(values, 99)) for word, values in seen.items()}
    for word, peak in peaks.items():
        if peak > APART * max(supply, relief, need):
            raise InputError(
                f"{name}: {cylinder.name}.{word} reaches {_shown(rig, peak)}, while the supply of "
                f"rig '{rig.name}' holds {_shown(rig, supply)}",
                hint="is the unit right?",
            )
    return max(peaks.values())


def _fed(cylinder: Cylinder, record: Record) -> bool:
    """Whether a recorded command opens an edge from the supply."""
    return any(
        (command := f"{cylinder.name}.{valve.name}.command") in record
        and bool(np.any(edge.sign * record[command] > edge.onset))
        for valve in cylinder.valve
        for edge in valve.edge
        if edge.from_ == "supply"
    )


def _at_end(record: Record, cylinder: Cylinder, rest: int) -> bool:
    """Whether the recorded stroke begins at an end stop, which carries what the oil does not."""
    channel = f"{cylinder.name}.x"
    if channel not in record:
        return False
    x = float(np.mean(record[channel][:rest]))
    return not TRAVEL < x / float(cylinder.stroke) < 1.0 - TRAVEL


def _span(cylinder: Cylinder, word: str) -> float:
    """A full stroke [m], or an angle [rad] of the size that a stroke makes."""
    return 1.0 if word in ("q", "qd") and cylinder.linkage is not None else float(cylinder.stroke)


def outside_stroke(record: Record, rig: Rig) -> list[str]:
    """Warnings of recorded strokes most of which lie outside of what their cylinders have: they
    count the other way, or from another zero.
    """
    result, unit = [], rig.unit_of("x")
    for cylinder in rig.cylinder:
        channel, stroke = f"{cylinder.name}.x", float(cylinder.stroke)
        if channel not in record:
            continue
        low, middle, high = np.percentile(record[channel], (0.0, 50.0, 100.0))
        if -TRAVEL * stroke <= middle <= (1.0 + TRAVEL) * stroke:
            continue
        turned = -TRAVEL * stroke <= -high and -low <= (1.0 + TRAVEL) * stroke
        ends = (from_si(float(end), unit, VOCABULARY["x"]) for end in (low, high, stroke))
        first, last, maximum = (f"{end:.4g}" for end in ends)
        requested = "is it counted the other way" if turned else "from where is it counted"
        key = "sign = -1" if turned else "neutral (offset of a sensor)"
        result.append(
            f"{channel} runs from {first} to {last} {unit}, and the stroke from 0 to {maximum} "
            f"{unit}: {requested}? Write {key} in the map of columns, or in [[sensor]] channel = "
            f'"{channel}"'
        )
    return result


def _stuck(record: Record, rig: Rig) -> list[str]:
    """Warnings of channels that stay constant while their cylinder moves, and of positions that
    stand still while command and pressures move.
    """
    results = []
    for cylinder in rig.cylinder:
        name, moves = cylinder.name, _travels(record, cylinder)
        pushed = not moves and _pushed(record, rig, cylinder)
        for word in ("q", "x", "qd", "v", "p_head", "p_rod", *GAUGES):
            if (channel := f"{name}.{word}") not in record:
                continue
            way, still = float(np.ptp(record[channel])), word in ("q", "x")
            if moves and way == 0.0:
                results.append(f"{channel} is constant while {name} moves: is the sensor stuck?")
            elif moves and still and way < STILL * _span(cylinder, word):
                results.append(f"{channel} stands still while {name} moves: is the sensor stuck?")
            elif pushed and still and way < STILL * _span(cylinder, word):
                results.append(
                    f"{channel} stands still while command and pressures of {name} move: is the "
                    "sensor stuck, or the cylinder held?"
                )
    return results


def _pushed(record: Record, rig: Rig, cylinder: Cylinder) -> bool:
    """Whether a command of a cylinder changes, and its pressures by a good part of what the supply
    has.
    """
    requested = any(
        (channel := f"{cylinder.name}.{valve.name}.command") in record
        and np.ptp(record[channel]) > ON * (float(valve.command_max) - float(valve.command_min))
        for valve in cylinder.valve
    )
    ends = [f"{cylinder.name}.{word}" for word in ("p_head", "p_rod")]
    maximum = max((float(np.ptp(record[end])) for end in ends if end in record), default=0.0)
    return requested and maximum > PUSHED * max(float(rig.supply.pressure), 1.0e6)


def at_limit(y: np.ndarray) -> np.ndarray:
    """Where a sensor's readings stand at the end of what it or its converter can tell, shape
    (samples,): at their largest or least, the very same one several times in a row, reached in a
    few samples and left again, while elsewhere they do not repeat like that.
    """
    result = np.zeros(y.size, bool)
    ends = np.flatnonzero(np.diff(y)) + 1
    starts, stops = np.concatenate([[0], ends]), np.concatenate([ends, [y.size]])
    length, level = stops - starts, y[starts]
    steps = np.abs(np.diff(level))
    if not steps.size:
        return result
    for end in (float(np.max(y)), float(np.min(y))):
        here = level == end
        usual = int(length[~here].max(initial=1))
        before = np.abs(end - y[np.maximum(starts - LIMIT_RISE, 0)])
        cut = here & (starts > 0) & (stops < y.size) & (length >= LIMIT_RUN)
        cut &= (length > LIMIT_SHARE * usual) & (before > LIMIT_STEPS * steps.min())
        if cut.any():
            result |= y == end
    return result


def _limited(record: Record, rig: Rig) -> list[str]:
    """Warnings of pressures and forces at the end of what their sensors can tell."""
    words = ("p_head", "p_rod", *GAUGES)
    names = [f"{cylinder.name}.{word}" for cylinder in rig.cylinder for word in words]
    results = []
    for name in [*names, "p_supply"]:
        if name not in record or not (there := at_limit(record[name])).any():
            continue
        first = int(np.argmax(there))
        results.append(
            f"{name} stands at {rig.shown(name, record[name][first])} in "
            f"{100 * np.mean(there):.2g} % of its samples, first at {record.t[first]:.6g} s, and "
            "never beyond: is that the end of its sensor's range? A fit does not count them, and a "
            "validation does not ask how far beyond the machine was"
        )
    return results


def off_pins(record: Record, model: Model) -> dict[str, float]:
    """By how much a log's stroke is above that of its angle and the rig file's pins [m], by
    cylinder: its level where that is off, else where it is worst; cylinders that agree left out.
    """
    results = {}
    for index, cylinder in enumerate(model.rig.cylinder):
        names = [f"{cylinder.name}.{word}" for word in ("x", "q")]
        if cylinder.linkage is None or any(name not in record for name in names):
            continue
        x, q = (record[name] for name in names)
        off = x - linkage_arrays(model.plant.cylinders[index], q)[0]
        noise = math.sqrt(float(np.mean(np.diff(off, 3) ** 2)) / 20.0) if off.size > 3 else 0.0
        level, maximum = float(np.median(off)), float(off[np.argmax(np.abs(off))])
        allowed = max(OFF_PINS * float(cylinder.stroke), NOISES * noise)
        if abs(level) > allowed:
            results[cylinder.name] = level
        elif abs(maximum) > 2.0 * allowed:
            results[cylinder.name] = maximum
    return results


def _apart(record: Record, model: Model) -> list[str]:
    """Warnings of strokes that disagree with angle and pins."""
    unit, result = model.rig.unit_of("x"), []
    for name, off in off_pins(record, model).items():
        shown = f"{abs(from_si(off, unit, VOCABULARY['x'])):.3g} {unit}"
        way, by = "above" if off > 0.0 else "below", model.rig.cylinder_named(name).linkage_word
        result.append(
            f"{name}.x is {shown} {way} what {name}.q and the {by} make it: check the {by}, "
            f'or give the sensor\'s offset ([[sensor]] channel = "{name}.x")'
        )
    return result


def _against(record: Record, rig: Rig) -> list[str]:
    """Warnings of gauges that go down as the pressures beside them push more: friction apart, all
    of `GAUGES` go up with them, so the sign of the one or the ends of the others are turned.
    """
    results = []
    for cylinder in rig.cylinder:
        ends = [f"{cylinder.name}.p_head", f"{cylinder.name}.p_rod"]
        if not all(end in record for end in ends):
            continue
        head, rod = (record[end] for end in ends)
        area_head, area_rod = cylinder.areas()
        for word in GAUGES:
            name = f"{cylinder.name}.{word}"
            pushed = head - rod if word == "load_pressure" else head * area_head - rod * area_rod
            if name not in record or not np.std(record[name]) > 0.0 or not np.std(pushed) > 0.0:
                continue
            if np.corrcoef(record[name], pushed)[0, 1] < AGAINST:
                results.append(
                    f"{name} falls where p_head and p_rod push more: sign = -1 of it in the map of "
                    "columns, or head and rod are the wrong way round"
                )
    return results


def _backwards(record: Record, rig: Rig) -> list[str]:
    """Warnings of positions and speeds that go down while the commands extend a cylinder, and up
    while they retract it: with a sign turned nothing follows the model, and a fit goes astray.
    """
    results = []
    for cylinder in rig.cylinder:
        ways = _ways(cylinder, record)
        ends = np.flatnonzero(np.diff(ways, prepend=0.0, append=0.0))
        if ends.size < 2:
            continue
        each = ways[ends[:-1]]
        sign = 1 if cylinder.linkage is None else cylinder.linkage.sign
        for word, turn in (("x", 1), ("v", 1), ("q", sign), ("qd", sign)):
            channel = f"{cylinder.name}.{word}"
            if channel not in record:
                continue
            y = turn * record[channel]
            y = y if word in ("x", "q") else np.cumsum(y) * record.sample_time
            gone = np.diff(y[np.minimum(ends, y.size - 1)])[each != 0.0]
            all_ = float(np.sum(np.abs(gone)))
            if all_ > TRAVEL * _span(cylinder, word) and (
                float(np.sum(each[each != 0.0] * gone)) < AGAINST * all_
            ):
                falls = "falls" if turn > 0 else "rises"
                results.append(
                    f"{channel} {falls} while the commands extend {cylinder.name}: is its sign "
                    "turned (sign = -1 in the map of columns), that of a command, or are head and "
                    "rod the wrong way round?"
                )
    return results


def _ways(cylinder: Cylinder, record: Record) -> np.ndarray:
    """Which way the commands move a cylinder at each sample: 1 out, −1 in, 0 neither, or where
    edges of both ways are open. Edges across the ports, and what pumps slip, count as none.
    """
    opened = np.zeros((2, record.t.size), dtype=bool)
    for valve in cylinder.valve:
        channel = f"{cylinder.name}.{valve.name}.command"
        for edge in valve.edge:
            if channel not in record or {edge.from_, edge.to} == {"head", "rod"}:
                continue
            out = "head" == edge.to or "rod" == edge.from_
            reach = edge.sign * record[channel]
            opened[0 if out else 1] |= reach > float(edge.deadband)
    return opened[0].astype(float) - opened[1].astype(float)


def _travels(record: Record, cylinder: Cylinder) -> bool:
    """Whether a position, or the integral of a speed, changes by more than sensors err."""
    for word in ("q", "x", "qd", "v"):
        channel = f"{cylinder.name}.{word}"
        if channel not in record:
            continue
        way = (
            record[channel]
            if word in ("q", "x")
            else np.cumsum(record[channel]) * record.sample_time
        )
        if np.ptp(way) > TRAVEL * _span(cylinder, word):
            return True
    return False


def moving_at_first(record: Record, rig: Rig, rest: int) -> tuple[str, ...]:
    """Cylinders that move at the first sample, by their rate or by what their position does in the
    first samples, of ``rest`` before a command changes.
    """
    results = []
    for cylinder in rig.cylinder:
        if not _travels(record, cylinder):
            continue
        for word in ("qd", "v", "q", "x"):
            channel = f"{cylinder.name}.{word}"
            if channel in record:
                shows = _begins_fast if word in ("qd", "v") else _begins_sloped
                if shows(record[channel], rest, record.sample_time):
                    results.append(cylinder.name)
                break
    return tuple(results)


def _begins_fast(speed: np.ndarray, rest: int, tick: float) -> bool:
    count = min(rest, max(1, round(FIRST / tick)))
    noise = 1.5 * float(np.median(np.abs(np.diff(speed)))) / math.sqrt(count)
    return abs(float(np.mean(speed[:count]))) > ONGOING * float(np.abs(speed).max()) + 4.0 * noise


def _begins_sloped(place: np.ndarray, rest: int, tick: float) -> bool:
    count = min(rest, max(8, round(2.5 * FIRST / tick)))
    if count < 8:
        return False
    jumps = np.abs(np.diff(place))
    noise = 1.5 * float(np.median(jumps)) * math.sqrt(12.0 / count)
    if noise == 0.0 and jumps.any():  # an encoder that stands between two of its counts
        noise = 0.5 * float(np.min(jumps[jumps > 0.0]))
    way = float(np.polyfit(np.arange(count), place[:count], 1)[0]) * count
    maximum = (
        float(np.abs(place[count:] - place[:-count]).max()) if place.size > count else abs(way)
    )
    return abs(way) > ONGOING * maximum + 4.0 * noise


def on_at_first(record: Record, rig: Rig, rest: int) -> dict[str, float]:
    """Commands [V] that are already on at the first sample, by channel."""
    results = {}
    for cylinder, valve in rig.valves():
        channel = f"{cylinder.name}.{valve.name}.command"
        if channel not in record:
            continue
        first = float(np.median(record[channel][:rest]))
        minimum = ON * (float(valve.command_max) - float(valve.command_min))
        if any(edge.sign * first > float(edge.deadband) + minimum for edge in valve.edge):
            results[channel] = first
    return results


def _begun(record: Record, rig: Rig, rest: int) -> list[str]:
    """Warnings of what is already on, or already moves, at the first sample."""
    sentences = [
        f"{channel} is already on at the first sample ({first:g} V): the start is taken from the "
        "first samples"
        for channel, first in on_at_first(record, rig, rest).items()
    ]
    return sentences + [
        f"{cylinder} already moves at the first sample: the start is taken from the first samples"
        for cylinder in moving_at_first(record, rig, rest)
    ]
