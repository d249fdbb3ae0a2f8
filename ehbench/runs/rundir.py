"""Run folders: results in plain files, with every input named by its SHA-256.

A run is written into a temporary folder beside its place and renamed when it is whole, so nothing
half-written stays. What a killed process left is cleared by the next run, and the logs in it are
kept. ``run.json`` holds only what the same inputs give again; what differs from run to run is in
``volatile.json``."""

from __future__ import annotations

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
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from ehbench.runs.versions import Versions
from ehbench.runtime.disk import DATA, impossible, read_bytes
from ehbench.runtime.interrupts import unbroken
from ehbench.vocabulary.errors import EhbenchError, InputError
from ehbench.vocabulary.messages import Message
from ehbench.vocabulary.text import shortened_path

PACKAGE = Path(__file__).resolve().parents[1]
SHIPPED = PACKAGE / "shipped"  # recipes and datasets in a wheel; a checkout has them beside it
_PART = re.compile(r"\.(?P<name>.+)\.(?P<pid>[1-9]\d*)\.part")
# what a disk says that takes no more
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
_LIBRARIES = (
    "numpy",
    "scipy",
    "pandas",
    "numba",
    "matplotlib",
    "pydantic",
    "mcap",
    "control",
)


def sha256(path: Path) -> str:
    """SHA-256 of a file, of a run folder's ``run.json``, or of all files of a ROS 2 bag."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        digest = hashlib.sha256()
        for part in sorted(item for item in path.iterdir() if item.is_file()):
            digest.update(part.name.encode() + b"\0" + read_bytes(part, DATA))
        return digest.hexdigest()
    target = path / "run.json" if path.is_dir() else path
    return hashlib.sha256(read_bytes(target, DATA)).hexdigest()


def shipped(name: str) -> Path:
    """Where the ``recipes`` or ``datasets`` that ship with the package are."""
    inside = SHIPPED / name
    return inside if inside.is_dir() else PACKAGE.parent / name


@lru_cache(maxsize=1)
def commit() -> str:
    """The commit of the checkout the package runs from (``+changes`` when tracked files differ), or
    ``none``.
    """
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
    """``value`` as JSON can hold it: arrays as lists, numpy numbers as Python's, NaN and infinities
    as null.
    """
    if isinstance(value, Message) and value.key:
        return {"key": value.key, "text": str(value), "fields": plain(value.fields)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [
            plain(item)
            for item in (sorted(value) if isinstance(value, (set, frozenset)) else value)
        ]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return value.as_posix()
    return value


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON with stable bytes."""
    path.write_text(
        json.dumps(plain(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        encoding="utf-8",
    )


def read_json(path: Path) -> Any:
    """Read a JSON file of a run folder.

    Raises:
        InputError: not there or not JSON.
    """
    try:
        return json.loads(read_bytes(path, DATA).decode("utf-8"), object_hook=_messages)
    except FileNotFoundError:
        raise InputError(
            "no such file", file=path, hint="is this a finished run folder of the right stage?"
        ) from None
    except (ValueError, RecursionError) as error:
        reason = str(error) or "nested too deeply"
        raise InputError(f"not JSON: {reason}", file=path) from None


def _messages(value: dict[str, Any]) -> Any:
    """A message of the catalogue where `plain` wrote one."""
    if value.keys() != {"key", "text", "fields"}:
        return value
    return Message(value["text"], value["key"], value["fields"])


@dataclass
class Run:
    """A run being written: put files into ``path``; ``facts`` become part of ``run.json``.

    ``left_over`` says what killed runs had left beside it.
    """

    path: Path
    final: Path
    record: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    left_over: tuple[str, ...] = ()

    def save(self) -> None:
        """Write ``run.json`` over the files that are there; figures are drawn from a folder that
        has one.
        """
        outputs = {
            path.relative_to(self.path).as_posix(): sha256(path)
            for path in sorted(self.path.rglob("*"))
            if path.is_file() and path != self.path / "run.json"
        }
        facts = plain({**self.record, **self.facts, "outputs": outputs})
        write_json(self.path / "run.json", {**facts, "checksum": checksum(facts)})


def checksum(facts: Mapping[str, Any]) -> str:
    """SHA-256 over the content of ``run.json`` without its checksum: shows an edit, proves no
    author.
    """
    text = json.dumps(facts, ensure_ascii=False, allow_nan=False, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def run_hash(recipe: str, inputs: Iterable[tuple[str, str]], versions: Versions) -> str:
    """Eight hex digits that name a run.

    Args:
        recipe: SHA-256 of its recipe.
        inputs: role and SHA-256 of each.
        versions: of its schema and methods.
    """
    digest = hashlib.sha256(f"{recipe}{versions}\n".encode())
    for role, content in inputs:
        digest.update(f"{role}:{content}\n".encode())
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
    """A ``Run`` whose folder becomes ``final`` when the block ends well; else nothing stays.

    A run that stands there is replaced, but only where it is as it was written.

    Raises:
        InputError: ``final`` holds anything but a run's own files as the run wrote them, or it
            cannot be written.
    """
    inputs, final = list(inputs), _place_of(final)
    _standing(final)
    left_over = clear_left(final.parent)
    scratch = final.parent / f".{final.name}.{os.getpid()}.part"
    shutil.rmtree(scratch, ignore_errors=True)
    # before there is a folder that a signal could leave behind: this takes a while
    run = Run(
        scratch,
        final,
        _record(stage, recipe, inputs, seeds or {}, versions or Versions.of(stage)),
        left_over=left_over,
    )
    began, hold = time.time(), None
    try:
        try:
            scratch.mkdir(parents=True)
        except (OSError, ValueError) as error:
            raise _no_place(final, error) from None
        hold = _held(scratch)
        yield run
        run.save()
        places = {"recipe": recipe.resolve(), "inputs": [path.resolve() for _, path in inputs]}
        write_json(scratch / "volatile.json", {**_volatile(began), **places})
        run.left_over += _put(scratch, final)
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise InputError(
            f"the run cannot be written: {error.strerror}; nothing of it stays",
            file=final,
            hint="make room, or choose another --out",
        ) from None
    except EhbenchError as error:  # of a file that is gone by the time the sentence is read
        if error.file is None or scratch not in Path(error.file).parents:
            raise
        raise type(error)(error.message, file=final, hint=error.hint) from None
    finally:
        with unbroken():
            shutil.rmtree(scratch, ignore_errors=True)
        if hold is not None:
            os.close(hold)


def _record(
    stage: str,
    recipe: Path,
    inputs: Sequence[tuple[str, Path]],
    seeds: Mapping[str, int],
    versions: Versions,
) -> dict[str, Any]:
    """What ``run.json`` says of a run whatever its stage: the same from the same inputs."""
    return {
        "stage": stage,
        "name": recipe.stem,
        "argv": ["ehbench", stage, recipe.name],
        "hash": hash_of(recipe, inputs, versions),
        "recipe": {"path": recipe.name, "sha256": sha256(recipe)},
        "inputs": [
            {"role": role, "path": _relative(path, recipe.parent), "sha256": sha256(path)}
            for role, path in inputs
        ],
        "seeds": dict(seeds),
        "versions": dict(_versions()),
        "schema": versions.schema,
        "methods": dict(versions.methods),
        "commit": commit(),
    }


@lru_cache(maxsize=1)
def _versions() -> Mapping[str, str]:
    """Versions of the package, of Python and of what results hang on; looked up once a process."""
    return {
        "ehbench": metadata.version("ehbench"),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


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


def _place_of(final: Path) -> Path:
    """Where a run's folder really lies: a link is followed, never replaced.

    Raises:
        InputError: the path leads nowhere: a loop of links, a name that no disk can hold.
    """
    try:
        place = final.resolve() if final.is_symlink() else final
        place.exists()
    except (OSError, RuntimeError, ValueError) as error:
        raise _no_place(final, error) from None
    return place


class Standing(NamedTuple):
    """What lies in the folder of a run that stands: the files that are as the run wrote them, and
    those of its files that have changed since.
    """

    own: tuple[Path, ...] = ()
    changed: tuple[Path, ...] = ()


def _standing(final: Path) -> Standing:
    """What stands where a run shall go.

    Raises:
        InputError: it is no folder, or holds anything that its run did not write.
    """
    for _ in range(100):
        try:
            return _surveyed(final)
        except FileNotFoundError:  # another process is putting its run there
            continue
        except (OSError, ValueError) as error:
            raise _no_place(final, error) from None
    raise InputError("another process keeps writing this run", file=final, hint="wait for it")


def _surveyed(final: Path) -> Standing:
    if not final.exists():
        return Standing()
    if not final.is_dir():
        raise InputError("is a file", file=final, hint="choose another --out")
    there = [path for path in sorted(final.rglob("*")) if path.is_symlink() or not path.is_dir()]
    if not there:
        return Standing()
    facts = final / "run.json"
    if not facts.is_file():
        for path in there:
            path.lstat()
        raise InputError(
            "exists and is no run folder; it is left as it is",
            file=final,
            hint="choose another --out",
        )
    own, changed = outputs_of(facts), []
    for path in there:
        name = path.relative_to(final).as_posix()
        if name in ("run.json", "volatile.json"):
            continue
        if name not in own or path.is_symlink() or not path.is_file():
            raise InputError(
                f"holds '{name}', which its run did not write; the folder is left as it is",
                file=final,
                hint="move that file away, or choose another --out",
            )
        if sha256(path) != own[name]:
            changed.append(path)
    return Standing(tuple(path for path in there if path not in changed), tuple(changed))


def _no_place(final: Path, error: Exception) -> InputError:
    reason = getattr(error, "strerror", None) or error
    return InputError(
        f"no run can be written here: {reason}",
        file=shortened_path(final),
        hint="choose another --out",
    )


def outputs_of(facts: Path) -> Mapping[str, Any]:
    """The files that a run wrote, by name, each with its SHA-256, from its ``run.json``.

    Raises:
        InputError: it is no ``run.json``.
    """
    read = read_json(facts)
    outputs = read.get("outputs") if isinstance(read, Mapping) else None
    if not isinstance(outputs, Mapping):
        raise InputError("names no outputs: it is no run's", file=facts)
    return outputs


def _put(scratch: Path, final: Path) -> tuple[str, ...]:
    """Move a whole run to its place; of two processes that make one run, the last stays. Files of
    the run before that someone changed are kept in ``salvaged``; a sentence for each.
    """
    before, message = final.with_name(f".{final.name}.{os.getpid()}.before"), []
    for _ in range(100):
        try:
            final.rename(before)
        except FileNotFoundError:
            pass
        else:
            try:
                message += _cleared(before, final)
            except InputError:  # someone put a file there while the run was made
                before.rename(final)
                raise
        try:
            scratch.rename(final)
            return tuple(message)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
    raise InputError("another process keeps writing this run", file=final, hint="wait for it")


def _cleared(before: Path, final: Path) -> list[str]:
    """Take away a run that another one replaces, which now lies at ``before``, but for what someone
    changed in it.
    """
    standing, message = _standing(before), []
    if standing.changed:
        retained = _free(final.parent / "salvaged" / final.name)
        for path in standing.changed:
            target = retained / path.relative_to(before)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
            name = path.relative_to(before).as_posix()
            message.append(f"'{name}' of the run before had been changed; it is kept as {target}")
    for path in standing.own:
        path.unlink()
    for folder in sorted((path for path in before.rglob("*") if path.is_dir()), reverse=True):
        folder.rmdir()
    before.rmdir()
    return message


# --- what killed processes left
# ------------------------------------------------------------------------------------------------


def clear_left(folder: Path) -> tuple[str, ...]:
    """Clear the temporary folders of processes that are gone, and keep the logs in them that hold
    samples, as ``salvaged/<name>_<pid>/…``; a sentence for each log kept.
    """
    messages = []
    for left in sorted(folder.glob(".*.part")):
        match = _PART.fullmatch(left.name)
        if match is None or not left.is_dir() or not _abandoned(left, int(match["pid"])):
            continue
        logs = [path for path in sorted(left.rglob("*.mcap")) if _holds_samples(path)]
        retained = _free(folder / "salvaged" / f"{match['name']}_{match['pid']}")
        for path in logs:
            target = retained / path.relative_to(left)
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.replace(path, target)
            except FileNotFoundError:  # another process was quicker
                continue
            messages.append(
                f"a run of '{match['name']}' was killed; what it had logged is in {target}"
            )
        shutil.rmtree(left, ignore_errors=True)
    return tuple(messages)


def _free(place: Path) -> Path:
    """A folder name that is not taken."""
    tries = (place if n == 1 else place.with_name(f"{place.name}_{n}") for n in itertools.count(1))
    return next(each for each in tries if not each.exists())


def _holds_samples(path: Path) -> bool:
    from ehbench.data import read

    try:
        return read(path, check=False).t.size > 0
    except EhbenchError:
        return False


def _abandoned(folder: Path, pid: int) -> bool:
    """Whether no process works in a temporary folder: neither one of that number nor, where
    processes of several containers share a disk, one that holds the folder.
    """
    if os.name != "posix":
        return False
    try:
        os.kill(pid, 0)
        return False
    except ProcessLookupError:
        pass
    except (OSError, OverflowError):
        return False
    hold = _held(folder)
    if hold is not None:
        os.close(hold)
    return hold is not None


def _held(folder: Path) -> int | None:
    """An open folder that this process alone holds until it is closed, or ends; None where another
    one holds it, or the system knows no such hold.
    """
    try:
        import fcntl

        hold = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(hold, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(hold)
        return None
    return hold


def _relative(path: Path, folder: Path) -> str:
    """A name for an input that is the same on every machine: its path from the recipe, or a run
    folder's own name.
    """
    if path.is_dir():
        return path.name
    return Path(os.path.relpath(path, folder)).as_posix()
