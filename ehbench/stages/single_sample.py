"""One sample of a study as a recipe of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ehbench.config.recipe import Recipe, load_recipe
from ehbench.report.bearing import Made
from ehbench.stages.base import Host, Stage, stage_of
from ehbench.stages.findings import Findings
from ehbench.stages.inputs import Inputs, Runs
from ehbench.stages.kept import write_sample
from ehbench.stages.study import PreparedStudy
from ehbench.vocabulary.errors import InputError


class Asking(Host, Runs, Protocol):
    """The session that asks for a sample."""

    @property
    def allow_code(self) -> bool: ...

    @property
    def unvalidated(self) -> bool: ...


def again(study: Path, index: int, host: Asking) -> Recipe:
    """`ehbench.workflow.sample`."""
    path = study
    if study.is_dir():
        built = Made(study)
        if built.recipe.place is None or not built.recipe.is_same:
            raise InputError(
                "its recipe is not found, or has changed since",
                file=study,
                hint="name the study's recipe to take the sample as it is now",
            )
        path = built.recipe.place
    recipe = load_recipe(path)
    stage = stage_of(recipe)
    if recipe.stage_name != "study" or not isinstance(stage, Stage):
        raise InputError("is no study", file=path, hint="write STUDY#417, a study's run or recipe")
    allowed = {"allow_code": host.allow_code, "unvalidated": host.unvalidated}
    prepared = stage.prepare(recipe, Inputs(recipe, Findings(recipe), host, **allowed))
    assert isinstance(prepared, PreparedStudy)
    if not 0 <= index < prepared.design.size:
        raise InputError(
            f"has no sample {index}", file=study, hint=f"it has 0 to {prepared.design.size - 1}"
        )
    folder = host.root / f"{recipe.name}_{prepared.key[:8]}_{index}"
    folder.mkdir(parents=True, exist_ok=True)
    return load_recipe(write_sample(prepared.plan, prepared.design, index, folder))
