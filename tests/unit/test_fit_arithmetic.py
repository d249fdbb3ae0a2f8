"""Notes, steps and errors of a fit on small arrays, against closed forms and independent sums."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.data.record import BlockAverages, Record
from ehbench.frequency_response.response import Averaging
from ehbench.identification import (
    basins,
    descent,
    estimate,
    frequency_domain,
    hydraulics,
    matching,
    means,
    results,
    sensitivity,
    simulator,
    uncertainty,
)
from ehbench.identification import problem as problem_module
from ehbench.identification.band import Band
from ehbench.identification.covariance import Block
from ehbench.identification.descent import carried, step
from ehbench.identification.frequency_domain import followed, on_response
from ehbench.identification.journal import Journal
from ehbench.identification.problem import (
    Mesh,
    Point,
    Problem,
    State,
    at_values,
    cost,
    effects,
    evaluate,
    initial,
    jacobian,
    pooled,
    towards,
    weighed,
)
from ehbench.identification.results import Lean, Moved
from ehbench.identification.search import Coordinate
from ehbench.identification.sensitivity import _logs_of, _read_off, _terms
from ehbench.identification.simulator import Effort, Log
from ehbench.identification.uncertainty import _fitted
from ehbench.plant.model import Model
from ehbench.plant.paced import AUTO
from ehbench.preprocessing import observations
from ehbench.preprocessing.sensors import VAGUE
from ehbench.signals.series import Ringing, correlation_time
from ehbench.vocabulary.errors import InputError, InsufficientData
from ehbench.vocabulary.terms import BEYOND, CORRELATED, Z95
from tests import analytic_fit
from tests.settings import answers
from tests.shared import refused, shipped

TICK = 1e-3


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def log_of(counts=None, **channels: np.ndarray) -> Log:
    """A log of the slide whose channels have these words; those of ``command`` are not compared."""
    names = {
        f"press.{name}" if name != "command" else "press.servo.command": name for name in channels
    }
    every = {name: channels[word] for name, word in names.items()}
    compared = [name for name in every if not name.endswith("command")]
    recorded = np.column_stack([every[name] for name in compared])
    record = Record(np.arange(len(recorded)) * TICK, every)
    counts = np.ones(recorded.shape, bool) if counts is None else counts
    start: Any = Stub(terms=(), uncertain=())
    who = ("press",)
    return Log("log", record, None, who, who, tuple(compared), recorded, counts, start)


WAVE = np.column_stack([1e-3 * np.sin(0.05 * np.arange(400)), 1e3 * np.cos(0.03 * np.arange(400))])


@pytest.mark.parametrize(
    ("ticks", "key"),
    [(0.2, None), (0.3, "late"), (-0.3, "early"), (4.5, "late"), (-4.5, "early"), (5.2, None)],
)
def test_a_log_is_late_by_the_slope_of_its_simulation(rng, ticks, key):
    """Of channels of all sizes, each by its residual; one sample that does not count is far off."""
    slope = np.gradient(WAVE, TICK, axis=0)
    recorded = WAVE - ticks * TICK * slope
    recorded[:, 1] += 20.0 * rng.standard_normal(400)
    recorded[7] += 9e9
    log = log_of(np.arange(400)[:, None] != [7, 7], v=recorded[:, 0], p_head=recorded[:, 1])
    notes: Any = results._late(log, WAVE)
    assert [note.key for note in notes] == ([f"identification.{key}"] if key else [])
    left, use = WAVE - recorded, np.arange(400) != 7
    size = np.sqrt(np.sum(left[use] ** 2, axis=0) / 400)
    pair = [(item[use] / size).reshape(-1, 1) for item in (slope, left)]
    best = float(np.linalg.lstsq(*pair, rcond=None)[0][0, 0])
    assert not notes or notes[0].fields["delay"] == pytest.approx(1e3 * abs(best), rel=1e-9)
    assert results._late(log_of(v=WAVE[:, 0]), np.ones((400, 1))) == []  # what stands still


@pytest.mark.parametrize(("noise", "told"), [(1.2, 1), (2.2, 0)])
def test_a_channel_that_goes_the_other_way_has_a_correlation_below_a_half(rng, noise, told):
    """About its mean, of what counts; one of which nothing does and a still one go no way."""
    wave = WAVE[:, :1] + 5.0
    y = -wave + noise * 7e-4 * rng.standard_normal(wave.shape)
    y[:100] = 99.0 * wave[:100]
    counts = np.ones((400, 3), bool)
    counts[:100, 0] = counts[:, 1] = False
    log = log_of(counts, v=y[:, 0], p_head=-wave[:, 0], p_rod=-wave[:, 0])
    notes: Any = results._turned(log, np.hstack([wave, wave, np.ones((400, 1))]))
    assert len(notes) == told
    likeness = np.corrcoef(y[100:, 0], wave[100:, 0])[0, 1]
    assert not told or notes[0].fields["likeness"] == pytest.approx(likeness)
    assert not told or notes[0].fields["channel"] == "press.v"


def test_how_a_log_fits_is_of_what_counts(rng):
    """Of a channel of which nothing does it is shown of all."""
    y = rng.standard_normal((60, 2))
    counts = np.column_stack([np.arange(60) >= 20, np.zeros(60, bool)])
    simulated = y + rng.standard_normal((60, 2))
    fit = results._log_fit(log_of(counts, v=y[:, 0], p_head=y[:, 1]), simulated, None)
    assert (fit.samples, fit.mean_of, fit.payload) == (60, 1, "none")
    for i, (name, some) in enumerate([("press.v", slice(20, 60)), ("press.p_head", slice(60))]):
        left, about = (simulated - y)[some, i], y[some, i] - y[some, i].mean()
        assert fit.residual_rms[name] == pytest.approx(np.sqrt(np.mean(left**2)))
        share = np.linalg.norm(left) / np.linalg.norm(about)
        assert fit.fit_percent[name] == pytest.approx(100.0 * (1.0 - share))
        assert fit.correlation_time[name] == pytest.approx(correlation_time(left))
    assert fit.counted == {"press.v": pytest.approx(200.0 / 3.0), "press.p_head": 0.0}


def left_over(rng, fit_percent, times, counted=True):
    """What is said of a speed that is followed so, with so many times its noise left, in a log
    whose head end is worse but may not count."""
    y = rng.standard_normal((4000, 2))
    log = log_of(np.tile([True, counted], (4000, 1)), v=y[:, 0], p_head=y[:, 1])
    noise = {c: results.noise_of(log.record, c) for c in log.channels}
    fits: Any = Stub(fit_percent={"press.v": fit_percent, "press.p_head": 10.0})
    fits.residual_rms = {"press.v": times * noise["press.v"], "press.p_head": 9.0}
    return results._left_over([log], [fits])


def test_what_is_left_over_is_of_the_channel_that_is_followed_worst(rng):
    worst: Any = left_over(rng, 70.0, 4.0)
    assert worst.fields["channel"] == "press.p_head"
    note: Any = left_over(rng, 70.0, 4.0, counted=False)
    assert (note.fields["channel"], note.fields["log"]) == ("press.v", "log")
    assert note.fields["share"] == pytest.approx(30.0)
    assert note.fields["times"] == pytest.approx(4.0)
    assert left_over(rng, 70.0, 2.0, False) == left_over(rng, 95.0, 4.0, False) == ""


def test_logs_that_are_compared_as_means_are_listed_by_how_many():
    plain = log_of(v=np.arange(60.0))
    tens, fives = (
        replace(plain, name=f"of {n}", means=BlockAverages.of(plain.record, n)) for n in (10, 5)
    )
    assert results._compared([plain]) == ()
    one, two = results._compared([plain, tens, replace(tens, name="b"), fives])
    assert (one.key, one.fields["logs"]) == ("identification.are_compared", "of 10 and b")
    assert (two.key, two.fields["logs"]) == ("identification.is_compared", "of 5")
    (every,) = results._compared([tens, replace(tens, name="b")])
    assert every.fields["logs"] == "all logs"
    (alone,) = results._compared([tens])
    assert alone.fields["logs"] == "of 10" and "100 Hz" in alone and "1 kHz" in alone


@dataclass(frozen=True)
class Begins:
    """Where a log starts."""

    record: Record | None = None
    terms: tuple = ()
    uncertain: tuple = ()


@pytest.mark.parametrize(("seconds", "count"), [(1.0, 2100), (2.5, 2750), (2.6, 4000)])
def test_the_head_of_a_log_has_two_steps_out_and_back(seconds, count):
    """Four changes of the command, here to 2 s, and a tenth more; whole, if that is most of it."""
    command = np.searchsorted([500, 1000, 1500, 2000, 2500], np.arange(4000), side="right") % 2
    log = replace(log_of(v=np.arange(4000.0), command=1.0 * command), start=Begins())
    assert len(log.head(seconds).recorded) == count
    assert (log.head(seconds) is log) == (count == 4000)
    tens = replace(log, means=BlockAverages.of(log.record, 10))
    tens = replace(tens, recorded=log.recorded[::10], counts=log.counts[::10])
    short = tens.head(seconds)
    assert (len(short.recorded), short.record.t.size, short.seen.t.size) == (
        count // 10, count, count // 10)  # fmt: skip


def test_what_is_freed_has_no_prior():
    prior = Stub(sharpness=np.array([2.0]), off=np.array([0.5]), weight=0.7)
    given: list = []
    with answers(sensitivity, prior_of=prior, _with=None,
                 release_of=lambda _, known, minimum: given.append((known, minimum))):  # fmt: skip
        sensitivity._release(Stub(), Stub(state=Stub(live=(0,))), Stub(), 3.0)
    ((known, minimum),) = given
    assert (known.sharpness.tolist(), known.off.tolist()) == ([2.0, 0.0], [0.5, 0.0])
    assert (known.weight, minimum) == (0.7, 3.0)


def test_means_leave_out_what_is_white_in_them(rng):
    """Of ten samples all but a tenth of its power; every sample leaves out nothing."""
    noise = 0.3 * rng.standard_normal(20000)
    plain = log_of(v=noise, p_head=np.arange(20000.0))
    tens = replace(plain, means=BlockAverages.of(plain.record, 10))
    assert tens.within == pytest.approx([0.3 * math.sqrt(0.9), 0.0], rel=0.03, abs=1e-6)
    assert plain.within.tolist() == [0.0, 0.0]
    spectral: Any = Stub()
    assert replace(plain, band=spectral).coarse.tolist() == [0.0, 0.0]


def test_what_is_not_excited_stays_at_its_start_and_is_of_the_data():
    place = Coordinate("carriage.damping", True, 1.0, 2.0, 0.5, 4.0)
    item = results.not_excited(place, 9)
    assert (item.value, item.start, item.lower, item.upper, item.samples) == (2.0, 2.0, 0.5, 4.0, 9)
    assert (item.std, item.interval, item.prior, item.from_data, item.from_starts) == (
        None, None, None, 1.0, 0.0)  # fmt: skip


def test_a_parameter_that_its_range_tells_is_as_sure_as_that_is_wide():
    place = Coordinate("carriage.damping", True, 1.0, 2.0, 0.5, 4.0)
    counts = np.array([[True, False], [False, False], [True, True]])
    log = Stub(each=10, counts=counts)
    asked: Any = Stub(search=[place], logs=[log, log])
    state: Any = Stub(theta=[math.log(2.0)], ranges={0: (math.log(1.0), math.log(3.0))})
    item = _fitted(asked, state, Stub(by_index={}), 0)
    assert item.interval == pytest.approx((1.0, 3.0)) and item.std == pytest.approx(1.0 / Z95)
    assert (item.status, item.error_from, item.samples) == ("estimated", "range", 40)


@pytest.mark.parametrize(
    ("size", "alone", "std", "likeness", "inside", "kind"),
    [
        (1.1, 0.9, 0.9, 0.99, (0, 1), "estimated"),
        (0.9, 0.9, 0.9, 0.99, (0, 1), "not_excited"),
        (1.1, 1.1, 0.9, 0.99, (0, 1), "not_excited"),
        (1.1, 0.9, 1.1, 0.99, (0, 1), "correlated"),
        (1.1, 0.9, 0.9, -1.01, (0, 1), "correlated"),
        (1.1, 0.9, 0.9, -1.01, (0,), "estimated"),  # the other is known at its bound
        (1.1, 0.9, 1.1, 0.99, (1,), "at_bound"),
    ],
)
@pytest.mark.parametrize("log", [True, False])
def test_an_error_means_what_its_sizes_say(size, alone, std, likeness, inside, kind, log):
    """In units of what is faint, vague and correlated."""
    place = Coordinate("carriage.damping", log, 1.0, 2.0, 0.5, 4.0)
    vague = uncertainty.VAGUE[log]
    match = Stub(correlation=np.array([[1.0, likeness * CORRELATED], [likeness * CORRELATED, 1.0]]),
                 error=lambda k: ([std, 0.1][k] * vague, 2.0 + k, "acf"), hac=np.eye(2),
                 alone=vague * np.array([alone, 0.1]), from_data=np.array([0.5, 1.0]),
                 from_starts=np.array([0.25, 0.0]), from_fixed=np.array([0.75, 0.0]),
                 whole=np.array([[4.0, 1.0], [1.0, 1.0]]))  # fmt: skip
    asked: Any = Stub(search=[place, replace(place, name="bulk_modulus")])
    state: Any = Stub(live=(0, 1))
    with answers(uncertainty, linearised=[], covariance_of=match, prior_of=None,
                 effects=uncertainty.PROBLEM.faint * np.array([size, 9.0]), fixed_changes=[],
                 _at_bound=lambda _, __, i: i not in inside):  # fmt: skip
        found = uncertainty.errors_of(asked, state)
    error = found.by_index[0]
    assert (error.kind, error.std, error.quantile) == (kind, std * vague, 2.0)
    shares = error.from_data, error.from_starts, error.from_fixed
    assert (error.source, *shares) == ("acf", 0.5, 0.25, 0.75)
    names = ("carriage.damping", "bulk_modulus")
    assert found.names == tuple(names[k] for k in inside)
    assert found.by_logs.shape == found.correlation.shape == (len(inside), len(inside))
    if len(inside) == 2:
        assert (found.by_logs[0, 1], found.correlation[0, 1]) == (likeness * CORRELATED, 0.5)


# --- frequency responses


@pytest.mark.parametrize(("level", "scatter"), [(80.0, 0.0), (80.0, 0.2), (1e-3, 0.0)])
def test_a_response_is_late_by_the_slope_of_its_phase(level, scatter):
    """Least squares of the difference by ω, each number by its size; one error is the least."""
    f = np.linspace(1.0, 9.0, 33)
    size = level / f
    bend = scatter * np.where(np.arange(33) % 3, 1.0, -1.0)
    seen = size * np.exp(-1j * (2.0 * np.pi * f * 4e-3 + bend))
    band = Band("u", Averaging(), np.arange(33), f, np.ones((33, 1)))
    pair = (np.concatenate([y.real, y.imag]) for y in (size + 0j, seen))
    late, error = band.lateness(*pair)
    slope, off = 2.0 * np.pi * f * size, size * (2.0 * np.pi * f * 4e-3 + bend)
    best = float(np.linalg.lstsq(slope[:, None], off, rcond=None)[0][0])
    assert late == pytest.approx(best, rel=1e-9)
    spread = max(1.0, float(np.sum((off - best * slope) ** 2)) / 32.0)
    assert error == pytest.approx(math.sqrt(spread / float(slope @ slope)), rel=1e-9)
    assert bool(scatter) == (spread > 1.0)


def test_a_late_response_is_told_with_its_interval_in_milliseconds():
    """Where it is late by more than its error and a part of a sample."""
    log: Any = Stub(name="log", channels=("a", "b", "c"), record=Stub(sample_time=TICK))
    log.band = Stub(command="u", lateness=lambda built, seen: (built[0], seen[0]))
    log.recorded = np.array([[1e-4, 1e-3, 1.0]])
    notes: Any = frequency_domain.late_responses(log, np.array([[0.02, -0.03, 0.05]]))
    told = [(n.fields["channel"], n.fields["word"], n.fields["delay"]) for n in notes]
    assert told == [("a", "behind", pytest.approx(20.0)), ("b", "ahead of", pytest.approx(30.0))]
    assert [n.fields["half"] for n in notes] == pytest.approx([0.196, 1.96], rel=1e-3)


def test_what_a_channel_answers_nowhere_is_known_of_nothing():
    band = Band("u", Averaging(), np.arange(4), np.arange(1.0, 5.0), np.ones((4, 1)))
    assert band.lateness(np.zeros(8), np.zeros(8)) == pytest.approx((0.0, 1e150))
    one = np.eye(8)[1]
    late = band.lateness(one, np.append(np.zeros(5), -1.0) @ np.eye(6, 8))  # at 2 Hz, by 90°
    assert late == pytest.approx((0.125, 1.0 / (4.0 * math.pi)))


def test_a_log_is_compared_by_its_response_in_units_of_its_errors(rng):
    """A gain of 2 of a command that has all frequencies: 1 % is the least error."""
    u = rng.standard_normal(8192)
    log = on_response(
        log_of(v=2.0 * u, x=0.5 * rng.standard_normal(8192) + u, command=u),
        "press.servo.command",
        Averaging(frequency=200.0, segment=0.512),
    )
    band: Any = log.band
    assert band.frequency[-1] <= 200.0 and band.frequency[-1] > 190.0
    gain, rest = log.recorded[: band.at.size, 0], log.recorded[band.at.size :, 0]
    assert gain == pytest.approx(np.full(gain.size, 100.0)) and np.abs(rest).max() < 1e-6
    assert log.counts.shape == log.recorded.shape == (2 * band.at.size, 2)
    assert np.isfinite(band.errors[:, 1]).mean() == log.counts[:, 1].mean() < 1.0
    still = Record(log.record.t, log.record.channels | {"press.x": np.zeros(8192)})
    speed, stroke = followed(log, still)
    assert speed.simulated is not None and stroke.simulated is None
    assert (speed.coherence, speed.channel) == (band.choice.coherence, "press.v")


# --- steps


def test_a_step_gains_what_it_should_of_a_quadratic_and_ends_at_its_least(rng):
    """Two logs with a start each, a prior on one parameter; λ of the normal matrix's diagonal."""
    jacobians, starts = rng.standard_normal((2, 30, 1, 2)), rng.standard_normal((2, 30, 1, 1))
    residuals, shifts = rng.standard_normal((2, 30, 1)), rng.standard_normal((2, 1))
    search = [Coordinate(n, False, 1.0, 0.0, -9.0, 9.0) for n in ("a", "b")]
    search[1] = replace(search[1], prior=0.5, centre=0.3)
    fields = {"search": search, "bounds": lambda _: np.array([[-9.0, 9.0]] * 2)}
    asked: Any = Stub(simulator=Stub(misfit=lambda _: ""), values=lambda theta: theta, **fields)
    state = State(np.array([0.2, -0.1]), [*shifts], {}, np.ones((2, 2)), (0, 1), prior_weight=0.7)
    blocks = [
        Block(("v",), *given, np.zeros((30, 1)), np.zeros(1))
        for given in zip(jacobians, starts, residuals, shifts, strict=True)
    ]
    theta, moved, gain = step(asked, state, blocks, 0.0)

    def price(theta, shifts):
        left = residuals[..., 0] + jacobians[:, :, 0] @ (theta - state.theta)
        left = left + starts[:, :, 0, 0] * (np.ravel(shifts) - shifts_before)[:, None]
        known = np.sum(np.square(shifts)) + ((theta[1] - 0.3) / 0.5) ** 2
        return float(np.sum(left**2) + 0.7 * known)

    shifts_before = np.ravel(shifts)
    least = price(theta, moved)
    assert gain == pytest.approx(price(state.theta, shifts) - least, rel=1e-9)
    for k in range(4):
        for side in (1e-3, -1e-3):
            off = np.eye(4)[k] * side
            assert price(theta + off[:2], np.ravel(moved) + off[2:]) > least
    held, _, less = step(asked, state, blocks, 1e3)
    assert 0.0 < less < gain and np.abs(held - state.theta).max() < 2e-3


@pytest.mark.parametrize(
    ("gained", "secant", "anew", "damping"),
    [
        (0.9, False, False, 0.2),
        (0.7, False, True, 0.2),
        (0.7, True, False, 0.2),
        (1.2, False, False, 0.2),
        (1.3, False, True, 0.2),
        (0.2, False, True, 2.0),  # not a quarter of what it should gain
    ],
)
def test_a_step_that_gains_what_it_should_leaves_the_starts_as_they_are(
    gained, secant, anew, damping
):
    here, there, origin = (Stub(free=()) for _ in range(3))
    asked: Any = Stub(simulator=Stub(effort=Effort()), report=lambda *_: None)
    given = {"linearised": [], "start_jacobian": [], "step": (here, [], 2.0), "evaluate": there}
    given |= {"carried": there, "cost": lambda _, state: 10.0 - 2.0 * gained * (state is there)}
    with answers(descent, **given):
        before: Any = descent._Descent(here, origin, 2.0, 4)
        after = descent._stepped(asked, before, 1e-3, secant)
    assert after is not None and after.state is there and after.steps == 5
    assert after.origin is (there if anew else origin)
    assert after.damping == pytest.approx(damping)


def test_derivatives_that_are_carried_explain_the_step_by_the_size_of_their_effect():
    """Of two parameters and a start; the second log knows one alone. Nothing turns without a
    step."""
    mesh: Any = None
    columns = {(0, 0): [2.0, 0.0], (1, 0): [0.0, 1.0], (0, 1): [0.0, 4.0]}
    columns = {key: np.array(column) for key, column in columns.items()}
    begin = np.array([1.0, 2.0])
    before = Point(begin, [np.array([0.5]), np.zeros(1)], [begin] * 2, mesh, columns)
    before.start_columns[0, 0] = np.ones(2)
    state = State(before.theta, before.shifts, {}, np.ones((2, 2)), (0, 1), point=before)
    after = [np.array([1.5, 1.0]), np.array([1.0, 3.0])]
    there = Point(np.array([1.1, 1.8]), [np.array([0.8]), np.ones(1)], after, mesh)
    found = carried(replace(state, point=there), state).here
    left = np.array([0.5 - 0.3 - 0.2, -1.0 - 0.3 + 0.2])
    total = 0.01 * 20.0 + 0.04 * 1.0
    assert found.columns[0, 0] == pytest.approx([2.0, 0.0] + left * 0.1 * 20.0 / total)
    assert found.columns[1, 0] == pytest.approx([0.0, 1.0] + left * -0.2 * 1.0 / total)
    assert found.columns[0, 1] == pytest.approx([0.0, 4.0 + 0.6 * 0.1 * 20.0 / total])
    assert (1, 1) not in found.columns and found.start_columns == before.start_columns
    stays = carried(replace(state, point=replace(there, theta=before.theta)), state).here
    assert all((stays.columns[key] == column).all() for key, column in columns.items())


@pytest.mark.parametrize(
    ("theta", "shift", "slack", "serves"),
    [(0.0, 0.0, 1.0, True), (0.019, 0.9, 1.0, True), (-0.021, 0.0, 1.0, False),
     (0.0, -1.1, 1.0, False), (0.0, 0.0, 100.0, False)],
)  # fmt: skip
def test_steps_serve_a_point_that_is_near(theta, shift, slack, serves):
    mesh = Mesh(np.array([0.0, 5.0]), [np.zeros(1), np.zeros(2)], [], 1.0)
    moved = [np.zeros(1), np.array([0.0, shift])]
    assert mesh.serves(np.array([0.0, 5.0 + theta]), moved, slack) == serves


# --- options


WHERE: Any = lambda *place: {}  # noqa: E731


@pytest.mark.parametrize(
    ("given", "samples", "key"),
    [
        (10, 2000, None),
        (1, 150, None),
        ("auto", 150, None),
        (10, 1999, "large_means"),
        (2, 399, "short_log"),
        (2, 400, None),
        (3, 401, "large_means"),
        (0, 400, "no_count"),
        (True, 400, "no_count"),
        (2.0, 4000, "no_count"),
    ],
)
def test_means_leave_a_log_two_hundred_of_them(given, samples, key):
    records = [("log", Record(np.arange(samples) * TICK, {}))]
    options: Any = hydraulics.FitOptions(decimate=given)
    if key is None:
        assert hydraulics._decimate(records, options, WHERE) == given
        return
    with refused(f"identification.{key}", InputError) as said:
        hydraulics._decimate(records, options, WHERE)
    if key == "large_means":
        fields: Any = said.value.message.fields
        assert (fields["means"], fields["maximum"]) == (samples // given, samples // 200)


@pytest.mark.parametrize(
    ("method", "response", "given", "left"),
    [("thesis", None, "auto", 1), ("thesis", None, 1, 1), ("thesis", None, 2, "thesis_means"),
     ("output_error", "u", "auto", 1), ("output_error", "u", 2, "response_means"),
     ("newton", None, 1, "unknown_method")],
)  # fmt: skip
def test_what_needs_every_sample_has_it(method, response, given, left):
    options: Any = hydraulics.FitOptions(method=method, decimate=given)
    options = replace(options, response=response and (response, Averaging()))
    records = [(name, Record(np.arange(900) * TICK, {})) for name in ("a", "b")]
    if left == 1:
        assert hydraulics._decimate(records, options, WHERE) == 1
        return
    with refused(f"identification.{left}", InputError):
        hydraulics._decimate(records, options, WHERE)


@pytest.mark.parametrize("names", [(), ("a", "a")])
def test_logs_have_names_of_their_own(names):
    records = [(name, Record(np.arange(900) * TICK, {})) for name in names]
    with refused("identification.unnamed_logs", InputError):
        hydraulics._decimate(records, hydraulics.FitOptions(), WHERE)


# --- sensors and loads behind the fit


def test_logs_in_which_a_row_may_show_have_its_cylinder_and_its_load():
    logs = [
        Stub(commanded=("boom",), payload=None),
        Stub(commanded=("boom", "arm"), payload="50 kg"),
        Stub(commanded=("arm",), payload="9 kg"),
    ]
    fit: Any = Stub(logs=logs)
    for cylinder, about, which in (
        ("", "the oil", [0, 1, 2]),
        ("boom", "boom.sh", [0, 1]),
        ("", "50 kg.boom.mass", [1]),
        ("boom", "9 kg.arm.mass", []),
    ):
        row: Any = Stub(cylinder=cylinder, about=about)
        assert _logs_of(fit, row) == which


def test_a_sensor_is_asked_with_a_wide_prior_of_its_unit():
    rows: Any = [
        Stub(readings=(("press.v", "offset", 5.0),)),
        Stub(readings=(("press.v", "lag", 2.0),)),
    ]
    offset, lag = _terms(rows, True)
    plain, _ = _terms(rows)
    assert (plain.known, plain.per, plain.std, plain.per_log) == (0.0, 1.0, 0.0, False)
    assert offset.std / lag.std == pytest.approx(20.0 * VAGUE["offset"] / VAGUE["lag"])


@pytest.mark.parametrize("word", ["offset", "scale", "lag"])
def test_what_a_sensor_does_to_its_channel_is_read_off(rng, word):
    """An offset and a scale move the start of the log with them."""
    y = 5.0 + WAVE[:, 0]
    log = log_of(np.arange(400)[:, None] > [9, -1], v=y, p_head=1e5 * y)
    doubts = (Stub(name="press.p_head", std=3.0), Stub(name="press.v", std=0.5))
    log = replace(log, start=Stub(uncertain=doubts, terms=()))
    slopes = rng.standard_normal((400, 2, 2))
    fit: Any = Stub(logs=[log], cutoff=None)
    residual = rng.standard_normal((400, 2))
    state: Any = Stub(here=Stub(residuals=[residual]), scales={"press.v": 2.0, "press.p_head": 1.0})
    row: Any = Stub(numbers=(), readings=(("press.v", word, 0.1),))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ehbench.identification.sensitivity.start_jacobian", lambda *_: [slopes])
        changes: Any = _read_off(fit, state, row)
        (change,) = changes
        other: Any = Stub(numbers=(), readings=(("press.q", word, 0.1),))
        assert _read_off(fit, state, other) is None
        assert _read_off(fit, state, Stub(numbers=(1,), readings=row.readings)) is None
        assert _read_off(fit, state, Stub(numbers=(), readings=row.readings * 2)) is None
    seen = y + residual[:, 0]
    by = {"offset": np.full(400, 0.1), "scale": 0.1 * seen}.get(word)
    expected = np.zeros((400, 2))
    expected[:, 0] = -0.1 * np.gradient(seen, TICK) if by is None else by
    expected = expected * log.counts / [2.0, 1.0]
    if by is not None:
        expected = expected - slopes[..., 1] * by[0] / 0.5
    assert change == pytest.approx(expected)


# --- matching of ringing


def match_of(search, windows, live=(0,)):
    work: Any = object.__new__(matching.Matching)
    work.search, work.windows, work.live, work.rounds = search, windows, [*live], 0
    work.theta, work.progress = np.array([c.begin for c in search]), lambda *_: None
    return work


def ring(omega, damping):
    return Ringing(natural_frequency=omega, damping_ratio=damping, ok=not math.isnan(omega))


def test_a_damping_is_matched_on_the_rings_of_its_joint_and_the_oil_on_every_frequency():
    search: Any = [Stub(row=Stub(mode_role=role), owner=owner) for role, owner in
                   (("frequency", ""), ("decay", "a"))]  # fmt: skip
    work: Any = object.__new__(matching.Matching)
    work.search, work.windows = search, [Stub(joint="a"), Stub(joint="b"), Stub(joint="a")]
    rings = [ring(20.0, 0.1), ring(30.0, 0.2), ring(math.nan, 0.3)]
    np.testing.assert_allclose(work._measure(0, rings), [math.log(20.0), math.log(30.0), math.nan])
    np.testing.assert_allclose(work._measure(1, rings), [0.1, math.nan, math.nan])


@pytest.mark.parametrize(("log", "steps"), [(True, 0.7), (False, 0.1)])
def test_a_simulation_that_is_silent_is_damped_less_in_four_rounds_and_then_left_out(log, steps):
    place: Any = Stub(
        row=Stub(mode_role="decay"), log=log, bounds=(-9.0, 9.0), begin=0.0, start=0.0
    )
    place.of = lambda value: value
    work = match_of([place], [])
    seen = []
    work.aim = [np.array([0.1])]
    work._rings = lambda theta, _: seen.append(float(theta[0])) or []
    work._measure = lambda *_: np.array([math.nan])
    stand = work._stand(None)
    assert seen == pytest.approx([-steps * k for k in range(5)])
    assert not stand.converged and work.live == [] and work.theta[0] == 0.0
    place.bounds = (0.0, 9.0)  # it cannot be damped less
    work.live, work.rounds, work.theta = [0], 0, np.zeros(1)
    work._stand(None)
    assert work.rounds == 1


def test_a_window_is_matched_on_its_first_run_of_samples_that_count():
    y = np.exp(-4.0 * np.arange(400) * TICK) * np.cos(40.0 * np.arange(400) * TICK)
    counts = np.ones((400, 2), bool)
    counts[:30, 1] = counts[330:, 0] = False
    log = log_of(counts, v=y, p_head=1e5 * y)
    part, columns, found = matching._ringing_of(log, slice(10, 390), "press")
    assert (part, columns) == (slice(30, 330), (0, 1)) and found.ok
    assert found.natural_frequency == pytest.approx(math.hypot(40.0, 4.0), rel=1e-3)
    part, columns, found = matching._ringing_of(log, slice(40, 300), "other")
    assert (part, columns, found.ok) == (slice(40, 300), (), False)


# --- problems and their searches


def plain_problem(misfit=lambda values: "", **fields) -> Problem:
    """Of two numbers between 0 and 10 in units of 2, on no log."""
    search = [Coordinate(n, False, 2.0, 2.0, 0.0, 20.0) for n in ("a", "b")]
    simulator: Any = Stub(misfit=misfit, logs=())
    given = {"spread": {}, "averaged": {}, "cutoff": None} | fields
    return Problem(simulator, tuple(search), 2, 2, max_iterations=9, report=lambda *_: None,
                   journal=Journal(), **given)  # fmt: skip


def test_a_number_has_the_room_that_another_leaves_it():
    """a + b ≤ 6, that is 3 in their units; the limit says why."""
    asked = plain_problem(lambda values: "too much" if sum(values) > 6.0 else "")
    theta = np.array([1.0, 1.5])
    assert asked.room(theta, [0, 1]) == pytest.approx(np.array([[0.0, 1.5], [0.0, 2.0]]), abs=1e-5)
    assert asked.room(theta, [1])[0, 1] <= 2.0
    assert asked.limit_at(np.array([1.5 - 5e-6, 1.5]), 0) == "too much"
    assert asked.limit_at(np.array([1.5 - 5e-5, 1.5]), 0) == ""
    below = plain_problem(lambda values: "too little" if sum(values) < 6.0 else "")
    assert below.limit_at(np.array([1.5 + 5e-6, 1.5]), 0) == "too little"
    assert below.limit_at(np.array([1.5 + 5e-5, 1.5]), 0) == ""
    assert below.room(np.array([2.0, 1.5]), [0])[0] == pytest.approx([1.5, 10.0], abs=1e-5)
    state = State(theta, [], {}, np.ones((2, 0)), (0, 1))
    assert towards(asked, state, 0, 1.2).theta.tolist() == [1.2, 1.5]
    assert towards(asked, state, 0, 9.0).theta == pytest.approx([1.5, 1.5], abs=1e-5)


def test_what_is_minimised_counts_priors_by_their_weight():
    """Of residuals in units of their scales; a search begins coarse, with a prior for a sample."""
    asked = analytic_fit.problem(more=(analytic_fit.TWIN, 1.0, 0.05, 20.0, 0.5, 2.0))
    state = initial(asked)
    assert (state.prior_weight, state.coarse, state.slack) == (1.0, True, 100.0)
    assert replace(state, coarse=False).slack == 1.0
    shifts = [np.array([3.0]), np.array([-0.5])]
    state = replace(evaluate(asked, state, shifts=shifts), prior_weight=0.7)
    sizes = np.array([state.scales[c] for c in ("press.x", "press.v")])
    left = sum(float(np.sum((part / sizes) ** 2)) for part in state.here.residuals)
    known = 9.0 + 0.25 + ((state.theta[3] - math.log(2.0)) * 2.0 / 0.5) ** 2
    assert cost(asked, state) == pytest.approx(left + 0.7 * known, rel=1e-12)


def test_a_residual_is_cut_and_that_of_a_failure_is_ten_spreads():
    log = log_of(np.arange(4)[:, None] > [0, -1], v=np.zeros(4), p_head=np.ones(4))
    asked = plain_problem(spread={"press.v": 2.0, "press.p_head": 3.0})
    failed = asked.residual(log, None)
    assert failed.tolist() == [[0.0, 30.0]] + [[20.0, 30.0]] * 3
    near = asked.residual(log, log.recorded + 0.5)
    assert near.tolist() == [[0.0, 0.5]] + [[0.5, 0.5]] * 3
    far = asked.residual(log, np.array([[9e9, -9e9]] * 4))
    assert far.tolist() == [[0.0, -3e6]] + [[2e6, -3e6]] * 3


def test_scales_are_of_what_is_left_and_of_what_means_leave_out_but_no_less_than_the_floor():
    asked = analytic_fit.problem()
    state = evaluate(asked, initial(asked))
    left = {c: pooled(asked.logs, c, state.here.residuals) for c in ("press.x", "press.v")}
    noisy = replace(asked, averaged={"press.x": 2.0 * left["press.x"], "press.v": 0.0})
    scales = weighed(noisy, state).scales
    assert scales["press.x"] == pytest.approx(math.sqrt(5.0) * left["press.x"])
    assert scales["press.v"] == pytest.approx(left["press.v"])
    wide = {"press.x": 1.0, "press.v": 1e6 * left["press.v"]}
    assert weighed(replace(noisy, spread=wide), state).scales["press.v"] == pytest.approx(
        5e3 * left["press.v"]
    )
    assert weighed(noisy, state, scales=False).scales == state.scales


def test_residuals_elsewhere_take_steps_of_their_own_from_the_starts_of_a_state():
    """As fine as a fit's, and none where a log fails."""
    asked, seen = analytic_fit.problem(), []
    plain = asked.simulator.simulate

    def simulate(vectors, chosen, shifts, slack):
        seen.append((chosen, shifts, slack))
        rows = plain(vectors, chosen, shifts)
        return [*rows[:-1], [None, *rows[-1][1:]]]

    state = replace(initial(asked), shifts=[np.ones(1), -np.ones(1)])
    with answers(asked.simulator, simulate=simulate):
        first, second = problem_module.residuals_at(asked, state, [state.theta, state.theta])
    assert seen == [(None, state.shifts, 1.0)] and second is None
    expected = evaluate(asked, state).here.residuals
    for part, other in zip(first or [], expected, strict=True):
        assert part == pytest.approx(other)
    assert Effort() == Effort(0, 0)


@pytest.mark.parametrize(
    ("step", "words", "paced", "means"),
    [(AUTO, ("x", "p_head"), True, True), (AUTO, ("x", "opening"), True, False),
     (AUTO, ("x", "flow"), False, False), (5e-4, ("x",), False, False)],
)  # fmt: skip
def test_a_log_is_simulated_in_chosen_steps_unless_flows_are_compared(step, words, paced, means):
    """Over vectors and logs; what makes no rig or fails has no channels."""
    asked: list = []

    class Model:
        def replay_paced(self, true, start, mesh, slack, averages):
            asked.append((true, start, mesh.tolist(), slack, averages))
            return "paced", np.array([7.0])

        def replay(self, true, step, start):
            asked.append((true, start, step))
            return "even"

    def begin(model, shift, shared):
        if shift[0] > 1.0:
            raise ArithmeticError
        return shift[0], shared

    start = Stub(begin=begin, seen=lambda replayed, shift, _: (replayed, shift[0]))
    log = Stub(channels=[f"press.{word}" for word in words], start=start, means="means")
    log.payload = None
    work: Any = object.__new__(simulator.Simulator)
    work.names, work.shared, work.logs, work.step = ("a", "bias"), {"bias"}, [log, log], step
    work.effort, work.workers = Effort(), 1

    def models(values):
        if values[0] < 0.0:
            raise ArithmeticError
        return {None: Model()}

    work.models = models
    points = [([1.0, 0.5], 0, [0.25]), ([1.0, 0.5], 1, [2.0]), ([-1.0, 0.5], 0, [0.0])]
    with answers(simulator, channels_of=lambda _, seen: seen):
        row, meshes = work.each(points, [np.array([3.0]), np.array([4.0])], 0.1)
        lists = work.simulate([[1.0, 0.5]] * 2, [1, 0], [[0.0], [0.5]])
    shown = "paced" if paced else "even"
    assert row == [(shown, 0.25), None, None]
    assert [mesh.tolist() for mesh in meshes] == [[7.0] if paced else [], [], []]
    given = ([3.0], 0.1, "means" if means else None) if paced else (step,)
    assert asked[0] == ({"bias": 0.5}, 0.25, *given)
    assert lists == [[(shown, 0.5), (shown, 0.0)]] * 2 and work.effort.evaluations == 7


def test_an_effect_is_the_largest_of_any_channel_as_a_share_of_its_spread():
    asked = replace(analytic_fit.problem(), spread={"press.x": 2.0, "press.v": 8.0})
    state = replace(initial(asked), scales={"press.x": 1.0, "press.v": 4.0})
    first, second = np.ones((50, 2, 2)), np.ones((50, 2, 2))
    first[:25, 0, 0], second[:, 1, 1] = 7.0, -6.0
    found = effects(asked, state, [first, second])
    assert found == pytest.approx([0.5 * math.sqrt(25.0), 3.0])
    assert effects(asked, state, [first], [0]) == pytest.approx([2.5, 0.5])


@pytest.mark.parametrize(
    ("values", "theta"),
    [({"a": 8.0}, [4.0, 1.0]), ({"b": -1.0}, [1.0, 3e-3]), ({"a": 99.0}, [10.0 - 3e-3, 1.0])],
)
def test_a_state_at_values_is_just_inside_the_bounds(values, theta):
    asked = plain_problem()
    asked.simulator.unshifted = lambda: []
    assert at_values(asked, values).theta == pytest.approx(theta)


def test_a_look_goes_a_decade_either_way_and_varies_the_damping_by_four():
    asked = analytic_fit.problem()
    theta = np.zeros(3) + initial(asked).theta
    vectors, each = basins._points(asked, theta, [0], [1])
    assert each == 3 and len(vectors) == 3 * 12
    moved = np.array(vectors) - theta
    assert np.unique(np.round(moved[:, 1], 6)).tolist() == [-1.4, 0.0, 1.4]
    assert not moved[0].any() and not moved[:, 2].any()
    assert moved[3::3, 0] == pytest.approx(np.linspace(-1.0, 1.0, 11) * math.log(10.0))
    vectors, each = basins._points(asked, theta, [2], [])
    assert (each, len(vectors)) == (1, 98)
    asked = replace(asked, search=(*asked.search[:2], replace(asked.search[2], upper=0.06)))
    top = np.array(basins._points(asked, theta, [2], [])[0])[:, 2].max()
    assert top == pytest.approx(math.log(0.06) - 1e-6, abs=1e-9)
    asked = replace(asked, search=(*asked.search[:2], replace(asked.search[2], lower=0.04)))
    bottom = np.array(basins._points(asked, theta, [2], [])[0])[1:, 2].min()
    assert bottom == pytest.approx(math.log(0.04) + 1e-6, abs=1e-9)


def test_a_slope_is_the_same_on_either_side_of_a_bound():
    asked = analytic_fit.problem((2.0, 1.0, 1.0))
    state = initial(asked)
    top = replace(asked.search[0], upper=asked.search[0].at(state.theta[0]))
    ended = replace(asked, search=(top, *asked.search[1:]))
    within, at_end = (jacobian(item, evaluate(item, state), [0])[0] for item in (asked, ended))
    assert at_end == pytest.approx(within, abs=1e-3 * float(np.abs(within).max()))


@pytest.mark.parametrize(("much", "misfit"), [(True, 3.0), (False, 5.0)])
def test_a_search_goes_on_from_where_one_number_stays_only_if_that_ends_better(much, misfit):
    """From a look's 9 to 8; without the first to 7, and with it to 6; without the second no
    better. Where little is left the look's is taken."""
    asked = plain_problem()
    ends = {(9, 9, 0, 1): (8, 5.0), (1, 1, 0, 1): (1, 6.0), (1, 8, 1): (7, 4.0),
            (7, 7, 0, 1): (6, 3.0), (6, 1, 0): (5, 3.5)}  # fmt: skip

    def coarse(_, __, start, free):
        at, left = ends[(*map(int, start), *free)]
        return basins._End(replace(state, theta=np.full(2, float(at))), left, much)

    state = State(np.ones(2), [], {}, np.ones((2, 0)), (0, 1))
    worse = basins._End(state, 7.0, True)
    with answers(basins, _coarse=coarse, _look=([np.full(2, 9.0)], []), _chain=worse):
        found = basins.nearest_basin(asked, state).theta.tolist()
    assert found == [float({end: at for at, end in ends.values()}[misfit])] * 2


# --- between which values the logs do not deny a parameter


@pytest.mark.parametrize(
    ("rise", "ends", "lowest"),
    [
        (lambda x: x**2, (-1.96, 1.96), (0.0, 0.0)),
        (lambda x: x**2 * (x < 0.0), (-1.96, 3.0), (0.0, 0.0)),
        (lambda x: x**2 * (x > 0.0), (-3.0, 1.96), (0.0, 0.0)),
        (lambda x: 9.0 * (abs(x) > 1.7) - 5.0 * (1.4 < x < 1.6), (-1.7, 1.7), (-5.0, 1.5)),
    ],
)
def test_halvings_find_where_a_parameter_is_denied(rise, ends, lowest):
    points = np.arange(-3.0, 4.0)
    state: Any = Stub(theta=np.zeros(1), prior_weight=1.0)
    asked = np.array([float(rise(x)) for x in points])
    with answers(estimate, _rises=lambda *given: (np.array([float(rise(given[3][0]))]), 0.0)):
        found, least, at = estimate._interval_ends(state, state, 0, points, asked)
    assert found == pytest.approx(ends, abs=1.0 / 32.0)
    assert (least, at) == pytest.approx(lowest)
    state.prior_weight = 2.0  # a sample counts for more
    with answers(estimate, _rises=lambda *given: (np.array([float(rise(given[3][0]))]), 0.0)):
        wider = estimate._interval_ends(state, state, 0, points, asked)[0]
    assert wider == pytest.approx(
        [2.77 if x == 1.96 else -2.77 if x == -1.96 else x for x in ends], abs=0.04
    )


# --- how many samples are a mean


@pytest.mark.parametrize(
    ("count", "tick", "frequency", "cutoff", "each"),
    [
        (6000, 1e-4, 100.0, None, 5),
        (6000, 1e-4, 10.0, None, 10),
        (6000, 1e-4, 100.0, 125.0, 4),
        (6000, 1e-4, 300.0, None, None),
        (600, 1e-4, 100.0, None, 3),
        (599, 1e-4, 100.0, None, None),
        (6000, 3.4e-4, 10.0, None, None),
    ],
)
def test_a_mean_lasts_a_twentieth_of_the_fastest_period(count, tick, frequency, cutoff, each):
    log = Record(np.arange(count) * tick, {"press.v": np.zeros(count)})
    with answers(means, fastest=frequency):
        found = means.means_of(Stub(), log, "auto", cutoff)
    assert (found and found.each) == each


# --- fixed numbers


class Row(Stub):
    """A row of the fault table, which is a key."""

    # pyrefly: ignore[bad-assignment]
    __hash__ = object.__hash__


def suspect(name, gain, move, certainty=1, bounds=(-9.0, 9.0)):
    row: Any = Row(name=name, bounds=bounds, certainty=certainty, gain=gain, move=move)
    return sensitivity._Suspect(row, [np.ones((3, 1))], (0,))


@pytest.mark.parametrize(("above", "more"), [(1.0, []), (0.9, ["little"])])
def test_rows_that_promise_are_the_likeliest_and_of_these_the_least_sure_first(above, more):
    """Each goes to its best δ, within bounds, and the estimates with it by as much; what it
    explains counts beside the noise."""
    every = [
        suspect("sure", 50.0, 2.0, 5),
        suspect("guessed", 40.0, 9.0, 0, (-1.0, 3.0)),
        suspect("low", 30.0, -4.0, 3, (-1.0, 1.0)),
        suspect("less", 20.0, 1.0, 0),
        suspect("at zero", 60.0, -2.0, 0, (0.0, 1.0)),
        suspect("little", 4.9, 1.0, 0),
    ]
    fit: Any = Stub(logs=[Stub()])
    result: Any = Stub(state=Stub(live=(0,), theta=np.array([7.0])), blocks=[])

    def release(_, __, item, minimum):
        assert minimum == math.inf
        return Stub(gain=item.row.gain, move=item.row.move, follow=np.array([6.0]))

    with answers(sensitivity, cost=100.0, prior_of=None, _with=lambda _, some: some, _logs_of=[0],
                 _columns={}, _release=release, gains_of=lambda some, _: [i.row.gain for i in some],
                 _moved=lambda _, __, theta: (Stub(theta=float(theta[0])),)):  # fmt: skip
        found = sensitivity._promising(fit, result, every, Stub(), above)
        assert sensitivity._promising(fit, result, [], Stub(), above) == []
    found, least = found[:4], found[4:]
    assert [item.row.name for item in found] == ["guessed", "low", "sure", "less"]
    assert [item.row.name for item in least] == more
    assert [item.delta for item in found] == [3.0, -1.0, 2.0, 1.0]
    assert [item.explains for item in found] == pytest.approx([0.4, 0.3, 0.5, 0.2])
    shares = [3.0 / 9.0, 1.0 / 4.0, 1.0, 1.0]
    assert [float(item.follow[0]) for item in found] == pytest.approx([6.0 * x for x in shares])
    moved: Any = [item.moved[0] for item in found]
    assert [item.theta for item in moved] == pytest.approx([7.0 + 6.0 * x for x in shares])


@pytest.mark.parametrize(("extra", "noise"), [(0.0, True), (0.5, False)])
def test_white_noise_alone_is_asked_of_no_fixed_number(extra, noise):
    asked = analytic_fit.problem()
    asked = replace(asked, spread=dict(asked.spread))
    state = evaluate(
        asked, at_values(asked, dict(zip(analytic_fit.NAMES, analytic_fit.TRUTH, strict=True)))
    )
    swing = 0.02 * extra * np.sin(np.arange(600) / 9.0)[:, None]
    spread = np.array([asked.spread[c] for c in ("press.x", "press.v")])
    left = [residual + swing * spread * math.sqrt(2.0) for residual in state.here.residuals]
    state = replace(state, point=replace(state.here, residuals=left))
    for log in asked.logs:
        # pyrefly: ignore[read-only]
        log.recorded = log.recorded + 0.0
    above = sensitivity.above_noise(asked, weighed(asked, state))
    assert (above < sensitivity.SETTINGS.worth) == noise
    assert sensitivity.above_noise(replace(asked, cutoff=9.0), weighed(asked, state)) == 1.0


def test_rows_that_a_fit_does_not_ask_are_those_it_fits_or_that_no_slope_tells():
    """Drift, parts among several, readings that are estimated or seen as a spectrum."""

    def row(name, kind="mass", alike=False, step=0.02, numbers=True, readings=()):
        item: Any = Row(name=name, kind=kind, alike=alike, row=Stub(step=step), edits=())
        item.parameters, item.numbers, item.readings = (name,), (1,) if numbers else (), readings
        return item

    speed, lag = (("press.v", "offset", 1.0),), (("press.v", "lag", 1.0),)
    every = [
        row("a"),
        row("fitted"),
        row("no slope", step=0.0),
        row("part", alike=True),
        row("gain of a part", "gain", alike=True),
        row("drift", "drift"),
        row("nothing", numbers=False),
        row("known", numbers=False, readings=speed),
        row("lag", numbers=False, readings=lag),
    ]
    term = Stub(channel="press.v", word="offset", std=1.0)
    log: Any = Stub(
        commanded=("press",), channels=("press.v",), band=None, start=Stub(terms=(term,))
    )
    log.record = Record(np.arange(3.0), {})
    rig = Stub(with_values=lambda values: values)
    simulator = Stub(known={"fitted": 1.0}, names=("fitted",), rig=rig, maps=None)
    fit: Any = Stub(
        simulator=simulator, logs=[log], by_name=lambda _: {"fitted": 2.0, "c.lag": 3.0}
    )
    seen = []

    def asked(*given):
        seen.append(given[:3])
        return every

    with answers(sensitivity, hypotheses=asked):
        found = sensitivity._fixed_rows(fit, Stub(theta=None))
        assert [item.name for item in found] == ["a", "gain of a part", "lag"]
        assert seen == [({"fitted": 2.0}, ["press"], ["press.v"])]
        log.band = Stub()
        found = sensitivity._fixed_rows(fit, Stub(theta=None))
    assert [item.name for item in found] == ["a", "gain of a part"]


@pytest.mark.parametrize(("beyond", "freed"), [(0.4, 0), (0.6, 1)])
def test_a_number_that_moves_an_estimate_by_half_of_its_interval_is_freed(beyond, freed):
    item = Stub(row=Stub(kind="mass"), beyond=beyond * BEYOND, explains=0.5)
    fit: Any = Stub(simulator=Stub(effort=Stub(evaluations=100)))
    asked = []
    with answers(sensitivity, above_noise=1.0, _screened=([], ()), _promising=lambda *_: [item],
                 _confirmed=lambda *given: asked.append(given)):  # fmt: skip
        sensitivity.doubts_of(fit, Stub(), Stub())
    assert len(asked) == freed


@pytest.mark.parametrize(
    ("there", "after", "above", "confirmed"),
    [(2.5, 80.0, 1.0, True), (2.3, 80.0, 1.0, False), (2.5, 96.0, 1.0, False)]
    + [(2.5, 96.0, 0.7, True), (2.3, 96.0, 0.7, False)],
)
@pytest.mark.parametrize("number", [True, False])
def test_a_row_is_confirmed_by_a_fit_that_frees_it(there, after, above, confirmed, number):
    """Four errors of 0.1 from where it is held, and a twentieth of the cost above noise less; its
    remedy is of the rig as that fit found it, without what a sensor adds."""
    held = Stub(name="b", unit=0.5, here=2.0)
    still = Stub(name="a", unit=0.0, here=9.0)
    row: Any = Stub(numbers=(still, held) if number else (), remedy=lambda *given: given)
    row.readings = () if number else (("press.v", "offset", 0.5),)
    search = [
        Coordinate("a", False, 1.0, 1.0, 0.0, 9.0),
        Coordinate("b", False, 1.0, 1.0, -9.0, 9.0),
    ]
    value = there if number else there - 2.0
    end = Stub(theta=np.array([1.0, value]))
    errors = Stub(state=end, by_index={1: Stub(std=0.1)})
    simulator = Stub(rig=Stub(with_values=dict), known={"a": None})
    fit: Any = Stub(search=search[:1], simulator=simulator)
    result: Any = Stub(state=Stub(live=(0,)))
    item: Any = Stub(row=row, delta=1.0)
    freed = Stub(search=search, logs=[Stub(start=Stub(terms=()))])
    freed.by_name = lambda theta: dict(zip("ab", theta, strict=True))
    with answers(sensitivity, _freed=(freed, None, [1]), solve=(None, True),
                 evaluate=None, errors_of=errors, _moved=("moved",),
                 cost=lambda _, state: after if state is end else 100.0):  # fmt: skip
        found = sensitivity._confirmed(fit, result, item, Stub(), above)
    assert (found is not None) == confirmed
    if found:
        lean = found[1]
        assert (lean.name, lean.here, lean.there) == ("b", 2.0 if number else 0.0, value)
        assert (lean.std, lean.explains) == pytest.approx((0.1, 1.0 - after / 100.0))
        assert lean.remedy == ({"a": 1.0}, pytest.approx((there - 2.0) / 0.5))


@pytest.mark.parametrize(
    ("far", "alone", "chosen"), [(90.0, 10.0, 1), (110.0, 90.0, 0), (110.0, 120.0, 1)]
)
def test_a_row_is_freed_from_its_own_step_alone_where_slopes_lead_astray(far, alone, chosen):
    """The step of what follows it is taken unless the logs are followed worse there than here; what
    goes back to its start does so in either."""
    search = [Coordinate(name, False, 1.0, 1.0, -9.0, 9.0) for name in "abc"]
    simulator = Stub(rig=Stub(with_values=lambda _: None), known={})
    fit: Any = Stub(search=search[:2], simulator=simulator)
    errors = {0: Stub(source="hac"), 1: Stub(source="range"), 2: Stub(std=0.1)}
    result: Any = Stub(state=Stub(live=(0, 1)), by_index=errors)
    row: Any = Stub(numbers=(), readings=(("c", "offset", 1.0),), remedy=lambda *_: "")
    item = sensitivity._Suspect(row, [], (), delta=1.0, follow=np.array([5.0, 7.0]))
    problem = Stub(search=search, logs=[Stub(start=Stub(terms=()))], by_name=lambda _: {})

    def freed(_, __, asked, effort):
        theta = np.array([*asked.follow, 1.0])
        return problem, Stub(theta=theta, cost=far if theta[0] else alone), [2]

    def solved(_, begin, *given, **more):
        ended.append(begin)
        return begin, True

    ended = []
    with answers(sensitivity, _freed=freed, solve=solved, evaluate=lambda _, state: state,
                 errors_of=lambda _, state: Stub(state=state, by_index=errors), _moved=(),
                 cost=lambda _, state: getattr(state, "cost", 100.0)):  # fmt: skip
        sensitivity._confirmed(fit, result, item, Stub(), 1.0)
    assert [list(begin.theta) for begin in ended] == [[5.0 * chosen, 7.0, 1.0]]


def test_what_lies_at_an_end_of_its_range_goes_back_beside_a_row_that_moves_nothing():
    """From where its search began, free, by derivatives that are taken anew; known by its range."""
    asked = analytic_fit.problem()
    state = evaluate(asked, initial(asked))
    jacobian(asked, state, (0, 1, 2))
    (low, _), here = asked.search[1].bounds, float(state.theta[1])
    ranges = {1: (low, low + 0.5)}
    state = replace(state.moved(1, low).fixed(1), ranges=ranges)
    errors = {i: uncertainty.Error(0.1, 2.0, "hac", "estimated", 1.0, 0.0, 0.0) for i in (0, 2)}
    result = uncertainty.Errors(errors, (), np.eye(2), np.eye(2), state, [], np.eye(2), np.ones(2))
    row: Any = Row(name="mass", certainty=0, kind="mass", numbers=())
    item = sensitivity._Suspect(row, [], (0,), 0.3, 1.0, np.array([1.0, 2.0]),
                                (Moved("m", 1.0, 2.0, 0.8),))  # fmt: skip
    seen = []

    def confirmed(_, errors, asked, *_rest):
        seen.append((errors, asked))
        moved = (Moved("m", 1.0, 2.0, 0.8 if asked is item else 3.0),)
        return row, Lean("m", 1.0, 2.0, 0.1, 0.2 + 0.2 * (asked is not item), moved, "")

    with answers(sensitivity, above_noise=1.0, _screened=([], ()), _promising=lambda *_: [item],
                 _confirmed=confirmed, _sentence="told"):  # fmt: skip
        found = sensitivity.doubts_of(asked, state, result)
        assert [lean.explains for lean in found.leans] == [0.4]
        without = replace(state, ranges={})
        assert not sensitivity.doubts_of(asked, without, replace(result, state=without)).leans
    (first, before), (freed, after), *_ = seen
    assert len(seen) == 3 and first is result and before is item
    assert freed.state.live == (0, 1, 2) and not freed.state.ranges
    assert list(after.follow) == pytest.approx([0.0, here - low, 0.0])
    assert {i for i, _ in freed.state.here.columns} == {0, 2}
    known = freed.by_index[1]
    assert known.quantile * known.std == pytest.approx(0.25) and known.source == "range"


def test_a_reading_is_freed_where_a_slope_says_and_with_all_that_is_known():
    asked = analytic_fit.problem()
    plain = {"rig": None, "maps": None, "workers": 1, "step": "auto", "names": analytic_fit.NAMES}
    vars(asked.simulator).update(plain)
    state = replace(evaluate(asked, initial(asked)), prior_weight=0.5)
    jacobian(asked, state, (0, 1))
    row: Any = Row(readings=(("press.v", "offset", 0.5),), numbers=(), edits=(), upper={})
    columns = [np.full((600, 2), 1.0 + k) for k in range(2)]
    item = sensitivity._Suspect(
        row, columns, (0, 1), delta=0.3, follow=np.array([0.01, 9e9, -0.02])
    )

    def simulator(rig, logs, names, *rest):
        assert names == [*analytic_fit.NAMES, "press.v.offset"]
        for log in logs:
            log.start = Stub(**vars(log.start) | {"terms": sensitivity._terms([row], True)})
        return analytic_fit.Closed(logs)

    with answers(sensitivity, Simulator=simulator, _with_terms=lambda logs, _: logs):
        freed, begin, new = sensitivity._freed(asked, state, item, Effort())
    assert new == [3] and begin.free == (0, 1, 2, 3) and begin.prior_weight == 0.5
    place = freed.search[3]
    assert begin.theta[3] * place.unit == pytest.approx(0.3 * 0.5)
    assert begin.theta[:3] - state.theta == pytest.approx([0.01, math.log(1e3), -0.02])
    for k in range(2):
        sizes = np.array([state.scales[c] for c in ("press.x", "press.v")])
        built = columns[k] * sizes * place.unit / 0.5
        assert begin.here.columns[3, k] == pytest.approx(built)
        assert begin.here.columns[1, k] is state.here.columns[1, k]


def test_what_rows_change_is_a_difference_over_its_step_in_units_of_the_scales():
    """Of numbers at once, of sensors at once; zero in logs that are not asked, gone where one
    simulation fails."""

    def row(name, inside, numbers=(), readings=()):
        item: Any = Row(name=name, inside=inside, numbers=numbers, readings=readings, edits=())
        return item

    def moved(name, here, unit):
        return Stub(name=name, here=here, at=lambda delta: here + delta * unit)

    mass, oil = row("mass", 0.1, (moved("m", 2.0, 3.0),)), row("oil", -0.2, (moved("o", 5.0, 1.0),))
    speed = row("speed", 0.5, readings=(("press.v", "offset", 4.0),))
    broken = row("broken", 1.0, (moved("x", 7.0, 1.0),))
    logs = [
        Stub(channels=("press.v",), recorded=np.zeros((3, 1)), start=Stub(terms=())) for _ in "ab"
    ]
    here = Stub(theta=None, residuals=[np.ones((3, 1)), np.ones((3, 1))], shifts=["s", "t"])
    here.mesh = Stub(steps="steps")
    asked = []

    def each(points, steps):
        asked.extend((names[-1], list(vector), k, shift, steps) for vector, k, shift in points)
        return [None if 8.0 in v else np.full((3, 1), 1.0 + sum(v)) for v, *_ in points], None

    names: list[str] = []

    def simulator(rig, logs, given, *rest):
        names[:] = given
        return Stub(each=each)

    simulated = Stub(rig=None, names=["p"], maps=None, workers=1, step="auto")
    fit: Any = Stub(
        simulator=simulated, logs=logs, values=lambda _: [10.0], residual=lambda _, y: y
    )
    state: Any = Stub(here=here, scales={"press.v": 2.0})
    which = {mass: [0], oil: [1], speed: [0, 1], broken: [0]}
    with answers(sensitivity, Simulator=simulator, _with_terms=lambda logs, _: logs):
        found = sensitivity._columns(fit, state, which, Stub())
    assert [vector for name, vector, *_ in asked if name == "x"] == [
        pytest.approx([10.0, 2.3, 5.0, 7.0]),
        pytest.approx([10.0, 2.0, 4.8, 7.0]),
        pytest.approx([10.0, 2.0, 5.0, 8.0]),
    ]
    assert asked[-2:] == [("press.v.offset", [10.0, 2.0], k, "st"[k], "steps") for k in (0, 1)]
    assert found.keys() == {mass, oil, speed}
    assert found[mass][0] == pytest.approx(np.full((3, 1), 24.3 / 0.1 / 2.0))
    assert not found[mass][1].any() and not found[oil][0].any()
    assert found[oil][1] == pytest.approx(np.full((3, 1), 23.8 / -0.2 / 2.0))
    assert found[speed][0] == pytest.approx(np.full((3, 1), 12.0 / 0.5 / 2.0))


# --- what no fit takes


@pytest.mark.parametrize(
    ("given", "std", "key"),
    [
        ({}, 1.0, None),
        ({"method": "thesis"}, 0.0, None),
        ({"method": "thesis"}, 1e-9, "thesis_sensor"),
        ({"method": "thesis", "prior": {"bulk_modulus": "3 %"}}, 0.0, "thesis_prior"),
        ({"method": "thesis", "response": ("u", Averaging())}, 0.0, "thesis_response"),
        ({"cutoff": 9.0, "response": ("u", Averaging())}, 0.0, "response_low_pass"),
        ({"cutoff": 9.0}, 0.0, None),
        ({"channels": ("press.speeed",)}, 0.0, "no_quantity"),
    ],
)
def test_options_that_do_not_go_together_are_refused(given, std, key):
    search = [Coordinate("bulk_modulus", True, 1.0, 1e9, 1e8, 1e10)]
    terms: Any = [Stub(std=std)]
    log = ("log", log_of(v=np.zeros(3)).record)
    work = lambda: hydraulics._refuse_options(  # noqa: E731
        [log], hydraulics.FitOptions(**given), search, terms, WHERE
    )
    if key is None:
        return work()
    with refused(f"identification.{key}", InputError):
        work()


@pytest.mark.parametrize(
    ("word", "mapped", "key"),
    [
        ("flow_gain", False, None),
        ("flow_gain", True, "edge_is_mapped"),
        ("map_factor", True, None),
        ("map_factor", False, "edge_is_unmapped"),
        ("cracking_pressure", True, None),
    ],
)
def test_an_edge_has_the_numbers_of_its_law_or_the_factor_of_its_map(word, mapped, key):
    names = ["bulk_modulus", f"press.servo_supply_head.{word}"]
    with answers(hydraulics, map_of=lambda *_: mapped or None):
        work = lambda: hydraulics._refuse_inert(shipped("slide_servo"), names, None, WHERE)  # noqa: E731
        if key is None:
            return work()
        with refused(f"identification.{key}", InputError) as said:
            work()
    fields: Any = said.value.message.fields
    assert fields["right"] == ("map_factor" if mapped else "flow_gain")
    assert f"{fields['edge']}.{word}" == names[1]


@pytest.mark.parametrize("model", [None, "a model of one's own"])
@pytest.mark.parametrize(("method", "fit"), [("thesis", "matched"), ("output_error", "estimated")])
def test_a_fit_is_by_its_method_and_tries_a_foreign_model_where_it_begins(method, fit, model):
    tried = []
    simulator = Stub(replay=lambda starts, _: tried.append(starts), unshifted=lambda: [])
    place = Coordinate("carriage.damping", True, 1.0, 2.0, 0.5, 4.0)
    log = Stub(start=Stub(terms=()))
    asked: Any = Stub(options=hydraulics.FitOptions(method=method), search=[place], logs=[log])
    asked.rig = Stub(model=model)
    with answers(hydraulics, simulator_of=simulator, problem_over=None, estimate=("estimated", 0),
                 Matching=Stub(fit=lambda: "matched")):  # fmt: skip
        found: Any = hydraulics.run_fit(asked)
    assert (found, tried) == (fit, [[2.0]] if model else [])


# --- windows of ringing


def ringing_log(decay, steps=(300, 1100)) -> Log:
    t = np.arange(2000) * TICK
    y, u = np.zeros(2000), np.zeros(2000)
    for k in steps:
        u[k:] += 5.0
        s = t[k:] - t[k]
        y[k:] = np.exp(-decay * s) * np.cos(50.0 * s)
    return log_of(v=y, p_head=1e5 * y, command=u)


def test_ringing_is_looked_for_after_each_change_of_a_cylinders_own_command():
    told = []
    simulator: Any = Stub(rig=shipped("slide_servo"), logs=[ringing_log(2.0)])
    first, second = matching.find_windows(simulator, lambda *given: told.append(given))
    assert [one.span.start for one in (first, second)] == [300, 1100]
    assert (first.log, first.cylinder, first.joint, first.columns) == (
        0,
        "press",
        "carriage",
        (0, 1),
    )
    assert second.recorded.natural_frequency == pytest.approx(math.hypot(50.0, 2.0), rel=1e-3)
    simulator.logs = [ringing_log(2.0, (1,))]  # from the first sample
    (only,) = matching.find_windows(simulator, lambda *_: None)
    assert only.span.start == 1
    simulator.logs = [ringing_log(30.0, range(300, 1900, 300))]
    with refused("identification.no_ringing", InsufficientData) as said:
        matching.find_windows(simulator, lambda *_: None)
    assert said.value.hint is not None and said.value.hint.count("log at ") == 3
    assert "log at 0.3 s" in said.value.hint
    simulator.logs = [log_of(v=np.zeros(50), command=np.zeros(50))]
    with refused("identification.no_ringing", InsufficientData) as said:
        matching.find_windows(simulator, lambda *_: None)
    assert said.value.hint is None


def test_ringing_is_of_the_cylinder_whose_command_changes_and_not_of_one_whose_command_stands():
    rig, log = shipped("thesis_arm"), ringing_log(2.0, (300,))
    y, given = log.recorded, {}
    for cylinder, valve in rig.valves():
        steps = cylinder is rig.cylinder[0]
        given[f"{cylinder.name}.{valve.name}.command"] = np.where(
            log.record.t < 0.3, 5.0, 5.0 + steps
        )
    names = tuple(f"{cylinder.name}.p_head" for cylinder in rig.cylinder)
    log = replace(log, record=replace(log.record, channels=given), channels=names, recorded=y)
    simulator: Any = Stub(rig=rig, logs=[log])
    (found,) = matching.find_windows(simulator, lambda *_: None)
    assert (found.cylinder, found.columns) == (rig.cylinder[0].name, (0,))


@pytest.mark.parametrize("silent", [0, 1])
def test_what_was_matched_is_told_with_its_scatter_and_what_is_silent(silent):
    place = Coordinate("carriage.damping", True, 1.0, 2.0, 0.5, 8.0)
    window = Stub(log=0, cylinder="press", columns=(0,), recorded=Stub(stop=0.5), span=slice(9, 20))
    work = match_of([place, replace(place, name="bulk_modulus")], [window, window])
    work.theta = np.array([math.log(4.0), 0.0])
    work.simulator = Stub(logs=[log_of(v=np.zeros(30))], fixed_errors=dict)
    rings = [Stub(ok=True), Stub(ok=not silent)]
    stand: Any = Stub(at_bound=[0] if silent else [], rings=rings)
    with answers(matching, finish=lambda _, built: built):
        built = work._result(stand, {0: (0.1, 2.0, 5)}, not silent)
    fitted, idle = built.fitted
    assert (fitted.value, fitted.std, fitted.samples) == (pytest.approx(4.0), pytest.approx(0.4), 5)
    assert fitted.interval == pytest.approx((4.0 * math.exp(-0.2), 4.0 * math.exp(0.2)))
    assert (fitted.status, idle.status) == ("at_bound" if silent else "estimated", "not_excited")
    assert idle.samples == 0
    keys = [text.key.partition(".")[2] for text in built.warnings]
    assert keys == (["still_moving", "model_is_silent"] if silent else [])
    assert not silent or built.warnings[1].fields["count"] == 1
    assert built.matches[0].start == pytest.approx(0.009)
    assert built.correlation.shape == (0, 0)
    work.live = []
    with refused("identification.no_ringing_tells", InsufficientData):
        work._result(stand, {}, True)


def test_doubts_are_of_the_gain_that_promises_most_and_of_what_fits_confirm():
    """The least sure first, of these what explains most; what explains less than half of the best,
    or moves no estimate beyond its interval, is none."""

    def item(kind, name, certainty=0, explains=0.5, beyond=2.0):
        row: Any = Row(
            kind=kind, parameters=(name,), certainty=certainty, remedy=lambda *_: "free it"
        )
        return Stub(row=row, explains=explains, beyond=beyond, delta=-0.5)

    every = [item("gain", "first", beyond=0.0), item("gain", "second", beyond=0.0)]
    every += [item("mass", "sure", 2), item("mass", "some", 0, 0.3), item("mass", "most", 0, 0.4)]
    every += [item("mass", "little", 0, 0.2), item("mass", "within", 0, 0.5, 0.9)]
    fit: Any = Stub(simulator=Stub(effort=Stub(evaluations=1000), rig=None))
    counts = []

    def confirmed(_, __, asked, *_rest):
        moved = (Moved("m", 1.0, 2.0, asked.beyond), Moved("n", 1.0, 2.0, 0.1))
        name = asked.row.parameters[0]
        return asked.row, Lean(name, 1.0, 2.0, 0.1, asked.explains, moved, "")

    with answers(sensitivity, above_noise=1.0, _promising=lambda *_: every,
                 _screened=lambda *given: counts.append(given[3]) or ([], ("unasked",)),
                 _release=Stub(std=0.1), _confirmed=confirmed, _sentence="told"):  # fmt: skip
        state: Any = Stub(ranges={})
        found = sensitivity.doubts_of(fit, state, Stub())
    assert counts == [120] and found.unasked == ("unasked",)
    (gain,) = found.warnings
    fields: Any = gain.fields
    assert (fields["name"], fields["move"], fields["share"]) == ("first", -50.0, 0.5)
    assert fields["half"] == pytest.approx(19.6, rel=1e-4)
    assert [lean.name for lean in found.leans] == ["most", "some", "sure"]
    assert {lean.sentence for lean in found.leans} == {"told"}


def test_rows_are_asked_of_the_log_that_is_followed_worst_of_those_that_show_them():
    """What needs no simulation of all logs; what changes nothing is dropped, the surest unasked."""
    zeros, ones = [np.zeros((2, 1))] * 2, [np.ones((2, 1))] * 2
    rows: Any = [Row(name=name, certainty=k) for k, name in enumerate(
        ("either", "second", "none", "late", "read", "dull"))]  # fmt: skip
    shows = {"either": [0, 1], "second": [1], "none": [], "late": [0]}
    read = {"read": ones, "dull": zeros}
    asked = []

    def columns(_, __, given, effort):
        asked.append({row.name: list(which) for row, which in given.items()})
        return {row: zeros if row.name == "none" else ones for row in given}

    fit: Any = Stub(logs=[Stub(), Stub()])
    with answers(sensitivity, _fixed_rows=lambda *_: rows[::-1], _columns=columns,
                 scaled=lambda *_: [np.array([[-3.0]]), np.array([[2.0, 2.0]])],
                 _read_off=lambda _, __, row: read.get(row.name),
                 _logs_of=lambda _, row: shows[row.name]):  # fmt: skip
        found, unasked = sensitivity._screened(fit, Stub(), Stub(), 3)
    assert asked == [{"either": [0], "second": [1], "none": [0]}] and unasked == ("late",)
    logs = {item.row.name: item.logs for item in found}
    assert logs == {"read": (0, 1), "either": (0,), "second": (0, 1)}


def closed_match(oil=(-3.0, 3.0), damping=(-3.0, 3.0), std=1e-3):
    """ω = 20 e^(a/2 + b/10) and ζ = 0.1 e^b in three windows, whose medians lie at 20 e^0.2 and at
    0.1 e^0.3: b = 0.3, a = 0.34."""
    ends = (("frequency", "", oil), ("decay", "a", damping))
    search: Any = [Stub(row=Stub(mode_role=role), owner=owner, log=True, bounds=bounds,
                        begin=min(0.0, bounds[1]) if bounds[0] < 0.0 else bounds[0] + 0.1,
                        start=-0.5, of=float) for role, owner, bounds in ends]  # fmt: skip
    seen = Stub(natural_frequency=20.0, natural_frequency_std=0.02, damping_ratio_std=std)
    work = match_of(search, [Stub(joint="a", recorded=seen)] * 3, (0, 1))
    work._rings = lambda theta, _: (
        [ring(20.0 * math.exp(0.5 * theta[0] + 0.1 * theta[1]), 0.1 * math.exp(theta[1]))] * 3
    )
    work.aim = [
        math.log(20.0) + np.array([0.2, 0.3, 0.17]),
        0.1 * math.exp(0.3) + np.array([-0.01, 0.0, 0.03]),
    ]
    work.maximum = 60
    return work


@pytest.mark.parametrize(
    ("bounds", "theta", "at_bound"),
    [
        ({}, (0.34, 0.3), []),
        ({"oil": (-3.0, 0.2)}, (0.2, 0.3), [0]),
        ({"damping": (0.5, 3.0)}, (0.3, 0.5), [1]),
        ({"damping": (-3.0, 0.1)}, (0.38, 0.1), [1]),
    ],
)
def test_a_matching_stands_where_the_medians_of_its_windows_are_met(bounds, theta, at_bound):
    work = closed_match(**bounds)
    stand = work._stand(None)
    assert stand.converged and stand.at_bound == at_bound
    assert work.theta == pytest.approx(theta, abs=2e-3)
    slope = [[0.5, 0.1], [0.0, 0.1 * math.exp(theta[1])]]
    assert stand.slope == pytest.approx(np.array(slope), rel=0.05, abs=1e-9)


@pytest.mark.parametrize(("std", "live"), [(1e-3, [0, 1]), (0.5, [0])])
def test_what_no_window_tells_is_left_out_and_the_rest_matched_again(std, live):
    work = closed_match(std=std)
    work._result = lambda *given: given
    stand, results, converged = work.fit()
    assert converged and work.live == live and results.keys() == {*live}
    spread = math.sqrt(math.pi / 2.0) * np.std([0.2, 0.3, 0.17], ddof=1) / math.sqrt(3.0)
    assert results[0][0] == pytest.approx(spread / 0.5, rel=0.01) and results[0][2] == 3
    assert work.theta[1] == pytest.approx(0.3 if 1 in live else -0.5, abs=2e-3)
    assert work.theta[0] == pytest.approx(0.34 if 1 in live else 0.5, abs=2e-3)
    work.maximum = 0
    assert work.fit() == (None, {}, False)


@pytest.mark.parametrize(
    ("rise", "after", "better"), [(-65.0, 9.0, True), (-65.0, 11.0, False), (-64.0, 9.0, False)]
)
def test_a_solution_elsewhere_is_better_that_surely_falls_and_ends_lower(rise, after, better):
    """16 in units of a prior's weight; there the parameter may move every log."""
    state = State(np.zeros(2), [], {}, np.zeros((2, 3), bool), (0, 1), prior_weight=4.0)
    with answers(estimate, solve=lambda _, item, __: (item, True),
                 cost=lambda _, item: 10.0 if item is state else after):  # fmt: skip
        found = estimate._better(Stub(), state, 1, rise, 0.5)
    assert (found is not None) == better
    assert found is None or found.theta.tolist() == [0.0, 0.5]
    assert found is None or found.influence.tolist() == [[False] * 3, [True] * 3]


def test_of_faint_parameters_those_that_nothing_denies_are_dropped():
    """One of no effect, one that rises by less than is denied; one is known by its range, and one
    that cannot be everywhere is asked though its effect is faint."""
    faint = estimate.PROBLEM.faint
    rises = {
        0: (np.full(14, 99.0), 0.5 * faint),
        1: (np.full(14, 7.0), 2.0 * faint),
        2: (np.full(14, 8.0), 2.0 * faint),
        3: (np.append(np.full(13, 8.0), math.inf), 0.5 * faint),
    }
    search = tuple(Coordinate(n, False, 1.0, 0.25, -1.0, 1.0) for n in "abcd")
    asked = replace(plain_problem(), search=search, requested=4, fitted=4)
    state = State(np.zeros(4), [], {}, np.zeros((4, 0)), (1, 2), (0, 3), {1: (0.0, 1.0)}, 2.0)
    seen = []

    def rising(_, __, i, points):
        seen.append(points)
        return rises[i]

    with answers(estimate, evaluate=lambda _, item: item, _rises=rising, _better=lambda *_: None,
                 _interval_ends=((-0.5, 0.5), 0.0, 0.0)):  # fmt: skip
        found = estimate._over_ranges(asked, state, [0, 1, 2, 3])
        with refused("identification.nothing_told", InsufficientData):
            estimate._over_ranges(asked, replace(state, free=(1,), at_bound=()), [1])
    assert (found.free, found.at_bound) == ((), ())
    assert found.ranges == {2: (-0.5, 0.5), 3: (-0.5, 0.5)}
    assert found.theta.tolist() == [0.25, 0.25, 0.0, 0.0]
    assert seen[0] == pytest.approx(np.unique([*np.linspace(-1.0, 1.0, 13), 0.25]))


# --- which samples count, and which logs move

SLIDE = shipped("slide_servo")


def test_samples_of_an_empty_chamber_count_no_more_until_a_command_changes():
    """Nor does what comes just before they are seen; another cylinder's channels do."""
    tick, limit = 0.01, observations.SETTINGS.empty * float(SLIDE.oil.cavitation_pressure)
    high = np.full(600, 1e6)
    empty = high.copy()
    empty[100] = 1.1 * limit  # gauge pressures: below it
    command = np.where(np.arange(600) < 300, 2.0, 6.0)
    channels = ["press.p_head", "press.x"]
    record = Record(
        np.arange(600) * tick,
        {"press.p_head": empty, "press.p_rod": high, "press.x": np.full(600, 0.1),
         "press.servo.command": command},
    )  # fmt: skip
    ahead = round(observations.SETTINGS.emptying / tick)
    counts, (note,) = simulator._counts("log", Model.of(SLIDE), record, channels)
    void = np.zeros(600, bool)
    void[100 - ahead : 300 + ahead] = True
    for column in counts.T:
        np.testing.assert_array_equal(~column, void)
    assert note.fields["t"] == pytest.approx((100 - ahead) * tick)
    assert note.fields["share"] == pytest.approx(100.0 * void.mean())
    empty[0] = 1.1 * limit
    counts, _ = simulator._counts("log", Model.of(SLIDE), record, channels)
    np.testing.assert_array_equal(counts[:, 0], np.arange(600) >= 300 + ahead)
    empty[300 + ahead - 1] = 1.1 * limit  # while samples before it do not count either
    counts, _ = simulator._counts("log", Model.of(SLIDE), record, channels)
    assert not counts.any(), "no command follows"
    with refused("identification.none_counts", InsufficientData):
        simulator.prepare(Model.of(SLIDE), record, "log", ["p_head"], (), 1, None)
    full = record.channels | {"press.p_head": np.full(600, 0.9 * limit)}
    counts, notes = simulator._counts("log", Model.of(SLIDE), Record(record.t, full), channels)
    assert counts.all() and not notes


def test_samples_of_a_pressure_at_the_end_of_its_sensor_do_not_count():
    """A stroke may stand at its end."""
    y = np.minimum(np.sin(0.02 * np.arange(900)), 0.8)
    record = Record(np.arange(900) * TICK, {"press.p_head": 1e6 * (2.0 + y), "press.x": 2.0 + y})
    counts, notes = simulator._counts("log", Model.of(SLIDE), record, ["press.x", "press.p_head"])
    assert counts[:, 0].all() and not notes
    assert np.flatnonzero(~counts[:, 1]).tolist() == np.flatnonzero(y == 0.8).tolist()


@pytest.mark.parametrize(
    ("role", "owner", "matched"),
    [("frequency", "", True), ("frequency", "a", False), ("decay", "a", True),
     ("decay", "", True), ("", "", False), ("", "a", False)],
)  # fmt: skip
def test_ringing_tells_of_the_oil_and_of_dampings(role, owner, matched):
    search: Any = [Stub(row=Stub(mode_role=role), owner=owner, name="x")]
    if matched:
        return matching.refuse_unmatched(search)
    with refused("identification.thesis_parameter", InputError):
        matching.refuse_unmatched(search)


@pytest.mark.parametrize(("share", "moves"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("name", ["slide_servo", "thesis_arm"])
def test_a_cylinder_moves_whose_position_changes_by_a_share_of_its_stroke(name, share, moves):
    """Of a joint, by that share of a radian."""
    rig = shipped(name)
    cylinder = rig.cylinder[0]
    change = share * simulator.SETTINGS.moves
    for word, span in (("x", float(cylinder.stroke)), ("q", 1.0)):
        if word == "q" and cylinder.linkage is None:
            continue
        at = np.linspace(0.1, 0.1 + change * span, 50)
        record = Record(np.arange(50) * TICK, {f"{cylinder.name}.{word}": at})
        assert simulator._moves(cylinder, record) is moves


def test_a_fit_whose_valves_all_stay_shut_says_so_of_its_first_log():
    t = np.arange(300) * TICK
    quiet = {"press.servo.command": np.full(300, 1e-3), "press.x": np.full(300, 0.1)}
    quiet |= {"press.p_head": np.full(300, 1e6), "press.p_rod": np.full(300, 1e6)}
    logs = [(name, Record(t, dict(quiet))) for name in ("first", "second")]
    with pytest.raises(InsufficientData) as refusal:
        hydraulics.prepare_fit(SLIDE, logs, ["bulk_modulus"])
    assert "first" in str(refusal.value) and "second" not in str(refusal.value)
