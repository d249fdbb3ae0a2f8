"""The format C: a folder for each part, and the check of each on this machine."""

import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from ehbench.export.compiler import build, compiler
from ehbench.export.content import Export, Written
from ehbench.export.source import write_sources
from ehbench.vocabulary import message
from ehbench.vocabulary.errors import ModelRejected


def write_c(export: Export, folder: Path) -> list[Written]:
    """Write the C of each part into ``c/<part>``.

    Raises:
        ModelRejected: the check on this machine fails."""
    written = []
    for part, kernel in zip(export.components, export.kernels, strict=True):
        place = folder / "c" / part.name
        write_sources(part, kernel, place)
        check = checked(place, part.name)
        note = "" if check else message("export.not_checked", name=part.name)
        written.append(Written(f"c/{part.name}", part.about, check, note))
    return written


def checked(folder: Path, name: str) -> str:
    """What the check of a part says on this machine; nothing where there is no compiler.

    Raises:
        ModelRejected: the check fails."""
    command = compiler()
    if command is None:
        return ""
    with TemporaryDirectory() as scratch:
        files = [folder / "check.c", folder / f"{name}.c"]
        program = build(command, files, Path(scratch) / "check")
        given = [str(program), str(folder / "check.csv")]
        done = subprocess.run(given, capture_output=True, text=True, check=False)
    if done.returncode:
        words = done.stdout.strip() or f"signal {-done.returncode}"
        raise ModelRejected(message("export.check_failed", name=name, words=words))
    return done.stdout.strip()
