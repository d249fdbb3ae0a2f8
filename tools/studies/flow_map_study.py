"""Whether the intervals of flow maps hold on random valves that share no code with the package.

python -m tools.studies.flow_map_study [VALVES] [SEED]

Orifices, compensated and curved laws; openings that are linear, curved, saturating or of two
slopes; starts that are sharp or soft; deadbands that shift with the drop or not; grids with
commands near the deadband, even ones and coarse ones; noise from 0.3 to 2 %. Prints which share of
a map the intervals hold, by volts above the deadband, and the median standard error there."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from ehbench.flow_maps.readings import readings_table
from ehbench.flow_maps.results import fit_flow_map
from ehbench.vocabulary.errors import InsufficientData

LPM, BAR = 1.0 / 6.0e4, 1.0e5
BANDS = ((0.0, 0.3), (0.3, 0.6), (0.6, 1.5), (1.5, 4.0), (4.0, 10.0))  # [V] above the deadband
Law = Callable[[np.ndarray, np.ndarray], np.ndarray]


def openings(rng: np.random.Generator) -> Law:
    """Share of the largest flow by share of the opening."""
    power, steep = rng.uniform(1.0, 1.8), rng.uniform(0.8, 2.0)
    knee, ratio = rng.uniform(0.25, 0.6), rng.uniform(0.3, 2.5)
    return [
        lambda y, _: y,
        lambda y, _: y**power,
        lambda y, _: np.tanh(steep * y) / np.tanh(steep),
        lambda y, _: np.where(y < knee, y * ratio, knee * ratio + (y - knee)),
    ][int(rng.integers(4))]


def drops(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Share of the largest flow by the drop [bar]."""
    level, power = rng.uniform(5.0, 25.0), rng.uniform(0.45, 0.6)
    return [
        lambda p: (p / 100.0) ** 0.5,
        lambda p: (1.0 - np.exp(-((p / level) ** 0.8))) * (1.0 - 0.0004 * p),
        lambda p: (p / 100.0) ** power,
    ][int(rng.integers(3))]


def valve(rng: np.random.Generator) -> tuple[Law, Callable[[np.ndarray], np.ndarray], float]:
    """(flow [m³/s] at drops [Pa] and commands [V], deadband [V] at drops, the rated flow)."""
    start, rated = rng.uniform(0.3, 2.5), rng.uniform(10.0, 120.0) * LPM
    shift = rng.uniform(-0.004, 0.006) if rng.random() < 0.4 else 0.0  # [V/bar]
    soft = rng.uniform(0.02, 0.12) if rng.random() < 0.4 else 0.0  # [V]
    opening, by_drop = openings(rng), drops(rng)

    def deadband(drop: np.ndarray) -> np.ndarray:
        return start + shift * drop / BAR

    def flow(drop: np.ndarray, command: np.ndarray) -> np.ndarray:
        wide = command - deadband(drop)
        wide = soft * np.logaddexp(0.0, wide / soft) if soft else np.maximum(wide, 0.0)
        wide = np.where(wide < 1e-4, 0.0, wide)
        return rated * opening(wide / (10.0 - start), wide) * by_drop(drop / BAR)

    return flow, deadband, rated


def commands(rng: np.random.Generator, start: float) -> np.ndarray:
    """The commands [V] of a test: near the deadband, even, or few."""
    tail = np.linspace(np.ceil(start + 1.5), 10.0, 5)
    near = np.round(start + np.array([-0.4, -0.2, 0.0, 0.2, 0.4, 0.7, 1.0]), 1)
    grids = [
        np.concatenate([[0.0], near, tail]),
        np.arange(0.0, 10.5, 0.75 if rng.random() < 0.5 else 1.0),
        np.concatenate([near[[0, 3]] + 0.1, np.linspace(np.ceil(start + 1.0), 10.0, 5)]),
    ]
    return np.unique(np.clip(grids[int(rng.integers(3))], 0.0, 10.0))


def held(rng: np.random.Generator) -> tuple[list[float], list[float]]:
    """(share of the map that the intervals hold, median standard error over the flow) by band.

    Raises:
        InsufficientData: the readings make no map."""
    flow, deadband, rated = valve(rng)
    bars = np.geomspace(3.0, 150.0, int(rng.integers(5, 11)))
    grid = commands(rng, float(deadband(np.zeros(1))[0])), bars * BAR, np.arange(rng.integers(2, 4))
    command, drop, trial = map(np.ravel, np.meshgrid(*grid, indexing="ij"))
    true, noise = flow(drop, command), rng.choice([0.003, 0.01, 0.02])
    read = true * (1.0 + noise * rng.standard_normal(true.size))
    read += 0.002 * rated * rng.standard_normal(true.size)
    read = np.where(true > 0.0, read, 0.0)
    built = fit_flow_map("v", "forward", readings_table(command, drop, read, trial=trial)).map
    command, drop = np.meshgrid(np.linspace(0.0, 10.0, 400), np.geomspace(3.0, 150.0, 40) * BAR)
    true, std = flow(drop, command), np.asarray(built.flow_std(drop, command))
    inside = np.abs(built.flow(drop, command) - true) <= 1.96 * std + 1e-12 * rated
    above, among = command - deadband(drop), np.asarray(built.inside(drop, command))
    places = [among & (above > low) & (above <= high) for low, high in BANDS]
    relative = std / np.maximum(true, 0.01 * rated)
    return (
        [float(inside[at].mean()) if at.any() else np.nan for at in places],
        [float(np.median(relative[at])) if at.any() else np.nan for at in places],
    )


def main(count: int = 60, seed: int = 1) -> None:
    """Print the table of so many valves."""
    shares, errors, refused = [], [], 0
    for number in range(count):
        try:
            share, error = held(np.random.default_rng([seed, number]))
        except InsufficientData:
            refused += 1
            continue
        shares.append(share)
        errors.append(error)
        print(f"valve {number}: {100.0 * min(filter(np.isfinite, share)):.0f} %", file=sys.stderr)
    print(f"{len(shares)} maps, {refused} refused")
    for band, share, error in zip(BANDS, np.nanmean(shares, 0), np.nanmedian(errors, 0)):
        low, high = band
        print(f"{low} to {high} V: {share:.1%} held, standard error {error:.1%} of the flow")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
