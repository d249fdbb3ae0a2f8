"""What a command prints: a verdict, a table, at most three steps with a line to paste."""

import json
import re
import shutil
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.config.recipe import kind_of, load_recipe
from ehbench.report.terminal import answer, report_answer
from ehbench.runs.rundir import read_json
from ehbench.stages import stage_of
from ehbench.vocabulary.commands import COMMANDS
from tests.answers import short
from tests.shared import ROOT
from tests.unit import report_runs as runs
from tests.unit.test_versions import made

LOG = ROOT / "datasets" / "slide_servo" / "steps" / "press_no_load.mcap"


@pytest.fixture(scope="module")
def place(slide_runs, boom_maps, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("words")
    for runs_of in (slide_runs, boom_maps):
        shutil.copytree(runs_of, folder / "reports", dirs_exist_ok=True)
    for name in ("recipes", "datasets"):
        (folder / name).symlink_to(ROOT / name)
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("check", "recipes/rigs/thesis_arm.toml"),
        ("check", LOG),
        ("check", "recipes/slide_servo/campaign.toml"),
        ("map", LOG, "--rig", "recipes/rigs/slide_servo.toml"),
        ("convert", LOG, "--to", "mat"),
        ("show", LOG),
        ("reproduce", "slide_servo"),
        ("next", "hydraulics"),
        ("why", "bulk_modulus", "hydraulics"),
        ("compare", "hydraulics", "hydraulics"),
        ("report", "hydraulics", "validation"),
    ],
    ids=lambda words: " ".join(str(Path(word).name) for word in words[:2]),
)
def test_each_command_is_short(words, place, inside, undrawn):
    runs = {run.name.rpartition("_")[0]: run for run in (place / "reports").iterdir()}
    done = inside(*(runs.get(word, word) for word in words), cwd=place)
    assert done.returncode == 0, done.stderr
    short(done.stdout)
    assert not re.search("(?m)^note: ", done.stderr)


NO_COMMAND = ("bench", "dataset")
CHEAP = (
    *("slide_servo/response", "slide_servo/tuning", "slide_servo/arc_tuning"),
    *("studies/stopping_trial", "trials/arc_slow", "trials/velocity_steps"),
)


def short_run(folder: Path) -> None:
    """Fail unless a run tells in few words what it found."""
    facts = read_json(folder / "run.json")
    short("\n".join(answer(folder, facts["notes"], facts["code"]).lines()))


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEAP)
def test_each_cheap_recipe_is_short(name, place, inside, undrawn, unlocused):
    path = Path("recipes") / f"{name}.toml"
    stage = stage_of(load_recipe(ROOT / path))
    assert stage.command in {item.name for item in COMMANDS}
    done = inside(stage.command, path, "--json", cwd=place)
    assert done.stdout, done.stderr
    values = json.loads(done.stdout)
    assert all(step["key"].startswith("steps.") for step in values["steps"])
    assert {"verdict", "notes", "folder", "code"} <= values.keys()
    notes = [note["text"] for note in values["notes"]]
    short("\n".join(answer(place / values["folder"], notes, values["code"]).lines()))
    assert not re.search("(?m)^note: ", done.stderr)


@pytest.mark.slow
def test_each_run_that_stands_is_short(slide_runs, boom_maps):
    stand = [
        run
        for runs_of in (slide_runs, boom_maps)
        for run in runs_of.iterdir()
        if not run.name.startswith("campaign")
    ]
    assert len(stand) == 3
    for run in stand:
        short_run(run)


@pytest.mark.slow
def test_the_pump_cylinder_is_identified_and_accepted_in_few_words(made_once, undrawn, tmp_path):
    """From a log of its virtual rig slip and damping are found; the held-out log follows."""
    (fit,) = made_once("v_lift", lambda root: made(root, "lift")).glob("lift_*")
    shipped = ROOT / "recipes" / "pump_cylinder" / "validation.toml"
    text = shipped.read_text().replace("hydraulics.toml", str(fit)).replace("../..", str(ROOT))
    (tmp_path / "judge.toml").write_text(text)
    run = workflow.run(tmp_path / "judge.toml", workflow.Session(root=tmp_path))
    assert run.code == workflow.DONE
    judged, rows = run.folder, read_json(fit / "parameters.json")["parameters"]
    status = {row["name"]: row["status"] for row in rows}
    for name in ("bulk_modulus", "table.damping", "lift.pump.slip"):
        assert status[name] == "estimated"
    assert read_json(judged / "validation.json")["accepted"]
    for folder in (fit, judged):
        short_run(folder)


RECIPES = {
    path.relative_to(ROOT / "recipes").with_suffix("").as_posix(): load_recipe(path)
    for path in sorted((ROOT / "recipes").rglob("*.toml"))
    if kind_of(path) == "recipe"
}
RECIPES = {name: item for name, item in RECIPES.items() if item.kind()[0] not in NO_COMMAND}
OTHERS = [name for name in RECIPES if name not in CHEAP]
# a run of each kind, whose tables a run of a recipe takes the place of
STORED = {
    "flow_map": runs.flow_map_run,
    "hydraulics": runs.hydraulics_run,
    "validation": runs.validation_run,
    "tune": runs.tune_run,
    "trial": runs.trial_run,
    "trials": lambda root: runs.trials_run(root, "many", runs.PAIR | runs.TRACKED),
    "response": lambda root: runs.table_run(root, "response", "slide_servo"),
    "arc_tuning": lambda root: runs.table_run(root, "arc_tuning", "slide_servo", "tuning"),
    "study": lambda root: runs.table_run(root, "study", "thesis_arm"),
    "export": lambda root: runs.table_run(root, "export", "slide_servo"),
}


def stored(root: Path, name: str) -> Path:
    """A run as a recipe would leave it, of a kind that takes long to make."""
    recipe = RECIPES[name]
    kind = recipe.kind()[1] or recipe.kind()[0]
    run = STORED[{"validate": "validation", "arc": "arc_tuning"}.get(kind, kind)](root)
    facts = json.loads((run / "run.json").read_text())
    facts |= {"name": recipe.name, "title": recipe.title or recipe.name}
    facts["recipe"]["path"] = f"recipes/{name}.toml"
    (run / "run.json").write_text(json.dumps(facts))
    return run


@pytest.mark.parametrize("name", OTHERS)
def test_every_other_recipe_would_be_short(name, tmp_path):
    """With as many notes as a run may have, and a limit that stopped it."""
    recipe, notes = RECIPES[name], [f"log: {i}" for i in "abc"]
    if recipe.kind()[0] != "campaign":
        short("\n".join(answer(stored(tmp_path, name), notes, 3, True).lines()))
        return
    folder, inputs = tmp_path / "campaign", []
    for place, file in enumerate(recipe.recipes):
        inside = f"{Path(name).parent.as_posix()}/{Path(file).stem}"
        run = stored(tmp_path / str(place), inside)
        inputs.append({"role": "run", "path": str(run), "sha256": "0"})
    folder.mkdir()
    facts = runs.table("facts", stage="report", name="campaign", inputs=inputs)
    (folder / "run.json").write_text(json.dumps(facts))
    text = "\n".join(report_answer(folder, notes).lines())
    assert "in the report" in text
    short(text)


def test_every_recipe_is_of_a_kind_that_is_looked_at():
    assert len(OTHERS) + len(CHEAP) == len(RECIPES) > 50


@pytest.mark.parametrize(
    "words", [("show", LOG), ("convert", LOG, "--to", "mat"), ("init", "ws")], ids=lambda w: w[0]
)
def test_commands_without_a_run_have_json_as_well(words, inside, tmp_path):
    known = json.loads(inside(*words, "--json", cwd=tmp_path).stdout)
    assert {"verdict", "steps", "notes", "folder"} <= known.keys()
    assert known["verdict"]["key"].startswith("app.") and (tmp_path / known["folder"]).exists()


def test_a_verbose_check_as_json_is_json_alone(inside):
    done = inside("check", ROOT / "recipes/rigs/slide_servo.toml", "-v", "--json")
    assert json.loads(done.stdout)["lines"][0].startswith("rig 'slide_servo'")


def test_an_error_is_json_too_where_a_command_is_asked_for_it(inside, tmp_path):
    text = (ROOT / "recipes" / "slide_servo" / "hydraulics.toml").read_text()
    (tmp_path / "fit.toml").write_text('colour = "red"\n' + text)
    done = inside("identify", "fit.toml", "--json", cwd=tmp_path)
    known = json.loads(done.stdout)
    assert known["code"] == done.returncode == 2
    (item,) = known["errors"]
    assert (item["key"], item["line"]) == ("config.unknown_key", 1)
    assert item["text"] in done.stderr and item["file"].endswith("fit.toml")
