"""A machine that fails: it stops for the right reason, valves rest, the log can be read."""

import numpy as np
import pytest

from ehbench.config.recipe import Fault, Limits, TrialRecipe, load_recipe
from ehbench.data import read_log
from ehbench.machines.protocol import Stamp
from ehbench.trial.preparation import prepare
from ehbench.trial.running import run
from ehbench.trial.session import Session
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, refused, shipped

SLOW = Limits.model_validate({"command_rate": "1 V/s"})
START = 2.0  # s: the boom moves at full speed


def recipe(on="model", **changes) -> TrialRecipe:
    loaded = load_recipe(ROOT / "recipes/trials/arc_fast_bench.toml")
    assert isinstance(loaded, TrialRecipe)
    bench = loaded.bench if on == "bench" else None
    return loaded.model_copy(update={"on": on, "bench": bench, **changes})


def prepared(*faults, on="model", **changes):
    given = tuple(Fault.model_validate({"start": f"{START} s", **item}) for item in faults)
    rig = shipped("thesis_arm")
    return prepare(recipe(on, fault=given, **changes), rig)


@pytest.mark.parametrize(
    ("fault", "limit", "channel", "within", "true_error"),
    [
        ({"kind": "nan", "target": "boom.p_head"}, "finite", "boom.p_head", 0.002, 1e-3),
        ({"kind": "nan", "target": "boom.x"}, "finite", "boom.x", 0.002, 1e-3),
        ({"kind": "stuck", "target": "boom.x"}, "position_mismatch", "boom.x", 0.15, 5e-3),
        ({"kind": "zero", "target": "boom.p_head"}, "following_error", "boom.x", 1.5, 50e-3),
        ({"kind": "supply_lost"}, "following_error", "boom.x", 1.0, 50e-3),
        ({"kind": "link_lost"}, "sample_age", "", 0.025, 1e-3),
        ({"kind": "link_delayed", "duration": "30 ms"}, "sample_age", "", 0.025, 1e-3),
        ({"kind": "link_delayed", "duration": "5 ms"}, None, "", 0.0, 2e-3),
        ({"kind": "link_reordered"}, None, "", 0.0, 2e-3),
        ({"kind": "slow", "target": "boom.rect", "duration": "20 ms"}, None, "", 0.0, 2e-3),
    ],
)
@pytest.mark.parametrize("on", ["model", "bench"])
def test_a_fault_stops_the_trial_for_its_reason(
    tmp_path, on, fault, limit, channel, within, true_error
):
    log = tmp_path / "log.mcap"
    result = run(prepared(fault, on=on), log=log)
    stop = result.facts.stop
    assert (stop and stop.limit) == limit
    assert result.facts.measures["tracking_true"]["max_error"] < true_error
    frame = read_log(log)
    if stop is None:
        return
    assert stop.channel == channel
    assert 0.0 <= stop.t - START <= within
    commands = np.column_stack([frame[n] for n in frame.columns if n.endswith(".command")])
    assert np.isfinite(commands).all()
    np.testing.assert_array_equal(commands[-1], 0.0)


def test_the_true_strokes_are_those_without_the_noise_of_the_sensors(tmp_path):
    late = {"kind": "offset", "target": "boom.x", "value": "1 mm", "start": "1000 s"}
    errors = []
    for faults in ([], [late]):
        result = run(prepared(*faults, on="bench"), log=tmp_path / f"{len(faults)}.mcap")
        errors.append(result.facts.measures["tracking_true"]["max_error"])
    assert errors[0] == errors[1]


class Probe:
    """A machine that keeps what it was sent, and gives what a test makes of its samples."""

    def __init__(self, machine, sense):
        self.machine, self.sense, self.sent, self.closed = machine, sense, [], False
        self.name, self.channels, self.commands = "rig", machine.channels, machine.commands
        self.strokes, self.rate, self.latency = machine.strokes, machine.rate, machine.latency

    def check_posture(self, posture):
        self.machine.check_posture(posture)

    def start(self, posture=None, low_side=None):
        return self.machine.start(posture, low_side)

    def tick(self, command):
        self.sent.append(command.copy())
        return self.sense(len(self.sent), self.machine.tick(np.nan_to_num(command)), self)

    def close(self):
        self.closed = True


def test_no_command_that_is_not_finite_reaches_a_machine():
    trial = prepared()

    def sense(tick, sample, probe):
        sample[4 if tick >= 1237 else slice(0, 0)] = np.nan
        return sample

    probe = Probe(trial.machine, sense)
    result = run(trial, probe)
    assert result.facts.stop is not None and result.facts.stop.limit == "finite"
    assert np.isfinite(probe.sent).all()
    np.testing.assert_array_equal(probe.sent[-1], trial.machine.commands.rest)


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_whatever_ends_a_trial_valves_go_to_rest_by_the_ramp(error):
    trial = prepared()

    def sense(tick, sample, probe):
        if tick == 2000:
            raise error
        return sample

    probe = Probe(trial.machine, sense)
    with pytest.raises(type(error)):
        run(trial, probe)
    ramp = np.array(probe.sent[2000:])
    assert len(ramp) == 51 and probe.closed  # 50 ms at 1 kHz
    sizes = np.abs(ramp).max(axis=1)
    assert sizes[0] > 0.0 and (np.diff(sizes) <= 0.0).all() and sizes[-1] == 0.0


def test_a_command_rate_stops_a_trial():
    stop = run(prepared(limits=SLOW)).facts.stop
    assert stop is not None and stop.limit == "command_rate" and stop.channel.endswith(".command")


@pytest.mark.parametrize(
    ("fault", "key"),
    [
        ({"kind": "stuck", "target": "boom.nothing"}, "machines.fault_target"),
        ({"kind": "slow", "target": "boom.x"}, "machines.fault_target"),
        ({"kind": "offset", "target": "boom.x"}, "machines.fault_value"),
    ],
)
def test_a_fault_that_does_not_fit_is_refused(fault, key):
    with refused(key, InputError):
        prepared(fault)


def test_both_paths_of_a_session_stop_at_the_same_row():
    trial = prepared(limits=SLOW)
    rows = []
    for fast in (True, False):
        session = Session(trial, trial.machine, fast)
        session.run()
        rows.append((session.end, session.stop))
    assert rows[0] == rows[1]


@pytest.mark.parametrize(
    ("fault", "stops"),
    [
        ({"kind": "zero", "target": "press.v", "start": "1.53 s"}, True),
        ({"kind": "scale", "target": "press.v", "start": "0 s", "value": "0.9"}, False),
        ({"kind": "offset", "target": "press.v", "start": "0 s", "value": "10 mm/s"}, False),
    ],
)
def test_a_slide_whose_stroke_contradicts_its_motion_stops(tmp_path, fault, stops):
    bench = ROOT / "recipes/bench/slide_servo.toml"
    (tmp_path / "trial.toml").write_text(
        f"""stage = "trial"
rig = "{ROOT / "recipes/rigs/slide_servo.toml"}"
on = "bench"
bench = "{bench}"
[motion]
kind = "point_to_point"
cylinder = "press"
waypoints = ["100 mm", "260 mm"]
speed = "150 mm/s"
[controller]
kind = "position"
"""
    )
    loaded = load_recipe(tmp_path / "trial.toml")
    assert isinstance(loaded, TrialRecipe)
    trial = prepare(
        loaded.model_copy(update={"fault": (Fault.model_validate(fault),)}), shipped("slide_servo")
    )
    result = run(trial)
    stop = result.facts.stop
    assert (stop is not None) == stops
    if stop is not None:
        assert (stop.limit, stop.channel) == ("position_mismatch", "press.x")
        # 5 % of the stroke at the motion's speed, forgotten over 1 s, and a tenth on top
        assert stop.t - 1.53 < 1.1 * -np.log(1.0 - 20.0 / 150.0)
    assert result.facts.measures["tracking_true"]["max_error"] < 10e-3


def test_a_sensor_that_is_dead_from_the_start_is_refused():
    with refused("trial.start_limit", InputError):
        run(prepared({"kind": "nan", "target": "boom.p_head", "start": "0 s"}))


@pytest.mark.parametrize(("channel", "needed"), [("swing.p_head", False), ("boom.p_head", True)])
def test_a_channel_without_sensor_is_in_no_log_and_refused_where_a_law_needs_it(channel, needed):
    trial = prepared()

    def sense(tick, sample, probe):
        sample[probe.channels.index(channel)] = np.nan
        return sample

    probe = Probe(trial.machine, sense)
    probe.unmeasured = (channel,)
    if needed:
        with refused("trial.blind_law", InputError):
            run(trial, probe)
        assert not probe.sent
    else:
        result = run(trial, probe)
        assert result.facts.stop is None and channel not in result.record.channels


def test_a_controller_that_takes_too_long_stops_a_machine_in_real_time(monkeypatch):
    trial = prepared()
    probe = Probe(trial.machine, lambda tick, sample, probe: sample)
    probe.real_time, probe.stamp = True, Stamp(0.0, 0, 0.0)
    clock = iter(np.arange(0.0, 1e6, 0.03))  # each look at the clock is 30 ms later
    monkeypatch.setattr("ehbench.trial.session.time.monotonic", lambda: float(next(clock)))
    stop = run(trial, probe).facts.stop
    assert stop is not None and stop.limit == "overrun" and stop.value == pytest.approx(0.03)


@pytest.mark.parametrize("fault", [{"kind": "nan", "target": "boom.x"}, {"kind": "link_lost"}])
def test_a_standstill_that_no_sensor_shows_is_not_claimed(fault):
    after = run(prepared(fault)).facts.after
    assert after is not None and after.still is None
