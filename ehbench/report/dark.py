"""Colours of figures on a dark page."""

from __future__ import annotations

import colorsys
import re

_COLOUR = re.compile(r"(fill|stroke):#([0-9a-f]{6})")


def dark(look: str) -> str:
    """The colours of a style as a dark page needs them: hue and order of lightness turned about,
    ``fill:#ffffff`` → ``fill:#171717``; empty where the style names none.
    """
    return ";".join(f"{what}:#{_inverted(colour)}" for what, colour in _COLOUR.findall(look))


def _inverted(colour: str, white: float = 0.09, black: float = 0.93) -> str:
    """A colour for a dark page; lightness of what is white and of what is black on paper."""
    red, green, blue = (int(colour[i : i + 2], 16) / 255.0 for i in (0, 2, 4))
    hue, lightness, saturation = colorsys.rgb_to_hls(red, green, blue)
    turned = black - lightness * (black - white)
    back = colorsys.hls_to_rgb(hue, turned, min(saturation, 0.75))
    return "".join(f"{round(255 * part):02x}" for part in back)
