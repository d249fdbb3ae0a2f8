"""Where the first, the last, the smallest and the largest of things count, by hand."""

import math
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from ehbench.data.record import Record
from ehbench.flow_maps.shape import valley
from ehbench.identification import matching, results
from ehbench.identification.hydraulics import FitOptions, _decimate
from ehbench.identification.problem import at_values
from ehbench.plant.model import Model
from ehbench.validation import held_out, sweeps, transients
from tests import analytic_fit
from tests.settings import refusal
from tests.shared import shipped

ANY: Any = Stub()
SLIDE = shipped("slide_servo")


@pytest.mark.parametrize("least", [0, 1, 3])
@pytest.mark.parametrize("begin", [0, 1, 2, 3])
def test_a_valley_is_found_from_either_side(least, begin):
    assert valley(lambda i: abs(i - least), 4, begin) == least


def test_a_command_steps_from_its_last_level():
    command = np.array([-5.0, -5.1, -4.9, -4.0, -4.05, 4.0])
    assert transients.steps_only(command, 0.5).tolist() == [-5.0, -5.0, -5.0, -4.0, -4.0, 4.0]


def test_a_copy_goes_on_over_one_missing_sample_and_ends_at_two():
    t = np.arange(60) * 1e-3
    rows: Any = Stub(log="a", t=t)
    for missing, runs in ((1, 1), (2, 2)):
        same = np.ones(60, bool)
        same[30 : 30 + missing] = False
        assert len(held_out._runs(t, same, rows)) == runs


def test_a_command_sweeps_however_late_it_begins():
    wave = np.repeat(np.arange(100) % 2, 10)
    u = np.concatenate([np.zeros(3000), wave, np.repeat([1.0, 0.0, 1.0], 120)])
    for stand, swept in ((u[:4010], True), (u, False)):
        log = Record(np.arange(stand.size) * 1e-3, {"press.servo.command": 5.0 * stand})
        assert (sweeps._sweeping(log, Model.of(SLIDE), "press") is not None) == swept


@pytest.mark.parametrize(("each", "count", "key"), [
    (2, 399, "identification.short_log"),
    (2, 400, ""),
    (3, 599, "identification.large_means"),
])  # fmt: skip
def test_a_log_has_two_hundred_means(each, count, key):
    log = ("log", Record(np.arange(count) * 1e-3, {}))
    options = FitOptions(decimate=each)
    assert refusal(lambda: _decimate([log], options, lambda *_: {})) == key


def test_each_channel_says_in_its_own_size_how_late_it_is():
    """A stroke [m] is late, a pressure [Pa] is not and has more noise."""
    t = np.arange(4000) * 1e-3
    rng = np.random.default_rng(1)
    x, p = 1e-3 * np.sin(20.0 * t), 1e6 * np.sin(31.0 * t)
    late = 1e-3 * np.sin(20.0 * (t - 1e-3))
    recorded = np.column_stack([late, p + 1e5 * rng.standard_normal(t.size)])
    log: Any = Stub(name="log", channels=("a", "b"), recorded=recorded, sample_time=1e-3)
    log.counts = np.ones(recorded.shape, bool)
    (note,) = results._late(log, np.column_stack([x, p]))
    sure = x + 1e-6 * rng.standard_normal(t.size)
    still: Any = Stub(**vars(log) | {"recorded": np.column_stack([sure, recorded[:, 1]])})
    assert getattr(note, "key", "") == "identification.late"
    assert not results._late(still, np.column_stack([x, p]))


@pytest.mark.parametrize(("value", "side"), [(1.0, "lower"), (9.0, "upper")])
def test_a_parameter_at_a_bound_names_the_nearer_one(value, side):
    item: Any = Stub(name="bulk_modulus", value=value, lower=1.0, upper=9.0, status="at_bound")
    built: Any = Stub(rig=SLIDE, logs=())
    notes: Any = results._statuses([item], built)
    assert notes[0].fields["side"] == side


def test_values_at_bounds_begin_just_inside():
    asked = analytic_fit.problem()
    low, high = asked.bounds(range(3)).T
    for edge, way in ((low, 1.0), (high, -1.0)):
        values = dict(zip(analytic_fit.NAMES, np.exp(edge), strict=True))
        off = way * (at_values(asked, values).theta - edge)
        reach = np.array([c.reach for c in asked.search])
        assert off == pytest.approx(1e-3 * reach, rel=1e-6)


def test_one_window_tells_a_parameter_by_its_own_error_alone():
    work: Any = object.__new__(matching.Matching)
    ring = Stub(natural_frequency_std=0.02, natural_frequency=2.0, damping_ratio_std=0.0)
    work.search = [Stub(row=Stub(mode_role="frequency"))]
    work.windows = [Stub(recorded=ring)] * 2
    one, two = np.array([0.1, math.nan]), np.array([0.1, 0.1])
    assert work._scatter(0, one, 0.5) == pytest.approx((0.02, norm.ppf(0.975), 1))
    std, quantile, count = work._scatter(0, two, 0.5)
    # of two windows, Student's t with one degree of freedom at 95 %
    assert (std, count) == (pytest.approx(0.02 / math.sqrt(2.0)), 2)
    assert quantile == pytest.approx(math.tan(math.pi * 0.475), rel=1e-9)
