"""What files this process may open, by Linux's Landlock (`man 7 landlock`)."""

import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

# numbers of the system calls, of a rule for paths, and of a process without new rights
_CREATE, _ADD, _RESTRICT, _BENEATH, _NO_NEW_RIGHTS = 444, 445, 446, 1, 38
_READ_FILE, _READ_FOLDER, _EVERYTHING = 1 << 2, 1 << 3, (1 << 13) - 1


class _Rule(ctypes.Structure):
    _pack_ = 1
    _fields_ = [("allowed", ctypes.c_uint64), ("folder", ctypes.c_int32)]


def system_paths() -> list[Path]:
    """What Python and its libraries read while they work: modules, time zones, the machine."""
    system = ("/usr", "/lib", "/lib64", "/proc", "/sys", "/etc/localtime", "/dev/null")
    package = Path(__file__).parents[1]  # an editable install is on no path
    python = (sys.prefix, sys.base_prefix, *sys.path)
    return [package, *(Path(name) for name in (*system, *python) if name)]


def restrict(readable: Iterable[Path], writable: Path) -> bool:
    """Let this process open nothing but these files, and what lies in these folders, for good.

    Args:
        readable: for reading.
        writable: a folder for everything.

    Returns:
        Whether the system knows how; else nothing has changed."""
    system = ctypes.CDLL(None, use_errno=True)
    handled = ctypes.c_uint64(_EVERYTHING)
    rules = system.syscall(_CREATE, ctypes.byref(handled), ctypes.sizeof(handled), 0)
    if rules < 0:
        return False
    for path in (writable, *readable):
        try:
            place = os.open(path, os.O_PATH)
        except OSError:  # not on this machine
            continue
        rights = _READ_FOLDER | _READ_FILE if path.is_dir() else _READ_FILE
        rule = _Rule(_EVERYTHING if path == writable else rights, place)
        system.syscall(_ADD, rules, _BENEATH, ctypes.byref(rule), 0)
        os.close(place)
    system.prctl(_NO_NEW_RIGHTS, 1, 0, 0, 0)
    return system.syscall(_RESTRICT, rules, 0) == 0
