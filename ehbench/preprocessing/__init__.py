"""What a log is and must be before a rig is judged on it."""
