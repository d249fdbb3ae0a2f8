"""What several test modules share; one BLAS thread, as the package's own runs have, before numpy is
loaded.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("MPLBACKEND", "agg")

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402

from ehbench import starter, workflow  # noqa: E402

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def workspace(tmp_path_factory) -> Path:
    """Where the examples of docs and docstrings run: beside the repository's recipes and datasets,
    a new workspace ``my_rig``, and a run ``reports/flow_maps`` of one valve's readings.
    """
    folder = tmp_path_factory.mktemp("docs")
    for name in ("recipes", "datasets"):
        (folder / name).symlink_to(ROOT / name)
    starter.init(folder / "my_rig")
    recipe = folder / "one_valve.toml"
    recipe.write_text(
        'stage = "identify"\nwhat = "flow_map"\nrig = "recipes/rigs/boom_four_valve.toml"\n'
        'data = ["datasets/boom_four_valve/flowmeter/sh.csv"]\n',
        encoding="utf-8",
    )
    workflow.run(recipe, workflow.Session(out=folder / "reports" / "flow_maps"))
    return folder
