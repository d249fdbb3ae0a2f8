"""Logs faster than the machine, compared as means: the same numbers and intervals."""

import math
from dataclasses import make_dataclass, replace
from functools import cache
from types import SimpleNamespace as Stub
from typing import Any

import numpy as np
import pytest

from ehbench.config.recipe import load_recipe
from ehbench.data.record import BlockAverages, Record
from ehbench.guidance.suggestions import _windows
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics, prepare_fit
from ehbench.identification.means import SETTINGS, fastest
from ehbench.identification.simulator import Log, seen_as, shut
from ehbench.plant.model import Model, simulate
from ehbench.plant.paced import AUTO
from ehbench.preprocessing.time_base import parts_of
from ehbench.vocabulary.errors import InputError
from tests.shared import RIGS, measured, shipped

NOISE = {"v": 2e-3, "p_head": 1.5e4, "p_rod": 1.5e4, "x": 1e-5, "p_supply": 6e3}
TRUTH = {"bulk_modulus": 9e8, "carriage.damping": 800.0}
START = {"bulk_modulus": 5e8, "carriage.damping": 1600.0}
RATE = 10_000.0


@cache
def rig(name="slide_servo"):
    return shipped(name)


@cache
def clean(payload=None, seconds=1.0003):
    """The slide out and back at 10 kHz; its last samples fill no mean."""
    t = np.arange(round(seconds * RATE) + 1) / RATE
    out, back = (t >= 0.07) & (t < 0.3), (t >= 0.55) & (t < 0.8)
    commands = {"press.servo": 3.0 * out - 3.0 * back}
    length = float(t[-1])
    return simulate(rig(), commands, length, payload=payload, rate=RATE, step=AUTO)


def noisy(record, seed, time=0.0):
    """What sensors would say, with noise that is white or of a correlation ``time`` [s]."""
    pole = math.exp(-1.0 / (RATE * time)) if time else 0.0
    return measured(record, seed, NOISE, pole=pole, before=500)


def logs(seed=1, time=0.0):
    return [
        (f"log {load}", noisy(clean(load), 10 * seed + k, time))
        for k, load in enumerate((None, "100 kg"))
    ]


def identify(records, **options):
    return identify_hydraulics(rig(), records, list(TRUTH), FitOptions(start=START, **options))


def prepared(records, **options):
    return prepare_fit(rig(), records, list(TRUTH), FitOptions(start=START, **options))


def width(one):
    return one.interval[1] - one.interval[0]


@pytest.mark.parametrize("time", [0.0, 2e-3])
def test_means_tell_what_samples_tell(time):
    """The truth from a start far off, by means and by samples: apart by a fraction of the standard
    error, intervals alike within what their own estimate varies by (2 % by 10 draws of the noise
    for the bulk modulus, some more for the damping)."""
    whole, means = identify(logs(1, time), decimate=1), identify(logs(1, time))
    for name, truth in TRUTH.items():
        low, high = means[name].interval
        assert low <= truth <= high
        assert abs(means[name].value - whole[name].value) < 0.25 * whole[name].std
        assert 0.93 < width(means[name]) / width(whole[name]) < 1.07
    assert whole.compared == ()
    assert means.compared == ("all logs are compared as means of 6 samples, 1.67 kHz of 10 kHz",)
    for one, other, (_, record) in zip(means.logs, whole.logs, logs(), strict=True):
        assert (one.samples, one.mean_of) == (record.t.size // 6 * 6, 6)
        assert (other.samples, other.mean_of) == (record.t.size, 1)
        for channel in one.residual_rms:  # of coloured noise, means leave as much
            least = 0.85 if time else 0.9 / math.sqrt(6)
            share = one.residual_rms[channel] / other.residual_rms[channel]
            assert least < share < (1.0 if time else 1.1 / math.sqrt(6))
            seconds = one.correlation_time[channel] * 6 / RATE
            expected = 2 * time if time else 6 / RATE  # of first order: (1 + pole)/(1 - pole)
            assert 0.5 * expected < seconds < 2.0 * expected
    assert means["bulk_modulus"].samples == sum(one.samples for one in means.logs)
    for name in means.scales:  # channels count for the same; noise is taken for white in a mean
        assert means.scales[name] == pytest.approx(whole.scales[name], rel=0.05 if time else 0.02)


def test_a_step_may_be_taken_at_any_sample():
    """A command that changes within a mean acts there: half a mean late is many errors off."""
    fit = identify(logs(2), decimate=33)
    for name, truth in TRUTH.items():
        assert abs(fit[name].value - truth) < 3.5 * fit[name].std
        assert fit[name].std < 0.02 * truth
    assert not any("behind" in text for text in fit.warnings)


def test_means_of_a_simulation_are_means_of_its_samples():
    """Added up in the kernel or afterwards; the stroke of a joint to the square of its motion."""
    boom = rig("boom_four_valve")
    t = np.arange(7004) / RATE
    up = 4.0 * ((t >= 0.0503) & (t < 0.4))
    made = simulate(boom, {"boom.sh": up, "boom.rt": up}, t[-1], rate=RATE, step=AUTO)
    model, means = Model.of(boom), BlockAverages.of(made, 10)
    start = model.rest_start(made)
    whole, mesh = model.replay_paced(made, start)
    wanted = BlockAverages.of(whole, 10).record
    alone, _ = model.replay_paced(made, start, mesh, means=means)
    assert alone.t.size == 700 and np.array_equal(alone.t, means.record.t)
    assert not any(name.endswith(("command", "opening")) for name in alone.channels)
    for name, y in alone.channels.items():
        close = 1e-6 if name.endswith((".x", ".v")) else 1e-11
        span = max(float(np.ptp(wanted[name])), 1e-9 * float(np.abs(wanted[name]).max()), 1e-300)
        assert np.abs(y - wanted[name]).max() < close * span, name
    chosen, steps = model.replay_paced(made, start, means=means)
    assert steps.size < mesh.size  # over several means at once, where nothing moves
    assert np.abs(chosen["boom.p_head"] - wanted["boom.p_head"]).max() < 1e-5 * np.ptp(
        wanted["boom.p_head"]
    )


def test_how_many_is_by_the_fastest_of_the_machine():
    """A twentieth of the 12.5 ms of an 80 Hz valve, whole samples; of a cutoff, of its period."""
    record = clean()
    frequency = fastest(Model.of(rig()), record)
    assert frequency == pytest.approx(80.0, rel=1e-6)
    (log,) = prepared([("log", record)]).logs
    assert log.each == math.floor(SETTINGS.share / frequency * RATE)
    (log,) = prepared([("log", record)], cutoff=100.0).logs
    assert log.each == 5
    (log,) = prepared([("log", record)], decimate=4).logs
    assert (log.each, len(log.recorded)) == (4, record.t.size // 4)
    assert log.seen.t[0] == pytest.approx(1.5 / RATE)
    assert len(_windows(log)) == len(log.recorded)


def test_the_hydraulic_mode_counts_where_it_is_faster_than_valves():
    """ω² = β (A_h²/V_h + A_r²/V_r)/m, the fastest of the log's postures, dry friction or not."""
    machine = rig().with_values({"carriage.mass": 25.0})
    model, record = Model.of(machine), clean()
    row = model.plant.cylinders[0]
    mass = float(model.plant.links[0].mass)

    def rate(x):
        head = row.area_head**2 / (row.volume_head + row.area_head * x)
        rod = row.area_rod**2 / (row.volume_rod - row.area_rod * x)
        return math.sqrt(row.bulk_modulus * (head + rod) / mass) / (2.0 * math.pi)

    x = record["press.x"]
    expected = max(rate(x.min()), rate(x.max()))
    assert expected > 80.0  # which the valve has
    assert fastest(model, record) == pytest.approx(expected, rel=1e-3)


def test_what_is_left_over_at_the_end_of_the_first_seconds():
    """The first seconds of a log are whole means."""
    (log,) = prepared([("log", clean(None, 1.6003))]).logs
    head = log.head(0.2)
    assert head.record.t.size == 6 * len(head.recorded) == 6 * head.seen.t.size < 9000
    assert np.array_equal(head.recorded, log.recorded[: len(head.recorded)])
    assert head.start.record is head.record


def test_the_first_seconds_of_a_log_hold_four_changes_of_every_command():
    t = np.arange(1000) * 0.01
    command = np.where((t * 0.5) % 1.0 < 0.5, 0.0, 1.0)  # changes at 1, 2, 3, 4, … s
    record = Record(t, {"press.servo.command": command, "press.v": 0.0 * t})
    zeros, start = np.zeros((t.size, 1)), make_dataclass("Start", ["record"])(record)
    log = Log("log", record, None, ("press",), ("press",), ("press.v",), zeros, zeros == 0.0, start)
    assert log.head(0.5).record.t.size == 400 + 5  # the fourth, and a tenth of the time more
    assert log.head(5.0).record.t.size == 500 + 50
    still = replace(log, record=Record(t, {"press.servo.command": 0.0 * t, "press.v": 0.0 * t}))
    assert still.head(0.5).record.t.size == 50 + 5
    assert log.head(7.0) is log


def test_commands_within_dead_bands_name_the_edge_that_is_nearest_to_open():
    """The crane's edges open at 1.5 V, of which one is made to open at 1.2 V the other way."""
    crane = shipped("crane_proportional").with_values({"lift.spool_pb.deadband": 1.2})
    model, t = Model.of(crane), np.arange(100) * 0.01

    def why(low: float, high: float) -> Any:
        record = Record(t, {"lift.spool.command": np.where(t < 0.5, low, high)})
        log: Any = Stub(commanded=("lift",), record=record)
        return shut(model, log)

    assert why(-1.25, 1.0) is None and why(0.0, 1.6) is None
    near = why(-1.1, 1.0)
    assert (near.fields["edge"], near.fields["channel"]) == ("lift.spool_pb", "lift.spool.command")
    assert near.fields["maximum"] == 1.1 and near.fields["onset"] == pytest.approx(1.2, rel=1e-6)
    assert why(-0.1, 1.0).fields["edge"] in ("lift.spool_pa", "lift.spool_bt")
    assert why(0.0, 0.0).key == "identification.opens_nothing"
    bare: Any = Stub(commanded=("lift",), record=Record(t, {}))
    assert getattr(shut(model, bare), "key", "") == "identification.opens_nothing"


@pytest.mark.parametrize(("volts", "shuts"), [(0.0, True), (0.5, False)])
def test_any_command_turns_a_pump(volts, shuts):
    record = Record(np.arange(2.0), {"lift.drive.command": np.array([0.0, volts])})
    log: Any = Stub(commanded=("lift",), record=record)
    assert (shut(Model.of(shipped("pump_cylinder")), log) is not None) == shuts


def test_uneven_clocks_and_gaps():
    """Times a fifth of a sample off are put right first; a log with a gap is two."""
    rng, record = np.random.default_rng(3), noisy(clean(), 5)
    off = replace(record, t=record.t + 0.2 / RATE * rng.uniform(-1.0, 1.0, record.t.size))
    (log,) = prepared([("log", off)]).logs
    (right,) = prepared([("log", record)]).logs
    assert any("not evenly sampled" in text for text in log.warnings)
    tick = np.diff(log.seen.t)
    assert log.each == 6 and np.ptp(tick) < 1e-9 and tick[0] == pytest.approx(6 / RATE, rel=1e-4)
    spread = np.std(right.recorded, axis=0)
    assert np.all(np.std(log.recorded - right.recorded, axis=0) < 0.02 * spread)
    rows = np.r_[0:5203, 5700 : record.t.size]
    parts, _ = parts_of("log", record.at(rows), driven=True, within=None)
    assert len(parts) == 2
    fit = prepared([(part.name, part.record) for part in parts])
    assert [len(one.recorded) for one in fit.logs] == [part.record.t.size // 6 for part in parts]


def test_a_mean_counts_where_all_its_samples_do():
    """A pressure sensor at its end: means with a sample of that, and no others, are left out."""
    record = noisy(clean(), 6)
    high = float(np.quantile(record["press.p_head"], 0.97))
    cut = {**record.channels, "press.p_head": np.minimum(record["press.p_head"], high)}
    (log,) = prepared([("log", replace(record, channels=cut))]).logs
    i = log.channels.index("press.p_head")
    at_end = cut["press.p_head"] == high
    some = at_end[: 6 * len(log.counts)].reshape(-1, 6).any(axis=1)
    assert 0 < np.count_nonzero(some) < len(some)
    assert np.mean(log.counts[some, i]) < 0.1  # a reading that stands alone is no end
    assert log.counts[~some, i].all()


def test_means_of_an_opening_are_of_every_sample():
    record = clean()
    (log,) = prepared([("log", record)], channels=("v", "press.servo.opening")).logs
    model = Model.of(rig())
    whole = model.replay(log.record, AUTO, start=model.rest_start(log.record))
    assert np.array_equal(
        seen_as(log, whole)["press.servo.opening"],
        BlockAverages.of(whole, log.each).record["press.servo.opening"],
    )


RECIPE = """
stage = "identify"
what = "hydraulics"
rig = "{rig}"
data = ["log.mcap"]
parameters = ["bulk_modulus"]
decimate = {given}
"""


@pytest.mark.parametrize("given", ["0", "-3", "2.5", "true", '"often"'])
def test_a_recipe_with_no_such_number_of_samples(tmp_path, given):
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE.format(rig=RIGS / "slide_servo.toml", given=given))
    with pytest.raises(
        InputError, match="decimate: .* is not a number of samples: a whole"
    ) as told:
        load_recipe(path)
    assert told.value.line == 7
