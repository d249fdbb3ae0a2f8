"""What a log can be: checks of names, units, signs and sensors against a rig.

What cannot be right raises an error; the rest are notes."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import permutations

import numpy as np

from ehbench.config.rig import Cylinder, Rig, Valve
from ehbench.data.rates import is_bad, range_of
from ehbench.data.record import Record
from ehbench.parts.cylinder import chamber_oil, joint_of, linkage_arrays
from ehbench.plant.foreign import FmuModel
from ehbench.plant.model import Model
from ehbench.plant.ties import TIED, position_channel, supplied, tied_words
from ehbench.preprocessing.observations import noise_of
from ehbench.signals.series import stretches_of, white_noise
from ehbench.vocabulary import VOCABULARY, Message, from_si, listed, message, setting
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError
from ehbench.vocabulary.quantities import GAUGES
from ehbench.vocabulary.units import MIXED, factor

LEAST_SAMPLES = 3
_MOTION, _ENDS = ("q", "x", "qd", "v"), ("p_head", "p_rod")
LIMITED = ("Pa", "N")  # units of channels whose sensors may stand at the end of their range


@dataclass(frozen=True)
class PlausibilitySettings:
    """Numbers by which a log is refused, or noted as odd."""

    coarse: float = setting(0.05, "s", "largest sample time", "no rig is logged slower")
    fine: float = setting(1.0e-5, "s", "least sample time", "no rig is logged faster")
    periods: float = setting(5.0, "", "largest sample time in periods of a valve", "aliasing")
    apart: float = setting(5.0, "", "factor of a pressure in a wrong unit", "units differ by 7")
    far_apart: float = setting(50.0, "", "the same if only the supply is known", "low chambers")
    loaded: float = setting(0.03, "", "load that shows, of the supply's force", "friction")
    overshoot: float = setting(0.01, "", "commands beyond a driver's range, of it", "converters")
    still: float = setting(1.0e-4, "", "share of the stroke that is a standstill", "encoders")
    pushed: float = setting(0.1, "", "share of the supply by which pressures push", "friction")
    on: float = setting(0.01, "", "share of a command's range from which it is on", "its noise")
    travel: float = setting(0.02, "", "share of the stroke that is surely a motion", "sensors")
    first: float = setting(0.02, "s", "span of the first samples that show a speed", "short")
    off_pins: float = setting(0.005, "", "stroke against angle, share of the stroke", "assembly")
    noises: float = setting(6.0, "", "the same in standard deviations of noise", "never by chance")
    worth: float = setting(0.1, "", "a position's noise, of a pressure's spread", "10 %")
    ongoing: float = setting(0.1, "", "first speed of a motion, of the largest", "else it creeps")
    against: float = setting(-0.5, "", "correlation of a turned sign", "friction leaves more")
    latest: float = setting(2.0, "s", "delay between two recorders that is looked for", "by hand")
    stray: float = setting(0.1, "", "share of a way that no command explains", "loads move it")
    limit_run: int = setting(4, "", "equal readings in a row at a sensor's limit", "none by chance")
    limit_share: float = setting(2.0, "", "the same, in runs of other values", "coarse counts")
    limit_rise: int = setting(2, "", "samples within which a limit is reached", "else it settles")
    limit_steps: float = setting(5.0, "", "least steps over which it is reached", "else it settles")


SETTINGS = PlausibilitySettings()


def _recorded(
    record: Record, cylinder: Cylinder, *words: str
) -> Iterator[tuple[str, str, np.ndarray]]:
    """(word, channel, values) of what a log has of a cylinder among some words, in their order."""
    for word in words:
        if (channel := f"{cylinder.name}.{word}") in record:
            yield word, channel, record[channel]


def _commanded(
    record: Record, cylinders: Iterable[Cylinder]
) -> Iterator[tuple[Cylinder, Valve, str, np.ndarray]]:
    """(cylinder, valve, channel, values) of each command [V] that a log has."""
    for cylinder in cylinders:
        for valve in cylinder.valve:
            for _, channel, values in _recorded(record, cylinder, f"{valve.name}.command"):
                yield cylinder, valve, channel, values


def replay_notes(name: str, record: Record, model: Model) -> Iterator[Message]:
    """Notes on a log whose measured inputs are replayed.

    Raises:
        InputError: it has no position to replay, or not all that a given motion needs."""
    words, rig = tied_words(record), model.rig
    if supplied(record):
        yield message("preprocessing.supply_replayed")
    if not words:
        return
    seen = {c.name: position_channel(record, c.name) for c in rig.cylinder}
    tied = record.meta[TIED]
    if not any(seen.values()):
        cylinder = rig.cylinder[0].name
        text = message("preprocessing.no_position", log=name, tied=tied, cylinder=cylinder)
        raise InputError(text)
    joints = {c.joint for c in rig.cylinder if seen[c.name]}
    lacking = ", ".join(joint for joint in model.layout.joints if joint not in joints)
    if "qd" in words and lacking:
        text = message("preprocessing.motion_unknown", log=name, tied=tied, joints=lacking)
        raise InputError(text)
    channels = ", ".join(filter(None, seen.values()))
    if "qd" not in words:
        yield message("preprocessing.position_replayed", channels=channels)
        return
    yield message("preprocessing.motion_replayed", channels=channels)
    yield from _coarse(record, model)


def begins_elsewhere(record: Record, model: Model, rest: int) -> Iterator[Message]:
    """Notes on channels that an FMU whose ``start`` does not set them begins elsewhere than the
    ``rest`` samples of a log."""
    if not isinstance(model, FmuModel):
        return
    short = {channel: y[:LEAST_SAMPLES] for channel, y in record.channels.items()}
    part = replace(record, t=record.t[:LEAST_SAMPLES], channels=short)
    try:
        first = model.replay(part, start=model.rest_start(record, rest))
    except EhbenchError:  # which ends what the log is for
        return
    for channel in model.binding.names["channels"]:
        if channel not in record or model.starts(channel):
            continue
        seen, begins = float(np.mean(record[channel][: max(rest, 1)])), float(first[channel][0])
        noise, spread = noise_of(record, channel), float(np.std(record[channel]))
        if abs(begins - seen) > max(SETTINGS.noises * noise, SETTINGS.worth * spread):
            ends = {"begins": begins, "seen": seen}
            shown = {key: model.rig.shown(channel, value) for key, value in ends.items()}
            yield message("preprocessing.begins_elsewhere", channel=channel, **shown)


def _coarse(record: Record, model: Model) -> Iterator[Message]:
    """Warnings of positions whose noise, given as motion, is worth much pressure."""
    for index, row in enumerate(model.plant.cylinders):
        cylinder = model.layout.cylinders[index]
        channel = position_channel(record, cylinder)
        noise = noise_of(record, channel) if channel else 0.0
        x = 0.5 * float(row.stroke)
        lever = linkage_arrays(row, np.array([joint_of(row, x)]))[1][0]
        noise *= 1.0 if channel == f"{cylinder}.x" else abs(float(lever))
        for side, area in enumerate((row.area_head, row.area_rod)):
            pressure = f"{cylinder}.{_ENDS[side]}"
            spread = float(np.std(record[pressure])) if pressure in record else 0.0
            worth = float(row.bulk_modulus * area / chamber_oil(row, side, x)) * noise
            if worth > SETTINGS.worth * spread > 0.0:
                shown, share = model.rig.shown("p_head", worth, 3), worth / spread
                fields = {"position": channel, "noise": shown, "pressure": pressure}
                yield message("preprocessing.position_noise", share=share, **fields)


def foreign_channels(name: str, record: Record, rig: Rig) -> list[Message]:
    """Notes on channels of nothing on the rig; refuses a log without any of a cylinder."""
    cylinders = {c.name for c in rig.cylinder}
    valves = {f"{c.name}.{v.name}" for c, v in rig.valves()}
    known = cylinders | set(rig.joint_names) | valves | set(rig.all_edges())
    odd: dict[str, list[str]] = {}
    for channel in record.channels:
        head = channel.rpartition(".")[0]
        if head and head not in known:
            owner = head.partition(".")[0]
            odd.setdefault(head if owner in cylinders else owner, []).append(channel)
    notes = []
    for owner, channels in odd.items():
        valve = all(channel.endswith(".command") for channel in channels)
        what = "a valve" if valve else "a cylinder"
        some = listed((f"'{channel}'" for channel in channels), 3)
        near = get_close_matches(owner, valves if "." in owner else cylinders, 1)
        fields = {"channels": some, "what": what, "rig": rig.name, "near": "".join(near)}
        key = "preprocessing.foreign_near" if near else "preprocessing.foreign"
        notes.append(message(key, **fields))
    if not any(channel.partition(".")[0] in cylinders for channel in record.channels):
        there = {"cylinders": ", ".join(c.name for c in rig.cylinder)}
        there |= {"channels": ", ".join(record.channels), "notes": "; ".join(notes)}
        raise InputError(message("preprocessing.all_foreign", log=name, rig=rig.name, **there))
    return notes


def undriven(record: Record, rig: Rig) -> Iterator[Message]:
    """Notes on valves whose command the log of their cylinder's others does not have."""
    known = {f"{cylinder.name}.{valve.name}.command" for cylinder, valve in rig.valves()}
    others = [channel for channel in record.channels if channel not in known]
    for cylinder in rig.cylinder:
        channels = [f"{cylinder.name}.{valve.name}.command" for valve in cylinder.valve]
        lacking = [channel for channel in channels if channel not in record]
        for channel in lacking if len(lacking) < len(channels) else ():
            near = "".join(get_close_matches(channel, others, 1, 0.8))
            key = "preprocessing.no_command_near" if near else "preprocessing.no_command"
            yield message(key, channel=channel, near=near)


def refuse_sample_time(name: str, record: Record, rig: Rig) -> None:
    """Refuse a time that can only be in another unit than it says."""
    tick = record.sample_time
    used = {item for _, valve in rig.valves() for item in valve.series}
    periods = [rig.dynamics[item].period() for item in used]
    maximum = min([SETTINGS.coarse, *(SETTINGS.periods * period for period in periods)])
    if tick > maximum:
        shown = 1e3 * maximum
        raise InputError(message("preprocessing.too_coarse", log=name, step=tick, most=shown))
    if tick < SETTINGS.fine:
        span = np.ptp(record.t)
        raise InputError(message("preprocessing.too_fine", log=name, step=tick, span=span))


def refuse_commands(name: str, record: Record, rig: Rig) -> None:
    """Refuse commands that no driver of the rig takes."""
    for _, valve, channel, values in _commanded(record, rig.cylinder):
        low, high = float(valve.command_min), float(valve.command_max)
        slack = SETTINGS.overshoot * (high - low)
        out = np.flatnonzero((values < low - slack) | (values > high + slack))
        if out.size:
            first = {"command": values[out[0]], "time": record.t[out[0]]}
            fields = {"channel": channel, "low": low, "high": high, **first}
            raise InputError(message("preprocessing.outside_driver", log=name, **fields))


def refuse_angles(name: str, record: Record, model: Model) -> None:
    """Refuse angles that mostly lie outside what their cylinder's stroke allows."""
    rig = model.rig
    for index, cylinder in enumerate(rig.cylinder):
        channel = f"{cylinder.name}.q"
        if channel not in record or cylinder.linkage is None:
            continue
        q, (low, high) = record[channel], sorted(model.stroke_range(index))
        middle, slack = float(np.median(q)), SETTINGS.travel * (high - low)
        wound = middle - 2.0 * math.pi * math.copysign(1.0, middle)
        read = {"": middle, "turned": -middle, "wound": wound}
        read |= {"degrees": math.radians(middle), "shifted": low}
        like = next(key for key, x in read.items() if low - slack <= x <= high + slack)
        if like:
            shown = {"low": float(q.min()), "high": float(q.max()), "first": low, "last": high}
            fields = {key: rig.shown("q", angle) for key, angle in shown.items()}
            fields |= {"channel": channel, "linkage": cylinder.linkage_word}
            raise LogError(message(f"preprocessing.angle_{like}", log=name, **fields))


def travels(rig: Rig) -> dict[str, float]:
    """How far positions can move [SI], by channel: a stroke, or the angle that it makes."""
    results = {}
    for cylinder in rig.cylinder:
        stroke = float(cylinder.stroke)
        results[f"{cylinder.name}.x"] = results[f"{cylinder.name}.q"] = stroke
        if cylinder.rack is not None:
            results[f"{cylinder.name}.q"] = stroke / float(cylinder.rack.radius)
        elif cylinder.pins is not None:  # three pins cannot pass one line
            results[f"{cylinder.name}.q"] = math.pi
    return results


def refuse_positions(name: str, record: Record, rig: Rig) -> None:
    """Refuse single positions that the cylinder cannot have gone to."""
    for channel, travel in travels(rig).items():
        if channel not in record:
            continue
        values = record[channel]
        out = np.flatnonzero(is_bad(channel, values, travel))
        if out.size:
            ends = (values[out[0]], *range_of(channel, values, travel))
            value, low, high = (rig.shown(channel, float(end), 4) for end in ends)
            fields = {"channel": channel, "value": value, "low": low, "high": high}
            fields |= {"log": name, "time": record.t[out[0]]}
            raise InputError(message("preprocessing.outside_travel", **fields))


def refuse_supply(name: str, record: Record, model: Model) -> None:
    """Refuse a supply pressure that is not of the unit it says."""
    if "p_supply" not in record:
        return
    rig, line = model.rig, model.plant.supply
    supply, seen = float(line.pressure), float(np.percentile(record["p_supply"], 90))
    minimum = float(line.margin) or supply  # which a load-sensing pump may stand at
    if minimum / SETTINGS.apart <= seen <= supply * SETTINGS.apart:
        return
    ratio, misses = max(seen, 1.0) / supply, []
    for a, b in permutations(MIXED["Pa"], 2):
        misses.append((abs(math.log(ratio * factor(b, "Pa") / factor(a, "Pa"))), a, b))
    miss, a, b = min(misses)
    fields = {key: rig.shown("p_head", p, 3) for key, p in (("seen", seen), ("supply", supply))}
    fields["like"] = f" it looks like {b} labelled {a}" if miss < math.log(1.3) else ""
    raise InputError(message("preprocessing.supply_pressure", log=name, rig=rig.name, **fields))


def refuse_pressures(name: str, record: Record, model: Model, rest: int, still: bool) -> None:
    """Refuse pressures that neither the supply nor the load can have made."""
    rig, plant, names = model.rig, model.plant, model.layout
    supply, shown = float(plant.supply.pressure), rig.shown
    try:
        start = model.start_of(record, rest)
    except EhbenchError:
        return  # a posture outside the stroke: the simulation says so
    for index, cylinder in enumerate(rig.cylinder):
        seen = {word: values for word, _, values in _recorded(record, cylinder, *_ENDS)}
        if not seen:
            continue
        areas = dict(zip(_ENDS, cylinder.areas(), strict=True))
        head, rod = (start[names.state(word, index)] * areas[word] for word in _ENDS)
        force = head - rod
        carrying, other = _ENDS if force > 0 else _ENDS[::-1]
        need = abs(force) / areas[carrying]
        peak = _peak(name, rig, cylinder, seen, supply, need)
        fed = any(
            np.any(edge.sign * values > valve.onset(edge))
            for _, valve, _, values in _commanded(record, [cylinder])
            for edge in valve.edge
            if edge.from_ == "supply"
        )
        if fed and len(seen) == 2 and peak < supply / SETTINGS.far_apart:
            fields = {"supply": shown("p_head", supply, 3), "peak": shown("p_head", peak, 3)}
            fields |= {"log": name, "cylinder": cylinder.name}
            raise InputError(message("preprocessing.low_pressures", **fields))
        light = need < SETTINGS.loaded * supply
        stroke = record.channels.get(f"{cylinder.name}.x", np.full(1, 0.5 * float(cylinder.stroke)))
        share = float(np.mean(stroke[:rest])) / float(cylinder.stroke)
        # at an end, the stop carries what the oil does not
        at_end = not SETTINGS.travel < share < 1.0 - SETTINGS.travel
        if not still or carrying not in seen or light or at_end:
            continue
        back = 0.0
        if other in seen:
            back = float(np.mean(seen[other][:rest])) * areas[other] / areas[carrying]
        fixed = float(np.mean(seen[carrying][:rest])) - back
        # dry friction may hold a light load without oil, but not keep the pressures down in motion
        low = fixed < need / SETTINGS.apart and peak < supply / SETTINGS.apart
        if low or (other in seen and fixed > need * SETTINGS.apart):
            fields = {"load": shown("p_head", need, 3), "fixed": shown("p_head", fixed, 3)}
            fields |= {"channel": f"{cylinder.name}.{carrying}", "rig": rig.name}
            raise InputError(message("preprocessing.load_pressure", log=name, **fields))


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
        need: pressure [Pa] that carries the load."""
    relief = 0.0 if cylinder.relief_pressure is None else float(cylinder.relief_pressure)
    peaks = {word: float(np.percentile(values, 99)) for word, values in seen.items()}
    for word, peak in peaks.items():
        if peak > SETTINGS.apart * max(supply, relief, need):
            fields = {"channel": f"{cylinder.name}.{word}", "peak": rig.shown("p_head", peak, 3)}
            fields |= {"supply": rig.shown("p_head", supply, 3), "rig": rig.name}
            raise InputError(message("preprocessing.high_pressure", log=name, **fields))
    return max(peaks.values())


def _travel_of(cylinder: Cylinder, word: str) -> float:
    """A full stroke [m], or an angle [rad] of the size that a stroke makes."""
    return 1.0 if word in ("q", "qd") and cylinder.linkage is not None else float(cylinder.stroke)


def notes_on_channels(record: Record, model: Model) -> Iterator[Message]:
    """What is odd about single channels, and about pairs of them."""
    rig = model.rig
    for cylinder in rig.cylinder:
        name, moves = cylinder.name, _travels(record, cylinder)
        pushed = not moves and _pushed(record, rig, cylinder)
        for word, channel, values in _recorded(record, cylinder, *_MOTION, *_ENDS, *GAUGES):
            way, motion = float(np.ptp(values)), word in _MOTION
            least = SETTINGS.still * _travel_of(cylinder, word) if word in ("q", "x") else 0.0
            still = motion and way <= least
            fields = {"channel": channel, "cylinder": name}
            last = record.at(slice(_stands_from(values), None))
            if last.t.size and _driven(last, rig, cylinder, motion):
                shown = {"level": rig.shown(channel, values[-1]), "time": last.t[0]}
                yield message("preprocessing.constant", **shown, **fields)
            elif moves and still:
                yield message("preprocessing.stands_still", **fields)
            elif pushed and still:
                yield message("preprocessing.stands_still_pushed", **fields)
        if (there := held(record, f"{name}.q")).any():
            first, share = int(np.argmax(there)), 100.0 * float(np.mean(there))
            fields = {"cylinder": name, "share": share, "time": record.t[first]}
            yield message("preprocessing.held", **fields)
    yield from constant_lines(record, rig)
    names = [f"{c.name}.{word}" for c in rig.cylinder for word in (*_ENDS, *GAUGES)]
    for name in [*names, "p_supply"]:
        if name in record and (there := at_limit(record[name])).any():
            first, share = int(np.argmax(there)), 100.0 * float(np.mean(there))
            level, time = rig.shown(name, record[name][first]), record.t[first]
            fields = {"channel": name, "level": level, "share": share, "time": time}
            yield message("preprocessing.limited", **fields)
    for name, off in off_pins(record, model).items():
        shown = rig.shown("x", abs(off), 3)
        way, by = "above" if off > 0.0 else "below", rig.cylinder_named(name).linkage_word
        yield message("preprocessing.off_pins", cylinder=name, off=shown, way=way, linkage=by)
    for cylinder in rig.cylinder:
        ends = [values for *_, values in _recorded(record, cylinder, *_ENDS)]
        for word, name, values in _recorded(record, cylinder, *GAUGES) if len(ends) == 2 else ():
            head_area, rod_area = (1.0, 1.0) if word == "load_pressure" else cylinder.areas()
            pushed = ends[0] * head_area - ends[1] * rod_area
            if not np.std(values) > 0.0 or not np.std(pushed) > 0.0:
                continue
            if np.corrcoef(values, pushed)[0, 1] < SETTINGS.against:  # the sensor is turned
                yield _turned("gauge_turned", name)
    yield from _backwards(record, rig)
    yield from outside_stroke(record, rig)
    yield from rates_of_other_units(record, rig)


def _stands_from(y: np.ndarray) -> int:
    """The sample from which readings are the very same to the end, for longer than ever before;
    their number where they are not."""
    ends = np.concatenate([[0], np.flatnonzero(np.diff(y)) + 1, [y.size]])
    *usual, last = np.diff(ends)
    least = max(SETTINGS.limit_run, SETTINGS.limit_share * max(usual, default=0))
    return int(ends[-2]) if last >= least else y.size


def constant_lines(record: Record, rig: Rig) -> Iterator[Message]:
    """Notes on pressures of supply and tank that stand while a cylinder is driven; one at the level
    that the rig has is stated, and no reading."""
    driven = (c.name for c in rig.cylinder if _driven(record, rig, c))
    name, supply = next(driven, ""), rig.supply
    lines = (("p_supply", supply.pressure), ("p_tank", supply.tank_pressure))
    for channel, stated in lines if name else ():
        if channel not in record or np.ptp(record[channel]) > 0.0:
            continue
        level = float(record[channel][0])
        if not math.isclose(level, float(stated), rel_tol=1e-6):
            shown = rig.shown(channel, level)
            fields = {"channel": channel, "level": shown, "cylinder": name, "time": record.t[0]}
            yield message("preprocessing.constant", **fields)


def outside_stroke(record: Record, rig: Rig) -> Iterator[Message]:
    """Notes on strokes that leave their cylinders' range: turned, or from another zero."""
    unit, slack = rig.unit_of("x"), SETTINGS.travel
    for cylinder in rig.cylinder:
        channel, stroke = f"{cylinder.name}.x", float(cylinder.stroke)
        if channel not in record:
            continue
        low, least, most, high = np.percentile(record[channel], (0.0, 1.0, 99.0, 100.0))
        if -slack * stroke <= least and most <= (1.0 + slack) * stroke:
            continue
        ends = (from_si(float(end), unit, VOCABULARY["x"]) for end in (low, high, stroke))
        first, last, largest = (f"{end:.4g}" for end in ends)
        fields = {"channel": channel, "low": first, "high": last, "stroke": largest, "unit": unit}
        turned = -slack * stroke <= -high and -low <= (1.0 + slack) * stroke
        key = "preprocessing.stroke_turned" if turned else "preprocessing.stroke_shifted"
        yield message(key, **fields)


def rates_of_other_units(record: Record, rig: Rig) -> Iterator[Message]:
    """Notes on positions that go along with the sum of their rates, but not as far."""
    t = record.t - np.mean(record.t)
    for cylinder in rig.cylinder:
        for words in (("q", "qd"), ("x", "v")):
            seen = [channel for _, channel, _ in _recorded(record, cylinder, *words)]
            if len(seen) < 2:
                continue
            ways = [_way(record, channel) for channel in seen]
            place, summed = (y - np.polyval(np.polyfit(t, y, 1), t) for y in ways)
            if np.ptp(summed) <= SETTINGS.travel * _travel_of(cylinder, words[0]):
                continue
            product, square = float(np.dot(place, summed)), float(np.dot(summed, summed))
            along = abs(product) > -SETTINGS.against * np.linalg.norm(place) * math.sqrt(square)
            ratio = abs(product) / square
            fields = {"place": seen[0], "rate": seen[1], "ratio": ratio}
            off, rest = abs(ratio - 1.0) * math.sqrt(square), place - product / square * summed
            if along and not 1.0 / SETTINGS.apart <= ratio <= SETTINGS.apart:
                yield message("preprocessing.rate_of_another_unit", **fields)
            elif product > 0.0 and off > max(
                SETTINGS.off_pins * math.sqrt(square), float(np.linalg.norm(rest))
            ):
                yield message("preprocessing.rate_of_another_scale", **fields)


def _driven(record: Record, rig: Rig, cylinder: Cylinder, motion: bool = False) -> bool:
    """Whether a cylinder moves, or, unless asked of its ``motion``, is pushed."""
    return _travels(record, cylinder) or (not motion and _pushed(record, rig, cylinder))


def _pushed(record: Record, rig: Rig, cylinder: Cylinder) -> bool:
    """Whether a cylinder's command changes, and its pressures by a good part of the supply's."""
    requested = any(
        np.ptp(values) > SETTINGS.on * (float(valve.command_max) - float(valve.command_min))
        for _, valve, _, values in _commanded(record, [cylinder])
    )
    ways = (float(np.ptp(values)) for *_, values in _recorded(record, cylinder, *_ENDS))
    maximum = max(ways, default=0.0)
    return requested and maximum > SETTINGS.pushed * max(float(rig.supply.pressure), 1.0e6)


def at_limit(y: np.ndarray) -> np.ndarray:
    """Where readings stand at the end of a sensor's range, shape (samples,): the very same extreme
    value several times in a row, reached in a few samples and left again."""
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
        before = np.abs(end - y[np.maximum(starts - SETTINGS.limit_rise, 0)])
        cut = here & (starts > 0) & (stops < y.size) & (length >= SETTINGS.limit_run)
        cut &= length > SETTINGS.limit_share * usual
        cut &= before > SETTINGS.limit_steps * steps.min()
        if cut.any():
            result |= y == end
    return result


def held(record: Record, channel: str) -> np.ndarray:
    """Where all readings of a channel's cylinder stand at those of the sample before, shape
    (samples,): several in a row, until one jumps and goes on slowly, as a recorder holds them when
    messages are lost. Coarse readings, and those of slow messages, stand more often than that."""
    owner, result = channel.rpartition(".")[0], np.zeros(record.t.size, bool)
    readings = [y for name, y in record.channels.items() if name.rpartition(".")[0] == owner]
    moving = [y for y in readings if np.ptp(y) > 0.0]
    if len(moving) < 2:
        return result
    steps = np.abs(np.diff(np.column_stack(moving), axis=0))
    usual = np.ma.median(np.ma.masked_equal(steps, 0.0), axis=0)
    counts = [0, 0]  # of stretches that end slowly, and in a jump
    for first, last in stretches_of((steps == 0.0).all(axis=1)):
        after = steps[last + 1 : last + 1 + SETTINGS.limit_rise]
        if last - first + 1 >= SETTINGS.limit_run and after.size:
            largest = SETTINGS.limit_share * after.max(axis=0)
            result[first + 1 : last + 1] = np.any(
                steps[last] > np.maximum(SETTINGS.limit_steps * usual, largest)
            )
        counts[int(result[last])] += 1
    return result & (counts[0] < counts[1])


def off_pins(record: Record, model: Model) -> dict[str, float]:
    """Stroke above that of angle and pins [m], by cylinder that disagrees: its level, else its
    worst."""
    results = {}
    for index, cylinder in enumerate(model.rig.cylinder):
        places = [values for *_, values in _recorded(record, cylinder, "x", "q")]
        if cylinder.linkage is None or len(places) < 2:
            continue
        x, q = places
        off = x - linkage_arrays(model.plant.cylinders[index], q)[0]
        noise = white_noise(off)
        level, maximum = float(np.median(off)), float(off[np.argmax(np.abs(off))])
        allowed = max(SETTINGS.off_pins * float(cylinder.stroke), SETTINGS.noises * noise)
        if abs(level) > allowed:
            results[cylinder.name] = level
        elif abs(maximum) > 2.0 * allowed:
            results[cylinder.name] = maximum
    return results


def _backwards(record: Record, rig: Rig) -> Iterator[Message]:
    """Notes on positions and speeds that fall while the commands extend a cylinder, or that go with
    its commands of another time."""
    for cylinder in rig.cylinder:
        opened = np.zeros((2, record.t.size), dtype=bool)
        for _, valve, _, values in _commanded(record, [cylinder]):
            for edge in valve.edge:
                if {edge.from_, edge.to} != {"head", "rod"}:
                    out = "head" == edge.to or "rod" == edge.from_
                    reach = edge.sign * values
                    opened[0 if out else 1] |= reach > max(valve.onset(edge), 0.0)
        ways = opened[0].astype(float) - opened[1].astype(float)
        ends = np.flatnonzero(np.diff(ways, prepend=0.0, append=0.0))
        if ends.size < 2:
            continue
        each = ways[ends[:-1]]
        driven = each != 0.0
        sign = 1 if cylinder.linkage is None else cylinder.linkage.sign
        for word, channel, _ in _recorded(record, cylinder, "x", "v", "q", "qd"):
            turn = sign if word in ("q", "qd") else 1
            y = turn * _way(record, channel)
            far = np.ptp(y) > SETTINGS.travel * _travel_of(cylinder, word)
            if far and (late := record.sample_time * _late(y, ends, each, record.sample_time)):
                key = "sensors_late" if late > 0.0 else "commands_late"
                fields = {"cylinder": cylinder.name, "ms": 1e3 * abs(late)}
                yield message(f"preprocessing.{key}", **fields)
                break
            gone = np.diff(y[np.minimum(ends, y.size - 1)])[driven]
            path, along = float(np.sum(np.abs(gone))), float(np.sum(each[driven] * gone))
            far = path > SETTINGS.travel * _travel_of(cylinder, word)
            if far and along < SETTINGS.against * path:
                falls = "falls" if turn > 0 else "rises"
                yield _turned("backwards", channel, way=falls, cylinder=cylinder.name)


def _late(y: np.ndarray, ends: np.ndarray, each: np.ndarray, tick: float) -> int:
    """By how many samples a way goes later than commands that have a sign between ``ends`` each: 0
    unless nearly all of it goes with them then, and clearly less of it now, either way."""
    reach, places = round(SETTINGS.latest / tick), np.concatenate([[0], ends, [y.size - 1]])
    shifts = np.arange(-reach, reach + 1, max(1, reach // 200))
    shifts = shifts[np.argsort(np.abs(shifts), kind="stable")] - shifts[np.abs(shifts).argmin()]
    gone = np.diff(y[np.clip(places + shifts[:, None], 0, y.size - 1)], axis=1)
    along = gone[:, 1:-1] @ each / np.maximum(np.sum(np.abs(gone), axis=1), 1e-300)
    best = float(along.max())
    if best < 1.0 - SETTINGS.stray or best - abs(along[0]) < SETTINGS.stray:
        return 0
    return int(np.median(shifts[along > best - SETTINGS.stray**2]))


def _turned(name: str, channel: str, **fields: str) -> Message:
    """A note on a channel whose sign is turned, with the line that puts it right."""
    cause = message(f"preprocessing.{name}", channel=channel, **fields)
    where = message("preprocessing.in_columns", channel=channel)
    written = {"cause": cause, "where": where, "line": "sign = -1"}
    return message("preprocessing.turned", weight=0.8, **written)


def _way(record: Record, channel: str) -> np.ndarray:
    """A position, or the integral of a speed."""
    y = record[channel]
    return y if channel.endswith((".q", ".x")) else np.cumsum(y) * record.sample_time


def _travels(record: Record, cylinder: Cylinder) -> bool:
    """Whether a position, or the integral of a speed, changes by more than sensors err."""
    return any(
        np.ptp(_way(record, channel)) > SETTINGS.travel * _travel_of(cylinder, word)
        for word, channel, _ in _recorded(record, cylinder, *_MOTION)
    )


def moving_at_first(record: Record, rig: Rig, rest: int) -> tuple[str, ...]:
    """Cylinders that move at the first sample, by rate or position in the samples before a
    command."""
    results, span = [], SETTINGS.first / record.sample_time
    for cylinder in rig.cylinder:
        first = next(_recorded(record, cylinder, "qd", "v", "q", "x"), None)
        if first is None or not _travels(record, cylinder):
            continue
        word, _, y = first
        jumps = np.abs(np.diff(y))
        if word in ("qd", "v"):
            count = min(rest, max(1, round(span)))
            noise = 1.5 * float(np.median(jumps)) / math.sqrt(count)
            speed, maximum = float(np.mean(y[:count])), float(np.abs(y).max())
        else:
            count = min(rest, max(8, round(2.5 * span)))
            if count < 8:
                continue
            noise = 1.5 * float(np.median(jumps)) * math.sqrt(12.0 / count)
            if noise == 0.0 and jumps.any():  # an encoder that stands between two of its counts
                noise = 0.5 * float(np.min(jumps[jumps > 0.0]))
            speed = float(np.polyfit(np.arange(count), y[:count], 1)[0]) * count
            steps = np.abs(y[count:] - y[:-count])
            maximum = float(steps.max(initial=0.0 if steps.size else abs(speed)))
        if abs(speed) > SETTINGS.ongoing * maximum + 4.0 * noise:
            results.append(cylinder.name)
    return tuple(results)


def on_at_first(record: Record, rig: Rig, rest: int) -> dict[str, float]:
    """Commands [V] that are already on at the first sample, by channel."""
    results = {}
    for _, valve, channel, values in _commanded(record, rig.cylinder):
        first = float(np.median(values[:rest]))
        minimum = SETTINGS.on * (float(valve.command_max) - float(valve.command_min))
        if any(edge.sign * first > max(valve.onset(edge), 0.0) + minimum for edge in valve.edge):
            results[channel] = first
    return results


def idle_at_first(
    record: Record, rig: Rig, on: Mapping[str, float], rest: int
) -> Iterator[Message]:
    """Notes on cylinders that stand in the first ``rest`` samples, although commands ``on`` open
    both their chambers and they move elsewhere: what is logged as the command has another zero.

    They stand where they move less than a share of what they do elsewhere in the same time, with
    the openings in proportion."""
    for cylinder in rig.cylinder:
        ends, share, opened = set[str](), 1.0, {}
        for _, valve, channel, values in _commanded(record, [cylinder]):
            if channel not in on:
                continue
            opened[channel] = on[channel]
            for edge in valve.edge:
                least = max(valve.onset(edge), 0.0)
                if (opening := edge.sign * on[channel] - least) > 0.0:
                    ends |= {edge.from_, edge.to}
                    share = min(share, opening / (np.abs(values).max() - least))
        first = next(_recorded(record, cylinder, *_MOTION), None)
        if not {"head", "rod"} <= ends or first is None:
            continue
        word, way = first[0], _way(record, first[1])
        usual = np.abs(way[rest:] - way[:-rest]).max(initial=0.0)
        surely = usual > SETTINGS.travel * _travel_of(cylinder, word)
        if surely and np.ptp(way[:rest]) < SETTINGS.ongoing * share * usual:
            for channel, command in opened.items():
                fields = {"channel": channel, "command": command, "cylinder": cylinder.name}
                yield message("preprocessing.idle_on", **fields)
