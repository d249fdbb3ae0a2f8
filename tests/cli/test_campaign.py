"""Campaigns: every shipped recipe is sound, and the same campaign twice gives the same bytes."""

import os
import re
import shutil
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.app import inspection
from ehbench.stages.dry_run import DryRun
from tests.answers import short
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
        short("\n".join(found.answer(path).lines()))


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
def test_a_damaged_run_is_made_again_to_the_same_bytes_and_one_that_stands_is_kept(
    slide_runs, tmp_path, request
):
    """By a campaign of whose runs one is there, damaged, and then by a recipe that needs it."""
    (stands,) = slide_runs.glob("hydraulics_*")
    fit = Path(shutil.copytree(stands, tmp_path / stands.name))
    (fit / "parameters.json").write_text("{}")
    session = workflow.Session(root=tmp_path)
    made = workflow.run(ROOT / "recipes" / "slide_servo" / "campaign.toml", session)
    assert made.code == workflow.DONE
    one, two = contents(slide_runs), contents(tmp_path)
    assert any(name.endswith("report.html") for name in one)
    assert [name for name in one if one[name] != two.get(name)] == []
    assert two.keys() - one.keys() == {f"salvaged/{fit.name}/parameters.json"}
    before = (fit / "volatile.json").stat().st_mtime_ns
    request.getfixturevalue("undrawn")
    request.getfixturevalue("undiagnosed")
    judged = workflow.run(ROOT / "recipes" / "slide_servo" / "validation.toml", session)
    assert (fit / "volatile.json").stat().st_mtime_ns == before
    assert judged.json("validation")["accepted"]
    assert judged.rig.parameters()["bulk_modulus"].sure == "identified"
