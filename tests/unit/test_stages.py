"""Every stage is whole: a recipe model of its own, a command, a section in the report."""

from __future__ import annotations

import pytest

from ehbench.app.cli import app
from ehbench.config import recipe
from ehbench.report.stages import SECTIONS
from ehbench.stages import REGISTRY, Stage
from ehbench.vocabulary.commands import COMMANDS

STAGES = [stage for stage in REGISTRY.values() if isinstance(stage, Stage)]
KNOWN = {one.name or one.callback.__name__ for one in app.registered_commands}


def test_every_kind_of_recipe_has_its_stage():
    assert recipe.recipe_kinds() == {kind: stage.recipe for kind, stage in REGISTRY.items()}


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name)
def test_a_stage_has_a_command_and_a_section(stage):
    assert stage.command in KNOWN and stage.writes
    assert stage.name in SECTIONS or stage.name == "campaign"  # a campaign is the page itself


def test_every_command_that_runs_recipes_has_a_stage():
    assert {one.name for one in COMMANDS} < {stage.command for stage in STAGES} <= KNOWN
