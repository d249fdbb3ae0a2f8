"""What a log shows of a cylinder, and how: the rules that identification and validation share."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.config.rig import Cylinder, Rig, Valve
from ehbench.data.record import Record, payloads_of
from ehbench.parts.cylinder import linkage_arrays
from ehbench.plant.model import MOVED, Model
from ehbench.plant.ties import RECORDED, SUPPLY, supplied, tied_words
from ehbench.signals.series import lowpass, rms, transients, white_noise
from ehbench.vocabulary import InputError, Message, message, setting
from ehbench.vocabulary.quantities import GAUGES

# what stands in for a channel that a log lacks, and moves with it
STAND_INS = {
    "q": ("x",),
    "x": ("q",),
    "qd": ("v",),
    "v": ("qd",),
    "p_head": GAUGES,
    "p_rod": GAUGES,
}
OF_VALVES = ("opening",)  # quantities that a cylinder has of each of its valves
_RATE_OF = {"qd": "q", "v": "x"}
# channels by which each log goes in place of a number of the rig
READ_OFF = {"supply.pressure": "p_supply", "supply.tank_pressure": "p_tank"}


@dataclass(frozen=True)
class ObservationSettings:
    """Numbers of what a log shows of a cylinder."""

    rate_cutoff: float = setting(20.0, "Hz", "low-pass of a position before its rate", "swings")
    together: float = setting(0.02, "s", "span of commands of one transient", "a few samples")
    slack: float = setting(0.01, "", "slack of precharge and tank, of pressures", "gauges")
    supply_off: float = setting(0.03, "", "rms error of the supply's pressure, of it", "gauges")
    clear_cycles: float = setting(1.5, "", "least cycles of a clear ringing", "else drift")
    clear_damping: float = setting(0.35, "", "largest damping of a clear ringing", "else drift")
    empty: float = setting(0.5, "", "empty chamber, of cavitation pressure", "half its slope")
    emptying: float = setting(
        0.05, "s", "time about an empty chamber in which samples do not count", "it fills"
    )
    near: float = setting(0.01, "", "distance from an end of the stroke, of it", "cushions act")


SETTINGS = ObservationSettings()


def column(record: Record, channel: str, like: Record) -> np.ndarray | None:
    """A channel [SI]; where ``like`` lacks it, the rate of its position behind a low-pass, or
    None. A simulation tied to that position has integrated another rate, which counts."""
    if channel in like:
        return record[channel]
    position = position_of(channel)
    if position == channel or position not in like:
        return None
    path = record[position]
    if channel in record and position.rpartition(".")[2] in tied_words(like):
        from scipy.interpolate import CubicSpline

        path = CubicSpline(record.t, record[channel]).antiderivative()(record.t)
    smooth = lowpass(path, record.sample_time, SETTINGS.rate_cutoff)
    return np.gradient(smooth, record.sample_time)


def count_error(y: np.ndarray) -> float:
    """Standard error of a resting reading in counts, in its unit; zero of one that never changes.

    It is Δ/√12 of a count Δ, the smallest step between its values; noise σ makes it less by
    exp(−2(πσ/Δ)²), the first harmonic of the bias of a dithered mean (Widrow & Kollár 2008)."""
    steps = np.diff(np.unique(y))
    if not steps.size:
        return 0.0
    count = float(steps.min())
    noise = max(white_noise(y) ** 2 - count**2 / 12.0, 0.0)
    return count / math.sqrt(12.0) * math.exp(-2.0 * noise * (math.pi / count) ** 2)


def noise_of(record: Record, channel: str, each: int = 1) -> float:
    """Standard deviation of white noise in a channel [SI], or in means of ``each`` samples of it,
    by third differences; of a rate from a position, by that position's."""
    position = position_of(channel)
    read = channel if channel in record or position not in record else position
    apart = record.apart(read)
    noise = white_noise(record[read], apart)
    count = np.arange(record.t.size)  # a sample is a triangle on what is interpolated
    pulse = np.maximum(0.0, 1.0 - np.abs(count - count.size // 2) / apart)
    answer = column(replace(record, channels={read: pulse}), channel, record)
    assert answer is not None  # the record has what it is from
    means = np.convolve(answer, np.full(each, 1.0 / each)) / math.sqrt(apart)
    return noise * float(np.linalg.norm(means))


def position_of(channel: str) -> str:
    """The channel whose rate a channel is; itself, if it is no rate."""
    owner, dot, word = channel.rpartition(".")
    return f"{owner}{dot}{_RATE_OF.get(word, word)}"


def alternatives(channel: str) -> tuple[str, ...]:
    """A channel, and those that stand in for it."""
    head, word = channel.rsplit(".", 1)
    return (channel, *(f"{head}.{item}" for item in STAND_INS.get(word, ())))


def channels_asked(record: Record, cylinder: str, word: str) -> list[str]:
    """The channels of a cylinder that a word names; of valves' ``opening`` all that were
    recorded."""
    valves = [channel for channel in record.channels if channel.startswith(f"{cylinder}.")]
    valves = [valve for valve in valves if valve.count(".") == 2 and valve.endswith(f".{word}")]
    return valves if word in OF_VALVES and valves else [f"{cylinder}.{word}"]


def stood_for(word: str) -> tuple[str, ...]:
    """A quantity, and those that it may stand in for."""
    return (word, *(item for item, others in STAND_INS.items() if word in others))


def least_change(valve: Valve) -> float:
    """The change of a valve's recorded command [V] that is more than noise."""
    return MOVED * (float(valve.command_max) - float(valve.command_min))


def least_changes(cylinder: Cylinder, record: Record) -> dict[str, float]:
    """`least_change` by recorded command channel of a cylinder."""
    channels = {f"{cylinder.name}.{valve.name}.command": valve for valve in cylinder.valve}
    return {name: least_change(valve) for name, valve in channels.items() if name in record}


def empty_chambers(rig: Rig, record: Record) -> Iterator[tuple[str, np.ndarray]]:
    """Each cylinder of which a chamber empties, and which samples follow from that, of which the
    model knows only a floor of pressure: from just before until just after its next command."""
    limit = SETTINGS.empty * float(rig.oil.cavitation_pressure)
    ahead = round(SETTINGS.emptying / record.sample_time)
    for cylinder in rig.cylinder:
        ends = [f"{cylinder.name}.{word}" for word in ("p_head", "p_rod")]
        pressures = [record[channel] for channel in ends if channel in record]
        empty = np.flatnonzero(np.min(pressures, axis=0) < limit) if pressures else np.empty(0)
        if not empty.size:
            continue
        commands, starts = least_changes(cylinder, record), []
        if commands:
            table = np.column_stack([record[channel] for channel in commands])
            minimum = np.array(list(commands.values()))
            starts = [window.start for window in transients(record.t, table, minimum=minimum)]
        stops, void = np.array([*starts, record.t.size]), np.zeros(record.t.size, dtype=bool)
        windows, firsts = np.unique(np.searchsorted(stops, empty, "right"), return_index=True)
        for first, stop in zip(empty[firsts], stops[windows], strict=True):
            void[max(0, first - ahead) : stop + ahead] = True
        yield cylinder.name, void


def at_ends(model: Model, record: Record) -> Iterator[tuple[str, np.ndarray]]:
    """Each cylinder that its log shows at an end of its stroke, and in which samples, with those
    just before and after: of stops and cushions the model knows only where the stroke ends."""
    from scipy.ndimage import maximum_filter1d

    around = 2 * round(SETTINGS.emptying / record.sample_time) + 1
    for name, row in zip(model.layout.cylinders, model.plant.cylinders, strict=True):
        channel = next((c for c in (f"{name}.x", f"{name}.q") if c in record), None)
        if channel is None:
            continue
        x = record[channel]
        x = linkage_arrays(row, x)[0] if channel.endswith("q") else x
        off = np.minimum(np.abs(x), np.abs(x - row.stroke))
        there = off < SETTINGS.near * row.stroke
        if there.any() and not there.all():
            yield name, maximum_filter1d(there, around, mode="constant")


def not_described(model: Model, record: Record) -> Iterator[tuple[str, str, np.ndarray]]:
    """(what, cylinder, samples) of a log that the model does not describe: ``cavitates`` of
    `empty_chambers`, ``at_end`` of `at_ends`."""
    for cylinder, void in empty_chambers(model.rig, record):
        yield "cavitates", cylinder, void
    for cylinder, void in at_ends(model, record):
        yield "at_end", cylinder, void


def commanded(model: Model, record: Record) -> tuple[str, ...]:
    """The cylinders whose recorded commands change or stand off rest, in the rig's order."""
    results = []
    for cylinder, valve in model.rig.valves():
        channel = f"{cylinder.name}.{valve.name}.command"
        if channel in record and cylinder.name not in results:
            span = least_change(valve)
            off = float(np.max(np.abs(record[channel] - valve.rest)))
            if float(np.ptp(record[channel])) > span or off > 2.0 * span:
                results.append(cylinder.name)
    return tuple(results)


def payload_of(record: Record) -> str | None:
    """The payload that a log says was carried, None for none.

    Raises:
        InputError: it changed on the way."""
    (_, payload), *changes = payloads_of(record)
    if changes:
        time, after = changes[0]
        before, after = payload or "none", after or "none"
        fields = {"before": before, "after": after, "time": time}
        raise InputError(message("preprocessing.payload_changes", **fields))
    return payload


def read_off(name: str, records: Sequence[Record]) -> str | None:
    """The channel of all records that is taken in place of a number of the rig, if there is one."""
    channel = READ_OFF.get(name)
    given = channel is not None and all(channel in record for record in records)
    return channel if given else None


def supply_off(record: Record, simulated: Record, rig: Rig) -> list[Message]:
    """Notes where pressures of supply and tank are not the rig file's, the accumulator runs empty
    or the supply's pressure is not the model's. What speaks against the model has a ``cause``, and
    the ``line`` to write and ``where``."""
    notes = []
    for name, channel in READ_OFF.items():  # what has no log goes by the rig file
        if channel not in record or channel not in simulated:
            continue
        if channel == "p_supply" and rig.supply.load_sensing is not None:
            continue  # it stands at the load's pressure
        known, level = float(rig.parameters()[name]), float(simulated[channel][0])
        share = SETTINGS.slack if channel == "p_tank" else SETTINGS.supply_off
        allowed = share * float(rig.supply.pressure)
        reached = level if supplied(record) else simulated[channel]  # oil flows back, too
        if channel == "p_supply" and np.percentile(record[channel] - reached, 99.0) > allowed:
            continue  # no level of its own: it goes with the load
        if abs(level - known) > allowed:
            shown = rig.shown(channel, level)
            fields = {"name": name, "known": rig.shown(channel, known), "seen": shown}
            cause = message("preprocessing.other_level", **fields)
            key = name.rpartition(".")[2]
            where = message("preprocessing.in_supply", key=key)
            written = {"line": f'{key} = "{shown}"', "where": where}
            notes.append(message("preprocessing.level_off", cause=cause, weight=0.5, **written))
    if supplied(record):
        return notes
    seen, accumulator = "p_supply" in record, rig.supply.accumulator
    if accumulator is not None:  # by the recording where it has the pressure, else by the model
        pressure = (record if seen else simulated)["p_supply"]
        precharge = float(accumulator.precharge)
        low = precharge - SETTINGS.slack * abs(precharge) - 4.0 * white_noise(pressure) * seen
        if (below := pressure < low).any():
            fields = {"time": f"{record.t[int(np.argmax(below))]:.4g} s"}
            fields |= {"precharge": rig.shown("precharge", precharge)}
            key = "preprocessing.empty_recorded" if seen else "preprocessing.empty_simulated"
            notes.append(message(key, **fields))
    if not seen:
        return notes
    off = simulated["p_supply"] - record["p_supply"]
    worst, noise = int(np.argmax(np.abs(off))), white_noise(record["p_supply"])
    limit = SETTINGS.supply_off * float(np.median(record["p_supply"]))
    if rms(off) >= max(limit, 3.0 * noise):
        far, time = float(off[worst]), f"{record.t[worst]:.4g} s"
        shown, way = rig.shown("p_supply", abs(far), 3), "below" if far > 0.0 else "above"
        cause = message("preprocessing.far_off", off=shown, way=way)
        where = message("preprocessing.in_data")
        fields = {"cause": cause, "line": f'{SUPPLY} = "{RECORDED}"', "where": where}
        notes.append(message("preprocessing.supply_off", time=time, weight=0.5, **fields))
    return notes


def rings_clearly(cycles: float, damping_ratio: float) -> bool:
    """Whether an oscillation lasts long enough for its frequency to be distinguished from drift."""
    return cycles >= SETTINGS.clear_cycles and damping_ratio <= SETTINGS.clear_damping
