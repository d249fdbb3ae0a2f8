"""How many samples of a log are compared as one mean: of a log much faster than the machine, as
many as take next to nothing from what it tells."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ehbench.data.record import BlockAverages, Record
from ehbench.plant.build import Plant
from ehbench.plant.derivatives import derivatives
from ehbench.plant.model import Model
from ehbench.plant.paced import CLOSE, pace_of
from ehbench.vocabulary import Message, message, setting

Decimate = int | Literal["auto"]


@dataclass(frozen=True)
class MeansSettings:
    """How many samples of a log are compared as one mean.

    A mean over T keeps sinc²(fT) of what white noise leaves known at a frequency f, so that of a
    share fT of a period the interval is (π fT)²/6 wider: 0.4 % of a twentieth."""

    share: float = setting(0.05, "", "part of the fastest period that a mean may last", "0.4 %")
    longest: float = setting(
        1.0e-3, "s", "longest mean", "from there on simulations take the time, not the samples"
    )
    worth: int = setting(3, "", "smallest number of samples of a mean", "fewer spare too little")
    fewest: int = setting(200, "", "smallest number of means that a log is left with", "chosen")
    swings: float = setting(
        0.1, "", "part of an eigenvalue's size that is imaginary in an oscillation", "chosen"
    )
    step: float = setting(
        1.0e-5, "", "step of finite differences, in states' scales or units", "half the digits"
    )


SETTINGS = MeansSettings()


def means_of(
    model: Model, record: Record, decimate: Decimate = "auto", cutoff: float | None = None
) -> BlockAverages | None:
    """A recording as it is compared; None: sample by sample.

    Args:
        record: evenly sampled.
        decimate: samples a mean, or ``"auto"``: by the fastest motion of the machine along it.
        cutoff: of a low-pass [Hz] that has to be left room."""
    count, tick = record.t.size, record.sample_time
    if decimate != "auto":
        return BlockAverages.of(record, decimate) if decimate > 1 else None
    worth, share = SETTINGS.worth, SETTINGS.share
    if worth * tick > SETTINGS.longest:
        return None
    longest = share / max(fastest(model, record), cutoff or 0.0, share / SETTINGS.longest)
    each = min(math.floor(longest / tick * (1.0 + 1e-6)), count // SETTINGS.fewest)
    return BlockAverages.of(record, each) if each >= worth else None


def fastest(model: Model, record: Record) -> float:
    """The highest frequency [Hz] that a machine answers with along a recording: of its valves, each
    by its slowest element, and of its oscillations, with valves shut, where its cylinders start
    and at both ends of their ways."""
    plant = model.plant
    rates = [0.0]
    for valve in plant.valves:
        elements = plant.elements.fastest[valve.first : valve.first + valve.count]
        rates += [float(np.min(elements))] if elements.size else []
    command, rest = model.commands_of(record)[0] if model.layout.played else None, plant.at.rates
    for end in (lambda y: y[0], np.min, np.max):
        seen = {
            channel: float(end(y))
            for channel, y in record.channels.items()
            if channel.rpartition(".")[2] in ("q", "x")
        }
        y = model.posed(seen, command)
        for index, row in enumerate(plant.cylinders):
            # each joint runs through its range in a second, so that dry friction does not hold it
            low, high = sorted(model.stroke_range(index))
            y[rest + row.joint] = high - low
        values = np.linalg.eigvals(_jacobian(model, y))
        rates += np.abs(values[np.abs(values.imag) > SETTINGS.swings * np.abs(values)]).tolist()
    return max(rates) / (2.0 * math.pi)


def _jacobian(model: Model, y: np.ndarray) -> np.ndarray:
    """∂ẏ/∂y at a state with valves at rest, by central differences, shape (states, states)."""
    plant: Plant = model.plant
    weights = pace_of(plant, model.layout, SETTINGS.longest).weights * CLOSE
    command, work = model.rest_commands(1)[0], np.empty(plant.at.work)

    def slope(at: np.ndarray) -> np.ndarray:
        dy = np.zeros(y.size)
        derivatives(at, command, plant, dy, work)
        return dy

    moves = np.diag(SETTINGS.step / np.where(weights > 0.0, weights, 1.0))
    columns = [(slope(y + move) - slope(y - move)) / (2.0 * move.sum()) for move in moves]
    return np.column_stack(columns)


def compared_as(record: Record, means: BlockAverages) -> Message:
    """As what a recording is compared, in words."""
    rates = {"mean": 1.0 / (means.each * record.sample_time), "sample": 1.0 / record.sample_time}
    fields = {k: f"{x / 1e3:.3g} kHz" if x >= 999.5 else f"{x:.3g} Hz" for k, x in rates.items()}
    return message("identification.as_means", each=means.each, **fields)
