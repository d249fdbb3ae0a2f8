"""Controllers, compiled: pure functions on numbers. They see a rig only through its metering edges
and areas.
"""
