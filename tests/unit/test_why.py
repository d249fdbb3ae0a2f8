"""Where a number of a run is from, and that no change of what it was made from goes unmarked."""

import json
import shutil
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from ehbench import workflow
from ehbench.app import cli
from ehbench.config.recipe import load_rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.report import compare, terminal
from ehbench.report.content import Findings
from ehbench.report.provenance import unsupported
from ehbench.report.saved import Saved
from ehbench.report.terminal import Answer
from ehbench.report.why import origin
from ehbench.runs import rundir, versions
from ehbench.runs.versions import METHODS, Versions
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.fields import Value
from tests.shared import RIGS

RECIPE = """stage = "identify"
what = "hydraulics"
rig = "rig.toml"
flow_maps = "maps.toml"
data = [
  { path = "one.csv", start = "0.2 s", stop = "3 s" },
  "two.csv",
]
parameters = ["bulk_modulus", "press.joint_damping"]
"""
ROW = {"name": "bulk_modulus", "unit": "Pa", "value": 7.0e8, "interval": [6.9e8, 7.1e8]}
ROW |= {"std": 5.0e6, "lower": 1.0e8, "upper": 2.0e9, "start": 6.0e8, "prior": None}
ROW |= {"from_data": 1.0, "from_starts": 0.0, "status": "estimated", "error_from": "hac"}
ROW |= {"samples": 400, "from_fixed": 0.62}
DEADBAND = {"valve": "sh", "direction": "forward", "deadband": 1.25}
DEADBAND |= {"deadband_interval": [1.2, 1.3]}
LOG = {"name": "one", "fit_percent": {"press.v": 91.5, "press.p_head": 80.0}}
DAMPING = {**ROW, "name": "press.joint_damping", "unit": "N*s/m"}
FIT = {"method": "output_error", "parameters": [ROW, DAMPING], "logs": [LOG]}


def write_run(final, stage, recipe, inputs, files, **facts):
    current = Versions.of(facts["what"])
    with rundir.open_run(final, stage, recipe, inputs, versions=current) as run:
        for name, content in files.items():
            rundir.write_json(run.path / name, content)
        shutil.copy(RIGS / "slide_servo.toml", run.path / "rig.toml")
        run.facts |= facts
    return final


def write_maps(shop, *rows):
    inputs = [("rig", shop / "rig.toml"), ("data", shop / "maps.csv")]
    files = {"summary.json": list(rows)}
    final, recipe = shop / "reports" / "maps_1", shop / "maps.toml"
    return write_run(final, "identify", recipe, inputs, files, what="flow_map")


@pytest.fixture
def shop(tmp_path) -> Path:
    """A flow-map run, a fit on it and on two logs, and a report over both."""
    shutil.copy(RIGS / "slide_servo.toml", tmp_path / "rig.toml")
    (tmp_path / "maps.csv").write_text("valve,command [V],flow [gpm]\nsh,1,2.0\nsh,2,4.0\n")
    (tmp_path / "maps.toml").write_text('stage = "identify"\ndata = ["maps.csv"]\n')
    (tmp_path / "fit.toml").write_text(RECIPE)
    for number, name in enumerate(("one", "two")):
        (tmp_path / f"{name}.csv").write_text(f"t [s],x [mm]\n0,{number}\n1,5\n2,7\n")
    reports = tmp_path / "reports"
    maps = write_maps(tmp_path, DEADBAND)
    logs = [("log", tmp_path / "one.csv"), ("log", tmp_path / "two.csv")]
    inputs = [("rig", tmp_path / "rig.toml"), ("flow_maps", maps), *logs]
    about = {"what": "hydraulics", "method": "output_error"}
    files = {"parameters.json": FIT}
    fit = write_run(reports / "fit_1", "identify", tmp_path / "fit.toml", inputs, files, **about)
    runs = [("run", maps), ("run", fit)]
    with rundir.open_run(reports / "report_1", "report", fit / "run.json", runs) as run:
        (run.path / "report.html").write_text("<p>bulk modulus 700</p>", encoding="utf-8")
    return tmp_path


def test_a_number_leads_to_interval_method_windows_logs_recipe_and_rig_line(shop):
    found = origin("bulk_modulus", shop / "reports" / "fit_1")
    assert found.values["changes"] == [] and found.values["interval"] == (6.9e8, 7.1e8)
    text = "\n".join(str(cell) for row in found.tables[0].rows for cell in row)
    method = "output error", "correlated residuals", "62 % of", "400 samples"
    for wanted in (*method, "0.2 s to 3 s"):
        assert wanted in text, text
    for name in ("one", "two"):
        assert rundir.sha256(shop / f"{name}.csv") in text
    assert found.values["recipe"]["line"] == 9
    lines = (shop / "rig.toml").read_text().splitlines()
    rig = found.values["rig"]
    assert "bulk_modulus" in lines[rig["line"] - 1]
    assert rig["source"] and rig["source"] in lines[rig["line"] - 1]
    plain = json.loads(found.as_json())
    assert plain["value"] == 7.0e8 and len(plain["inputs"]) == 4 and plain["changes"] == []


def test_of_several_runs_the_newest_is_asked_and_named(shop):
    fit = shop / "reports" / "fit_1"
    later = shutil.copytree(fit, shop / "reports" / "fit_2")
    edit_json("volatile.json", "started", "2999-01-01T00:00:00Z")(later)
    for runs in ([fit, later], [later, fit]):
        words = ["why", "bulk_modulus", *map(str, runs)]
        answer = CliRunner().invoke(cli.app, words)
        assert "fit_2, the newest of 2" in answer.output, answer.output


def test_a_parameter_that_a_validation_carries_leads_to_its_fit(shop):
    """And what changed in the validation is still told."""
    fit = shop / "reports" / "fit_1"
    (shop / "judge.toml").write_text('stage = "validate"\ndata = ["two.csv"]\n')
    inputs = [("rig", fit), ("log", shop / "two.csv")]
    files = {"parameters.json": json.loads((fit / "parameters.json").read_text())}
    final, recipe = shop / "reports" / "judged_1", shop / "judge.toml"
    judged = write_run(final, "validate", recipe, inputs, files, what="validation")
    found = origin("bulk_modulus", judged)
    assert found == origin("bulk_modulus", fit) and found.values["changes"] == []
    (judged / "rig.toml").write_text("")
    assert [c.key for c in origin("bulk_modulus", judged).values["changes"]] == [
        "report.output_changed"
    ]


def test_what_is_fitted_anew_on_the_rig_of_a_fit_is_from_the_new_fit(shop):
    fit = shop / "reports" / "fit_1"
    inputs = [("rig", fit), ("log", shop / "two.csv")]
    files = {"parameters.json": FIT | {"parameters": [ROW | {"value": 7.05e8}]}}
    again, recipe = shop / "reports" / "fit_2", shop / "fit.toml"
    write_run(again, "identify", recipe, inputs, files, what="hydraulics")
    found = origin("bulk_modulus", again)
    assert found.values["run"] == str(again) and found.values["value"] == 7.05e8


def test_a_stage_of_one_kind_is_named_once(shop):
    files, final = {"trial.json": {"tracking": {"rms": 0.002}}}, shop / "reports" / "trial_1"
    write_run(final, "trial", shop / "fit.toml", [("rig", shop / "rig.toml")], files, what="trial")
    assert origin("tracking.rms", final).values["method"][0] == "trial"


@pytest.mark.parametrize("edited", [False, True])
@pytest.mark.parametrize("stage", ["validate", "trial"])
def test_a_rig_file_copied_by_hand_leads_to_its_fit(shop, stage, edited):
    """By the value, where another line of the copy was edited; a copy of no fit is said to be."""
    fitted = load_rig(shop / "rig.toml").with_values({"bulk_modulus": Value(7.0e8, "identified")})
    text = tomli_w.dumps(fitted.as_toml())
    fit = shop / "reports" / "fit_1"
    (fit / "rig.toml").write_text(text)
    renew(fit, fit / "rig.toml", "outputs", "rig.toml")
    same = shop / "reports" / "another_1"  # with the value, and another rig
    shutil.copytree(fit, same)
    (same / "rig.toml").write_text(text + "\n")
    renew(same, same / "rig.toml", "outputs", "rig.toml")
    copy, recipe = shop / "my_rig.toml", shop / "judge.toml"
    copy.write_text(text)
    recipe.write_text(f'stage = "{stage}"\nrig = "my_rig.toml"\n')
    if edited:
        shutil.rmtree(same)
        copy.write_text(text.replace(fitted.title, "Edited"))
    final = shop / "reports" / "judged_1"
    inputs = [("rig", copy), ("log", shop / "two.csv")]
    write_run(final, stage, recipe, inputs, {"result.json": {}}, what="validation")
    shutil.copy(copy, final / "rig.toml")
    found = origin("bulk_modulus", final)
    assert found.values["run"] == str(fit) and found.values["interval"] == (6.9e8, 7.1e8)
    report = final.parent / "report_2"
    with rundir.open_run(report, "report", final / "run.json", [("run", final)]) as run:
        (run.path / "report.html").write_text("<p>judged</p>", encoding="utf-8")
    assert origin("bulk_modulus", report).values["run"] == str(fit)
    names = {source["path"] for source in found.values["inputs"]}
    assert any(name.endswith("one.csv") for name in names)
    datasheet = origin("supply.pressure", final)
    assert [text.key for text in datasheet.values["method"]] == ["report.from_rig"]
    assert datasheet.values["rig"]["file"].endswith("my_rig.toml")
    shutil.rmtree(fit)
    shutil.rmtree(same, ignore_errors=True)
    lost = origin("bulk_modulus", final)
    assert lost.values["value"] == 7.0e8
    assert [text.key for text in lost.values["method"]] == ["report.no_fit"]


@pytest.mark.parametrize(
    "new", [None, 'rated = { flow = "60 L/min", command = "10 V", drop = "35 bar" }']
)
def test_the_rig_line_of_an_edge_without_a_name_is_its_gain_or_rated_point(shop, new):
    """The second of three that have the same gain."""
    text = (shop / "rig.toml").read_text()
    gain = 'flow_gain = { value = "2.4 L/min/V/MPa^0.5", source = "datasheet" }'
    head, first, rest = text.partition(gain)
    (shop / "rig.toml").write_text(head + first + rest.replace(gain, new or gain, 1))
    line = text[: len(head + first) + rest.index(gain)].count("\n") + 1
    name = "press.servo_rod_tank.flow_gain"
    fit = shop / "reports" / "fit_1"
    rows = json.loads((fit / "parameters.json").read_text())
    rows["parameters"][1]["name"] = name
    (fit / "parameters.json").write_text(json.dumps(rows))
    found = origin(name, fit)
    assert found.values["rig"]["line"] == line


@pytest.mark.parametrize(
    "name, value",
    [
        ("press.joint_damping", 7.0e8),
        ("sh.forward.deadband", 1.25),
        ("deadband", 1.25),
        ("one press.v", 91.5),
        ("fit_percent.press.p_head", 80.0),
    ],
)
def test_any_number_of_a_report_is_found_by_the_end_of_its_path(shop, name, value):
    found = origin(name, shop / "reports" / "report_1")
    assert found.values["value"] == value and found.values["changes"] == []


def test_a_name_of_nothing_or_of_several_is_refused_with_what_is_near(shop):
    with pytest.raises(InputError, match="no number") as error:
        origin("bulk_moduls", shop / "reports" / "fit_1")
    assert "bulk_modulus" in str(error.value.hint)
    with pytest.raises(InputError, match="2 numbers"):
        origin("fit_percent", shop / "reports" / "fit_1")


def test_a_tunings_numbers_have_their_unit_and_no_line_of_the_rig(shop):
    """Its damping ratio is not that of a spool; its gains come before those it did not take."""
    (shop / "tune.toml").write_text('stage = "tune"\nrig = "rig.toml"\n')
    gains = {"extend_resistive": 2.8e-11, "retract_resistive": 2.8e-11}
    tuning = {"damping_ratio": 0.19, "feedback_gain": gains}
    # pyrefly: ignore[bad-assignment]
    tuning["alternatives"] = [{"feedback_gain": value} for value in (2.7e-11, 2.6e-11)]
    folder, inputs = shop / "reports" / "tune_1", [("rig", shop / "rig.toml")]
    write_run(folder, "tune", shop / "tune.toml", inputs, {"tuning.json": tuning}, what="tuning")
    shutil.copy(shop / "rig.toml", folder / "rig.toml")
    found = origin("damping_ratio", folder)
    assert found.values["value"] == 0.19 and found.values["rig"] is None
    with pytest.raises(InputError, match="2 numbers") as error:
        origin("feedback_gain", folder)
    assert "feedback_gain.extend_resistive" in str(error.value)
    gain = origin("feedback_gain.extend_resistive", folder)
    assert gain.values["unit"] == "m^3/(s*Pa)" and gain.verdict.fields["value"].endswith(
        " mL/min/bar"
    )


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("thresholds.fit_percent.p_head", "30 %"),
        ("start.press.p_head", "1.5 × 10⁶"),
        ("halves", "4.25"),
        ("constraints.bandwidth", "0.5 Hz"),
        ("answer.bandwidth", "45.0 ± 2.0 Hz (95 %: 43.0 … 47.0)"),
    ],
)
def test_no_number_has_the_unit_of_what_only_names_it(shop, name, shown):
    """A share of a fit to a pressure is no pressure, a channel's row no time of its table."""
    numbers = {
        "thresholds": {"fit_percent": {"p_head": 30.0}},
        "start": {"press.p_head": 1.5e6},
        "moved": [{"name": "bulk_modulus", "halves": 4.25}],
        "constraints": {"bandwidth": np.pi},
        "answer": {"bandwidth": {"value": 45.0, "interval": [43.0, 47.0], "unit": "Hz"}},
    }
    recipe, files = shop / "fit.toml", {"numbers.json": numbers}
    folder = write_run(shop / "reports" / "of", "tune", recipe, [], files, what="tuning")
    assert origin(name, folder).verdict.fields["value"] == shown


def edit(name, old, new):
    def change(shop):
        path = shop / name
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def edit_json(name, key, value):
    def change(shop):
        path = shop / name
        content = json.loads(path.read_text(encoding="utf-8"))
        assert content.get(key) != value
        path.write_text(json.dumps(content | {key: value}), encoding="utf-8")

    return change


def swap(shop):
    one, two = shop / "one.csv", shop / "two.csv"
    texts = one.read_text(), two.read_text()
    one.write_text(texts[1])
    two.write_text(texts[0])


def remade(shop):
    (shop / "maps.csv").write_text("valve,command [V],flow [gpm]\nsh,1,2.5\nsh,2,4.0\n")
    shutil.rmtree(shop / "reports" / "maps_1")
    write_maps(shop)


def renew(run: Path, file: Path, where: str, key: str | int, *entry: str) -> None:
    """Give a run the digest that a file of it, or of its inputs, has now."""
    facts = json.loads((run / "run.json").read_text())
    digest = rundir.sha256(file)
    facts[where][key] = facts[where][key] | {entry[0]: digest} if entry else digest
    (run / "run.json").write_text(json.dumps(facts))


def forge_output(shop):
    """A number and its digest changed together."""
    edit("reports/fit_1/parameters.json", "700000000.0", "900000000.0")(shop)
    run = shop / "reports/fit_1"
    renew(run, run / "parameters.json", "outputs", "parameters.json")


def forge_input(shop):
    """A log and its digest changed together."""
    edit("one.csv", "1,5", "1,6")(shop)
    renew(shop / "reports/fit_1", shop / "one.csv", "inputs", 2, "sha256")


TAMPERINGS = {
    "a row of the readings": edit("maps.csv", "sh,1,2.0", "sh,1,2.1"),
    "a row taken out": edit("maps.csv", "sh,2,4.0\n", ""),
    "the unit of the readings": edit("maps.csv", "flow [gpm]", "flow [L/min]"),
    "the valve of a row": edit("maps.csv", "sh,1", "sr,1"),
    "a sample of a log": edit("one.csv", "1,5", "1,6"),
    "the unit of a log": edit("two.csv", "x [mm]", "x [m]"),
    "a sample more": edit("two.csv", "2,7\n", "2,7\n3,9\n"),
    "two logs swapped": swap,
    "a log gone": lambda shop: (shop / "one.csv").unlink(),
    "the readings gone": lambda shop: (shop / "maps.csv").unlink(),
    "the rig's number": edit("rig.toml", "bulk_modulus", "bulk_modulus "),
    "the rig gone": lambda shop: (shop / "rig.toml").unlink(),
    "the window in the recipe": edit("fit.toml", "0.2 s", "0.1 s"),
    "the parameters of the recipe": edit("fit.toml", ', "press.joint_damping"', ""),
    "the recipe of the maps": edit("maps.toml", "maps.csv", "other.csv"),
    "the recipe gone": lambda shop: (shop / "fit.toml").unlink(),
    "the maps made anew": remade,
    "the run of the maps gone": lambda shop: shutil.rmtree(shop / "reports" / "maps_1"),
    "a number of the run": edit("reports/fit_1/parameters.json", "700000000.0", "710000000.0"),
    "an interval of the run": edit("reports/fit_1/parameters.json", "690000000.0", "699000000.0"),
    "a status of the run": edit("reports/fit_1/parameters.json", "estimated", "certain"),
    "a number of the run behind": edit("reports/maps_1/summary.json", "1.25", "1.35"),
    "the rig that the run left": edit("reports/fit_1/rig.toml", "name", "nam"),
    "a file of the run gone": lambda shop: (shop / "reports/fit_1/rig.toml").unlink(),
    "the versions": edit_json("reports/fit_1/run.json", "schema", 0),
    "the method it names": edit_json("reports/fit_1/run.json", "method", "thesis"),
    "what it warns of": edit_json("reports/fit_1/run.json", "warnings", ["all is well"]),
    "the inputs it names": edit_json("reports/fit_1/run.json", "inputs", []),
    "a number and its digest": forge_output,
    "a log and its digest": forge_input,
}


@pytest.mark.slow
@pytest.mark.parametrize("what", TAMPERINGS)
def test_whatever_is_tampered_with_marks_the_number(shop, what):
    TAMPERINGS[what](shop)
    for of in ("fit_1", "report_1"):
        found = origin("bulk_modulus", shop / "reports" / of)
        assert found.values["changes"] and found.verdict.key == "report.not_supported", of


def test_the_page_of_a_report_is_part_of_it(shop):
    edit("reports/report_1/report.html", "700", "800")(shop)
    changes = origin("deadband", shop / "reports/report_1").values["changes"]
    assert any("report.html" == change.fields["file"] for change in changes)


def test_a_report_over_a_run_whose_log_was_edited_says_so_and_exits_with_3(shop, monkeypatch):
    monkeypatch.setattr(import_module("ehbench.report"), "build", lambda *_: "<p>")
    fit = shop / "reports" / "fit_1"
    assert workflow.report([fit], workflow.Session(out=shop / "first")).code == 0
    edit("one.csv", "1,5", "1,6")(shop)
    assert any("one.csv" in text for text in unsupported(fit))
    made = workflow.report([fit], workflow.Session(out=shop / "second"))
    assert made.code == 3 and "one.csv" in made.notes[0]


def falsify(run: Path) -> None:
    """Another value, with the digest of its file renewed and the checksum of all as it was."""
    table = json.loads((run / "parameters.json").read_text())
    table["parameters"][0]["value"] = 9.9e8
    (run / "parameters.json").write_text(json.dumps(table))
    renew(run, run / "parameters.json", "outputs", "parameters.json")


@pytest.mark.parametrize("name", ["report", "compare", "show"])
@pytest.mark.parametrize("whose", ["itself", "upstream"])
def test_a_falsified_run_is_named_by_each_command(shop, inside, monkeypatch, name, whose):
    monkeypatch.setattr(import_module("ehbench.report"), "build", lambda *_: "<p>")
    bare = lambda _, notes=(), code=0: Answer("done", notes=notes)
    monkeypatch.setattr(terminal, "report_answer", bare)
    fit = shop / "reports" / "fit_1"
    chapter = SimpleNamespace(content=SimpleNamespace(status="estimated"), findings=Findings())
    reported = lambda folder: (SimpleNamespace(run=Saved(folder), **vars(chapter)), ())
    monkeypatch.setattr(compare, "reported", reported)
    rows = {"parameters.json": {"parameters": [ROW]}}
    inputs = [("rig", fit)]
    write_run(shop / "trial_1", "trial", shop / "fit.toml", inputs, rows, what="hydraulics")
    t = np.arange(50) / 10.0
    write_log(shop / "trial_1" / "log.mcap", Record(t, {"press.x": 0.1 + 0.01 * t}))
    trial = shop / "trial_1"
    words = {
        "report": ("report", "-v", trial, "--out", shop / "page"),
        "compare": ("compare", "-v", trial, trial),
        "show": ("show", trial, "--out", shop / "page.html"),
    }[name]
    assert inside(*words, cwd=shop).returncode == 0
    falsify(fit if whose == "upstream" else trial)
    done = inside(*words, cwd=shop)
    assert done.returncode == 3
    run = "fit_1" if whose == "upstream" else "trial_1"
    assert f"{run}: 'run.json'" in done.stdout + done.stderr
    if name == "show":
        assert run in (shop / "page.html").read_text().partition("</header>")[0]


def test_a_run_of_an_older_method_is_marked(shop, monkeypatch):
    newer = METHODS | {"output_error": METHODS["output_error"] + 1}
    monkeypatch.setattr(versions, "METHODS", newer)
    changes = origin("bulk_modulus", shop / "reports" / "fit_1").values["changes"]
    assert len(changes) == 1 and "output_error" in changes[0]


def test_a_shop_moved_as_a_whole_still_bears_its_numbers(shop, tmp_path_factory):
    there = tmp_path_factory.mktemp("moved") / "shop"
    shutil.move(shop, there)
    for name in ("fit_1", "maps_1", "report_1"):
        (there / "reports" / name / "volatile.json").unlink()
    for file in ("fit.toml", "maps.toml", "maps.csv", "one.csv", "two.csv", "rig.toml"):
        shutil.copy(there / file, there / "reports" / file)
    assert origin("bulk_modulus", there / "reports" / "fit_1").values["changes"] == []


def test_a_file_in_place_of_a_run_folder_is_named_as_it_is(tmp_path):
    (tmp_path / "fit.toml").write_text(RECIPE)
    with pytest.raises(InputError, match="is no run folder") as caught:
        origin("bulk_modulus", tmp_path / "fit.toml")
    assert str(caught.value.file).endswith("fit.toml")
