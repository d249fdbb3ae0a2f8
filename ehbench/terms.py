"""Words and numbers that laws, methods and reports share."""

from __future__ import annotations

Z95 = 1.959964  # standard errors from the middle to the end of a 95 % interval
CORRELATED = 0.95  # correlation from which logs tell two estimates only together
# working functions by the number that a log holds
FUNCTIONS = (
    "hold",
    "extend_resistive",
    "extend_overrunning",
    "extend_overrunning_regeneration",
    "retract_resistive",
    "retract_overrunning",
    "retract_overrunning_regeneration",
    "extend_resistive_regeneration",
)
# limits of an edge by the bit that a log holds
LIMITS = {1: "saturated", 2: "against", 4: "reversed", 8: "faint", 16: "outside"}
