"""A rig, its linear models, its mechanism and its controllers for other programs."""
