"""What residuals say of a model: built faults are named first or second, sound models cry at
nothing. `tools/studies/structure_study.py` has the long tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ehbench.config.recipe import load_rig
from ehbench.diagnosis import Case, ask
from ehbench.diagnosis.cures import cures
from ehbench.parts.valve.delay import Delay
from ehbench.plant.model import Model
from ehbench.preprocessing.observations import commanded
from ehbench.validation import prepare_validation, run_validation
from tests.virtual_logs import RIGS, clean_log, noisy, virtual_log
from tools.studies.structure_study import Fault, asked, faults, log_of

# a step out and a step back, and a sweep, of so many seconds each
QUICK = {"kinds": ("quick steps", "chirp"), "seconds": 1.2}


def rig_of(name: str):
    return load_rig(RIGS / f"{name}.toml")


BUILT = {
    "slide_servo": ("gain", "lag", "friction", "damping", "sensor lag", "sensor sign"),
    "crane_proportional": ("gain", "deadband", "load", "delay", "sensor scale"),
    "boom_four_valve": ("bulk modulus", "leakage", "saturation", "sensor offset"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [(n, k) for n, kinds in BUILT.items() for k in kinds])
def test_a_built_fault_is_named_first_or_second(name, kind):
    rig = rig_of(name)
    fault = next(one for one in faults(name, rig) if one.kind == kind)
    found = asked(name, rig, fault, 7, **QUICK)
    assert fault.named(found), found.findings
    first = found.findings[0]
    assert first.explains > 0.7 and first.cure and first.sentence
    assert found.follows, "and its residuals follow something"


@pytest.mark.parametrize("name", ["slide_servo", "crane_proportional", "thesis_arm"])
def test_a_sound_model_has_no_findings(name):
    rig = rig_of(name)
    for seed in (21, 22):
        assert not asked(name, rig, Fault("none", "", rig), seed, **QUICK).findings


def leaking_press(leakage: float = 6.0e-12):
    """The slide, with a heavier load and a piston seal that leaks [m³/(s·Pa)]."""
    rig = rig_of("slide_servo")
    return rig.with_values({"press.leakage_internal": leakage, "carriage.mass": 400.0})


@pytest.mark.parametrize("excess", [1.0e5, 4.0e5])
def test_the_exact_model_of_a_leaking_rig_has_no_findings(excess):
    """Its pressures [Pa] begin above their equilibrium and fall at standstill, so that the mean of
    the standstill is not the initial state.
    """
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
        prepared = prepare_validation(judged, [("log", log)])
        verdict = run_validation(prepared)
        verdicts[judged is rig] = verdict.with_structure(ask(prepared.cases(verdict.logs)))
    assert verdicts[True].verdict == "accepted"
    assert verdicts[False].verdict == "accepted with reservation"
    (reservation,) = verdicts[False].reservations
    assert name in reservation


def test_sizes_and_lines_of_the_cure():
    rig = rig_of("slide_servo")
    fault = next(one for one in faults("slide_servo", rig) if one.words == "one gain 8 % down")
    first = asked("slide_servo", rig, fault, 3, **QUICK).findings[0]
    assert first.about == "press.servo_supply_head" and first.size == pytest.approx(-0.08, abs=0.01)
    assert "slower than the model whatever the command" in first.sentence
    assert first.cure == (
        'add "press.servo_supply_head.flow_gain" to parameters of the identify recipe'
    )


def test_lines_of_what_was_fitted_already_and_of_a_late_command():
    rig = rig_of("slide_servo")
    names = [name for name in rig.parameters() if name.endswith("flow_gain")]
    fitted = rig.with_values({n: replace(rig.parameters()[n], sure="identified") for n in names})
    for one, says in ((rig, "to parameters of the identify recipe"), (fitted, "fitted already")):
        found = cures(one, ["press"], ["press.v"], False)
        lines = [cure.line(0.1) for cure in found if cure.kind == "gain"]
        assert lines and all(says in line for line in lines)
    delay = next(cure for cure in cures(rig, ["press"], ["press.v"], False) if cure.kind == "delay")
    assert "dynamics" in delay.line(0.01) and 'late = "10 ms"' in delay.line(-0.01)
    assert "earlier" in delay.says(-0.01) and "press.servo.command" in delay.says(-0.01)


def test_a_delay_that_the_rig_file_has_is_to_be_freed():
    rig = rig_of("slide_servo")
    cylinder = rig.cylinder[0]
    valve = cylinder.valve[0]
    series = valve.model_copy(update={"dynamics": ("bus", *valve.series)})
    bus = Delay.model_validate({"kind": "delay", "delay": "1 ms"})
    late = rig.model_copy(
        update={
            "cylinder": (cylinder.model_copy(update={"valve": (series,)}),),
            "dynamics": {**rig.dynamics, "bus": bus},
        }
    )
    cure = next(one for one in cures(late, ["press"], ["press.v"], False) if one.kind == "delay")
    assert cure.line(0.01) == 'add "bus.delay" to parameters of the identify recipe'
    assert "more delay of press.servo" in cure.says(0.01) and "late =" in cure.line(-0.01)


def test_stroke_and_angle_are_held_against_the_pins():
    rig = rig_of("crane_proportional")
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
    rig = rig_of("slide_servo")
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
