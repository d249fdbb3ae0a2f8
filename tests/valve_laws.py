"""Valves that are no splines, and readings of their flow with noise."""

import itertools

import numpy as np

GPM = 3.785411784e-3 / 60.0
COMMANDS = np.array([0, 1, 1.25, 1.5, 1.75, 2, 2.25, 2.5, 3, 4, 5, 6, 7, 8, 9, 10.0])
DROPS = np.geomspace(1e5, 6.5e6, 12)
BAR, LPM = 1e5, 1e-3 / 60.0


def poppet(drop, command, deadband=1.6, rated=8 * GPM):
    """Orifice whose area saturates with the opening."""
    wide = np.maximum(command - deadband, 0) / (10 - deadband)
    return rated * (1 - np.exp(-1.6 * wide)) / (1 - np.exp(-1.6)) * np.sqrt(drop / 6.5e6)


def compensated(drop, command, deadband=1.62, rated=8 * GPM):
    """Pressure-compensated: levels off above some 600 kPa and then falls."""
    wide = np.maximum(command - deadband, 0) / (10 - deadband)
    level = (1 - np.exp(-((drop / 6e5) ** 0.8))) * (1 - 0.03 * drop / 1e6)
    return rated * np.tanh(1.15 * wide) / np.tanh(1.15) * level


def servo(drop, command):
    """Orifice law without a deadband, thesis 2.2."""
    return 3.59e-8 * command * np.sqrt(drop)


def readings(
    law, seed, *, drops=DROPS, commands=COMMANDS, trials=3, noise=0.01, limit=0.4 * GPM, scale=1.0
):
    """Turbine readings above ``limit`` and cylinder-speed readings below, each with noise."""
    rng, numbers = np.random.default_rng(seed), np.arange(1, trials + 1)
    command, drop, trial = map(np.ravel, np.meshgrid(commands, drops, numbers, indexing="ij"))
    drop = drop * (1 + 0.5 * noise * rng.standard_normal(drop.size))
    true = law(drop, command)
    slow = true < limit
    std = np.where(slow, np.hypot(0.3 * noise * GPM, 2 * noise * true), noise * np.hypot(GPM, true))
    flow = scale * (true + std * rng.standard_normal(drop.size))
    method = np.where(slow, "cylinder", "flowmeter")
    data = {"command": command, "pressure_drop": drop, "flow": flow}
    return data | {"method": method, "trial": trial.astype(int)}


def kinked(drop, command):
    """A sharp compensator: an orifice up to 6 bar, above it nearly level."""
    level = 4 * LPM * np.maximum(command - 1.5, 0.0)
    return level * np.sqrt(np.minimum(drop / (6 * BAR), 1.0)) * (1 - 0.001 * drop / BAR)


def kinked_readings(seed, commands, drops, trials, noise=0.005):
    rng, numbers = np.random.default_rng(seed), np.arange(1, trials + 1)
    command, drop, trial = map(np.ravel, np.meshgrid(commands, drops, numbers, indexing="ij"))
    true = kinked(drop * BAR, command)
    flow = true * (1 + noise * rng.standard_normal(drop.size))
    flow += 0.01 * LPM * (true > 0) * rng.standard_normal(drop.size)
    data = {"command": command, "pressure_drop": drop * BAR, "flow": flow}
    return data | {"trial": trial.astype(int)}


def soft(drop, command):
    """Onset that grows as a parabola over 0.6 V and is straight above, as round notches make it."""
    x = np.maximum(command - 1.4, 0.0)
    return 8 * GPM * np.where(x < 0.6, x**2 / 1.2, x - 0.3) / 8.3 * np.sqrt(drop / 6.5e6)


def jumping(drop, command):
    """An orifice that opens at 1.25 V with a twentieth of its flow at 10 V."""
    wide = (command - 1.25) / 8.75
    return 8 * GPM * np.where(wide > 0.0, 0.05 + 0.95 * wide, 0.0) * np.sqrt(drop / 6.5e6)


def parabola(drop, command):
    """Area that grows with the square of the opening all the way."""
    return 8 * GPM * (np.maximum(command - 1.2, 0.0) / 8.8) ** 2 * np.sqrt(drop / 6.5e6)


def two_lands(drop, command):
    """Two lands that open one after the other: a kink in the opening."""
    first, second = np.maximum(command - 1.1, 0) / 8.9, np.maximum(command - 3.1, 0) / 6.9
    return 8 * GPM * (0.3 * first + 0.7 * second) * np.sqrt(drop / 6.5e6)


def kinked_opening(kink, ratio):
    """An orifice whose area grows ``ratio`` times as fast above an opening."""

    def law(drop, command):
        x = np.maximum(command - 1.6, 0.0)
        area = np.where(command < kink, x, kink - 1.6 + ratio * (command - kink))
        return 8 * GPM * area / (kink - 1.6 + ratio * (10 - kink)) * np.sqrt(drop / 6.5e6)

    return law


def swept(law, seed, hysteresis, commands=COMMANDS):
    """Readings of two trials, each up and down at every drop, in the order they were taken."""
    rng = np.random.default_rng(seed)
    sweeps = itertools.product((1, 2), DROPS[::2], (1, -1))
    rows = [(u, drop, trial, way) for trial, drop, way in sweeps for u in commands[::way]]
    u, drop, trial, way = np.array(rows).T
    true = law(drop, np.maximum(u - 0.5 * way * hysteresis, 0.0))
    flow = true + 0.01 * np.hypot(0.3 * GPM, true) * rng.standard_normal(u.size)
    return {"command": u, "pressure_drop": drop, "flow": flow, "trial": trial.astype(int)}


def pressed(drop, command):
    """An orifice whose deadband grows by 0.6 V with the drop, which presses it to its seat."""
    wide = np.maximum(command - 1.4 - 0.6 * drop / 6.5e6, 0.0)
    return 8 * GPM * wide / 8.6 * np.sqrt(drop / 6.5e6)


def hump(drop, command):
    """Opens up to some 8.4 V and closes again above."""
    share = np.maximum(command - 1.6, 0.0) / 8.4
    return 8 * GPM * np.sin(0.62 * np.pi * share) * np.sqrt(drop / 6.5e6)


def leaky(goes_on):
    """A poppet with a leak beside it: below the deadband, or at every command."""

    def law(drop, command):
        beside = goes_on | (np.asarray(command) < 1.6)
        return poppet(drop, command) + beside * 0.05 * GPM * np.sqrt(drop / 6.5e6)

    return law
