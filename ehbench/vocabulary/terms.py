"""Words and numbers that laws, methods and reports share."""

Z95 = 1.959964  # standard errors from the middle to the end of a 95 % interval
CORRELATED = 0.95  # correlation from which logs tell two estimates only together
TOLD = 0.01  # half of an interval over the estimate below which no test for it is proposed
# half widths of its 95 % interval from which an estimate is elsewhere
BEYOND = 1.0
