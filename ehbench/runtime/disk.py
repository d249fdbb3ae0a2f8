"""Files read whole: only plain ones, and only as large as can be held; files written whole or not
at all."""

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from zlib import crc32

from ehbench.vocabulary import InputError
from ehbench.vocabulary.text import shortened_path

TEXT = 16 * 2**20  # [bytes] of a recipe, rig or JSON file
DATA = 4 * 2**30  # [bytes] of a log or table


def read_bytes(path: Path, maximum: int = TEXT, error: type[InputError] = InputError) -> bytes:
    """The bytes of a plain file of at most ``maximum`` bytes.

    Raises:
        FileNotFoundError: there is none.
        InputError: of the type ``error``: it is a folder, a pipe or a device, too large, not
            readable, or its name is none that a disk can hold."""
    try:
        # a pipe without a writer would keep the process waiting
        flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(path, os.O_RDONLY | flags)
        with open(descriptor, "rb") as file:
            result = os.fstat(descriptor)
            if stat.S_ISDIR(result.st_mode):
                raise error("is a folder", file=shortened_path(path), hint="name a file in it")
            if not stat.S_ISREG(result.st_mode):
                raise error("is no plain file but a pipe or a device", file=shortened_path(path))
            if result.st_size > maximum:
                size, limit = (f"{item / 1e6:.4g} MB" for item in (result.st_size, maximum))
                text = f"is {size} large, more than the {limit} that are read"
                raise error(text, file=shortened_path(path))
            return file.read()
    except FileNotFoundError:
        raise
    except NotADirectoryError:
        raise FileNotFoundError from None
    except (OSError, ValueError) as reason:
        words = getattr(reason, "strerror", None) or reason
        raise error(f"cannot be read: {words}", file=shortened_path(path)) from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path``. What the block writes there takes the place of ``path``
    when the block ends well; otherwise an earlier file stays as it was. A link is followed, a
    device is written to."""
    path = path.resolve()
    if path.exists() and not path.is_file():
        yield path
        return
    part = path.with_name(f".{os.getpid()}_{crc32(os.fsencode(path.name)):08x}.part")
    try:
        part.unlink(missing_ok=True)
        yield part
        os.replace(part, path)
    except OSError as error:  # names what the user asked for
        error.filename = str(path) if error.filename in (None, str(part)) else error.filename
        raise
    finally:
        with suppress(OSError):  # a disk that cannot be written to
            part.unlink(missing_ok=True)


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """A temporary folder inside a new or empty one. What the block writes moves into ``folder``
    when the block ends well; otherwise nothing stays."""
    is_new = not folder.exists()
    scratch = folder / f".{os.getpid()}.part"
    scratch.mkdir(parents=True)
    try:
        yield scratch
        for item in sorted(scratch.iterdir()):
            item.rename(folder / item.name)
    except BaseException:
        shutil.rmtree(folder if is_new else scratch, ignore_errors=True)
        raise
    scratch.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write a text whole or not at all, in UTF-8; bytes of file names that are none come out as
    they were."""
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8", "surrogateescape"))


def impossible(path: Path) -> str:
    """Why a path can be that of no file, or ''."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return ""
    except (OSError, ValueError) as error:
        return str(getattr(error, "strerror", None) or error)
    return ""
