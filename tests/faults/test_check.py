"""`ehbench check` on recipes: every mistake that the files alone show, where it stands, and nothing
run or written.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.data import read
from ehbench.data.logs import write_log
from ehbench.vocabulary.errors import InputError, InsufficientData, ModelRejected

ROOT = Path(__file__).parents[2]
STEPS, ARC, OWN = "trials/velocity_steps.toml", "trials/arc_slow.toml", "trials/own_controller.toml"
CHAIN, TUNING, FIT = "thesis/steps_simulated.toml", "thesis/tuning.toml", "thesis/hydraulics.toml"
JUDGED, MAPS, ALL = "thesis/validation.toml", "thesis/flow_maps.toml", "thesis/campaign.toml"
FEW = "slide_servo/campaign.toml"  # of two recipes: all that a campaign names is checked with it
RIG = 'rig = "../rigs/thesis_arm.toml"'
STEP = 'name = "30 %"\nkind = "velocity_steps"\ncylinder = "boom"\nlevels = ["30 %"]\n'
GAIN = 'gains = { feedback_gain = "8e-11 m^3/(s*Pa)", '
COMMAND = RIG + '\n‹command = [{ valve = "%s", kind = "constant", offset = "%s" }]'
BOOM = '"../../datasets/thesis_arm/steps/boom_50lb.mcap"'


@pytest.fixture
def recipes(tmp_path, monkeypatch) -> Path:
    """A copy of the shipped recipes that are named here, beside the datasets, in a folder without
    runs.
    """
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


# file, what stands there, what is written instead, words of the error, which is on the line behind
# ‹
@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            STEPS,
            'payloads = ["none", "50 lb"]',
            '‹payloads = ["none", "60 lb"]',
            "no payload '60 lb' (it has 50 lb, 100 lb)",
        ),
        (
            STEPS,
            'posture = { boom = "40 mm" }',
            '‹posture = { boom = "400 mm" }',
            "outside the stroke (0 to 254.0 mm)",
        ),
        (STEPS, "posture = { boom", "‹posture = { bom", "'bom', which is no cylinder or joint"),
        (
            STEPS,
            f'[[motion]]\n{STEP}travel = "150 mm"',
            f'‹[[motion]]\n{STEP}travel = "350 mm"',
            "leaves the stroke",
        ),
        (
            STEPS,
            'cylinder = "boom"',
            '‹cylinder = "bom"',
            "no cylinder 'bom' (it has swing, boom, stick)",
        ),
        (STEPS, 'levels = ["70 %"]', 'levels = ["70"]', "'70' has no unit"),
        (
            STEPS,
            GAIN + "washout",
            "‹" + GAIN + "washot",
            "no gains 'washot' (did you mean 'washout'?)",
        ),
        (
            STEPS,
            'kind = "open_loop"',
            'kind = "open_loop"\n‹rules = { dwel = "1 s" }',
            "no rules 'dwel' (did you mean 'dwell'?)",
        ),
        (
            STEPS,
            'kind = "open_loop"',
            'kind = "open_loop"\n‹unused = ["boom.rex"]',
            "no valve 'boom.rex'",
        ),
        (
            STEPS,
            'stroke_margin = "2 mm"',
            '‹stroke_margin = "60 mm"',
            "cannot start: boom.x = 40 mm passed stroke_margin",
        ),
        (
            STEPS,
            RIG,
            RIG + '\non = "bench"\n‹bench = "../bench/slide_servo.toml"',
            "has other cylinders than rig 'thesis_arm'",
        ),
        (
            STEPS,
            RIG,
            RIG + '\non = "bench"\n‹bench = "../bench/thesis_arn.toml"',
            "(did you mean 'thesis_arm.toml'?)",
        ),
        (STEPS, RIG, COMMAND % ("stick.servo", "30 V"), "its range is -10 to 10 V"),
        (STEPS, RIG, COMMAND % ("stick.sevo", "3 V"), "has no valve 'stick.sevo'"),
        (STEPS, RIG, COMMAND % ("boom.hect", "3 V"), "is the controller's"),
        (
            ARC,
            'kind = "arc"',
            'kind = "arc"\n‹gains = "../thesis/tunin.toml"',
            "(did you mean 'tuning.toml'?)",
        ),
        (
            ARC,
            'kind = "arc"',
            'kind = "arc"\n‹gains = "../thesis/validation.toml"',
            "of stage 'validate' (name a tune recipe",
        ),
        (OWN, 'class = "own_controller:', '‹class = "own_controler:', "no module 'own_controler'"),
        (
            CHAIN,
            'gains = { from = "tuning.toml", washout',
            '‹gains = { from = "tuning.toml", washot',
            "no gains 'washot'",
        ),
        (
            CHAIN,
            'rig = "validation.toml"',
            '‹rig = "validatio.toml"',
            "(did you mean 'validation.toml'?)",
        ),
        (TUNING, 'cylinder = "boom"', '‹cylinder = "bom"', "no cylinder 'bom'"),
        (
            TUNING,
            'payloads = ["none", "50 lb"]',
            '‹payloads = ["60 lb"]',
            "no payload '60 lb'",
        ),
        (
            TUNING,
            'cylinder = "boom"',
            'cylinder = "boom"\n‹functions = ["extend"]',
            "no working function 'extend'",
        ),
        (
            FIT,
            '  "swing.friction_coulomb", "boom.friction_coulomb"',
            '  "swing.friction_coulomb", "boom.friction_colomb"',
            "no parameter 'boom.friction_colomb' (nearest is 'boom.friction_coulomb')",
        ),
        (
            FIT,
            'bulk_modulus = "800 MPa"',
            '‹bulk_modulus = "800 V"',
            "'V' cannot be turned into Pa",
        ),
        (
            FIT,
            'compare_dynamics = ["eq_2_12", "eq_2_17"]',
            '‹compare_dynamics = ["eq_2_12", "eq_2_18"]',
            "no dynamics 'eq_2_18'",
        ),
        (FIT, BOOM, "‹" + BOOM.replace("50lb", "51lb"), "(did you mean 'boom_50lb.mcap'?)"),
        (
            FIT,
            BOOM,
            f'{{ path = {BOOM}, payload = "55 lb" }}',
            "boom_50lb: rig 'thesis_arm' has no payload '55 lb'",
        ),
        (
            FIT,
            BOOM,
            '"../../datasets/slide_servo/heldout/press_no_load.mcap"',
            "no channel is of a cylinder of rig 'thesis_arm'",
        ),
        (
            FIT,
            'method = "output_error"',
            'method = "output_error"\n‹cutoff = "700 Hz"',
            "not below half the rate",
        ),
        (
            JUDGED,
            "title =",
            '‹channels = ["flow_head"]\ntitle =',
            "cannot be judged on channel 'flow_head'",
        ),
        (JUDGED, "heldout/swing_no_load.mcap", "flowmeter/hect.csv", "hect.csv"),
        (
            FEW,
            'recipes = ["hydraulics.toml", "validation.toml"]',
            'recipes = [\n  "hydraulics.toml",\n‹  "validatio.toml"]',
            "(did you mean 'validation.toml'?)",
        ),
        (
            FEW,
            'recipes = ["hydraulics.toml", "validation.toml"]',
            '‹recipes = ["hydraulics.toml", "../bench/slide_servo.toml"]',
            "is of stage 'bench', which no campaign runs",
        ),
    ],
)
def test_a_mistake_is_found_without_a_run(recipes, file, old, new, words):
    path = changed(recipes, file, old, new.replace("‹", ""))
    found = inspection.check(path)
    assert found.code == 2 and found.lines[-1] == "1 mistake", found.errors
    (error,) = found.errors
    assert words in str(error)
    if "‹" in new:
        marked = new.partition("‹")[2].partition("\n")[0]
        assert (
            error.file == str(path) and marked in path.read_text().splitlines()[error.line - 1]
        ), error
    assert not Path("reports").exists()


def test_readings_of_another_rig_are_found(recipes):
    found = inspection.check(
        changed(recipes, MAPS, "rigs/thesis_arm.toml", "rigs/slide_servo.toml")
    )
    assert "rig 'slide_servo' has no metering edge 'hect'" in str(found.errors[0])


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
        return next(one for one in inspection.check(path).lines if "how sure" in one)

    own = recipes / "rigs" / "slide_servo.toml"
    (tmp_path / "rig.toml").write_text(own.read_text().replace(', source = "datasheet" }', " }"))
    told = line(own)
    assert "datasheet" in told and "without" not in told
    assert line(tmp_path / "rig.toml") == told.replace("datasheet", "without a source")


def test_a_log_in_which_nothing_is_commanded_does_not_support_a_fit(recipes, tmp_path):
    still = recipes.parent / "still.mcap"
    record = read(ROOT / "datasets/slide_servo/heldout/press_no_load.mcap")
    write_log(
        still,
        type(record)(record.t[:50], {n: v[:50] for n, v in record.channels.items()}, record.meta),
    )
    path = changed(
        recipes, "slide_servo/hydraulics.toml", "data = [", 'data = [\n  "../../still.mcap",'
    )
    found = inspection.check(path)
    assert found.code == InsufficientData.exit_code and "no valve command" in str(found.errors[0])


def test_all_mistakes_of_a_campaign_are_told_at_once(recipes):
    changed(recipes, FIT, '"eq_2_17"]', '"eq_2_18"]')
    changed(recipes, TUNING, 'cylinder = "boom"', 'cylinder = "bom"')
    changed(recipes, "thesis/arc_bench.toml", '"50 lb"', '"55 lb"')
    found = inspection.check(recipes / ALL)
    assert [Path(error.file).name for error in found.errors] == [
        "hydraulics.toml",
        "tuning.toml",
        "arc_bench.toml",  # of the rig with the five valves, and of that with the four-way valve
        "arc_bench.toml",
    ]
    assert found.lines[-1] == "4 mistakes"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('washout = "0 rad/s", ', 'wash_out = "0 rad/s", ', "has no gains 'wash_out'"),
        ('washout = "0 rad/s", ', 'washout = "0 bar", ', "washout: 'bar' cannot be turned"),
        ('{ from = "tuning.toml", washout', "{ washout", "feedback_gain"),
    ],
)
def test_gains_that_do_not_fit_are_refused_before_anything_is_run(recipes, old, new, said):
    """The runs that the recipe names take minutes."""
    path = changed(recipes, CHAIN, old, new)
    line = next(i for i, text in enumerate(path.read_text().splitlines(), 1) if new in text)
    with pytest.raises(InputError) as refused:
        workflow.run(path)
    assert said in f"{refused.value.message} {refused.value.hint}"
    assert abs(refused.value.line - line) <= 5  # that of the gain, or of the controller's table
    assert not Path("reports").exists()


def test_what_has_not_been_run_is_said_and_the_rig_file_behind_it_taken(recipes):
    said = "\n".join(inspection.check(recipes / CHAIN).lines)
    assert "runs first: flow_maps.toml, hydraulics.toml, validation.toml, tuning.toml" in said
    assert (
        "note: 'validation.toml' has not been run: checked against ../rigs/thesis_arm.toml" in said
    )
    assert "not checked: what hangs on the gains: 'tuning.toml' has not been run" in said
    assert "not checked: what hangs on the flow maps: 'flow_maps.toml' has not been run" in said
    assert "it runs 24 trials (2 payloads × 3 motions × 4 controllers) on the model" in said
    assert (
        "writes: reports/steps_simulated_<hash>: a log and a ledger for each trial" in said
        and said.endswith("ok")
    )
    assert not Path("reports").exists()


def test_a_run_that_stands_is_taken(recipes, slide_runs):
    shutil.copytree(slide_runs, "reports")
    session = workflow.Session(keep=True)
    made = workflow.run(recipes / "slide_servo" / "validation.toml", session)
    (recipes / "tune.toml").write_text('stage = "tune"\nrig = "slide_servo/validation.toml"\n')
    found = inspection.check(recipes / "tune.toml")
    assert f"  reads: {made.folder} (rig 'slide_servo', validated)" in found.lines
    assert not any("not been run" in line for line in found.lines)
    assert any(
        line.endswith(": tuning.json, rig.toml, figures") and "tune_" in line
        for line in found.lines
    )
    stands = inspection.check(recipes / "slide_servo" / "validation.toml").lines
    assert any(line.startswith(f"  writes: {made.folder}, which stands") for line in stands)


def test_a_rig_that_is_not_validated_is_told(recipes):
    (recipes / "tune.toml").write_text('stage = "tune"\nrig = "rigs/slide_servo.toml"\n')
    found = inspection.check(recipes / "tune.toml")
    assert found.code == 0 and any("--unvalidated" in line for line in found.lines)
    with pytest.raises(ModelRejected):
        workflow.run(recipes / "tune.toml")


def test_bandwidths_are_not_chosen_where_no_trial_would_take_them(recipes):
    """Margins of a law whose model lacks a part of the rig were said to be met."""
    rig = recipes / "rigs" / "slide_servo.toml"
    force = '[[cylinder.force]]\nkind = "constant"\nforce = "100 N"\n\n[[cylinder.valve]]'
    pushed = rig.read_text().replace("[[cylinder.valve]]", force, 1)
    (recipes / "rigs" / "pushed.toml").write_text(pushed)
    tune = recipes / "tune.toml"
    tune.write_text('stage = "tune"\nwhat = "arc"\nrig = "rigs/pushed.toml"\n')
    found = inspection.check(tune)
    assert found.code == 2 and "knows no [[cylinder.force]]" in str(found.errors[0])
    assert "tune.toml:2" in str(found.errors[0])
    tune.write_text('stage = "tune"\nrig = "rigs/pushed.toml"\n')
    assert inspection.check(tune).code == 0


def test_a_log_that_the_rig_is_fitted_to_is_told(recipes):
    found = inspection.check(
        changed(recipes, JUDGED, "heldout/swing_no_load", "steps/swing_no_load")
    )
    name = "../../datasets/thesis_arm/steps/swing_no_load.mcap"
    assert f"  note: {name} does not count: hydraulics.toml fits the rig to it" in found.lines


def test_lost_data_are_told_with_3(recipes):
    whole = ROOT / "datasets/slide_servo/heldout/press_no_load.mcap"
    (recipes.parent / "cut.mcap").write_bytes(whole.read_bytes()[: int(0.8 * whole.stat().st_size)])
    path = changed(
        recipes,
        "slide_servo/validation.toml",
        "../../datasets/slide_servo/heldout/press_no_load",
        "../../cut",
    )
    found = inspection.check(path)
    assert found.code == 3 and any("lost: cut.mcap" in line for line in found.lines)


def test_code_is_not_run(recipes):
    (recipes / "trials" / "own_controller.py").write_text("raise SystemExit('ran')\n")
    found = inspection.check(recipes / OWN)
    assert found.code == 0 and any("--allow-code" in line for line in found.lines)
    assert any(
        line.startswith("  not checked: what 'own_controller:PositionFeedback' does")
        for line in found.lines
    )


def test_recipes_in_a_circle_are_named(recipes):
    (recipes / "a.toml").write_text('stage = "tune"\nrig = "b.toml"\n')
    (recipes / "b.toml").write_text('stage = "validate"\nrig = "a.toml"\ndata = ["x.mcap"]\n')
    (error,) = inspection.check(recipes / "a.toml").errors
    assert "needs itself: a.toml → b.toml → a.toml" in str(error)


@pytest.mark.parametrize(
    ("level", "words"), [('"30 %"', "shares of what the flow maps allow"), ('"50 mm/s"', "")]
)
def test_edges_without_their_maps_leave_the_rest_to_be_checked(recipes, level, words):
    rig = (
        (recipes / "rigs" / "slide_servo.toml")
        .read_text()
        .replace('law = "orifice"', 'law = "map"')
    )
    (recipes / "rigs" / "mapped.toml").write_text(rig)
    head = 'stage = "trial"\nrig = "rigs/mapped.toml"\n[motion]\nkind = "velocity_steps"\n'
    law = '[controller]\nkind = "open_loop"\n'
    path = recipes / "t.toml"
    path.write_text(head + f'levels = [{level}]\nduration = "1 s"\n' + law)
    found = inspection.check(path)
    assert found.code == 0 and any(
        "hangs on the flow maps of press.servo_head_tank" in line for line in found.lines
    )
    assert any(words and words in line for line in found.lines) == bool(words)
    path.write_text(
        head + f'levels = [{level}]\nduration = "1 s"\n' + law + 'gains = { of_gain = "1 s" }\n'
    )
    assert "no gains 'of_gain' (did you mean 'off_gain'?)" in str(inspection.check(path).errors[0])
    path.write_text(head + 'levels = ["50 mm/s"]\nduration = "9 s"\n' + law)
    assert "leaves the stroke" in str(inspection.check(path).errors[0])
