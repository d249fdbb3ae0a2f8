"""Lanes: several rigs of one layout side by side in the registers of one core."""
