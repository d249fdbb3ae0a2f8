"""Logs and recipes broken the way people break them: refused or told, in one sentence."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.config.recipe import load_recipe
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.parts.friction.stribeck import Stribeck
from ehbench.plant.model import Model, simulate
from ehbench.preprocessing.plausibility import notes_on_channels, outside_stroke, undriven
from ehbench.preprocessing.preparation import distinct_names, preprocess
from ehbench.preprocessing.time_base import evened
from ehbench.report.terminal import Answer
from ehbench.validation import models_of, validate_rig
from ehbench.vocabulary.errors import InputError, InsufficientData, LogError
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.messages import is_warning, of_log
from tests.shared import RIGS, identify, judged, measured, shipped

NOISE = {"qd": 1e-3, "v": 1e-3, "p_head": 1e4, "p_rod": 1e4, "q": 1e-5, "x": 1e-5, "p_supply": 1e4}
CRANE = ["bulk_modulus", "arm.joint_damping"]


@cache
def rig(name="crane_proportional"):
    return shipped(name)


def steps(samples, out, back):
    u = np.zeros(samples)
    u[round(0.07 * samples) : round(0.3 * samples)] = out
    u[round(0.55 * samples) : round(0.8 * samples)] = back
    return u


def logged(machine, valve, volts, payload=None, samples=1501, posture=None):
    """What sensors say of steps there and back, with noise."""
    seconds = (samples - 1) / 1000.0
    volts = {valve: steps(samples, *volts)}
    made = simulate(machine, volts, seconds, payload=payload, posture=posture)
    return measured(made, samples, NOISE)


@cache
def crane(payload=None):
    return logged(rig(), "lift.spool", (5.0, -4.5), payload)


def changed(record, **edits):
    """A log with channels scaled by their last word, ``p_head=0.01``, or replaced."""
    channels = dict(record.channels)
    for name in channels:
        word = name.rsplit(".", 1)[-1]
        if word in edits:
            channels[name] = channels[name] * edits[word]
        if (whole := name.replace(".", "_")) in edits and whole != word:
            channels[name] = edits[whole]
    return replace(record, channels=channels)


def taken(record, machine=None):
    payload = record.meta.get("payload", "none")
    model = Model.of(machine or rig(), payload=None if payload == "none" else payload)
    return preprocess("log", record, model)


def refused(says, work, kind=InputError):
    """The error of some work, by the key of the catalogue or by its text."""
    with pytest.raises(kind) as caught:
        work()
    assert says == caught.value.key or re.search(says, str(caught.value)), caught.value
    return caught.value


def test_a_sound_log_passes_as_it_is():
    for payload in (None, "200 kg"):
        record, told = taken(crane(payload))
        assert record is crane(payload) and told == ()


# --- parameters without bounds ---


EXCITED = {
    "lift.spool_pa.flow_gain": (0.5, 3.0),
    "lift.spool_pa.deadband": (0.6,),
    "arm.mass": (1.5,),
    "lift.volume_head": (3.0,),
    "lift.volume_rod": (1.5,),
    "spool.natural_frequency": (0.4,),
    "lift.leakage_internal": (None,),
    "carriage.mass": (0.5,),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "factor"), [(n, f) for n, fs in EXCITED.items() for f in fs])
def test_what_the_log_excites_comes_back_without_bounds(name, factor):
    """Only the start is given; no vocabulary range may stand in for a scale."""
    slides = name == "carriage.mass"
    machine = rig("slide_servo") if slides else rig()
    valve, volts = ("press.servo", (3.0, -3.0)) if slides else ("lift.spool", (5.0, -4.5))
    known = machine.parameters()[name]
    truth = 2.0e-12 if factor is None else float(known)
    record = logged(machine.with_values({name: truth}), valve, volts)
    unbounded = replace(known, value=truth, lower=None, upper=None, text=None)
    given = {"start": {name: factor * truth}} if factor else {"start": {name: 0.0}}
    given["upper"] = {} if factor else {name: 8e-12}
    bare = machine.with_values({name: unbounded})
    found = identify(bare, [("log", record)], [name], **given)[name]
    assert found.status == "estimated", found
    # five standard errors, and errors that make the number worth having
    assert abs(found.value - truth) < 5.0 * found.std and found.std < 0.05 * truth, (found, truth)


@pytest.mark.slow
def test_a_rod_end_may_hold_less_than_a_wrong_bore_would_sweep():
    """A bore that is sought decides with it what the rod end can hold at least."""
    true, stroke = rig().cylinder[0], float(rig().cylinder[0].stroke)
    names = {"lift.bore": float(true.bore), "lift.volume_rod": float(true.volume_rod)}
    start = {"lift.bore": 1.15 * names["lift.bore"], "lift.volume_rod": 3.1e-3}
    fit = identify(rig().with_values(start), [("log", crane())], ["bulk_modulus", *names])
    wrong = 0.25 * np.pi * (start["lift.bore"] ** 2 - float(true.rod) ** 2) * stroke
    assert names["lift.volume_rod"] < wrong < start["lift.volume_rod"]
    for name, value in names.items():
        assert fit[name].status == "estimated"
        low, high = fit[name].interval or (np.nan, np.nan)
        assert abs(fit[name].value - value) < high - low < 0.1 * value


def test_a_rod_end_without_oil_at_full_stroke_is_never_tried():
    fit = identify(rig(), [("log", crane())], ["lift.volume_rod"])
    cylinder = rig().cylinder[0]
    assert fit["lift.volume_rod"].value > cylinder.areas()[1] * float(cylinder.stroke)


def test_a_start_at_zero_needs_a_bound():
    work = lambda: identify(rig(), [("log", crane())], ["lift.leakage_head"])
    error = refused("identification.zero_start", work)
    assert '[upper] "lift.leakage_head"' in str(error.hint)


# --- names ---


def renamed(record, old, new):
    channels = {name.replace(old, new): values for name, values in record.channels.items()}
    return replace(record, channels=channels)


def test_channels_of_nothing_on_the_rig_are_named():
    more = {"lft.p_head": crane()["lift.p_head"], "lift.spol.command": np.zeros(1501)}
    odd = replace(crane(), channels=crane().channels | more)
    told = " ".join(taken(odd)[1])
    for name, near in (("lft.p_head", "lift"), ("lift.spol.command", "lift.spool")):
        assert f"the log has '{name}'" in told and f"nearest is '{near}'" in told
    fit = identify(rig(), [("log", odd)], CRANE)
    assert sum(text.startswith("log: the log has '") for text in fit.warnings) == 2


def test_a_command_that_the_log_lacks_is_said_without_being_asked():
    """Where the log has those of the cylinder's other valves; a log each is one note."""
    boom = rig("boom_four_valve")
    log = logged(boom, "boom.sh", (4.0, 0.0))
    others = {f"boom.{v.name}.command": 0.0 * log.t for v in boom.cylinder[0].valve}
    whole = replace(log, channels={**others, **log.channels})
    assert not [*undriven(whole, boom)]
    slip = renamed(whole, "boom.rt.command", "boom.tr.command")
    (note,) = undriven(slip, boom)
    assert (note.fields["channel"], note.fields["near"]) == ("boom.rt.command", "boom.tr.command")
    notes = ["a: an odd one", *(of_log(name, note) for name in ("a", "b"))]
    first, told, *rest = Answer("done", notes=notes).lines(200)
    assert first == "done" and "no boom.rt.command" in told and told.endswith("(the like of b)")
    assert rest == ["1 note with -v"]


def test_what_is_asked_to_be_compared_is_compared_or_said():
    machine = rig("slide_servo")
    log = logged(machine, "press.servo", (2.0, -2.0))
    asked, wanted = ["bulk_modulus"], ["v", "p_head", "rod_force"]
    wrong = [*wanted[:2], "rod_forse"]
    work = lambda: identify(machine, [("log", log)], asked, channels=wrong)
    error = refused("identification.no_quantity", work)
    assert "nearest is 'rod_force'" in error.message
    fit = identify(machine, [("log", log)], asked, channels=wanted)
    said = [text.fields for text in fit.warnings if getattr(text, "key", "").endswith("_compared")]
    assert said == [{"log": "log", "word": "rod_force"}]


def test_a_log_of_another_rig_is_refused():
    logs = [("log", renamed(crane(), "lift.", "lifts."))]
    says = "no channel is of a cylinder of rig 'crane_proportional'.*nearest is 'lift'.*it has lift"
    refused(says, lambda: identify(rig(), logs, CRANE))
    refused("no channel is of a cylinder", lambda: validate_rig(rig(), logs))


def test_a_log_has_a_payload_and_a_name():
    silent = replace(crane(), meta={})
    _, told = taken(silent)
    assert told == ("the log names no payload: taken as unloaded (the rig has 200 kg)",)
    bare = rig().model_copy(update={"payload": {}})
    assert taken(silent, bare)[1] == ()
    paths = [Path(text) for text in ("a/step.csv", "b/step.mcap", "b/other.csv", "c/b/step.csv")]
    assert distinct_names(paths) == ["a_step", "b_step", "other", "b_step_2"]


# --- units ---


@pytest.mark.parametrize(
    ("chambers", "supply", "says"),
    [
        (0.01, 0.01, r"p_supply is 1.8 bar, .* holds 180 bar.*it looks like bar labelled kPa"),
        (10.0, 10.0, r"p_supply is .* it looks like bar labelled MPa"),
        (14.5, 1.0, r"lift.p_head reaches .* bar, .* holds 180 bar \(is the unit right"),
        (0.1, 1.0, r"at rest lift.p_head holds .*, while the load .* requires .*is the unit right"),
        (0.01, 1.0, r"is the unit right"),
    ],
)
@pytest.mark.parametrize("payload", [None, "200 kg"])
def test_pressures_in_a_wrong_unit_are_refused(chambers, supply, says, payload):
    wrong = [("log", changed(crane(payload), p_head=chambers, p_rod=chambers, p_supply=supply))]
    refused(says, lambda: identify(rig(), wrong, CRANE))
    refused(says, lambda: validate_rig(rig(), wrong))


def test_pressures_that_carry_no_load_are_judged_by_the_supply():
    slide = logged(rig("slide_servo"), "press.servo", (3.0, -3.0))
    channels = {
        name: 0.01 * v if name.startswith("press.p_") else v
        for name, v in slide.channels.items()
        if name != "p_supply"
    }
    says = "press is fed from a supply of .* and its pressures stay below"
    refused(says, lambda: taken(replace(slide, channels=channels), rig("slide_servo")))
    # Half the pressure the rig file says is another day, not another unit
    half = {"supply.pressure": 0.5 * float(rig().supply.pressure)}
    assert taken(logged(rig().with_values(half), "lift.spool", (5.0, -4.5)))[1] == ()


@pytest.mark.parametrize(
    ("machine", "valve"), [(None, "lift.spool"), ("slide_servo", "press.servo")]
)
def test_single_positions_that_nothing_reaches_are_refused(machine, valve):
    machine = shipped(machine or "crane_proportional")
    record = logged(machine, valve, (3.0, -3.0))
    name = next(n for n in record.channels if n.endswith((".x", ".q")))
    values = record[name].copy()
    for at in (300, 700):
        values[at] = -9.999
    wrong = replace(record, channels=record.channels | {name: values})
    error = refused("preprocessing.outside_travel", lambda: taken(wrong, machine))
    assert error.fields["time"] == record.t[300]
    if name.endswith(".x"):  # another zero, another unit; an angle's are refused as a whole
        for all_of in (record[name] + 15.0, 50.0 * record[name]):
            taken(replace(record, channels=record.channels | {name: all_of}), machine)


def test_a_fit_that_follows_nothing_is_no_fit():
    """A flow gain bounded far above the true one: the speed is followed worse than by its mean."""
    gain, truth = "lift.spool_pa.flow_gain", float(rig().parameters()["lift.spool_pa.flow_gain"])

    def given(start, lower):
        ends = zip(("start", "lower", "upper"), (start, lower, 8.0), strict=True)
        return {key: {gain: factor * truth} for key, factor in ends}

    log = [("log", crane())]
    work = lambda: identify(rig(), log, [gain], channels=("qd",), **given(5.0, 4.0))
    refused("identification.follows_nothing", work, InsufficientData)
    fit = identify(rig(), log, [gain], **given(2.5, 2.4))
    poor = [name for name, percent in fit.logs[0].fit_percent.items() if percent < 0.0]
    loud = fit.warnings[0]
    assert 0 < len(poor) < 3 and loud.key == "identification.does_not_follow"
    assert is_warning(loud)  # shown without -v
    assert (loud.fields["poor"], loud.fields["all"]) == (len(poor), 3)
    assert all(f"log: {name}" in loud.fields["worst"] for name in poor)


@pytest.mark.slow
@pytest.mark.parametrize("freed", [(), ("press.friction_static",)], ids=["held", "freed"])
def test_where_one_parameter_limits_another_the_fit_ends_at_the_limit(freed):
    """Break-away friction below the friction in motion makes no rig; the truth is above it."""
    slide = rig("slide_servo")
    own = slide.cylinder[0].model_copy(update={"friction_coulomb": Value(900.0, "N")})
    log = logged(slide.model_copy(update={"cylinder": (own,)}), "press.servo", (3.0, -3.0))
    table = Stribeck(law="stribeck", friction_static="520 N", stribeck_speed="20 mm/s")
    more = {"friction": table, "friction_coulomb": Value(300.0, "N", upper=5000.0)}
    built = slide.model_copy(update={"cylinder": (own.model_copy(update=more),)})
    names = ["press.friction_coulomb", "press.friction_viscous", *freed]
    fit = identify(built, [("log", log)], names, start={"press.friction_viscous": 100.0})
    fit.rig.refuse_misfits()
    coulomb = fit.parameters[0]
    if freed:
        assert coulomb.value == pytest.approx(900.0, rel=0.05)
        return
    assert coulomb.status == "at_bound" and 519.0 < coulomb.value <= 520.0
    (note,) = [text for text in fit.warnings if text.key == "identification.at_limit"]
    assert "friction_static: must not lie below friction_coulomb" in note.fields["reason"]


@pytest.mark.parametrize(("modulus", "odd"), [("30 MPa", True), ("300 MPa", False)])
def test_an_oil_that_no_machine_has_is_named(modulus, odd):
    known = shipped("slide_servo")
    oil = known.oil.model_copy(update={"bulk_modulus": Value(1e6 * float(modulus[:-4]), "MPa")})
    log = logged(known.model_copy(update={"oil": oil}), "press.servo", (3.0, -3.0), samples=701)
    fit = identify(
        known,
        [("log", log)],
        ["bulk_modulus"],
        start={"bulk_modulus": 1e8},
        lower={"bulk_modulus": 1e7},
    )
    assert fit["bulk_modulus"].value == pytest.approx(float(modulus[:-4]) * 1e6, rel=0.02)
    notes = [note.fields for note in fit.warnings if note.key == "identification.unusual"]
    assert [note["name"] for note in notes] == ["bulk_modulus"] * odd


def test_a_turned_sensor_is_named():
    """One of three channels with its sign turned: the fit goes by the other two, and says so."""
    other = changed(crane(), lift_qd=-crane()["lift.qd"])
    for log, wrong in ((crane(), []), (other, ["lift.qd"])):
        warnings = identify(rig(), [("log", log)], CRANE).warnings
        turned = [text for text in warnings if getattr(text, "key", "").endswith("other_way")]
        assert [text.fields["channel"] for text in turned] == wrong


@pytest.mark.parametrize("word", ["q", "qd"])
def test_a_position_that_goes_against_its_commands_is_told_before_a_fit(word):
    """On the crane and on one whose pins turn it the other way."""
    log, channel = crane(), f"lift.{word}"
    turned = changed(log, **{f"lift_{word}": -log[channel]})
    pins = rig().cylinder[0].pins.model_copy(update={"sign": -1})
    cylinder = rig().cylinder[0].model_copy(update={"pins": pins})
    for own, good, bad in ((rig().cylinder[0], log, turned), (cylinder, turned, log)):
        model = Model.of(rig().model_copy(update={"cylinder": (own,)}))
        for record, count in ((good, 0), (bad, 1)):
            told = [one for one in preprocess("log", record, model)[1] if "extend lift" in one]
            assert len([one for one in told if one.startswith(channel + " ")]) == count, told
    still = changed(turned, lift_spool_command=0.0 * log.t)
    assert not any("extend lift" in one for one in preprocess("log", still, Model.of(rig()))[1])


def test_commands_outside_the_driver_are_refused():
    u = crane()["lift.spool.command"]
    over = changed(crane(), lift_spool_command=u + 7.0 * (crane().t > 0.2))
    says = r"log: lift.spool.command = 12 V at t = 0.201 s lies outside -10 to 10 V"
    refused(says, lambda: identify(rig(), [("log", over)], CRANE))
    noise = np.random.default_rng(1).uniform(-0.19, 0.19, u.size)  # 1 % of the range is 0.2 V
    assert taken(changed(crane(), lift_spool_command=np.where(u > 0, 10.0, u) + noise))[1] == ()


# --- time ---


@pytest.mark.parametrize(
    ("scale", "says"),
    [
        (1e3, r"1 s pass between samples.*is the time in ms\?"),
        (60.0, r"0.06 s pass between samples, .*at most 50 ms would do"),
        (1e-3, r"is the time in s"),
    ],
)
def test_time_in_another_unit_is_refused_at_once(scale, says):
    scaled = replace(crane(), t=crane().t * scale)
    refused(says, lambda: identify(rig(), [("log", scaled)], CRANE))


def test_a_gap_is_named(tmp_path):
    gap = crane().at(np.delete(np.arange(1501), np.arange(700, 708)))
    says = r"log: not evenly sampled: 9 ms pass after t = 0.699 s, 1 ms elsewhere"
    refused(says, lambda: identify(rig(), [("log", gap)], CRANE), LogError)
    assert "9 ms pass after t = 0.699 s" in judged(rig(), [("log", gap)]).logs[0].failure
    write_log(tmp_path / "gap.mcap", gap)
    found = inspection.check(tmp_path / "gap.mcap")
    assert found.code == 3 and any("9 ms after t = 0.699 s" in line for line in found.lines)


def test_jitter_is_resampled_and_told(tmp_path):
    """Samples up to a quarter of a tick early or late come back on the grid."""
    volts = np.repeat(steps(601, 5.0, -4.5), 20)[:12001]
    fine = simulate(rig(), {"lift.spool": volts}, 0.6, rate=20000.0)
    at = 20 * np.arange(601) + np.random.default_rng(3).integers(-5, 6, 601)
    at[[0, -1]] = 0, 12000
    late = Record(
        fine.t[at],
        {n: v[::20] if n.endswith("command") else v[at] for n, v in fine.channels.items()},
        fine.meta,
    )
    even, told = evened("log", late)
    assert np.allclose(np.diff(even.t), 1e-3, rtol=1e-9)
    assert len(told) == 1 and "resampled to 1000 Hz" in told[0]
    on_grid = {n: v[::20] for n, v in fine.channels.items()}
    for name in ("lift.q", "lift.p_head"):
        error, unmended = (np.abs(v - on_grid[name]).max() for v in (even[name], late[name]))
        assert error < 0.2 * unmended, name
    assert np.array_equal(even["lift.spool.command"], on_grid["lift.spool.command"])
    fit = identify(rig(), [("log", late)], CRANE)
    assert "log: " + told[0] in fit.warnings
    write_log(tmp_path / "late.mcap", late)
    found = inspection.check(tmp_path / "late.mcap")
    assert found.code == 0 and told[0] in map(str.strip, found.lines)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_samples_are_counted(count):
    short = [("log", crane().at(slice(count)))]
    for work in (lambda: identify(rig(), short, CRANE), lambda: validate_rig(rig(), short)):
        error = refused("preprocessing.few_samples", work)
        assert error.message.fields["count"] == count


# --- sensors and starts ---


@pytest.mark.parametrize("start", [0, 300])
@pytest.mark.parametrize("word", ["x", "q", "v", "qd", "p_head", "p_rod"])
def test_a_stuck_sensor_is_told(word, start):
    log, name = crane(), f"lift.{word}"
    stuck = np.where(np.arange(1501) < start, log[name], log[name][start])
    notes = taken(changed(log, **{f"lift_{word}": stuck}))[1]
    (note,) = (note for note in notes if note.key == "preprocessing.constant")
    assert note.fields["channel"] == name and note.fields["time"] == log.t[start]


def test_a_sensor_that_stands_with_its_cylinder_is_not_stuck():
    log = crane()
    rest = np.full(600, -1)  # which moves no more
    still = {name: np.concatenate([y, y[rest]]) for name, y in log.channels.items()}
    still = replace(log, t=log.t[1] * np.arange(2101), channels=still)
    assert not [note for note in taken(still)[1] if note.key == "preprocessing.constant"]


@pytest.mark.parametrize(("level", "count"), [(0.0, 1), (3e5, 0)])
def test_a_dead_sensor_of_the_tank_is_told(level, count):
    """The tank of the rig stands at 3 bar, which a log may state."""
    log = crane()
    dead = replace(log, channels=log.channels | {"p_tank": np.full(log.t.size, level)})
    notes = [note for note in taken(dead)[1] if note.key == "preprocessing.constant"]
    assert len(notes) == count
    assert all(note.fields["channel"] == "p_tank" for note in notes)
    still = {name: np.full(log.t.size, y[0]) for name, y in dead.channels.items()}
    assert not any(
        note.key == "preprocessing.constant" for note in taken(replace(log, channels=still))[1]
    )


@pytest.mark.parametrize("word, key", [("p_rod", "constant"), ("qd", "stands_still_pushed")])
def test_a_dead_sensor_is_told_of_a_log_without_positions(word, key):
    dead = changed(crane(), **{f"lift_{word}": np.zeros(1501)})
    known = ("lift.p_head", "lift.p_rod", "lift.spool.command", f"lift.{word}")
    alone = replace(dead, channels={name: dead[name] for name in known})
    assert [note.key for note in taken(alone)[1]] == [f"preprocessing.{key}"]


def test_an_angle_that_stands_still_is_told_whatever_else_was_recorded():
    """Dithering by one count; and with nothing beside it but the pressures. At rest it may."""
    log, rng = crane(), np.random.default_rng(1)
    count = 2e-5 * rng.integers(0, 2, log.t.size)
    stuck = changed(log, lift_q=log["lift.q"][0] + count)
    assert "lift.q stands still while lift moves: is the sensor stuck?" in taken(stuck)[1]
    kept = {c: y for c, y in stuck.channels.items() if c not in ("lift.x", "lift.v", "lift.qd")}
    (said,) = taken(replace(stuck, channels=kept))[1]
    assert said.startswith("lift.q stands still while command and pressures of lift move")
    first = int(np.argmax(np.diff(log["lift.spool.command"]) != 0.0))
    rest = {c: y[:first] for c, y in kept.items()}
    assert not taken(replace(stuck, t=log.t[:first], channels=rest))[1]


def test_a_cylinder_that_stands_still_has_no_stuck_sensor():
    still = {
        n: v if n.endswith("command") else np.full(v.size, v[0])
        for n, v in crane().channels.items()
        if not n.endswith(("qd", "v"))
    }
    assert taken(replace(crane(), channels=still))[1] == ()


def test_a_log_that_begins_in_motion_is_told():
    on = "lift.spool.command is already on at the first sample (5 V)"
    for first, said in ((200, [on, "lift already moves at the first sample"]), (50, [])):
        told = taken(crane().at(slice(first, None)))[1]
        assert len(told) == len(said), told
        assert all(any(text.startswith(start) for text in told) for start in said), told


# --- recipes ---

HEAD = 'stage = "identify"\nwhat = "hydraulics"\nrig = "r.toml"\ndata = ["a.mcap"]\n'
HEAD += 'parameters = ["bulk_modulus", "arm.joint_damping"]\n'


@pytest.mark.parametrize("key", ["arm.joint_damping", '"arm.joint_damping"'])
def test_dotted_keys_do_with_or_without_quotes(tmp_path, key):
    (tmp_path / "h.toml").write_text(
        HEAD + f'[start]\nbulk_modulus = "1 GPa"\n{key} = "700 N*m*s/rad"\n'
        f'[upper]\n{key} = "9 kN*m*s/rad"\n'
    )
    recipe = load_recipe(tmp_path / "h.toml")
    assert recipe.start == {"bulk_modulus": "1 GPa", "arm.joint_damping": "700 N*m*s/rad"}
    assert recipe.upper == {"arm.joint_damping": "9 kN*m*s/rad"}
    lines = [recipe.at(table, "arm.joint_damping")["line"] for table in ("start", "upper")]
    assert lines == [8, 10]


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ('[start]\narm.joint_damping = "700 kPa"', 7, "cannot be turned into"),
        ('[start]\nbulk_modulus = "90 GPa"', 7, "outside 0.001 to 10 GPa"),
        ('[start]\nbulk_modulus = "3 GPa"', 7, "outside its bounds"),
        ('[lower]\n"arm.joint_dampin" = "1 N*m*s/rad"', 7, "nearest is 'arm.joint_damping'"),
        ('[upper]\n"arm.mass" = "900 kg"', 7, "not among the parameters to fit"),
    ],
)
def test_bad_starts_and_bounds_say_file_and_line(tmp_path, text, line, says):
    (tmp_path / "h.toml").write_text(HEAD + text + "\n")
    recipe = load_recipe(tmp_path / "h.toml")
    tables = {"start": recipe.start, "lower": recipe.lower, "upper": recipe.upper}
    log = [("log", crane())]
    work = lambda: identify(rig(), log, recipe.parameters, **tables, where=recipe.at)
    error = refused(says, work)
    assert (error.file, error.line) == (str(recipe.path), line)


def test_unknown_parameters_and_payloads_say_file_and_line(tmp_path):
    (tmp_path / "h.toml").write_text(HEAD.replace("arm.joint_damping", "arm.joint_dampin"))
    recipe = load_recipe(tmp_path / "h.toml")
    at = {"where": recipe.at}
    heavy, log = [("log", replace(crane(), meta={"payload": "300 kg"}))], [("log", crane())]
    wrong = "log: rig 'crane_proportional' has no payload '300 kg'"
    near = "nearest is 'arm.joint_damping'"
    for line, says, work in (
        (5, near, lambda: identify(rig(), log, recipe.parameters, **at)),
        (4, rf"{wrong} \(it has 200 kg\)", lambda: identify(rig(), heavy, CRANE, **at)),
        (4, wrong, lambda: models_of(rig(), heavy, (), None, **at)),
    ):
        assert refused(says, work).line == line


def test_a_cutoff_above_half_the_rate_is_refused():
    work = lambda: identify(rig(), [("log", crane())], CRANE, cutoff=500.0)
    assert refused("identification.high_cutoff", work).fields["half"] == pytest.approx(500.0)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (
            'kind = "multisine", frequency = "20 Hz", frequency_max = "20 Hz"',
            "frequency_max, 20 Hz, must lie above frequency, 20 Hz",
        ),
        ('kind = "sine", frequency = "0 Hz"', "'frequency' must be above 0 Hz"),
        (
            'kind = "sine", frequency = "100 Hz"',
            "frequency, 100 Hz, must lie below half the rate, 100 Hz",
        ),
        (
            'kind = "multisine", frequency = "2 Hz", frequency_max = "150 Hz"',
            "frequency_max, 150 Hz, must lie below half the rate, 100 Hz",
        ),
    ],
)
def test_sines_that_samples_cannot_hold_are_refused(tmp_path, command, says):
    path = tmp_path / "t.toml"
    head = 'stage = "trial"\nrig = "r.toml"\nduration = "1 s"\nrate = "200 Hz"\n'
    text = head + 'command = [{ valve = "lift.spool", amplitude = "1 V", <command> }]\n'
    path.write_text(text.replace("<command>", command))
    with pytest.raises(InputError, match=says):
        load_recipe(path)
    path.write_text(text.replace("<command>", 'kind = "sine", frequency = "99 Hz"'))
    assert float(load_recipe(path).command[0].frequency) == pytest.approx(99.0)


def test_the_lower_limit_of_the_meter_goes_from_the_recipe_to_the_fit(undrawn, tmp_path):
    """A turbine still below 1 L/min shifts no deadband, by the recipe or by its zeros."""
    gain, deadband, limit = 2.2 / 6e4 / 1e3, 1.0, 1.0 / 6e4  # the rig file's `sh`
    rows = ["valve,direction,command [V],pressure_drop [kPa],flow [L/min],trial"]
    rng = np.random.default_rng(5)
    for trial in (1, 2, 3):
        for u in (0.6, 1.2, 1.4, 1.7, 2.0, 3.0, 4.5, 6.0, 8.0):
            for drop in (0.5e6, 1e6, 2e6, 4e6, 8e6):
                noise = 1.0 + 0.005 * rng.standard_normal()
                flow = gain * max(u - deadband, 0.0) * np.sqrt(drop) * noise
                shown = 6e4 * flow if flow >= limit else 0.0
                rows.append(f"sh,forward,{u},{drop / 1e3},{shown:.5f},{trial}")
    (tmp_path / "sh.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "rig.toml").write_text((RIGS / "boom_four_valve.toml").read_text())
    head = 'stage = "identify"\nwhat = "flow_map"\nrig = "rig.toml"\ndata = ["sh.csv"]\n'
    found = {}
    for name, line in (("blind", ""), ("told", 'meter_limit = "1 L/min"\n')):
        (tmp_path / f"{name}.toml").write_text(head + line)
        session = workflow.Session(out=tmp_path / f"run_{name}")
        (found[name],) = workflow.run(tmp_path / f"{name}.toml", session).json("summary")
    for item in found.values():
        assert abs(item["deadband"] - deadband) < 3.0 * item["deadband_std"] < 0.3
    (tmp_path / "told.toml").write_text(head + 'meter_limit = "4 bar"\n')
    says = r"told.toml:5: meter_limit: 'bar' cannot be turned into m\^3/s"
    with pytest.raises(InputError, match=says):
        load_recipe(tmp_path / "told.toml")


VERDICT = 'stage = "validate"\nrig = "r.toml"\ndata = ["a.mcap"]\n[thresholds]\n'


def test_a_threshold_of_the_ringing_can_be_switched_off(tmp_path):
    stiffer = rig().with_values({"bulk_modulus": 1.1 * float(rig().parameters()["bulk_modulus"])})

    def checks(text):
        (tmp_path / "v.toml").write_text(VERDICT + "fit_percent = { p_head = 1 }\n" + text)
        limits = load_recipe(tmp_path / "v.toml").thresholds
        result = judged(stiffer, [("log", crane())], thresholds=limits)
        return [check.what for check in result.logs[0].checks]

    keys = ("natural_frequency_error", "damping_ratio_error")
    words = ("lift natural frequency", "lift damping ratio")
    for levels, there in ((("0.5", "false"), words[:1]), (("false", "0.5"), words[1:])):
        said = checks("".join(f"{key} = {x}\n" for key, x in zip(keys, levels, strict=True)))
        assert [word for word in words if word in said] == list(there)
    plain = checks("")
    assert words[0] in plain and words[1] not in plain


@pytest.mark.parametrize(
    ("raw", "says"),
    [("true", "or false for no limit"), ("0", "greater than 0"), ('"15 %"', "valid number")],
)
def test_a_share_that_is_none_is_refused_with_its_line(tmp_path, raw, says):
    (tmp_path / "v.toml").write_text(VERDICT + f"natural_frequency_error = {raw}\n")
    with pytest.raises(InputError, match=says) as caught:
        load_recipe(tmp_path / "v.toml")
    assert caught.value.line == 5


def test_a_stroke_outside_of_the_cylinder_is_told_with_what_it_lacks():
    slide = shipped("slide_servo")
    x = np.linspace(0.15, 0.2, 50)

    def said(values: np.ndarray) -> str:
        return " ".join(outside_stroke(Record(0.001 * np.arange(50), {"press.x": values}), slide))

    assert said(x) == ""
    assert "runs from -200 to -150 mm, and the stroke from 0 to 400 mm" in said(-x)
    assert "counted the other way? Write sign = -1" in said(-x)
    assert "from where is it counted" in said(x + 1.0)
    past = said(np.append(x[:-5], np.full(5, 0.42)))  # at its end, by a longer stroke
    assert "runs from 150 to 420 mm" in past and "is the stroke another?" in past
    assert said(np.append(x[:-5], np.full(5, 0.407))) == ""


@pytest.mark.parametrize(
    ("shift", "scale", "says"),
    [
        *[(0.0, 57.3, "preprocessing.angle_degrees"), (0.48, -1.0, "preprocessing.angle_turned")],
        (50.0, 1.0, "preprocessing.angle_shifted"),
        (2.0 * np.pi, 1.0, "preprocessing.angle_wound"),
    ],
)
def test_angles_that_the_stroke_does_not_allow_are_refused(shift, scale, says):
    log = changed(crane(), lift_q=scale * (crane()["lift.q"] + shift))
    refused(says, lambda: preprocess("log", log, Model.of(rig())), LogError)


@pytest.mark.parametrize(
    ("scale", "offset", "other"),
    [
        *[(0.01745, 0.0, ["unit"]), (0.1, 0.0, ["unit"]), (0.4, 0.0, ["scale"])],
        *[(0.99, 0.0, ["scale"]), (0.998, 0.0, []), (1.0, 0.01, [])],
    ],
)
def test_a_position_and_its_rate_are_of_like_units_and_scales(scale, offset, other):
    """Angles in radians that are labelled deg; a rate whose sensor drifts is let be."""
    whole, model = crane(), Model.of(rig())
    middle = float(np.mean(whole["lift.q"]))
    log = changed(whole, lift_q=middle + scale * (whole["lift.q"] - middle))
    log = changed(log, lift_qd=whole["lift.qd"] + offset)
    notes = [note for note in notes_on_channels(log, model) if "rate_of_another" in note.key]
    assert [note.key.rpartition("_")[2] for note in notes] == other
    assert [note.fields["ratio"] for note in notes] == pytest.approx([scale] * len(other), rel=0.02)


@pytest.mark.parametrize(("late", "key"), [(0, ""), (250, "sensors_late"), (-250, "commands_late")])
def test_sensors_or_commands_of_another_clock_are_told_by_the_motion(late, key):
    """Before that, they looked like sensors with turned signs."""
    log, model = crane(), Model.of(rig())
    at = np.arange(log.t.size) - late
    moved = {
        name: y if name.endswith("command") else y[np.clip(at, 0, y.size - 1)]
        for name, y in log.channels.items()
    }
    notes = [*notes_on_channels(replace(log, channels=moved), model)]
    assert [note.key for note in notes] == [f"preprocessing.{key}"] * bool(key)
    assert all(abs(note.fields["ms"] - 250.0) < 60.0 for note in notes)


def test_a_clock_that_is_off_is_as_likely_as_a_scale():
    log, model = crane(), Model.of(rig())
    notes = [*notes_on_channels(replace(log, t=1.01 * log.t), model)]
    notes = [note for note in notes if note.key == "preprocessing.rate_of_another_scale"]
    assert [note.fields["place"] for note in notes] == ["lift.q", "lift.x"]
    assert [note.fields["ratio"] for note in notes] == pytest.approx(2 * [1.0 / 1.01], rel=1e-3)
