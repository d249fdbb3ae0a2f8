"""Judge a model on logs it was not fitted to: simulated against recorded, residuals, ringing, a
verdict with reasons."""

from ehbench.validation.judge import (
    PreparedValidation,
    models_of,
    prepare_log,
    prepare_validation,
    run_validation,
    validate_rig,
)
from ehbench.validation.results import LogResult, Ring, Validation, speaking_against
