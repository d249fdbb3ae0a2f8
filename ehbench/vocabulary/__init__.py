"""Names, quantities, units, typed values and errors: what all other packages speak. What most
modules take of it is named here; `fields` and the words of single subjects stay in their files."""

from ehbench.vocabulary.errors import (
    EhbenchError,
    InputError,
    InsufficientData,
    LogError,
    SimulationError,
    UnitError,
    placed,
)
from ehbench.vocabulary.messages import Message, message
from ehbench.vocabulary.notebook import plural
from ehbench.vocabulary.progress import Progress
from ehbench.vocabulary.quantities import VOCABULARY, Quantity, quantity
from ehbench.vocabulary.settings import setting
from ehbench.vocabulary.terms import MAD, Z95
from ehbench.vocabulary.text import grouped, listed, shortened
from ehbench.vocabulary.units import from_si, to_si
