"""Correlations of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.report.saved import Table
from ehbench.report.style import MUTED, RECORDED, canvas, cycled, key, legend
from ehbench.report.words import title_of


def correlations(path: Path, channels: Sequence[Table]) -> None:
    """A column a channel: the residual's autocorrelation, and below its correlation with each
    earlier command, with bands.
    """
    crossed = [item for channel in channels for item in channel.get("cross_correlation", [])]
    commands = dict.fromkeys(item["of"] for item in crossed)
    looks = {name: cycled(i) for i, name in enumerate(commands)}
    rows = 2 if crossed else 1
    shape = {"sharex": True, "sharey": True, "squeeze": False}
    with canvas(path, rows, len(channels), (7.4, 1.75 * rows + 0.5), **shape) as (figure, axes):
        for column, channel in enumerate(channels):
            top, auto = axes[0, column], channel["autocorrelation"]
            _banded(top, [auto], {auto["of"]: {"color": RECORDED, "linestyle": "-"}})
            top.set_title(title_of(channel["channel"]), fontsize=8.5)
            if crossed:
                _banded(axes[1, column], channel.get("cross_correlation", []), looks)
            axes[-1, column].set_xlabel("lag [s]")
        axes[0, 0].set_ylim(-1.05, 1.05)
        axes[0, 0].set_ylabel("with itself [1]")
        if crossed:
            axes[1, 0].set_ylabel("with commands [1]")
            legend(figure, [key(n.removesuffix(".command"), **look) for n, look in looks.items()])


def _banded(ax, correlations: Sequence[Table], looks: dict) -> None:
    for correlation in correlations:
        lag, value, band = (np.array(correlation[key], float) for key in ("lag", "value", "band"))
        ax.fill_between(
            lag, -band, band, color=MUTED, alpha=0.22 / len(correlations) ** 0.5, linewidth=0
        )
        ax.plot(lag, value, linewidth=1.1, **looks[correlation["of"]])
    ax.axhline(0.0, color=MUTED, linewidth=0.6)
