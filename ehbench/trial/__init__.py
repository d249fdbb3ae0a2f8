"""Trials: open-loop commands or a controller, on the model or on the virtual bench, stopped safely when a limit is reached."""

from __future__ import annotations

from ehbench.trial.commands import command_table
from ehbench.trial.controllers import code_file, gains_file
from ehbench.trial.run import RUN_OUT, Facts, Stop, run_trial

__all__ = ["RUN_OUT", "Facts", "Stop", "code_file", "command_table", "gains_file", "run_trial"]
