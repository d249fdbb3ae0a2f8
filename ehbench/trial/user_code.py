"""A user's controller: loads the class, calls it tick by tick, and reports where it went wrong; the
protocol is in docs/howto/run_trials.md."""

import math
import os
import re
import signal
import sys
import threading
import time
import traceback
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from fnmatch import filter as filter_names
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.recipe import TrialRecipe
from ehbench.control.trajectory import Reference
from ehbench.machines.rows import within
from ehbench.runtime.compiled import bound
from ehbench.runtime.interrupts import Terminated
from ehbench.trial.code import code_file
from ehbench.trial.controllers import Design, controller_of, quantities
from ehbench.vocabulary import VOCABULARY, Quantity, message, quantity, setting, shortened
from ehbench.vocabulary.errors import InputError

NOTE = "note."  # what the channel of a note begins with: no machine measures such a one
_NOTE_NAME = re.compile(r"(?:\w[\w-]{0,99}\.){0,9}\w{1,99}")


@dataclass(frozen=True)
class CodeSettings:
    """What a user's code may take."""

    step: float = setting(60.0, "s", "wall time of one step", "a loop that never ends")
    start: float = setting(600.0, "s", "wall time of loading and starting", "it may compile")
    look: float = setting(1.0, "s", "time between looks at the clock", "cheap")
    names: int = setting(1000, "", "names that an attribute may list", "an endless list")


CODE = CodeSettings()


class Overdue(BaseException):
    """Raised inside a call that has taken too long, where it stands."""


class Exit(BaseException):
    """Raised in place of an end of the process that code asked of the system."""


class Guard:
    """Runs calls of code that may do anything; ``longest`` [s] is what one may take.

    Only the main thread can be woken: elsewhere a call may take as long as it likes."""

    def __init__(self) -> None:
        self.longest = CODE.start
        self._since = 0.0

    def __call__(self, function: Callable[..., Any], *given: Any) -> Any:
        """What the function gives.

        Raises:
            Overdue, Exit: it took too long, or asked for the process's end.
            Terminated, KeyboardInterrupt: the user ended the process.
            BaseException: whatever the code raised."""

        def no_exit(status: int = 0) -> None:
            raise Exit(status)

        # pyrefly: ignore[bad-assignment]
        leave, os._exit = os._exit, no_exit
        self._since = time.monotonic()
        try:
            return function(*given)
        finally:
            self._since = 0.0
            os._exit = leave

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Within the block a call that takes too long is ended."""
        main = threading.current_thread() is threading.main_thread()
        if not main or not hasattr(signal, "setitimer") or signal.getitimer(signal.ITIMER_REAL)[0]:
            yield
            return
        before = signal.signal(signal.SIGALRM, self._look)
        signal.setitimer(signal.ITIMER_REAL, CODE.look, CODE.look)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)

    def _look(self, *_: object) -> None:
        if self._since and time.monotonic() - self._since > self.longest:
            raise Overdue


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
        InputError: the file or class is not right, or its code raised."""

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
        # rules and tuned gains are for the built-in controllers
        for given, key, word in (
            (chosen.rules, "trial.code_given_rules", "rules"),
            (chosen.gains_from, "trial.code_given_tuning", "gains"),
        ):
            if given:
                raise InputError(message(key), **recipe.at(*chosen.where, word))
        gains = {name: _gain(recipe, name, raw) for name, raw in chosen.written_gains.items()}
        self.used = {
            "gains": {
                name: float(v)
                for name, v in gains.items()
                if isinstance(v, int | float) and math.isfinite(v)
            }
        }
        with self.code.guard.watched():
            self.object = self.code.make(gains)
            patterns = self.code.names_of(self.object, "channels")
            known = ", ".join(self.names)
            if not patterns:
                raise self.code.misuse("trial.no_observed", known=known)
            for pattern in patterns:
                if not filter_names(self.names, pattern):
                    raise self.code.misuse("trial.unmeasured", pattern=pattern, known=known)
            observed = {name for pattern in patterns for name in filter_names(self.names, pattern)}
            notes = self.code.names_of(self.object, "notes") or ()
        self.noted = [self._note_row(name, notes) for name in notes]
        self.channels = (
            *(f"{design.cylinder}.{name}_desired" for name in Reference._fields),
            *(NOTE + name for name in notes),
        )
        self.references = references
        self.telemetry = np.zeros((len(references), len(self.channels)))
        valves = design.model.plant.valves
        self.low, self.high = valves.lowest.copy(), valves.highest.copy()
        self.beyond = 0
        self._commanded = {
            name: i for i, name in enumerate(design.valves) if name not in chosen.unused
        }
        self._unused = [design.valves.index(name) for name in chosen.unused]
        self._hidden = [i for i, name in enumerate(self.names) if name not in observed]
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
        self.code.guard.longest = CODE.step

    def step(self, row: int, t: float, sample: np.ndarray, command: np.ndarray) -> None:
        """One tick: write what the class asks for into ``command``, where it asks, and its notes
        into their row."""
        self.telemetry[row, : len(Reference._fields)] = self.references[row]
        reference = Reference(*self.references[row].tolist())
        answer = self.code.call(".step", self.object.step, t, self._seen(sample), reference, t=t)
        retained = [float(command[i]) for i in self._unused]
        self._take(answer, t, command)
        for i, volts in zip(self._unused, retained, strict=True):
            command[i] = volts
        if not self._in_range(command, self.low, self.high):
            if not np.isfinite(command).all():
                raise self.code.misuse(
                    "trial.command_not_finite", answer=shortened(answer, 80), t=t
                )
            self.beyond += 1
            np.clip(command, self.low, self.high, out=command)
        if self.noted:
            notes = self.telemetry[row, len(reference) :]
            unlike = (AttributeError, TypeError, ValueError)
            numbers = lambda: np.asarray(self.object.note, float).reshape(notes.shape)
            try:
                notes[:] = self.code.call(".note", numbers, t=t, passing=unlike)
            except unlike:
                raise self.code.misuse("trial.note_count", count=notes.size) from None
            for (name, quantity_row), value in zip(self.noted, notes.tolist(), strict=True):
                if not quantity_row.lower <= value <= quantity_row.upper or math.isinf(value):
                    fields = {key: getattr(quantity_row, key) for key in ("unit", "lower", "upper")}
                    raise self.code.misuse(
                        "trial.note_range", name=name, value=value, t=t, **fields
                    )

    def _take(self, answer: Any, t: float, command: np.ndarray) -> None:
        """Write an answer of the class, a dict by valve or a row of volts, into ``command``."""
        unlike = (TypeError, ValueError)
        try:
            unknown = self.code.call("'s answer", self._write, answer, command, t=t, passing=unlike)
        except unlike:
            valves, fields = self.design.valves, {"t": t, "answer": shortened(answer, 80)}
            fields |= {"count": len(valves), "valves": ", ".join(valves)}
            raise self.code.misuse("trial.no_commands", **fields) from None
        for name in unknown:
            what = "unused by the recipe" if name in self.design.valves else "no valve"
            fields = {"name": shortened(name, 60), "what": what}
            valves = ", ".join(self._commanded)
            raise self.code.misuse("trial.unknown_command", valves=valves, **fields)

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

    def _seen(self, sample: np.ndarray) -> dict[str, float]:
        seen = sample.tolist()
        for i in self._hidden:
            seen[i] = math.nan
        return dict(zip(self.names, seen, strict=True))

    def _note_row(self, name: str, notes: Sequence[str]) -> tuple[str, Quantity]:
        """A note's name with its row of the vocabulary."""
        if not _NOTE_NAME.fullmatch(name):
            raise self.code.misuse("trial.note_name", name=shortened(name, 60))
        if notes.count(name) > 1:
            raise self.code.misuse("trial.note_twice", name=name)
        try:
            return name, quantity(name)
        except KeyError as error:
            problem = error.args[0]
            raise self.code.misuse("trial.note_quantity", name=name, problem=problem) from None


class _Code:
    """The file and class of the user, and errors that point into it."""

    def __init__(self, file: Path, label: str) -> None:
        self.file, self.label, self.guard = file, label, Guard()

    def make(self, gains: Mapping[str, Any]) -> Any:
        """An object of the class, with the methods of the protocol."""
        controller = self.call("()", partial(self._load(), **gains))
        for method in ("start", "step"):
            if not callable(self.call(f".{method}", getattr, controller, method, None)):
                raise self.misuse("trial.no_method", method=method)
        return controller

    def names_of(self, controller: Any, attribute: str) -> tuple[str, ...] | None:
        """The texts that an attribute lists; None where there is none, or one text alone."""

        def listed() -> tuple[Any, ...] | None:
            given = getattr(controller, attribute, None)
            if isinstance(given, str) or not isinstance(given, Sequence):
                return None
            return tuple(islice(given, CODE.names))

        names = self.call(f".{attribute}", listed)
        for name in names or ():
            if type(name) is not str:
                raise self.misuse("trial.not_text", attribute=attribute, value=shortened(name, 60))
        return names

    def _load(self) -> Callable[..., Any]:
        module = types.ModuleType(f"ehbench_user_{self.file.stem}")
        module.__file__ = str(self.file)
        sys.modules[module.__name__] = module  # where dataclasses and pickles look for it
        try:
            code = self.guard(compile, self.file.read_bytes(), str(self.file), "exec")
        except OSError as error:
            problem = message("trial.code_unreadable", problem=error.strerror)
            raise InputError(problem, file=self.file) from None
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            reason, line = getattr(error, "msg", str(error)), getattr(error, "lineno", None)
            problem = message("trial.not_python", problem=reason)
            raise InputError(problem, file=self.file, line=line) from None
        self.call("", exec, code, module.__dict__)
        controller = getattr(module, self.label, None)
        if not isinstance(controller, type):
            types_here = ((n, x) for n, x in vars(module).items() if isinstance(x, type))
            there = [name for name, item in types_here if item.__module__ == module.__name__]
            raise self.misuse("trial.no_class", known=", ".join(there) or "none")
        return controller

    def call(
        self,
        what: str,
        function: Callable[..., Any],
        *given: Any,
        t: float | None = None,
        passing: tuple[type[Exception], ...] = (),
    ) -> Any:
        """What a function of the user's gives; errors but those ``passing`` point into the file."""
        try:
            return self.guard(function, *given)
        except BaseException as error:
            # what who runs the program does is not the code's own
            if isinstance(error, (*passing, Terminated, KeyboardInterrupt)):
                raise
            raise self.raised(what, error, t) from error

    def raised(self, what: str, error: BaseException, t: float | None = None) -> InputError:
        frames = traceback.extract_tb(error.__traceback__)
        last = next((f for f in reversed(frames) if f.filename == str(self.file)), None)
        where = {"label": self.label, "place": what}
        where["time"] = "" if t is None else f" at t = {t:.4g} s"
        where["line"] = "" if last is None else f"in the line: {last.line}"
        if isinstance(error, Exit):
            problem = message("trial.code_exits", **where)
        elif isinstance(error, Overdue):
            problem = message("trial.code_overdue", longest=self.guard.longest, **where)
        else:
            try:
                text = str(error)[:300]
            except Exception:
                text = "no text"
            name = type(error).__name__
            problem = message("trial.code_raised", error=name, problem=text, **where)
        return InputError(problem, file=self.file, line=None if last is None else last.lineno)

    def misuse(self, key: str, **fields: Any) -> InputError:
        return InputError(message(key, label=self.label, **fields), file=self.file)


def _gain(recipe: TrialRecipe, name: str, raw: Any) -> Any:
    if isinstance(raw, str) and name in VOCABULARY:
        return quantities(recipe, "gains", {name: raw}, {name: VOCABULARY[name]})[name]
    return raw
