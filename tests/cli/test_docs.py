"""The docs say what the models say: every key of a rig file with its symbol, unit, range and
default; every example loads.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
import tomli_w

from ehbench import inspection, recipe, rig
from ehbench.fields import Q
from ehbench.quantities import Quantity
from ehbench.recipe import load_rig
from ehbench.units import from_si

PAGE = Path(__file__).parents[2] / "docs" / "rig_file.md"
MODELS = [
    item
    for item in vars(rig).values()
    if isinstance(item, type) and issubclass(item, rig.FileModel) and item is not rig.FileModel
]
EXAMPLES = (
    re.findall(r"```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    if PAGE.exists()
    else []
)


def parts(annotation: Any) -> list[Any]:
    """An annotation and all that it is made of."""
    return [annotation, *(found for part in get_args(annotation) for found in parts(part))]


def marks(field: Any) -> list[Any]:
    """What a field's annotation carries beside its type."""
    return [
        *field.metadata,
        *(mark for part in parts(field.annotation) for mark in getattr(part, "__metadata__", ())),
    ]


def number(value: float, row: Quantity) -> str:
    return f"{from_si(value, row.display, row):.4g}"


def unit(row: Quantity) -> str:
    return "–" if row.display == "dimensionless" else row.display


def cells(name: str, field: Any) -> tuple[str, str, str, str, str]:
    """(key, symbol, unit or kind, range, default) of a field, as the page has to have them."""
    key = f"`{field.alias or name}`"
    default = "needed" if field.is_required() else "none"
    row = next((mark.row for mark in marks(field) if isinstance(mark, Q)), None)
    if row is not None:
        count = {"com": "3 × ", "inertia": "6 × "}.get(name, "")
        low, high = (number(value, row) for value in (row.lower, row.upper))
        if isinstance(field.default, rig.Value):
            default = number(float(field.default), row)
        return key, row.symbol, count + unit(row), f"{low} … {high}", default
    kinds = parts(field.annotation)
    choices = next((get_args(kind) for kind in kinds if get_origin(kind) is Literal), ())
    tables = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, rig.FileModel)]
    if get_origin(field.annotation) is dict:
        kind = "tables by name" if tables else "units by name"
    elif tables:
        kind = "list of tables" if any(get_origin(kind) is tuple for kind in kinds) else "table"
    else:
        kind = (
            "choice"
            if choices
            else "list of pairs"
            if any(get_origin(kind) is tuple for kind in kinds)
            else "text"
        )
    if choices and not field.is_required():
        default = f"`{field.default}`"
    return key, "", kind, ", ".join(f"`{choice}`" for choice in choices), default


def rows(model: type[rig.FileModel]) -> list[tuple[str, ...]]:
    """The rows of the table under the heading that names a model."""
    found = re.search(
        rf"<!-- {model.__name__} -->\n(.*?)(?:\n\n|\Z)", PAGE.read_text(encoding="utf-8"), re.S
    )
    assert found, f"docs/rig_file.md has no table <!-- {model.__name__} -->"
    lines = [
        tuple(cell.strip() for cell in line.strip("| ").split(" | "))
        for line in found[1].splitlines()
    ]
    return lines[2:]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_key_of_a_rig_file_has_its_row(model):
    expected = [cells(name, field) for name, field in model.model_fields.items()]
    written = rows(model)
    assert [row[:5] for row in written] == expected
    assert all(len(row) == 6 and len(row[5]) > 3 for row in written)


def test_every_stage_and_every_key_of_a_campaign_stands_on_the_page_of_recipes(tmp_path):
    page = (PAGE.parent / "recipes.md").read_text(encoding="utf-8")
    for stage, what in recipe.recipe_kinds():
        assert f"`{stage}`" in page and (what is None or f'`what = "{what}"`' in page)
    (tmp_path / "campaign.toml").write_text(
        *re.findall(r"```toml\n(.*?)```", page, re.S), encoding="utf-8"
    )
    given = recipe.load_recipe(tmp_path / "campaign.toml").model_fields_set
    assert given >= set(recipe.Campaign.model_fields) - {"path", "note"}


def test_every_word_for_how_sure_a_number_is_stands_on_the_page():
    assert all(f"| `{word}` |" in PAGE.read_text(encoding="utf-8") for word in rig.SURENESS)


@pytest.mark.parametrize("text", EXAMPLES, ids=lambda text: text.splitlines()[0].strip("# "))
def test_every_example_is_part_of_a_rig_that_checks(text, tmp_path):
    """Each example takes the place of what the whole one at the top of the page has."""
    made, part = tomllib.loads(EXAMPLES[0]), tomllib.loads(text)
    if isinstance(
        part.get("cylinder"), dict
    ):  # [[cylinder.valve]] alone belongs to the cylinder of the whole one
        part["cylinder"] = [made["cylinder"][0] | part["cylinder"]]
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(made | part), encoding="utf-8")
    lines = inspection.check(tmp_path / "rig.toml").lines
    assert lines[-1] == "ok" and not any("note:" in line for line in lines)
    given = load_rig(tmp_path / "rig.toml").as_toml()
    assert all(key in given for key in part)
