"""What a log shows of a cylinder, and how: the rules that identification and validation share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ehbench.config.rig import Rig, Valve
from ehbench.data.record import Record, payloads_of
from ehbench.plant.model import MOVED, Model
from ehbench.plant.ties import supplied
from ehbench.signals.series import lowpass, rms, white_noise
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.quantities import GAUGES, quantity
from ehbench.vocabulary.units import from_si

RATE_CUTOFF = 20.0  # [Hz] of the low-pass before a rate is taken from a position
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
TOGETHER = 0.02  # [s]: commands that change within this before a transient have begun it with it
EMPTY = 0.01  # share of an accumulator's precharge below which its line has no gas
SUPPLY_OFF = 0.03  # share of the supply's pressure by which it may be off the model's, rms
# ringing of fewer cycles, or better damped, is told by drift as well as by oscillation
CLEAR_CYCLES, CLEAR_DAMPING = 1.5, 0.35


def column(record: Record, channel: str, like: Record) -> np.ndarray | None:
    """A channel [SI]; where ``like`` lacks it, the rate of its position behind a low-pass, None if
    that is lacking too.
    """
    if channel in like:
        return record[channel]
    position = position_of(channel)
    if position == channel or position not in like:
        return None
    smooth = lowpass(record[position], record.sample_time, RATE_CUTOFF)
    return np.gradient(smooth, record.sample_time)


def noise_of(record: Record, channel: str) -> float:
    """Standard deviation of a channel's white noise [SI], by third differences; of a rate that is
    taken from a position, what that position's noise makes of it.
    """
    position = position_of(channel)
    if channel in record or position not in record:
        return white_noise(record[channel])
    pulse = np.zeros(record.t.size)
    pulse[record.t.size // 2] = 1.0
    answer = column(replace(record, channels={position: pulse}), channel, record)
    return 0.0 if answer is None else white_noise(record[position]) * float(np.linalg.norm(answer))


def position_of(channel: str) -> str:
    """The channel whose rate a channel is; itself, if it is no rate."""
    head, word = channel.rsplit(".", 1)
    return f"{head}.{_RATE_OF.get(word, word)}"


def alternatives(channel: str) -> tuple[str, ...]:
    """A channel, and those that stand in for it."""
    head, word = channel.rsplit(".", 1)
    return (channel, *(f"{head}.{item}" for item in STAND_INS.get(word, ())))


def channels_asked(record: Record, cylinder: str, word: str) -> list[str]:
    """The channels of a cylinder that a word asks for: one, or of what its valves have (their
    ``opening``) all that were recorded.
    """
    valves = [channel for channel in record.channels if channel.startswith(f"{cylinder}.")]
    valves = [valve for valve in valves if valve.count(".") == 2 and valve.endswith(f".{word}")]
    return valves if word in OF_VALVES and valves else [f"{cylinder}.{word}"]


def stood_for(word: str) -> tuple[str, ...]:
    """A quantity, and those that it may stand in for."""
    return (word, *(item for item, others in STAND_INS.items() if word in others))


def least_change(valve: Valve) -> float:
    """The change of a valve's recorded command [V] that is more than noise."""
    return MOVED * (float(valve.command_max) - float(valve.command_min))


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
        InputError: it changed on the way.
    """
    (_, message), *changes = payloads_of(record)
    if changes:
        at, name = changes[0]
        raise InputError(
            f"the payload changes from {message or 'none'} to {name or 'none'} at t = {at:g} s",
            hint="take a window of the log with one payload",
        )
    return message


def supply_off(record: Record, simulated: Record, rig: Rig) -> list[str]:
    """Sentences where the recorded supply pressure is not the model's, so that its supply is
    another than the machine's, and where the accumulator runs empty; none where neither is so, or
    known.
    """
    if supplied(record):
        return []
    empty = _empty(record, simulated, rig)
    if "p_supply" not in record:
        return empty
    off = simulated["p_supply"] - record["p_supply"]
    far, noise = float(off[np.argmax(np.abs(off))]), white_noise(record["p_supply"])
    if rms(off) < max(SUPPLY_OFF * float(np.median(record["p_supply"])), 3.0 * noise):
        return empty
    row, unit = quantity("p_supply"), rig.unit_of("p_supply")
    shown = f"{abs(from_si(far, unit, row)):.3g} {unit}"
    when = f"{record.t[int(np.argmax(np.abs(off)))]:.4g} s"
    way = "below" if far > 0.0 else "above"
    return [
        *empty,
        f"p_supply is up to {shown} {way} the model's (at t = {when}), whose supply is not the "
        "machine's: supply = \"recorded\" in the recipe drives the model by the log's, or estimate "
        "the supply's parameters",
    ]


def _empty(record: Record, simulated: Record, rig: Rig) -> list[str]:
    """A sentence where the supply falls below its accumulator's precharge, by the recording where
    it tells, else by the model: without gas on the line a little oil moves its pressure by a lot.
    """
    accumulator = rig.supply.accumulator
    if accumulator is None:
        return []
    seen = "p_supply" in record
    pressure = record["p_supply"] if seen else simulated["p_supply"]
    precharge = float(accumulator.precharge)
    low = pressure < precharge - EMPTY * abs(precharge) - 4.0 * white_noise(pressure) * seen
    if not low.any():
        return []
    when = f"{record.t[int(np.argmax(low))]:.4g} s"
    cure = 'supply = "recorded" for this log' if seen else "record p_supply"
    return [
        f"the accumulator runs empty at t = {when}: p_supply falls below its precharge, "
        f"{rig.shown('precharge', precharge)}, where a little oil more or less moves it by a lot, "
        f"and numbers make up for that; {cure}, or stop before"
    ]


def rings_clearly(cycles: float, damping_ratio: float) -> bool:
    """Whether an oscillation lasts long enough for its frequency to be told from drift."""
    return cycles >= CLEAR_CYCLES and damping_ratio <= CLEAR_DAMPING
