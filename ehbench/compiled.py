"""How the hot functions are compiled: one decorator for the laws, the plant and the integrator, one
for loops that allocate, one cache for their code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core import config
from numba.extending import overload

PACKAGE = Path(__file__).resolve().parent
_SETTINGS: Any = config
_MARKS = (b"njit", b"@kernel", b"@part_kernel", b"@allocating_kernel", b"choice(", b"Generic(")


def _cache_folder() -> Path:
    """A cache for these very sources: numba looks only at a function's own file, and would keep
    what it inlined of others.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + content)
    return PACKAGE / "__pycache__" / f"kernels_{digest.hexdigest()[:12]}"


def _compiler(folder: Path, **options: Any) -> Callable[[Callable], Any]:
    """A decorator that compiles when first called and keeps the code in ``folder``.

    numba reads where to keep code when it wraps a function, and from its global settings only;
    they are as before once the function is wrapped.
    """

    def compiled(function: Callable) -> Any:
        before, _SETTINGS.CACHE_DIR = _SETTINGS.CACHE_DIR, str(folder)
        try:
            return numba.njit(cache=True, **options)(function)
        finally:
            _SETTINGS.CACHE_DIR = before

    return compiled


_FOLDER = _cache_folder()


def is_cold() -> bool:
    """Whether nothing is compiled yet, so that a first run takes a minute longer."""
    return not any(_FOLDER.rglob("*.nbc"))


# Without numba's reference counting a kernel cannot allocate (the compiler refuses it), and passing
# rows and slices of arrays costs nothing: 1.4 times as fast a plant. Arguments are the caller's.
OPTIONS: Any = {"nogil": True, "error_model": "numpy", "_nrt": False}
# numba hands forceinline down from callers that have it: the derivatives would stand ten times in
# one loop, which takes half as long again to compile and is no faster
kernel = _compiler(_FOLDER, **OPTIONS, forceinline=False)

# for the small kernels of which a large one is made: they go into its code, without a call
part_kernel = _compiler(_FOLDER, **OPTIONS, forceinline=True)

allocating_kernel = _compiler(_FOLDER, nogil=True)

_INLINED: Any = {**OPTIONS, "forceinline": True}
# for what is made at import, which no cache can find again: it goes into the code of its callers
inlined = numba.njit(**_INLINED)


def bound(function: Any, *like: Any) -> Callable:
    """A kernel for arguments of the types of ``like``, which are not looked at again with each
    call: that takes longer than a tick. It must be given no others.
    """
    if not hasattr(function, "get_overload"):  # nothing is compiled
        return function
    types = tuple(numba.typeof(argument) for argument in like)
    function.compile(types)
    return function.get_overload(types)


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
    exec(
        f"def {name}(law, {arguments}):\n{chain}    return law_{last}({arguments})\n"
        f"def typed(law, {arguments}): return chosen\n"
        f"def chosen(law, {arguments}):\n{chain}    return law_{last}({arguments})\n",
        space,
    )
    overload(space[name], jit_options=_INLINED)(space["typed"])
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
        self.call: Callable = space[name]

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
            overload(self.call, jit_options=_INLINED)(space["typed"])
            return function

        return register


Column = tuple[str, Any] | tuple[str, Any, tuple[int, ...]]


def record(*columns: Column) -> np.dtype:
    """The layout of one row of a table: a field's name, its type (``f8``, ``i8`` or another layout)
    and, of an array, its shape.
    """
    return np.dtype((np.record, list(columns)), align=True)


def table(rows: int, layout: np.dtype) -> np.recarray:
    """A table of rows of a layout, all zero; ``table[i].field`` reads in kernels and in Python."""
    return np.zeros(rows, layout).view(np.recarray)


def table_of(rows: Sequence[Mapping[str, Any]], layout: np.dtype) -> np.recarray:
    """A table of rows given by the names of their fields; what a row does not name is zero."""
    names = layout.names or ()
    values = [tuple(map(row.get, names, repeat(0))) for row in rows]
    return np.array(values, layout).view(np.recarray)
