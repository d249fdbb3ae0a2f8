"""Rigs and recipes from their files."""

from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from ehbench.config.recipe.base import Recipe
from ehbench.config.recipe.toml import line_of, read_text, read_toml, table_of, validated
from ehbench.config.rig import Rig
from ehbench.vocabulary import InputError, shortened


def load_rig(path: str | Path) -> Rig:
    """The rig of a TOML file, or of a run folder that holds an identified rig (``rig.toml``).

    Example:
        rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
        rig.parameters()["bulk_modulus"]

    Raises:
        InputError: with file, line, key, value and the nearest valid key."""
    path = Path(path)
    if path.is_dir():
        path = path / "rig.toml"
    return _rig(read_text(path), path)


@lru_cache(maxsize=32)
def _rig(text: str, path: Path) -> Rig:
    """The rig of a file's text; one campaign reads it dozens of times."""
    rig = validated(Rig, table_of(text, path), text, path)
    if rig.model is None:
        return rig
    model = rig.model.model_copy(update={"place": (path.parent / rig.model.fmu).resolve()})
    return rig.model_copy(update={"model": model})


def recipe_kinds() -> dict[tuple[str, str | None], type[Recipe]]:
    """Every recipe model by its ``stage`` and ``what`` (None where the stage has one kind): all
    subclasses of `Recipe` with a stage of their own, those of stages elsewhere once imported."""
    results: dict[tuple[str, str | None], type[Recipe]] = {}
    waiting = Recipe.__subclasses__()
    while waiting:
        model = waiting.pop(0)
        waiting += model.__subclasses__()
        if "stage" in model.model_fields:
            results[model.kind()] = model
    return results


def load_recipe(path: str | Path) -> Recipe:
    """The recipe of a TOML file, of the type its ``stage`` (and ``what``) names.

    Raises:
        InputError: with file, line, key, value and the nearest valid key."""
    path = Path(path)
    table, text = read_toml(path)
    known = recipe_kinds()
    stage, what = table.get("stage"), table.get("what")
    stages = sorted({s for s, _ in known})

    def refusal(key: str, given: object, choices: str) -> InputError:
        wrong = f"unknown {key} = {shortened(given, 60)}"
        where: dict[str, Any] = {"file": path, "line": line_of(text, (key,))}
        hint = f"{key} is one of {choices}"
        return InputError(f"'{key}' is missing" if given is None else wrong, hint=hint, **where)

    if not isinstance(stage, str) or stage not in stages:
        raise refusal("stage", stage, ", ".join(stages))
    named = [w for s, w in known if s == stage and w]
    requested = what if named else None  # else its model refuses the key
    model = known.get((stage, requested)) if isinstance(requested, str | None) else None
    if model is None:
        without = ", or left out" if (stage, None) in known else ""
        raise refusal("what", what, ", ".join(named) + without)
    return validated(model, table, text, path).model_copy(update={"path": path.resolve()})


def kind_of(path: Path) -> Literal["rig", "recipe", "map"]:
    """Whether a TOML file is a rig (mechanism), a recipe (stage) or a map of columns (names)."""
    table, _ = read_toml(path)
    if "stage" not in table and "names" in table:
        return "map"
    return "recipe" if "stage" in table or "mechanism" not in table else "rig"
