"""Files by others as tables of named columns, one file here a format.

A reader says what stands in a file and changes nothing: names, units and time bases are the file's
own; a map of columns makes channels of them (`ehbench.data.channels`). To add a format, write one
file here with a function ``read(path, dialect) -> Source`` and a row in ``READERS``."""

import codecs
import re
import stat
import warnings
import zipfile
from dataclasses import dataclass, replace
from fnmatch import filter as filter_names
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ehbench.data.readers.table import (
    Dialect,
    Source,
    SourceColumn,
    SourceTable,
    pivoted,
    with_clock,
)
from ehbench.data.readers.transfer import received, send
from ehbench.runtime.confined import Bounds, Ended, confined
from ehbench.runtime.memory import SHARE, available
from ehbench.vocabulary import EhbenchError, LogError, listed, message, setting
from ehbench.vocabulary.text import shortened_path


class Reader(NamedTuple):
    """A format: what it is called, how its files end and begin, the module here that reads it and
    the package that this needs beside those of every installation. All zip archives begin alike:
    the format of one is that whose ``member`` it holds, a pattern of names.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    package: str = ""
    magic: tuple[bytes, ...] = ()
    member: str = ""


ZIP, GZIP = b"PK\x03\x04", b"\x1f\x8b"
_BINARY = re.compile(rb"[\0-\x08\x0e-\x1f]")  # what no text holds, but for that of UTF-16
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
READERS = (
    Reader("text", (".csv", ".txt", ".tsv", ".dat", ".asc", ".lvm", ".log"), "delimited"),
    Reader("JSON", (".json", ".jsonl", ".ndjson"), "json_records", "", (b'{"', b"[{")),
    Reader("MDF", (".mf4", ".mdf", ".dat"), "mdf", "asammdf", (b"MDF     ", b"UnFinMF ")),
    Reader("TDMS", (".tdms",), "tdms", "nptdms", (b"TDSm",)),
    Reader("MAT", (".mat",), "mat", "", (b"MATLAB 5.0 MAT-file",)),
    Reader("MAT v7.3", (".mat",), "hdf5", "h5py", (b"MATLAB 7.3 MAT-file",)),
    Reader("HDF5", (".h5", ".hdf5", ".hdf", ".he5"), "hdf5", "h5py", (b"\x89HDF\r\n\x1a\n",)),
    Reader("Parquet", (".parquet", ".pq"), "parquet", "pyarrow", (b"PAR1",)),
    Reader("NumPy", (".npz", ".npy"), "npz", "", (ZIP, b"\x93NUMPY"), "*.npy"),
    Reader("Excel", (".xlsx", ".xlsm"), "excel", "openpyxl", (ZIP,), "[[]Content_Types].xml"),
    Reader(
        "ROS 2 bag", (".mcap", ".db3"), "ros", "rosbags", (b"\x89MCAP0\r\n", b"SQLite format 3")
    ),
)
# how files begin that others must make recordings of first
_OTHERS = (
    (
        re.compile(
            rb"date [^\n]*\nbase +(hex|dec)|;\$FILEVERSION=|LOGG.\0\0\0|\(\d+\.\d+\) \w+ \w+#"
        ),
        message("data.bus_frames"),
    ),
    (re.compile(rb"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"), message("data.old_or_locked_workbook")),
)


@dataclass(frozen=True)
class ReaderSettings:
    """What reading a file by a library may take; a library works in a child process."""

    memory: float = setting(2e9, "B", "memory for a file of any size", "libraries and small files")
    swells: float = setting(
        100.0, "", "bytes of memory for each byte of the file", "packed recordings take up to 50"
    )
    seconds: float = setting(20.0, "s", "computing for a file of any size", "100 times the usual")
    slowness: float = setting(
        2e-5, "s/B", "computing for each byte of the file", "a packed workbook takes 5e-6"
    )
    patience: float = setting(
        10.0, "", "times the computing after which waiting ends", "a machine with other work"
    )


SETTINGS = ReaderSettings()


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
                head = file.read(512)
    except (FileNotFoundError, NotADirectoryError):
        raise LogError(message("data.no_file"), file=path) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        text = message("data.unreadable", reason=reason)
        raise LogError(text, file=shortened_path(path)) from None
    for begin, text in _OTHERS:
        if begin.match(head.removeprefix(codecs.BOM_UTF8)):
            raise LogError(text, file=path)
    name = path.name.lower().removesuffix(".gz")
    packed = b"".join(head.removeprefix(codecs.BOM_UTF8).split())  # JSON may have blanks anywhere
    begins = [x for x in READERS if head.startswith(x.magic) or packed.startswith(x.magic)]
    if head.startswith(ZIP):
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.namelist()
        except Exception as error:  # a damaged archive raises all kinds
            reason = str(error) or type(error).__name__
            text = message("data.unreadable_as", format="a zip archive", reason=reason)
            raise LogError(text, file=path) from None
        begins = [reader for reader in begins if filter_names(members, reader.member)]
        if not begins:
            text = message("data.unknown_archive", members=listed(members, 3))
            raise LogError(text, file=path)
    ends = [reader for reader in READERS if name.endswith(reader.suffixes)]
    if head.startswith(GZIP) and ends and not {*ends} & {*READERS[:2]}:
        raise LogError(message("data.packed", format=ends[0].name, path=path.name), file=path)
    both = [reader for reader in begins if reader in ends]
    is_text = head.startswith(_UTF_16) or not _BINARY.search(head)
    texts = [reader for reader in READERS[:2] if reader in ends] or READERS[:1]
    texts = texts if ends and is_text else ()  # whatever they are called
    for reader in (*both, *begins, *texts, *ends):
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        source = (_confined if reader.magic else _read)(reader, path, dialect or Dialect())
    tables = (part for table in source.tables for part in pivoted(with_clock(table)))
    source = replace(source, tables=tuple(tables))
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


def _confined(reader: Reader, path: Path, dialect: Dialect) -> Source:
    """What a reader makes of a file, in a child process.

    Raises:
        LogError: what reads it refuses it, or comes to no end.
    """
    import_module(f"{__name__}.{reader.module}")  # here, so that the next file finds it

    def work(pipe: BinaryIO) -> None:
        try:
            result = _read(reader, whole, dialect)
        except EhbenchError as error:
            result = error
        send(pipe, result)

    whole = path.absolute()  # the child works in another folder
    files = path.rglob("*") if path.is_dir() else (path,)
    size = sum(file.lstat().st_size for file in files)
    memory = min(SETTINGS.memory + SETTINGS.swells * size, SHARE * available())
    seconds = SETTINGS.seconds + SETTINGS.slowness * size
    try:
        bounds = Bounds(memory, seconds, SETTINGS.patience * seconds)
        return received(confined(work, bounds, [whole]), path)
    except Ended as end:
        key = "data.reading_late" if end.late else "data.reading_crashed"
        fields = {"format": reader.name, "package": reader.package or "its library"}
        text = message(key, seconds=seconds, signal=end.name, **fields)
        raise LogError(text, file=path) from None


def _read(reader: Reader, path: Path, dialect: Dialect) -> Source:
    """What a reader makes of a file; whatever it raises is one sentence."""
    try:
        return import_module(f"{__name__}.{reader.module}").read(path, dialect)
    except EhbenchError as error:
        if error.file is not None:
            raise
        raise LogError(error.message, file=path, hint=error.hint) from None
    except RecursionError:
        reason = "it is too deep"
    except MemoryError:
        reason = "it is too large"
    except KeyError as error:
        reason = message("data.lacks", what=error)
    except Exception as error:  # the libraries raise all kinds on a damaged file
        reason = str(error) or type(error).__name__
    text = message("data.unreadable_as", format=reader.name, reason=reason)
    raise LogError(text, file=path)
