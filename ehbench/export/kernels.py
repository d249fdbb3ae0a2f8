"""C text of kernels: compiled anew for a plain processor in a process of its own, so that the text
is the same on every machine, translated, and cached beside the kernels' machine code."""

import hashlib
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import numba

from ehbench.export import c99
from ehbench.export.component import Component
from ehbench.runtime.compiled import FOLDER, WITHIN, Kernel
from ehbench.runtime.disk import write_text
from ehbench.vocabulary import EhbenchError, message

# no vectors, and nothing that only this machine's processor has
PLAIN = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
PLAIN |= {"NUMBA_LOOP_VECTORIZE": "0", "NUMBA_SLP_VECTORIZE": "0"}
PLAIN |= {"LLVMLITE_ENABLE_OPAQUE_POINTERS": "1"}  # of numba 0.61, as of all later ones
NAME = "kernel"  # of the function in C


class Kernels(NamedTuple):
    """The C text of a kernel, and the types of its parameters as LLVM has them."""

    source: str
    kinds: Sequence[str]


def kernels_of(components: Sequence[Component]) -> list[Kernels]:
    """The C text of each component's kernel, from the cache where it is there.

    Raises:
        EhbenchError: a kernel has a part that no rule writes as C."""
    digest = hashlib.sha256()
    for module in (c99, sys.modules[__name__]):
        digest.update(Path(str(module.__file__)).read_bytes())
    places = {}
    for item in components:
        like = ", ".join(str(numba.typeof(value)) for value in item.arguments.values())
        key = f"{item.kernel.__module__}.{item.kernel.__qualname__}({like})"
        inner = digest.copy()
        inner.update(key.encode())
        places[item.name] = FOLDER / f"export_{inner.hexdigest()[:16]}.json"
    jobs = {
        str(places[item.name]): (
            item.kernel.__module__,
            item.kernel.__qualname__,
            *item.arguments.values(),
        )
        for item in components
        if not places[item.name].is_file()
    }
    if jobs:  # in a process whose compiler knows a plain processor only
        paths = os.pathsep.join(path for path in sys.path if path)
        done = subprocess.run(
            [sys.executable, "-P", "-m", __name__],
            input=pickle.dumps(jobs),
            capture_output=True,
            env={**os.environ, **PLAIN, "PYTHONPATH": paths},
            check=False,
        )
        if done.returncode:
            lines = done.stderr.decode(errors="replace").strip().splitlines() or ["?"]
            raise EhbenchError(message("export.not_compiled", reason=lines[-1]))
    return [Kernels(**json.loads(places[item.name].read_text())) for item in components]


def translate(module: str, name: str, *arguments: Any) -> Kernels:
    """The C text of a function of the package that is compiled for some arguments."""
    function: Any = import_module(module)
    for part in name.split("."):
        function = getattr(function, part)
    inner = function if isinstance(function, Kernel) else numba.njit(**WITHIN)(function)
    names = ", ".join(signature(function).parameters)
    space: dict[str, Any] = {"inner": inner}
    exec(f"def exported({names}):\n    inner({names})", space)
    dispatcher: Any = numba.njit(**WITHIN)(space["exported"])
    dispatcher.compile(tuple(numba.typeof(value) for value in arguments))
    text = dispatcher.inspect_llvm(dispatcher.signatures[0])
    result = c99.Translation(text, "8exported", NAME)
    return Kernels(result.source(), [kind for kind, _ in result.entry.parameters])


if __name__ == "__main__":
    for place, job in pickle.loads(sys.stdin.buffer.read()).items():
        write_text(Path(place), json.dumps(translate(*job)._asdict()))
