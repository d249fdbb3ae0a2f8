"""Draw saved results: a run's figures, and one HTML page over many runs; re-runs nothing."""

from pathlib import Path

from ehbench.report.page import build
from ehbench.report.saved import FigureIndex, Saved
from ehbench.report.stages import report_of

__all__ = ["build", "draw"]


def draw(folder: Path) -> None:
    """Draw a run folder's figures; which ones, its ``run.json`` says. A kind without figures
    leaves an empty index.

    Raises:
        InputError: a saved file is missing or lacks what its figure needs."""
    run = Saved(folder)
    index = FigureIndex(run.folder)
    report_of(run).draw(run, index)
    index.save()
