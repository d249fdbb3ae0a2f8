"""The live view of a trial: a process beside it that reads what the trial copies into memory."""
