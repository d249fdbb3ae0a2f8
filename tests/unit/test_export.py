"""Exported C and functional mock-up units against trials of ehbench, bit for bit."""

import re
import shutil
import subprocess
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pint
import pytest

from ehbench import trial, workflow
from ehbench.app import inspection
from ehbench.config.recipe import ExportRecipe, TrialRecipe, load_rig
from ehbench.control import LAW_NAMES
from ehbench.control.trajectory import SHAPING_NAMES
from ehbench.export import FORMATS, Export, c99, compiler
from ehbench.export.source import write_sources
from ehbench.plant.model import Model
from ehbench.runtime.fmu import fmu_of
from ehbench.vocabulary.codes import FUNCTIONS
from ehbench.vocabulary.errors import EhbenchError
from tests.shared import RECIPES, refused, shipped

CC = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler is here")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")
BASE = ("kg", "m", "s", "A", "K")  # of FMI's base units those that have a dimension
SANE = ("-fsanitize=undefined", "-fno-sanitize-recover=all")
# uses after a scope are not looked for, which takes gcc most of its time: the only names that end
# with a scope are copied there, in one line
OF_ADDRESSES = ("-fsanitize=address", "-fno-sanitize-address-use-after-scope", *SANE)
QUICK = {
    "thesis_arm": "arc",
    "thesis_arm_standard": "",  # the same arm with a four-way valve
    "slide_servo": "position",
    "crane_proportional": "pressure_feedback",
    "boom_four_valve": "open_loop",
    "pump_cylinder": "",  # a pump moves it: commands alone
}
# every shipped rig, and every built-in law on one with each kind of valves
EACH = ("thesis_arm", "slide_servo", "boom_four_valve")
CASES = [
    pytest.param(name, law, marks=() if law and QUICK[name] == law else pytest.mark.slow)
    for name in sorted(path.stem for path in (RECIPES / "rigs").glob("*.toml"))
    for law in (LAW_NAMES if name in EACH else (QUICK[name],))
]


def prepared(name: str, law: str = "", several: bool = True):
    """A short trial of a rig: all its cylinders, or that of most valves, go out and back."""
    rig = shipped(name)
    keys = {"stage": "trial", "rig": "rig.toml", "duration": "0.5 s"}
    if law:
        gains = {"feedback_gain": "1e-12 m^3/(s*Pa)"} if law == "pressure_feedback" else {}
        motions, richest = [], max(rig.cylinder, key=lambda item: len(item.valve))
        for cylinder in rig.cylinder if several else [richest]:
            stroke = float(cylinder.stroke)
            points = [f"{share * stroke!r} m" for share in (0.4, 0.42, 0.4)]
            motion = {"kind": "point_to_point", "cylinder": cylinder.name, "waypoints": points}
            motions.append(motion | {"speed": f"{0.2 * stroke!r} m/s", "hold": "0.05 s"})
        keys["motion"] = motions[-1] | ({"also": motions[:-1]} if motions[:-1] else {})
        # pyrefly: ignore[bad-assignment]
        keys["controller"] = {"kind": law, "gains": gains}
    recipe = TrialRecipe(path=Path("x.toml"), **keys)
    return rig, trial.prepare(recipe, rig)


def export_of(name: str, law: str = "", several: bool = True, **keys) -> Export:
    rig, ready = prepared(name, law, several=several)
    recipe = ExportRecipe(stage="export", rig="rig.toml", path=Path("x.toml"), **keys)
    return Export(recipe, rig, None, Path("rig.toml"), ready, {})


def program(folder: Path, name: str, *flags: str) -> str:
    """What the check says, compiled with all warnings as errors."""
    files = [str(folder / "check.c"), str(folder / f"{name}.c"), "-lm"]
    subprocess.run([str(CC), *STRICT, *flags, *files, "-o", str(folder / "check")], check=True)
    done = subprocess.run(
        [folder / "check", folder / "check.csv"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done
    return done.stdout


@needs_compiler
@pytest.mark.parametrize(("name", "law"), CASES)
def test_c_equals_a_trial_to_the_bit(name, law, tmp_path):
    """Model and valves, which are the same under every law, and cylinders at once, once for each
    rig."""
    whole = law == QUICK[name]
    export = export_of(name, law, whole, **({} if whole else {"parts": "controller"}))
    driven = len(export.rig.cylinder) if whole else 1
    record = trial.run(export.trial).record
    assert len(export.components) == whole + 2 * driven * bool(law)
    others: list[str] = []  # parts live in one program
    for part, kernel in zip(export.components, export.kernels, strict=True):
        valves = part.name.endswith("valves")
        if valves and not whole:
            continue
        write_sources(part, kernel, tmp_path / part.name)
        late = part.name.endswith("_model")  # its outputs are those at the end of a tick
        checked = law == ("arc" if name == "slide_servo" else "position")
        sane = late or valves and not others if whole else checked
        flags = OF_ADDRESSES if sane else ()
        said = program(tmp_path / part.name, part.name, *flags, *others)
        if whole and law == "pressure_feedback":
            others.append(str(tmp_path / part.name / f"{part.name}.c"))
        outputs = len(part.role("output"))
        assert said.startswith(f"0 of {part.rows.shape[0] * outputs} differ")
        if valves:
            continue
        names = [item.name for item in part.variables if item.role != "parameter"]
        for channel, column in zip(names, part.rows.T, strict=True):
            if channel in record:
                begin = 1 if late and not channel.endswith(".command") else 0
                recorded = record[channel][begin : begin + column.size]
                assert np.array_equal(recorded, column, equal_nan=True), channel


@pytest.mark.parametrize("law", LAW_NAMES)
def test_every_number_of_a_law_has_a_meaning_and_lies_within_its_bounds(law):
    controller = export_of("slide_servo", law, parts="controller").components[0]
    given = controller.role("parameter")
    assert [item.name for item in given if not item.about] == []
    assert [i.name for i in given if not i.lower <= i.start <= i.upper] == []
    names = [item.name.rsplit(".", 1)[-1] for item in given if "shaping" in item.name]
    assert names == ([] if law == "arc" else [*SHAPING_NAMES])
    one_by_one = [item.about for item in given if "feedback_gain[" in item.name]
    assert len({*one_by_one}) == len(one_by_one) == (0 if law == "arc" else len(FUNCTIONS))


@pytest.mark.parametrize("name", ["slide_servo", "thesis_arm"])
def test_every_input_of_a_law_has_unit_and_meaning(name):
    controller = export_of(name, "arc", parts="controller").components[0]
    inputs = controller.role("input")
    assert [item.name for item in inputs if not item.unit or not item.about] == []
    ahead = [item for item in inputs if item.name.endswith("_ahead")]
    assert [item.unit for item in ahead] == ["m/s", "m/s"] and ahead[0].about != ahead[1].about
    learnt = [item for item in controller.role("parameter") if item.name.endswith("]")]
    assert len(learnt) == len({item.about for item in learnt}) == 16
    units = {item.name[:-3]: [] for item in learnt}
    for item in learnt:
        units[item.name[:-3]].append(item.unit)
    assert units.pop("rate") == [""] * 4
    assert [*units.values()] == [["dimensionless", "kg", "N", "dimensionless"]] * 3


def test_a_law_among_others_names_the_desired_motion_of_each_joint():
    """The lever of each joint's desired rate is that with which its cylinder moves."""
    export = export_of("thesis_arm", "arc", parts="controller")
    record = trial.run(export.trial).record
    part = export.components[0]
    column = dict(zip([v.name for v in part.variables if v.role != "parameter"], part.rows.T))
    for cylinder in export.rig.cylinder:
        rate = column[f"{cylinder.joint}.desired.qd"]
        at = np.argmax(np.abs(rate))
        lever = record[f"{cylinder.name}.v_desired"][at] / rate[at]
        moving = np.argmax(np.abs(record[f"{cylinder.name}.qd"]))
        moved = record[f"{cylinder.name}.v"][moving] / record[f"{cylinder.name}.qd"][moving]
        assert lever == pytest.approx(moved, rel=0.02)  # over 2 % of the stroke
        for word in ("qd", "qdd"):  # the time ahead is a tick
            now, soon = (column[f"{cylinder.joint}.{when}.{word}"] for when in ("desired", "ahead"))
            assert np.abs(soon[:-1] - now[1:]).max() < 0.02 * np.abs(now).max()


@needs_compiler
@pytest.mark.slow
def test_names_and_texts_of_any_kind_are_exported(tmp_path, monkeypatch):
    text = (RECIPES / "rigs" / "thesis_arm.toml").read_text()
    names = {"swing": "a-b", "stick": "A_b", "boom": "UPPER", "hect": "2", "hepc": "NAME"}
    names |= {"regen": "name", "50 lb": "*/ int x; /*"}
    for old, new in names.items():
        text = re.sub(rf'"{old}"|(?<=\.){old}(?=\])', f'"{new}"', text)
    assert '"A_b"' in text and 'source = "assumed"' in text
    odd = r'source = "/* assumed */ \\\n \u0007 ??/ öl 油 %d \""'
    (tmp_path / "rig.toml").write_text(text.replace('source = "assumed"', odd))
    moved = ["a-b", "A_b", "UPPER"]
    rig = load_rig(tmp_path / "rig.toml")
    motions = [
        f'kind = "point_to_point"\ncylinder = "{name}"\nspeed = "20 mm/s"\n'
        f'waypoints = ["{0.4 * stroke!r} m", "{0.41 * stroke!r} m"]\n'
        for name in moved
        for stroke in [float(rig.cylinder_named(name).stroke)]
    ]
    (tmp_path / "trial.toml").write_text(
        'stage = "trial"\nrig = "rig.toml"\nduration = "0.5 s"\npayload = "*/ int x; /*"\n'
        '[controller]\nkind = "arc"\n[motion]\n'  # compiled for an arm already
        + "[[motion.also]]\n".join(motions)
    )
    session = workflow.Session(out=tmp_path / "out", unvalidated=True)
    monkeypatch.setattr(compiler, "FLAGS", STRICT)
    done = workflow.export(tmp_path / "trial.toml", {}, session)
    written = {Path(item["file"]).name: item["check"] for item in done.json("export")["written"]}
    assert len({name.upper() for name in written}) == 7
    for name, check in written.items():
        assert check.startswith("0 of") and re.fullmatch("[A-Za-z]\\w*", name, re.ASCII)


@pytest.mark.parametrize("name", sorted(QUICK))
def test_the_model_of_every_rig_is_exported_without_a_controller(name, tmp_path):
    text = f'stage = "export"\nrig = "{RECIPES / "rigs" / name}.toml"\n'
    (tmp_path / "export.toml").write_text(text)
    assert inspection.check(tmp_path / "export.toml").errors == ()


@needs_compiler
def test_a_check_that_differs_fails(tmp_path):
    export = export_of("slide_servo")
    part = export.components[0]
    write_sources(part, export.kernels[0], tmp_path)
    rows = (tmp_path / "check.csv").read_text().splitlines()
    last = rows[-1].split(",")
    last[-1] = repr(float(last[-1]) + 1.0)
    (tmp_path / "check.csv").write_text("\n".join([*rows[:-1], ",".join(last), ""]))
    with pytest.raises(AssertionError, match="1 of"):
        program(tmp_path, part.name)


def test_what_has_no_rule_is_refused():
    text = "define i32 @_ZN8exportedB(ptr %a) {\nentry:\n  %x = {}\n  ret i32 0\n}\n"
    for instruction in ("fadd <2 x double> %a, %a", "call double @llvm.fma.f64(double 1.0)"):
        with refused("export.untranslated"):
            c99.Translation(text.replace("{}", instruction, 1), "8exported", "f").source()


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    """FMUs of the slide of both versions, and its rig."""
    pytest.importorskip("fmpy", reason="fmpy is not installed")
    if CC is None:
        pytest.skip("no C compiler is here")
    folder, export = tmp_path_factory.mktemp("units"), export_of("slide_servo")
    for version in (2, 3):
        FORMATS[f"fmu{version}"](export, folder)
    return folder, export


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("changed", [{}, {"bulk_modulus": 6e8}])
@pytest.mark.filterwarnings("ignore")  # of fmpy
def test_a_unit_equals_the_run_of_the_model(units, version, changed):
    from fmpy import read_model_description, simulate_fmu
    from fmpy.validation import validate_fmu

    folder, export = units
    file = str(folder / f"fmu{version}" / "slide_servo_model.fmu")
    assert validate_fmu(file) == []
    described = read_model_description(file)
    about = {item.name: item for item in described.modelVariables}
    assert about["press.p_head"].unit == "Pa" and about["press.x"].causality == "output"
    assert about["carriage.q"].unit == "m"  # it slides
    for unit in described.unitDefinitions:
        base = [f"{name}^{getattr(unit.baseUnit, name)}" for name in BASE if unit.baseUnit]
        assert base or unit.name.endswith("Pa^0.5)")  # a root has no whole powers
        assert not base or pint.Unit(unit.name).is_compatible_with("*".join(base))
    assert "assumed" in str(about["bulk_modulus"].description)
    for item in export.components[0].variables:  # as a user's own unit it is read in SI
        use = "channels" if item.role == "output" else "settable"
        read = fmu_of(Path(file)).variable(item.name, item.unit or None, use)
        assert (read.factor, read.offset) == (1.0, 0.0)
    t = np.arange(301) / 1000.0
    volts = np.where(t >= 0.02, 3.0 * np.sin(40.0 * t), 0.0)
    given = np.array(list(zip(t, volts)), dtype=[("time", float), ("press.servo.command", float)])
    names = ["press.p_head", "press.p_rod", "carriage.q", "press.servo.opening", "p_supply"]
    result = simulate_fmu(
        file,
        stop_time=0.3,
        output_interval=0.002,  # two ticks
        input=given[::2],
        start_values=changed,
        output=[*names, "press.servo.command"],
    )
    held = np.repeat(result["press.servo.command"][1:], 2)  # what acted until then
    before = Model.of(export.rig)
    model = Model.of(export.rig.with_values(changed))
    log = model.run(before.trim(before.posture(None)), np.append(held, 0.0)[:, None])
    for name in names:
        column = log[:, model.layout.state_names.index(name)]
        assert np.array_equal(result[name], column[::2]), name


@pytest.mark.filterwarnings("ignore")
def test_another_importer_runs_a_unit_alike(units):
    """libcosim, by its C++ importer FMI Library."""
    pytest.importorskip("libcosimpy", reason="libcosimpy is not installed")
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    run = CosimExecution.from_step_size(1_000_000)  # ns
    file = str(units[0] / "fmu2" / "slide_servo_model.fmu")
    unit = run.add_local_slave(CosimLocalSlave(fmu_path=file, instance_name="press"))
    inputs, outputs = CosimManipulator.create_override(), CosimObserver.create_last_value()
    assert run.add_manipulator(inputs) and run.add_observer(outputs)
    number = {item.name.decode(): item.reference for item in run.slave_variables(unit)}
    inputs.slave_real_values(unit, [number["press.servo.command"]], [3.0])
    run.step(200)
    names = ["press.p_head", "press.p_rod", "carriage.q", "press.servo.opening", "p_supply"]
    values = outputs.last_real_values(unit, [number[name] for name in names])
    model = Model.of(units[1].rig)
    log = model.run(model.trim(model.posture(None)), np.full((201, 1), 3.0))
    assert values == [log[-1, model.layout.state_names.index(name)] for name in names]


def test_a_unit_refuses_what_it_cannot_do(units):
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave

    file = str(units[0] / "fmu2" / "slide_servo_model.fmu")
    about = read_model_description(file)
    number = {item.name: item.valueReference for item in about.modelVariables}
    folder = extract(file)
    first, second = (
        FMU2Slave(guid=about.guid, unzipDirectory=folder, instanceName=name,
                  modelIdentifier=about.coSimulation.modelIdentifier)
        for name in "ab"
    )  # fmt: skip
    for unit in (first, second):
        unit.instantiate()
        unit.setupExperiment()
    first.setReal([number["press.servo.command"]], [5.0])
    for unit in (first, second):
        unit.doStep(0.0, 0.05)
    assert first.getReal([number["press.v"]])[0] > 0.01  # and the other stands
    assert abs(second.getReal([number["press.v"]])[0]) < 1e-9
    for wrong in (
        lambda: first.doStep(0.05, 0.0015),
        lambda: first.setReal([number["bulk_modulus"]], [float("nan")]),
        lambda: first.setReal([number["bulk_modulus"]], [-1.0]),
        lambda: first.setReal([number["press.servo.command"]], [1e300]),
        lambda: first.setReal([number["press.x"]], [0.1]),
    ):
        with pytest.raises(Exception, match="status"):
            wrong()
    for unit in (first, second):
        unit.freeInstance()
    shutil.rmtree(folder)


PYTHON = """stage = "trial"
rig = "{rigs}/slide_servo.toml"
duration = "1 s"
[controller]
class = "own:Own"
"""
FORCE = """
[[cylinder.force]]
name = "pull"
kind = "channel"
channel = "press.load_force"
"""
TUNED = """stage = "trial"
rig = "{rigs}/slide_servo.toml"
rate = "500 Hz"
[motion]
kind = "point_to_point"
waypoints = ["200 mm", "250 mm"]
speed = "50 mm/s"
[controller]
kind = "pressure_feedback"
gains = "{rigs}/../slide_servo/tuning.toml"
"""


@pytest.mark.parametrize(
    ("written", "options", "insisted", "key", "code"),
    [
        ("rig", {}, False, "export.unvalidated", 4),
        ("python", {}, True, "export.is_code", 2),
        ("tuned", {}, True, "export.other_rate", 2),
        ("force", {}, True, "export.played_force", 2),
        ("rig", {"parts": "controller"}, True, "export.without_controller", 2),
        ("rig", {"targets": ("win64",)}, True, "export.no_compiler", 2),
        ("rig", {"payload": "anvil"}, True, "config.no_payload", 2),
        ("rig", {"formats": ("ada",)}, True, "config.entry_not_one_of", 2),
        ("rig", {"rate": "0 Hz"}, True, "", 2),
    ],
)
def test_what_cannot_be_exported(tmp_path, monkeypatch, written, options, insisted, key, code):
    monkeypatch.setattr(compiler, "find_spec", lambda name: None)
    source = RECIPES / "rigs" / "slide_servo.toml"
    texts = {"python": PYTHON, "tuned": TUNED, "force": source.read_text() + FORCE}
    if written in texts:
        source = tmp_path / "source.toml"
        text = texts[written]
        source.write_text(text if written == "force" else text.format(rigs=RECIPES / "rigs"))
    before = sorted(tmp_path.rglob("*"))
    session = workflow.Session(root=tmp_path / "reports", unvalidated=insisted)
    with pytest.raises(EhbenchError) as error:
        workflow.export(source, options, session)
    assert (error.value.key, error.value.exit_code) == (key, code)
    named = error.value.file  # what an option says is in no file
    assert (named is None) == (key in ("", "config.entry_not_one_of"))
    assert named is None or Path(named).is_file()
    assert [item for item in sorted(tmp_path.rglob("*")) if item.is_file()] == before


def test_without_a_compiler_sources_are_left_and_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "find_spec", lambda name: None)
    monkeypatch.setattr(compiler.shutil, "which", lambda name: None)
    session = workflow.Session(out=tmp_path / "out", unvalidated=True)
    source = RECIPES / "rigs" / "slide_servo.toml"
    done = workflow.export(source, {"formats": ("c", "fmu2")}, session)
    assert [getattr(note, "key", "") for note in done.notes] == [
        "export.not_checked",
        "export.source_only",
    ]
    assert done.code == 0 and (done.folder / "c" / "slide_servo_model" / "check.c").is_file()
    with ZipFile(done.folder / "fmu2" / "slide_servo_model.fmu") as unit:
        names = unit.namelist()
    assert "sources/slide_servo_model.c" in names
    assert not any(name.startswith("binaries") for name in names)
    recipe = tmp_path / "out.toml"
    assert inspection.check(recipe).errors == ()
