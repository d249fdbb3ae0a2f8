"""The load of a cylinder over its speed: which quadrants a motion needs, and the forces at hand."""

from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.report.figures.trial import FUNCTION_SHADES, flags_of
from ehbench.report.style import ACCENT, MUTED, canvas, legend, swatch
from ehbench.report.words import axis, shown, words
from ehbench.vocabulary.codes import FUNCTIONS


def load_plane(path: Path, rig: Rig, record: Record, cylinder: str) -> None:
    """``load_force`` over ``v``, a colour for each working function; dashed what the supply's
    pressure can push and pull with nothing against it. Force and speed of one sign: the load
    resists; of two signs: it drives.
    """
    areas = next(item for item in rig.cylinder if item.name == cylinder).areas()
    pressures = (record[f"{cylinder}.p_head"], record[f"{cylinder}.p_rod"])
    force = areas[0] * pressures[0] - areas[1] * pressures[1]
    v, functions = record[f"{cylinder}.v"], flags_of(record, cylinder, "function")
    with canvas(path, 1, 1, (5.2, 4.2)) as (figure, ax):
        used = sorted(set(functions.tolist()))
        for function in used:
            there = np.where(functions == function, shown(rig, "v", v), np.nan)
            ax.plot(there, shown(rig, "load_force", force), color=FUNCTION_SHADES[function])
        supply = float(rig.supply.pressure)
        for limit in (areas[0] * supply, -areas[1] * supply):
            ax.axhline(shown(rig, "load_force", limit), color=ACCENT, linestyle=(0, (5, 3)))
        ax.axhline(0.0, color=MUTED, linewidth=0.7)
        ax.axvline(0.0, color=MUTED, linewidth=0.7)
        ax.set(xlabel=axis(rig, "v", "Speed"), ylabel=axis(rig, "load_force", "Load"))
        legend(figure, [swatch(words(FUNCTIONS[item]), FUNCTION_SHADES[item]) for item in used], 3)
