"""A controller of the user's own: loads the class, asks it tick by tick, and says where it went
wrong; the protocol is in docs/howto/run_trials.md.
"""

from __future__ import annotations

import math
import re
import sys
import traceback
import types
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.control.trajectory import Reference
from ehbench.machines.rows import within
from ehbench.runtime.compiled import bound
from ehbench.trial.controllers import Design, code_file, controller_of, quantities
from ehbench.trial.guard import LONGEST, Exit, Guard, Overdue, is_users
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.quantities import VOCABULARY, Quantity, quantity
from ehbench.vocabulary.text import shortened

NOTE = "note."  # what the channel of a note begins with: no machine measures such a one
_NOTE_NAME = re.compile(r"(?:\w[\w-]{0,99}\.){0,9}\w{1,99}")
_MOST_NAMES = 1000


class UserCode:
    """A controller of the user's own, ready to run over the rows of ``references``.

    Args:
        recipe: names the class.
        design: what the class is designed on.
        channels: of the machine's sample.
        rate: [Hz].
        references: x_d, v_d, a_d, j_d, a row a tick.

    Attributes:
        telemetry: a row a tick, its columns ``channels``: the reference and the class's own notes.
        used: the numbers that it was given as gains.
        beyond: ticks in which it asked for more than a driver takes.

    Raises:
        InputError: the file or class is not right, or its code raised.
    """

    def __init__(
        self,
        recipe: TrialRecipe,
        design: Design,
        channels: Sequence[str],
        rate: float,
        references: np.ndarray,
    ) -> None:
        self.design, self.rate, self.names = design, rate, tuple(channels)
        chosen, file = controller_of(recipe), code_file(recipe)
        assert file is not None  # the recipe names a class
        self.code = _Code(file, chosen.class_name)
        _refuse_foreign(recipe)
        gains = {name: _gain(recipe, name, raw) for name, raw in chosen.written_gains.items()}
        self.used = {"gains": {name: float(v) for name, v in gains.items() if _is_number(v)}}
        with self.code.guard.watched():
            self.object = self.code.make(gains)
            observed = self._observed(self.code.names_of(self.object, "channels"))
            notes = self.code.names_of(self.object, "notes") or ()
        self.noted = [self._note_row(name, notes) for name in notes]
        own = f"{design.cylinder}."
        self.channels = (
            *(f"{own}{name}_desired" for name in Reference._fields),
            *(NOTE + name for name in notes),
        )
        self.references = references
        self.telemetry = np.zeros((len(references), len(self.channels)))
        self.telemetry[:, : len(Reference._fields)] = references
        valves = design.model.plant.valves
        self.low, self.high = valves.lowest.copy(), valves.highest.copy()
        self.beyond = 0
        self._commanded = {
            name: i for i, name in enumerate(design.valves) if name not in chosen.unused
        }
        self._unused = [design.valves.index(name) for name in chosen.unused]
        self._hidden = [i for i, seen in enumerate(observed) if not seen]
        self._in_range = bound(within, self.low, self.low, self.high)

    @property
    def label(self) -> str:
        """Name of the class."""
        return self.code.label

    def watched(self) -> AbstractContextManager[None]:
        """Within the block a step that does not come back is ended."""
        return self.code.guard.watched()

    def start(self, sample: np.ndarray) -> None:
        """Hand the class its rig, the time between samples and the first sample."""
        self.code.call(
            ".start", self.object.start, self.design, 1.0 / self.rate, self._seen(sample)
        )
        self.code.guard.longest = LONGEST

    def step(self, row: int, t: float, sample: np.ndarray, command: np.ndarray) -> None:
        """One tick: write what the class asks for into ``command``, where it asks, and its notes
        into their row.
        """
        reference = Reference(*self.references[row].tolist())
        answer = self.code.call(".step", self.object.step, t, self._seen(sample), reference, t=t)
        retained = [float(command[i]) for i in self._unused]
        self._take(answer, t, command)
        for i, volts in zip(self._unused, retained, strict=True):
            command[i] = volts
        if not self._in_range(command, self.low, self.high):
            self._bring_in_range(answer, t, command)
        if self.noted:
            self._note(self.telemetry[row, len(reference) :], t)

    def _take(self, answer: Any, t: float, command: np.ndarray) -> None:
        """Write an answer of the class, a dict by valve or a row of volts, into ``command``."""
        try:
            unknown = self.code.guard(self._write, answer, command)
        except (TypeError, ValueError):
            hint = f"a dict of volts by valve, or {len(self.design.valves)} numbers: " + ", ".join(
                self.design.valves
            )
            raise self.code.error(
                f".step gave {shortened(answer, 80)} at t = {t:.4g} s, which is no set of commands",
                hint=hint,
            ) from None
        except BaseException as error:
            if is_users(error):
                raise
            raise self.code.raised("'s answer", error, t) from error
        for name in unknown:
            which = "which is no valve"
            if name in self.design.valves:
                which = "which the recipe leaves unused"
            raise self.code.error(
                f".step names {shortened(name, 60)}, {which}",
                hint="valves are " + ", ".join(self._commanded),
            )

    def _write(self, answer: Any, command: np.ndarray) -> tuple[Any, ...]:
        """The first name in an answer that is none of a valve it may command, if there is one."""
        if isinstance(answer, Mapping):
            for name, value in answer.items():
                if name not in self._commanded:
                    return (name,)
                command[self._commanded[name]] = value
        elif np.shape(answer) == command.shape:
            # numpy would spread one number, or None, over all valves
            command[:] = answer
        else:
            raise TypeError
        return ()

    def _bring_in_range(self, answer: Any, t: float, command: np.ndarray) -> None:
        if not np.isfinite(command).all():
            raise self.code.error(
                f".step gave {shortened(answer, 80)} at t = {t:.4g} s, which is not finite",
                hint="channels that it does not name in `channels` are nan",
            )
        self.beyond += 1
        np.clip(command, self.low, self.high, out=command)

    def _note(self, row: np.ndarray, t: float) -> None:
        try:
            row[:] = self.code.guard(lambda: np.asarray(self.object.note, float).reshape(row.shape))
        except (AttributeError, TypeError, ValueError):
            raise self.code.error(
                f".note does not hold {row.size} numbers", hint="one for each name in `notes`"
            ) from None
        except BaseException as error:
            if is_users(error):
                raise
            raise self.code.raised(".note", error, t) from error
        for (name, quantity_row), value in zip(self.noted, row.tolist(), strict=True):
            if not quantity_row.lower <= value <= quantity_row.upper or math.isinf(value):
                lower, upper = quantity_row.lower, quantity_row.upper
                raise self.code.error(
                    f".note has {name} = {value:g} at t = {t:.4g} s, which no log holds",
                    hint=f"a note is a finite number [{quantity_row.unit}], {lower:g} to {upper:g}",
                )

    def _seen(self, sample: np.ndarray) -> dict[str, float]:
        seen = sample.tolist()
        for i in self._hidden:
            seen[i] = math.nan
        return dict(zip(self.names, seen, strict=True))

    def _observed(self, patterns: tuple[str, ...] | None) -> list[bool]:
        """True for the channels of the sample that the class is given."""
        if not patterns:
            hint = (
                'like channels = ["boom.p_head", "p_supply"]; boom.* are all of a cylinder; there '
                "are " + ", ".join(self.names)
            )
            raise self.code.error("does not say which channels it is given", hint=hint)
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in self.names):
                raise self.code.error(
                    f"asks for channel '{pattern}', which the machine does not measure",
                    hint="it has " + ", ".join(self.names),
                )
        return [any(fnmatchcase(name, pattern) for pattern in patterns) for name in self.names]

    def _note_row(self, name: str, notes: Sequence[str]) -> tuple[str, Quantity]:
        """A note's name with its row of the vocabulary."""
        hint = "a note has a name of the vocabulary, like boom.load_force"
        if not _NOTE_NAME.fullmatch(name):
            raise self.code.error(f"notes {shortened(name, 60)}: no name of a channel", hint=hint)
        if notes.count(name) > 1:
            raise self.code.error(f"notes '{name}' twice", hint="each note has a name of its own")
        try:
            return name, quantity(name)
        except KeyError as error:
            raise self.code.error(f"notes '{name}': {error.args[0]}", hint=hint) from None


class _Code:
    """The file and class of the user, and errors that point into it."""

    def __init__(self, file: Path, label: str) -> None:
        self.file, self.label, self.guard = file, label, Guard()

    def make(self, gains: Mapping[str, Any]) -> Any:
        """An object of the class, with the methods of the protocol."""
        controller = self.call("()", self._load(), **gains)
        for method in ("start", "step"):
            if not callable(self.call(f".{method}", getattr, controller, method, None)):
                raise self.error(
                    f"has no method '{method}'",
                    hint="docs/howto/run_trials.md has the protocol of a controller",
                )
        return controller

    def names_of(self, controller: Any, attribute: str) -> tuple[str, ...] | None:
        """The texts that an attribute lists; None where there is none, or one text alone."""

        def listed() -> tuple[Any, ...] | None:
            given = getattr(controller, attribute, None)
            if isinstance(given, str) or not isinstance(given, Sequence):
                return None
            return tuple(islice(given, _MOST_NAMES))

        names = self.call(f".{attribute}", listed)
        for name in names or ():
            if type(name) is not str:
                raise self.error(
                    f".{attribute} holds {shortened(name, 60)}", hint="it is a list of texts"
                )
        return names

    def _load(self) -> Callable[..., Any]:
        module = types.ModuleType(f"ehbench_user_{self.file.stem}")
        module.__file__ = str(self.file)
        sys.modules[module.__name__] = module  # where dataclasses and pickles look for it
        try:
            code = self.guard(compile, self.file.read_bytes(), str(self.file), "exec")
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", file=self.file) from None
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            reason, line = getattr(error, "msg", str(error)), getattr(error, "lineno", None)
            raise InputError(f"not Python: {reason}", file=self.file, line=line) from None
        self.call("", exec, code, module.__dict__)
        controller = getattr(module, self.label, None)
        if not isinstance(controller, type):
            there = [
                name
                for name, item in vars(module).items()
                if isinstance(item, type) and item.__module__ == module.__name__
            ]
            raise InputError(
                f"has no class '{self.label}'",
                file=self.file,
                hint="it has " + (", ".join(there) or "none"),
            )
        return controller

    def call(
        self,
        what: str,
        function: Callable[..., Any],
        *given: Any,
        t: float | None = None,
        **named: Any,
    ) -> Any:
        try:
            return self.guard(function, *given, **named)
        except BaseException as error:
            if is_users(error):
                raise
            raise self.raised(what, error, t) from error

    def raised(self, what: str, error: BaseException, t: float | None = None) -> InputError:
        frames = [
            f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(self.file)
        ]
        line, text = (frames[-1].lineno, f": {frames[-1].line}") if frames else (None, "")
        at = "" if t is None else f" at t = {t:.4g} s"
        did = f"raised {type(error).__name__}{at}: {_said(error)}"
        if isinstance(error, Exit):
            did = f"asked the system to end the process{at}"
        elif isinstance(error, Overdue):
            did = f"did not come back within {self.guard.longest:g} s{at}"
        return InputError(
            f"{self.label}{what} {did}",
            file=self.file,
            line=line,
            hint=f"in the line{text}" if text else None,
        )

    def error(self, message: str, hint: str) -> InputError:
        return InputError(
            f"{self.label}{'' if message[0] == '.' else ' '}{message}", file=self.file, hint=hint
        )


def _said(error: BaseException) -> str:
    """What an error says, where it can."""
    try:
        return str(error)[:300]
    except Exception:
        return "without words"


def _refuse_foreign(recipe: TrialRecipe) -> None:
    """Refuse rules and tuned gains, which are for the built-in controllers."""
    chosen = controller_of(recipe)
    foreign = {
        "rules": ("rules of function selection", bool(chosen.rules)),
        "gains": ("gains of a tune run", chosen.gains_from is not None),
    }
    for table, (what, given) in foreign.items():
        if given:
            raise InputError(
                f"a controller of your own is given no {what}",
                **recipe.at(*chosen.where, table),
                hint="it chooses for itself; give it numbers by gains = { name = value }",
            )


def _gain(recipe: TrialRecipe, name: str, raw: Any) -> Any:
    if isinstance(raw, str) and name in VOCABULARY:
        return quantities(recipe, "gains", {name: raw}, {name: VOCABULARY[name]})[name]
    return raw


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
