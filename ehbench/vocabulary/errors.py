"""The error tree. Every error a user can cause says what, where and what would be right."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ehbench.vocabulary.messages import Message

_MAXIMUM = 700  # characters of a sentence


class EhbenchError(Exception):
    """Base of all errors that are the user's or the data's, never a bug.

    The message is one sentence; ``file`` and ``line`` say where, ``hint`` what would be right, by
    default that of the catalogue. ``key`` and ``fields`` are those of a message of the catalogue.
    ``others`` are the mistakes that were seen with it. ``exit_code`` is what the command line
    returns."""

    exit_code = 2

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        hint: str | None = None,
    ) -> None:
        if isinstance(message, Message):
            hint = hint or message.hint or None
        self.key = getattr(message, "key", "")
        self.fields = getattr(message, "fields", {})
        self.message = one_line(message)
        self.file = None if file is None else one_line(str(file))
        self.line = line
        self.hint = None if hint is None else one_line(hint)
        self.others: tuple[EhbenchError, ...] = ()
        super().__init__(str(self))

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        where = "" if self.file is None else f"{place}: "
        return where + self.message + (f" ({self.hint})" if self.hint else "")

    def as_json(self) -> dict[str, Any]:
        """Plain values: key, text, file, line and hint."""
        text = str(self.message)
        places = {"file": self.file, "line": self.line, "hint": self.hint}
        return {"key": self.key, "text": text, **places}


@contextmanager
def placed(where: Mapping[str, Any], about: str = "") -> Iterator[None]:
    """A block whose input errors get a place, unless they say themselves where they stand.

    Args:
        where: file and line, as `Recipe.at` gives them.
        about: what goes before the message."""
    try:
        yield
    except InputError as error:
        if error.file is not None:
            raise
        text = f"{about}: {error.message}" if about else error.message
        raise type(error)(text, **where, hint=error.hint) from None


@contextmanager
def gathered(errors: list[EhbenchError]) -> Iterator[None]:
    """A block whose error is put into a list; what comes after the block goes on."""
    try:
        yield
    except EhbenchError as error:
        errors += [error, *error.others]


def raise_all(errors: Sequence[EhbenchError]) -> None:
    """Raise the first of some errors with the others, each once; nothing where there are none."""
    if unlike := list({str(error): error for error in errors}.values()):
        unlike[0].others = tuple(unlike[1:])
        raise unlike[0]


def nearest(
    name: str, known: Iterable[str], says: str = "did you mean '{}'?", cutoff: float = 0.6
) -> str | None:
    """A hint at the known name that is most like another; None where none is like it."""
    near = get_close_matches(name, list(known), 1, cutoff)
    return says.format(near[0]) if near else None


def one_line(text: str) -> str:
    """A sentence on one line: what it quotes of a file may be anything, and of any length."""
    plain = text  # a message stays one, with its key
    if not text.isprintable():
        plain = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return plain if len(plain) <= _MAXIMUM else plain[: _MAXIMUM - 200] + " … " + plain[-190:]


class InputError(EhbenchError):
    """A file, key, value or command-line argument is wrong (exit 2)."""


class UnitError(InputError):
    """A unit is missing, unknown, of another dimension, or implausible (exit 2)."""


class LogError(InputError):
    """A log or data file cannot be read as what it claims to be (exit 2)."""


class InsufficientData(EhbenchError):
    """The data are well formed but do not support the claim asked of them (exit 4)."""

    exit_code = 4


class ModelRejected(EhbenchError):
    """A model failed its validation, or a rig was not validated (exit 4)."""

    exit_code = 4


class SimulationError(EhbenchError):
    """A simulation left the range in which its numbers mean anything (exit 5)."""

    exit_code = 5


class FmuError(SimulationError):
    """A user's FMU crashes, hangs, reports an error or no number (exit 2)."""

    exit_code = 2
