"""What a sample is to those who run and keep it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

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
