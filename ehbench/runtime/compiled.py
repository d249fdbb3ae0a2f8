"""How the hot functions are compiled: one decorator for the laws, the plant and the integrator, one
for loops that allocate, one cache for their code. It uses numba through its public interface.
"""

import atexit
import gc
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, update_wrapper
from itertools import repeat
from pathlib import Path
from secrets import randbits
from threading import Lock
from typing import Any

import numba
import numpy as np
from numba.extending import overload, typeof_impl

from ehbench.runtime.interrupts import unbroken
from ehbench.runtime.sources import sources

PACKAGE = Path(__file__).resolve().parents[1]
_SETTINGS: Any = numba.config
_SETTING = Lock()
_MARKS = (
    b"@kernel",
    b"@part_kernel",
    b"@allocating_kernel",
    b"choice(",
    b"generic(",
    b"@inlined",
)


def _cache_folder() -> Path:
    """A cache for these very sources: numba looks only at a function's own file, and would keep
    what it inlined of others.

    It lies beside the package, or where that cannot be written, where numba was told, or at the
    user's home; else it is gone with this process.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources(PACKAGE, ".py"):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + content)
    home = os.path.expanduser("~/.cache/ehbench")
    for place in filter(os.path.isabs, (PACKAGE / "__pycache__", _SETTINGS.CACHE_DIR, home)):
        with suppress(OSError):
            os.makedirs(place, exist_ok=True)
            if os.access(place, os.W_OK):
                return Path(place, f"kernels_{digest.hexdigest()[:12]}")
    folder = tempfile.mkdtemp(prefix="ehbench_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


FOLDER = _cache_folder()
KEPT = FOLDER.name.startswith("kernels_")  # for the next process


def is_cold() -> bool:
    """Whether nothing is compiled yet, so that a first run takes a minute longer."""
    return not (_SETTINGS.DISABLE_JIT or any(FOLDER.rglob("*.nbc")))


# Without reference counting (_nrt) a kernel cannot allocate, and passing rows and slices of arrays
# costs nothing: a trial takes a twelfth of the time. The caller owns all arrays.
OPTIONS: Any = {"nogil": True, "error_model": "numpy", "_nrt": False}
# numba hands forceinline down from callers that have it: the derivatives would stand ten times in
# one loop, which takes half as long again to compile and is no faster
_APART: Any = {**OPTIONS, "forceinline": False}
_INLINED: Any = {**OPTIONS, "forceinline": True}
_WITHIN: Any = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}  # called by kernels only


class Kernel:
    """A function that is compiled when first called.

    Other kernels call it as it is. What takes arguments from Python apart, for a plant more code
    than most kernels are, it gets only when Python calls it, as a second function.

    Args:
        function: in the part of Python that numba knows.
        options: of numba.
        kept: False where no cache can find it again, as of what is made at import.
    """

    def __init__(self, function: Callable, options: Mapping[str, Any], kept: bool = True) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._folder = str(FOLDER) if kept else ""
        self._called = False

    def _dispatcher(self, folder: str, **more: Any) -> Any:
        """numba's dispatcher, its code cached in ``folder``. numba reads where from its global
        settings only, when it wraps a function; they are as before then.
        """
        with _SETTING:
            before, _SETTINGS.CACHE_DIR = _SETTINGS.CACHE_DIR, folder
            try:
                options = {**self._options, **more}
                dispatcher: Any = numba.njit(cache=bool(folder), **options)(self._function)
            finally:
                _SETTINGS.CACHE_DIR = before
        # numba (0.61 to 0.68) counts files from 1: of two processes that compile at once for
        # different types, one could load the other's code
        files: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        name = getattr(files, "_data_name_pattern", "")
        if "{number" in name:
            files._data_name = lambda _: name.format(number=randbits(48))
        return dispatcher

    @cached_property
    def inner(self) -> Any:
        """The function that kernels call. Only the compiler needs it."""
        return self._dispatcher(self._folder, **_WITHIN)

    @cached_property
    def outer(self) -> Any:
        """The function that Python calls."""
        return self._dispatcher(self._folder and f"{self._folder}/outer")

    def compile(self, *like: Any) -> None:
        """Compile it for calls by kernels with arguments of the types of ``like``."""
        _entry_point(self.inner, like)

    def __call__(self, *arguments: Any) -> Any:
        """Call it from Python."""
        if not self._called:
            _entry_point(self.outer, arguments)
            self._called = True
        return self.outer(*arguments)


@typeof_impl.register(Kernel)
def _type_of_kernel(value: Kernel, _: Any) -> Any:
    """The type by which numba knows what a kernel calls."""
    return numba.typeof(value.inner)


def _entry_point(dispatcher: Any, like: Sequence[Any]) -> Callable:
    """A function compiled, or loaded from the cache, for arguments of the types of ``like``. No
    signal interrupts the compiler.
    """
    types = tuple(numba.typeof(argument) for argument in like)
    # the compiler creates millions of objects that stay: to look through them again and again
    # takes a tenth of its time
    collects = gc.isenabled()
    gc.disable()
    try:
        with unbroken():
            return dispatcher.compile(types)
    finally:
        if collects:
            gc.enable()


def _compiler(options: Mapping[str, Any], kept: bool = True) -> Callable[[Callable], Any]:
    """A decorator that makes a `Kernel`, or leaves the function where numba is switched off."""

    def compiled(function: Callable) -> Any:
        return function if _SETTINGS.DISABLE_JIT else Kernel(function, options, kept)

    return compiled


kernel = _compiler(_APART)

# for the small kernels of which a large one is made: they go into its code, without a call
part_kernel = _compiler(_INLINED)

allocating_kernel = _compiler({"nogil": True})

# for what is made at import, which no cache can find again: it goes into the code of its callers
inlined = _compiler(_INLINED, kept=False)

# of overloads, numba's word for a choice by types: as a kernel, and as a part of one
WITHIN: Any = {**OPTIONS, **_WITHIN}
_CHOSEN: Any = {**_INLINED, **_WITHIN}


def bound(function: Any, *like: Any) -> Callable:
    """A kernel for arguments of the types of ``like``, which are not looked at again with each
    call: that takes longer than a tick. It must be given no others.
    """
    if not hasattr(function, "outer"):  # nothing is compiled
        return function
    return _entry_point(function.outer, like)


def choice(name: str, laws: Sequence[Callable], arguments: str, by: str = "law") -> Any:
    """A function ``name(law, …)`` that calls one of several kernels by its number ``law``.

    In a kernel the choice is a chain of comparisons over calls that the compiler may inline, and
    its machine code goes to the cache; tuples of functions do neither. In plain Python it is the
    same chain.

    Args:
        laws: the kernels, all of the same arguments and the same type of result.
        arguments: their arguments as a signature has them, such as ``"row, v"``.
        by: where these have the number instead, such as ``"row.friction"``: ``name(row, v)``.
    """
    space: dict[str, Any] = {f"law_{i}": law for i, law in enumerate(laws)}
    last, given = len(laws) - 1, f"law, {arguments}" if by == "law" else arguments
    chain = "".join(f"    if {by} == {i}: return law_{i}({arguments})\n" for i in range(last))
    text = f"({given}):\n{chain}    return law_{last}({arguments})\n"
    exec(f"def {name}{text}def typed({given}): return chosen\ndef chosen{text}", space)
    overload(space[name], jit_options=_CHOSEN)(space["typed"])
    return space[name]


def generic(name: str, arguments: str) -> Any:
    """A function of a plant that each type of plant has a kernel of its own for.

    Kernels call it; which of its kernels that is, is settled by the type of the argument ``plant``
    when they are compiled. ``function.of(Plant)`` decorates the kernel of that type.

    Args:
        name: of the function.
        arguments: as a signature has them, one of them ``plant``.
    """
    space: dict[str, Any] = {"kernels": {}}
    exec(f"def {name}({arguments}): return kernels[type(plant)]({arguments})\n", space)
    call = space[name]

    def of(plant: type) -> Callable[[Callable], Callable]:
        def register(function: Callable) -> Callable:
            space["kernels"][plant] = function
            inner: dict[str, Any] = {"function": function, "wanted": plant}
            exec(
                f"def chosen({arguments}): return function({arguments})\n"
                f"def typed({arguments}):\n"
                "    if getattr(plant, 'instance_class', None) is wanted: return chosen\n",
                inner,
            )
            overload(call, jit_options=_CHOSEN)(inner["typed"])
            return function

        return register

    call.of = of
    return call


_field, _column = np.void.__getitem__, np.ndarray.__getitem__


class Row(np.record):
    """A row of a table. numpy's own looks every name up in Python, also those that numba asks each
    argument of a kernel for; here only names of fields come so far.
    """

    __getattribute__ = np.void.__getattribute__

    def __getattr__(self, name: str) -> Any:
        """A field."""
        try:
            return _field(self, name)
        except (KeyError, ValueError):
            raise AttributeError(f"no field '{name}'") from None


class Table(np.recarray):
    """A table whose rows are such; `table` makes one."""

    __getattribute__ = np.ndarray.__getattribute__

    # pyrefly: ignore[bad-override-param-name]
    def __array_finalize__(self, like: Any) -> None:
        """Nothing: numpy's own would make its rows those of numpy."""

    def __getitem__(self, index: Any) -> Any:
        """A column by its name: an array, or a table of the layout that each row has there; rows
        by anything else.
        """
        result = _column(self, index)
        if isinstance(index, str) and result.dtype.names is None:
            return result.view(np.ndarray)
        return result

    def __getattr__(self, name: str) -> Any:
        """A column."""
        if name not in (self.dtype.fields or ()):
            raise AttributeError(f"no column '{name}'")
        return self[name]


Column = tuple[str, Any] | tuple[str, Any, tuple[int, ...]]


def record(*columns: Column) -> np.dtype:
    """The layout of one row of a table: a field's name, its type (``f8``, ``i8`` or another layout)
    and, of an array, its shape.
    """
    return np.dtype((Row, list(columns)), align=True)


def table(rows: int, layout: np.dtype) -> np.recarray:
    """A table of rows of a layout, all zero; ``table[i].field`` reads in kernels and in Python."""
    return np.zeros(rows, layout).view(Table)


def table_of(rows: Sequence[Mapping[str, Any]], layout: np.dtype) -> np.recarray:
    """A table of rows given by the names of their fields; what a row does not name is zero."""
    names = layout.names or ()
    values = [tuple(map(row.get, names, repeat(0))) for row in rows]
    return np.array(values, layout).view(Table)
