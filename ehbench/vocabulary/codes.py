"""What the coded channels of a log mean: working functions, limits of the valve level, estimates.

Plain words and numbers, for controllers that write them and reports that read them."""

# channel `function`
FUNCTIONS = (
    "hold",
    "extend_resistive",
    "extend_overrunning",
    "extend_overrunning_regeneration",
    "retract_resistive",
    "retract_overrunning",
    "retract_overrunning_regeneration",
    "extend_resistive_regeneration",
    "retract_overrunning_through_rod",
    "extend_resistive_fed_at_rod",
    "retract_overrunning_vented",
    "extend_overrunning_vented",
)
(
    HOLD,
    EXTEND_RESISTIVE,
    EXTEND_OVERRUNNING,
    EXTEND_OVERRUNNING_REGENERATION,
    RETRACT_RESISTIVE,
    RETRACT_OVERRUNNING,
    RETRACT_OVERRUNNING_REGENERATION,
    EXTEND_RESISTIVE_REGENERATION,
    RETRACT_OVERRUNNING_THROUGH_ROD,
    EXTEND_RESISTIVE_FED_AT_ROD,
    RETRACT_OVERRUNNING_VENTED,
    EXTEND_OVERRUNNING_VENTED,
) = range(12)

# channel `function_status`: STALLED, no function that suits is feasible; UNABLE, there is none
OK, STALLED, UNABLE = 0, 1, 2
STATUS_MEANS = {
    "stalled": "no working function could move the load at the pressures that there were",
    "unable": "the circuit has no working function for the motion and the load",
}

# channel `limits`, a sum of bits
SATURATED, AGAINST, REVERSED, FAINT, OUTSIDE = 1, 2, 4, 8, 16
LIMITS = {
    SATURATED: "saturated",
    AGAINST: "against",
    REVERSED: "reversed",
    FAINT: "faint",
    OUTSIDE: "outside",
}
LIMITS_MEAN = {
    "saturated": "even the widest command passes less than was asked",
    "against": "flow was asked the other way along an edge's path, which is kept shut",
    "reversed": "the pressure drop is against the flow asked, so that the edge is shut",
    "faint": "the drop is too small to meter by; the command is that of the least drop metered at",
    "outside": "drop and command lie beyond what the edge's map was measured at",
}

# the four estimates of the adaptive law, in its order
ESTIMATES = ("inverse_inertia", "payload_share", "disturbance", "inverse_bulk")
INVERSE_INERTIA, PAYLOAD_SHARE, DISTURBANCE, INVERSE_BULK = range(4)

# channel `learning`: estimates learn from the errors of tracking, not, or from the load at rest
FREE, FROZEN, WEIGHED = 0, 1, 2
