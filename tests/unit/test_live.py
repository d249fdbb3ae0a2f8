"""The live view of a trial: what it shows, to whom, and that it changes nothing."""

import http.client
import json
import math
import sys
from importlib.machinery import ModuleSpec
from io import StringIO
from threading import Thread
from types import ModuleType, SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from rich.console import Console

from ehbench import workflow
from ehbench.config.recipe import TrialRecipe
from ehbench.live.board import ENDED, FIRST, LATE, LEVERS, LIMIT, STATE, STOPPING, TIME
from ehbench.live.frames import frame_of
from ehbench.live.screen import screen
from ehbench.live.view import View, facts_of
from ehbench.live.viewer import foxglove
from ehbench.machines.paced import PacedMachine
from ehbench.machines.rows import LIMITS
from ehbench.trial import prepare, run
from tests.shared import RECIPES, refused, shipped

RIG = shipped("slide_servo")
KEYS = {
    "rate": "250 Hz",
    "motion": {
        "kind": "point_to_point",
        "cylinder": "press",
        "waypoints": ["160 mm", "190 mm"],
        "speed": "100 mm/s",
    },
    "controller": {"kind": "position"},
    "limits": {"stroke_margin": "20 mm", "pressure_max": "20 MPa", "command_max": "9 V"},
}


def trial(**keys):
    path = RECIPES / "trials/position.toml"
    return prepare(TrialRecipe(stage="trial", rig="x", path=path, **(KEYS | keys)), RIG)


def asked(url, method="GET", path="", body=None, **headers):
    """(code, headers, body) of the answer; of a stream its first frames."""
    parts = urlsplit(url)
    link = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20.0)
    link.request(method, path if path.startswith("/") else parts.path + path, body, headers)
    answer = link.getresponse()
    text = answer.read(4000 if "event-stream" in answer.headers["Content-Type"] else None)
    link.close()
    return answer.status, answer.headers, text.decode()


# --- what it shows


def test_a_frame_has_each_limit_with_its_margin():
    prepared = trial()
    facts = facts_of(prepared)
    numbers = np.zeros(facts.first_lever + LEVERS)
    numbers[[STATE, TIME, LATE, LIMIT]] = STOPPING, 1.5, 3, LIMITS.index("pressure_max")
    values = {"x": 0.15, "v": -0.02, "p_head": 19e6, "p_rod": math.nan, "x_desired": 0.148}
    for name, value in values.items():
        numbers[FIRST + facts.names.index(f"press.{name}")] = value
    numbers[FIRST + facts.names.index("press.servo.command")] = -4.5
    frame = frame_of(facts, numbers.tolist())
    assert (frame["state"], frame["stop"], frame["late"]) == ("stopping", "pressure_max", 3)
    row, stroke = frame["cylinders"][0], float(prepared.machine.strokes[0])
    assert row["x"] == pytest.approx(150.0) and row["p_rod"] is None
    margins = {item["limit"]: item for item in frame["margins"]}
    share = float(RIG.cylinder[0].stroke) * 0.1
    for limit, margin, used in (
        ("stroke_margin", 1e3 * (min(0.15, stroke - 0.15) - 0.02), None),
        ("command_max", 4.5, 0.5),
        ("following_error", 1e3 * (share - 0.002), 0.002 / share),
    ):
        assert margins[limit]["margin"] == pytest.approx(margin), limit
        assert used is None or margins[limit]["used"] == pytest.approx(used), limit
    assert margins["pressure_max"]["channel"] == "press.p_head"
    assert margins["pressure_max"]["used"] == pytest.approx(0.95)
    lines = StringIO()
    Console(width=120, file=lines).print(screen(facts, frame))
    for word in ("pressure_max", "press", "x [mm]", "-20.0", "–", "stopping"):
        assert word in lines.getvalue(), word


# --- to whom, and that it changes nothing


@pytest.fixture
def begun():
    """A view of a trial, which ends with the test."""
    views = []

    def begin(prepared):
        views.append(View(prepared, lambda url: False))
        return views[-1]

    yield begin
    for view in views:
        view.close()


def test_a_watched_trial_is_the_trial(begun, tmp_path):
    prepared = trial()
    alone = run(prepared, log=tmp_path / "alone.mcap")
    view, answers = begun(prepared), {}
    port = urlsplit(view.url).port

    def ask():
        answers["page"] = asked(view.url)
        answers["events"] = asked(view.url, path="events")
        answers["unknown"] = asked(view.url, path="other")
        answers["token"] = asked(view.url, path="/guess/")
        answers["rebound"] = asked(view.url, Host=f"evil.example:{port}")

    browser = Thread(target=ask)
    browser.start()
    machine = PacedMachine.of(prepared.machine)
    watched = run(prepared, machine, tmp_path / "watched.mcap", watcher=view)
    browser.join()
    codes = {name: code for name, (code, _, _) in answers.items()}
    assert codes == {"page": 200, "events": 200, "unknown": 404, "token": 403, "rebound": 403}
    assert "default-src 'none'" in answers["page"][1]["Content-Security-Policy"]
    assert "src=" not in answers["page"][2] and "http" not in answers["page"][2]
    events = [line for line in answers["events"][2].splitlines() if line.startswith("data: ")]
    facts, frame = (json.loads(line.removeprefix("data: ")) for line in events[:2])
    assert facts["rate"] == 250.0 and frame["cylinders"][0]["name"] == "press"
    assert (tmp_path / "watched.mcap").read_bytes() == (tmp_path / "alone.mcap").read_bytes()
    assert watched.facts == alone.facts
    last = prepared.t.size - 1
    assert view.numbers[TIME] == prepared.t[last]
    known = dict(zip(facts_of(prepared).names, view.numbers[FIRST:], strict=False))
    for name in ("press.x", "press.servo.command", "press.x_desired"):
        assert known[name] == watched.record[name][last], name


def test_a_view_that_is_killed_is_not_missed(begun):
    prepared = trial()
    alone, view = run(prepared), begun(prepared)
    view.process.kill()
    watched = run(prepared, PacedMachine.of(prepared.machine), watcher=view)
    assert watched.facts == alone.facts
    np.testing.assert_array_equal(watched.record["press.x"], alone.record["press.x"])


def test_a_view_ends_with_its_trial(begun):
    view = begun(trial())
    view.close()
    assert view.process.returncode == 0 and view.numbers[STATE] == ENDED


def test_a_set_is_not_watched():
    session = workflow.Session(live=lambda url: False)
    with refused("stages.live_of_set"):
        workflow.run(RECIPES / "trials/supplies.toml", session)


def test_foxglove_gets_each_frame(monkeypatch):
    said = []
    server = SimpleNamespace(stop=lambda: said.append("stop"))
    module = ModuleType("foxglove")
    module.__spec__ = ModuleSpec("foxglove", None)
    module.set_log_level = lambda level: None
    module.start_server = lambda **keys: said.append(keys["host"]) or server
    module.log = lambda topic, frame: said.append((topic, frame))
    monkeypatch.setitem(sys.modules, "foxglove", module)
    with foxglove(facts_of(trial())) as log:
        log({"t": 1.0})
    assert said == ["127.0.0.1", ("/trial", {"t": 1.0}), "stop"]
