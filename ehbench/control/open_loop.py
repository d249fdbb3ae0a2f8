"""The desired speed alone: pressure feedback without any feedback."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ehbench.control import pressure_feedback
from ehbench.control.law import DesignPoint, Packed

NO_FEEDBACK = {"feedback_gain": 0.0, "off_gain": 0.0, "washout": 0.0, "ramp_washout": 0.0}


def pack(
    point: DesignPoint, gains: Mapping[str, Any], rules: np.record, shaping: np.record
) -> Packed:
    """As pressure feedback without its feedback gains, so that both can name one tune run."""
    return pressure_feedback.pack(point, {**gains, **NO_FEEDBACK}, rules, shaping)


LAW = replace(pressure_feedback.LAW, name="open_loop", pack=pack, required=None)
