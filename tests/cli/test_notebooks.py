"""The notebooks run from their first cell to their last."""

import json
import shutil

import pytest
from matplotlib import pyplot

from tests.shared import ROOT

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
