"""How the hot functions are compiled: one decorator for the laws, the plant and the integrator, one
for loops that allocate, one cache for their code.
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, update_wrapper
from itertools import repeat
from pathlib import Path
from secrets import randbits
from threading import Lock
from typing import Any

import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core import config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime.nrt import rtsys
from numba.extending import overload

from ehbench.runtime.interrupts import unbroken
from ehbench.runtime.sources import sources

PACKAGE = Path(__file__).resolve().parents[1]
_SETTINGS: Any = config
_SETTING = Lock()
_MARKS = (
    *(b"njit", b"@kernel", b"@part_kernel", b"@allocating_kernel", b"choice(", b"Generic("),
    *(b"intrinsic(", b"LaneKernel"),
)


def _cache_folder() -> Path:
    """A cache for these very sources: numba looks only at a function's own file, and would keep
    what it inlined of others.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources(PACKAGE, ".py"):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + content)
    return PACKAGE / "__pycache__" / f"kernels_{digest.hexdigest()[:12]}"


_FOLDER = _cache_folder()


def is_cold() -> bool:
    """Whether nothing is compiled yet, so that a first run takes a minute longer."""
    return not (_SETTINGS.DISABLE_JIT or any(_FOLDER.rglob("*.nbc")))


class _LinkedLibrary(JITCodeLibrary):
    """Code that only goes into that of its callers: numba would optimise it, and make machine code
    of it and of all that it calls, for every kernel on the way up. Here that is left to the kernel
    on top.
    """

    def _optimize_final_module(self) -> None:
        """Nothing: the caller's does it."""

    def _finalize_final_module(self) -> None:
        """Keep the code for callers; the engine gets the environments alone, which numba sets."""
        shared, names = self._final_module, []
        for function in shared.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = "linkonce_odr"
        for variable in shared.global_variables:
            if variable.name.startswith("_ZN08NumbaEnv"):
                names.append(f'@"{variable.name}" = common global i64 0\n')
        self._shared_module = shared
        self._final_module = llvm.parse_assembly("".join(names))
        self._final_module.name = shared.name
        super()._finalize_final_module()


class _WholeLibrary(JITCodeLibrary):
    """Code that Python calls, with all that it calls in turn, which nothing else will ever call: so
    the optimiser may put a function into its only caller, and pass no argument that is not used. A
    plant or a controller has a hundred of them.
    """

    def _optimize_final_module(self) -> None:
        """numba's own, with no function to be seen from outside but those that it compiled here."""
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.linkonce_odr:
                function.linkage = "internal"
        super()._optimize_final_module()


class _Compiler(Compiler):
    """numba's compiler, into a library of ours, while nothing collects garbage: it makes millions
    of objects that stay, and to look through them again and again takes a tenth of the time.
    """

    library: type[JITCodeLibrary] = _WholeLibrary

    def compile_extra(self, func: Callable) -> Any:
        """Compile a function and, on the way, all that it calls."""
        with unbroken(), _uncollected():
            return super().compile_extra(func)

    def define_pipelines(self) -> list[Any]:
        """numba's own, into a library of ours."""
        state = self.state
        if state.library is None:
            name = state.func_id.func_qualname
            state.library = self.library(state.targetctx.codegen(), name)
            state.library.enable_object_caching()
        return super().define_pipelines()


class _LinkedCompiler(_Compiler):
    """The same for what only kernels call."""

    library = _LinkedLibrary


@contextmanager
def _uncollected() -> Iterator[None]:
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


# Without numba's reference counting a kernel cannot allocate (the compiler refuses it), and passing
# rows and slices of arrays costs nothing: 1.4 times as fast a plant. Arguments are the caller's.
OPTIONS: Any = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "pipeline_class": _Compiler,
}
# numba hands forceinline down from callers that have it: the derivatives would stand ten times in
# one loop, which takes half as long again to compile and is no faster
_APART: Any = {**OPTIONS, "forceinline": False}
_INLINED: Any = {**OPTIONS, "forceinline": True}
_WITHIN: Any = {  # called by kernels only
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": _LinkedCompiler,
}


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
        self._folder = str(_FOLDER) if kept else ""
        self._outer: Any = None
        self._found = False

    @cached_property
    def _inner(self) -> Any:
        """The function that kernels call: wanted by the compiler alone, so made for it."""
        return self._dispatcher(self._folder, **_WITHIN)

    def _dispatcher(self, folder: str, **more: Any) -> Any:
        """numba's own, its code kept in ``folder``. numba reads where from its global settings
        only, when it wraps a function; they are as before then.
        """
        with _SETTING:
            before, _SETTINGS.CACHE_DIR = _SETTINGS.CACHE_DIR, folder
            try:
                built: Any = numba.njit(cache=bool(folder), **{**self._options, **more})(
                    self._function
                )
            finally:
                _SETTINGS.CACHE_DIR = before
        if folder:
            _name_apart(built._cache._cache_file)
            _load_alone(built._cache)
        return built

    @property
    def _numba_type_(self) -> Any:
        """By which numba knows what a kernel calls."""
        return self._inner._numba_type_

    @property
    def outer(self) -> Any:
        """The function that Python calls."""
        if self._outer is None:
            self._outer = self._dispatcher(self._folder and f"{self._folder}/outer")
        return self._outer

    def compile(self, *like: Any) -> None:
        """Compile it for calls by kernels with arguments of the types of ``like``."""
        self._inner.compile(tuple(numba.typeof(each) for each in like))

    @property
    def is_kept(self) -> bool:
        """Whether a cache has code of it that Python can call; asked until it has."""
        if not self._found:
            files = self.outer._cache._cache_file
            self._found = Path(files._index_path).exists()
        return self._found

    @property
    def made_of(self) -> tuple[Callable, Mapping[str, Any]]:
        """(the function, options of numba)."""
        return self._function, self._options

    def __call__(self, *arguments: Any) -> Any:
        """Call it from Python."""
        return (self._outer or self.outer)(*arguments)


def _name_apart(files: Any) -> None:
    """Let each file of a cache have a name of its own. numba counts from 1, and of two processes
    that compile at once for different types, one would call the other's code.
    """
    name = files._data_name_pattern
    files._data_name = lambda _: name.format(number=randbits(48))


def _load_alone(cache: Any) -> None:
    """Let a cache load code without all that numba can compile: it makes that known before, a third
    of a second in every process, and code that is compiled needs its memory management alone.
    """

    def load(signature: Any, target: Any) -> Any:
        with unbroken(), cache._guard_against_spurious_io_errors():
            rtsys.initialize(target)
            return cache._load_overload(signature, target)

    cache.load_overload = load


def _compiler(options: Mapping[str, Any], kept: bool = True) -> Callable[[Callable], Any]:
    """A decorator that makes a `Kernel`, or leaves the function where numba is switched off."""

    def compiled(function: Callable) -> Any:
        return function if _SETTINGS.DISABLE_JIT else Kernel(function, options, kept)

    return compiled


kernel = _compiler(_APART)

# for the small kernels of which a large one is made: they go into its code, without a call
part_kernel = _compiler(_INLINED)

allocating_kernel = _compiler({"nogil": True, "pipeline_class": _Compiler})

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
    types = tuple(numba.typeof(argument) for argument in like)
    function.outer.compile(types)
    return function.outer.get_overload(types)


def choice(name: str, laws: Sequence[Callable], arguments: str) -> Callable:
    """A function ``name(law, …)`` that calls one of several kernels by its number ``law``.

    In a kernel the choice is a chain of comparisons over calls that the compiler may inline, and
    its machine code goes to the cache; tuples of functions do neither. In plain Python it is the
    same chain.

    Args:
        laws: the kernels, all of the same arguments and the same type of result.
        arguments: their arguments as a signature has them, such as ``"row, v"``.
    """
    space: dict[str, Any] = {f"law_{i}": law for i, law in enumerate(laws)}
    last = len(laws) - 1
    chain = "".join(f"    if law == {i}: return law_{i}({arguments})\n" for i in range(last))
    text = f"(law, {arguments}):\n{chain}    return law_{last}({arguments})\n"
    exec(f"def {name}{text}def typed(law, {arguments}): return chosen\ndef chosen{text}", space)
    overload(space[name], jit_options=_CHOSEN)(space["typed"])
    space[name].text = f"def {name}{text}"
    space[name].made_of = space[name], _INLINED
    return space[name]


class Generic:
    """A function of a plant that each type of plant has a kernel of its own for.

    ``of(Plant)`` decorates the kernel of that type. Kernels call ``call``; which one it is, is
    settled by the type of the argument ``plant`` when they are compiled.

    Args:
        name: of the function.
        arguments: as a signature has them, one of them ``plant``.
    """

    def __init__(self, name: str, arguments: str) -> None:
        self.kernels: dict[type, Callable] = {}
        self.arguments = arguments
        space: dict[str, Any] = {"kernels": self.kernels}
        exec(f"def {name}({arguments}): return kernels[type(plant)]({arguments})\n", space)
        self.call: Any = space[name]
        self.call.generic = self

    def of(self, plant: type) -> Callable[[Callable], Callable]:
        """Decorate the kernel that serves this type of plant."""

        def register(function: Callable) -> Callable:
            self.kernels[plant] = function
            space: dict[str, Any] = {"function": function, "wanted": plant}
            exec(
                f"def chosen({self.arguments}): return function({self.arguments})\n"
                f"def typed({self.arguments}):\n"
                "    if getattr(plant, 'instance_class', None) is wanted: return chosen\n",
                space,
            )
            overload(self.call, jit_options=_CHOSEN)(space["typed"])
            return function

        return register


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
