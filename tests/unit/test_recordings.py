"""A log whose payload or channels are not those that are stated: the note says which are, and a
sound log has none."""

from dataclasses import replace
from types import SimpleNamespace as Stub

import numpy as np
import pytest

from ehbench.diagnosis import Case, misread, recordings
from ehbench.plant.model import Model
from ehbench.plant.ties import RECORDED, SUPPLY
from ehbench.preprocessing.observations import commanded
from ehbench.report.content import remedy_step
from ehbench.report.stages.validation import doubts
from ehbench.validation import prepare_validation, run_validation, speaking_against
from ehbench.vocabulary import quantity
from ehbench.vocabulary.fields import read_value
from ehbench.vocabulary.messages import Message, message
from tests.shared import identify, shipped
from tools.virtual_logs import virtual_log

CRANE = "crane_proportional"
MISREAD = "diagnosis.misread"


def recorded(name, seed=3, payload=None, wave="quick steps", duration=2.0):
    """A log of a shipped rig that carries a payload and says so."""
    rig = shipped(name)
    log = virtual_log(name, rig.with_payload(payload), wave, seed, duration=duration)
    return replace(log, meta=dict(log.meta) | {"payload": payload or "none"})


def said(log, payload):
    return replace(log, meta=dict(log.meta) | {"payload": payload})


def exchanged(log, first, second):
    return replace(log, channels=log.channels | {first: log[second], second: log[first]})


def notes(name, log):
    payload = log.meta["payload"]
    model = Model.of(shipped(name), payload=None if payload == "none" else payload)
    return list(misread(Case("log", log, model, commanded(model, log))))


def test_a_foreign_model_is_asked_of_no_other_payload_or_channels(monkeypatch):
    monkeypatch.setattr(recordings, "_left", lambda case: pytest.fail("simulated"))
    foreign = Stub(model=Stub(rig=Stub(model="slide.fmu")), channels=("press.v",))
    silent = Stub(model=Stub(rig=Stub(model=None)), channels=())
    for case in (foreign, silent):
        assert list(misread(case)) == []


@pytest.mark.parametrize(("name", "load"), [(CRANE, "200 kg"), ("slide_servo", "100 kg")])
def test_a_payload_that_a_log_does_not_name_is_named(name, load):
    for carried, written in ((load, "none"), (None, load)):
        log = recorded(name, payload=carried)
        assert notes(name, log) == []
        (note,) = notes(name, said(log, written))
        assert note.fields["share"] > 0.9
        assert note.fields["remedy"].startswith(f'payload = "{carried or "none"}"')


@pytest.mark.parametrize(
    ("name", "pair"),
    [
        (CRANE, ("lift.p_head", "lift.p_rod")),
        ("boom_four_valve", ("boom.sh.command", "boom.sr.command")),
        ("thesis_arm", ("swing.servo.command", "stick.servo.command")),
        ("thesis_arm", ("swing.p_head", "stick.p_head")),
    ],
)
def test_channels_in_each_others_place_are_named(name, pair):
    log = recorded(name)
    assert notes(name, log) == []
    (note,) = notes(name, exchanged(log, *pair))
    assert note.fields["share"] > 0.6
    assert note.fields["remedy"].fields.items() >= dict(zip(("first", "second"), pair)).items()


@pytest.mark.parametrize(("flow", "said"), [("60 L/min", False), ("14 L/min", True)])
def test_a_supply_that_gives_way_is_replayed(flow, said):
    """The pump of the machine is weaker than that of its rig file; its pressure was recorded."""
    rig = shipped(CRANE).with_values({"supply.flow_limit": read_value(flow, quantity("flow"))})
    log = replace(virtual_log(CRANE, rig, "quick steps", 3, duration=2.0), meta={"payload": "none"})
    keys = [note.fields["remedy"].key for note in notes(CRANE, log)]
    assert keys == ["diagnosis.write_supplied"] * said
    bare = {name: y for name, y in log.channels.items() if name != "p_supply"}
    assert notes(CRANE, replace(log, channels=bare)) == []
    assert notes(CRANE, replace(log, meta=dict(log.meta) | {SUPPLY: RECORDED})) == []


def test_a_log_that_cannot_be_simulated_has_no_note():
    name, log = "boom_four_valve", recorded("boom_four_valve")
    beyond = {"boom.q": log["boom.q"] + 3.0, "boom.x": log["boom.x"] + 3.0}
    assert notes(name, replace(log, channels=log.channels | beyond)) == []


def test_a_turned_motion_is_tried_beside_exchanged_channels():
    log = recorded("slide_servo")
    case = Case("log", log, Model.of(shipped("slide_servo")), ("press",))
    tried = {key or "turned": other.record for other, key, _ in recordings._exchanged(case)}
    assert tried["turned"]["press.v"] == pytest.approx(-log["press.v"])
    assert tried["exchanged"]["press.p_head"] == pytest.approx(log["press.p_rod"])


@pytest.mark.parametrize(
    ("shares", "best"),
    [
        ({"carried": 0.49}, None),
        ({"carried": 0.51}, "carried"),
        ({"exchanged": 0.79}, None),
        ({"exchanged": 0.81}, "exchanged"),
        ({"carried": 0.7, "exchanged": 0.85}, "exchanged"),
        ({"": 0.95, "exchanged": 0.85}, ""),  # a turned motion, which another note tells
    ],
)
def test_what_explains_most_of_a_residual_is_best(shares, best, monkeypatch):
    monkeypatch.setattr(recordings, "_left", lambda other: other)
    left, case = np.full(1000, 10.0), Stub(noise_squares=1000.0, independent=len)
    others = [(left * np.sqrt(1.0 - 0.99 * share), key, {}) for key, share in shares.items()]
    found = recordings._best(case, left, others)
    assert (found and found[1]) == best
    assert not found or found[0] == pytest.approx(max(shares.values()))


@pytest.mark.parametrize(("share", "asked"), [(0.45, False), (0.55, True)])
def test_channels_are_exchanged_where_half_the_spread_is_left(share, asked, monkeypatch):
    log = recorded("slide_servo")
    case = Case("log", log, Model.of(shipped("slide_servo")), ("press",))
    spread = np.concatenate([(y - y.mean()) / case.scales[n] for n, y in case.recorded.items()])
    turned = replace(case, name="turned")
    monkeypatch.setattr(recordings, "_left", lambda at: spread * (at is not turned) * share)
    monkeypatch.setattr(recordings, "_set_up", lambda at: ())
    for key, told in (("", False), ("exchanged", asked)):
        other = (turned, key, dict.fromkeys(("first", "second"), key))
        monkeypatch.setattr(recordings, "_exchanged", lambda at, other=other: (other,))
        assert bool(list(misread(case))) == told


def test_a_fit_that_exchanged_channels_spoil_is_asked_as_it_began():
    """With pressures in each other's place a fit ends anywhere; its rig file's numbers tell."""
    rig = shipped("slide_servo")
    log = exchanged(recorded("slide_servo"), "press.p_head", "press.p_rod")
    spoilt = rig.with_values({"bulk_modulus": 5e7, "press.leakage_internal": 4e-9})
    case = Case("log", log, Model.of(spoilt), commanded(Model.of(rig), log))
    (note,) = misread(case, replace(case, model=Model.of(rig)))
    assert note.fields["share"] > 0.9


def test_what_a_fit_finds_of_its_logs_weighs_on_the_verdict():
    """The log that judges is sound; one of those that were fitted carried more than it says."""
    rig = shipped("slide_servo")
    first, loaded, last = (
        recorded("slide_servo", 4 + k, load, duration=1.2)
        for k, load in enumerate((None, "100 kg", None))
    )
    verdicts = {}
    for written in ("100 kg", "none"):
        fit = identify(rig, [("a", first), ("b", said(loaded, written))], ["bulk_modulus"])
        against = speaking_against(fit.as_json())
        prepared = replace(prepare_validation(fit.rig, [("c", last)]), leans=against)
        verdicts[written] = run_validation(prepared, diagnose=False).verdict
        named = [item for item in against if getattr(item["sentence"], "key", "") == MISREAD]
        assert [item["sentence"].fields["remedy"].fields["log"] for item in named] == (
            ["b"] if written == "none" else []
        )
    assert verdicts == {"100 kg": "accepted", "none": "rejected"}


def test_steps_come_in_the_order_of_what_speaks_for_them():
    """A turned sign stands for 80 % of a residual, a supply that is off for half of it."""
    given = {"supply": {"weight": 0.5}, "turned": {"weight": 0.8}}
    given |= {"exchanged": {"share": 0.87}, "cause": {"share": 0.55}, "fixed": {"share": 0.3}}
    texts = [Message("", "", {"remedy": name} | more) for name, more in given.items()]
    order = [item["remedy"] for item in doubts({"reasons": texts[:2], "reservations": texts[2:]})]
    assert order == ["exchanged", "turned", "cause", "supply", "fixed"]


def test_a_number_that_was_fitted_wrong_is_a_step_to_take():
    """Else an alternative that explains less would stand first."""
    (name,) = names = ["lift.friction_coulomb"]
    step = remedy_step(message("faults.fitted", names=name))
    assert (step.key, step.hint.split()) == ("steps.fit_again", names)


def test_a_fixed_number_that_rejects_comes_before_a_cause_that_moves_none():
    """A boom's weight is off: a residual follows a sensor's offset more, and moves no number."""
    mass = Message("", "", {"remedy": "mass", "estimate": "bulk_modulus", "share": 0.61})
    offset = Message("", "", {"remedy": "offset", "cause": "it reads too much", "share": 0.92})
    for reasons, others, first in (([mass], [offset], "mass"), ([], [mass, offset], "offset")):
        assert doubts({"reasons": reasons, "reservations": others})[0]["remedy"] == first
