"""Where a user begins: a new workspace, and a campaign by its name."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from ehbench.runs import rundir
from ehbench.runtime.disk import impossible
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.text import shortened, shortened_path


def find_campaign(name: str) -> Path:
    """The campaign file of a name such as ``thesis``: ``recipes/<name>/campaign.toml`` here or
    beside the package, or a file.

    Raises:
        InputError: there is none.
    """
    here, places = Path(name) / "campaign.toml", (Path("recipes"), rundir.shipped("recipes"))
    for candidate in (Path(name), *(place / here for place in places)):
        if not impossible(candidate) and candidate.is_file():
            return candidate
    known = sorted({item.parent.name for place in places for item in place.glob("*/campaign.toml")})
    near = get_close_matches(name, known, 1)
    hint = "give a campaign's TOML file, or a name for recipes/<name>/campaign.toml"
    raise InputError(
        f"no campaign {shortened(name, 100)}",
        hint=f"did you mean '{near[0]}'?" if near else f"{hint}: {', '.join(known)}",
    )


def init(folder: Path) -> Path:
    """A new workspace: a commented rig file and recipes that run as they are. No file is ever
    written over.

    Raises:
        InputError: the folder exists and is not empty, or cannot be made.
    """
    template = rundir.PACKAGE / "workspace"
    try:
        place = folder.resolve()
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise InputError(
                "exists and is not empty; nothing was written",
                file=folder,
                hint="name a new folder",
            )
        for source in sorted(template.rglob("*")):
            target = place / source.relative_to(template)
            if source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as file:
                    file.write(source.read_bytes())
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be made: {reason}", file=shortened_path(folder)) from None
    return folder
