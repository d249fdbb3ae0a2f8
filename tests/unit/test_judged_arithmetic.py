"""What judges a model beside the residual, on small arrays: steps, sweeps, black boxes, copies."""

import math
from dataclasses import replace
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.config.recipe import Thresholds
from ehbench.data.record import Record
from ehbench.diagnosis import Structure, cases
from ehbench.diagnosis.faults.scales import Scales
from ehbench.frequency_response.response import Estimate, Response
from ehbench.plant.model import Model
from ehbench.plant.ties import TIED
from ehbench.preprocessing.observations import least_change
from ehbench.preprocessing.preparation import PreparedLog
from ehbench.validation import baseline, checks, held_out, judge, sweeps
from ehbench.validation.residuals import Pair, compare_channel
from ehbench.validation.results import (
    BlackBox,
    ChannelResult,
    Check,
    LogResult,
    Ring,
    speaking_against,
)
from ehbench.validation.transients import stands, steps_only, transients_of, why_not_judged
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.terms import Z95
from tests.settings import answers
from tests.shared import shipped

TICK = 1e-3
MODEL = Model.of(shipped("slide_servo"))
COMMAND = "press.servo.command"


@pytest.fixture
def rng():
    return np.random.default_rng(5)


# --- ringing after steps


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_command_keeps_its_value_until_it_is_off_by_more_than_its_noise(sign):
    given = sign * np.array([0.2, 0.7, -0.2, 1.0, 1.4, 0.6, 0.49, 0.3, -0.2])
    held = sign * np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0, 0.49, 0.49, -0.2])
    assert steps_only(given, 0.5).tolist() == held.tolist()


@pytest.mark.parametrize(
    ("omega", "damping", "std", "key", "fields"),
    [
        (20.0, 0.1, 0.04, "grows", {"damping": 0.1}),
        (20.0, 0.6, 0.01, "short_stand", {"periods": 20.0 * 0.8 * 0.399 / (2.0 * math.pi)}),
        (200.0, 1.2, 0.01, "short_stand", {"periods": 0.0}),
    ],
)
def test_a_window_is_as_long_as_its_damped_periods(omega, damping, std, key, fields):
    t = 10.0 + np.arange(400) * TICK
    result: Any = Stub(natural_frequency=omega, damping_ratio=damping, damping_ratio_std=std)
    note: Any = why_not_judged(t, np.zeros((400, 1)), result)
    assert note.key == f"validation.{key}"
    assert {name: note.fields[name] for name in fields} == pytest.approx(fields)


@pytest.mark.parametrize(
    ("first", "second", "std"), [(50.0, 75.0, 0.01), (75.0, 50.0, 0.01), (50.0, 75.0, 6.0)]
)
def test_halves_that_ring_otherwise_are_told_in_hertz(first, second, std):
    """By more than 0.15 · 50 and three standard errors."""
    t = np.arange(2000) * TICK
    turn = np.where(t < 1.0, first * t, first + second * (t - 1.0))
    swing = np.exp(-1.0 * t) * np.sin(turn)
    result: Any = Stub(natural_frequency=50.0, damping_ratio=0.02, damping_ratio_std=1e-4, stop=2.0)
    result.natural_frequency_std = std
    note: Any = why_not_judged(t, swing[:, None], result)
    if std > 1.0:
        assert note == ""
        return
    assert note.key == "validation.halves_differ"
    assert note.fields["half"] == pytest.approx(75.0 / (2.0 * math.pi), rel=0.01)
    assert note.fields["whole"] == pytest.approx(50.0 / (2.0 * math.pi))


@pytest.mark.parametrize(
    ("levels", "stand"),
    [
        ([0.0, 0.9, 1.0, 1.0, 1.0, 1.09, 1.09, 1.09], True),
        ([0.0, 0.9, 1.0, 1.0, 1.0, 1.11, 1.11, 1.11], False),
        ([1.0, 0.9, 0.0, 0.0, 0.0, 0.0, -0.1, -0.15], False),
        ([1.0, 0.9, 0.0, 0.0, 0.15, -0.15, 0.0, 0.0], True),
    ],
)
def test_a_command_stands_whose_thirds_differ_by_a_tenth_of_its_step(levels, stand):
    assert stands(np.column_stack([levels, np.full(8, 3.0)]), 2) == stand
    assert not stands(np.column_stack([levels, np.full(8, 3.0)]), 6), "two samples, no third part"


@pytest.mark.parametrize(
    ("left", "creep", "key"),
    [(5.0, 0.0, ""), (1.05, 0.0, "only_noise_left"), (5.0, 0.9, "command_moves")],
)
def test_a_window_tells_of_a_model_where_more_than_noise_is_left(rng, left, creep, key):
    """And where its command stands; a position that rings tells nothing."""
    t, least = np.arange(2000) * TICK, least_change(MODEL.rig.cylinder[0].valve[0])
    u = least * (2.0 + creep * (t - 0.5) / 1.5) * (t >= 0.5)
    noise = 1e4 * rng.standard_normal(t.size)
    swing = np.exp(-2.0 * (t - 0.5)) * np.cos(40.0 * (t - 0.5)) * (t >= 0.5)
    y = 5e6 + 1e6 * swing + noise
    log = Record(t, {"press.p_head": y, "press.x": swing, COMMAND: u})
    simulated = y + left * 1e4 * np.where(np.arange(t.size) % 2, 1.0, -1.0)
    pairs = {"press.x": Pair(swing, swing, False), "press.p_head": Pair(y, simulated, False)}
    assert transients_of(log, MODEL, "press", {"press.x": pairs["press.x"]}) == []
    (window,) = transients_of(log, MODEL, "press", pairs)
    note: Any = window.recorded.reason if creep else window.note
    assert getattr(note, "key", "").removeprefix("validation.") == key
    assert window.start == pytest.approx(0.5)
    assert window.recorded.cycles == 0.0 if creep else window.recorded.cycles > 5.0


@pytest.mark.parametrize(("later", "starts"), [(20, [0.52]), (21, [0.5]), (400, [0.5])])
def test_a_window_begins_with_the_last_of_the_commands_that_change_together(later, starts):
    """Within 20 ms; a change of another cylinder alone begins none of this one."""
    model = Model.of(shipped("thesis_arm"))
    t = np.arange(1500) * TICK
    one, other = 5.0 * (t >= 0.4999), 5.0 * (np.arange(1500) >= 500 + later)
    y = 5e6 + 1e6 * np.exp(-2.0 * t) * np.cos(40.0 * t)
    log = Record(t, {"swing.servo.command": one, "boom.hepc.command": other, "swing.p_head": y})
    found = transients_of(log, model, "swing", {"swing.p_head": Pair(y, 1.1 * y, False)})
    assert [window.start for window in found] == pytest.approx(starts)


def test_a_ringing_is_clear_that_lasts_and_a_black_box_counts_where_it_is_told():
    assert Ring(10.0, 0.1, 0.1, 0.01, 5.0).clear
    assert not Ring(10.0, 0.1, 0.1, 0.01, 0.5).clear and not Ring().clear
    assert not BlackBox().counts


@pytest.mark.parametrize(
    ("key", "shown", "scale"),
    [("natural_frequency", ("6 ± 0.2 Hz", "5 ± 0.1 Hz"), 2.0 * math.pi),
     ("damping_ratio", ("6 ± 0.2", "5 ± 0.1"), 1.0)],
)  # fmt: skip
@pytest.mark.parametrize("limit", [0.11, 0.105])
def test_the_worst_ringing_is_off_by_its_share_less_two_errors(key, shown, scale, limit):
    """6 ± 0.2 against 5 ± 0.1: 0.2 − 2·√0.05/5; the one that is off by more is known less."""

    def side(value, std):
        return (
            Stub(**{key: scale * value, f"{key}_std": scale * std}, natural_frequency=1.0)
            if key == "damping_ratio"
            else Stub(**{key: scale * value, f"{key}_std": scale * std})
        )

    windows: Any = [
        Stub(start=1.0, recorded=side(5.0, 0.1), simulated=side(6.0, 0.2)),
        Stub(start=2.0, recorded=side(5.0, 0.1), simulated=side(7.0, 0.9)),
    ]
    found = checks._ringing_check("press", key, windows, limit)
    told: Any = found.sentence
    assert found.reached == pytest.approx(0.2) and told.fields["time"] == 1.0
    assert found.passed == (0.2 - 0.4 * math.sqrt(0.05) <= limit)
    assert (told.fields["simulated"], told.fields["recorded"]) == shown
    windows[1].simulated = Stub(natural_frequency=None, reason="it is still")
    none = checks._ringing_check("press", key, windows, 9.0)
    told = none.sentence
    assert not none.passed and none.reached is None and told.fields["time"] == 2.0


# --- sweeps


@pytest.mark.parametrize(("wait", "sweeps_so"), [(80, True), (150, False)])
def test_a_sweep_that_begins_late_stands_no_longer_for_it(wait, sweeps_so):
    turns = np.repeat(np.arange(100) % 2, 10)
    u = 5.0 * np.concatenate([np.zeros(500), turns, np.zeros(wait), np.repeat([1.0, 0.0], 10)])
    t = np.arange(u.size) * TICK
    found = sweeps._sweeping(Record(t, {COMMAND: u}), MODEL, "press")
    assert (found is not None) == sweeps_so
    assert found is None or found == (COMMAND, slice(510, 500 + 1000 + wait + 11))
    boom, names = Model.of(shipped("boom_four_valve")), ["boom.sh.command", "boom.rt.command"]
    for sizes, most in (((0.5, 1.0), 1), ((1.0, 0.5), 0)):
        log = Record(t, {name: size * u for name, size in zip(names, sizes, strict=True)})
        both = sweeps._sweeping(log, boom, "boom")
        assert (both and both[0]) == (names[most] if sweeps_so else None)


def response_of(gain, delay, coherent, low=None) -> Response:
    """A response at 1 … 40 Hz that is late and known to 10 %."""
    f = np.arange(1.0, 41.0)
    phase = -2.0 * math.pi * f * delay
    gain = gain * np.ones(40)
    ends = (gain, gain * (1.0 - 0.1 * Z95), gain * (1.0 + 0.1 * Z95))
    told = None if low is None else Estimate(delay, low, 2.0 * delay - low)
    return Response(f, *ends, phase, phase, phase, 0.9 * coherent + 0.05, coherent, 0.1, 9.0, 1.0,
                    told, None, None, ())  # fmt: skip


@pytest.mark.parametrize(
    ("known", "told"),
    [
        (range(1, 41), True),
        (range(20, 41), True),
        (range(21, 41), False),
        ((1, *range(5, 39, 2), 39), False),
        ((1, *range(3, 39, 2), 39), True),
        ((1, 2), False),
        ((), False),
    ],
)
def test_a_response_counts_over_an_octave_of_which_half_is_known(known, told):
    """Of 39 frequencies 19 are less than half, 20 are not; of what oscillates of the cylinder."""
    coherent = np.isin(np.arange(1.0, 41.0), list(known))
    one, other = Pair(np.zeros(9), np.ones(9), False), Pair(np.zeros(9), np.zeros(9), False)
    pairs = {"press.v": one, "press.x": other, "boom.v": other, "press.p_rod": one}
    asked = []

    def response(_, command, channel, y, span, coherence):
        asked.append((command, channel, float(y[0]), span, coherence))
        return response_of(1.0, 0.0, coherent) if known else None

    with answers(sweeps, _sweeping=lambda *_: (COMMAND, slice(2, 7)), _response=response,
                 _sweep_of=lambda *given: given[:2]):  # fmt: skip
        found = sweeps.sweeps_of(Stub(), Stub(), "press", pairs, 0.8)
    channels = ("press.v", "press.p_rod")
    assert found == [(COMMAND, channel) for channel in channels if told]
    both = [(0.0, 0.8), (1.0, 0.0)][: 2 if told else 1]
    assert asked == [(COMMAND, c, y, slice(2, 7), limit) for c in channels for y, limit in both]


def test_a_sweep_is_off_by_what_its_errors_do_not_make():
    """Where the recording is coherent: its gain doubles, it lags 3 ms more than 2 ± 1 ms."""
    coherent = np.arange(40) % 5 > 0
    recorded = response_of(2.0, 2e-3, coherent, 1e-3)
    plain = sweeps._sweep_of("u", "press.v", recorded, None)
    assert (plain.band, plain.frequencies, plain.averages) == ((2.0, 40.0), 32, 9.0)
    assert plain.coherence == (pytest.approx(0.95), None)
    assert plain.delay == (pytest.approx(2e-3), None) and plain.simulated is None
    found = sweeps._sweep_of("u", "press.v", recorded, response_of(4.0, 5e-3, coherent))
    assert found.delay == pytest.approx((2e-3, 5e-3))
    assert found.coherence == pytest.approx((0.95, 0.95))
    assert found.simulated is not None and found.simulated.frequency[-1] == 40.0
    assert found.delay_error == pytest.approx(2e-3) and found.gain_ratio == 2.0
    chance = 0.01 + 1.645 * math.sqrt(2.0 * 32 * 1e-4) / 32.0
    assert found.gain_error == pytest.approx(math.sqrt(1.0 - chance), rel=1e-6)
    turn = 2.0 * math.pi * recorded.frequency[coherent] * 3e-3
    assert found.phase_error == pytest.approx(math.sqrt(np.mean(turn**2) - chance), rel=1e-6)
    near = sweeps._sweep_of("u", "press.v", recorded, response_of(2.0, 2.5e-3, coherent))
    assert near.delay_error == near.gain_error == 0.0
    vague = replace(recorded, delay=None)
    assert sweeps._sweep_of("u", "press.v", vague, recorded).delay_error == 0.0


# --- the black box


def test_signals_count_from_the_first_command_and_the_level_before_it():
    y, u = np.arange(12.0), np.array([2.0, 2.0, 2.0, 2.0, 2.0, 5.0, 5.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    log = Record(np.arange(12) * TICK, {"ram.v": y, "ram.a.command": u})
    t, blocks, given, level = baseline._signals(log, "ram.v", ("ram.a.command",), 2e-3)
    assert level == 2.0  # of 0 … 4
    assert t == pytest.approx(TICK * (np.arange(0.0, 12.0, 2.0) + 0.5))
    assert blocks == pytest.approx(np.arange(0.5, 12.0, 2.0) - 2.0)
    assert given == pytest.approx(np.array([[0, 0, 1.5, 1.5, 0, 0], [0, 0, 0, -0.5, -1, -2]]).T)
    at_once = Record(log.t, {"ram.v": y, "ram.a.command": np.arange(12.0)})
    assert baseline._signals(at_once, "ram.v", ("ram.a.command",), 3e-3)[3] == 1.0
    still = Record(log.t, {"ram.v": y, "ram.a.command": np.ones(12)})
    assert baseline._signals(still, "ram.v", ("ram.a.command",), 4e-3)[3] == 1.5


def arx_log(rng, order, size=200):
    """A channel by its recursion from rest, whose command is never below its first."""
    poles, inputs = np.array([0.5, -0.3])[:order], np.arange(1.0, order + 2.0)
    u, y = np.abs(rng.standard_normal(size)), np.zeros(size)
    u[: order + 1] = 0.0
    for k in range(order, size):
        past, drive = y[k - order : k][::-1], u[k - order : k + 1][::-1]
        y[k] = poles @ past + inputs @ drive
    return poles, inputs, Record(np.arange(size) * TICK, {"ram.v": y, "ram.a.command": u})


@pytest.mark.parametrize("order", [1, 2])
def test_the_numbers_of_a_recursion_come_back(rng, order):
    """What is never commanded has none."""
    poles, inputs, log = arx_log(rng, order)
    short = log.at(slice(2 * order))
    box = baseline._least_squares("ram.v", ("ram.a.command",), TICK, order, [short, log])
    assert box is not None and box.poles == pytest.approx(poles)
    assert box.inputs[0::2] == pytest.approx([*inputs, 0.0], abs=1e-9)
    assert box.inputs[1:-1:2] == pytest.approx(np.zeros(order + 1), abs=1e-9)
    assert baseline._least_squares("ram.v", ("ram.a.command",), TICK, order, [short]) is None
    found = baseline.fit("ram.v", [log])
    assert found is not None and found.tick == pytest.approx(TICK)
    assert found.run(log) == pytest.approx(log["ram.v"], abs=1e-6)


def test_a_black_box_is_shown_over_what_is_scored(rng):
    _, _, log = arx_log(rng, 1)
    box = baseline.fit("ram.v", [log])
    odd = Record(log.t, log.channels | {"ram.v": log["ram.v"] + 9.0 * (log.t > 0.15)})
    item = ChannelResult("ram.v", "m/s", 50.0, 0.0, 0.0, 0.0)
    scored = LogResult("a", "none", "held_out", 0.2, TICK, (0.01, 0.1), channels=(item,))
    shown = baseline._with_fits(scored, odd, {"ram.v": box}).channels[0]
    assert shown.baseline_percent == pytest.approx(100.0, abs=1e-3)
    whole = baseline._with_fits(replace(scored, scored=None), odd, {"ram.v": box}).channels[0]
    assert whole.baseline_percent is not None and whole.baseline_percent < 90.0
    for other in (replace(item, fit_percent=None), replace(item, channel="ram.x")):
        same = replace(scored, channels=(other,))
        assert baseline._with_fits(same, odd, {"ram.v": box}).channels == (other,)


@pytest.mark.parametrize(
    ("status", "training", "fitted", "shown", "counts"),
    [
        (("held_out", "fitted", "held_out"), 0, ("b",), "ac", True),
        (("held_out", "held_out", "held_out"), 1, ("t",), "abc", True),
        (("held_out", "fitted", "held_out"), 1, ("t", "b"), "ac", True),
        (("held_out", "held_out", "held_out"), 0, ("a",), "bc", False),
        (("fitted", "fitted", "failed"), 0, (), "", True),
    ],
)
def test_a_black_box_is_fitted_to_what_the_model_was_or_to_the_first(
    status, training, fitted, shown, counts
):
    item = ChannelResult("ram.v", "m/s", 50.0, 0.0, 0.0, 0.0)
    other = replace(item, channel="ram.x", fit_percent=None)
    logs = [
        LogResult(n, "none", s, 1.0, TICK, channels=(item, other))
        for n, s in zip("abc", status, strict=True)
    ]
    asked = {}

    def fit(channel, records):
        asked[channel] = tuple(records)
        return Stub(poles=np.zeros(2), tick=4e-3)

    with answers(
        baseline,
        fit=fit,
        _with_fits=lambda log, record, _: replace(log, name=log.name + record),
        _better=lambda log: [log.name],
    ):
        found, box, better = baseline.black_boxes(logs, ["a", "b", "c"], [("t", "t")] * training)
    assert asked == ({"ram.v": fitted} if shown else {})
    assert (box.fitted, box.counts) == (fitted, counts)
    assert box.orders == ({"ram.v": (2, 4e-3)} if shown else {})
    assert [log.name for log in found] == [2 * n if n in shown else n for n in "abc"]
    assert better == ([2 * n for n in shown] if counts else [])


# --- residuals


def test_a_residual_goes_along_with_the_commands_of_its_own_cylinder(rng):
    t = np.arange(4000) * TICK
    u = np.repeat(rng.standard_normal(40), 100)
    y = 1e6 * np.repeat(rng.standard_normal(400), 10)
    log = Record(t, {"press.p_head": y, COMMAND: u})
    late = np.concatenate([np.zeros(200), u[:-200]])
    result = compare_channel(log, MODEL, "press.p_head", Pair(y, y + 1e5 * late, False))
    auto: Any = result.autocorrelation
    (cross,) = result.cross_correlation
    assert auto.lag[0] == pytest.approx(0.01) and auto.lag[-1] == pytest.approx(0.5)
    assert len(auto.lag) == len(cross.lag) - 1 == 50 and cross.of == COMMAND
    assert cross.lag[int(np.argmax(cross.value))] == pytest.approx(0.2)
    assert 0.0 < cross.outside_percent < 100.0
    assert result.max_error == pytest.approx(1e5 * late[np.argmax(np.abs(late))])
    still = Record(t, {"press.p_head": y, COMMAND: np.ones(4000)})
    same = compare_channel(still, MODEL, "press.p_head", Pair(y, y + 1e5 * late, False))
    assert same.cross_correlation == () and same.autocorrelation == auto
    short = log.at(slice(0, 110))
    part = Pair(y[:110], y[:110] + 1e5 * u[20:130], False)
    few: Any = compare_channel(short, MODEL, "press.p_head", part).autocorrelation
    assert len(few.lag) == 2  # a quarter of eleven blocks


# --- samples that a model was fitted to


@pytest.mark.parametrize(("gap", "runs"), [(1, 1), (2, 2)])
def test_a_stretch_has_at_most_one_sample_missing(gap, runs):
    same = np.ones(60, bool)
    same[30 : 30 + gap] = False
    rows: Any = Stub(log="a", t=np.arange(60) * TICK)
    found = held_out._runs(np.arange(60) * TICK, same, rows)
    assert len(found) == runs and sum(item.samples for item in found) == 60 - gap
    assert (found[0].start, found[-1].stop) == pytest.approx((0.0, 0.059))
    assert runs == 1 or (found[0].stop, found[1].start) == pytest.approx((0.029, 0.032))


@pytest.mark.parametrize(("quiet", "runs"), [(2, 1), (5, 2)])
def test_a_copy_of_a_noise_goes_on_where_it_rests_for_some_blocks(rng, quiet, runs):
    """Its readings are those of the fitted samples but for a tenth of the noise."""
    size = 64 * 14
    loud = np.ones(size)
    loud[64 * 4 : 64 * (4 + quiet)] = 1e-4
    y = loud * rng.standard_normal(size)
    copy = y + 0.1 * rng.standard_normal(size)
    t = np.arange(size) * TICK
    rows = held_out.FittedSamples("a", t, {"v": y})
    found = held_out._same_noise(Record(t, {"v": copy, "x": copy}), rows)
    assert len(found) == runs
    assert sum(item.samples for item in found) == size - (64 * quiet if runs > 1 else 0)
    other = Record(t, {"v": loud * rng.standard_normal(size)})
    assert held_out._same_noise(other, rows) == []
    assert held_out._same_noise(Record(t, {"x": copy}), rows) == []
    assert held_out._same_noise(Record(t[:63], {"v": copy[:63]}), rows) == []
    assert held_out._overlaps(Record(t, {"x": copy}), rows) == []


@pytest.mark.parametrize(("agreeing", "late"), [(24, 0.5), (16, 0.5), (6, 0.0)])
def test_a_shift_is_what_half_of_the_rows_agree_on(agreeing, late):
    """Rows of 1, 2, 3 …; of some the copy has each elsewhere."""
    y = np.arange(1.0, 25.0)
    t = np.arange(24) * TICK
    when = t + 0.5
    when[agreeing:] += 0.1 * np.arange(1.0, 25.0 - agreeing)
    found = held_out._shift(when, y[:, None], t, y[:, None], np.full(1, 1e-6))
    assert found == pytest.approx(late)
    assert held_out._shift(when, y[:, None] + 0.5, t, y[:, None], np.full(1, 1e-6)) == 0.0


# --- which logs count, and by what


@pytest.mark.parametrize(
    ("fitted", "overlap", "moved", "keys"),
    [
        (False, (), ["press"], []),
        (True, (), ["press"], ["fitted"]),
        (True, (Stub(start=1.0, stop=2.5, log="a"),), ["press"], ["samples_fitted"]),
        (False, (), [], ["no_motion"]),
        (True, (), [], ["fitted", "no_motion"]),
    ],
)
def test_a_log_counts_that_moves_and_was_not_fitted(fitted, overlap, moved, keys):
    model, counted = Stub(model=MODEL), Record(np.arange(4) * TICK, {})
    log: Any = Stub(fitted=fitted, overlap=overlap, failure="", log=model, counted=counted)
    with answers(judge, not_described=[]):
        notes: list[Any] = list(judge._not_counted(log, moved))
    assert [note.key for note in notes] == [f"validation.{key}" for key in keys]
    if overlap:
        assert notes[0].fields["spans"] == "1 … 2.5 s (of a)"
    void = np.array([False, False, True, False])
    with answers(judge, not_described=[("cavitates", "press", void)]):
        told: Any = list(judge._not_counted(log, moved))[-1]
        log.failure = "it did not run"
        assert list(judge._not_counted(log, moved)) == notes
    assert told.fields == {"cylinder": "press", "t": 2 * TICK, "share": 25.0}


@pytest.mark.parametrize(
    ("tied", "judged"),
    [("", ["press.x", "press.v", "press.p_head"]), ("position", ["press.v", "press.p_head"])],
)
def test_what_is_tied_to_the_recording_is_not_judged(tied, judged):
    record = Record(np.arange(9) * TICK, {"press.x": np.zeros(9)})
    if tied:
        record = replace(record, meta={TIED: tied})
    channels = ["press.x", "press.v", "press.p_head"]
    assert judge._free(MODEL, record, channels) == judged


@pytest.mark.parametrize(
    ("scored", "samples"), [(None, range(9)), ((0.002, 0.004), range(2, 5)), ((0.0, 0.0), [0])]
)
def test_what_is_scored_of_a_log_has_both_its_ends(scored, samples):
    record = Record(np.arange(9) * TICK, {"press.x": np.arange(9.0)})
    log = judge.JudgedLog(PreparedLog("log", record, MODEL), scored=scored)
    assert log.counted["press.x"].tolist() == list(samples)
    keep = cases.Case.keep.func(
        Stub(record=record, scored=scored, model=MODEL, cylinders=["press"])
    )
    assert np.flatnonzero(keep).tolist() == list(samples)


@pytest.mark.parametrize(
    ("scored", "samples"), [(None, range(150)), ((0.16, 0.3), range(160, 301))]
)
def test_no_cause_is_sought_where_a_chamber_empties(scored, samples):
    """From 50 ms before, as in a fit; a log of nothing else is asked all the same."""
    pressure = np.where(np.arange(400) < 200, 1e6, -1e5)
    record = Record(np.arange(400) * TICK, {"press.p_head": pressure})
    keep = cases.Case.keep.func(
        Stub(record=record, scored=scored, model=MODEL, cylinders=["press"])
    )
    assert np.flatnonzero(keep).tolist() == list(samples)


def test_a_log_that_cannot_be_judged_is_told_with_its_facts():
    """What was scored of it, its payload, and the channels that somebody may look at."""
    u, x = np.repeat([0.0, 5.0], 20), np.arange(40.0)
    record = Record(np.arange(40) * TICK, {COMMAND: u, "press.x": x, "press.p_rod": x})
    failure = LogError("log: no start")
    given = PreparedLog("log", record, MODEL)
    whole = judge._judge(judge.JudgedLog(given, failure=failure), ("x",), Thresholds())
    assert (whole.payload, whole.status, whole.failure) == ("none", "failed", "no start")
    assert whole.duration == pytest.approx(0.039) and whole.scored is None
    assert (whole.moved, whole.held) == (("press",), ())
    assert set(whole.series) == {"t", "press.x"}
    loaded = replace(given, record=replace(record, meta={"payload": "mould"}))
    part = judge.JudgedLog(loaded, scored=(0.005, 0.015), failure=failure)
    scored = judge._judge(part, ("x",), Thresholds())
    assert scored.payload == "mould" and scored.duration == pytest.approx(0.01)
    assert scored.scored == pytest.approx((0.005, 0.015))
    assert (scored.moved, scored.held) == ((), ("press",))


def test_what_a_log_may_be_instead_is_a_reservation_and_no_rejection():
    """Another payload, exchanged channels: unless nobody asks for it."""
    check = Check("press.x fit", 90.0, 80.0, "%", True, "it fits")
    log = LogResult("a", "none", "held_out", 1.0, TICK, checks=(check,))
    prepared: Any = Stub(rig=Stub(name="slide"), channels=("x",), logs=[Stub(log=Stub(record=0))])
    prepared.training, prepared.leans, prepared.cases = (), (), lambda results: [1, 2]
    shares = []
    with answers(judge, _judge=log, black_boxes=([log], BlackBox(), ()), ask=Structure(),
                 misread=lambda case: [f"exchanged {case}"]):  # fmt: skip
        found = judge.run_validation(prepared, progress=lambda _, share: shares.append(share))
        quiet = judge.run_validation(prepared, diagnose=False)
    assert found.accepted and found.reservations == ("exchanged 1", "exchanged 2")
    assert found.reasons == () and shares == [1.0, 1.0]
    assert quiet.verdict == "accepted" and found.verdict == "accepted with reservation"


def test_a_cause_rejects_that_makes_most_of_what_a_fit_leaves():
    """One whose share is not known does not."""
    notes = [Stub(fields=fields) for fields in ({"cause": "a"}, {"cause": "b", "share": 0.6}, {})]
    lean = {"sentence": "lean", "explains": 0.4}
    against = speaking_against({"warnings": [*notes, "plain"], "leans": [lean]})
    assert [item["explains"] for item in against] == [0.0, 0.6, 0.4]
    found = judge.Validation("slide", True, (), (), {}, ()).with_fit(against)
    assert found.reasons == (notes[1],) and found.reservations == (notes[0], "lean")
    assert not found.accepted


# --- residual diagnosis


@pytest.mark.parametrize(
    ("gain", "noise", "independent", "counted"),
    [
        (99.0, 0.0, 1e4, False),  # less than a tenth of the excess
        (101.0, 0.0, 290.0, True),  # 290 ln(1000/899) = 30.9
        (101.0, 0.0, 280.0, False),
        (61.0, 900.0, 500.0, True),  # 500 ln(1000/939) = 31.5
        (59.0, 900.0, 1e4, False),  # half of it is below 30
        (61.0, 900.0, 470.0, False),
        (1000.0, 0.0, 1.2, True),  # all of it: 1.2 ln(1e12) = 33.2
    ],
)
def test_a_cause_counts_beyond_chance_and_a_trifle(gain, noise, independent, counted):
    assert cases.counts(gain, 1000.0, noise, independent) == counted


def test_a_case_counts_its_blocks_by_the_memory_of_each_channel(rng):
    """A first-order process with the pole a lasts (1 + a)/(1 − a) samples."""
    slow = np.zeros(4000)
    for i, step in enumerate(rng.normal(size=3999)):
        slow[i + 1] = 0.8 * slow[i] + step
    white = rng.normal(size=4000)
    some: Any = Stub(recorded={"x": slow, "v": slow, "q": white})
    count = cases.Case.independent(some, np.concatenate([slow, slow, white]))
    assert count == pytest.approx(2 * 4000 / 9.0 + 4000, rel=0.1)
    rate = lambda tick: cases.Case.block.func(Stub(record=Stub(sample_time=tick)))
    assert [rate(tick) for tick in (0.02, 0.004, 0.001)] == [1, 1, 5]
    flat = Record(np.arange(5.0), {"x": np.ones(5), "v": np.linspace(0.0, 1.0, 5)})
    assert [cases.Case._moves(Stub(record=flat), name) for name in "xvq"] == [False, True, False]


def test_a_model_follows_a_log_from_the_best_start_but_where_that_is_not_refined():
    case = cases.Case("log", Record(np.arange(5.0), {}), MODEL, ())
    shifts = []
    for item in (case, replace(case, refined=False)):
        vars(item).update(_start=Stub(uncertain=("x",)), _of_cylinders=())
        with answers(cases, best_shifts=np.array([2.0])):
            shifts += item._shifts.tolist()
    assert shifts == [2.0, 0.0]


def test_scales_of_a_log_tell_a_drive_by_commands_of_several_sizes():
    log = {"press.servo.command": np.array([0.0, 1.0, -5.0, 5.0]), "x": np.array([1.0, 5.0])}
    some: Any = Stub(cylinder=Stub(name="press"), records=[log], reach=5.0, channel="x")
    some.valve = Stub(name="servo", given=(-10.0, 10.0))
    graded = lambda: Scales.graded.__get__(some)
    assert graded() and Scales.spread.func(some) == 2.0
    some.valve.given = (0.0, 10.0)
    assert graded()
    some.valve.given = (-10.0, 0.0)
    assert graded()
    some.valve.given = (1.0, 10.0)
    assert not graded()
    some.valve.given, log["press.servo.command"] = (-10.0, 10.0), np.array([0.0, 5.0, -5.0])
    log["x"] = np.ones(3)
    assert not graded() and Scales.spread.func(some) == 1.0
