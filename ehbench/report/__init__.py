"""Draw saved results: figures of one run, and one self-contained HTML page over many. Reads files
only, re-runs nothing.
"""

from __future__ import annotations

from ehbench.report.figures import draw
from ehbench.report.page import build

__all__ = ["build", "draw"]
