"""The samples of a running study on disk, as they come: what a killed study goes on from.

A line is a sample; the last one may be torn."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.runs.rundir import FULL
from ehbench.sampling.sample import Sample
from ehbench.vocabulary.errors import InputError

SYNC = 1.0  # [s] between two syncs


class Journal:
    """The samples that are done.

    Args:
        path: of the file; what stands there is taken over if it is of this very study, recipe,
            inputs and code, else replaced.
        key: of the study: recipe, inputs, code.
        size: how many samples it has.
        resume: whether to take over what stands.

    Attributes:
        taken: how many samples were taken over.

    Raises:
        InputError: samples of this study stand there, and nobody asked to go on with them.
    """

    def __init__(self, path: Path, key: str, size: int, resume: bool) -> None:
        self.path, self.done = path, np.zeros(size, bool)
        self._places = np.zeros(size, np.int64)
        self._synced = 0.0
        path.parent.mkdir(parents=True, exist_ok=True)
        self.end = self._taken_over(key)
        self.taken = int(self.done.sum())
        if self.taken and not resume:
            raise InputError(
                f"a study that was killed left {self.taken} of its {size} samples here",
                file=path,
                hint="go on with --resume, or remove the file to begin anew",
            )
        self._file = path.open("ab")
        self._file.truncate(self.end)
        if not self.end:
            self._write(json.dumps({"study": key}).encode() + b"\n")

    def _taken_over(self, key: str) -> int:
        """Take over what stands; where its last whole line ends."""
        if not self.path.exists():
            return 0
        end = 0
        with self.path.open("rb") as file:
            for line in file:
                if not line.endswith(b"\n"):
                    break
                try:
                    message = json.loads(line)
                except ValueError:
                    break
                if not end and message.get("study") != key:
                    return 0
                if end:
                    self.done[message["i"]], self._places[message["i"]] = True, end
                end += len(line)
        return end

    def add(self, samples: Sequence[Sample]) -> None:
        """Keep samples.

        Raises:
            InputError: the disk takes no more; what is kept stays.
        """
        for sample in samples:
            if self.done[sample.index]:
                continue
            at = self.end
            self._write(_line(sample))
            self.done[sample.index], self._places[sample.index] = True, at
        if time.monotonic() - self._synced > SYNC:
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()

    def _write(self, line: bytes) -> None:
        try:
            self._file.write(line)
            self._file.flush()
        except OSError as error:
            if error.errno not in FULL:
                raise
            raise InputError(
                f"no more samples can be kept: {error.strerror}; {int(self.done.sum())} are",
                file=self.path,
                hint="make room, then go on with --resume",
            ) from None
        self.end += len(line)

    def samples(self, indices: Sequence[int] | None = None) -> Iterator[Sample]:
        """Samples in the order of their numbers; all by default."""
        required = np.flatnonzero(self.done) if indices is None else indices
        with self.path.open("rb") as file:
            for index in required:
                file.seek(int(self._places[index]))
                yield _sample(json.loads(file.readline()))

    def close(self) -> None:
        """Let the file go; one without a sample goes altogether."""
        try:
            self._file.close()
        except OSError as error:  # what could not be written is said already
            if error.errno not in FULL:
                raise
        if not self.done.any():
            self.path.unlink(missing_ok=True)


def _line(item: Sample) -> bytes:
    numbers = [value if math.isfinite(value) else None for value in item.measures]
    messages: dict[str, Any] = {"i": item.index, "c": item.code, "s": item.status, "m": numbers}
    if item.said:
        messages["e"] = item.said
    return json.dumps(messages, separators=(",", ":"), ensure_ascii=False).encode() + b"\n"


def _sample(message: dict[str, Any]) -> Sample:
    numbers = tuple(math.nan if value is None else float(value) for value in message["m"])
    return Sample(message["i"], message["c"], message["s"], message.get("e", ""), numbers)
