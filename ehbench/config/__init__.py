"""Rig files and recipes: TOML with line numbers, as typed models."""
