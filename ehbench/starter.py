"""Where a user begins: a new workspace, and a campaign by its name."""

from __future__ import annotations

import shutil
from pathlib import Path

from ehbench import rundir
from ehbench.errors import InputError


def find_campaign(name: str) -> Path:
    """The campaign file of a name such as ``thesis``: ``recipes/<name>/campaign.toml`` here or
    beside the package, or a file.

    Raises:
        InputError: there is none.
    """
    here = Path(name) / "campaign.toml"
    for candidate in (Path(name), Path("recipes") / here, rundir.shipped("recipes") / here):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"no campaign '{name}'",
        hint="give a campaign's TOML file, or a name for recipes/<name>/campaign.toml",
    )


def init(folder: Path) -> Path:
    """A new workspace: a commented rig file and recipes that run as they are.

    Raises:
        InputError: the folder exists and is not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "exists and is not empty; nothing was written", file=folder, hint="name a new folder"
        )
    try:
        shutil.copytree(rundir.PACKAGE / "workspace", folder, dirs_exist_ok=True)
    except (OSError, shutil.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be made: {reason}", file=folder) from None
    return folder
