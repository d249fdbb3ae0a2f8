"""How figures are drawn: plain functions from numbers to an SVG file."""
