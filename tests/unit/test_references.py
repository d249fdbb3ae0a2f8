"""Figures of others beside a model's own: what a recipe may say, and the table in the report."""

import pytest
from pydantic import ValidationError

from ehbench.config.recipe.validate import Reference
from ehbench.report.saved import Table
from ehbench.report.stages.validation import others_rows
from ehbench.report.template import Template
from tests.shared import RIGS, shipped


def test_figures_of_others_stand_beside_the_model_s_own():
    page = Template("validation", shipped("slide_servo"))
    others = [
        {"name": "ARX", "channel": "press.p_head", "measure": "rms_error", "source": "paper"}
        | {"value": 3e5},
        {"name": "GP", "channel": "press.p_head", "measure": "rms_error", "source": "notebook"}
        | {"value": 1e5},
    ]
    log = {"name": "second_half", "channels": [{"channel": "press.p_head", "rms_error": 2e5}]}
    rows = others_rows(Table({"logs": [log], "references": others}, RIGS))
    grid = page.table("others", rows)
    names = [getattr(row[0], "text", row[0]) for row in grid.rows]
    assert names == ["GP", "this model", "ARX"]
    assert [getattr(row[3], "text", "") for row in grid.rows] == ["1", "2", "3"]
    assert all(row[4] == "bar" for row in grid.rows)
    assert not others_rows(Table({"logs": [log]}, RIGS))


@pytest.mark.parametrize("value", ["3 mm", "-3 bar", "-0.1 bar", True])
def test_a_figure_of_others_has_the_channel_s_unit(value):
    given = {"name": "a", "channel": "press.p_head", "value": value, "source": "b"}
    with pytest.raises(ValidationError, match="for Reference\nvalue"):
        Reference.model_validate(given)
    with pytest.raises(ValidationError, match="not a fit in percent"):
        Reference.model_validate(given | {"measure": "fit_percent", "value": "3 bar"})
