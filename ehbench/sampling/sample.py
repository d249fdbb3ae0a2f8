"""A sample of a study, and where samples are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.text import shortened


@dataclass(frozen=True)
class Workers:
    """Where a study's samples are made: the address of a Dask ``scheduler``, '' for this machine;
    how many workers, 0 for one a core.
    """

    scheduler: str = ""
    count: int = 0

    @classmethod
    def of(cls, text: str) -> Workers:
        """Those of ``--workers``: how many here, or a scheduler's address; '' is one a core.

        Raises:
            InputError: it is neither.
        """
        if ":" in text:
            return cls(scheduler=text)
        if text and not (text.isdecimal() and int(text) > 0):
            raise InputError(message("sampling.no_workers", text=shortened(text, 40)))
        return cls(count=int(text or 0))


# status word by exit code
STATUS = {
    0: "done",
    1: "failed",
    2: "refused",
    3: "incomplete",
    4: "rejected",
    5: "stopped",
}
LATE = "late"  # beyond its time limit, exit code 5
WHOLE = (0, 3, 4)  # exit codes of samples that came to their end


class Sample(NamedTuple):
    """The result of a sample: its number, exit code, status, message, measures [SI] (nan: it has
    none), and how long it took [s], which no file states.
    """

    index: int
    code: int
    status: str
    message: str
    measures: tuple[float, ...]
    seconds: float = 0.0

    @classmethod
    def lost(cls, index: int, message: str, measures: int, late: bool = False) -> Sample:
        """A sample that left nothing."""
        code, status = (5, LATE) if late else (1, STATUS[1])
        return cls(index, code, status, message, (math.nan,) * measures)


Task = tuple[int, Mapping[str, Any]]  # a sample's number and what it sets
Make = Callable[[int, Mapping[str, Any]], Sample]
Open = Callable[[], Make]  # makes ready what makes samples, in the process where it is called
