"""Pure functions of time series."""
