"""The docs say what the models say: every key, example, snippet and name."""

import importlib
import json
import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from matplotlib import pyplot
from typer.main import get_command

from ehbench.app import cli, inspection
from ehbench.config import recipe, rig
from ehbench.config.recipe import load_rig
from ehbench.parts.edge.orifice import ORIFICE_DROP
from ehbench.parts.supply import RECOVERY_TIME
from ehbench.vocabulary.fields import SURENESS
from tests.shared import ROOT
from tools import reference

FILES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in FILES}
WHOLE = {f"docs/{name}": page for name, page in reference.WHOLE_PAGES.items()}
REFERENCE = [page for page in PAGES if page.startswith("docs/reference/") and page not in WHOLE]
ALL_KEYS = "\n".join(PAGES[page] for page in REFERENCE)
TABLES = reference.pages()
MODELS = reference.models([rig.Rig, *reference.recipe_models()])


def blocks(page: str, kind: str) -> list[str]:
    """The fenced blocks of a language in a page."""
    return re.findall(rf"```{kind}\n(.*?)```", PAGES[page], re.S)


EXAMPLES = [(page, text) for page in PAGES for text in blocks(page, "toml")]
RECIPES = [text for _, text in EXAMPLES if re.search("^stage", text, re.M)]
OTHER = r"^stage|^\[(names|response)"  # recipes, and tables of a map or of a response
RIGS = [text for page, text in EXAMPLES if page in REFERENCE and not re.search(OTHER, text, re.M)]


# --- the reference of all keys


@pytest.mark.parametrize("page", WHOLE)
def test_pages_made_as_a_whole_are_current(page):
    assert PAGES[page] == WHOLE[page]()


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_stands_in_a_table_and_no_other(model):
    """Of a model and those that it inherits from, as pydantic takes them."""
    written = {
        key.strip("`")
        for base in model.__mro__
        if (match := re.search(rf"<!-- {base.__name__} -->\n((?:\|.*\n)+)", ALL_KEYS))
        for key in reference.read_table(match[1])
    }
    fields = model.model_fields.items()
    assert written == {field.alias or name for name, field in fields if not field.exclude}


def test_every_stage_is_in_the_reference():
    for stage, what in recipe.recipe_kinds():
        keys = f'`stage = "{stage}"`' + ("" if what is None else f', `what = "{what}"`')
        assert f"\n{keys}" in ALL_KEYS, keys


@pytest.mark.parametrize("model", [recipe.Command, recipe.Motion])
def test_every_kind_of_command_and_motion_is_documented(model):
    for kind in model.model_fields["kind"].annotation.__args__:
        assert f"\n| `{kind}` | " in "".join(PAGES.values())


def test_every_word_for_provenance_is_in_the_reference():
    assert all(f"| `{word}` |" in ALL_KEYS for word in SURENESS)


def test_fixed_numbers_of_the_plant_are_in_the_reference():
    time = f"a time constant of {1e3 * RECOVERY_TIME:g} ms, a fixed number"
    assert time in PAGES["docs/reference/rig_file.md"]
    assert f"Δp/(Δp² + ({1e-3 * ORIFICE_DROP:g} kPa)²)^¼" in PAGES["docs/reference/valves.md"]


def test_the_generator_writes_and_checks(tmp_path, monkeypatch, capsys):
    """The tables of the docs are as the models make them; a change of either is told."""
    monkeypatch.setattr(reference, "DOCS", tmp_path)
    monkeypatch.setattr(reference, "WHOLE_PAGES", {})  # `test_pages_made_as_a_whole_are_current`
    (tmp_path / "reference").mkdir()
    for name in TABLES:
        (tmp_path / name).write_text(PAGES[f"docs/{name}"], encoding="utf-8")
    assert reference.main(["--check"]) == 0
    (name,) = (name for name in TABLES if "| `max_iterations` |" in PAGES[f"docs/{name}"])
    page, text = tmp_path / name, PAGES[f"docs/{name}"]
    page.write_text(text.replace("| `max_iterations` |", "| `iterations` |"))
    changed = page.read_text()
    assert reference.main(["--check"]) == 2
    assert "`max_iterations`" in capsys.readouterr().err and page.read_text() == changed
    page.write_text(text.replace("| 1 … 1000 | `100` |", "| 1 … 10 | `20` |"))
    assert reference.main(["--check"]) == 1
    assert f"docs/{name}: make reference" in capsys.readouterr().err
    assert reference.main([]) == 0 and page.read_text() == text


def heading_anchors(page: str) -> set[str]:
    """The anchors of a page's headings, as a web page makes them."""
    headings = re.findall(r"^#+ (.+)$", PAGES[page], re.M)
    return {re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in headings}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_and_every_name_of_the_package_leads_somewhere(page):
    for name, anchor in re.findall(r"\]\((?!https?:)([^)#]*)(?:#([\w-]+))?\)", PAGES[page]):
        target = (ROOT / page).parent.joinpath(name).resolve() if name else ROOT / page
        assert target.exists(), f"{page} links {name}"
        if anchor:
            where = target.relative_to(ROOT).as_posix()
            assert anchor in heading_anchors(where), f"{page} links {name}#{anchor}"
    for dotted in re.findall(r"\b(?<![/\w])ehbench(?:\.[A-Za-z_]\w*)+", PAGES[page]):
        assert resolved(dotted) is not None
    for path in re.findall(
        r"`((?:ehbench|tests|recipes|datasets|docs)/[\w/.]*(?:/|\.\w+))`", PAGES[page]
    ):
        assert (ROOT / path).exists() or path == "ehbench/facts.json", path  # a name inside a log


def words(page: str) -> int:
    """The words of a page without its generated tables."""
    return len(re.sub(r"<!-- \w[\w ]* -->\n(?:\|.*\n)*", "", PAGES[page]).split())


def test_pages_and_bullets_are_short():
    """README, how-to pages, all pages, and all of them together, as CONTRIBUTING says."""
    limits = {"README.md": 1200, "docs/howto/": 1500, "docs/architecture.md": 1500, "": 4000}
    most = {
        page: next(n for start, n in limits.items() if page.startswith(start)) for page in PAGES
    }
    long = {page: words(page) for page in PAGES if words(page) > most[page]}
    assert long == {}
    assert sum(words(page) for page in PAGES if page != "CONTRIBUTING.md") <= 40_000
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    bullets = re.findall(r"^- ((?:.+\n)(?:  .+\n)*)", text, re.M)
    assert len(bullets) > 50 and [b for b in bullets if len(b.split()) > 25] == []
    assert set(re.findall("^### (.+)$", text, re.M)) <= {"Breaking", "Added", "Changed", "Fixed"}


def test_workflows_call_targets_that_exist():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        for line in re.findall(r"run: make (.+)", path.read_text()):
            assert set(line.split()) <= targets, f"{path.name}: make {line}"
    assert "make check" in (ROOT / ".ci" / "run").read_text()


# --- examples of files


@pytest.mark.parametrize("text", RIGS, ids=lambda text: text.splitlines()[0].strip("# "))
def test_every_example_is_part_of_a_rig_that_checks(text, tmp_path):
    """Each example takes the place of what the complete one of the reference has."""
    made, part = tomllib.loads(blocks("docs/reference/rig_file.md", "toml")[0]), tomllib.loads(text)
    # [[cylinder.valve]] alone belongs to the cylinder of the whole one
    if isinstance(part.get("cylinder"), dict):
        part["cylinder"] = [made["cylinder"][0] | part["cylinder"]]
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(made | part), encoding="utf-8")
    lines = inspection.check(tmp_path / "rig.toml").lines
    assert lines[-1] == "ok" and not any("note:" in line for line in lines)
    given = load_rig(tmp_path / "rig.toml").as_toml()
    assert all(key in given for key in part)


@pytest.mark.parametrize("text", RECIPES, ids=lambda text: tomllib.loads(text)["stage"])
def test_every_recipe_in_the_docs_loads(text, tmp_path):
    (tmp_path / "recipe.toml").write_text(text, encoding="utf-8")
    assert recipe.load_recipe(tmp_path / "recipe.toml").stage == tomllib.loads(text)["stage"]


def test_the_recipes_of_the_reference_check(tmp_path):
    """Next to the rig that they name; and the campaign of the reference has every key."""
    (tmp_path / "rigs").symlink_to(ROOT / "recipes" / "rigs")
    seen = set()
    for text in (text for page in REFERENCE for text in blocks(page, "toml") if text in RECIPES):
        (tmp_path / "recipe.toml").write_text(text, encoding="utf-8")
        given = recipe.load_recipe(tmp_path / "recipe.toml")
        seen.add(given.stage)
        if given.stage == "campaign":
            assert given.model_fields_set >= set(recipe.Campaign.model_fields) - {"path", "note"}
        else:
            found = inspection.check(tmp_path / "recipe.toml")
            assert found.errors == () and found.lines[-1] == "ok", found
    assert seen == {"trial", "bench", "campaign"}


# --- commands

COMMANDS = [
    (page, line)
    for page in PAGES
    for line in re.findall(r"^    (?:\.venv/bin/)?ehbench (.+)$", PAGES[page], re.M)
]


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=lambda text: text.split("/")[-1])
def test_every_command_has_its_options(page, line):
    """As the command line takes them; the files need not be there."""
    words = shlex.split(line, comments=True)
    command = get_command(cli.app).get_command(None, words[0])
    assert command is not None, f"{page}: ehbench {line}"
    command.make_context(words[0], words[1:], resilient_parsing=False).close()


# --- Python


@pytest.mark.slow
@pytest.mark.parametrize("page", [name for name in PAGES if blocks(name, "python")])
def test_every_snippet_runs(page, workspace, kept, undrawn, monkeypatch):
    """In the order of the page, whose CSV is the ``step.csv`` that it reads."""
    monkeypatch.chdir(workspace)
    for text in blocks(page, "csv"):
        Path("step.csv").write_text(text, encoding="utf-8")
    names: dict[str, Any] = {}
    for number, text in enumerate(blocks(page, "python"), 1):
        exec(compile(text, f"{page}, snippet {number}", "exec"), names)
    pyplot.close("all")


def test_pages_with_snippets_are_found():
    pages = {name for name in PAGES if blocks(name, "python")}
    assert "README.md" in pages and len(pages) >= 5


def resolved(dotted: str) -> Any:
    """What a dotted name of the package names."""
    parts = dotted.split(".")
    for size in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:size]))
        except ModuleNotFoundError:
            continue
        for part in parts[size:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


# --- the notebooks run from their first cell to their last

FOLDER = ROOT / "docs" / "notebooks"
BOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", BOOKS, ids=lambda path: path.stem)
def test_every_cell_runs_and_none_holds_outputs(
    path, boom_maps, undrawn, tmp_path, monkeypatch, capsys
):
    """As they stand in the repository: no outputs, so that none can be out of date."""
    for name in ("recipes", "datasets"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(boom_maps, tmp_path / "reports")  # where runs are that a recipe calls for
    monkeypatch.chdir(tmp_path)
    book, space = json.loads(path.read_text(encoding="utf-8")), {"__name__": "__main__"}
    for cell in book["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
            exec(compile("".join(cell["source"]), path.name, "exec"), space)
    pyplot.close("all")
    told = capsys.readouterr().out
    assert "accepted" in told and "4.000 V for that flow" in told
    assert space["page"].is_file()
    assert {"estimated"} >= set(space["found"].parameters.loc[["bulk_modulus"], "status"])


def test_there_is_a_notebook():
    assert BOOKS
