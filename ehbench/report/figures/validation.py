"""Correlations of residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ehbench.report.figures.channels import title_of
from ehbench.report.saved import Table
from ehbench.report.style import CYCLE, MARKS, MUTED, RECORDED, canvas, legend


def correlations(path: Path, channels: Sequence[Table]) -> None:
    """A column a channel: the residual's autocorrelation, and below its correlation with each
    earlier command, with bands.
    """
    cross = any(channel.get("cross_correlation") for channel in channels)
    rows = 2 if cross else 1
    commands = list(
        dict.fromkeys(
            one["of"] for channel in channels for one in channel.get("cross_correlation", [])
        )
    )
    looks = {
        name: (CYCLE[i % len(CYCLE)], MARKS[i % len(MARKS)]) for i, name in enumerate(commands)
    }
    with canvas(
        path, rows, len(channels), (7.4, 1.75 * rows + 0.5), sharex=True, sharey=True, squeeze=False
    ) as (figure, axes):
        for column, channel in enumerate(channels):
            top = axes[0, column]
            _banded(
                top,
                [channel["autocorrelation"]],
                {channel["autocorrelation"]["of"]: (RECORDED, "-")},
            )
            top.set_title(title_of(channel["channel"]), fontsize=8.5)
            if cross:
                _banded(axes[1, column], channel.get("cross_correlation", []), looks)
            axes[-1, column].set_xlabel("lag [s]")
        axes[0, 0].set_ylim(-1.05, 1.05)
        axes[0, 0].set_ylabel("with itself [1]")
        if cross:
            axes[1, 0].set_ylabel("with commands [1]")
            from matplotlib.lines import Line2D

            legend(
                figure,
                [
                    Line2D(
                        [], [], color=colour, linestyle=mark, label=name.removesuffix(".command")
                    )
                    for name, (colour, mark) in looks.items()
                ],
            )


def _banded(ax, found: Sequence[Table], looks: dict) -> None:
    for one in found:
        lag, value, band = (np.array(one[key], float) for key in ("lag", "value", "band"))
        ax.fill_between(lag, -band, band, color=MUTED, alpha=0.22 / len(found) ** 0.5, linewidth=0)
        colour, mark = looks[one["of"]]
        ax.plot(lag, value, color=colour, linestyle=mark, linewidth=1.1)
    ax.axhline(0.0, color=MUTED, linewidth=0.6)
