"""Fits with uncertainty: flow maps, hydraulics."""
