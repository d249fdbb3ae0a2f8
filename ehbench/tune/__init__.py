"""Gains from linear models of a cylinder at operating points."""
