"""`ehbench check` on recipes: every mistake that files show, with its place, nothing run."""

import shutil
from pathlib import Path

import pytest

from ehbench import data, workflow
from ehbench.app import inspection
from ehbench.data import read
from ehbench.data.logs import write_log
from ehbench.vocabulary.commands import COMMANDS
from ehbench.vocabulary.errors import InputError, InsufficientData, ModelRejected
from tests.shared import ROOT

STEPS, ARC, OWN = "trials/velocity_steps.toml", "trials/arc_slow.toml", "trials/own_controller.toml"
CHAIN, TUNING, FIT = "thesis/steps_simulated.toml", "thesis/tuning.toml", "thesis/hydraulics.toml"
JUDGED, MAPS, ALL = "thesis/validation.toml", "thesis/flow_maps.toml", "thesis/campaign.toml"
FEW = "slide_servo/campaign.toml"  # of two recipes: all that a campaign names is checked with it
SLIDE_TUNING, SLIDE_JUDGED = "slide_servo/tuning.toml", "slide_servo/validation.toml"  # few logs
FLOWS = "thesis_arm/flowmeter/hect.csv"
RIG = 'rig = "../rigs/thesis_arm.toml"'
MOTION = (
    '[[motion]]\nname = "30 %%"\nkind = "velocity_steps"\ncylinder = "boom"\nlevels = ["30 %%"]\n'
)
MOTION += 'travel = "%d mm"'
OPEN, METHOD = 'kind = "open_loop"', 'method = "output_error"'
FROM = 'gains = { from = "tuning.toml", '
BOTH = 'recipes = ["hydraulics.toml", "validation.toml"]'
SLIDE = "../../datasets/slide_servo/heldout/press_no_load.mcap"
GAIN = 'gains = { feedback_gain = "8e-11 m^3/(s*Pa)", '
COMMAND = RIG + '\n‹command = [{ valve = "%s", kind = "constant", offset = "%s" }]'
BOOM = '"../../datasets/thesis_arm/steps/boom_50lb.mcap"'


@pytest.fixture
def recipes(tmp_path, monkeypatch) -> Path:
    """The shipped recipes that are named here, beside the datasets, without runs."""
    for name in ("bench", "rigs", "slide_servo", "thesis", "trials"):
        shutil.copytree(ROOT / "recipes" / name, tmp_path / "recipes" / name)
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "recipes"


def changed(recipes: Path, file: str, old: str, new: str) -> Path:
    path = recipes / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


# file, what it says, what is written instead (‹ marks the line of the error), words of the error
MISTAKES = [
    (STEPS, 'payloads = ["none", "50 lb"]', '‹payloads = ["none", "60 lb"]', "'60 lb'"),
    (STEPS, 'posture = { boom = "40 mm" }', '‹posture = { boom = "400 mm" }', "254.0 mm"),
    (STEPS, "posture = { boom", "‹posture = { bom", "'bom'"),
    (STEPS, MOTION % 150, "‹" + MOTION % 350, "leaves the stroke"),
    (STEPS, 'cylinder = "boom"', '‹cylinder = "bom"', "'bom'"),
    (STEPS, 'levels = ["70 %"]', 'levels = ["70"]', "'70'"),
    (STEPS, GAIN + "washout", "‹" + GAIN + "washot", "'washout'"),
    (STEPS, OPEN, OPEN + '\n‹rules = { dwel = "1 s" }', "'dwell'"),
    (STEPS, OPEN, OPEN + '\n‹unused = ["boom.rex"]', "'boom.rex'"),
    (STEPS, 'stroke_margin = "2 mm"', '‹stroke_margin = "60 mm"', "stroke_margin"),
    (STEPS, RIG, RIG + '\non = "bench"\n‹bench = "../bench/slide_servo.toml"', "'thesis_arm'"),
    (STEPS, RIG, RIG + '\non = "bench"\n‹bench = "../bench/thesis_arn.toml"', "'thesis_arm.toml'"),
    (STEPS, RIG, COMMAND % ("stick.servo", "30 V"), "-10 to 10 V"),
    (STEPS, RIG, COMMAND % ("stick.sevo", "3 V"), "'stick.sevo'"),
    (STEPS, RIG, COMMAND % ("boom.hect", "3 V"), "boom.hect"),
    (ARC, 'kind = "arc"', 'kind = "arc"\n‹gains = "../thesis/tunin.toml"', "'tuning.toml'"),
    (ARC, 'kind = "arc"', 'kind = "arc"\n‹gains = "../thesis/validation.toml"', "'validate'"),
    (OWN, 'class = "own_controller:', '‹class = "own_controler:', "'own_controler'"),
    (CHAIN, FROM + "washout", "‹" + FROM + "washot", "'washot'"),
    (CHAIN, 'rig = "validation.toml"', '‹rig = "validatio.toml"', "'validation.toml'"),
    (SLIDE_TUNING, "title =", '‹cylinder = "bom"\ntitle =', "'bom'"),
    (SLIDE_TUNING, 'payloads = ["none"]', '‹payloads = ["60 lb"]', "'60 lb'"),
    (SLIDE_TUNING, "title =", '‹functions = ["extend"]\ntitle =', "'extend'"),
    (FIT, '"boom.friction_coulomb"', '"boom.friction_colomb"', "'boom.friction_coulomb'"),
    (FIT, 'bulk_modulus = "800 MPa"', '‹bulk_modulus = "800 V"', "'V'"),
    (FIT, '["eq_2_12", "eq_2_17"]', '["eq_2_12", "eq_2_18"]', "'eq_2_18'"),
    (FIT, BOOM, "‹" + BOOM.replace("50lb", "51lb"), "'boom_50lb.mcap'"),
    (FIT, BOOM, f'{{ path = {BOOM}, payload = "55 lb" }}', "'55 lb'"),
    (FIT, BOOM, f'"{SLIDE}"', "'thesis_arm'"),
    (FIT, METHOD, METHOD + '\n‹cutoff = "700 Hz"', "half the rate"),
    (SLIDE_JUDGED, '["x", "v", "p_head", "p_rod"]', '‹["flow_head"]', "'flow_head'"),
    (SLIDE_JUDGED, "slide_servo/heldout/press_no_load.mcap", FLOWS, "hect.csv"),
    (MAPS, "rigs/thesis_arm.toml", "rigs/slide_servo.toml", "no metering edge 'hect'"),
    (FEW, BOTH, 'recipes = [\n  "hydraulics.toml",\n‹  "validatio.toml"]', "'validation.toml'"),
    (FEW, BOTH, '‹recipes = ["hydraulics.toml", "../bench/slide_servo.toml"]', "'bench'"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("file", "old", "new", "words"), MISTAKES)
def test_a_mistake_is_found_without_a_run(recipes, file, old, new, words):
    path = changed(recipes, file, old, new.replace("‹", ""))
    found = inspection.check(path)
    assert found.code == 2, found.lines
    (error,) = found.errors
    assert words in str(error)
    if "‹" in new:
        marked = new.partition("‹")[2].partition("\n")[0]
        line = path.read_text().splitlines()[error.line - 1]
        assert error.file == str(path) and marked in line, error
    assert not Path("reports").exists()


@pytest.mark.parametrize(
    "header, row, told",
    [
        ("flow [L/min],pressure_drop [bar]", "3,12.5", "drops 12.5 bar to 12.5 bar, flow up to 3"),
        ("flow [gpm],method", "3,cylinder", "no pressures, flow up to 3 gpm"),
    ],
)
def test_readings_are_told_in_the_units_of_their_file(tmp_path, header, row, told):
    path = tmp_path / "readings.csv"
    path.write_text(f"valve,command [V],{header}\nk1,2,{row}\n")
    assert f"k1 forward: 1 reading at 1 command, {told}" in inspection.check(path).lines[1]


def test_numbers_of_a_rig_without_a_source_are_counted(recipes, tmp_path):
    """Those of data sheets, once that is no longer said."""

    def line(path: Path) -> str:
        return next(line for line in inspection.check(path).lines if "sources" in line)

    own = recipes / "rigs" / "slide_servo.toml"
    (tmp_path / "rig.toml").write_text(own.read_text().replace(', source = "datasheet" }', " }"))
    told = line(own)
    assert "datasheet" in told and "without" not in told
    assert line(tmp_path / "rig.toml") == told.replace("datasheet", "without a source")


def test_a_log_in_which_nothing_is_commanded_does_not_support_a_fit(recipes, tmp_path):
    still = recipes.parent / "still.mcap"
    record = read(ROOT / "datasets/slide_servo/heldout/press_no_load.mcap")
    short = {n: v[:50] for n, v in record.channels.items()}
    write_log(still, type(record)(record.t[:50], short, record.meta))
    fit, more = "slide_servo/hydraulics.toml", 'data = [\n  "../../still.mcap",'
    found = inspection.check(changed(recipes, fit, "data = [", more))
    assert found.code == InsufficientData.exit_code and "no valve command" in str(found.errors[0])


def test_all_mistakes_of_a_campaign_are_told_at_once(recipes):
    changed(recipes, FIT, '"eq_2_17"]', '"eq_2_18"]')
    changed(recipes, TUNING, 'cylinder = "boom"', 'cylinder = "bom"')
    changed(recipes, "thesis/arc_bench.toml", '"50 lb"', '"55 lb"')
    found = inspection.check(recipes / ALL)
    # the last of the rig with the five valves, and of that with the four-way valve
    files = ["hydraulics.toml", "tuning.toml", "arc_bench.toml", "arc_bench.toml"]
    assert [Path(error.file).name for error in found.errors] == files


def test_gains_that_do_not_fit_are_refused_before_anything_is_run(recipes):
    """The runs that the recipe names take minutes."""
    path = changed(recipes, CHAIN, 'washout = "0 rad/s", ', 'wash_out = "0 rad/s", ')
    with pytest.raises(InputError, match="has no gains 'wash_out'"):
        workflow.run(path)
    assert not Path("reports").exists()


def test_what_has_not_been_run_is_said_and_the_rig_file_behind_it_taken(recipes):
    found = inspection.check(recipes / CHAIN)
    chain = ["flow_maps.toml", "hydraulics.toml", "validation.toml", "tuning.toml"]
    assert found.notes.required == chain
    assert {"name": "validation.toml", "root": "../rigs/thesis_arm.toml"} in [
        note.fields for note in found.notes.remarks
    ]
    undecided = {(note.key, note.fields.get("name")) for note in found.notes.undecided}
    assert ("stages.gains_not_run", "tuning.toml") in undecided
    assert ("stages.maps_not_run", "flow_maps.toml") in undecided
    assert found.notes.does.fields["factors"] == "2 payloads × 3 motions × 4 controllers"
    assert found.notes.writes.startswith("reports/steps_simulated_<hash>: ")
    assert found.lines[-1] == "ok"
    assert not Path("reports").exists()


def test_a_run_that_stands_is_taken(recipes, slide_runs):
    shutil.copytree(slide_runs, "reports")
    session = workflow.Session(keep=True)
    made = workflow.run(recipes / "slide_servo" / "validation.toml", session)
    (recipes / "tune.toml").write_text('stage = "tune"\nrig = "slide_servo/validation.toml"\n')
    found = inspection.check(recipes / "tune.toml")
    assert f"  reads: {made.folder} (rig 'slide_servo', validated)" in found.lines
    assert not found.notes.required
    lines = [line for line in found.lines if "tune_" in line]
    assert any(line.endswith(": tuning.json, rig.toml, figures") for line in lines)
    assert inspection.check(recipes / "slide_servo" / "validation.toml").notes.is_current


def test_a_rig_that_is_not_validated_is_told(recipes):
    (recipes / "tune.toml").write_text('stage = "tune"\nrig = "rigs/slide_servo.toml"\n')
    found = inspection.check(recipes / "tune.toml")
    assert found.code == 0 and any("--unvalidated" in line for line in found.lines)
    with pytest.raises(ModelRejected):
        workflow.run(recipes / "tune.toml")


def test_a_trial_is_refused_with_the_tuning_that_it_would_run_first(recipes):
    (recipes / "tune.toml").write_text(
        'stage = "tune"\nrig = "rigs/thesis_arm.toml"\ncylinder = "boom"\n'
    )
    trial = changed(recipes, CHAIN, FROM, FROM.replace("tuning.toml", "../tune.toml"))
    found = inspection.check(trial)
    assert (found.code, [error.key for error in found.errors]) == (4, ["stages.not_validated"])
    option = "--" + found.errors[0].hint.rpartition("--")[2]
    command = next(command for command in COMMANDS if command.name == "run-trial")
    assert option[2:] in command.options


def test_bandwidths_are_not_chosen_where_no_trial_would_take_them(recipes):
    """Margins of a law whose model lacks a part of the rig were said to be met."""
    rig = recipes / "rigs" / "slide_servo.toml"
    mount = '[cylinder.mount]\nstiffness = "50 kN/mm"\ndamping = "4 kN*s/m"\n\n[[cylinder.valve]]'
    soft = rig.read_text().replace("[[cylinder.valve]]", mount, 1)
    (recipes / "rigs" / "soft.toml").write_text(soft)
    tune = recipes / "tune.toml"
    tune.write_text('stage = "tune"\nwhat = "arc"\nrig = "rigs/soft.toml"\n')
    found = inspection.check(tune)
    assert found.code == 2 and found.errors[0].key == "control.arc_lacks_part"
    assert "tune.toml:2" in str(found.errors[0])
    tune.write_text('stage = "tune"\nrig = "rigs/soft.toml"\n')
    assert inspection.check(tune).code == 0


def test_a_log_that_the_rig_is_fitted_to_is_told(recipes):
    path = changed(recipes, JUDGED, "heldout/swing_no_load", "steps/swing_no_load")
    found = inspection.check(path)
    (note,) = [note for note in found.notes.remarks if note.key == "stages.fitted_to"]
    name = "../../datasets/thesis_arm/steps/swing_no_load.mcap"
    assert note.fields == {"name": name, "recipe": "hydraulics.toml"}


def test_lost_data_are_told_with_3(recipes):
    whole = ROOT / "datasets/slide_servo/heldout/press_no_load.mcap"
    (recipes.parent / "cut.mcap").write_bytes(whole.read_bytes()[: int(0.8 * whole.stat().st_size)])
    held = "../../datasets/slide_servo/heldout/press_no_load"
    path = changed(recipes, "slide_servo/validation.toml", held, "../../cut")
    found = inspection.check(path)
    assert found.code == 3 and any("lost: cut.mcap" in line for line in found.lines)


def test_each_log_is_read_once_whatever_is_wrong(recipes, monkeypatch):
    taken = []
    monkeypatch.setattr(
        data, "read", lambda path, **given: taken.append(path) or read(path, **given)
    )
    (recipes / "a.csv").write_text("t [s],x\n0,1\n")
    path = changed(
        recipes, JUDGED, "../../datasets/thesis_arm/heldout/swing_no_load.mcap", "../a.csv"
    )
    assert [error.key for error in inspection.check(path).errors] == ["data.label_without_unit"]
    assert len(taken) == len(set(taken))


def test_code_is_not_run(recipes):
    (recipes / "trials" / "own_controller.py").write_text("raise SystemExit('ran')\n")
    found = inspection.check(recipes / OWN)
    assert found.code == 0
    assert "stages.is_code" in {note.key for note in found.notes.remarks}
    assert "stages.code_not_run" in {note.key for note in found.notes.undecided}


def test_recipes_in_a_circle_are_named(recipes):
    (recipes / "a.toml").write_text('stage = "tune"\nrig = "b.toml"\n')
    (recipes / "b.toml").write_text('stage = "validate"\nrig = "a.toml"\ndata = ["x.mcap"]\n')
    (error,) = inspection.check(recipes / "a.toml").errors
    assert error.key == "stages.circle" and error.fields["names"] == "a.toml → b.toml → a.toml"


@pytest.mark.parametrize(("level", "is_timed"), [('"30 %"', False), ('"50 mm/s"', True)])
def test_edges_without_their_maps_leave_the_rest_to_be_checked(recipes, level, is_timed):
    rig = (recipes / "rigs" / "slide_servo.toml").read_text()
    rig = rig.replace('law = "orifice"', 'law = "map"')
    (recipes / "rigs" / "mapped.toml").write_text(rig)
    head = 'stage = "trial"\nrig = "rigs/mapped.toml"\n[motion]\nkind = "velocity_steps"\n'
    law = '[controller]\nkind = "open_loop"\n'
    path = recipes / "t.toml"
    mine = head + f'levels = [{level}]\nduration = "1 s"\n' + law
    path.write_text(mine)
    found = inspection.check(path)
    notes = {note.key: note for note in found.notes.undecided}
    assert found.code == 0
    assert "press.servo_head_tank" in notes["stages.without_maps"].fields["edges"]
    assert ("stages.stroke_unknown" in notes) != is_timed
    path.write_text(mine + 'gains = { of_gain = "1 s" }\n')
    assert "'off_gain'" in str(inspection.check(path).errors[0])
    path.write_text(head + 'levels = ["50 mm/s"]\nduration = "9 s"\n' + law)
    assert "leaves the stroke" in str(inspection.check(path).errors[0])


DATA = 'data = ["nothing.mcap", "empty.csv",'


def test_all_mistakes_of_a_rig_file_and_of_logs_are_shown_at_once(recipes):
    """A list whose entries are wrong, and a key that is misspelt, are no second mistake."""
    rig = changed(
        recipes, "rigs/slide_servo.toml", 'bore = { value = "50 mm"', 'bore = { value = "50 kg"'
    )
    changed(recipes, "rigs/slide_servo.toml", "stroke =", "strokes =")
    fit = changed(recipes, "slide_servo/hydraulics.toml", "data = [", DATA)
    (fit.parent / "empty.csv").write_text("a,b\n")
    errors = inspection.check(fit).errors
    assert [Path(str(error.file)).name for error in errors] == [rig.name] * 2 + [
        fit.name,
        "empty.csv",
    ]
    assert {error.key for error in errors} >= {"config.unknown_key", "stages.no_file"}
    with pytest.raises(InputError) as refusal:  # a run begins with none of them
        workflow.run(fit)
    assert [str(error) for error in (refusal.value, *refusal.value.others)] == [
        *map(str, errors[:2])
    ]
    shutil.copy(ROOT / "recipes" / "rigs" / rig.name, rig)
    for name in ("a", "b"):  # what two logs share is wrong once
        (fit.parent / f"{name}.csv").write_text("t,p\n0,1\n1,2\n2,3\n")
    (fit.parent / "m.toml").write_text('[names]\nt = "t [s]"\np = "press.p_head [kg]"\n')
    entries = [f'{{ path = "{name}.csv", columns = "m.toml" }}' for name in ("a", "b")]
    both = changed(recipes, "slide_servo/hydraulics.toml", DATA, f"data = [{','.join(entries)},")
    with pytest.raises(InputError) as refusal:
        workflow.run(both)
    assert refusal.value.line == 3 and not refusal.value.others
    changed(recipes, "slide_servo/hydraulics.toml", f"data = [{','.join(entries)},", DATA)
    with pytest.raises(InputError) as refusal:
        workflow.run(fit)
    assert not refusal.value.others and "nothing.mcap" in str(refusal.value)
    assert refusal.value.line == fit.read_text().splitlines().index(DATA) + 1
