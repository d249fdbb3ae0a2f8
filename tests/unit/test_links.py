"""Machines out of this process: packets, the states of a target, trials over a link, faults, the
responders. Everything is on loopback or on a virtual clock.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import Fault, TrialRecipe, load_rig
from ehbench.links.client import LinkMachine
from ehbench.links.layout import Layout
from ehbench.links.responder import (
    ALIVE,
    ARMED,
    HEADER,
    IDLE,
    REASONS,
    RUNNING,
    STOPPED,
    STOPPING,
    Target,
)
from ehbench.links.serve import ServedTarget
from ehbench.links.transport import STATE, TOKEN, VirtualLink
from ehbench.trial import prepare, run
from ehbench.vocabulary.errors import InputError

ROOT = Path(__file__).parents[2]
RIG = load_rig(ROOT / "recipes/rigs/slide_servo.toml")
LAYOUT = Layout.of(RIG)
MOTION = {
    "kind": "point_to_point",
    "cylinder": "press",
    "waypoints": ["160 mm", "190 mm"],
    "speed": "100 mm/s",
    "acceleration": "1 m/s^2",
    "jerk": "20 m/s^3",
}
KEYS = {"rate": "250 Hz", "motion": MOTION, "controller": {"kind": "position"}}


def trial(on="bench", **keys):
    given = {**KEYS, "limits": {"stroke_margin": "20 mm"}, **keys}
    recipe = TrialRecipe(
        stage="trial", rig="x", on=on, path=ROOT / "recipes/trials/position.toml", **given
    )
    return prepare(recipe, RIG)


# --- a target by itself


class Rig:
    """Sensors that say what a test wants."""

    ahead, resets = False, 0

    def __init__(self, *values):
        self.values, self.set = list(values), []

    def tick(self, commands):
        self.set.append(list(commands))
        return self.values

    def reset(self):
        self.resets += 1


def target(**keys):
    rig = Rig(1.0, 2.0)
    return rig, Target(rig, [(-10.0, 10.0, 0.0, 1000.0)], {77: (1, list)}, 1000.0, **keys)


def packet(sequence, wish, *values, token=5, layout=77, reason=0):
    return struct.pack(
        f"<{8 + len(values)}d", layout, token, sequence, 0, 0, wish, reason, 0, *values
    )


def armed(**keys):
    """A running target, the number of its next packet and the time."""
    rig, item = target(**keys)
    t = 0.0
    for n in range(1, 600):
        item.receive(packet(n, ALIVE if n < 5 else ARMED, 0.0), t)
        item.tick(t)
        t += 1e-3
    assert item.state == ARMED
    assert item.receive(packet(600, RUNNING, 3.0), t) and item.state == RUNNING
    return rig, item, 601, t


def test_a_target_arms_only_after_half_a_second_without_a_gap():
    _, item = target()
    states = []
    for n in range(1, 520):
        item.receive(packet(n, ARMED if n > 1 else ALIVE, 0.0), 1e-3 * n)
        states.append(item.state)
    assert states[0] == ALIVE and states[400] == ALIVE and states[-1] == ARMED


def test_what_acts_is_clamped_in_value_and_rate_and_ramps_to_rest():
    rig, item, n, t = armed(ramp=0.01)
    for _ in range(30):
        item.receive(packet(n, RUNNING, 30.0), t)
        item.tick(t)
        n, t = n + 1, t + 1e-3
    steps = np.diff(np.ravel(rig.set))
    assert rig.set[-1] == [10.0] and steps.max() == pytest.approx(1.0)  # 1000 V/s
    item.receive(packet(n, STOPPING, reason=1), t)
    first = len(rig.set)
    while item.state != STOPPED:
        item.tick(t)
    ramp = np.ravel(rig.set[first:])
    np.testing.assert_allclose(ramp, np.linspace(9.0, 0.0, 10), atol=1e-9)
    assert REASONS[item.reason] == "done"


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (b"", "malformed"),
        (b"x" * 71, "malformed"),
        (packet(math.nan, RUNNING, 1.0), "malformed"),
        (packet(700, RUNNING, 1.0, 2.0), "oversized"),
        (packet(700, RUNNING), "oversized"),
        (packet(600, RUNNING, 1.0), "replayed"),
        (packet(599, RUNNING, 1.0), "replayed"),
        (packet(700, RUNNING, 1.0, token=6), "foreign"),
        (packet(700, RUNNING, 1.0, layout=78), "foreign"),
    ],
)
def test_a_packet_that_does_not_count_is_counted_and_changes_nothing(bad, why):
    _, item, _, t = armed()
    before = vars(item) | {"rejected": None}
    assert not item.receive(bad, t)
    assert item.rejected == {why: 1} and vars(item) | {"rejected": None} == before


@pytest.mark.parametrize(
    ("last", "reason"),
    [
        (packet(601, RUNNING, math.nan), "not_finite"),
        (packet(601, ALIVE, 1.0), "disagreement"),
        (packet(601, STOPPING, reason=2), "host"),
        (None, "watchdog"),
    ],
)
def test_a_target_stops_by_itself_latched_until_a_new_token(last, reason):
    rig, item, n, t = armed()
    if last is not None:
        item.receive(last, t)
    ticks = 0
    while item.state != STOPPED:
        item.tick(t)
        ticks, t = ticks + 1, t + 1e-3
        assert ticks < 80  # the watchdog's 20 and the ramp's 50
    assert REASONS[item.reason] == reason and rig.set[-1] == [0.0]
    for wish in (ALIVE, ARMED, RUNNING):
        n += 1
        item.receive(packet(n, wish, 5.0), t)
        item.tick(t)
    assert item.state == STOPPED and rig.set[-1] == [0.0]
    assert not item.receive(packet(1, ALIVE, token=0), t)  # of a session that is over
    resets = rig.resets
    assert item.receive(packet(1, ALIVE, token=9), t) and item.state == ALIVE
    assert rig.resets == resets + 1


def test_a_target_stops_at_a_limit_by_itself():
    rig, item, _, t = armed(limits=[(1, 0.0, 3.0)])
    item.tick(t)
    assert item.state == RUNNING
    rig.values[1] = math.nan
    item.tick(t)
    assert item.state == STOPPING and REASONS[item.reason] == "limit"


def test_a_host_that_falls_silent_is_let_go():
    _, item = target()
    item.receive(packet(1, ALIVE), 0.0)
    item.tick(0.9)
    assert item.state == ALIVE
    item.tick(1.1)
    assert item.state == IDLE


# --- trials over a link, on a virtual clock


def over_link(served, mode="stream", on_sample=None, **keys):
    """(result, machine, target) of a trial on a served bench."""
    item = ServedTarget(served, keys.pop("faults", ()))
    link = VirtualLink(item)
    prepared = trial("model", **keys)
    machine = LinkMachine(prepared, LAYOUT, link, mode, "virtual")
    if on_sample is not None:
        take = machine._take
        machine._take = lambda numbers: take(on_sample(numbers.copy(), machine))
    return run(prepared, machine, fast=False), machine, item


@pytest.mark.parametrize("mode", ["stream", "setpoint"])
def test_a_trial_over_a_link_does_what_it_does_in_this_process(mode):
    here = run(trial("model"), fast=False)
    there, machine, item = over_link(trial("model"), mode)
    assert machine.rejected == {} and item.rejected == {}
    assert REASONS[item.reason] == "done" and item.state == STOPPED
    assert here.record.t.size == there.record.t.size
    tolerance = 1e-5 if mode == "stream" else 1e-3  # the oil has settled for half a second more
    for name in ("press.x", "press.servo.command"):
        scale = np.ptp(here.record[name])
        np.testing.assert_allclose(
            there.record[name], here.record[name], atol=tolerance * scale, rtol=0.0
        )


def test_references_at_a_tenth_of_the_targets_rate_do_as_well():
    served = trial("bench", rate="1000 Hz")
    result, _, _ = over_link(served, "setpoint", rate="100 Hz")
    near, _, _ = over_link(served, "stream", rate="1000 Hz")
    assert result.facts.stop is None and result.facts.rate == 100.0
    errors = [r.facts.measures["tracking"]["max_error"] for r in (result, near)]
    assert errors[0] < 1.3 * errors[1]


def nan_sample(numbers, machine):
    if machine.row > 100:
        numbers[len(HEADER) + LAYOUT.channels.index("press.p_head")] = math.nan
    return numbers


def rebooted(numbers, machine):
    if machine.row > 100:
        numbers[STATE] = IDLE
    return numbers


def other_session(numbers, machine):
    if machine.row > 100:
        numbers[TOKEN] += 1
    return numbers


@pytest.mark.parametrize(
    ("change", "limit"),
    [(nan_sample, "finite"), (rebooted, "machine"), (other_session, "sample_age")],
)
def test_a_host_stops_when_samples_or_states_are_wrong(change, limit):
    result, machine, item = over_link(trial(), on_sample=change)
    assert result.facts.stop.limit == limit
    assert 0.4 <= result.facts.stop.t <= 0.45
    assert item.applied == [0.0] and item.state == STOPPED


def test_replayed_and_torn_packets_do_not_count_at_the_host():
    before = []

    def again(numbers, machine):
        before.append(numbers)
        if machine.row in (50, 60):
            return before[-3] if machine.row == 50 else numbers[:-1]
        return numbers

    result, machine, _ = over_link(trial(), on_sample=again)
    assert result.facts.stop is None
    assert machine.rejected == {"replayed": 1, "malformed": 1}
    assert result.record["missed_ticks"].sum() == 2.0


def fault(**keys):
    return Fault.model_validate({"start": "0.3 s", **keys})


@pytest.mark.parametrize(
    ("failing", "limit", "reason"),
    [
        ({"kind": "link_lost"}, "sample_age", "watchdog"),
        ({"kind": "link_delayed", "duration": "40 ms"}, "sample_age", "done"),
        ({"kind": "link_delayed", "duration": "8 ms"}, None, "done"),
        ({"kind": "link_reordered"}, None, "done"),
    ],
)
def test_a_fault_of_the_link_is_one_of_its_packets(failing, limit, reason):
    result, machine, item = over_link(trial(), faults=(fault(**failing),))
    stop = result.facts.stop
    assert (stop and stop.limit) == limit
    if reason != "watchdog":
        assert REASONS[item.reason] == reason
    assert (machine.rejected["replayed"] > 20) == (failing["kind"] == "link_reordered")


@pytest.mark.parametrize(
    ("keys", "key"),
    [
        ({"rate": "500 Hz"}, "links.other_rate"),
        ({"motion": {**MOTION, "waypoints": ["60 mm", "90 mm"]}}, "links.stands"),
    ],
)
def test_a_machine_that_does_not_fit_the_trial_is_refused(keys, key):
    with pytest.raises(InputError) as error:
        over_link(trial(), **keys)
    assert error.value.key == key


def test_a_target_of_another_rig_sends_nothing():
    item = ServedTarget(trial())
    item.modes = {number + 1: mode for number, mode in item.modes.items()}
    machine = LinkMachine(trial("model"), LAYOUT, VirtualLink(item), "stream", "virtual")
    with pytest.raises(InputError) as error:
        machine.start()
    assert error.value.key == "links.silent" and item.rejected["foreign"] > 100
