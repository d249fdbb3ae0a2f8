"""Figures that measure once are those of matplotlib, to the byte."""

from __future__ import annotations

from io import StringIO

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from ehbench.report import style
from ehbench.report.sheet import Sheet

T = np.linspace(0.0, 3.0, 40)


def shared(figure):
    """Panels that share formatters and differ in width, with small numbers and aligned labels."""
    axes = figure.subplots(3, 2, sharex=True, sharey="row", width_ratios=(3, 1))
    for row, scale in zip(axes, (1.0, 3e-7, 4e6), strict=True):
        for ax in row:
            ax.plot(T, scale * np.sin(5.0 * T), label="a")
            ax.set_title("Title\nof two lines")
            ax.set_ylabel("speed [mm/s]")
    axes[0, 1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    style.legend(figure, axes[0, 0].get_lines())
    figure.align_labels()


def logarithmic(figure):
    """Small ticks with a grid, ticks with names, ticks on top."""
    left, right = figure.subplots(1, 2)
    left.loglog(T + 0.01, (T + 0.01) ** -2.0)
    left.grid(which="minor")
    right.bar(["one", "two $", "three"], [1.0, 2.0, 3.0])
    right.tick_params(axis="x", top=True, labeltop=True, labelbottom=False, labelrotation=30)
    right.set_title("names above")
    style._let_formulas(figure)


def coloured(figure):
    """A colour bar, a second axis, a panel added, and limits of its own."""
    first, second = figure.subplots(2, 1, sharex=True)
    image = first.pcolormesh(T, T, np.outer(T, T), rasterized=True)
    figure.colorbar(image, ax=first, label="product")
    second.plot(T, T)
    second.set_xlim(0.5, 2.0)
    other = second.twinx()
    other.plot(T, 1e6 * T**2)
    other.set_ylabel("square")
    second.tick_params(axis="y", colors="red", length=8, width=2, pad=6)


@pytest.mark.parametrize("draw", [shared, logarithmic, coloured])
def test_a_sheet_is_what_matplotlib_draws(draw):
    about = {"Date": None, "Creator": "ehbench"}
    with matplotlib.rc_context(style._RC):
        plain, text = Figure(figsize=(7.2, 4.2)), StringIO()
        draw(plain)
        FigureCanvasSVG(plain).print_svg(text, metadata=about)
    with matplotlib.rc_context(style._RC):
        sheet = Sheet((7.2, 4.2))
        draw(sheet)
        made = sheet.svg(about)
    assert made == text.getvalue() and len(made) > 10_000


def test_what_was_measured_for_a_drawing_is_not_taken_for_the_next():
    with matplotlib.rc_context(style._RC):
        sheet = Sheet((4.0, 3.0))
        ax = sheet.subplots()
        ax.plot(T, T)
        assert ">2.5<" in sheet.svg({"Date": None})
        ax.set_xticks([0.0, 1.0, 2.25])
        assert ">2.25<" in sheet.svg({"Date": None})
