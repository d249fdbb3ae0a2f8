"""Files by others as tables of named columns, one file here a format.

A reader says what stands in a file and changes nothing: names, units and time bases are the file's
own; a map of columns makes channels of them (`ehbench.data.channels`). To add a format, write one
file here with a function ``read(path, dialect) -> Source`` and a row in ``READERS``."""

from __future__ import annotations

import gc
import logging
import stat
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable
from ehbench.vocabulary.errors import EhbenchError, LogError
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.text import shortened_path

__all__ = [
    "SourceColumn",
    "Dialect",
    "READERS",
    "Reader",
    "Source",
    "SourceTable",
    "open_source",
    "reader_of",
    "suffixes",
]


class Reader(NamedTuple):
    """A format: what it is called, how its files end and begin, the module here that reads it and
    the package that this needs beside those of every installation. Files that begin as other
    formats do too, as all archives, are ``packed``: their ending has to fit.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    package: str = ""
    magic: tuple[bytes, ...] = ()
    packed: bool = False


READERS = (
    Reader("text", (".csv", ".txt", ".tsv", ".dat", ".asc", ".lvm"), "delimited"),
    Reader("MDF", (".mf4", ".mdf", ".dat"), "mdf", "asammdf", (b"MDF     ", b"UnFinMF ")),
    Reader("TDMS", (".tdms",), "tdms", "nptdms", (b"TDSm",)),
    Reader("MAT", (".mat",), "mat", "", (b"MATLAB 5.0 MAT-file",)),
    Reader("MAT v7.3", (".mat",), "hdf5", "h5py", (b"MATLAB 7.3 MAT-file",)),
    Reader("HDF5", (".h5", ".hdf5", ".hdf", ".he5"), "hdf5", "h5py", (b"\x89HDF\r\n\x1a\n",)),
    Reader("Parquet", (".parquet", ".pq"), "parquet", "pyarrow", (b"PAR1",)),
    Reader("Excel", (".xlsx", ".xlsm"), "excel", "openpyxl", (b"PK\x03\x04",), True),
    Reader(
        "ROS 2 bag", (".mcap", ".db3"), "ros", "rosbags", (b"\x89MCAP0\r\n", b"SQLite format 3")
    ),
)
_HEAD = 24  # bytes that tell a format


def suffixes() -> tuple[str, ...]:
    """All endings of files that are read, each once."""
    return tuple(dict.fromkeys(suffix for reader in READERS for suffix in reader.suffixes))


def reader_of(path: Path) -> Reader:
    """The reader of a file, by its first bytes, else by its ending; that of a ROS 2 bag for its
    folder.

    Raises:
        LogError: no such file, or of no format that is read.
    """
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return next(reader for reader in READERS if reader.module == "ros")
        raise LogError(message("data.is_folder"), file=path)
    try:
        head = b""
        if stat.S_ISREG(path.stat().st_mode):  # a pipe would keep the process waiting
            with path.open("rb") as file:
                head = file.read(_HEAD)
    except (FileNotFoundError, NotADirectoryError):
        raise LogError(message("data.no_file"), file=path) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        text = message("data.unreadable", reason=reason)
        raise LogError(text, file=shortened_path(path)) from None
    name = path.name.lower().removesuffix(".gz")
    begins = [reader for reader in READERS if head.startswith(reader.magic)]
    ends = [reader for reader in READERS if name.endswith(reader.suffixes)]
    both = [reader for reader in begins if reader in ends]
    for reader in (*both, *(reader for reader in begins if not reader.packed), *ends):
        return reader
    kind, known = path.suffix or path.name, ", ".join((".toml", *suffixes()))
    raise LogError(message("data.unknown_format", kind=kind, known=known), file=path)


def open_source(path: Path, dialect: Dialect | None = None) -> Source:
    """What stands in a file.

    Raises:
        LogError: no format that is read, damaged, too large to hold, empty; or what reads it is
            not installed.
    """
    reader = reader_of(path)
    if reader.package:
        try:
            import_module(reader.package)
        except ImportError:
            text = message("data.reader_missing", name=reader.name, package=reader.package)
            raise LogError(text, file=path) from None
    read: Callable[[Path, Dialect], Source] = import_module(f"{__name__}.{reader.module}").read
    with _quiet():
        source = _read(reader, read, path, dialect or Dialect())
    requested = dialect.table if dialect else None
    if requested is not None and len(source.tables) > 0 and source.tables[0].name:
        there = ", ".join(f"'{table.name}'" for table in source.tables)
        retained = tuple(table for table in source.tables if table.name == requested)
        if not retained:
            text = message("data.no_table", table=requested, there=there)
            raise LogError(text, file=path)
        source = replace(source, tables=retained)
    if not any(table.size for table in source.tables):
        hint = "; ".join(source.losses[:4]) or None
        raise LogError(message("data.no_column_of_numbers"), file=path, hint=hint)
    return source


def _read(
    reader: Reader, read: Callable[[Path, Dialect], Source], path: Path, dialect: Dialect
) -> Source:
    """What a reader makes of a file; whatever it raises is one sentence."""
    was_on = gc.isenabled()
    gc.disable()  # so that what a library leaves of a broken file stays among the youngest
    try:
        return read(path, dialect)
    except EhbenchError as error:
        if error.file is not None:
            raise
        raise LogError(error.message, file=path, hint=error.hint) from None
    except RecursionError:
        reason = "it is too deep"
    except MemoryError:
        reason = "it is too large"
    except Exception as error:  # the libraries raise all kinds on a damaged file
        reason = str(error) or type(error).__name__
    finally:
        if was_on:
            gc.enable()
    gc.collect(0)  # what they leave of it complains as it goes
    text = message("data.unreadable_as", format=reader.name, reason=reason)
    raise LogError(text, file=path)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what a library says of a broken file beside its errors."""
    level = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        sys.unraisablehook = hook
        logging.disable(level)
