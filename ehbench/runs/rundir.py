"""Run folders: results in plain files, with every input named by its SHA-256.

A run is written into a temporary folder next to its place and renamed when it is whole, so nothing
half-written stays. What a killed process left is cleared by the next run, and the logs in it are
kept. ``run.json`` holds only what the same inputs give again; what differs from run to run is in
``volatile.json``."""

import errno
import hashlib
import itertools
import json
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from ehbench.runs.versions import Versions
from ehbench.runtime.disk import DATA, impossible, read_bytes, write_text
from ehbench.runtime.interrupts import unbroken
from ehbench.vocabulary import EhbenchError, InputError, Message, message
from ehbench.vocabulary.text import shortened_path

PACKAGE = Path(__file__).resolve().parents[1]
SHIPPED = PACKAGE / "shipped"  # recipes and datasets in a wheel; a checkout has them next to it
_PART = re.compile(r"\.(?P<name>.+)\.(?P<pid>[1-9]\d*)\.part")
# errors of a disk that takes no more
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
_LIBRARIES = "numpy scipy pandas numba matplotlib pydantic mcap control".split()


def sha256(path: Path) -> str:
    """SHA-256 of a file, of a run folder's ``run.json``, or of all files of a ROS 2 bag."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        digest = hashlib.sha256()
        for part in sorted(item for item in path.iterdir() if item.is_file()):
            digest.update(os.fsencode(part.name) + b"\0" + read_bytes(part, DATA))
        return digest.hexdigest()
    target = path / "run.json" if path.is_dir() else path
    return hashlib.sha256(read_bytes(target, DATA)).hexdigest()


def shipped(name: str) -> Path:
    """Where the ``recipes`` or ``datasets`` that ship with the package are."""
    inside = SHIPPED / name
    return inside if inside.is_dir() else PACKAGE.parent / name


@lru_cache(maxsize=1)
def commit() -> str:
    """The commit of the package's checkout (``+changes`` when files differ), or ``none``."""
    try:
        done = subprocess.run(
            ["git", "-C", str(PACKAGE), "describe", "--always", "--abbrev=12", "--dirty=+changes"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "none"
    return done.stdout.strip() or "none"


def plain(value: Any) -> Any:
    """``value`` as JSON holds it: arrays as lists, NaN and infinities as null."""
    if isinstance(value, Message):
        if not value.key:
            return str(value)
        return {"key": value.key, "text": str(value), "fields": plain(value.fields)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (set, frozenset)):
        value = sorted(value)
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return value.as_posix()
    return value


def write_json(path: Path, value: Any) -> None:
    """Write JSON with stable bytes; bytes of names that are no UTF-8 as ``\\udcXX``."""
    text = json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_text(path, text.encode("utf-8", "backslashreplace").decode())


def read_json(path: Path) -> Any:
    """Read a JSON file of a run folder.

    Raises:
        InputError: not there or not JSON."""

    def message_of(value: dict[str, Any]) -> Any:  # where `plain` wrote one
        if value.keys() != {"key", "text", "fields"}:
            return value
        return Message(value["text"], value["key"], value["fields"])

    try:
        return json.loads(read_bytes(path, DATA).decode("utf-8"), object_hook=message_of)
    except FileNotFoundError:
        raise InputError(message("runs.no_file"), file=path) from None
    except (ValueError, RecursionError) as error:
        text = message("runs.no_json", reason=str(error) or "nested too deeply")
        raise InputError(text, file=path) from None


@dataclass
class Run:
    """A run being written: put files into ``path``; ``facts`` become part of ``run.json``.

    ``left_over`` says what killed runs had left next to it."""

    path: Path
    final: Path
    record: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    left_over: tuple[str, ...] = ()

    def save(self) -> None:
        """Write ``run.json`` over the files that are there."""
        outputs = {
            path.relative_to(self.path).as_posix(): sha256(path)
            for path in sorted(self.path.rglob("*"))
            if path.is_file() and path != self.path / "run.json"
        }
        facts = plain({**self.record, **self.facts, "outputs": outputs})
        write_json(self.path / "run.json", {**facts, "checksum": checksum(facts)})


def checksum(facts: Mapping[str, Any]) -> str:
    """SHA-256 of ``run.json`` without its checksum: shows an edit, proves no author."""
    text = json.dumps(plain(facts), ensure_ascii=False, allow_nan=False, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()


def run_hash(recipe: str, inputs: Iterable[tuple[str, str]], versions: Versions) -> str:
    """Eight hex digits that name a run, by the SHA-256 of its recipe, role and SHA-256 of each
    input, and the versions of its schema and methods."""
    digest = hashlib.sha256(f"{recipe}{versions}\n".encode())
    for role, content in inputs:
        digest.update(f"{role}:{content}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()[:8]


def hash_of(recipe: Path, inputs: Iterable[tuple[str, Path]], versions: Versions) -> str:
    """The `run_hash` of files."""
    return run_hash(sha256(recipe), ((role, sha256(path)) for role, path in inputs), versions)


def is_whole(folder: Path) -> bool:
    """Whether a run folder is there with every output as it was written."""
    if impossible(folder / "run.json") or not (folder / "run.json").is_file():
        return False
    outputs = outputs_of(folder / "run.json")
    return all(
        (folder / name).is_file() and sha256(folder / name) == digest
        for name, digest in outputs.items()
    )


@contextmanager
def open_run(
    final: Path,
    stage: str,
    recipe: Path,
    inputs: Iterable[tuple[str, Path]],
    seeds: Mapping[str, int] | None = None,
    versions: Versions | None = None,
) -> Iterator[Run]:
    """A ``Run`` whose folder becomes ``final`` when the block ends well; otherwise nothing stays
    but what it recorded of a machine.

    An earlier run there is replaced, but only where its files are as it wrote them, and never
    where it recorded a machine.

    Raises:
        InputError: ``final`` contains anything but the files of a run that can be made again, or it
            cannot be written."""
    inputs, final = list(inputs), checked_place(final)
    left_over = clear_left(final.parent)
    scratch = final.parent / f".{final.name}.{os.getpid()}.part"
    shutil.rmtree(scratch, ignore_errors=True)
    # before there is a folder that a signal could leave behind: this takes a while
    record = _record(stage, recipe, inputs, seeds or {}, versions or Versions.of(stage))
    run = Run(scratch, final, record, left_over=left_over)
    began, lock = time.time(), None
    absent = [folder for folder in scratch.parents if not folder.exists()]
    try:
        try:
            scratch.mkdir(parents=True)
        except (OSError, ValueError) as error:
            raise _no_place(final, error) from None
        lock = _lock(scratch)
        with _recording_kept(run):
            yield run
            run.save()
            places = {"recipe": recipe.resolve(), "inputs": [path.resolve() for _, path in inputs]}
            write_json(scratch / "volatile.json", {**_volatile(began), **places})
            run.left_over += _put(scratch, final)
    except OSError as error:
        if error.errno not in FULL:
            raise
        text = message("runs.not_written", reason=error.strerror)
        raise _noted(error, InputError(text, file=final)) from None
    except EhbenchError as error:  # of a file that is gone by the time the message is read
        if error.file is None or scratch not in Path(error.file).parents:
            raise
        elsewhere = type(error)(error.message, file=final, hint=error.hint)
        raise _noted(error, elsewhere) from None
    finally:
        with unbroken():
            shutil.rmtree(scratch, ignore_errors=True)
            with suppress(OSError):  # they hold the run
                for folder in absent:
                    folder.rmdir()
        if lock is not None:
            os.close(lock)


def _noted(error: Exception, other: EhbenchError) -> EhbenchError:
    """Another error in place of one, with its notes: where the log is."""
    for note in getattr(error, "__notes__", []):
        other.add_note(note)
    return other


@contextmanager
def _recording_kept(run: Run) -> Iterator[None]:
    """A block in which a run that recorded a machine ends in a folder beside its own where that
    has become occupied, and leaves its log where anything else fails."""
    try:
        yield
    except BaseException as error:
        if "://" not in str(run.facts.get("on")):  # the address of a machine
            raise
        with unbroken():
            if isinstance(error, InputError) and (run.path / "volatile.json").is_file():
                taken, run.final = run.final, _unused(run.final)
                run.left_over += (message("runs.beside", place=taken), *_put(run.path, run.final))
                return
            for note in salvage(run.path):
                error.add_note(note)
        raise


def _record(
    stage: str,
    recipe: Path,
    inputs: Sequence[tuple[str, Path]],
    seeds: Mapping[str, int],
    versions: Versions,
) -> dict[str, Any]:
    """What ``run.json`` states of a run of any stage: the same from the same inputs."""
    digests = [(role, path, sha256(path)) for role, path in inputs]
    content = [(role, digest) for role, _, digest in digests]
    # names that are the same on every machine: from the recipe, or a run folder's
    named = {
        path: path.name if path.is_dir() else Path(os.path.relpath(path, recipe.parent)).as_posix()
        for _, path, _ in digests
    }
    return {
        "stage": stage,
        "name": recipe.stem,
        "argv": ["ehbench", stage, recipe.name],
        "hash": run_hash(sha256(recipe), content, versions),
        "recipe": {"path": recipe.name, "sha256": sha256(recipe)},
        "inputs": [
            {"role": role, "path": named[path], "sha256": digest} for role, path, digest in digests
        ],
        "seeds": dict(seeds),
        "schema": versions.schema,
        "methods": dict(versions.methods),
        "versions": dict(_libraries()),
        "commit": commit(),
    }


@lru_cache(maxsize=1)
def _libraries() -> Mapping[str, str]:
    """Versions of the package, of Python and of libraries that results depend on."""
    return {
        "ehbench": metadata.version("ehbench"),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


def started(folder: Path) -> str:
    """When a run was started, as text that sorts by time; empty where none was."""
    file = folder / "volatile.json"
    return str(read_json(file).get("started", "")) if file.is_file() else ""


def _volatile(began: float) -> dict[str, Any]:
    """What differs from run to run; ``began`` is when [s since 1970]."""
    return {
        "argv": sys.argv,
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(began)),
        "seconds": round(time.time() - began, 3),
        "machine": platform.machine(),
        "system": platform.system(),
        "cores": os.cpu_count(),
    }


def checked_place(final: Path) -> Path:
    """Where a run's folder really is: a link is followed, never replaced.

    Raises:
        InputError: the path leads nowhere, or to what no run may replace."""
    try:
        place = final.resolve() if final.is_symlink() else final
        if place.is_symlink():  # in a circle, which is no error for `resolve` of Python 3.13
            place.stat()
        if Path.cwd().is_relative_to(place.resolve()):
            raise InputError(message("runs.current_folder"), file=final)
        _survey(place)
    except FileNotFoundError:  # another process is putting its run there
        pass
    except (OSError, RuntimeError, ValueError) as error:
        raise _no_place(final, error) from None
    return place


def _no_place(final: Path, error: Exception) -> InputError:
    reason = str(getattr(error, "strerror", None) or error)
    return InputError(message("runs.no_place", reason=reason), file=shortened_path(final))


def _survey(folder: Path) -> tuple[list[Path], list[Path]]:
    """(files of the run in a folder that are as the run wrote them, those that have changed).

    Raises:
        InputError: it is no folder, contains anything that its run did not write, or what a machine
            did."""
    if not folder.exists():
        return [], []
    if not folder.is_dir():
        raise InputError(message("runs.is_file"), file=folder)
    files = [path for path in sorted(folder.rglob("*")) if path.is_symlink() or not path.is_dir()]
    if not files:
        return [], []
    if not (folder / "run.json").is_file():
        for path in files:
            path.lstat()
        raise InputError(message("runs.not_a_run"), file=folder)
    outputs, unchanged, changed = outputs_of(folder / "run.json"), [], []
    if "://" in (on := str(read_json(folder / "run.json").get("on"))):  # the address of a machine
        raise InputError(message("runs.recorded", on=on), file=folder)
    for path in files:
        name = path.relative_to(folder).as_posix()
        if name in ("run.json", "volatile.json"):
            unchanged.append(path)
        elif name not in outputs or path.is_symlink() or not path.is_file():
            raise InputError(message("runs.foreign_file", name=name), file=folder)
        else:
            (unchanged if sha256(path) == outputs[name] else changed).append(path)
    return unchanged, changed


def outputs_of(facts: Path) -> Mapping[str, Any]:
    """The files that a run wrote, by name, each with its SHA-256, from its ``run.json``.

    Raises:
        InputError: it is no ``run.json``."""
    content = read_json(facts)
    outputs = content.get("outputs") if isinstance(content, Mapping) else None
    if not isinstance(outputs, Mapping):
        raise InputError(message("runs.no_outputs"), file=facts)
    return outputs


def _put(scratch: Path, final: Path) -> tuple[str, ...]:
    """Move a whole run to its place, where the same run stays: another process may be reading it.
    Files of the run before that someone changed are kept in ``salvaged``; a message for each."""
    before, messages = final.with_name(f".{final.name}.{os.getpid()}.before"), []
    for _ in range(100):
        with suppress(FileNotFoundError, InputError):  # another process is putting its run there
            facts = [read_bytes(folder / "run.json", DATA) for folder in (scratch, final)]
            if facts[0] == facts[1] and is_whole(final):
                os.replace(scratch / "volatile.json", final / "volatile.json")
                return tuple(messages)
        with suppress(FileNotFoundError):
            final.rename(before)
            try:
                messages += _remove(before, final)
            except InputError:  # someone put a file there meanwhile
                before.rename(final)
                raise
        try:
            scratch.rename(final)
            return tuple(messages)
        except OSError as error:  # another process has put its run there
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
    raise InputError(message("runs.busy"), file=final)


def _remove(before: Path, final: Path) -> list[Message]:
    """Remove the run of ``final``, which now lies at ``before``, but for what someone changed."""
    unchanged, changed = _survey(before)
    messages = []
    retained = _unused(final.parent / "salvaged" / final.name)
    for path in changed:
        name = path.relative_to(before)
        target = retained / name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
        messages.append(message("runs.changed", name=name.as_posix(), target=str(target)))
    for path in unchanged:
        path.unlink()
    for folder in sorted((path for path in before.rglob("*") if path.is_dir()), reverse=True):
        folder.rmdir()
    before.rmdir()
    return messages


# --- what killed processes left


def clear_left(folder: Path) -> tuple[str, ...]:
    """Remove what dead processes left, keep logs with samples in ``salvaged``; a message each."""
    messages = []
    for left in sorted(folder.glob(".*.part")):
        match = _PART.fullmatch(left.name)
        if match is None or not left.is_dir() or not _abandoned(left, int(match["pid"])):
            continue
        messages += salvage(left)
        shutil.rmtree(left, ignore_errors=True)
    return tuple(messages)


def salvage(left: Path) -> list[Message]:
    """Move the logs with samples of a run that was not finished to ``salvaged`` beside it; a
    message each."""
    from ehbench.data import read

    match, messages = _PART.fullmatch(left.name), []
    if match is None:
        return messages
    retained = _unused(left.parent / "salvaged" / f"{match['name']}_{match['pid']}")
    for path in sorted(left.rglob("*.mcap")):
        try:
            samples = read(path, check=False).t.size
        except EhbenchError:
            samples = 0
        if not samples:
            continue
        target = retained / path.relative_to(left)
        target.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process was quicker
            os.replace(path, target)
            messages.append(message("runs.salvaged", name=match["name"], target=str(target)))
    return messages


def _unused(place: Path) -> Path:
    tries = (place if n == 1 else place.with_name(f"{place.name}_{n}") for n in itertools.count(1))
    return next(item for item in tries if not item.exists())


def _abandoned(folder: Path, pid: int) -> bool:
    """Whether no process of that number, or with the folder's lock, works in it."""
    if os.name != "posix":
        return False
    try:
        os.kill(pid, 0)
        return False
    except ProcessLookupError:
        pass
    except (OSError, OverflowError):
        return False
    lock = _lock(folder)
    if lock is not None:
        os.close(lock)
    return lock is not None


def _lock(folder: Path) -> int | None:
    """A folder that only this process locks until it ends; None where it cannot."""
    try:
        import fcntl

        lock = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        return None
    return lock
