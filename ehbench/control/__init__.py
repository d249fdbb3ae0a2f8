"""Controllers, compiled: pure functions that see a rig by its metering edges and areas."""

# the built-in controllers that a recipe can name, each in the file of its name
LAW_NAMES = ("open_loop", "pressure_feedback", "position", "arc")
