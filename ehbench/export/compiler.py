"""C compilers: the machine's own, or that of the extra ``[export]``, which knows other targets."""

import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from ehbench.vocabulary import EhbenchError, message

FLAGS = ("-std=c11", "-O2", "-ffp-contract=off")


class Target(NamedTuple):
    """A kind of machine: what the extra's compiler calls it, the folders of its binary in an FMU
    of version 2 and 3, and the binary's ending."""

    triple: str
    folders: tuple[str, str]
    ending: str = ".so"


TARGETS = {
    "linux64": Target("x86_64-linux-gnu", ("linux64", "x86_64-linux")),
    "win64": Target("x86_64-windows-gnu", ("win64", "x86_64-windows"), ".dll"),
    "aarch64": Target("aarch64-linux-gnu", ("aarch64-linux", "aarch64-linux")),
}
HERE = {("Linux", "x86_64"): "linux64", ("Linux", "aarch64"): "aarch64"}.get(
    (platform.system(), platform.machine()), ""
)


def compiler(target: str = HERE) -> list[str] | None:
    """The command that compiles for a target, by default this machine; None where there is none."""
    if target == HERE:
        for name in ("cc", "gcc", "clang"):
            if path := shutil.which(name):
                return [path]
    if find_spec("ziglang") is None or target not in TARGETS:
        return None
    return [sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[target].triple]


def build(command: Sequence[str], files: Sequence[Path], out: Path, *more: str) -> Path:
    """Compile files into a program or library.

    Raises:
        EhbenchError: the compiler refuses; with its first words."""
    given = [*command, *FLAGS, *more, *map(str, files), "-o", str(out), "-lm"]
    done = subprocess.run(given, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        reason = " ".join(done.stderr.split())[:300]
        raise EhbenchError(message("export.compiler_failed", compiler=command[0], reason=reason))
    return out
