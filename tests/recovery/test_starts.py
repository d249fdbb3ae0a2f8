"""Where a log starts is estimated: in motion, at a drifting rest, or without a speed."""

import math
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from ehbench.data.record import Record
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.initial_states import (
    first_error,
    follow_recording,
    initial_state_of,
    mean_error,
)
from ehbench.preprocessing.plausibility import moving_at_first
from ehbench.preprocessing.preparation import preprocess
from ehbench.signals.series import first_of, fit_percent, rms
from ehbench.vocabulary.messages import is_warning
from tests.shared import measured, shipped

NOISE = {"qd": 4e-3, "v": 1e-3, "p_head": 6e3, "p_rod": 6e3, "q": 1e-4, "x": 1e-5, "p_supply": 6e3}
SLIDE = ["bulk_modulus", "carriage.damping"]
COMPARED = ["press.v", "press.p_head", "press.p_rod"]


noisy = partial(measured, noise=NOISE)


@cache
def driven(kind):
    """A log of the slide, driven by steps or by a sine, and a sample in the middle of a motion."""
    t = np.arange(1501) * 1e-3
    steps = 3.0 * ((t > 0.1) & (t < 0.7)) - 3.0 * (t > 0.9)
    command = steps if kind == "steps" else 3.0 * np.sin(2.0 * math.pi * 1.5 * t)
    return simulate(shipped("slide_servo"), {"press.servo": command}, 1.5), 350


@pytest.mark.parametrize("kind", ["steps", "sine"])
@pytest.mark.parametrize("drop", [(), ("v", "qd")])
def test_a_log_that_begins_in_motion_is_followed(kind, drop):
    made, first = driven(kind)
    record, model = (
        noisy(made, 1, drop=drop).at(slice(first, None)),
        Model.of(shipped("slide_servo")),
    )
    rest = model.replay(record)
    start = follow_recording(model, record, ["press"], COMPARED).start
    followed = model.replay(record, start=start)
    for channel in ("press.x", *COMPARED):
        true = made[channel][first:]
        fits = [fit_percent(true, one[channel]) for one in (rest, followed)]
        assert fits[1] > 97.0, (channel, fits)
        # the place is told by the first samples alone, whatever moves
        assert kind == "sine" or channel == "press.x" or fits[0] < fits[1] - 10.0


def test_parameters_come_back_from_logs_that_begin_in_motion():
    logs = [
        (kind, noisy(made, seed).at(slice(first, None)))
        for seed, kind in enumerate(("steps", "sine"))
        for made, first in [driven(kind)]
    ]
    given = FitOptions(start={"bulk_modulus": 5e8, "carriage.damping": 1500.0})
    fit = identify_hydraulics(shipped("slide_servo"), logs, SLIDE, given)
    for name, truth in (("bulk_modulus", 9e8), ("carriage.damping", 800.0)):
        assert abs(fit[name].value - truth) < 4.0 * fit[name].std, fit[name]
        assert fit[name].std < 0.02 * truth
    assert all(percent > 90.0 for log in fit.logs for percent in log.fit_percent.values())
    assert any("already moves at the first sample" in text for text in fit.warnings)
    assert {"press.qd", "press.servo.opening"} <= set(fit.logs[0].start)


def test_a_rest_that_drifts_does_not_bias():
    """Leakage lets the pressures creep: their mean is not where the log starts."""
    leaky = shipped("slide_servo").with_values({"press.leakage_internal": 1e-12})
    model = Model.of(leaky)
    t = np.arange(1201) * 1e-3
    table = model.rest_commands(t.size)
    table[:, 0] = 3.0 * ((t > 0.25) & (t < 0.6)) - 3.0 * ((t > 0.8) & (t < 1.0))
    y = model.trim(model.posture({}), 2e6)
    names = [model.layout.state(f"p_{side}", 0) for side in ("head", "rod")]
    made = model.record(t, table, model.run(y, table), {"rig": "slide_servo", "payload": "none"})
    record = noisy(made, 3)
    mean = model.rest_start(record).y
    found = follow_recording(model, record, ["press"], COMPARED).start.y
    assert np.abs(mean - y)[names].max() > 2e4
    assert np.abs(found - y)[names].max() < 4e3


def test_a_rest_that_creeps_tells_its_first_place():
    """The mean of a place that leakage lets creep is half of the creep off, in the same direction
    in every log: it made the bulk modulus wrong by more than its interval."""
    leaky = shipped("boom_four_valve").with_values({"boom.leakage_internal": 1e-11})
    model = Model.of(leaky)
    table = model.rest_commands(401)
    table[300:, 0] = 3.0
    y = model.trim(model.posture({}))
    made = model.record(np.arange(401) * 1e-3, table, model.run(y, table), {})
    place = model.layout.state("q", 0)
    creep = abs(made["boom.q"][299] - y[place])
    assert creep > 2e-5
    assert abs(model.rest_start(made).y[place] - y[place]) < 0.05 * creep


@pytest.mark.parametrize("drop", [(), ("v",)])
def test_a_load_that_sinks_before_the_first_command_does_not_ring(drop):
    """Begun from no speed at all the model rings by as much as the load sinks."""
    pump, t = shipped("pump_cylinder"), np.arange(1601) * 1e-3
    command = 4.0 * ((t > 0.9) & (t < 1.2)) - 3.0 * (t > 1.3)
    made = simulate(pump, {"lift.drive": command}, 1.6).at(slice(600, None))
    record, model = noisy(made, 4, drop=drop), Model.of(pump)
    compared = ["lift.v", "lift.p_head", "lift.p_rod"]
    rest = model.replay(record)
    followed = model.replay(record, start=follow_recording(model, record, ["lift"], compared).start)
    for channel, noise in (("lift.v", 1e-3), ("lift.p_head", 6e3)):
        off = [rms(made[channel] - y[channel]) for y in (rest, followed)]
        assert off[0] > 0.3 * noise and off[1] < 0.1 * noise, (channel, off)


def test_a_start_is_as_sure_as_its_samples():
    record = noisy(driven("steps")[0], 2)
    start = initial_state_of(Model.of(shipped("slide_servo")), record, ["press"], COMPARED)
    assert "press.qd" not in {number.name for number in start.uncertain}
    noise = np.random.default_rng(6).standard_normal((300, 200))
    found = [first_of(y + 0.01 * np.arange(200), 150) for y in noise]
    said = [first_error(y + 0.01 * np.arange(200), 150) for y in noise]
    assert abs(np.mean(found)) < 4.0 * np.std(found) / math.sqrt(300)
    assert np.median(said) == pytest.approx(np.std(found), rel=0.15)
    assert first_of(noise[0], 3) == pytest.approx(np.mean(noise[0][:3]))
    assert first_error(noise[0], 3) == mean_error(noise[0], 3)
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(2000)
    assert mean_error(noise, 400) == pytest.approx(0.05, rel=0.4)
    assert mean_error(noise + 0.05 * np.arange(2000), 400) > 5.0
    assert mean_error(noise[:3], 1) > 0.3


def test_a_slide_with_a_position_sensor_only_keeps_its_motion():
    logs = [
        (f"log {seed}", noisy(driven("steps")[0], seed, drop=("v", "qd", "q"))) for seed in (6, 7)
    ]
    given = FitOptions(start={"bulk_modulus": 5e8, "carriage.damping": 1500.0})
    fit = identify_hydraulics(shipped("slide_servo"), logs, SLIDE, given)
    assert "press.v" in fit.logs[0].fit_percent
    for name, truth in (("bulk_modulus", 9e8), ("carriage.damping", 800.0)):
        assert abs(fit[name].value - truth) < 4.0 * fit[name].std, fit[name]


def test_what_a_log_lacks_is_left_wide():
    """A compared pressure is held loosely, one that is not recorded hardly at all."""
    made = driven("steps")[0]
    model = Model.of(shipped("slide_servo"))
    lacking = noisy(made, 8, drop=("p_rod", "p_supply"))
    start = initial_state_of(model, lacking, ["press"], ["press.v", "press.p_head"])
    std = {number.name: number.std for number in start.uncertain}
    assert set(std) == {"press.p_head", "press.p_rod", "press.q"}
    assert std["press.p_rod"] > 3.0 * std["press.p_head"]


def test_a_tank_is_as_sure_as_the_mean_of_its_sensor():
    """As noisy as the supply's it is as much in number; one typed in, without noise, is not."""
    made, model = driven("steps")[0], Model.of(shipped("slide_servo"))
    seen = noisy(made, 8)
    noise = seen["p_supply"] - made["p_supply"]
    felt = replace(seen, channels=seen.channels | {"p_tank": 2e5 + noise})
    start, known = (initial_state_of(model, one, ["press"], COMPARED) for one in (felt, seen))
    assert "p_tank" not in {number.name for number in known.uncertain}
    std = {number.name: number.std for number in start.uncertain}
    assert std["p_tank"] == pytest.approx(std["p_supply"])
    shifts = np.array([2.0 * (number.name == "p_tank") for number in start.uncertain])
    (stands, _), (moved, _) = start.begin(model, 0.0 * shifts), start.begin(model, shifts)
    assert moved.tank == pytest.approx(stands.tank + 2.0 * std["p_tank"])
    np.testing.assert_array_equal(moved.y, stands.y)
    assert start.numbers(moved)["p_tank"] == moved.tank
    assert start.moved(shifts)["p_tank"] == pytest.approx(2.0 * std["p_tank"])


def test_a_mean_tank_pressure_that_is_off_is_in_the_interval():
    """A preload of the way to the tank answers to the tank's pressure as it does to the preload:
    where the mean of a noisy sensor is off by twice its error, its value is off by less than that.
    """
    one = shipped("slide_servo")
    name = "press.servo_rod_tank.cracking_pressure"
    one = one.with_values({name: 5e5})
    t = np.arange(2001) * 1e-3
    command = 3.0 * ((t > 0.1) & (t < 0.8)) - 3.0 * ((t > 1.0) & (t < 1.7))
    seen = noisy(simulate(one, {"press.servo": command}, 2.0), 3)
    noise = 8e3 * np.random.default_rng(4).standard_normal(t.size)
    off = 2.0 * mean_error(noise, 100) - np.mean(noise[:100])
    record = replace(seen, channels=seen.channels | {"p_tank": seen["p_tank"] + noise + off})
    found = identify_hydraulics(one, [("log", record)], [name], FitOptions(workers=1))
    assert abs(found[name].value - 5e5) < 2.0 * found[name].std
    assert found[name].from_starts > 0.5 and found.logs[0].start_shift["p_tank"] < 0.0


def test_an_encoder_between_two_counts_stands_still():
    """An angle of 2 mrad a count that flickers at rest does not move; one that turns does."""
    t = np.arange(2001) * 1e-3
    flicker = 1.2 + 9e-4 + 4e-4 * np.random.default_rng(3).standard_normal(t.size)
    way = 0.3 * np.clip(t - 0.5, 0.0, 1.0)
    for turning, found in ((0.0, ()), (0.3, ("lift",))):
        angle = np.round((flicker + way + turning * t) / 2e-3) * 2e-3
        record = Record(t, {"lift.q": angle, "lift.spool.command": np.where(t < 0.5, 0.0, 5.0)})
        assert moving_at_first(record, shipped("crane_proportional"), 500) == found


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional", "pump_cylinder"])
def test_models_share_a_start_only_where_it_is_the_same(name, moves):
    """A start that was found for other parameters is that of these, whichever number differs."""
    made, known = Model.of(shipped(name)), shipped(name).parameters()
    table = made.rest_commands(200)
    y = made.trim(made.posture(None), None, table[0])
    record = made.record(np.arange(200) * 1e-3, table, made.run(y, table), {"rig": name})
    live = [one.name for one in shipped(name).cylinder]
    start = replace(initial_state_of(made, record, live, []), moves=moves)
    none, found = np.zeros(len(start.uncertain)), []
    for key, value in known.items():
        varied = Model.of(shipped(name).with_values({key: 1.01 * float(value) or 1e-3}, known))
        (shared, _), (own, _) = start.begin(varied, none), replace(start).begin(varied, none)
        np.testing.assert_array_equal(shared.y, own.y, err_msg=key)
        assert shared[1:] == own[1:]
        found.append(start.unmoved(varied, record))
    oil = list(known).index("bulk_modulus")
    assert found[oil] is start.unmoved(made, record)
    assert len({id(one) for one in found}) < 0.8 * len(found)


@pytest.mark.parametrize("moves", [False, True])
def test_a_start_goes_by_the_first_commands_and_by_all_readings(moves):
    model, t = Model.of(shipped("slide_servo")), np.arange(200) * 1e-3
    still = {"press.x": 0.2, "press.p_head": 5e6, "press.p_rod": 8e6, "p_supply": 1.4e7}
    channels = {name: np.full(t.size, value) for name, value in still.items()}
    record = Record(t, channels | {"press.servo.command": np.linspace(0.0, 1.0, t.size)})
    start = replace(initial_state_of(model, record, ["press"], []), moves=moves)
    first = start.unmoved(model, record)
    for name in record.channels:
        other = replace(record, channels=record.channels | {name: 1.01 * record[name] + 1e-3})
        varied, alone = start.unmoved(model, other), replace(start, record=other)
        np.testing.assert_array_equal(varied.y, alone.unmoved(model, other).y, err_msg=name)
        assert varied[1:] == alone.unmoved(model, other)[1:]
        assert np.any(varied.y != first.y) or varied[1:] != first[1:], name
    later = record["press.servo.command"].copy()
    later[2:] = 5.0
    same = replace(record, channels=record.channels | {"press.servo.command": later})
    assert start.unmoved(model, same) is first


@pytest.mark.parametrize(
    ("zero", "opened", "asked"),
    [
        (0.0, 1.0, False),
        (2.0, 1.0, True),  # 0 … 20 mA taken for 4 … 20 mA
        (-2.0, 1.0, True),
        (0.02, 1.0, False),  # the driver's noise
        (0.0, -1.0, False),  # triggered by its command: on from the first sample, and moving
    ],
)
@pytest.mark.parametrize("drop", [(), ("v", "qd"), ("x", "q")])
def test_a_command_that_is_on_while_its_cylinder_stands_is_asked_for_its_zero(
    zero, opened, asked, drop
):
    made, _ = driven("steps")
    first = 0 if opened > 0.0 else 110
    record = noisy(made, 1, drop=drop).at(slice(first, None))
    command = record["press.servo.command"] + zero
    record = replace(record, channels=record.channels | {"press.servo.command": command})
    notes = preprocess("log", record, Model.of(shipped("slide_servo")))[1]
    fields = [note.fields for note in notes if note.key == "preprocessing.idle_on"]
    shown = {"channel": "press.servo.command", "command": pytest.approx(zero), "cylinder": "press"}
    assert fields == [shown] * asked
    assert all(is_warning(note) == (note.key == "preprocessing.idle_on") for note in notes)


def test_a_single_open_chamber_moves_nothing_and_asks_nothing():
    """Four cartridges: the one that is open at first lets nothing out of the other chamber."""
    rig = shipped("boom_four_valve")
    t = np.arange(1501) * 1e-3
    volts = {v.name: np.zeros(t.size) for v in rig.cylinder[0].valve}
    pair = {
        end: next(v.name for v in rig.cylinder[0].valve for e in v.edge if {e.from_, e.to} == ends)
        for end, ends in {"in": {"supply", "head"}, "out": {"rod", "tank"}}.items()
    }
    for name in pair.values():
        volts[name][(t > 0.5) & (t < 1.0)] = 6.0
    log = simulate(rig, {f"boom.{name}": u for name, u in volts.items()}, 1.5)
    held = [(pair["in"],), tuple(pair.values())]
    for names, count in zip(held, (0, 2), strict=True):
        on = {
            f"boom.{name}.command": log[f"boom.{name}.command"] + 6.0 * (t < 0.5) for name in names
        }
        record = replace(log, channels=log.channels | on)
        notes = preprocess("log", record, Model.of(rig))[1]
        assert sum(note.key == "preprocessing.idle_on" for note in notes) == count
