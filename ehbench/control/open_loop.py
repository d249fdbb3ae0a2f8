"""The desired speed alone: the law of pressure feedback without any feedback, the off-side's
included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.control import pressure_feedback
from ehbench.control.law import Packed, Site

OFF = {"feedback_gain": 0.0, "off_gain": 0.0, "washout": 0.0, "ramp_washout": 0.0}


def pack(site: Site, gains: Mapping[str, Any], rules: np.record, shaping: np.record) -> Packed:
    """As pressure feedback, whose own gains are left aside, so that both can name one tune run."""
    return pressure_feedback.pack(site, {**gains, **OFF}, rules, shaping)


LAW = replace(pressure_feedback.LAW, name="open_loop", pack=pack, required=None)
