"""ehbench: the workbench for people who run electrohydraulic test rigs.

    import ehbench
    rig = ehbench.load_rig("recipes/rigs/thesis_arm.toml")
    log = ehbench.simulate(rig, {"boom.hepc": 4.0, "boom.rect": 8.0}, duration=1.0)
    run = ehbench.identify("recipes/thesis/flow_maps.toml")
    maps = ehbench.load_flow_maps(run.folder)

Everything is SI inside; `ehbench.quantities` names each quantity with its unit.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Sums of one BLAS thread have one order, so the same input gives the same bytes; small systems are
# quicker that way too.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from ehbench.logs import read_log as read_log
    from ehbench.physics.flow_map import load_flow_maps as load_flow_maps
    from ehbench.plant.model import simulate as simulate
    from ehbench.recipe import load_rig as load_rig
    from ehbench.workflow import Outcome, Progress

__all__ = ["identify", "load_flow_maps", "load_rig", "read_log", "simulate", "validate"]

# imported when first used, so that `import ehbench` and `ehbench --help` are quick
_HOME = {
    "load_flow_maps": "ehbench.physics.flow_map",
    "load_rig": "ehbench.recipe",
    "read_log": "ehbench.logs",
    "simulate": "ehbench.simulation",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ehbench' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def identify(
    recipe: str | Path, *, out: str | Path | None = None, progress: Progress | None = None
) -> Outcome:
    """Run a recipe of stage ``identify``: flow maps from readings, or hydraulics from step logs.

    Args:
        recipe: its TOML file.
        out: the run's folder; ``reports/<recipe>_<hash8>/`` by default.
        progress: called with a sentence and the share done.

    Returns:
        The outcome: ``.folder``, ``.code``, ``.notes``, and what the run saved: ``.rig``,
            ``.flow_maps``, ``.json("parameters")``.

    Raises:
        InputError: a bad recipe or bad data; says file, line and what would be right.
        InsufficientData: the data do not support the fit.
    """
    return _run(recipe, "identify", out, progress)


def validate(
    recipe: str | Path, *, out: str | Path | None = None, progress: Progress | None = None
) -> Outcome:
    """Run a recipe of stage ``validate``; ``.code`` is 4 when the rig is rejected and
    ``.json("validation")`` says why.

    Args:
        recipe: its TOML file.
        out: the run's folder; ``reports/<recipe>_<hash8>/`` by default.
        progress: called with a sentence and the share done.

    Raises:
        InputError: a bad recipe or bad data; says file, line and what would be right.
    """
    return _run(recipe, "validate", out, progress)


def _run(
    recipe: str | Path, stage: str, out: str | Path | None, progress: Progress | None
) -> Outcome:
    from ehbench import workflow

    workflow.expect_stage(Path(recipe), stage)
    return workflow.run(
        Path(recipe), workflow.Desk(out=None if out is None else Path(out), progress=progress)
    )
