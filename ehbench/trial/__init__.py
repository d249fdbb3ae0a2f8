"""Trials: open-loop commands or a controller, on the model or on the virtual bench, stopped safely
when a limit is reached."""

from ehbench.trial.cases import Account, Case, account, file_names, run_cases, table_csv, table_rows
from ehbench.trial.code import code_file, code_files, refuse_code
from ehbench.trial.commands import command_table
from ehbench.trial.controllers import gains_file, refuse_unknown
from ehbench.trial.preparation import RUN_OUT, Prepared, Stop, prepare
from ehbench.trial.running import Facts, Result, log_channels, run, run_trial
from ehbench.trial.session import Session
