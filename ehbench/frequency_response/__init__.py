"""Frequency responses of logs and transfer functions that fit them."""
