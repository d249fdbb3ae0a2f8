"""A picture of every column of a foreign file."""

from pathlib import Path

import numpy as np

from ehbench.app.mapping.guesses import Guess
from ehbench.app.mapping.written import own_rows, remark
from ehbench.data.readers import Source
from ehbench.report.style import ACCENT, MUTED, canvas, thin
from ehbench.vocabulary.messages import message


def draw(picture: Path, source: Source, guesses: dict[str, Guess]) -> None:
    """Each column over the time, or over its rows."""
    names, rows_of = source.names(), own_rows(source, guesses)
    columns = {name: source.tables[i].columns[j] for name, (i, j) in names.items()}
    shown = [name for name in names if guesses[name].channel != "t"]
    shown = [name for name in shown if np.isfinite(columns[name].values).any()][:24]
    shown = shown or list(names)[:1]
    rows = len(shown)
    with canvas(picture, rows, 1, (7.2, 1.35 * rows + 0.5), squeeze=False) as (_, axes):
        for ax, name in zip(axes[:, 0], shown):
            index = names[name][0]
            table, column = source.tables[index], columns[name]
            across, t = "row", np.arange(column.values.size, dtype=float)
            if table.t is not None:
                across, t = "time [s]", table.t
            for other, guess in guesses.items():
                if table.t is None and guess.channel == "t" and names[other][0] == index:
                    across, t = f"time [{guess.unit}]", columns[other].values
            good = np.isfinite(t)
            ax.plot(*thin(t[good], column.values[good]))
            guess = guesses[name]
            label = f" → {guess.channel}{'' if guess.sure else ' ?'}" if guess.channel else ""
            # a few bad samples among those of its rate
            bad = np.flatnonzero(rows_of[name] & ~np.isfinite(column.values))[:20].tolist()
            label += message("app.red_marks") if bad else ""
            unit = column.known_unit or column.unit
            ax.set_title(remark(name) + label, color="black" if guess.sure else MUTED)
            ax.set_ylabel(unit or "–")
            ax.set_xlabel(across)
            for at in bad:
                ax.axvline(t[at], color=ACCENT, linewidth=0.8)
