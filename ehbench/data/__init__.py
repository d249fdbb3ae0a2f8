"""Recordings of any format in, logs in and out."""
