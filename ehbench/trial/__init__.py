"""Trials: open-loop commands or a controller, on the model or on the virtual bench, stopped safely
when a limit is reached.
"""

from __future__ import annotations

from ehbench.trial.cases import Case, file_names, run_cases, table_csv, table_rows
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import code_file, gains_file, refuse_code
from ehbench.trial.run import (
    RUN_OUT,
    Facts,
    PreparedTrial,
    Stop,
    prepare_trial,
    run_prepared,
    run_trial,
)

__all__ = [
    "RUN_OUT",
    "Case",
    "Facts",
    "PreparedTrial",
    "Stop",
    "code_file",
    "command_table",
    "file_names",
    "gains_file",
    "prepare_trial",
    "refuse_code",
    "run_cases",
    "run_prepared",
    "run_trial",
    "table_csv",
    "table_rows",
]
