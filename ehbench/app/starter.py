"""Where a user begins: a new workspace, and a campaign by its name."""

from pathlib import Path

from ehbench.runs import rundir
from ehbench.runtime.disk import filling, impossible
from ehbench.vocabulary import InputError, message, shortened
from ehbench.vocabulary.errors import nearest
from ehbench.vocabulary.text import shortened_path


def find_campaign(name: str) -> Path:
    """The campaign file of a name such as ``thesis``: ``recipes/<name>/campaign.toml`` here or
    beside the package, or a file.

    Raises:
        InputError: there is none."""
    here, places = Path(name) / "campaign.toml", (Path("recipes"), rundir.shipped("recipes"))
    for candidate in (Path(name), *(place / here for place in places)):
        if not impossible(candidate) and candidate.is_file():
            return candidate
    known = sorted({item.parent.name for place in places for item in place.glob("*/campaign.toml")})
    text = message("app.no_campaign", name=shortened(name, 100), known=", ".join(known))
    raise InputError(text, hint=nearest(name, known))


def init(folder: Path) -> None:
    """A new workspace: a commented rig file and recipes that run as they are. No file is ever
    written over.

    Raises:
        InputError: the folder exists and is not empty, or cannot be created."""
    template = rundir.PACKAGE / "workspace"
    try:
        place = folder.resolve()
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise InputError(message("app.not_empty"), file=folder)
        with filling(place) as scratch:
            for source in sorted(template.rglob("*")):
                target = scratch / source.relative_to(template)
                if source.is_file():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(source.read_bytes())
    except (OSError, RuntimeError, ValueError) as error:
        reason = str(getattr(error, "strerror", None) or error)
        text = message("app.no_workspace", reason=reason)
        raise InputError(text, file=shortened_path(folder)) from None
