"""What residuals say of a model: built faults are named first or second, sound models cry at
nothing. `tools/studies/structure_study.py` has the long tables."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace as Stub
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from ehbench import diagnosis
from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis import Case, ask, recordings
from ehbench.diagnosis.faults import COMMANDS, DRIFT, LATE, SENSORS, TABLE, hypotheses, hypothesis
from ehbench.diagnosis.faults.hypothesis import Hypothesis, Number
from ehbench.diagnosis.faults.scales import Scales
from ehbench.diagnosis.recordings import followed
from ehbench.identification.fixed_numbers import counts_on
from ehbench.parts.fault import Amount
from ehbench.parts.fault import Fault as Row
from ehbench.plant.model import Model
from ehbench.plant.ties import RECORDED, SUPPLY, TIED
from ehbench.preprocessing.observations import commanded
from ehbench.preprocessing.sensors import Term
from ehbench.signals.series import correlation_time
from ehbench.validation import validate_rig
from ehbench.vocabulary.errors import EhbenchError
from tests.shared import RIGS, shipped, slide
from tools.studies.structure_study import Fault, asked, faults, log_of
from tools.virtual_logs import clean_log, noisy, virtual_log

QUICK = {"kinds": ("quick steps",), "seconds": 1.2}  # a step out and a step back


ALL_FAULTS = (*TABLE.values(), SENSORS, COMMANDS, (LATE, DRIFT))
# beside those of the slide that `test_suggestions` cures
BUILT = {
    "slide_servo": ("damping", "sensor sign"),
    "crane_proportional": ("gain", "deadband", "load"),
    "boom_four_valve": ("bulk modulus", "leakage", "saturation", "sensor offset"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [(n, k) for n, kinds in BUILT.items() for k in kinds])
def test_a_built_fault_is_named_first_or_second(name, kind):
    rig = shipped(name)
    fault = next(one for one in faults(name, rig) if one.kind == kind)
    # what limits all valves alike is told from other laws by a sweep
    more = {"kinds": ("quick steps", "chirp")} if kind == "saturation" else {}
    found = asked(name, rig, fault, 7, **QUICK | more)
    assert fault.named(found), found.findings
    first = found.findings[0]
    assert first.explains > 0.7 and first.remedy and first.sentence
    assert found.follows, "and its residuals follow something"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "size"),
    [
        ("slide_servo", "through rod", 1.0),
        ("slide_servo", "load sensing", 0.15),
        ("slide_servo", "overlap", -0.02),
        ("slide_servo", "area", -0.03),
        ("slide_servo", "load", 0.12),
        ("crane_proportional", "linkage", 0.04),
    ],
)
def test_what_a_rig_file_has_wrong_or_lacks_is_named_first(name, kind, size):
    rig, kinds = shipped(name), ("quick steps",)
    sound = clean_log(name, rig, *kinds, 1.2)
    rows = hypotheses(rig, [rig.cylinder[0].name], [], [sound])
    row = next(row for row in rows if row.kind == kind)
    found = asked(name, rig, Fault(kind, "", row.rig(rig, size)), 7, kinds, 1.2).findings
    first = next(item for item in found if item.kind != "pins")  # which stroke and angle tell
    assert (first.kind, first.about) == (kind, row.about)
    assert first.size == pytest.approx(size, rel=0.1)


def leaking_press(leakage: float = 6.0e-12):
    """The slide, with a heavier load and a piston seal that leaks [m³/(s·Pa)]."""
    rig = shipped("slide_servo")
    return rig.with_values({"press.leakage_internal": leakage, "carriage.mass": 400.0})


def test_the_exact_model_of_a_leaking_rig_has_no_findings():
    """Pressures fall at standstill, so that their mean is not the initial state."""
    excess = 4.0e5
    rig = leaking_press(2.0e-11)
    model = Model.of(rig)
    log = clean_log("slide_servo", rig, "ramps", duration=2.0)
    rest, row = model.rest_start(log), model.plant.cylinders[0]
    y = rest.y.copy()
    y[model.layout.state("p_head", 0)] += excess
    y[model.layout.state("p_rod", 0)] += excess * row.area_head / row.area_rod
    log = noisy(model.replay(log, start=rest._replace(y=y)), 31)
    assert ask([Case("log", log, model, commanded(model, log))]).findings == ()


STRIBECK = {"friction_static": "300 N", "stribeck_speed": "20 mm/s"}
LAWS = {
    "stribeck": STRIBECK,
    "directional": {"friction_retracting": "180 N"},
    "lugre": STRIBECK | {"bristle_stiffness": "1e6 N/m"},
}
SPRING = {"kind": "spring", "stiffness": "20 N/mm", "free_length": "150 mm"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "number", "factor"),
    [
        ("stribeck", "friction_static", 1.5),
        ("stribeck", "stribeck_speed", 1.5),
        ("lugre", "bristle_stiffness", 1.5),
        ("directional", "friction_retracting", 1.5),
        (None, "force.stiffness", 1.2),
        (None, "force.free_length", 1.2),
    ],
)
def test_a_number_of_a_friction_law_or_of_an_outer_spring_is_named(law, number, factor):
    if law is None:
        rig = slide(force=[SPRING])
    else:
        rig = slide(friction_coulomb="120 N", friction={"law": law} | LAWS[law])
    name = f"press.{number}"
    wrong = rig.with_values({name: factor * float(rig.parameters()[name])})
    log = virtual_log("slide_servo", rig, "steps", 5, duration=1.6, share=0.3)
    for model, expected in ((Model.of(rig), []), (Model.of(wrong), [name])):
        results = ask([Case("log", log, model, commanded(model, log))]).findings
        assert [item.about for item in results[:1]] == expected, results


def test_a_constant_force_that_nobody_wrote_down_is_named():
    """With its size in the line for the rig file."""
    log = virtual_log(
        "slide_servo",
        slide(force=[{"kind": "constant", "force": "-300 N"}]),
        "steps",
        5,
        duration=2.0,
        share=0.3,
    )
    model = Model.of(shipped("slide_servo"))
    first, *_ = ask([Case("log", log, model, commanded(model, log))]).findings
    assert (first.kind, first.about) == ("outer force", "press")
    size = re.search(r'force = \[\{ kind = "constant", force = "(.*) N" \}\]', first.remedy)
    assert size is not None and float(size[1]) == pytest.approx(-300.0, abs=20.0)


@pytest.mark.slow
def test_a_cause_of_most_of_the_residual_is_a_reservation():
    """The model follows the log well enough for every threshold, and is wrong."""
    rig = leaking_press()
    log = virtual_log("slide_servo", rig, "quick steps", 5, duration=1.5)
    assert validate_rig(rig, [("log", log)]).verdict == "accepted"
    name = "carriage.damping"
    wrong = rig.with_values({name: 2.0 * float(rig.parameters()[name])})
    verdict = validate_rig(wrong, [("log", log)])
    assert verdict.verdict == "accepted with reservation"
    (reservation,) = verdict.reservations
    assert name in reservation


def test_size_and_remedy_of_a_gain():
    rig = shipped("slide_servo")
    fault = next(item for item in faults("slide_servo", rig) if item.words == "one gain 8 % down")
    first = asked("slide_servo", rig, fault, 3, **QUICK).findings[0]
    assert first.about == "press.servo_supply_head" and first.size == pytest.approx(-0.08, abs=0.01)
    assert first.sentence.key == "faults.gain_less" and first.remedy.key == "faults.free"
    assert first.remedy.fields["quoted"] == '"press.servo_supply_head.flow_gain"'


def rows_of(rig, kind):
    """The rows of a kind for the slide's logs."""
    log = clean_log("slide_servo", shipped("slide_servo"), "steps", duration=1.0)
    rows = hypotheses(rig, ["press"], ["press.v", "press.p_head"], [log])
    return [row for row in rows if row.kind == kind]


def test_a_leakage_far_beyond_its_slope_is_found_at_its_size():
    """By the slope it is a tenth of it; leakage to the outside is asked after that past a seal."""
    rig = leaking_press(2.0e-11)
    model = Model.of(rig.with_values({"press.leakage_internal": 0.0}))
    log = virtual_log("slide_servo", rig, "steps", 5, duration=2.0)
    first = ask([Case("log", log, model, commanded(model, log))]).findings[0]
    assert first.about == "press.leakage_internal"
    unit = 0.01 / 1.4e7 * np.pi / 4 * 0.05**2
    assert first.size * unit == pytest.approx(2.0e-11, rel=0.02)
    ranks = {row.parameters[0]: row.rank for row in rows_of(rig, "leakage")}
    assert ranks["press.leakage_internal"] < min(
        ranks[f"press.leakage_{side}"] for side in ("head", "rod")
    )


def test_a_tank_pressure_that_no_log_has_comes_before_a_preload_that_explains_the_same():
    rig = shipped("slide_servo")
    log = virtual_log(
        "slide_servo", rig.with_values({"supply.tank_pressure": 4e5}), "steps", 5, 2.0
    )
    bare = {name: y for name, y in log.channels.items() if name != "p_tank"}
    log = replace(log, channels=bare)
    model = Model.of(rig)
    first, second = ask([Case("log", log, model, commanded(model, log))]).findings[:2]
    assert first.kind == "tank" and second.kind == "preload"
    assert first.explains > 0.9 and first.size * 1.4e7 == pytest.approx(2e5, rel=0.02)
    assert first.remedy.fields["quoted"] == '"supply.tank_pressure"'


def test_remedies_of_what_was_fitted_and_of_a_late_command():
    rig = shipped("slide_servo")
    names = [name for name in rig.parameters() if name.endswith("flow_gain")]
    fitted = rig.with_values({n: replace(rig.parameters()[n], sure="identified") for n in names})
    for given, key in ((rig, "faults.free"), (fitted, "faults.fitted")):
        rows = rows_of(given, "gain")
        assert {row.remedy(given, 0.1).key for row in rows} == {key}
        assert [rows[0].sentence(given, by).key for by in (0.1, -0.1)] == [
            "faults.gain_more",
            "faults.gain_less",
        ]
    fields, gain = rows[0]._fields(rig, -0.1), float(rig.parameters()[rows[0].parameters[0]])
    shares = {"percent": 10.0, "rest": 90.0, "ms": 100.0, "volts": 0.0}
    assert {key: fields[key] for key in shares} == pytest.approx(shares)
    shown = [rig.shown(rows[0].parameters[0], share * gain, 3) for share in (0.1, 0.9)]
    assert [fields["by"], fields["value"]] == shown
    fields = rows[0]._fields(rig, 0.002)  # which three digits would not show
    assert fields["value"] == rig.shown(rows[0].parameters[0], 1.002 * gain, 4)
    assert fields["value"] != rig.shown(rows[0].parameters[0], gain, 4)
    (delay,) = rows_of(rig, "delay")
    assert delay.remedy(rig, 0.01).key == "faults.free_sensor"
    (late,) = rows_of(rig, "late command")
    assert delay.bounds[0] == late.bounds[1] == 0.0  # one is for either sign
    assert late.remedy(rig, -0.01).key == "faults.written_late"
    assert late.remedy(rig, -0.01).fields["ms"] == pytest.approx(10.0)
    assert late.sentence(rig, -0.01).fields["channels"] == "press.servo.command"


def test_a_delay_that_the_rig_file_has_is_to_be_freed():
    tables = shipped("slide_servo").as_toml()
    tables["dynamics"]["bus"] = {"kind": "delay", "delay": "1 ms"}
    press = dict(tables["cylinder"][0])
    press["valve"] = [{**press["valve"][0], "dynamics": ["spool", "bus"]}]
    rig = Rig.model_validate({**tables, "cylinder": [press]})
    (row,) = rows_of(rig, "delay")
    assert row.parameters == ("bus.delay",) and row.remedy(rig, 0.01).key == "faults.free"
    assert row.bounds[0] == pytest.approx(-0.001)
    assert row.sentence(rig, -0.001).key == "faults.delay_less"


@pytest.mark.parametrize(
    ("kind", "name", "delta", "value"),
    [
        ("leakage", "press.leakage_internal", 0.5, 0.5 * 0.01 / 1.4e7 * np.pi / 4 * 0.05**2),
        ("area", "press.bore", 0.005, 0.05 * 1.005),
        ("friction law", "press.friction_static", 0.1, 0.1 * 1.4e7 * np.pi / 4 * 0.05**2),
        ("load", "carriage.mass", -0.1, 225.0),
        ("preload", "press.servo_rod_tank.cracking_pressure", 0.1, 1.4e6),
        ("accumulator", "supply.gas_volume", 0.4, 0.4 * np.pi / 4 * 0.05**2 * 0.4),
        ("accumulator", "supply.precharge", 0.4, 0.7e7),
    ],
)
def test_a_row_moves_its_number(kind, name, delta, value):
    """Also one that is 0 or missing in the rig file."""
    rig = shipped("slide_servo")
    row = next(row for row in rows_of(rig, kind) if name in row.parameters)
    assert float(row.rig(rig, delta).parameters()[name]) == pytest.approx(value)
    assert float(row.altered(rig).parameters()[name]) >= 0.0


def test_stroke_and_angle_are_held_against_the_pins():
    rig = shipped("crane_proportional")
    log = log_of("crane_proportional", Fault("none", "", rig), "steps", 5)
    model = Model.of(rig)

    def found(record):
        return ask([Case("log", record, model, commanded(model, record))]).findings

    assert not any(one.kind == "pins" for one in found(log))
    off = replace(log, channels=log.channels | {"lift.x": log["lift.x"] + 0.0118})
    first = found(off)[0]
    assert first.kind == "pins" and "disagree with the pins by 1" in first.sentence
    assert first.size == pytest.approx(0.0118, abs=5e-4) and first.explains == 1.0


def test_only_what_is_scored_is_asked_and_a_log_without_motion_says_nothing():
    rig = shipped("slide_servo")
    fault = next(one for one in faults("slide_servo", rig) if one.kind == "sensor sign")
    log = log_of("slide_servo", fault, "steps", 5)
    model = Model.of(rig)
    case = Case("log", log, model, commanded(model, log))
    part = replace(case, scored=(1.0, 2.0))
    assert part.recorded["press.v"].size == pytest.approx(case.recorded["press.v"].size / 4, abs=2)
    assert ask([part]).findings[0].kind == "sensor sign"
    still = {name: np.full(log.t.shape, values[0]) for name, values in log.channels.items()}
    rest = replace(log, channels=still)
    assert commanded(model, rest) == ()
    assert ask([Case("rest", rest, model, ())]).findings == ()
    assert ask([]).findings == ()


def test_the_log_that_is_farthest_off_tells_of_pins(monkeypatch):
    monkeypatch.setattr(recordings, "off_pins", lambda record, model: record)
    model = Stub(rig=shipped("crane_proportional"))
    offs = ({"lift": 0.01}, {}, {"lift": -0.02}, {"lift": 0.015})
    logs: Any = [Stub(name=f"log {k}", record=off, model=model) for k, off in enumerate(offs)]
    ((name, sentence, _, off),) = recordings.disagreements(logs)
    assert (name, off) == ("lift", -0.02) and "of log 2 disagree with the pins by 20" in sentence


def test_cylinders_take_turns_and_one_thing_is_told_once(monkeypatch):
    """Four of each at most, after what stroke and angle say; what cannot be asked is left out."""
    given = {"a": "uvwxyz", "b": "qu"}
    names = {kind: diagnosis.Finding(kind, "it", "", "", 0.6, 1.0) for kind in "qtuvwxyz"}
    search = lambda group: Stub(findings=lambda: [names[k] for k in given[group[0][0].cylinders]])
    monkeypatch.setattr(diagnosis, "_Search", search)
    monkeypatch.setattr(diagnosis, "followed", lambda case, simulated: [case.name])
    off = lambda cases: [("a", "off", "look", 0.01)] if len(cases) == 3 else []
    monkeypatch.setattr(diagnosis, "disagreements", off)

    def case(name, owner, channels="p", error=None):
        simulated = Mock(side_effect=error)
        return Stub(name=name, cylinders=owner, channels=channels, simulated=simulated, left=str)

    failed = case("failed", "b", error=EhbenchError("no"))
    cases: Any = [case("1", "a"), failed, case("still", "b", ""), case("2", "b"), case("3", "a")]
    found = ask(cases)
    first, *others = found.findings
    assert [item.kind for item in others] == ["u", "q", "v", "w", "x"]
    assert first == diagnosis.Finding("pins", "a", "off", "look", 1.0, 0.01, 0.0)
    assert found.follows == ("1", "2", "3")


# --- the search for faults, in closed form

U, V, W = np.eye(3, 40)
WEAK, BOTH, FAR = (Hypothesis(Row(k, low=-9.0, high=9.0), k) for k in ("weak", "both", "far"))
BOUND = Hypothesis(Row("bound", low=-0.5, high=0.25), "bound")


def search_of(left, noise=0.0, count=1000.0) -> Any:
    """A search whose residuals are one vector; a finding is its fault, size and gain."""
    search: Any = object.__new__(diagnosis._Search)
    search.left, search.now = [left], float(left @ left)
    search.noise, search.count = noise, count
    search._finding = lambda *given: given
    return search


def test_a_fault_has_the_size_of_its_projection_within_its_bounds():
    search = search_of(3.0 * U + 2.0 * V)
    for fault, slope, size, promise in (
        (WEAK, [2.0 * U], -1.5, 9.0),
        (BOUND, [2.0 * U], -0.5, 13.0 - (4.0 + 4.0)),
        (BOUND, [-2.0 * U], 0.25, 13.0 - (6.25 + 4.0)),
        (WEAK, [W], 0.0, 0.0),
        (WEAK, [0.0 * U], 0.0, 0.0),
        (WEAK, None, 0.0, 0.0),
    ):
        assert search._size(fault, slope, search.left) == pytest.approx(size)
        assert search._promise(fault, slope, search.left) == pytest.approx((promise, size))


def test_a_gain_counts_by_the_noise_and_the_number_of_what_is_left():
    assert [search_of(U, 500.0, n)._counts(61.0, 1000.0) for n in (470.0, 490.0)] == [False, True]


def test_faults_of_a_search_have_a_slope_or_sizes_to_try(monkeypatch):
    """Of all cylinders and channels of its logs; the model has the payload as its load."""
    search, given = search_of(U), []
    rig, maps = Stub(), Stub()
    some = {"record": "log", "maps": maps, "model": Stub(rig=rig)}
    search.cases = [Stub(cylinders=c, channels=c * 2, **some) for c in ("ab", "bc")]
    rows = {
        name: Hypothesis(Row(name, step=step, trials=trials), name)
        for name, step, trials in (
            ("slope", 0.1, ()),
            ("back", -0.1, ()),
            ("payload", 0.1, ()),
            ("trials", 0.0, (1.0,)),
            ("neither", 0.0, ()),
        )
    }
    asked = lambda *about: given.extend(about) or [*rows.values()]
    monkeypatch.setattr(diagnosis, "hypotheses", asked)
    assert [item.about for item in search._faults()] == ["slope", "back", "trials"]
    assert given == [rig, [*"abc"], [*"abc"], ["log", "log"], maps]


def test_a_fault_is_run_along_the_logs_of_its_cylinder(monkeypatch):
    """What no rig has, what stops and what comes to nothing finite leaves nothing."""
    search = search_of(U)
    search.left = [U, V]

    def case(owner):
        def run_of(fault, delta):
            if fault.kind == "no rig":
                raise ValueError
            return fault.kind

        ends = lambda replayed, fault, delta: math.nan if replayed == "nan" else delta
        return Stub(cylinders=(owner,), run_of=run_of, seen=ends, left=lambda delta: delta * W)

    search.cases = [case("a"), case("b")]
    stops = lambda runs, step: [None if run == "stops" else run for run in runs]
    monkeypatch.setattr(diagnosis, "replay_many", stops)
    points = [(Hypothesis(Row("one"), "x", cylinder="b"), 2.0), (Hypothesis(Row("all"), "x"), 3.0)]
    points += [(Hypothesis(Row(kind), "x"), 1.0) for kind in ("no rig", "stops", "nan")]
    (one, every, *others) = search._at(points)
    np.testing.assert_array_equal(one, [U, 2.0 * W])
    np.testing.assert_array_equal(every, [3.0 * W, 3.0 * W])
    assert others == [None, None, None]


def test_beside_the_best_fault_stands_what_explains_most_of_the_rest():
    left = 10.0 * U + 9.0 * V + 12.0 * W
    search = search_of(left)
    slopes = {WEAK: [U], FAR: [W], BOTH: [V + W], BOUND: None}
    ((fault, size, gain),) = search._additional([], [left], slopes).values()
    assert fault is BOTH and size == -9.0  # its bound
    assert gain == pytest.approx(225.0 - (0.0 + 9.0))
    ((fault, _, gain),) = search._additional([BOTH], [left], slopes).values()
    assert fault is FAR and gain == pytest.approx(144.0 - 9.0)
    assert search._additional([BOTH, FAR], [8.0 * U + 20.0 * V], slopes) == {}  # a seventh
    assert search._additional([BOTH, FAR, WEAK], [left], slopes) == {}


def test_a_slope_is_a_difference_to_the_side_that_the_bounds_allow(monkeypatch):
    search = search_of(U)
    monkeypatch.setattr(search, "_at", lambda points: [[U + 3.0 * d * V] for _, d in points])
    below = Hypothesis(replace(BOUND.row, high=0.0), "below")
    slopes = search._slopes([WEAK, below, Hypothesis(replace(WEAK.row, step=0.0), "none")])
    assert slopes[WEAK][0] == pytest.approx(3.0 * V) and slopes[below][0] == pytest.approx(3.0 * V)
    assert list(slopes.values())[2] is None


def test_sizes_are_refined_to_both_sides(monkeypatch):
    """What is left bends: δ is best at 0.37, a little aside from where slopes say."""
    search = search_of(U)
    misses = lambda points: [[U * (0.1 + (delta - 0.37) ** 2)] for _, delta in points]
    monkeypatch.setattr(search, "_at", misses)
    for first, tried in ((0.5, 0.25), (0.25, 0.25), (0.45, 0.45)):
        best = search._best({WEAK: [-U / first]})[WEAK]
        assert best[0] == pytest.approx(tried)
        found = search._refined({WEAK: best})[WEAK]
        assert abs(found[0] - 0.37) < 0.51 * best[0] * 0.5**5 * 2.0
        assert found[1] == pytest.approx((0.1 + (found[0] - 0.37) ** 2) ** 2)


def test_a_hypothesis_knows_its_bounds_certainty_and_how_far_it_moves_what_was_identified():
    known = {"name": "bulk_modulus", "starts": (1.0,), "upper": 20.0}
    assumed = Number(here=10.0, unit=5.0, sure="assumed", **known)
    sure = Number(here=0.4, unit=0.2, sure="identified", std=0.05, **known)
    fixed = Number(here=0.0, unit=0.0, sure="assumed", **known)
    row = Row("gain", low=-3.0, high=4.0, step=0.02, rank=3)
    both, one = Hypothesis(row, "a", (assumed, sure)), Hypothesis(row, "a", (sure, fixed))
    assert both.bounds == one.bounds == (-2.0, 4.0) and both.rank == (0, 2)
    none = Hypothesis(row, "a")
    assert (none.bounds, none.certainty, none.starts) == ((-3.0, 4.0), 0, ({},))
    assert Hypothesis(row, "a", (sure,)).rank == (5, 3) and Hypothesis(row, "a").rank == (3, 3)
    assert Hypothesis(row, "a", (assumed,), edits=((("oil",), "", {}, {}),)).rank == (3, 3)
    assert (both.certainty, Hypothesis(row, "a", (sure, fixed)).certainty) == (0, 5)
    assert both.beyond(-0.3) == one.beyond(0.3) == pytest.approx(0.06 / (1.96 * 0.05), rel=1e-4)
    assert Hypothesis(row, "a", (assumed,)).beyond(1.0) == 0.0
    weighed, printed = replace(assumed, std=0.1), replace(sure, std=None)
    assert Hypothesis(row, "a", (weighed, printed)).beyond(1.0) == 0.0
    several = replace(assumed, name="supply.pressure", starts=(2.0, 3.0, 4.0))
    assert Hypothesis(row, "a", (sure, several)).starts == tuple(
        {"bulk_modulus": 1.0, "supply.pressure": value} for value in (2.0, 3.0, 4.0)
    )
    twice = Hypothesis(row, "a", (assumed, several))
    added = Hypothesis(row, "a", (assumed,), edits=((("oil",), "", {}, {}),))
    assert twice.parts([both, twice, one, added, none]) == [both, one]
    assert both.inside == Hypothesis(replace(row, high=0.02), "a").inside == 0.02
    assert Hypothesis(replace(row, step=-3.0), "a").inside == -3.0
    assert Hypothesis(replace(row, high=0.01), "a").inside == -0.02
    assert sure.at(-3.0) == 0.0 and assumed.begin(4.0) == 18.0  # 0.9 of where a search ends


@pytest.mark.parametrize("row", {id(r): r for rows in ALL_FAULTS for r in rows}.values())
def test_steps_and_trials_of_a_fault_are_within_its_bounds(row):
    assert row.low <= 0.0 <= row.high and row.low < row.high
    assert row.low <= row.step <= row.high or row.low <= -row.step <= row.high
    assert all(row.low <= delta <= row.high and delta != 0.0 for delta in row.trials)


def test_what_is_asked_of_a_case_is_what_moves():
    """A rate, or the rate of a position; both pressures, those that stand still left out."""
    t = np.arange(400) * 1e-3
    moves, still = np.sin(20.0 * t), 0.0 * t + 1.0
    model = Model.of(shipped("slide_servo"))

    def asked_of(**channels):
        record = Record(t, {f"press.{name}": y for name, y in channels.items()})
        return Case("log", record, model, ("press",)).channels

    assert asked_of(v=moves, p_head=moves, p_rod=still) == ("press.v", "press.p_head")
    assert asked_of(v=still, p_head=still, p_rod=moves) == ("press.p_rod",)
    assert asked_of(x=moves, p_head=still, p_rod=still) == ("press.v",)
    assert asked_of(x=still, p_head=still) == ()
    assert asked_of(v=moves, qd=moves, p_head=moves) == ("press.v", "press.p_head")
    assert asked_of(x=moves, load_pressure=moves) == ("press.v", "press.load_pressure")
    assert asked_of(v=moves, load_pressure=moves, p_head=moves) == ("press.v", "press.p_head")
    for meta, seen in (
        ({}, ("press.v", "p_supply")),
        ({SUPPLY: RECORDED}, ("press.v",)),
        ({TIED: "motion"}, ("p_supply",)),
    ):
        record = Record(t, {"press.v": moves, "p_supply": moves}, meta)
        assert Case("log", record, model, ("press",)).channels == seen


def test_an_error_of_the_supplys_pressure_is_measured_by_its_level():
    """A ripple of 0.1 bar on 100 bar does not matter: 3 % of it are 3 bar."""
    t = np.arange(400) * 1e-3
    moves = np.sin(20.0 * t)
    record = Record(t, {"press.v": moves, "p_supply": 1e7 + 1e4 * moves})
    case = Case("log", record, Model.of(shipped("slide_servo")), ("press",))
    assert case.scales["p_supply"] == pytest.approx(3e5, rel=1e-3)
    assert case.scales["press.v"] == pytest.approx(5e-3 * np.std(moves), rel=0.01)


def test_rows_of_the_supply_are_those_that_a_replay_shows():
    """A log gives its replay the pressures that it has, or all of the supply's line."""
    t = np.arange(100) * 1e-3
    channels = {"press.servo.command": np.where(t < 0.05, 0.0, 5.0)}

    def kinds(meta, *more):
        log = Record(t, channels | {name: 1e7 + 0.0 * t for name in more}, meta)
        rows = hypotheses(shipped("slide_servo"), ["press"], ["p_supply"], [log])
        of_supply = {row.kind for row in rows if row.about == "the supply"}
        (offset, *_) = [row.cylinder for row in rows if row.about == "p_supply"] or ["-"]
        return of_supply, offset

    line = {"pump", "supply line", "accumulator", "load sensing"}
    assert kinds({}) == ({"supply", "tank", *line}, "-")
    assert kinds({}, "p_supply") == ({"tank", *line}, "")  # its sensor concerns all cylinders
    assert kinds({}, "p_supply", "p_tank") == (line, "")
    assert kinds({SUPPLY: RECORDED}, "p_supply") == (set(), "")


def test_the_oils_spring_and_what_a_bulk_modulus_counts_on():
    """K = Σ β A²/V, by hand; a bulk modulus that keeps K while the dead volumes grow by 1 %."""
    rig = shipped("slide_servo")
    (item,) = rig.cylinder
    (head, rod), half = item.areas(), 0.5 * float(item.stroke)
    volumes = np.array([float(item.volume_head), float(item.volume_rod)])
    areas, signs = np.array([head, rod]), np.array([1.0, -1.0])

    def stiffness(x, factor=1.0):
        return float(np.sum(areas**2 / (factor * volumes + signs * areas * x)))

    log = clean_log("slide_servo", rig, "steps", duration=0.5)
    scales = Scales(rig, item, None, [log])
    assert scales["unit"] == scales["second"] == 1.0
    assert scales.damper == pytest.approx(math.sqrt(scales.spring * scales.load))
    assert scales.spring == pytest.approx(float(rig.oil.bulk_modulus) * stiffness(half), rel=1e-9)
    (note,) = counts_on(rig, ["bulk_modulus"], {"press": [log]})
    x = float(np.mean(log["press.x"]))
    slope = (stiffness(x, 0.999) - stiffness(x, 1.001)) / 0.002 / stiffness(x)
    assert note.fields["share"] == pytest.approx(note.fields["more"] * slope, rel=1e-4)
    (note,) = counts_on(rig, ["bulk_modulus", "press.volume_rod"], {"press": [log]})
    part = areas[0] ** 2 * volumes[0] / (volumes[0] + head * x) ** 2 / stiffness(x)
    assert note.fields["share"] == pytest.approx(note.fields["more"] * part, rel=1e-6)


def test_residuals_follow_what_goes_along_with_them():
    """An error by the direction of motion, none below a twentieth of the largest speed."""
    t = np.arange(4000) * 5e-3
    v = np.where(t < 12.0, 0.2 * np.sign(np.sin(1.3 * t)), 0.009 * np.sign(np.sin(7.0 * t)))
    noise = np.random.default_rng(3).standard_normal(t.size)
    command = np.random.default_rng(4).standard_normal(t.size)
    channels = {"press.v": v, "press.x": np.full(t.size, 0.1), "press.servo.command": command}
    channels["press.p_head"] = np.zeros(t.size)
    error = 0.3 * noise + np.where(t < 12.0, np.sign(v), 0.0)
    case: Any = Stub(name="log", channels=("press.p_head",), blocks=lambda y: y)
    case.record = Record(t, channels)
    case.recorded = {"press.p_head": np.cos(t)}  # of which no error is made
    shown = Record(t, {"press.p_head": error + np.cos(t)})
    found = {item.what: item for item in followed(case, shown)}
    best = max(found.values(), key=lambda item: abs(item.correlation))
    assert best.what == "direction" and best.channel == "press.p_head"
    assert best.correlation == pytest.approx(1.0 / math.sqrt(1.0 + 0.09 / 0.6), abs=0.01)
    assert found.keys() == {"direction", "speed"}
    assert not [*followed(case, Record(t, {"press.p_head": np.cos(t) + 1.0}))]
    assert 0.0 < best.band < 0.7


def test_alike_faults_are_asked_of_each_part_of_each_valve_and_of_all_valves():
    """Of a spool's edges and of two cartridges; a driver without minus has no neutral."""
    spool = rows_of(shipped("slide_servo"), "gain")
    assert [(row.alike, len(row.numbers)) for row in spool] == [(True, 1)] * 4 + [(False, 4)]
    assert spool[-1].about == "press.servo"
    rig = shipped("boom_four_valve")
    log = clean_log("boom_four_valve", rig, "steps", duration=1.0)
    rows = hypotheses(rig, ["boom"], ["boom.qd", "boom.p_head"], [log])
    gains = [row for row in rows if row.kind == "gain"]
    assert [(row.alike, len(row.numbers)) for row in gains] == [(False, 1)] * 2 + [(False, 2)]
    kinds = {row.kind for row in rows}
    assert "neutral" not in kinds and {"drift", "sensor lag", "sensor scale"} <= kinds
    assert len(rows_of(shipped("slide_servo"), "neutral")) == 1


def test_a_place_of_a_rig_file_is_named_and_what_has_no_name_counted():
    rig = shipped("slide_servo")
    assert [edge.name for edge in rig.cylinder[0].valve[0].edge] == [None] * 4
    place = ("cylinder", 0, "valve", 0, "edge", 1)
    where = "[[cylinder]] press, [[cylinder.valve]] servo, [[cylinder.valve.edge]] 2"
    assert hypothesis._where(rig, place) == where
    assert hypothesis._where(rig, ("payload", "100 kg")) == "[payload.100 kg]"


def pasted(text: str, lines: str) -> str:
    """A rig file with the lines of a suggestion below the header that they name, in place of what
    it has of these keys."""
    where, *keys = lines.splitlines()
    if where.startswith("["):
        return f"{text}\n{lines}\n"
    rows, at = text.splitlines(), 0
    for header, name in re.findall(r"(\[+[\w.]+\]+) ?(\w*)", where):
        places = [i for i, row in enumerate(rows) if i >= at and row == header]
        named = [i for i in places if f'name = "{name}"' in rows[i + 1 : i + 3]]
        at = named[0] if named else places[int(name or 1) - 1]
    end = next((i for i, row in enumerate(rows) if i > at and row.startswith("[")), len(rows))
    stems = tuple(line.partition("=")[0] for line in keys)
    rest = [row for row in rows[at + 1 : end] if not row.startswith(stems)]
    return "\n".join([*rows[: at + 1], *rest, *keys, *rows[end:]])


@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional", "boom_four_valve"])
def test_the_lines_of_a_suggestion_can_be_pasted_into_the_rig_file(name, tmp_path):
    rig, count = shipped(name), 0
    log = clean_log(name, rig, "steps", duration=1.0)
    cylinder = rig.cylinder[0].name
    for row in hypotheses(rig, [cylinder], [f"{cylinder}.p_head"], [log]):
        text = (RIGS / f"{name}.toml").read_text()
        for lines in row.rig_lines(rig):
            text, count = pasted(text, lines), count + 1
        (tmp_path / "rig.toml").write_text(text)
        loaded = load_rig(tmp_path / "rig.toml")
        assert loaded.parameters().keys() == row.altered(rig).parameters().keys(), row.name
    assert count > 9


def test_words_of_a_fault_for_recipe_and_rig_file():
    """Numbers to five digits; a sensor's word or its sign."""
    rig = shipped("slide_servo")
    number = Number("press.volume_rod", 1e-3, 1.0, (1e-3,), 1.2345678e-3, "assumed")
    place = ("cylinder", 0, "valve", 0)
    content = {"law": {"value": 1.23456789}, "of": ["a", 2.0], "far": "inf m"}
    edit = (place, "law", content, {"load": "12.3456789 kg"})
    added = Hypothesis(Row("gain"), "a", (number,), edits=(edit,))
    assert added.recipe_lines(rig) == (
        'parameters: add "press.volume_rod"',
        f'[upper] "press.volume_rod" = "{rig.shown(number.name, number.upper, 5)}"',
    )
    (line,) = added.rig_lines(rig)
    values = 'law = 1.2346\nof = ["a", 2]\nfar = "inf m"\nload = "12.346 kg"'
    valve = "# in [[cylinder]] press, [[cylinder.valve]] servo:"
    assert line == f"{valve}\n{values}"
    plain = Hypothesis(Row("gain"), "a", (number,), edits=((place, "dynamics", {"f": "x y"}, {}),))
    assert plain.rig_lines(rig) == (f'{valve}\ndynamics = {{ f = "x y" }}',)
    for kind, word in (("sensor scale", 'scale = "estimate"'), ("sensor sign", "sign = -1")):
        read = Hypothesis(Row(kind), "press.v", readings=(("press.v", "scale", 1.0),))
        assert read.recipe_lines(rig) == (f'[[sensor]] channel = "press.v", {word}',)
        assert read.freedom == 1
    assert Hypothesis(Row("drift"), "a", readings=(("u", "drift", 1.0),)).recipe_lines(rig) == ()


def test_a_fault_of_readings_is_added_to_what_is_known_of_sensors():
    """Commands that drift grow in proportion to time, to 1 + δ at the end."""
    name = "press.servo.command"
    log = Record(np.linspace(2.0, 4.0, 5), {name: np.full(5, 3.0), "press.v": np.ones(5)})
    drift = Hypothesis(
        Row("drift"), "a", readings=((name, "drift", 1.0), ("press.other.command", "drift", 1.0))
    )
    grown = drift.record(log, 0.5)
    np.testing.assert_allclose(grown[name], 3.0 * np.array([1.0, 1.125, 1.25, 1.375, 1.5]))
    np.testing.assert_array_equal(grown["press.v"], 1.0)
    offset = Hypothesis(Row("sensor offset"), name, readings=((name, "offset", 4.0),))
    assert offset.record(log, 0.5) is log
    known = (Term(name, "scale", 0.1, 2.0, 0.3, True),)
    terms, bias = offset.terms(known, {f"{name}.offset": 1.0, f"{name}.scale": 7.0}, -0.25)
    assert terms == (*known, Term(name, "offset", 0.0, 1.0, 0.0, False))
    assert bias == {f"{name}.offset": 0.0, f"{name}.scale": 7.0}
    again, bias = offset.terms(terms, {}, 0.5)
    assert again == terms and bias == {f"{name}.offset": 2.0}
    assert drift.terms(known, {}, 1.0)[0] == known


def case_of(channels, *, step=1e-3, noise=0.0, **more) -> Case:
    """A case of some channels at standstill of the model, two cylinders' words alike."""
    t = np.arange(next(iter(channels.values())).size) * step
    rng = np.random.default_rng(7)
    seen = {name: y + noise * rng.standard_normal(t.size) for name, y in channels.items()}
    return Case("log", Record(t, seen), Model.of(shipped("slide_servo")), ("press",), **more)


def test_what_is_left_is_in_units_of_a_blocks_noise():
    """White noise of 0.02, five samples to a block; errors of 0.3 beside a spread of 1/√2."""
    y = np.sin(2.0 * np.pi * np.arange(8000) / 2000.0)
    case = case_of({"press.v": y, "press.p_head": 2.0 * y}, noise=0.02)
    assert case.channels == ("press.v", "press.p_head") and case.block == 5
    wanted = math.hypot(0.02 / math.sqrt(5.0), 0.005 / math.sqrt(2.0))
    assert case.scales["press.v"] == pytest.approx(wanted, rel=0.05)
    off = Record(case.record.t, {n: v + 0.3 for n, v in case.record.channels.items()})
    left = case.left(off)
    assert left.size == 3200
    assert left[:1600] == pytest.approx(0.3 / case.scales["press.v"])
    assert left[1600:] == pytest.approx(0.3 / case.scales["press.p_head"])
    shares = [(case.noise[name] / case.scales[name]) ** 2 for name in case.channels]
    assert case.noise_squares == pytest.approx(1600.0 * sum(shares))
    white = np.random.default_rng(2).standard_normal(3200)
    assert case.independent(white) == pytest.approx(3200.0, rel=0.1)
    slow = np.append(np.repeat(white[::8], 8)[:1600], np.repeat(white[::4], 4)[:1600])
    each = [1600.0 / correlation_time(part) for part in np.split(slow, 2)]
    assert case.independent(slow) == pytest.approx(sum(each)) and sum(each) < 1200.0
    part = replace(case, scored=(2.0, 3.999))
    assert part.keep.sum() == 2000 and part.left(off).size == 800


def test_a_search_refines_only_what_has_a_slope_and_stays_within_bounds(monkeypatch):
    search, asked = search_of(U), []

    def at(points):
        asked.extend(points)
        return [[U * abs(1.0 - delta)] for _, delta in points]

    monkeypatch.setattr(search, "_at", at)
    fixed = Hypothesis(replace(WEAK.row, step=0.0), "fixed")
    near = {BOUND: (0.2, 0.64, [U]), fixed: (0.5, 0.25, [U])}
    refined = search._refined(near)
    assert refined[fixed] is near[fixed] and {fault for fault, _ in asked} == {BOUND}
    assert max(delta for _, delta in asked) <= 0.25 and refined[BOUND][0] == pytest.approx(0.25)
    assert len(asked) < 2 * diagnosis.HALVINGS


def scales_of(command, part=None, channel=""):
    """Scales of the slide, whose valve was commanded so, of ±10 V."""
    rig = shipped("slide_servo")
    (item,) = rig.cylinder
    log = Record(np.arange(command.size) * 1e-3, {"press.servo.command": command})
    return Scales(rig, item, item.valve[0], [log], channel, part and part(item.valve[0]))


def test_scales_of_a_machine_by_hand():
    area = math.pi / 4.0 * 0.05**2
    scales = scales_of(np.array([-3.0, 0.0, 2.0]))
    assert (scales.pressure, scales.force) == (1.4e7, pytest.approx(1.4e7 * area))
    assert scales.leakage == pytest.approx(0.01 * area / 1.4e7)
    assert (scales.command, scales.reach) == (float(scales.valve.command_max), 3.0)
    assert scales.friction == pytest.approx(max(scales.coulomb, 0.006 * scales.force))
    for edge in scales.valve.edge:
        found = scales_of(np.array([-3.0, 0.0, 2.0]), lambda valve, edge=edge: edge)
        assert found.reach == (2.0 if edge.sign > 0 else 3.0)
    scales.part = Stub(opening_max=9.0, deadband=1.5)
    assert scales.travel == 7.5
    assert scales_of(np.array([-3.0, 0.0]), lambda valve: valve.edge[0]).empty
    assert not scales.empty
    amount = Amount((0.5, 2.0), "command", "V", (0.1, 3.0))
    top = scales.command
    assert (scales.of(amount), scales.of(amount, 1), scales.of(amount, 7)) == (
        0.5 * top,
        2 * top,
        2 * top,
    )
    written = scales.written(amount)
    assert written == {
        "value": f"{0.5 * top!r} V",
        "lower": f"{0.05 * top!r} V",
        "upper": f"{1.5 * top!r} V",
    }
    assert scales.written(amount._replace(span=None)) == f"{0.5 * top!r} V"
    assert scales.written(amount._replace(unit="")) == 0.5 * top and scales.written("a") == "a"


@pytest.mark.parametrize(
    ("small", "middle", "graded"), [(0, 6, True), (0, 4, False), (100, 6, True), (100, 4, False)]
)
def test_commands_of_several_sizes_grade_a_valve(small, middle, graded):
    """Beyond a twentieth of those over a tenth of the largest lie below eight tenths of it."""
    large = 100 - middle
    command = np.repeat([0.5, 5.0, 10.0], [small, middle, large])
    assert scales_of(command).graded == graded
    assert scales_of(np.repeat([0.9, 8.1, 10.0], [small, middle, large])).graded is False


def linear(left, slopes, monkeypatch):
    """(findings, how often models were run) where all is linear in its fault."""
    search, runs = search_of(left), []

    def at(points):
        runs.append(len(points))
        return [[left + delta * slopes[fault]] for fault, delta in points]

    def finding(fault, delta, gain):
        return diagnosis.Finding(fault.kind, fault.about, "", "", gain, delta)

    monkeypatch.setattr(search, "_at", at)
    monkeypatch.setattr(search, "_faults", lambda: [*slopes])
    search._finding = finding
    findings = search.findings()
    pair = [item for item in findings if item.jointly]
    both = sum(item.explains for item in pair)
    assert len(pair) in (0, 2) and [item.jointly for item in pair] == pytest.approx(
        [both] * len(pair)
    )
    return findings, runs


def searched(*given):
    """As `linear`, findings as name, size and what they explain."""
    findings, runs = linear(*given)
    return [(item.about, item.size, item.explains) for item in findings], runs


def test_of_faults_alike_the_plainer_comes_first_and_what_explains_the_rest_third(monkeypatch):
    """Gains of 900 cos²: 1 and 0.98 leave 400 and 418, alike, 0.9 is near, 0.5 is not; 400 lie
    beside these. Where no more lies there 0.98 leaves much more. A number less sure comes first."""

    def fault(name, rank, kind="gain", sure=""):
        of = ("bulk_modulus", 20.0, 1.0, (1.0,), None, sure)
        numbers = (Number(*of),) if sure else ()
        return Hypothesis(Row(kind, low=-9.0, high=9.0, rank=rank), name, numbers)

    def along(share):
        return 10.0 * (math.sqrt(share) * U + math.sqrt(1.0 - share) * V)

    slopes = {
        fault("first", 5): along(1.0),
        fault("plainer", 1): along(0.98),
        fault("near", 0, "lag"): along(0.9),
        fault("nearest", 6): along(0.95),  # a third of its kind
        fault("aside", 0, "load"): along(0.5),
        fault("other", 0, "leakage"): 5.0 * W + V,
    }
    rest = 100.0 - 30.0 * math.sqrt(0.98 * 0.02)  # of what the plainer leaves, along the other
    found, _ = searched(30.0 * U + 20.0 * W, slopes, monkeypatch)
    assert [name for name, _, _ in found] == ["plainer", "first", "other", "near"]
    sizes = [-3.0 * math.sqrt(0.98), -3.0, -rest / 26.0, -3.0 * math.sqrt(0.9)]
    assert [size for _, size, _ in found] == pytest.approx(sizes)
    assert [gain for _, _, gain in found] == pytest.approx([882.0, 900.0, rest**2 / 26.0, 810.0])
    first, *others = linear(30.0 * U + 20.0 * W, slopes, monkeypatch)[0]
    assert first.alike == ("gain of first", "gain of nearest") and first.cause.key == "faults.alike"
    assert not any(item.alike for item in others) and others[0].cause == others[0].sentence
    found, _ = searched(90.0 * U, {row: 10.0 * by for row, by in slopes.items()}, monkeypatch)
    assert [name for name, _, _ in found][:2] == ["first", "plainer"]
    rows = fault("weighed", 1, sure="weighed"), fault("assumed", 9, sure="assumed")
    slopes = {fault("sensor", 1): along(0.99), rows[0]: along(1.0), rows[1]: along(0.98)}
    found, _ = searched(30.0 * U + 20.0 * W, slopes, monkeypatch)
    assert [name for name, _, _ in found] == ["assumed", "sensor"]


def test_two_faults_that_explain_apart_are_no_alternatives(monkeypatch):
    """Each half of the squares, and nothing of the other half."""
    left, slopes = 8.9 * U + 8.5 * V, {WEAK: U, FAR: V}
    first, second = linear(left, slopes, monkeypatch)[0]
    assert (first.about, second.about, first.alike) == ("weak", "far", ())
    assert first.jointly == second.jointly == pytest.approx(79.21 + 72.25)
    assert second.size == pytest.approx(-8.5)


def test_quiet_residuals_are_asked_by_slopes_alone(monkeypatch):
    """40 residuals whose squares sum to 49 hold no fault; to 54 models are run, in vain. 1000 that
    sum to 72 are quiet, but one slope tells of all."""
    for size, runs in ((7.0, 1), (7.4, 2)):
        found, asked = searched(size * U, {WEAK: U}, monkeypatch)
        assert not found and (len(asked) == 1) == (runs == 1)
    one = np.eye(1, 1000)[0]
    found, _ = searched(8.5 * one, {WEAK: 2.0 * one}, monkeypatch)
    assert found == [("weak", pytest.approx(-4.25), pytest.approx(72.25))]


def test_the_six_that_leave_least_are_refined(monkeypatch):
    """Eight that explain ever less, every other one with a size above zero."""
    refined, shares = [], [1.0 - 0.05 * k for k in range(8)]
    search, faults = diagnosis._Search, [replace(WEAK, about=str(k)) for k in range(8)]
    slopes = {
        fault: 10.0 * (-1.0) ** k * (math.sqrt(shares[k]) * U + math.sqrt(1.0 - shares[k]) * V)
        for k, fault in enumerate(faults)
    }
    kept = lambda _, reached: refined.extend(reached) or {}
    monkeypatch.setattr(search, "_refined", kept)
    searched(30.0 * U + 20.0 * W, slopes, monkeypatch)
    assert refined == faults[:6]


@pytest.mark.parametrize(
    ("noise", "gain", "share"), [(0.0, 50.0, 0.5), (20.0, 60.0, 0.75), (60.0, 50.0, 1.0)]
)
def test_a_finding_explains_its_share_of_what_exceeds_the_noise(noise, gain, share):
    search = search_of(10.0 * U, noise)
    del search._finding
    search.cases = [Stub(model=Stub(rig=rig)) for rig in ("a", "b")]
    words = {name: lambda rig, delta: f"{rig} {delta}" for name in ("sentence", "remedy")}
    found = search._finding(
        Stub(kind="gain", about="a", beyond=lambda delta: 2.0 * delta, **words), 0.3, gain
    )
    assert (found.explains, found.size, found.beyond) == (share, 0.3, 0.6)
    assert (found.sentence, found.remedy) == ("a 0.3", "a 0.3")
    assert diagnosis.Structure((found,)).causes == ((found,) if share > 0.5 else ())
