"""matplotlib's SVG drawing with what it measures again and again measured once: the same figures.

A figure's layout is found in two rounds and then drawn, and each time every text is measured and
every axis finds its ticks two or three times over.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from io import StringIO
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Tick, XAxis, YAxis
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.backends.backend_svg import FigureCanvasSVG, RendererSVG
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

DPI = 72  # of every SVG


@lru_cache(4096)
def _extent(text: str, font: FontProperties) -> tuple[float, float, float]:
    """Width, height and descent of a text that is no formula [pt]."""
    return _MEASURE.get_text_width_height_descent(text, font, False)


@lru_cache(256)
def _heights(font: FontProperties) -> tuple[float | None, float | None, float | None]:
    """Ascent, descent and gap between lines of a font [pt], as its own tables say."""
    face: Any = get_font(findfont(font))
    size = font.get_size_in_points()
    scale = 1 / face.get_sfnt_table("head")["unitsPerEm"] * size * DPI / 72
    for name, keys in (
        ("OS/2", ("sTypoAscender", "sTypoDescender", "sTypoLineGap")),
        ("hhea", ("ascent", "descent", "lineGap")),
    ):
        if (table := face.get_sfnt_table(name)) is not None:
            above, below, gap = (table[key] * scale for key in keys)
            return above, -below, gap
    return None, None, None


_MEASURE = RendererSVG(1.0, 1.0, StringIO())


class _Renderer(RendererSVG):
    """Asks for the size of no text twice, in whatever figure it stands."""

    def get_text_width_height_descent(
        self, s: str, prop: FontProperties, ismath: Any
    ) -> tuple[float, float, float]:
        """matplotlib's own."""
        if ismath:  # by settings that a process may change
            return super().get_text_width_height_descent(s, prop, ismath)
        return _extent(s, prop.copy())

    def _get_font_height_metrics(
        self, prop: FontProperties
    ) -> tuple[float | None, float | None, float | None]:
        """What matplotlib's texts else read from the font for each line that they lay out."""
        return _heights(prop.copy())


class _Axis:
    """What both axes of a panel do: make ticks like their first one; and while the figure is drawn,
    find ticks, and the boxes of their labels, once for each place of the panel, as nothing else
    moves them then. A formatter that panels share goes by the numbers of the one that asked last.
    """

    _clipped_by: tuple = ()  # what the panel gave its axis before there were small ticks
    _found: tuple[tuple, list] | None = None  # where, and the ticks
    _boxes: tuple[list, list] | None = None  # of the labels of these ticks

    @property
    def _as_it_is(self) -> Any:
        return super()

    def _update_ticks(self: Any) -> list:
        if not _is_drawn(self):
            return self._as_it_is._update_ticks()
        words = (self.major.formatter, self.minor.formatter)
        sheet = self.get_figure(root=True)
        place = (sheet.drawings, *self.get_view_interval(), *self.axes.bbox.bounds)
        if (
            self._found is None
            or self._found[0] != place
            or any(getattr(one, "asked_by", None) is not self for one in words)
        ):
            self._found, self._boxes = (place, self._as_it_is._update_ticks()), None
            for one in words:
                one.asked_by = self
        return self._found[1]

    def set_clip_path(self: Any, path: Any, transform: Any = None) -> None:
        """matplotlib's own, which makes a small tick of each axis for it."""
        if "minorTicks" in vars(self):
            return self._as_it_is.set_clip_path(path, transform)
        self._clipped_by, self.minorTicks = (path, transform), []
        self._as_it_is.set_clip_path(path, transform)
        del self.minorTicks  # matplotlib makes them when they are asked for

    def _get_tick(self: Any, major: bool) -> Tick:
        ticks = self.majorTicks if major else self.minorTicks
        if ticks:
            return _alike(ticks[0])
        tick = self._as_it_is._get_tick(major)
        if not major and self._clipped_by:
            tick.set_clip_path(*self._clipped_by)
        return tick

    def _get_ticklabel_bboxes(self: Any, ticks: list, renderer: Any) -> tuple[list, list]:
        if self._found is None or ticks is not self._found[1] or not _is_drawn(self):
            return self._as_it_is._get_ticklabel_bboxes(ticks, renderer)
        if self._boxes is None:
            self._boxes = self._as_it_is._get_ticklabel_bboxes(ticks, renderer)
        return self._boxes


def _alike(tick: Tick) -> Tick:
    """A tick with the looks of another: to make one from its settings takes ten times as long."""
    made = copy(tick)
    parts = tick.get_children()
    for name, part in vars(tick).items():
        if any(part is one for one in parts):
            setattr(made, name, copy(part))
    return made


def _is_drawn(one: Any) -> bool:
    sheet = one.get_figure(root=True)
    return isinstance(sheet, Sheet) and sheet.is_drawn


class _XAxis(_Axis, XAxis):
    """The horizontal one."""


class _YAxis(_Axis, YAxis):
    """The vertical one."""


class _Axes(Axes):
    """A panel with these axes."""

    def _init_axis(self) -> None:
        spines: Any = self.spines
        self.xaxis, self.yaxis = _XAxis(self, clear=False), _YAxis(self, clear=False)
        for axis, sides in ((self.xaxis, ("bottom", "top")), (self.yaxis, ("left", "right"))):
            for side in sides:
                spines[side].register_axis(axis)


class Sheet(Figure):
    """A figure of such panels, drawn as SVG."""

    is_drawn = False
    drawings = 0  # so far

    def __init__(self, size: tuple[float, float]) -> None:
        super().__init__(figsize=size)
        FigureCanvasSVG(self)

    def add_subplot(self, *place: Any, **look: Any) -> Any:
        """matplotlib's own."""
        return super().add_subplot(*place, **({"axes_class": _Axes} | look))

    def svg(self, metadata: dict[str, str | None]) -> str:
        """The whole figure as text, as matplotlib's canvas writes it; what the layout measures with
        is what draws.
        """
        text, (width, height) = StringIO(), self.get_size_inches()
        dpi: Any = self.dpi
        self.dpi = DPI
        svg = _Renderer(width * DPI, height * DPI, text, image_dpi=dpi, metadata=metadata)
        page: Any = MixedModeRenderer(self, width, height, dpi, svg)
        canvas: Any = self.canvas
        self.is_drawn, canvas.get_renderer = True, lambda: page
        self.drawings += 1
        try:
            self.draw(page)
        finally:
            self.is_drawn = False
            del canvas.get_renderer
        page.finalize()
        return text.getvalue()
