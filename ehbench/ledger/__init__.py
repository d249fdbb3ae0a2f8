"""The energy ledger of a trial: where the pump's energy went, from a model's record or from
measured channels alone.

``powers`` asks the parts, ``quadrature`` goes over a record, ``sheet`` is the ledger and what its
rows are called; ``model_account`` and ``log_account`` make one, ``bounds`` holds it against
what is possible."""

from ehbench.ledger.bounds import Bounds, bounds
from ehbench.ledger.log_account import Accuracy, ledger_of_log
from ehbench.ledger.model_account import ledger_of_model
from ehbench.ledger.sheet import Ledger, Row
