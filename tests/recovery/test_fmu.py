"""A user's FMU as model and as machine: replayed, fitted, judged, run, and refused."""

import copy
import json
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w

import ehbench
from ehbench import workflow
from ehbench.config.recipe import load_recipe, load_rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.plant.foreign import FmuModel, model_of
from ehbench.preprocessing.preparation import preprocess
from ehbench.runtime import fmu
from ehbench.runtime.fmu_child import Instance
from ehbench.vocabulary.errors import EhbenchError, InputError
from tests.press_fmu import A1, A2, MASS, UNITS, press, press_fmu
from tests.shared import refused

pytest.importorskip("fmpy")
pytestmark = pytest.mark.usefixtures("all_undrawn")
TRUE = {"bulk_modulus": 1.1e9, "carriage.damping": 2400.0}
RIG = f"""
name = "press"
[oil]
bulk_modulus = {{ value = "700 MPa", lower = "100 MPa", upper = "3 GPa" }}
[supply]
pressure = "140 bar"
tank_pressure = "2 bar"
flow_limit = "60 L/min"
[mechanism]
kind = "slide"
name = "carriage"
mass = "{MASS} kg"
damping = {{ value = "500 N*s/m", lower = "1 N*s/m", upper = "20000 N*s/m" }}
[[cylinder]]
name = "press"
joint = "carriage"
bore = "50 mm"
rod = "28 mm"
stroke = "400 mm"
volume_head = "150 cm^3"
volume_rod = "700 cm^3"
relief_pressure = "210 bar"
[[cylinder.valve]]
name = "servo"
command_min = "-10 V"
command_max = "10 V"
""" + "".join(
    f'[[cylinder.valve.edge]]\nfrom = "{a}"\nto = "{b}"\nsign = {s}\nlaw = "orifice"\n'
    'flow_gain = "4e-8 m^3/(s*V*Pa^0.5)"\n'
    for a, b, s in (
        ("supply", "head", 1),
        ("rod", "tank", 1),
        ("supply", "rod", -1),
        ("head", "tank", -1),
    )
)
MODEL = """
[model]
fmu = "press.fmu"
channels = { "press.x" = "x", "press.v" = "v", "press.p_head" = "pA", "press.p_rod" = "pB" }
commands = { "press.servo" = "u" }
parameters = { bulk_modulus = "beta", "carriage.damping" = "drag" }
start = { "press.x" = "x0", "press.p_head" = "pA0", "press.p_rod" = "pB0" }
"""
FIT = """
stage = "identify"
what = "hydraulics"
rig = "rig.toml"
parameters = ["bulk_modulus", "carriage.damping"]
channels = ["v", "p_head", "p_rod"]
"""
JUDGE = """
stage = "validate"
rig = "fit"
channels = ["v", "p_head", "p_rod"]
[thresholds]
fit_percent = { v = 60, p_head = 60, p_rod = 60 }
"""
TRIAL = """
stage = "trial"
rig = "rig.toml"
rate = "500 Hz"
[motion]
kind = "point_to_point"
waypoints = ["100 mm", "160 mm"]
hold = "0.2 s"
speed = "80 mm/s"
[controller]
kind = "position"
"""


@cache
def recorded(seed: int, first: float, back: float) -> Record:
    """Steps out and back by SciPy, with the noise of sensors."""
    t = np.arange(1000) * 1e-3
    ends = [0.1, 0.35, 0.55, 0.8]
    u = np.array([0.0, first, 0.0, back, 0.0])[np.searchsorted(ends, t, side="right")]
    pa = 6e6
    y0 = [0.15, 0.0, pa, pa * A1 / A2]
    y = press(t, u, TRUE["bulk_modulus"], TRUE["carriage.damping"], np.array(y0))
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=y.shape) * [2e-5, 1e-3, 2e4, 2e4]
    names = ("press.x", "press.v", "press.p_head", "press.p_rod")
    channels = dict(zip(names, (y + noise).T, strict=True))
    return Record(t, channels | {"press.servo.command": u}, {"payload": "none"})


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    press_fmu(folder / "press.fmu")
    (folder / "rig.toml").write_text(RIG + MODEL)
    for name, *steps in (("a", 1, 1.5, -1.0), ("b", 2, -1.2, 1.8), ("c", 3, 1.0, -1.5)):
        write_log(folder / f"{name}.mcap", recorded(*steps))
    data = '[[data]]\npath = "{}.mcap"\n'
    (folder / "fit.toml").write_text(FIT + data.format("a") + data.format("b"))
    (folder / "judge.toml").write_text(JUDGE + data.format("c"))
    (folder / "trial.toml").write_text(TRIAL)
    return folder


@pytest.fixture(scope="module")
def fitted(place):
    return ehbench.identify(place / "fit.toml", out=place / "fit", allow_code=True)


def test_a_replay_is_scipys(place):
    rig = load_rig(place / "rig.toml").with_values(TRUE)
    record = recorded(1, 1.5, -1.0)
    quiet = record.channels | {"press.p_head": np.full(1000, 6e6)}
    quiet["press.x"] = np.full(1000, 0.15)
    quiet["press.p_rod"] = np.full(1000, 6e6 * A1 / A2)
    built = model_of(rig).replay(replace(record, channels=quiet))
    y0 = np.array([0.15, 0.0, 6e6, 6e6 * A1 / A2])
    beta, drag = TRUE.values()
    y = press(record.t, record["press.servo.command"], beta, drag, y0)
    for column, name in enumerate(("press.x", "press.v", "press.p_head", "press.p_rod")):
        span = np.ptp(y[:, column])
        assert built[name] == pytest.approx(y[:, column], rel=0, abs=1e-4 * span), name


@pytest.mark.parametrize("named", [True, False])
def test_a_log_that_begins_elsewhere_is_told(place, named):
    """The FMU begins at 100 mm where ``start`` says nothing else, the log at 150 mm."""
    rig = load_rig(place / "rig.toml")
    assert rig.model is not None
    if not named:
        model = rig.model.model_copy(
            update={"start": {"press.p_head": "pA0", "press.p_rod": "pB0"}}
        )
        rig = rig.model_copy(update={"model": model})
    _, notes = preprocess("a", recorded(1, 1.5, -1.0), model_of(rig))
    told = [note.fields for note in notes if note.key == "preprocessing.begins_elsewhere"]
    expected = [("press.x", "100 mm", "150 mm")]
    assert [tuple(map(fields.get, ("channel", "begins", "seen"))) for fields in told] == (
        [] if named else expected
    )


def check_parameters(table):
    for name, true in TRUE.items():
        low, high = table.loc[name, ["low", "high"]]
        assert table.loc[name, "status"] == "estimated"
        assert low <= true <= high and high - low < 0.1 * true, (name, low, true, high)


def test_a_fit_from_afar_has_the_truth_in_its_intervals(fitted, place):
    check_parameters(fitted.parameters)
    again = load_rig(place / "fit")
    assert again.model is not None and again.model.place == (place / "fit" / "press.fmu").resolve()


def test_the_judge_accepts_it_and_rejects_where_it_began(fitted, undiagnosed, place):
    good = ehbench.validate(place / "judge.toml", out=place / "good", allow_code=True)
    assert good.code == 0 and good.json("validation")["accepted"]
    first = (place / "judge.toml").read_text().replace('"fit"', '"rig.toml"')
    (place / "first.toml").write_text(first)
    bad = ehbench.validate(place / "first.toml", out=place / "bad", allow_code=True)
    assert bad.code == 4


@pytest.fixture(scope="module")
def off(place):
    """A log whose sensor of the head end reads 6 % and 3 bar too much."""
    record = recorded(1, 1.5, -1.0)
    reading = {"press.p_head": 1.06 * record["press.p_head"] + 3e5}
    off = replace(record, channels=record.channels | reading)
    write_log(place / "off.mcap", off.between(0.0, 0.6))
    for name, text in (("judge_off", JUDGE), ("fit_off", FIT)):
        (place / f"{name}.toml").write_text(text + '[[data]]\npath = "off.mcap"\n')
    return place


def test_a_sensor_that_reads_wrong_is_named(fitted, off):
    run = ehbench.validate(off / "judge_off.toml", out=off / "judged_off", allow_code=True)
    found = run.json("validation")["structure"]["findings"][0]
    assert found["kind"].startswith("sensor") and found["about"] == "press.p_head"


@pytest.mark.slow
def test_what_is_suggested_reads_it_right_and_a_test_is_proposed(fitted, off):
    session = workflow.Session(allow_code=True, out=off / "better")
    workflow.suggest(off / "fit_off.toml", session, 60.0)
    (sensor,) = load_recipe(off / "better" / "fit_off.toml").sensor
    assert sensor.channel == "press.p_head" and sensor.scale.value == pytest.approx(1.06, abs=2e-3)
    assert sensor.offset.value == pytest.approx(3e5, abs=2e4)
    proposed = workflow.next_test(off / "fit", None, workflow.Session(allow_code=True))
    for written in (None, off / "test.toml"):  # an FMU runs where it is allowed to
        assert "--allow-code" in proposed.answer(off / "fit", written).steps[0].hint
    assert proposed.known.interval is not None
    low, high = proposed.known.interval
    assert proposed.proposals[0].interval[1] - proposed.proposals[0].interval[0] < high - low


def test_a_trial_runs_on_it(place):
    run = ehbench.run_trial(place / "trial.toml", out=place / "trial", allow_code=True)
    log = ehbench.read_log(run.folder / "log.mcap")
    assert run.code == 0 and log["press.x"].iloc[-1] == pytest.approx(0.16, abs=2e-3)
    machine = ehbench.open_machine(place / "rig.toml", rate=500.0, allow_code=True)
    with refused("machines.fmu_not_started", InputError):
        machine.tick([0.0])
    sample = machine.start({"press": "100 mm"})
    assert sample[machine.channels.index("press.x")] == pytest.approx(0.1)
    with refused("machines.fmu_copied", InputError):
        copy.deepcopy(machine)


def test_a_trial_needs_no_sensor_of_speed(place, tmp_path):
    known = MODEL.replace('"press.v" = "v", ', "", 1)
    shutil.copy(place / "press.fmu", tmp_path)
    (tmp_path / "rig.toml").write_text(RIG + known)
    (tmp_path / "trial.toml").write_text((place / "trial.toml").read_text())
    run = ehbench.run_trial(tmp_path / "trial.toml", out=tmp_path / "trial", allow_code=True)
    facts = run.json("trial")["measures"]
    assert run.code == 0 and 0.0 < facts["tracking"]["max_error"] < 0.01
    assert 0.0 < facts["speed_rms_error"] < 0.1


@pytest.mark.parametrize(
    ("fault", "change", "key"),
    [
        ("CRASH", None, "runtime.fmu_crashed"),
        ("HANG", None, "runtime.fmu_hung"),
        ("REFUSE", None, "runtime.fmu_failed"),
        ("NANS", None, "plant.fmu_not_finite"),
        ("", ('= "beta"', '= "betta"'), "runtime.fmu_variable"),
        ("", ('= "drag"', '= "u0"'), "runtime.fmu_variable"),
        ("", ('= "u"', '= "x"'), "runtime.fmu_not_set"),
        ("", ('"press.x" = "x"', '"press.x" = "pA"'), "runtime.fmu_unit"),
        ("", ('"press.x" = "x"', '"press.y" = "x"'), "config.model_name"),
        ("", ('"press.x" = "x"', '"press.x" = "v"'), None),
        ("", ('"press.servo" = "u"', ""), None),
        ("", ('bulk_modulus = "beta", ', ""), "identification.fmu_parameter"),
        ("windows", None, "runtime.fmu_platform"),
        ("none", None, "runtime.fmu_unreadable"),
        ("broken", None, "runtime.fmu_unreadable"),
    ],
)
def test_what_cannot_run_is_refused(fault, change, key, place, tmp_path, monkeypatch):
    if fault == "HANG":
        monkeypatch.setattr(fmu, "FMU", replace(fmu.FMU, wait=0.5))
    if fault == "windows":
        press_fmu(tmp_path / "press.fmu", platform="win64")
    elif fault == "broken":
        (tmp_path / "press.fmu").write_bytes(b"PK\3\4 broken")
    elif fault.isupper():
        press_fmu(tmp_path / "press.fmu", fault)
    elif fault != "none":
        shutil.copy(place / "press.fmu", tmp_path)
    text = RIG + (MODEL.replace(*change) if change else MODEL)
    (tmp_path / "rig.toml").write_text(text)
    for name in ("a.mcap", "b.mcap", "c.mcap", "fit.toml", "judge.toml", "trial.toml"):
        shutil.copy(place / name, tmp_path)
    judge = (tmp_path / "judge.toml").read_text().replace('"fit"', '"rig.toml"')
    (tmp_path / "judge.toml").write_text(judge)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(EhbenchError) as caught:
        ehbench.identify(tmp_path / "fit.toml", out=tmp_path / "fit", allow_code=True)
    assert caught.value.exit_code == 2 and (key is None or caught.value.key == key)
    for name in ("judge", "trial") if fault.isupper() else ():
        with pytest.raises(EhbenchError) as caught:
            ehbench.run(tmp_path / f"{name}.toml", out=tmp_path / name, allow_code=True)
        assert caught.value.exit_code == 2 and "press.fmu" in str(caught.value.file), name
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("unit", "taken"), [("V", 2.0), ("mV", 2000.0), ("bar", 2.0), ("%", 2.0)])
def test_a_command_in_another_unit_than_volts_is_its_number(unit, taken, tmp_path, monkeypatch):
    monkeypatch.setitem(UNITS, "u", unit)  # of these the FMU defines the bar
    press_fmu(tmp_path / "press.fmu")
    (tmp_path / "rig.toml").write_text(RIG + MODEL)
    model = model_of(load_rig(tmp_path / "rig.toml"))
    assert isinstance(model, FmuModel)
    assert model.commanded(np.array([2.0])) == pytest.approx([taken])


@pytest.mark.parametrize("ended", ["terminateSimulation", "earlyReturn"])
def test_a_step_of_fmi_3_that_ends_before_its_time_is_an_error(ended):
    flags = [name == ended for name in ("event", "terminateSimulation", "earlyReturn")]
    instance = object.__new__(Instance)
    instance.references, instance.third, instance.count = {"commands": [], "channels": []}, True, 0
    instance.fmu = SimpleNamespace(doStep=lambda t, step: (*flags, t), getFloat64=lambda names: [])
    with pytest.raises(RuntimeError, match=ended):
        instance.steps(np.zeros((2, 0)), 1e-3)


def test_a_number_that_only_the_fmu_has_is_fitted(place, tmp_path):
    shutil.copy(place / "press.fmu", tmp_path)
    number = """[model.numbers.drag]
variable = "drag"
number = { value = 500, lower = 1, upper = 20000 }
"""
    model = MODEL.replace(', "carriage.damping" = "drag"', "") + number
    (tmp_path / "rig.toml").write_text(RIG + model)
    write_log(tmp_path / "a.mcap", recorded(1, 1.5, -1.0))
    fit = FIT.replace("carriage.damping", "drag.number") + '[[data]]\npath = "a.mcap"\n'
    (tmp_path / "fit.toml").write_text(fit)
    run = ehbench.identify(tmp_path / "fit.toml", out=tmp_path / "fit", allow_code=True)
    low, high = run.parameters.loc["drag.number", ["low", "high"]]
    assert low <= TRUE["carriage.damping"] <= high < 1.1 * low
    again = load_rig(run.folder).parameters()["drag.number"]
    assert float(again) == run.parameters.loc["drag.number", "value"] and again.upper == 20000.0


def test_the_controller_of_an_fmu_is_exported_and_its_model_is_not(place, tmp_path):
    session = workflow.Session(out=tmp_path / "out", unvalidated=True, allow_code=True)
    with pytest.raises(EhbenchError) as caught:
        workflow.export(place / "trial.toml", {}, session)
    assert caught.value.key == "export.is_fmu" and caught.value.exit_code == 2
    done = workflow.export(place / "trial.toml", {"parts": "controller"}, session)
    for item in done.json("export")["written"]:  # the same whenever it is written: no times
        assert re.fullmatch(r"0 of \d+ differ", item["check"])
    assert [getattr(note, "key", "") for note in done.notes][-1] == "export.times"


def test_foreign_code_runs_only_where_it_is_allowed(fitted, place, tmp_path):
    for run in (
        lambda: ehbench.identify(place / "fit.toml", out=tmp_path / "fit"),
        lambda: ehbench.validate(place / "judge.toml", out=tmp_path / "fit"),
        lambda: ehbench.run_trial(place / "trial.toml", out=tmp_path / "fit"),
        lambda: ehbench.open_machine(place / "rig.toml"),
    ):
        with pytest.raises(EhbenchError) as caught:
            run()
        assert caught.value.key == "stages.fmu_not_allowed" and caught.value.exit_code == 2
    assert not (tmp_path / "fit").exists()
    checked = ehbench.check(place / "fit.toml")
    assert checked.errors == ()
    (step,) = checked.answer(place / "fit.toml").steps
    assert step.fields["options"] == " --allow-code"
    json.dumps(ehbench.check(place / "rig.toml").lines)
    (place / "all.toml").write_text('stage = "campaign"\nrecipes = ["trial.toml"]\n')
    (step,) = ehbench.check(place / "all.toml").answer(place / "all.toml").steps
    assert step.fields["options"] == " --allow-code"


@pytest.mark.slow
def test_what_is_exported_comes_back(tmp_path):
    """Exported, imported, and fitted from a distant start to noisy logs of the same rig."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to build an FMU with")
    slide = Path(__file__).parents[2] / "recipes" / "rigs" / "slide_servo.toml"
    export = f'stage = "export"\nrig = "{slide}"\nparts = "model"\nformats = ["fmu3"]\n'
    (tmp_path / "export.toml").write_text(export)
    run = ehbench.run(tmp_path / "export.toml", out=tmp_path / "export", unvalidated=True)
    (unit,) = (run.folder / "fmu3").glob("*.fmu")
    shutil.copy(unit, tmp_path / "press.fmu")
    true, rng = load_rig(slide).with_values(TRUE), np.random.default_rng(5)
    for name, volts in (("a", 1.5), ("b", -1.2)):
        t = np.arange(901) * 1e-3
        ends = [0.1, 0.3, 0.5, 0.7]
        u = np.array([0.0, volts, 0.0, -volts, 0.0])[np.searchsorted(ends, t, side="right")]
        log = ehbench.simulate(true, {"press.servo": u}, 0.9)
        noise = {"press.x": 2e-5, "press.v": 1e-3, "press.p_head": 2e4, "press.p_rod": 2e4}
        channels = {c: log[c] + s * rng.normal(size=t.size) for c, s in noise.items()}
        channels["press.servo.command"] = log["press.servo.command"]
        write_log(tmp_path / f"{name}.mcap", Record(t, channels, {"payload": "none"}))
    model = MODEL.replace('= "x"', '= "press.x"').replace('= "v"', '= "press.v"')
    model = model.replace('= "pA"', '= "press.p_head"').replace('= "pB"', '= "press.p_rod"')
    model = model.replace('= "u"', '= "press.servo.command"').replace('"beta"', '"bulk_modulus"')
    model = model.replace('"drag"', '"carriage.damping"').partition("start")[0]
    far = load_rig(slide).with_values({"bulk_modulus": 4e8, "carriage.damping": 400.0})
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(far.as_toml()) + model)
    data = "".join(f'[[data]]\npath = "{name}.mcap"\n' for name in "ab")
    (tmp_path / "fit.toml").write_text(FIT + data)
    fit = ehbench.identify(tmp_path / "fit.toml", out=tmp_path / "fit", allow_code=True)
    check_parameters(fit.parameters)
