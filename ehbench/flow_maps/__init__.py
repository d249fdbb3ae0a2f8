"""Flow maps from readings and step logs."""
