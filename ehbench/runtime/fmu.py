"""FMUs of users: their variables, and their binaries at work in child processes.

A binary is foreign code. Each runs in a process with bounded memory and time, which where the
system knows how opens no files but its own."""

import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np

from ehbench.runtime.fmu_child import DONE, HEAD, START, STEP
from ehbench.vocabulary import InputError, UnitError, message, setting, units
from ehbench.vocabulary.errors import FmuError


@dataclass(frozen=True)
class FmuSettings:
    """What the binary of a user's FMU may take."""

    memory: float = setting(4e9, "B", "memory of its process", "large tables")
    wait: float = setting(30.0, "s", "time of its start, or of so many steps", "a stiff solver")
    rows: int = setting(1000, "steps", "in one request", "a second at 1 kHz")
    unpacked: float = setting(2e9, "B", "size of its files", "maps and tables")


FMU = FmuSettings()


BASE = ("kg", "m", "s", "A", "K")  # of the base units those that numbers of rigs have


class Variable(NamedTuple):
    """A real number of an FMU: its value reference, and ``SI = factor·value + offset``."""

    reference: int
    factor: float
    offset: float


class Fmu:
    """An FMU for co-simulation, unpacked.

    Raises:
        InputError: it cannot be read, is not for co-simulation, or not for this platform."""

    def __init__(self, file: Path) -> None:
        try:
            import fmpy
        except ImportError:
            raise InputError(message("runtime.no_fmpy"), file=file) from None
        self.file = file
        place = mkdtemp(prefix="ehbench_fmu_")
        weakref.finalize(self, shutil.rmtree, place, ignore_errors=True)
        self.folder = Path(place) / "fmu"
        (self.folder.parent / "work").mkdir()
        try:
            with ZipFile(file) as archive:
                size = sum(item.file_size for item in archive.infolist())
            if size > FMU.unpacked:
                raise InputError(message("runtime.fmu_large", size=size), file=file)
            fmpy.extract(str(file), str(self.folder))
            self.description = fmpy.read_model_description(str(self.folder), validate=False)
            platforms = fmpy.supported_platforms(str(self.folder))
        except InputError:
            raise
        except OSError as error:
            reason = error.strerror or self.plain(error)
            raise InputError(message("runtime.fmu_unreadable", reason=reason), file=file) from None
        except Exception as error:  # a zip or an XML may be broken in any way
            reason = f"modelDescription.xml: {self.plain(error)}"
            reason = "no zip archive" if isinstance(error, BadZipFile) else reason
            raise InputError(message("runtime.fmu_unreadable", reason=reason), file=file) from None
        version = self.description.fmiVersion
        if self.description.coSimulation is None or str(version)[:1] not in "23":
            raise InputError(message("runtime.fmu_kind", version=version), file=file)
        if fmpy.platform not in platforms:
            there = ", ".join(platforms) or "none"
            fields = {"platform": fmpy.platform, "there": there}
            raise InputError(message("runtime.fmu_platform", **fields), file=file)

    def plain(self, problem: object) -> str:
        """A problem in words that name the FMU's files as the FMU does."""
        return str(problem).replace(f"{self.folder}{os.sep}", "")

    def variable(self, name: str, unit: str | None, use: str) -> Variable:
        """A variable by name, in the SI unit of what it stands for; without one as the FMU has it.
        What its ``use`` is: a key of the references of a `FmuProcess`, or ``settable`` before the
        start.

        Raises:
            InputError: there is none, it is no single real number, not of that dimension, or cannot
                be set where it is to be."""
        known = {item.name: item for item in self.description.modelVariables}
        item = known.get(name)
        if item is None:
            near = ", ".join(sorted(known, key=lambda other: (abs(len(other) - len(name)), other)))
            text = message("runtime.fmu_variable", name=name, known=near[:200])
            raise InputError(text, file=self.file)
        if item.type not in ("Real", "Float64") or item.dimensions:
            raise InputError(message("runtime.fmu_not_real", name=name), file=self.file)
        able = item.causality in ("input", "parameter", "structuralParameter")
        able |= use != "commands" and item.initial in ("exact", "approx")
        if use != "channels" and not able:
            fields = {"name": name, "causality": item.causality}
            raise InputError(message("runtime.fmu_not_set", **fields), file=self.file)
        declared = item.unit or getattr(item.declaredType, "unit", None)
        if declared is None or unit is None:
            return Variable(item.valueReference, 1.0, 0.0)
        base = {each.name: each.baseUnit for each in self.description.unitDefinitions}.get(declared)
        if base is not None:
            powers = {word: power for word in BASE if (power := getattr(base, word))}
            expected = units.exponents(unit)  # an angle may be a stroke: a rig may slide
            vague = use != "commands" and (not powers or not expected or "rad" in expected)
            if vague or powers == expected:
                return Variable(item.valueReference, base.factor, base.offset)
            problem: str = message("vocabulary.unit_of_another_kind", unit=declared, si=unit)
        else:
            try:
                # a dot multiplies, but in a number
                factor = units.factor(re.sub(r"(?<!\d)\.|\.(?!\d)", "*", declared), unit)
                return Variable(item.valueReference, factor, 0.0)
            except UnitError as error:
                problem = error.message
        if use == "commands":  # a rig has volts alone
            return Variable(item.valueReference, 1.0, 0.0)
        fields = {"name": name, "unit": declared, "problem": problem}
        raise InputError(message("runtime.fmu_unit", **fields), file=self.file)


@lru_cache(maxsize=8)
def _unpacked(file: Path, stamp: int, size: int) -> Fmu:
    return Fmu(file)


def fmu_of(file: Path) -> Fmu:
    """The FMU of a file, unpacked once.

    Raises:
        InputError: as `Fmu`."""
    try:
        facts = file.stat()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(message("runtime.fmu_unreadable", reason=reason), file=file) from None
    return _unpacked(file, facts.st_mtime_ns, facts.st_size)


class FmuProcess:
    """An FMU at work in a child, by the value references of ``start``, ``commands`` and
    ``channels``.

    Every method raises FmuError where the binary crashes, hangs or reports an error."""

    def __init__(self, fmu: Fmu, references: Mapping[str, Sequence[int]]) -> None:
        self.fmu, self.width = fmu, len(references["channels"])
        given = {"references": dict(references), "memory": FMU.memory, "seconds": FMU.wait}
        self._child = subprocess.Popen(
            [sys.executable, "-m", "ehbench.runtime.fmu_child", str(fmu.folder), json.dumps(given)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        self.close = weakref.finalize(self, _end, self._child)

    def start(self, values: np.ndarray) -> np.ndarray:
        """The channels at t = 0, shape (channels,), of a new instance: ``values`` of its start,
        then the commands."""
        return self._ask(START, values[None, :], 0.0)[0]

    def steps(self, table: np.ndarray, tick: float) -> np.ndarray:
        """The channels after each command of a ``table``, shape (rows, commands), has acted for a
        tick [s]; fewer rows where one is not finite."""
        rows = [np.empty((0, self.width))]
        for first in range(0, len(table), FMU.rows):
            part = table[first : first + FMU.rows]
            rows.append(self._ask(STEP, part, tick))
            if len(rows[-1]) < len(part):
                break
        return np.concatenate(rows)

    def _ask(self, kind: int, table: np.ndarray, tick: float) -> np.ndarray:
        until = time.monotonic() + FMU.wait
        body = np.ascontiguousarray(table, dtype=float).tobytes()
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(HEAD.pack(kind, len(table), tick) + body)
            self._child.stdin.flush()
            status, size, _ = HEAD.unpack(self._read(HEAD.size, until))
            answer = self._read(size, until)
        except (BrokenPipeError, EOFError):
            code = self._child.wait()
            name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            if -code in (signal.SIGXCPU, signal.SIGALRM):
                raise self._hung() from None
            raise FmuError(message("runtime.fmu_crashed", end=name), file=self.fmu.file) from None
        if status != DONE:
            problem = self.fmu.plain(answer.decode(errors="replace"))
            raise FmuError(message("runtime.fmu_failed", problem=problem), file=self.fmu.file)
        return np.frombuffer(bytes(answer)).reshape(-1, self.width)

    def _read(self, size: int, until: float) -> bytearray:
        assert self._child.stdout is not None
        number, result = self._child.stdout.fileno(), bytearray()
        waiting = select.poll()
        waiting.register(number, select.POLLIN)
        while len(result) < size:
            left = until - time.monotonic()
            if left <= 0.0:
                self.close()
                raise self._hung()
            if waiting.poll(1e3 * left):
                piece = os.read(number, size - len(result))
                if not piece:
                    raise EOFError
                result += piece
        return result

    def _hung(self) -> FmuError:
        return FmuError(message("runtime.fmu_hung", seconds=FMU.wait), file=self.fmu.file)


def _end(child: subprocess.Popen[Any]) -> None:
    """End a child, whatever it does."""
    child.kill()
    child.wait()
    for pipe in (child.stdin, child.stdout):
        try:
            pipe.close()  # type: ignore[union-attr]
        except OSError:
            continue
