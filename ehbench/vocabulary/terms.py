"""Words and numbers that laws, methods and reports share."""

Z95 = 1.959964  # standard errors from the middle to the end of a 95 % interval
MAD = 1.4826  # standard deviation of normal noise over the median of its size
CORRELATED = 0.95  # correlation from which logs tell two estimates only together
TOLD = 0.01  # half of an interval over the estimate below which no test for it is proposed
# half widths of its 95 % interval from which an estimate is elsewhere
BEYOND = 1.0
# rows of a cylinder in an energy ledger that the piston's work pays
MECHANICAL = (
    *("friction", "friction_spring", "end_stop", "stop", "load_spring", "damping"),
    *("mount", "mount_spring", "sway", "swaying"),
)
