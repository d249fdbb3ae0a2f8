"""What a trial and its live view share: the layout of their memory, and what is known before.

This module loads fast: the view's process needs little else."""

from dataclasses import dataclass

from ehbench.vocabulary import setting

WAITING, RUNNING, STOPPING, ENDED = range(4)  # states of a trial
STATE, TIME, LATE, LIMIT = range(4)  # where the board has state, time [s], late ticks, limit
FIRST = LIMIT + 1  # of the numbers that `Facts` names
HEARD, HELD, LEVERS = range(3)  # at its end: time of the last word [s], dead-man, deflections
HOST = "127.0.0.1"
PAGE = "page"  # the device whose levers are on the page


@dataclass(frozen=True)
class ViewSettings:
    """Numbers of a live view."""

    frames: float = setting(20.0, "Hz", "frames a second", "smooth to the eye")
    near: float = setting(0.9, "", "share of the way to a limit from which on it is red", "chosen")
    width: int = setting(16, "cells", "of a bar on the terminal", "lines of 120 letters")
    longest: int = setting(4096, "bytes", "of what a page may say at a time", "a hundred levers")
    silence: float = setting(0.25, "s", "until a lever that says nothing is let go", "six words")
    end: float = setting(2.0, "s", "until a view that does not end is killed", "forty frames")


VIEW = ViewSettings()


@dataclass(frozen=True)
class Facts:
    """What a view must know beside the numbers of the board.

    ``names`` of the numbers behind the board's header; ``units`` by word: name, and what an SI
    value is multiplied by; ``stops``, the names of all limits, and those of the recipe as
    ``limits`` [SI]; ``following`` and ``strokes`` [m] by cylinder; ``pressure`` [Pa] of the supply.
    """

    title: str
    machine: str
    duration: float
    rate: float
    names: tuple[str, ...]
    units: dict[str, tuple[str, float]]
    stops: tuple[str, ...]
    limits: dict[str, float]
    following: dict[str, float]
    strokes: dict[str, float]
    pressure: float
    levers: dict[str, tuple[str, float]]
    device: str
    button: str

    @property
    def first_lever(self) -> int:
        """Where the board has what the operator says."""
        return FIRST + len(self.names)
