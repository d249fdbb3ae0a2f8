"""What of a recording is tied into a simulation along it: the motion of a closed loop, the pressure
of the supply.

A position that a controller held drifts away when its commands are replayed without it, for it
integrates every error of a flow. With ``position`` tied, joint coordinates are the recording's, and
rates and pressures the model's; with ``motion``, rates are the recording's as well, and pressures
the answer to it. The supply's pressure may be given where the rig file's supply is not the
machine's: a pump that gives way, an accumulator."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ehbench.data.record import Record
from ehbench.parts.cylinder import joint_of
from ehbench.plant.build import Plant
from ehbench.plant.layout import Layout
from ehbench.signals.series import lowpass, white_noise

SUPPLY, RECORDED = "supply", "recorded"  # the fact that the supply's pressure is the recording's
TIED = "tied"  # the fact of a record that says what of it is tied: a key of WORDS
DELAY = "delay"  # the last word of the fact of a command, what its samples leave of a delay [s]
# which words of a cylinder's channels are given then
WORDS: dict[str, tuple[str, ...]] = {
    "none": (),
    "position": ("q", "x"),
    "motion": ("q", "x", "qd", "v"),
}
SEEN = 3.0  # times the density of white noise, beyond which a position shows motion
PERIOD = 0.5  # [s] of which its spectrum is taken
ABOVE = 1.5  # times the highest frequency that shows motion, where its noise is cut off …
ORDER = 4  # … so sharply that what rings below keeps its size


class Ties(NamedTuple):
    """What is tied: ``cylinders`` and ``supply`` with it, ``rates`` [unit/s], shape (samples,
    ties), and first values by state."""

    cylinders: np.recarray
    supply: np.record
    rates: np.ndarray
    first: dict[int, float]


def tied_words(record: Record) -> tuple[str, ...]:
    """The words of a cylinder's channels that a record gives to a simulation along it."""
    return WORDS[record.meta.get(TIED, "none")]


def supplied(record: Record) -> bool:
    """Whether a record gives its supply pressure to a simulation along it."""
    return record.meta.get(SUPPLY) == RECORDED and "p_supply" in record


def late_of(record: Record, valves: Sequence[str]) -> np.ndarray:
    """By how much [s], less than a sample, each valve's command acts later than its samples say."""
    return np.array([float(record.meta.get(f"{name}.command.{DELAY}", 0.0)) for name in valves])


def position_channel(record: Record, cylinder: str) -> str | None:
    """The channel that tells where a cylinder stands; None where none does."""
    return next((name for w in ("q", "x") if (name := f"{cylinder}.{w}") in record), None)


def ties_of(plant: Plant, names: Layout, record: Record) -> Ties:
    """What a record ties of a plant: the coordinates of all cylinders whose position it has, and
    with ``motion`` their rates; the pressure of the supply.

    Coordinates run straight from sample to sample; so do rates, through the central differences of
    the coordinates without what is noise (`without_noise`)."""
    tick, words = record.sample_time, tied_words(record)
    before, cylinders = len(names.valves) + len(names.played), plant.cylinders.copy()
    tied: list[tuple[int, np.ndarray]] = []
    for row, cylinder in zip(cylinders, names.cylinders, strict=True):
        channel, joint = position_channel(record, cylinder), int(row.joint)
        if channel is None or not words:
            continue
        moving = "qd" in words
        q = record[channel]
        q = without_noise(q, tick, record.apart(channel)) if moving else q
        if channel.endswith(".x"):
            q = np.asarray(joint_of(row, np.clip(q, 0.0, float(row.stroke))))
        row.tied_position = before + len(tied)
        tied.append((joint, q))
        if moving:
            row.tied_rate = before + len(tied)
            tied.append((plant.at.rates + joint, np.gradient(q, tick)))
    line = plant.at_pressures().supply
    if supplied(record):
        line.tied = before + len(tied)
        supply = without_noise(record["p_supply"], tick, record.apart("p_supply"))
        tied.append((plant.at.supply, supply))
    rates = [np.append(np.diff(values) / tick, 0.0) for _, values in tied]
    first = {at: float(values[0]) for at, values in tied}
    table = np.column_stack(rates) if rates else np.zeros((record.t.size, 0))
    return Ties(cylinders, line, table, first)


def without_noise(y: np.ndarray, tick: float, each: int = 1) -> np.ndarray:
    """A position [unit] without what lies above the frequencies at which motion shows above its
    white noise, which third differences tell; of one that is interpolated, those of its samples,
    which stand in every ``each``-th place.

    Noise of a motion that is given is an error of the regressor: it makes the oil seem softer."""
    size = min(y.size, round(PERIOD / tick))
    density = 2.0 * tick * each * white_noise(y, each) ** 2
    if size < 16 or density == 0.0:
        return y
    from scipy.signal import welch

    frequency, power = welch(y, 1.0 / tick, nperseg=size, detrend="linear")
    shows = int(np.max(np.flatnonzero(power > SEEN * density), initial=0))
    corner = ABOVE * float(frequency[min(shows + 1, frequency.size - 1)])
    return lowpass(y, tick, corner, ORDER)
