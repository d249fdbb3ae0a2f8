"""The samples of a running study on disk, a line each; the last one may be torn."""

import json
import math
import os
import time
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from ehbench.runs.rundir import FULL
from ehbench.sampling.sample import Sample
from ehbench.vocabulary import InputError, message


class Journal:
    """The samples that are done.

    Args:
        path: of the file; its content is taken over if it is of this very study, else replaced.
        key: of the study: recipe, inputs, versions.
        size: how many samples it has.
        resume: whether to take over its content.

    Attributes:
        done: which samples are there.
        taken: how many samples were taken over.

    Raises:
        InputError: it has samples of this study, and ``resume`` is not set."""

    def __init__(self, path: Path, key: str, size: int, resume: bool) -> None:
        self.path, self.done = path, np.zeros(size, bool)
        self._places = np.zeros(size, np.int64)
        self._end, self._synced = 0, 0.0
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("rb") if path.exists() else BytesIO() as file:
            for line in file:  # whole lines of a file of this study
                try:
                    row = json.loads(line) if line.endswith(b"\n") else {}
                except ValueError:
                    row = {}
                # pyrefly: ignore[redundant-condition]
                if self._end and "i" in row:
                    self.done[row["i"]], self._places[row["i"]] = True, self._end
                elif self._end or row.get("study") != key:
                    break
                self._end += len(line)
        self.taken = int(self.done.sum())
        if self.taken and not resume:
            text = message("sampling.left_samples", count=self.taken, size=size)
            raise InputError(text, file=path)
        self._file = path.open("ab")
        self._file.truncate(self._end)
        if not self._end:
            self._write(json.dumps({"study": key}).encode() + b"\n")

    def add(self, samples: Sequence[Sample]) -> None:
        """Add samples.

        Raises:
            InputError: the disk takes no more; what is there stays."""
        for sample in samples:
            if not self.done[sample.index]:
                place, row = self._end, {"i": sample.index, "c": sample.code, "s": sample.status}
                row |= {"m": [value if math.isfinite(value) else None for value in sample.measures]}
                row |= {"e": sample.message} if sample.message else {}
                text = json.dumps(row, separators=(",", ":"), ensure_ascii=False)
                self._write(text.encode() + b"\n")
                self.done[sample.index], self._places[sample.index] = True, place
        if time.monotonic() - self._synced > 1.0:  # [s] between two syncs
            os.fsync(self._file.fileno())
            self._synced = time.monotonic()

    def _write(self, line: bytes) -> None:
        try:
            self._file.write(line)
            self._file.flush()
        except OSError as error:
            if error.errno not in FULL:
                raise
            count = int(self.done.sum())
            text = message("sampling.disk_full", reason=error.strerror, count=count)
            raise InputError(text, file=self.path) from None
        self._end += len(line)

    def samples(self) -> Iterator[Sample]:
        """The samples in the order of their numbers."""
        with self.path.open("rb") as file:
            for place in self._places[self.done].tolist():
                file.seek(place)
                row = json.loads(file.readline())
                numbers = (math.nan if value is None else float(value) for value in row["m"])
                yield Sample(row["i"], row["c"], row["s"], row.get("e", ""), tuple(numbers))

    def close(self) -> None:
        """Close the file; one without a sample is removed."""
        try:
            self._file.close()
        except OSError as error:  # what could not be written is reported already
            if error.errno not in FULL:
                raise
        if not self.done.any():
            self.path.unlink(missing_ok=True)
