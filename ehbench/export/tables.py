"""Formats that need no compiled code: numbers and linear models for MATLAB, the mechanism."""

from collections.abc import Callable
from pathlib import Path

from ehbench.config.rig import Rig
from ehbench.export.content import Export, Written
from ehbench.export.linear import state_spaces
from ehbench.export.matlab import matlab_files
from ehbench.runtime.disk import replacing
from ehbench.vocabulary import EhbenchError, message


def write_matlab(export: Export, folder: Path) -> list[Written]:
    """Write parameters and linear models into ``matlab``."""
    spaces, note = [], ""
    try:
        spaces = state_spaces(export.rig, export.maps)
    except EhbenchError as error:
        note = message("export.no_linear", reason=error.message)
    files = matlab_files(export.rig, export.fitted, spaces)
    *others, last = _written(folder / "matlab", files, message("export.about_matlab"))
    return [*others, last._replace(note=note)]


def write_mechanism(
    export: Export, folder: Path, ending: str, text: Callable[[Rig], bytes]
) -> list[Written]:
    """Write the mechanism, as a ``text`` has it, into ``mechanism``."""
    carrying = export.rig.with_payload(export.trial.recipe.payload)
    files = {f"{export.rig.name}.{ending}": text(carrying)}
    return _written(folder / "mechanism", files, message("export.about_mechanism"))


def _written(folder: Path, files: dict[str, bytes], about: str) -> list[Written]:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        with replacing(folder / name) as place:
            place.write_bytes(content)
    return [Written(f"{folder.name}/{name}", about) for name in files]
