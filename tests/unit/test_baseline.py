"""The black box beside a model: it follows what is linear, and speaks only where it may."""

import math

import numpy as np
import pytest

from ehbench.data.record import Record
from ehbench.validation.baseline import Arx, black_boxes, fit
from ehbench.validation.results import ChannelResult, LogResult

TICK = 1e-3


def log_of(seed: int, seconds: float = 4.0, noise: float = 0.0, level: float = 5e6) -> Record:
    """A pressure that rings after each step of a command, by the exact answer of its oscillator."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / TICK)) * TICK
    u = np.repeat(rng.uniform(-1.0, 1.0, 1 + t.size // 400), 400)[: t.size] * (t >= 0.2)
    decay, omega = 8.0, 50.0
    y = np.full(t.size, level)
    for i in np.flatnonzero(np.diff(u)) + 1:
        s = t[i:] - t[i]
        swing = np.cos(omega * s) + decay / omega * np.sin(omega * s)
        y[i:] += 1e6 * (u[i] - u[i - 1]) * (1.0 - np.exp(-decay * s) * swing)
    y += noise * rng.standard_normal(t.size)
    return Record(t, {"ram.p_head": y, "ram.spool.command": u})


def result(name: str, fit_percent: float, status: str = "held_out") -> LogResult:
    item = ChannelResult("ram.p_head", "Pa", fit_percent, 0.0, 0.0, 0.0)
    return LogResult(name, "none", status, 4.0, TICK, channels=(item,))


@pytest.mark.parametrize(("noise", "reached"), [(0.0, 99.5), (1.5e4, 90.0)])
def test_a_linear_channel_is_followed_at_another_level(noise, reached):
    results, box, _ = black_boxes(
        [result("b", 50.0)], [log_of(2, noise=noise, level=9e6)], [("a", log_of(1, noise=noise))]
    )
    assert results[0].channels[0].baseline_percent > reached
    assert box.fitted == ("a",) and box.counts


@pytest.mark.parametrize(
    ("fit_percent", "status", "keys"),
    [
        (50.0, "fitted", ["validation.black_box"]),  # the first log trains the black box
        (100.0, "fitted", []),
        (50.0, "held_out", []),  # not known what the model was fitted to: shown only
    ],
)
def test_the_verdict_counts_it_where_both_had_the_same_logs(fit_percent, status, keys):
    results = [result("a", 90.0, status), result("b", fit_percent)]
    shown, box, better = black_boxes(results, [log_of(1), log_of(2)])
    assert [text.key for text in better] == keys
    assert box.counts == (status == "fitted")
    assert shown[0].channels[0].baseline_percent is None
    assert shown[1].channels[0].baseline_percent > 99.0


@pytest.mark.parametrize(
    "training",
    [
        log_of(1, seconds=0.02),  # too short
        Record(log_of(1).t, {"ram.p_head": log_of(1)["ram.p_head"]}),  # no command
        Record(log_of(1).t, {"ram.spool.command": log_of(1)["ram.spool.command"]}),
        log_of(1).at(np.arange(4000) ** 2 % 4000 < 2000),  # uneven
    ],
)
def test_logs_that_support_none_give_none(training):
    shown, box, better = black_boxes([result("b", 10.0)], [log_of(2)], [("a", training)])
    assert shown[0].channels[0].baseline_percent is None
    assert (box.orders, better) == ({}, [])


def test_a_black_box_runs_where_its_channels_and_its_first_samples_are():
    box = Arx("ram.p_head", ("ram.spool.command",), 0.1, np.array([0.5, 0.1]), np.zeros(7))
    record = log_of(1)
    assert box.runs(record) and box.runs(record.at(slice(302)))
    assert not box.runs(record.at(slice(300)))  # two samples and one before: 0.3 s
    for name in record.channels:
        rest = {other: y for other, y in record.channels.items() if other != name}
        assert not box.runs(Record(record.t, rest))


def test_a_free_run_that_grows_stays_a_number_or_is_none():
    t = np.arange(3000) * TICK
    u = np.where(t > 0.1, 1.0, 0.0)
    growing = Record(t, {"ram.p_head": np.exp(20.0 * t), "ram.spool.command": u})
    long = Record(
        np.arange(60000) * TICK,
        {
            "ram.p_head": np.sin(np.arange(60000) * TICK),
            "ram.spool.command": np.ones(60000) * (np.arange(60000) > 100),
        },
    )
    box = fit("ram.p_head", [growing])
    assert box is not None and max(abs(np.roots([1.0, *-box.poles]))) > 1.0
    shown, _, better = black_boxes([result("b", 10.0)], [long], [("a", growing)])
    reached = shown[0].channels[0].baseline_percent
    assert better == [] and (reached is None or math.isfinite(reached))


@pytest.mark.parametrize("order", [1, 2, 4])
def test_a_free_run_is_its_own_recursion_from_the_first_samples(order):
    """``y(k) = Σ a(i) y(k − i) + Σ b(i) u⁺(k − i) + b⁻(i) u⁻(k − i) + c``, step by step."""
    rng = np.random.default_rng(order)
    poles = rng.uniform(-0.2, 0.2, order)
    inputs = rng.standard_normal(2 * (order + 1) + 1)
    t, u = np.arange(60) * TICK, rng.standard_normal(60)
    u[:10] = 0.0
    y = 3.0 + rng.standard_normal(60)
    box = Arx("ram.p_head", ("ram.spool.command",), TICK, poles, inputs)
    run = box.run(Record(t, {"ram.p_head": y, "ram.spool.command": u}))
    level = y[:10].mean()
    expected = list(y[:order] - level)
    for k in range(order, 60):
        value = sum(poles[i] * expected[k - 1 - i] for i in range(order)) + inputs[-1]
        for i in range(order + 1):
            value += inputs[2 * i] * max(u[k - i], 0.0) + inputs[2 * i + 1] * min(u[k - i], 0.0)
        expected.append(value)
    assert run == pytest.approx(level + np.array(expected), rel=1e-9)
