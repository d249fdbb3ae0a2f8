"""What residuals say of a model: built faults are named first or second, sound models cry at
nothing. `tools/studies/structure_study.py` has the long tables."""

from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.rig import Rig
from ehbench.diagnosis import Case, ask
from ehbench.diagnosis.faults import hypotheses
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import commanded
from ehbench.validation import validate_rig
from tests.shared import shipped
from tests.virtual_logs import clean_log, noisy, virtual_log
from tools.studies.structure_study import Fault, asked, faults, log_of

# a step out and a step back, and a sweep, of so many seconds each
QUICK = {"kinds": ("quick steps", "chirp"), "seconds": 1.2}


BUILT = {
    "slide_servo": ("gain", "lag", "friction", "damping", "sensor lag", "sensor sign"),
    "crane_proportional": ("gain", "deadband", "load", "delay", "sensor scale"),
    "boom_four_valve": ("bulk modulus", "leakage", "saturation", "sensor offset"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [(n, k) for n, kinds in BUILT.items() for k in kinds])
def test_a_built_fault_is_named_first_or_second(name, kind):
    rig = shipped(name)
    fault = next(one for one in faults(name, rig) if one.kind == kind)
    found = asked(name, rig, fault, 7, **QUICK)
    assert fault.named(found), found.findings
    first = found.findings[0]
    assert first.explains > 0.7 and first.remedy and first.sentence
    assert found.follows, "and its residuals follow something"


@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional", "thesis_arm"])
def test_a_sound_model_has_no_findings(name):
    rig = shipped(name)
    for seed in (21, 22):
        assert not asked(name, rig, Fault("none", "", rig), seed, **QUICK).findings


def leaking_press(leakage: float = 6.0e-12):
    """The slide, with a heavier load and a piston seal that leaks [m³/(s·Pa)]."""
    rig = shipped("slide_servo")
    return rig.with_values({"press.leakage_internal": leakage, "carriage.mass": 400.0})


@pytest.mark.parametrize("excess", [1.0e5, 4.0e5])
def test_the_exact_model_of_a_leaking_rig_has_no_findings(excess):
    """Pressures fall at standstill, so that their mean is not the initial state."""
    rig = leaking_press(2.0e-11)
    model = Model.of(rig)
    log = clean_log("slide_servo", rig, "ramps", duration=2.0)
    rest, row = model.rest_start(log), model.plant.cylinders[0]
    y = rest.y.copy()
    y[model.layout.state("p_head", 0)] += excess
    y[model.layout.state("p_rod", 0)] += excess * row.area_head / row.area_rod
    log = noisy(model.replay(log, start=rest._replace(y=y)), 31)
    assert ask([Case("log", log, model, commanded(model, log))]).findings == ()


@pytest.mark.parametrize(
    ("name", "factor"),
    [("bulk_modulus", 1.2), ("carriage.damping", 2.0), ("carriage.mass", 1.1)],
)
def test_a_cause_of_most_of_the_residual_is_a_reservation(name, factor):
    """The model follows the log well enough for every threshold, and is wrong."""
    rig = leaking_press()
    log = virtual_log("slide_servo", rig, "steps", 5, duration=3.0)
    wrong = rig.with_values({name: factor * float(rig.parameters()[name])})
    verdicts = {}
    for judged in (rig, wrong):
        verdicts[judged is rig] = validate_rig(judged, [("log", log)])
    assert verdicts[True].verdict == "accepted"
    assert verdicts[False].verdict == "accepted with reservation"
    (reservation,) = verdicts[False].reservations
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


def test_remedies_of_what_was_fitted_and_of_a_late_command():
    rig = shipped("slide_servo")
    names = [name for name in rig.parameters() if name.endswith("flow_gain")]
    fitted = rig.with_values({n: replace(rig.parameters()[n], sure="identified") for n in names})
    for given, key in ((rig, "faults.free"), (fitted, "faults.fitted")):
        assert {row.remedy(given, 0.1).key for row in rows_of(given, "gain")} == {key}
    (delay,) = rows_of(rig, "delay")
    assert delay.remedy(rig, 0.01).key == "faults.free_sensor"
    assert delay.remedy(rig, -0.01).fields["ms"] == pytest.approx(10.0)
    assert delay.sentence(rig, -0.01).fields["channels"] == "press.servo.command"


def test_a_delay_that_the_rig_file_has_is_to_be_freed():
    tables = shipped("slide_servo").as_toml()
    tables["dynamics"]["bus"] = {"kind": "delay", "delay": "1 ms"}
    press = dict(tables["cylinder"][0])
    press["valve"] = [{**press["valve"][0], "dynamics": ["spool", "bus"]}]
    rig = Rig.model_validate({**tables, "cylinder": [press]})
    (row,) = rows_of(rig, "delay")
    assert row.parameters == ("bus.delay",) and row.remedy(rig, 0.01).key == "faults.free"
    assert row.remedy(rig, -0.01).key == "faults.written_late"


@pytest.mark.parametrize(
    ("kind", "name", "delta", "value"),
    [
        ("leakage", "press.leakage_internal", 0.5, 0.5 * 0.01 / 1.4e7 * np.pi / 4 * 0.05**2),
        ("area", "press.bore", 0.005, 0.05 * 1.005),
        ("friction law", "press.friction_static", 0.1, 0.1 * 1.4e7 * np.pi / 4 * 0.05**2),
        ("load", "carriage.mass", -0.1, 225.0),
        ("preload", "press.servo_rod_tank.cracking_pressure", 0.1, 1.4e6),
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
    assert first.size == pytest.approx(0.0118, abs=5e-4)


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
