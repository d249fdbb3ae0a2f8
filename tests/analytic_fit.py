"""A problem of output error whose simulations are a closed form: steps of a ringing stroke.

    x(t) = gain · (1 − e^(−d t) (cos ωt + d/ω sin ωt)) + start · e^(−d t) cos ωt,  ω² ∝ oil

A fourth parameter may be a `LAG`, behind which the step comes, or a `TWIN` that multiplies the
gain."""

from collections.abc import Sequence
from types import SimpleNamespace as Stub

import numpy as np

from ehbench.identification.problem import Problem, problem_of
from ehbench.identification.search import Coordinate

NAMES = ("bulk_modulus", "carriage.damping", "press.servo_supply_head.flow_gain")
TRUTH = (1e9, 1.2, 0.05)  # ω = 4 Hz, d = 1.2/s, a step of 50 mm
LAG, TWIN = "press.valve.natural_frequency", "press.servo_rod_tank.flow_gain"
OFFSET = 0.2  # prior standard deviations that each log's start is off
T = np.arange(600) * 2e-3


def stroke(values: Sequence[float], offset: float, side: float, more: str = "") -> np.ndarray:
    """Stroke and speed [m, m/s] after a step to one side, shape (samples, 2); ``more`` names the
    fourth of the values."""
    bulk, decay, gain = values[:3]
    omega = 8.0 * np.pi * np.sqrt(bulk / 1e9)
    wave, fade = np.cos(omega * T), np.exp(-decay * T)
    x = side * gain * (1.0 - fade * (wave + decay / omega * np.sin(omega * T)))
    if more:
        x = x * (values[3] if more == TWIN else 1.0 - np.exp(-values[3] * T))
    x = x + 1e-3 * offset * fade * wave
    return np.column_stack([x, np.gradient(x, T)])


class Closed:
    """What a search asks of a simulator, in closed form, and how often it did."""

    def __init__(self, logs, more=""):
        self.logs, self.effort = tuple(logs), Stub(evaluations=0, iterations=0)
        self.more = more

    def over(self, logs):
        return self

    def chosen(self, which):
        return self.logs if which is None else [self.logs[i] for i in which]

    def unshifted(self):
        return [np.zeros(1) for _ in self.logs]

    def fixed_errors(self):
        return {}

    def misfit(self, values):
        return ""

    def each(self, points, meshes=None, slack=1.0):
        self.effort.evaluations += len(points)
        row = [stroke(v, shift[0], self.logs[k].side, self.more) for v, k, shift in points]
        return row, meshes or [np.zeros(1) for _ in self.logs]

    def simulate(self, vectors, chosen=None, shifts=None, slack=1.0):
        which = range(len(self.logs)) if chosen is None else chosen
        return [self.each([(v, k, shifts[k]) for k in which])[0] for v in vectors]


def log_of(k: int, noise: float, seed: int) -> Stub:
    """A recorded step, out or back, with white noise."""
    rng, side = np.random.default_rng([seed, k]), 1.0 - 2.0 * (k % 2)
    y = stroke(TRUTH, OFFSET, side)
    y = y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape)
    doubt = Stub(name="press.x0", std=1e-3, share=1e-2)
    log = Stub(name=f"log {k}", side=side, channels=("press.x", "press.v"), recorded=y)
    log.record, log.seen = {}, Stub(apart=lambda channel: 1)
    log.start = Stub(terms=(), uncertain=(doubt,), moves=True)
    log.counts, log.sample_time, log.each, log.commanded = (
        np.ones(y.shape, bool),
        2e-3,
        1,
        ("press",),
    )
    log.within, log.coarse, log.band = np.zeros(2), np.zeros(2), None
    log.head = lambda seconds: log
    return log


def problem(factors=(1.0, 1.0, 1.0), noise=0.02, more=(), upper=(1e3,) * 3, **given) -> Problem:
    """A search that begins so many times the truth off, up to ``upper`` times the truth; ``more``:
    name, start, bounds and prior of a fourth parameter."""
    rows = zip(NAMES, TRUTH, factors, upper, strict=True)
    search = [Coordinate(n, True, 1.0, f * x, x / 1e3, top * x) for n, x, f, top in rows]
    if more:
        search.append(Coordinate(more[0], True, 1.0, *more[1:]))
    logs = [log_of(k, noise, given.get("seed", 1)) for k in range(2)]
    return problem_of(Closed(logs, more and more[0]), search, None, 100)
