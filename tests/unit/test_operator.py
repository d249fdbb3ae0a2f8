"""Motions by hand: levers, their replay, the page and the joystick that have them."""

import json
import math
import sys
import time
from threading import Thread
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from ehbench import workflow
from ehbench.config.recipe import TrialRecipe, load_recipe
from ehbench.links.arming import rehearsed, run_remote
from ehbench.links.client import LinkMachine
from ehbench.links.layout import Layout
from ehbench.links.opening import Address
from ehbench.links.serve import ServedTarget
from ehbench.live.joystick import Joystick, follow_stick
from ehbench.live.view import View, facts_of
from ehbench.machines.paced import PacedMachine
from ehbench.trial import prepare, run
from ehbench.trial.lever import Lever
from tests.shared import RECIPES, RIGS, refused, shipped
from tests.unit.test_live import asked
from tools.studies.link_study import VirtualLink

PATH = RECIPES / "trials/position.toml"
HAND = {"kind": "operator", "speed": "100 mm/s"}
KEYS = {
    "rate": "250 Hz",
    "duration": "2 s",
    "motion": HAND,
    "controller": {"kind": "position"},
    "limits": {"stroke_margin": "20 mm"},
}


def trial(rig="slide_servo", **keys):
    recipe = TrialRecipe(stage="trial", rig="x", path=PATH, **(KEYS | keys))
    return prepare(recipe, shipped(rig))


class Hand:
    """Levers that swing with noise, held from ``first`` to ``last`` of its words."""

    def __init__(self, count=1, first=50, last=400, size=1.0):
        self.row, self.span, self.size = -1, range(first, last), size
        self.noise = np.random.default_rng(1).normal(size=(10_000, count))

    def read(self):
        self.row += 1
        swing = self.size * (math.sin(self.row / 60) + 0.1 * self.noise[self.row])
        return swing.tolist() if self.row in self.span else None


# --- how a lever moves a cylinder


@pytest.mark.parametrize("deflection", [1.0, -1.0, 0.525, -0.04])
def test_a_lever_asks_for_its_share_of_the_speed(deflection):
    lever = Lever(0.1, 0.5, 0.05, 0.0, 1.0, 1e-3)
    table = lever.table(0.5, np.full(1001, deflection))
    share = {1.0: 1.0, -1.0: -1.0, 0.525: 0.5, -0.04: 0.0}[deflection]
    assert table[-1, 1] == pytest.approx(0.1 * share)
    ramp = abs(0.1 * share) / 0.5  # then at full speed
    assert table[-1, 0] - 0.5 == pytest.approx(0.1 * share * (1.0 - 0.5 * ramp), abs=1e-9)


def test_no_lever_leaves_its_strokes_or_hurries():
    draw = np.random.default_rng(3)
    for _ in range(40):
        speed, rate, tick = (
            draw.uniform(0.02, 1.0),
            draw.uniform(0.1, 5.0),
            draw.uniform(5e-4, 0.01),
        )
        lever = Lever(speed, rate, 0.05, 0.1, 0.4, tick)
        held = np.repeat(draw.uniform(-1.0, 1.0, 40).round(), 200)
        x, v, a, _ = lever.table(draw.uniform(0.1, 0.4), held).T
        assert x.min() >= 0.1 - 1e-12 and x.max() <= 0.4 + 1e-12
        assert np.abs(v).max() <= speed * (1 + 1e-12)
        assert np.abs(np.diff(v)).max() <= rate * tick * (1 + 1e-9)
        np.testing.assert_allclose(np.diff(v), a[1:] * tick, atol=1e-12)
        np.testing.assert_allclose(np.diff(x), 0.5 * tick * (v[1:] + v[:-1]), atol=1e-12)


# --- trials and their replay

BOOM = HAND | {"cylinder": "boom"}
THREE = BOOM | {"also": [HAND | {"cylinder": name} for name in ("swing", "stick")]}
ON_BENCH = {"controller": {"kind": "position"}, "on": "bench"}
FEEDBACK = {"kind": "pressure_feedback", "gains": {"feedback_gain": "5e-12 m^3/(s*Pa)"}}


def played(keys, place):
    """The keys of a trial that plays the levers of a run."""
    motion = keys.get("motion", HAND)
    also = [item | {"file": str(place)} for item in motion.get("also", ())]
    return keys | {"motion": motion | {"file": str(place)} | ({"also": also} if also else {})}


@pytest.mark.parametrize(
    ("rig", "levers", "keys"),
    [
        ("slide_servo", 1, {}),
        ("slide_servo", 1, {"controller": {"kind": "open_loop"}}),
        ("thesis_arm", 3, {"motion": THREE, "duration": "1 s", "controller": {"kind": "arc"}}),
        ("thesis_arm", 1, {"motion": BOOM, "duration": "1 s"} | ON_BENCH),
    ],
)
def test_a_replay_is_the_trial_to_the_bit(rig, levers, keys, tmp_path):
    hand = run(trial(rig, **keys), log=tmp_path / "log.mcap", operator=Hand(levers))
    assert hand.facts.stopped == "" and np.ptp(hand.record[f"{hand.facts.cylinder}.x"]) > 5e-3
    again = run(trial(rig, **played(keys, tmp_path)))
    assert again.record.channels.keys() == hand.record.channels.keys()
    np.testing.assert_array_equal(again.record.t, hand.record.t)
    for name, values in hand.record.channels.items():
        assert again.record[name].tobytes() == values.tobytes(), name
    assert again.facts.measures == hand.facts.measures


def test_levers_of_another_recorder_let_go_with_its_dead_man_and_have_no_gap(tmp_path):
    path, t = tmp_path / "levers.csv", np.arange(1500) * 1e-3
    rows = [f"{x:.3f},0.5,{int(x < 0.8)}" for x in t]
    header = "t [s],press.operator [1],press.deadman [1]"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    record = run(trial(motion=HAND | {"file": str(path)})).record
    speed, pressed = record["press.v_desired"], record["press.deadman"] > 0.0
    assert record.t[pressed][-1] == pytest.approx(0.796) and np.max(speed[pressed]) > 0.02
    assert speed[-1] == 0.0 and not record["press.operator"][~pressed].any()
    path.write_text("\n".join([header, *rows[:400], *rows[700:]]), encoding="utf-8")
    with refused("trial.lever_gap") as error:
        trial(motion=HAND | {"file": str(path)})
    assert error.value.fields == {"t": pytest.approx(0.399), "seconds": pytest.approx(0.301)}


def test_open_loop_and_feedback_meet_the_same_operator(tmp_path):
    keys = {"controller": {"kind": "open_loop"}}
    hand = run(trial(**keys), log=tmp_path / "log.mcap", operator=Hand(size=0.4))
    other = run(trial(**played({"controller": FEEDBACK}, tmp_path / "log.mcap")))
    for name in ("press.operator", "press.deadman", "press.v_desired"):
        np.testing.assert_array_equal(other.record[name], hand.record[name])
    assert not np.array_equal(other.record["press.x"], hand.record["press.x"])


@pytest.mark.parametrize(("release", "ends"), [("continue", False), ("end", True)])
def test_a_dead_man_switch_that_is_let_go_ramps_to_rest(release, ends):
    keys = {"motion": HAND | {"release": release, "acceleration": "0.4 m/s^2"}}
    result = run(trial(**keys), operator=Hand(first=10, last=160))
    v, held = result.record["press.v_desired"], result.record["press.deadman"]
    assert held[:10].max() == 0.0 and held[10:160].min() == 1.0 and held[160:].max() == 0.0
    assert abs(v[159]) > 0.02 and not v[:10].any()
    rest = 159 + math.ceil(abs(v[159]) / 0.4 * 250.0 - 1e-9)
    assert v[rest - 1] != 0.0 and not v[rest:].any()
    assert result.record.t.size == (rest + 1 if ends else 501)


def test_words_that_are_no_numbers_let_go():
    nobody = SimpleNamespace(read=lambda: [math.nan])
    record = run(trial(duration="0.1 s"), operator=nobody).record
    assert not record["press.deadman"].any() and not record["press.v_desired"].any()


@pytest.mark.parametrize("mode", ["stream", "setpoint"])
def test_an_operator_over_a_link_moves_the_machine_as_here(mode):
    here = run(trial(), operator=Hand())
    prepared = trial()
    link = VirtualLink(ServedTarget(trial()))
    machine = LinkMachine(prepared, Layout.of(prepared.rig), link, mode, "virtual")
    there = run(prepared, machine, operator=Hand())
    for name in ("press.operator", "press.x_desired"):
        np.testing.assert_array_equal(there.record[name], here.record[name])
    x = here.record["press.x"]
    np.testing.assert_allclose(there.record["press.x"], x, atol=2e-3 * np.ptp(x))


def test_a_machine_is_compared_with_the_model_under_the_same_hand(monkeypatch):
    link = VirtualLink(ServedTarget(trial()))
    monkeypatch.setattr(Address, "link", lambda self, layout=None: link)
    url = "udp://here:1?clock=virtual"
    remote = run_remote(trial(), url, lambda about, token: token, operator=Hand())
    apart = remote.dry_run["differences"]["press.x"]["largest"]
    assert 0.0 < apart < 0.02 * np.ptp(remote.result.record["press.x"])


def test_a_dry_run_goes_to_both_ends_at_full_speed():
    prepared = trial(duration="60 s")
    dry, distances = rehearsed(prepared, 0.02)
    x, stroke = dry.record["press.x"], float(prepared.machine.strokes[0])
    room = 0.02 + 0.02 * stroke
    assert x.min() == pytest.approx(room, abs=2e-3)
    assert x.max() == pytest.approx(stroke - room, abs=2e-3)
    assert 0.0 < distances["press"] < 0.02 and dry.record.t[-1] < 60.0


@pytest.mark.parametrize(
    ("key", "keys"),
    [
        ("config.motion_needs_speed", {"motion": {"kind": "operator"}}),
        ("config.operator_stands", {"motion": HAND | {"speed": "0 mm/s"}}),
        ("config.operator_needs_duration", {"duration": None}),
    ],
)
def test_incomplete_motions_are_refused_at_the_door(key, keys, tmp_path):
    import tomli_w

    given = {k: v for k, v in (KEYS | keys).items() if v is not None}
    path = tmp_path / "trial.toml"
    path.write_text(tomli_w.dumps({"stage": "trial", "rig": "x"} | given))
    with refused(key):
        load_recipe(path)


def test_nobody_at_the_levers_is_refused(tmp_path):
    with refused("trial.unmanned"):
        run(trial())
    with refused("trial.no_channel"):
        log = tmp_path / "log.mcap"
        run(trial(motion=HAND, duration="0.1 s"), log=log, operator=Hand())
        trial(rig="thesis_arm", motion=HAND | {"cylinder": "boom", "file": str(log)})
    path = tmp_path / "set.toml"
    path.write_text(
        f'stage = "trials"\nrig = "{RIGS}/slide_servo.toml"\nduration = "1 s"\n[[motion]]\n'
        'kind = "operator"\nspeed = "50 mm/s"\n[[controller]]\nkind = "position"\n'
    )
    with refused("config.operator_of_set"):
        load_recipe(path)


# --- the page's levers


def driven(view, until, words, answers):
    """Say these words to a page again and again for some seconds."""
    while time.monotonic() < until:
        try:
            answers.append(asked(view.url, "POST", "levers", json.dumps(words))[0])
        except OSError:
            return
        time.sleep(0.03)


@pytest.mark.parametrize("end", ["silent", "killed", "let go"])
def test_levers_of_the_page_move_the_machine_until_it_is_gone(end, tmp_path):
    prepared, answers = trial(), []
    view = View(prepared, lambda url: False)
    try:
        words = {"held": True, "levers": [0.8]}
        driven(view, time.monotonic() + 0.1, words, answers)  # the page is there
        browser = Thread(target=driven, args=(view, time.monotonic() + 1.0, words, answers))
        browser.start()

        def leave():
            browser.join()
            if end == "killed":
                view.process.kill()
            elif end == "let go":
                driven(view, time.monotonic() + 0.1, words | {"held": False}, answers)

        leaving = Thread(target=leave)
        leaving.start()
        machine = PacedMachine.of(prepared.machine)
        log = tmp_path / "log.mcap"
        result = run(prepared, machine, log, watcher=view, operator=view)
        leaving.join()
    finally:
        view.close()
    record = result.record
    assert set(answers) == {204} and record["press.deadman"].max() == 1.0
    assert record["press.v_desired"].max() == pytest.approx(0.1 * (0.8 - 0.05) / 0.95)
    assert not record["press.deadman"][-50:].any() and not record["press.v_desired"][-50:].any()
    again = run(trial(**played({}, tmp_path)))
    assert again.record["press.x"].tobytes() == record["press.x"].tobytes()


def test_a_page_takes_sound_words_from_its_reader_only():
    view = View(trial(), lambda url: False)
    try:
        sound = {"held": True, "levers": [0.5]}
        for code, words, keys in (
            (204, sound, {}),
            (400, {"held": True, "levers": [math.nan]}, {}),
            (400, {"held": True, "levers": [0.1, 0.2]}, {}),
            (400, {"levers": [0.1]}, {}),
            (400, [1], {}),
            (400, sound | {"more": "x" * 5000}, {}),
            (403, sound, {"Host": "evil.example"}),
            (403, sound, {"path": "/guess/levers"}),
        ):
            path = keys.pop("path", "levers")
            assert asked(view.url, "POST", path, json.dumps(words), **keys)[0] == code, words
        assert view.read() == [0.5]
        asked(view.url, "POST", "levers", json.dumps(sound | {"held": False}))
        assert view.read() is None
    finally:
        view.close()


def test_a_trial_by_hand_runs_from_its_recipe(tmp_path):
    path, views = tmp_path / "hand.toml", []
    path.write_text(
        f'stage = "trial"\nrig = "{RIGS}/slide_servo.toml"\nduration = "1 s"\nrate = "250 Hz"\n'
        '[motion]\nkind = "operator"\nspeed = "50 mm/s"\n[controller]\nkind = "position"\n'
    )
    with refused("trial.unmanned"):
        workflow.run(path, workflow.Session(root=tmp_path / "alone"))
    session = workflow.Session(root=tmp_path, live=lambda url: bool(views.append(url)))
    facts = workflow.run(path, session).json("trial")
    assert len(views) == 1 and facts["samples"] == 251 and not facts["stopped"]


# --- joysticks


@pytest.fixture
def sticks(monkeypatch):
    """A stand-in for evdev: its devices by path, which tests press, move and unplug."""
    codes = {"ABS_X": 0, "ABS_Y": 1, "ABS_RX": 3, "BTN_TRIGGER": 288, "BTN_THUMB": 289}
    module, devices = ModuleType("evdev"), {}
    module.ecodes = SimpleNamespace(ecodes=codes, EV_ABS=3, EV_KEY=1)

    class InputDevice:
        def __init__(self, path):
            self.path, self.name = path, devices[path]["name"]

        def capabilities(self):
            return {3: [(0, None), (1, None)], 1: [288, 289]}

        def _there(self):
            if self.path not in devices:
                raise OSError("no such device")
            return devices[self.path]

        def absinfo(self, code):
            return SimpleNamespace(value=self._there()["axes"][code], min=0, max=255)

        def active_keys(self):
            return self._there()["keys"]

        def close(self):
            pass

    module.InputDevice, module.list_devices = InputDevice, lambda: list(devices)
    monkeypatch.setitem(sys.modules, "evdev", module)
    devices["/dev/input/event3"] = {"name": "Old Joystick", "axes": {0: 255, 1: 0}, "keys": [289]}
    return devices


@pytest.mark.parametrize(
    ("device", "axes", "button", "says"),
    [
        ("old joy", ("", ""), "", [1.0, -1.0]),
        ("/dev/input/event3", ("-ABS_Y",), "BTN_THUMB", [1.0]),
        ("Old", ("ABS_X",), "BTN_TRIGGER", None),
    ],
)
def test_a_joystick_says_its_axes_while_its_button_is_held(sticks, device, axes, button, says):
    assert Joystick(device, axes, button).read() == says


@pytest.mark.parametrize(
    ("key", "given"),
    [
        ("live.no_device", ("Other", ("",), "")),
        ("live.no_axis", ("Old", ("ABS_RX",), "")),
        ("live.no_axis", ("Old", ("", "", ""), "")),
        ("live.no_button", ("Old", ("",), "BTN_FOO")),
    ],
)
def test_a_joystick_that_does_not_fit_is_refused(sticks, key, given):
    with refused(key):
        Joystick(*given)


def test_a_joystick_that_is_unplugged_lets_go_until_it_is_back(sticks):
    facts, said = facts_of(trial(motion=HAND | {"device": "Old"})), []

    class Over(BaseException):
        pass

    def put(levers):
        said.append(levers)
        if len(said) == 2:
            sticks["gone"] = sticks.pop("/dev/input/event3")
        if len(said) == 3:
            sticks["/dev/input/event3"] = sticks.pop("gone")
        if len(said) == 4:
            raise Over

    with pytest.raises(Over):
        follow_stick(facts, put)
    assert said == [[1.0], [1.0], None, [1.0]]


def test_without_evdev_its_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "evdev", None)
    with refused("live.extra"):
        View(trial(motion=HAND | {"device": "Old"}), lambda url: False)
