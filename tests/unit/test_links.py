"""Packets, the states of a target, trials over a link, faults, on loopback or a virtual clock."""

import io
import math
import struct
import sys
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from ehbench.app import cli
from ehbench.config.recipe import Fault, TrialRecipe
from ehbench.data import read
from ehbench.data.record import Record
from ehbench.identification.hydraulics import identify_hydraulics
from ehbench.links.arming import (
    causes_of_stop,
    estimated,
    exchanges_in,
    run_remote,
    stopping_distances,
    token_of,
)
from ehbench.links.buffered import BufferedLink
from ehbench.links.client import LINK, LinkMachine
from ehbench.links.layout import Layout, csv_text
from ehbench.links.opening import Address, open_machine
from ehbench.links.quality import Quality, measure
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
from ehbench.links.transport import SEQUENCE, STATE, TIME
from ehbench.trial import prepare, run, running
from ehbench.vocabulary.errors import InputError
from tests.settings import at
from tests.shared import ROOT, judged, refused, shipped
from tools.studies import link_study
from tools.studies.link_study import VirtualLink

RIG = shipped("slide_servo")
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


def test_a_slides_joint_coordinate_is_a_stroke_in_the_table_of_packets():
    rows = csv_text(LAYOUT, 250.0).splitlines()
    about = {row.split(",")[2]: row.split(",")[3:] for row in rows if row.startswith("up,")}
    assert about["press.q"] == about["press.x"] and about["press.qd"] == about["press.v"]
    crane = csv_text(Layout.of(shipped("crane_proportional")), 250.0)
    assert "lift.q,rad," in crane and "lift.qd,rad/s," in crane


def trial(on="bench", rig=RIG, **keys):
    given = {**KEYS, "limits": {"stroke_margin": "20 mm"}, **keys}
    recipe = TrialRecipe(
        stage="trial", rig="x", on=on, path=ROOT / "recipes/trials/position.toml", **given
    )
    return prepare(recipe, rig)


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


def over_link(served, mode="stream", on_sample=None, kind=LinkMachine, **keys):
    """(result, machine, target) of a trial on a served bench."""
    item = ServedTarget(served, keys.pop("faults", ()))
    link = VirtualLink(item)
    prepared = trial("model", **keys)
    machine = kind(prepared, LAYOUT, link, mode, "virtual")
    if on_sample is not None:
        take = machine._take
        machine._take = lambda numbers: take(on_sample(numbers.copy(), machine))
    return run(prepared, machine, fast=False), machine, item


@pytest.mark.parametrize("mode", ["stream", "setpoint"])
def test_a_trial_over_a_link_does_what_it_does_in_this_process(mode):
    here = run(trial("model"), fast=False)
    there, machine, item = over_link(trial("model"), mode)
    assert machine.rejected == {} and item.rejected == {} and machine.unheeded == 0
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


UP = (*HEADER, *LAYOUT.up)


@pytest.mark.parametrize(
    ("wrong", "limit"),
    [
        ({"press.p_head": math.nan}, "finite"),
        ({"press.x": math.inf}, "finite"),
        ({"press.p_head": 1e300}, "pressure_range"),
        ({"state": IDLE}, "machine"),
        ({"state": STOPPED + 4}, "machine"),
        ({"state": STOPPING, "reason": 99.0}, "machine"),
        ({"time": 1e6}, "machine"),
        ({"time": -3.0}, "machine"),
        ({"sequence": 1e300}, "machine"),
        ({"sequence": 1.0}, "sample_age"),
        ({"token": 0.0}, "sample_age"),
        ({"press.servo.command": math.nan}, None),
    ],
)
def test_a_host_stops_when_samples_or_states_are_wrong(wrong, limit):
    def change(numbers, machine):
        if machine.row > 100:
            numbers[[UP.index(name) for name in wrong]] = list(wrong.values())
        return numbers

    result, machine, item = over_link(trial(), on_sample=change)
    assert item.applied == [0.0] and item.state == STOPPED
    assert (np.diff(result.record.t) < 0.1).all()
    if limit is None:
        assert result.facts.stop is None
    else:
        assert result.facts.stop.limit == limit and 0.4 <= result.facts.stop.t <= 0.45


@pytest.mark.parametrize("samples", [0.0, 5.0])
def test_a_jump_of_the_targets_clock_is_no_reason_of_the_target(samples):
    """Alone, and with its count: rows between them would be the host's invention."""

    def jump(numbers, machine):
        numbers[TIME] += 5.0 * (machine.row > 100)
        numbers[SEQUENCE] += machine.rate * samples * (machine.row > 100)
        return numbers

    result, machine, item = over_link(trial(), on_sample=jump)
    assert machine.reasons[int(result.facts.stop.value)] == "clock"
    assert "clock" in result.facts.stopped and REASONS[item.reason] != "clock"
    assert 0.4 <= result.facts.stop.t <= 0.45


@pytest.mark.parametrize("looped", [True, False])
def test_a_target_that_counts_and_measures_nothing_is_stopped(looped):
    """No limit sees a machine that moves while all its sensors stay as they are."""
    frozen, places = [], slice(len(HEADER), len(HEADER) + len(LAYOUT.channels))

    def freeze(numbers, machine):
        if machine.row > 75:
            frozen.append(numbers[places].copy())
            numbers[places] = frozen[0]
        return numbers

    keys = {} if looped else OPEN | {"command": (STEP | {"amplitude": "3 V"},)}
    result, machine, item = over_link(trial(**keys), on_sample=freeze, **keys)
    assert machine.reasons[int(result.facts.stop.value)] == "frozen"
    assert result.facts.after.still is None  # no sensor says
    begins = 0.5 if looped else 0.3  # it moves, and its samples do not change
    assert 0.1 <= result.facts.stop.t - begins < 0.3 and item.state == STOPPED
    _, _, item = over_link(trial("model", **keys), **keys)  # without noise it stands to the bit
    assert REASONS[item.reason] == "done"


@pytest.mark.parametrize(
    ("change", "least"),
    [
        (lambda volts: 0.0, 0.6),  # the echo is not wired
        (lambda volts: -volts, 0.3),
        (lambda volts: 1e3 * volts, 0.6e-3),  # millivolts
        (lambda volts: volts * (1.0 + 1e-3), math.inf),  # rounded on the way
    ],
)
def test_ticks_in_which_another_command_acted_are_counted(change, least):
    """``least`` [V] is the command that is 3 % of 20 V away from what the target says of it."""
    sent = run(trial("model"), fast=False).record["press.servo.command"]

    def echo(numbers, machine):
        numbers[-1] = change(numbers[-1])
        return numbers

    _, machine, _ = over_link(trial("model"), on_sample=echo)
    # where it changes quickly, one of three packets may be nearer
    assert machine.unheeded == pytest.approx((np.abs(sent) > least).sum(), abs=10)


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
        ({"kind": "link_delayed", "duration": "100 ms"}, "sample_age", "watchdog"),
        ({"kind": "link_delayed", "duration": "40 ms"}, "sample_age", "done"),
        ({"kind": "link_delayed", "duration": "20 ms"}, None, "done"),
        ({"kind": "link_delayed", "duration": "5 ms"}, None, "done"),
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
    with refused(key, InputError):
        over_link(trial(), **keys)


def test_a_machine_without_its_supply_is_refused():
    """As of a pump that is off, or of numbers in bar."""

    def in_bar(numbers, machine):
        numbers[UP.index("p_supply")] *= 1e-5
        return numbers

    with refused("links.supply", InputError):
        over_link(trial(), on_sample=in_bar)


def test_samples_of_another_size_are_not_taken_for_another_layout():
    item = ServedTarget(trial())
    link = VirtualLink(item)
    receive, machine = link.receive, LinkMachine(trial("model"), LAYOUT, link, "stream", "virtual")
    link.receive = lambda timeout: [numbers[:-1] for numbers in receive(timeout)]
    with refused("links.silent", InputError) as error:
        machine.start()
    assert machine.rejected["malformed"] > 100 and "malformed" in str(error.value)


def test_a_measurement_counts_what_does_not_count():
    """Vectors of a target that sends float32, or too few numbers."""
    single = np.ones(24, "<f4").tobytes()
    link = SimpleNamespace(virtual=True, send=lambda _: None, close=lambda: None)
    link.receive = lambda timeout: [np.frombuffer(single, "<f8"), np.empty(0)]
    with at(LINK, "patience", 0.2), refused("links.silent", InputError) as error:
        measure(link, "udp://here:1", 0.1)
    for why in ("foreign", "malformed"):
        assert why in str(error.value)


def test_a_target_of_another_rig_is_named_by_its_layout():
    item = ServedTarget(trial())
    item.modes = {number + 1: mode for number, mode in item.modes.items()}
    item.layout += 1
    machine = LinkMachine(trial("model"), LAYOUT, VirtualLink(item), "stream", "virtual")
    with pytest.raises(InputError) as error:
        machine.start()
    assert error.value.key == "links.other_layout" and item.rejected["foreign"] > 100
    for number in (LAYOUT.number("stream"), LAYOUT.number("stream") + 1):
        assert str(number) in str(error.value)


# --- a table that the target plays

STEP = {
    "valve": "press.servo",
    "kind": "step",
    "amplitude": "2 V",
    "start": "0.2 s",
    "stop": "0.6 s",
}
OPEN = {"motion": None, "controller": None, "duration": "1 s", "command": (STEP,)}


def buffered(served, lose=0.0, answers=lambda numbers: True, **keys):
    """(result, target) of a table over a link that loses a share, and answers that are not so."""
    item = ServedTarget(served, watchdog=0.1)
    link, dice = VirtualLink(item), np.random.default_rng(1)
    send, receive = link.send, link.receive
    link.send = lambda numbers: None if dice.random() < lose else send(numbers)
    link.receive = lambda timeout: [n for n in map(np.copy, receive(timeout)) if answers(n)]
    prepared = trial("model", **OPEN, **keys)
    machine = BufferedLink(prepared, LAYOUT, link, "buffered", "virtual")
    result = run(prepared, machine)
    assert np.abs(estimated(machine.exchanges)["sample_delay"]).max() < 0.1
    return result, item


def test_a_missing_sensor_and_rows_that_do_not_come_are_not_made_up():
    times = []

    def answers(numbers):
        numbers[UP.index("press.qd")] = math.nan
        times.extend([numbers[TIME]] if numbers[STATE] == RUNNING else [])
        return numbers[STATE] != RUNNING or numbers[TIME] < times[0] + 0.3

    result, _ = buffered(trial(**OPEN), answers=answers)
    assert result.facts.stop.limit == "machine" and result.facts.stop.t == pytest.approx(
        0.3, abs=0.01
    )


@pytest.mark.parametrize("lose", [0.0, 0.1])
def test_a_table_is_uploaded_played_and_its_log_downloaded(lose):
    here = run(trial(**OPEN))
    result, item = buffered(trial(**OPEN), lose)
    assert result.facts.stop is None and item.state == STOPPED
    np.testing.assert_array_equal(
        result.record["press.servo.command"], here.record["press.servo.command"]
    )
    apart = result.record["press.x"] - here.record["press.x"]
    assert np.abs(apart).max() < 2e-4 and np.ptp(here.record["press.x"]) > 5e-3


def test_a_table_that_the_target_stops_ends_in_the_log_where_it_was_stopped():
    served = trial(**OPEN, limits={"stroke_margin": "20 mm", "pressure_max": "4 MPa"})
    result, item = buffered(served)
    assert result.facts.stop.limit == "machine" and REASONS[item.reason] == "limit"
    assert 0.2 < result.facts.stop.t < 0.4 and result.facts.after.still is None
    assert result.record.t[-1] < result.facts.stop.t  # what came of it, no log says


def test_a_target_clamps_what_it_plays():
    """The host's limits see the log alone: volts and steps beyond the driver's are the target's."""
    prepared, item = trial("model", **OPEN), ServedTarget(trial(**OPEN), watchdog=0.1)
    machine = BufferedLink(prepared, LAYOUT, VirtualLink(item), "buffered", "virtual")
    machine.start()
    (low, high, _, change) = LAYOUT.clamps()[0]
    played = machine.play(np.where(np.arange(40)[:, None] < 20, 3.0 * high, 3.0 * low))
    applied = played.applied[:, 0]
    assert applied.max() == high and applied.min() == low
    assert np.abs(np.diff(applied)).max() <= change / machine.rate + 1e-9


def test_a_closed_loop_cannot_be_played():
    with refused("links.buffered_loop", InputError):
        over_link(trial(), "buffered", kind=BufferedLink)


CARD = """
[inputs."press.x"]
terminal = "{0}0"
scale = 0.1
offset = 0.16
[inputs."press.p_head"]
terminal = "{0}3"
scale = 1e6
[outputs."press.servo"]
"""


def played(tmp_path, url, inputs, output):
    """The record of a table that a card has played, and its commands."""
    (tmp_path / "card.toml").write_text(CARD.format(inputs) + output)
    prepared = trial("model", **OPEN)
    result = run(prepared, open_machine(prepared, f"{url}?map={tmp_path / 'card.toml'}"))
    command = result.record["press.servo.command"]
    assert result.facts.stop is None and command.max() == 2.0
    return result.record, command


def test_a_card_plays_a_table(tmp_path, monkeypatch):
    """Against a substitute: what is asked of nidaqmx, in which order."""
    did = []

    class Task:
        def __init__(self):
            self.channels = []
            self.ao_channels = self.ai_channels = self.timing = self

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def add_ao_voltage_chan(self, name):
            self.channels.append(name)

        add_ai_voltage_chan = add_ao_voltage_chan

        def cfg_samp_clk_timing(self, rate, source="", samps_per_chan=1):
            did.append((tuple(self.channels), rate, source, samps_per_chan))

        def write(self, volts, auto_start=True):
            did.append(("write", volts))

        def start(self):
            did.append(("start", tuple(self.channels)))

        def read(self, count, timeout):
            (volts,) = [item[1] for item in did[-3:] if item[0] == "write"]
            return [[0.5 * v for v in volts], [0.1 * v for v in volts]]

    monkeypatch.setitem(sys.modules, "nidaqmx", SimpleNamespace(Task=Task))
    record, command = played(tmp_path, "nidaq://Dev1", "ai", 'terminal = "ao0"\nscale = 0.5')
    np.testing.assert_allclose(record["press.x"][1:], 0.16 + 0.025 * command[1:])
    np.testing.assert_allclose(record["press.p_head"][1:], 5e4 * command[1:])
    assert "press.p_rod" not in record and did[-1] == ("write", 0.0)
    rows = record.t.size + 1
    assert (("Dev1/ai0", "Dev1/ai3"), 250.0, "/Dev1/ao/SampleClock", rows) in did


def test_a_labjack_streams_a_table(tmp_path, monkeypatch):
    """Against a substitute of ljm: outputs as streams, inputs read at the same scans."""
    out, did, scanned = {}, [], []

    def begin(handle, rows, count, scans, rate):
        scanned.extend(scans)
        did.append((rows, count, rate))

    def volts(handle):
        inputs = [0.5 * np.array(out[1000]), 0.1 * np.array(out[1000])]
        return np.column_stack([*inputs, out[1000]]).ravel().tolist(), 0, 0

    ljm = SimpleNamespace(
        openS=lambda *where: did.append(where) or 7,
        nameToAddress=lambda name: ({"DAC0": 1000}[name], 3),
        namesToAddresses=lambda count, names: (names, [3] * count),
        periodicStreamOut=lambda h, n, target, rate, count, column: out.update({target: column}),
        eStreamStart=begin,
        eStreamRead=volts,
        eStreamStop=lambda handle: did.append("stop"),
        eWriteName=lambda handle, name, value: did.append((name, value)),
        close=lambda handle: did.append("close"),
    )
    monkeypatch.setitem(sys.modules, "labjack", SimpleNamespace(ljm=ljm))
    monkeypatch.setitem(sys.modules, "labjack.ljm", ljm)
    output = 'terminal = "DAC0"\nscale = 0.25\noffset = 2.5'
    record, command = played(tmp_path, "labjack://ANY", "AIN", output)
    np.testing.assert_allclose(record["press.x"][1:], 0.16 + 0.05 * (0.25 * command[1:] + 2.5))
    assert did[0] == ("ANY", "ANY", "ANY") and did[-3:] == ["stop", ("DAC0", 2.5), "close"]
    assert (record.t.size + 1, 3, 250.0) in did
    assert scanned[-3:] == ["AIN0", "AIN3", "STREAM_OUT0"]


# --- before anything moves


def remote(monkeypatch, ask, **keys):
    item = ServedTarget(trial())
    monkeypatch.setattr(Address, "link", lambda self, layout=None: VirtualLink(item))
    return run_remote(trial("model", **keys), "udp://here:1?clock=virtual", ask), item


def test_a_trial_runs_with_the_token_of_rig_recipe_and_link(monkeypatch):
    asked = []
    (result, link, dry, warnings), item = remote(
        monkeypatch, lambda about, token: asked.append(token) or token.lower()
    )
    assert result.facts.stop is None and item.reason == REASONS.index("done") and not warnings
    assert asked == [token_of(trial("model"), "udp://here:1?clock=virtual")]
    assert asked[0] != token_of(trial("model"), "udp://there:1?clock=virtual")
    assert link["late"] == 0 and set(link) >= {"rejected", "clock_offset", "command_delay"}
    assert 0.0 < dry["stopping_distance"]["press"] < 0.02
    assert dry["differences"]["press.x"]["largest"] < 5e-3


def test_nobody_to_ask_types_no_token(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert cli._typed("it moves", "1A2B3C") == "" and "1A2B3C" in capsys.readouterr().err


def test_what_comes_after_a_stop_makes_no_tick_late(monkeypatch):
    item = ServedTarget(trial(), (fault(kind="link_lost"),))
    monkeypatch.setattr(Address, "link", lambda self, layout=None: VirtualLink(item))
    ask = lambda about, token: token  # noqa: E731
    result, link, _, _ = run_remote(trial("model"), "udp://here:1?clock=virtual", ask)
    stop = result.facts.stop
    assert stop.limit == "sample_age" and result.record.t[-1] > stop.t + 1.0
    # the limit is 20 ms: five samples of 4 ms, and that at which it was met
    assert link["late"] <= 6 and link["ticks"] == pytest.approx(250.0 * stop.t, abs=2.0)


@pytest.mark.parametrize("stands", [0.151, 0.17])
def test_a_trial_begins_where_its_machine_stands(monkeypatch, stands):
    """Off its first waypoint by less than is refused: no step of the desired stroke, nor of the
    dry run's."""
    item = ServedTarget(trial(posture={"press": f"{stands} m"}))
    monkeypatch.setattr(Address, "link", lambda self, layout=None: VirtualLink(item))
    remote = run_remote(trial("model"), "udp://here:1?clock=virtual", lambda about, token: token)
    record, dry = remote.result.record, remote.dry_run
    x, desired = record["press.x"], record["press.x_desired"]
    assert x[0] == pytest.approx(stands, abs=5e-4) and desired[0] == pytest.approx(x[0], abs=5e-4)
    speed = np.abs(np.diff(desired)) / record.sample_time
    assert speed.max() < 0.1 + 1e-9  # that of the motion
    assert np.abs(x - desired).max() < 6e-3 < abs(stands - 0.16)
    assert dry["differences"]["press.x"]["largest"] < 5e-3
    assert "trial.off_start" in [note.key for note in remote.result.facts.warnings]


def test_a_fault_of_a_link_waits_for_valves_that_move(monkeypatch):
    """A session that ends before does not begin its time: the target was gone for ever."""
    item = ServedTarget(trial(), (fault(kind="link_lost", start="0.4 s"),))
    monkeypatch.setattr(Address, "link", lambda self, layout=None: VirtualLink(item))
    url = "udp://here:1?clock=virtual"
    with refused("links.unarmed"):
        run_remote(trial("model"), url, None)
    for n in range(500):
        item.tick(n / 250.0)
    remote = run_remote(trial("model"), url, lambda about, token: token)
    assert remote.result.facts.stop.limit == "sample_age"
    assert remote.result.facts.stop.t == pytest.approx(0.42, abs=0.02)


def test_a_stop_of_a_machine_that_goes_the_other_way_names_the_command(monkeypatch):
    """And one that does not go at all is not said to be too slow, nor turned."""
    near = {"limits": {"stroke_margin": "20 mm", "following_error": "10 mm"}}
    ask = lambda about, token: token  # noqa: E731
    for sign, key in ((-1.0, "links.likely"), (0.0, "trial.unmoved")):
        item = ServedTarget(trial())
        machine, tick = item.served.machine, item.served.machine.tick
        monkeypatch.setattr(machine, "tick", lambda volts, tick=tick, k=sign: tick(k * volts))
        monkeypatch.setattr(Address, "link", lambda self, layout=None, at=item: VirtualLink(at))
        url = "udp://here:1?clock=virtual"
        result, _, _, warnings = run_remote(trial("model", **near), url, ask)
        assert result.facts.stop.limit == "following_error"
        told = [*result.facts.warnings, *warnings]
        assert [note.key for note in told] == [key]
        if sign:
            assert "command" in told[0].fields["cause"]
            assert "press.servo" in told[0].fields["cause"]


def test_a_stroke_that_stays_while_the_speed_goes_on_is_no_standstill():
    """Where both stay it is."""
    limits = {"limits": {"stroke_margin": "20 mm", "following_error": "10 mm"}}
    q, x, v = (UP.index(f"press.{word}") for word in ("q", "x", "v"))

    def stuck(numbers, _, both=False):
        numbers[[q, x]], numbers[v] = 0.16, 0.0 if both else numbers[v]
        return numbers

    cases = (
        (stuck, "position_mismatch", []),
        (partial(stuck, both=True), "following_error", ["trial.unmoved"]),
    )
    for change, limit, keys in cases:
        result, _, _ = over_link(trial("bench"), on_sample=change, **limits)
        assert (result.facts.stop.limit, result.facts.stop.channel) == (limit, "press.x")
        assert [note.key for note in result.facts.warnings] == keys


def test_a_stop_of_a_machine_with_exchanged_sensors_names_them():
    ends = [UP.index(f"press.p_{side}") for side in ("head", "rod")]

    def exchanged(numbers, machine):
        numbers[ends] = numbers[ends[::-1]]
        return numbers

    limits = {"limits": {"stroke_margin": "20 mm", "speed_max": "95 mm/s"}}
    prepared = trial("model", **limits)
    for change, count in ((exchanged, 1), (None, 0)):
        result, _, _ = over_link(trial("bench"), on_sample=change, **limits)
        assert result.facts.stop.limit == "speed_max"
        causes = causes_of_stop(prepared, result)
        assert len(causes) == count
        for cause in causes:
            assert all(f"press.p_{side}" in cause.fields["cause"] for side in ("head", "rod"))


def test_a_person_hears_of_a_stroke_that_no_sensor_gives(monkeypatch):
    item, asked = ServedTarget(trial()), []
    link, place = VirtualLink(item), UP.index("press.x")
    receive = link.receive

    def blind(timeout):
        vectors = [numbers.copy() for numbers in receive(timeout)]
        for numbers in vectors:
            numbers[place] = math.nan
        return vectors

    link.receive = blind
    monkeypatch.setattr(Address, "link", lambda self, layout=None: link)
    with pytest.raises(InputError) as error:
        run_remote(
            trial("model", controller={"kind": "open_loop"}),
            "udp://here:1?clock=virtual",
            lambda about, token: asked.append(about) or "no",
        )
    assert error.value.key == "links.wrong_token" and "press.x" in asked[0]


@pytest.mark.parametrize(
    ("ask", "keys", "key"),
    [
        (None, {}, "links.unarmed"),
        (lambda about, token: "000000", {}, "links.wrong_token"),
        (None, {"fault": (Fault.model_validate({"kind": "link_lost"}),)}, "links.simulated"),
        (None, {"motion": {**MOTION, "waypoints": ["90 mm", "120 mm"]}}, "links.stands"),
        (None, {"limits": {}}, "links.no_margin"),
        (None, {"limits": {"stroke_margin": "1 mm"}}, "links.stopping"),
        (None, {"limits": {"stroke_margin": "20 mm", "speed_max": "50 mm/s"}}, "links.dry_run"),
    ],
)
def test_nothing_moves_before_dry_run_margin_and_token(monkeypatch, ask, keys, key):
    closed = []
    monkeypatch.setattr(VirtualLink, "close", lambda self: closed.append(self))
    with refused(key, InputError):
        remote(monkeypatch, ask, **keys)
    # nothing is opened before the recipe is sound
    assert bool(closed) != (key == "links.simulated")


def test_the_stopping_distance_grows_with_the_watchdog():
    prepared = trial("model")
    record = run(prepared).record
    near, far = (stopping_distances(prepared, record, w)["press"] for w in (0.0, 0.1))
    speed = np.abs(record["press.v"]).max()
    assert far - near == pytest.approx(0.1 * speed, rel=0.05)


@pytest.mark.parametrize(("rate", "expected"), [(1000.0, 0.02), (100.0, 0.04), (50.0, 0.08)])
def test_a_slow_target_waits_long_enough_for_a_sound_link(rate, expected):
    """20 ms, or four samples: half of it is the longest gap that a trial is armed with."""
    target = ServedTarget(trial("model", rate=f"{rate} Hz"))
    assert target.watchdog == pytest.approx(expected)
    quality = Quality("x", 1000, 0, 0, (0.0, 0.0, 0.0), 1.9 / rate, target.watchdog, rate)
    assert not quality.problems()


def test_clocks_and_delays_are_estimated_with_intervals_that_hold_the_truth():
    """Exchanges drawn by hand: an offset, a drift, a delay each way."""
    draw = np.random.default_rng(3)
    t = 1e-2 * np.arange(4000.0)  # the target's
    offset, drift = 1234.5, 3e-5
    host = offset + (1.0 + drift) * t
    came = host + 2e-4 + draw.exponential(1e-4, t.size)
    sent = came - 1e-5 - 9e-3  # number k leaves before sample k comes and acts after 3 ms
    acts = sent + 3e-3 + draw.exponential(1e-4, t.size)
    acknowledged = np.searchsorted(acts, host)
    rows = np.column_stack([1.0 + np.arange(t.size), sent, came, t, acknowledged])
    known = estimated(rows.tolist())
    waits = host[np.minimum(np.searchsorted(acknowledged, rows[:, 0]), t.size - 1)] - sent
    for name, truth in {
        "clock_offset": offset,
        "clock_drift": drift,
        "sample_delay": np.median(came - host),
        "command_delay": np.median(waits),
    }.items():
        value, low, high = known[name]
        assert low <= truth <= high and low <= value <= high, name
    assert known["clock_offset"][2] - known["clock_offset"][1] < 2e-2


# --- many trials with faults


def test_no_fault_takes_the_machine_farther_than_its_margin(tmp_path):
    """50 of the study's faults: within the margin, valve at rest, log read, the stop fits."""
    base, reasons = link_study.trial("model"), {}
    for seed in range(50):
        item = link_study.outcome(base, link_study.drawn(seed), seed, tmp_path / "log.mcap")
        assert item.safe and item.right, item
        reasons.setdefault(item.fault.kind, set()).add(item.limit)
    assert reasons["nan"] == {"finite"} and reasons["link_lost"] == {"sample_age"}
    assert reasons["link_reordered"] == {""} and len(reasons) == len(link_study.KINDS)


def test_a_log_over_a_link_identifies_as_any_other(tmp_path):
    steps = tuple(
        {**STEP, "amplitude": f"{volts} V", "start": f"{t} s", "stop": f"{t + 0.3} s"}
        for volts, t in ((3, 0.2), (-3, 0.7), (5, 1.2), (-5, 1.7))
    )
    keys = {**OPEN, "command": steps, "duration": "2.2 s", "rate": "500 Hz"}
    bulk = 0.8 * float(RIG.parameters()["bulk_modulus"])
    served = trial("model", rig=RIG.with_values({"bulk_modulus": bulk}), **keys)
    prepared, link = trial("model", **keys), VirtualLink(ServedTarget(served))
    machine, log = LinkMachine(prepared, LAYOUT, link, "stream", "virtual"), tmp_path / "log.mcap"
    run(prepared, machine, log=log, fast=False)
    fit = identify_hydraulics(RIG, [("steps", read(log))], ["bulk_modulus"])
    assert fit.parameters[0].value == pytest.approx(bulk, rel=1e-4)
    for factor, accepted in ((1.0, True), (2.0, False)):
        rig = RIG.with_values({"bulk_modulus": factor * bulk})
        assert judged(rig, [("steps", read(log))]).accepted is accepted


def test_a_log_alone_gives_clocks_and_delays(tmp_path, monkeypatch):
    """As the packets of the trial do, for a link whose target's clock began at another time; the
    target is at rest before the log is finished."""
    states, finish = [], running.LiveLog.finish
    monkeypatch.setattr(
        running.LiveLog, "finish", lambda *log: (states.append(item.state), finish(*log))
    )
    item, prepared = ServedTarget(trial()), trial("model")
    for _ in range(250):
        item.tick(item.sequence / item.rate)
    machine = LinkMachine(prepared, LAYOUT, VirtualLink(item), "stream", "virtual")
    run(prepared, machine, log=tmp_path / "log.mcap", fast=False)
    assert states == [STOPPED]
    record = read(tmp_path / "log.mcap")
    known = estimated(exchanges_in(record))
    for name in ("clock_offset", "command_delay", "sample_delay"):
        value, low, high = known[name]
        assert low <= value <= high
    began = record["packet_received"][-1] - record["sample_time"][-1]
    assert known["clock_offset"][1] - 5e-3 <= began <= known["clock_offset"][2] + 5e-3
    assert estimated(exchanges_in(run(prepared).record)) == {}


def test_a_log_has_the_samples_that_a_late_host_left_out():
    """Rows 3 and 4 came too late for the host, and row 7 was lost on the way."""
    t = 4e-3 * np.arange(10.0)
    sent = np.column_stack([t * (i + 1) for i in range(len(LAYOUT.up))])
    machine = LinkMachine(trial("model"), LAYOUT, VirtualLink(ServedTarget(trial())), "stream", "")
    machine.heard = lambda: (np.delete(t, 7), np.delete(sent, 7, axis=0))
    rows = [0, 1, 2, 5, 6, 8, 9]
    channels = {
        "press.x": sent[rows, 2],
        "press.servo.command": np.zeros(7),
        "press.x_desired": t[rows],
    }
    record = running._on_beats(Record(t[rows], channels), machine)
    np.testing.assert_allclose(record.t, t)
    np.testing.assert_allclose(record["press.x"], 3.0 * t)
    acted = np.append(t[1:], t[-1])  # what acted from a row on comes with the next sample
    acted[6] = t[8]
    np.testing.assert_allclose(record["press.servo.command"], 9.0 * acted)
    np.testing.assert_allclose(record["press.x_desired"], t[[0, 1, 2, 2, 2, 5, 6, 6, 8, 9]])
