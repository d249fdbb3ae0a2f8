"""Campaigns: every shipped recipe is sound, and the same campaign twice gives the same bytes."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.stages.dry_run import DryRun
from tests.shared import ROOT, contents

RECIPES = sorted((ROOT / "recipes").rglob("*.toml"))


@pytest.fixture(scope="module")
def dry_run() -> DryRun:
    """One for all recipes: those that several name are prepared once."""
    return DryRun(workflow.ROOT)


@pytest.mark.slow
@pytest.mark.parametrize("folder", sorted({path.parent.name for path in RECIPES}))
def test_every_recipe_and_all_it_names_is_sound(folder, dry_run):
    """A folder at a time, whose recipes name each other, by one worker of a parallel run."""
    if folder == "real" and not os.environ.get("EHBENCH_DATA"):
        pytest.skip("EHBENCH_DATA does not say where these recordings are")
    for path in (path for path in RECIPES if path.parent.name == folder):
        found = inspection.check(path, dry_run)
        assert found.code == 0 and found.lines[-1] == "ok", path


@pytest.mark.slow
def test_a_check_takes_maps_that_stand_already(boom_maps):
    """Of a recipe that waits for another one, which has the maps of a finished run."""
    recipe = ROOT / "recipes" / "boom_four_valve" / "validation.toml"
    assert inspection.check(recipe, DryRun(boom_maps)).errors == ()


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.relative_to(ROOT / "recipes").as_posix())
def test_every_recipe_says_what_it_is_for(path):
    assert path.read_text().startswith("# ")


def test_every_recipe_of_the_docs_is_there():
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for name in re.findall(r"(?<![\w/])(recipes/[\w/]+\.toml)", page.read_text()):
            places = (ROOT / name, ROOT / "ehbench" / "workspace" / name)
            assert any(place.is_file() for place in places), f"{page.name} names {name}"


@pytest.mark.slow
def test_the_same_campaign_twice_gives_the_same_bytes(slide_runs, tmp_path):
    recipe = ROOT / "recipes" / "slide_servo" / "campaign.toml"
    made = workflow.run(recipe, workflow.Session(root=tmp_path / "again"))
    assert made.code == workflow.DONE
    one, two = contents(slide_runs), contents(tmp_path / "again")
    assert one.keys() == two.keys() and any(name.endswith("report.html") for name in one)
    assert [name for name in one if one[name] != two[name]] == []


@pytest.mark.slow
def test_a_run_that_stands_is_kept_and_a_damaged_one_is_made_again(slide_runs, undrawn, tmp_path):
    recipe = ROOT / "recipes" / "slide_servo" / "validation.toml"
    (stands,) = slide_runs.glob("hydraulics_*")
    source = Path(shutil.copytree(stands, tmp_path / stands.name))
    before = (source / "volatile.json").stat().st_mtime_ns
    made = workflow.run(recipe, workflow.Session(root=tmp_path))
    assert (source / "volatile.json").stat().st_mtime_ns == before
    (source / "parameters.json").write_text("{}")
    workflow.run(recipe, workflow.Session(root=tmp_path))
    assert json.loads((source / "parameters.json").read_text())["parameters"]
    assert made.json("validation")["accepted"]
    assert made.rig.parameters()["bulk_modulus"].sure == "identified"
