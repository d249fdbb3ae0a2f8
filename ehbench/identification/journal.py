"""How far a search has come, in a file beside the run's folder, so that one that was stopped goes
on.

A search is a chain of steps, each a function of what it starts from and of nothing else. The
journal keeps what each came to under the SHA-256 of its start; a search that is done again skips
the steps whose starts are the same, and ends with the same bytes."""

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ehbench.runs import rundir
from ehbench.runtime.disk import write_text
from ehbench.vocabulary import EhbenchError, InputError

EVERY = 0.5  # [s] between writings: what a killed search loses at most


class Journal:
    """What the steps of a search came to, in their order.

    Args:
        path: file to keep it in; None keeps nothing.
        about: facts at its head, among them the ``hash`` of the run's inputs.
        known: steps of the search that was stopped."""

    def __init__(
        self,
        path: Path | None = None,
        about: Mapping[str, Any] | None = None,
        known: list[dict[str, Any]] | None = None,
    ) -> None:
        self.path, self.about, self.known = path, dict(about or {}), known or []
        self.steps: list[dict[str, Any]] = []
        self.stands: dict[str, Any] = {}
        self.search = ""  # the search that steps belong to
        self._written = time.monotonic()

    def begin(self, *start: object) -> dict[str, Any]:
        """Begin a step; what is known of it, empty where nothing is. ``left`` is how many known
        steps of the same search come after it.

        Args:
            start: all that the step's result depends on: bytes, or what `repr` tells exactly."""
        digest = hashlib.sha256()
        for part in start:
            digest.update(part if isinstance(part, bytes) else repr(part).encode())
            digest.update(b"\0")
        name, at = digest.hexdigest(), len(self.steps)
        if at < len(self.known) and self.known[at].get("from") != name:
            self.known = self.known[:at]
        result = dict(self.known[at]) if at < len(self.known) else {}
        self.steps.append(result or {"from": name, "search": self.search})
        left = sum(step["search"] == self.search for step in self.known[at + 1 :])
        return result | {"left": left} if result else {}

    def keep(self, stands: Mapping[str, Any], **result: Any) -> None:
        """Note what the step that was begun last has come to, and where the search stands."""
        self.steps[-1] = self.steps[-1] | result
        self.stands = dict(stands)
        if time.monotonic() - self._written > EVERY:
            self.write()

    def write(self) -> None:
        """Write all that is known, in one piece; a disk that takes no more ends no search."""
        self._written = time.monotonic()
        if self.path is None or not self.steps:
            return
        steps = self.steps + self.known[len(self.steps) :]
        text = json.dumps({**self.about, "stands": self.stands, "steps": steps}, indent=1)
        with suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_text(self.path, text + "\n")


def place_of(final: Path) -> Path:
    """Where the journal of a run lies."""
    return final.with_name(f"{final.name}.search.json")


@contextmanager
def journal_of(final: Path, about: Mapping[str, Any], resume: bool) -> Iterator[Journal]:
    """The journal of a run that goes to ``final``; it stays where the run is stopped, and is gone
    when the run has ended.

    Args:
        about: as of `Journal`; a journal is gone on with where they are the same.
        resume: go on with the one that is there."""
    path = place_of(final)
    journal = Journal(path, about, _steps(path, about) if resume else [])
    try:
        yield journal
    except EhbenchError:  # it would end so again
        _remove(path)
        raise
    except BaseException as error:
        journal.write()
        if path.is_file():
            error.add_note(f"how far the search has come is kept in {path}: --resume goes on")
        raise
    _remove(path)


def _remove(path: Path) -> None:
    """Remove a journal; where nothing can be removed, there is none."""
    with suppress(OSError):
        path.unlink()


def _steps(path: Path, about: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The steps in a journal of the same run; none where there is no such journal."""
    try:
        read = rundir.read_json(path)
    except InputError:
        return []
    if not isinstance(read, dict) or any(read.get(key) != value for key, value in about.items()):
        return []
    steps = read.get("steps")
    if not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        return []
    # only where a step can be gone on with is the search what it was, to what it has in memory
    while steps and not steps[-1].keys() & {"steps", "costs"}:
        steps.pop()
    return steps
