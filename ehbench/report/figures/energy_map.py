"""Energy over load and speed, a panel a controller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.report.style import INK, canvas
from ehbench.report.words import number


def energy_map(
    path: Path,
    panels: Sequence[tuple[str, np.ndarray]],
    loads: Sequence[str],
    speeds: Sequence[str],
    unit: str,
    columns: int = 2,
    darkest: float = 1.0,
) -> None:
    """Cells of load × speed: the energy, and in per cent how far it lies above the least that any
    controller takes there, which is its shade.

    Args:
        path: of the SVG.
        panels: (controller, energies as shown, shape (loads, speeds), NaN where there is none).
        loads, speeds: what rows and columns are of.
        unit: of the energies.
        columns: of panels.
        darkest: share above the minimum from which a cell is as dark as can be.
    """
    minimum = np.fmin.reduce([energies for _, energies in panels])
    rows = math.ceil(len(panels) / columns)
    size = (7.4, rows * (0.42 * len(loads) + 0.75) + 0.5)
    shape = {"sharex": True, "sharey": True, "squeeze": False}
    with canvas(path, rows, columns, size, **shape) as (_, axes):
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
        for ax, (title, energies) in zip(axes.flat, panels, strict=False):
            above = energies / minimum - 1.0
            ax.pcolormesh(
                np.arange(len(speeds) + 1) - 0.5,
                np.arange(len(loads) + 1) - 0.5,
                np.minimum(above, darkest),
                cmap="Oranges",
                vmin=0.0,
                vmax=2.0 * darkest,  # so that numbers stay readable
                edgecolor="white",
            )
            for (row, column), energy in np.ndenumerate(energies):
                if np.isfinite(energy):
                    more = 100.0 * above[row, column]
                    text = f"{number(energy, 3)}\n" + (f"+{more:.0f} %" if more >= 0.5 else "least")
                    look = {"ha": "center", "va": "center", "fontsize": 7.5, "color": INK}
                    ax.text(column, row, text, **look)
            ax.set_title(title)
            ax.set_xticks(range(len(speeds)), speeds)
            ax.set_yticks(range(len(loads)), loads)
            ax.grid(False)
        axes[0, 0].set_ylabel(f"load; energy [{unit}]")
