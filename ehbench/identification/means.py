"""How many samples of a log are compared as one mean: of a log much faster than the machine, as
many as take next to nothing from what it tells."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from ehbench.data.record import BlockAverages, Record
from ehbench.identification.search import Where
from ehbench.plant.build import Plant
from ehbench.plant.derivatives import derivatives
from ehbench.plant.model import Model
from ehbench.plant.paced import CLOSE, pace_of
from ehbench.vocabulary.errors import InputError

Decimate = int | Literal["auto"]
# A mean over T keeps sinc²(fT) of what white noise leaves known at a frequency f, so that of a
# share fT of a period the interval is (π fT)²/6 wider: 0.4 % of a twentieth.
SHARE = 0.05  # of the fastest period that a mean may last, …
LONGEST = 1.0e-3  # … and [s]: from there on the simulations take the time, not the samples
WORTH = 3  # means of fewer samples spare too little
FEWEST = 200  # means that a log is left with
SWINGS = 0.1  # of an eigenvalue's size that is imaginary where it is of an oscillation
STEP = 1.0e-5  # of finite differences, in states' scales, or in units of states without one


def means_of(
    model: Model, record: Record, decimate: Decimate = "auto", cutoff: float | None = None
) -> BlockAverages | None:
    """A recording as it is compared; None: sample by sample.

    Args:
        record: evenly sampled.
        decimate: samples a mean, or ``"auto"``: by the fastest motion of the machine along it.
        cutoff: of a low-pass [Hz] that has to be left room.
    """
    count, tick = record.t.size, record.sample_time
    if decimate != "auto":
        return BlockAverages.of(record, decimate) if decimate > 1 else None
    if WORTH * tick > LONGEST or count < WORTH * FEWEST:
        return None
    longest = SHARE / max(fastest(model, record), cutoff or 0.0, SHARE / LONGEST)
    each = min(math.floor(longest / tick * (1.0 + 1e-6)), count // FEWEST)
    return BlockAverages.of(record, each) if each >= WORTH else None


def refuse_few(name: str, record: Record, each: int, where: Where) -> None:
    """Refuse means of so many samples that a log is left with too few.

    Raises:
        InputError: says how many would do.
    """
    count = record.t.size
    if each > 1 and count < FEWEST * each:
        maximum = count // FEWEST
        some = (
            f"at most {maximum} samples a mean"
            if maximum > 1
            else "decimate = 1 compares each sample"
        )
        raise InputError(
            f"{name}: means of {each} of its {count} samples are {count // each}, and a log is "
            f"compared by {FEWEST} at least",
            **where("decimate"),
            hint=some,
        )


def fastest(model: Model, record: Record) -> float:
    """The highest frequency [Hz] that a machine answers with along a recording: of its valves, each
    by its slowest element, and of its oscillations, with valves shut, where its cylinders start
    and at both ends of their ways.
    """
    plant = model.plant
    rates = [0.0]
    for valve in plant.valves:
        own = plant.elements.fastest[valve.first : valve.first + valve.count]
        rates += [float(np.min(own))] if own.size else []
    for y in _states(model, record):
        values = np.linalg.eigvals(_jacobian(model, y))
        rates += np.abs(values[np.abs(values.imag) > SWINGS * np.abs(values)]).tolist()
    return max(rates) / (2.0 * math.pi)


def _states(model: Model, record: Record) -> list[np.ndarray]:
    """States on the way in which each joint runs through its range in a second, so that dry
    friction does not hold it: where cylinders are at the start, and all where they are furthest
    out and in.
    """
    seen = [
        {
            channel: float(end(y))
            for channel, y in record.channels.items()
            if channel.rpartition(".")[2] in ("q", "x")
        }
        for end in (lambda y: y[0], np.min, np.max)
    ]
    command = model.commands_of(record)[0] if model.layout.played else None
    results = []
    for item in seen:
        y = model.posed(item, command)
        n = model.plant.at.rates
        for index, row in enumerate(model.plant.cylinders):
            low, high = sorted(model.stroke_range(index))
            y[n + row.joint] = high - low
        results.append(y)
    return results


def _jacobian(model: Model, y: np.ndarray) -> np.ndarray:
    """∂ẏ/∂y at a state with valves at rest, by central differences, shape (states, states)."""
    plant: Plant = model.plant
    weights = pace_of(plant, model.layout, LONGEST).weights * CLOSE
    steps = STEP / np.where(weights > 0.0, weights, 1.0)
    command, work = model.rest_commands(1)[0], np.empty(plant.at.work)

    def slope(at: np.ndarray) -> np.ndarray:
        dy = np.zeros(y.size)
        derivatives(at, command, plant, dy, work)
        return dy

    columns = [
        (slope(y + step * item) - slope(y - step * item)) / (2.0 * step)
        for step, item in zip(steps, np.eye(y.size), strict=True)
    ]
    return np.column_stack(columns)


def said(record: Record, means: BlockAverages) -> str:
    """As what a recording is compared, in words."""
    rates = (_rate(1.0 / tick) for tick in (means.each * record.sample_time, record.sample_time))
    return f"as means of {means.each} samples, {' of '.join(rates)}"


def _rate(rate: float) -> str:
    return f"{rate / 1e3:.3g} kHz" if rate >= 999.5 else f"{rate:.3g} Hz"
