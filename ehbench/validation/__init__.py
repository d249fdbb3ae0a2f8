"""Judge a model on logs it was not fitted to: simulated against recorded, residuals, ringing, a
verdict with reasons.
"""

from ehbench.validation.judge import (
    JudgedLog,
    PreparedValidation,
    models_of,
    prepare_log,
    prepare_validation,
    run_validation,
    validate_rig,
)
from ehbench.validation.results import (
    ChannelResult,
    Check,
    Correlation,
    LogResult,
    Overlap,
    Ring,
    Transient,
    Validation,
    read_validation,
    speaking_against,
)

__all__ = [
    "ChannelResult",
    "Check",
    "Correlation",
    "JudgedLog",
    "LogResult",
    "Overlap",
    "PreparedValidation",
    "Ring",
    "Transient",
    "Validation",
    "models_of",
    "prepare_log",
    "prepare_validation",
    "read_validation",
    "run_validation",
    "speaking_against",
    "validate_rig",
]
