"""What every recipe has, and the pieces that several recipes share.

Paths in a recipe are relative to the recipe. A rig or a flow map may be named by a file, by a run
folder, or by the recipe that makes it: the workflow then makes it first if it is not there."""

import os
import re
from collections.abc import Set
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field

from ehbench.config.recipe.columns import AnyColumns
from ehbench.config.recipe.toml import as_table, line_of
from ehbench.runtime.disk import impossible
from ehbench.vocabulary import InputError, message, shortened
from ehbench.vocabulary.fields import FileModel, Internal, Q, Value

# what a machine carries, by the name that its rig file has for it; ``none`` is no payload
Payload = Annotated[str | None, BeforeValidator(lambda raw: None if raw == "none" else raw)]


class BesideFile(FileModel):
    """A file that another recorder wrote of the same run."""

    path: str
    columns: AnyColumns = None
    shift: Annotated[Value, Q("start")] | None = None
    clock: Literal["shared", "own"] = "shared"


class DataFile(FileModel):
    """A log to use: its path, the payload carried (else what the log's own meta says), constant
    forces on rods by the channel of a force of the rig, a window of its time, a note, files beside
    it."""

    path: str
    payload: str | None = None
    force: dict[str, Annotated[Value, Q("force")]] = {}
    start: Annotated[Value, Q("start")] | None = None
    stop: Annotated[Value, Q("stop")] | None = None
    note: str = ""
    columns: AnyColumns = None
    beside: tuple[Annotated[BesideFile, as_table("path")], ...] = ()


DataFiles = Annotated[tuple[Annotated[DataFile, as_table("path")], ...], Field(min_length=1)]
Tied = Literal["none", "position", "motion"]
Supplied = Literal["model", "recorded"]


class ReplayedFile(DataFile):
    """A log that a simulation runs along, and what of its motion that is tied to."""

    tied: Tied | None = None
    supply: Supplied | None = None


ReplayedFiles = Annotated[
    tuple[Annotated[ReplayedFile, as_table("path")], ...], Field(min_length=1)
]


class Recipe(FileModel):
    """What every recipe has. ``path`` is the recipe's own file; names of other files are relative
    to it."""

    title: str = ""
    note: str = ""
    path: Annotated[Path, Internal] = Field(default=Path("recipe.toml"), exclude=True)

    @classmethod
    def kind(cls) -> tuple[str, str | None]:
        """(stage, what) that a file of this kind has; what is None where the stage has one kind."""
        fields = cls.model_fields
        (stage,) = get_args(fields["stage"].annotation)
        what = get_args(fields["what"].annotation)[0] if "what" in fields else None
        return stage, what

    @property
    def stage_name(self) -> str:
        """The word that the file has for its stage."""
        return self.kind()[0]

    @property
    def name(self) -> str:
        """The recipe's name: its file's stem."""
        return self.path.stem

    def file(self, name: str) -> Path:
        """A path of this recipe, as written in it, relative to its folder; ``$NAME`` stands for a
        variable of the environment.

        Raises:
            InputError: no file can have such a path, or a variable is not set."""
        for variable in re.findall(r"\$(\w+)", name):
            if not os.environ.get(variable):
                fields = {"name": shortened(name, 60), "variable": variable}
                raise InputError(message("config.variable_not_set", **fields), file=self.path)
        path = self.path.parent / re.sub(r"\$(\w+)", lambda at: os.environ[at[1]], name)
        if reason := impossible(path):
            text = message("config.no_path", name=shortened(name, 60), reason=reason)
            raise InputError(text, file=self.path)
        return path.resolve()

    def at(self, *location: str | int) -> dict[str, Any]:
        """``file`` and ``line`` of a key, as errors take them; no line where it is not known."""
        try:
            text = self.path.read_text(encoding="utf-8-sig", errors="surrogateescape")
        except OSError:
            return {"file": self.path, "line": None}
        return {"file": self.path, "line": line_of(text, location)}


def dotted(raw: Any, entry_keys: Set[str] = frozenset()) -> Any:
    """Tables within tables as dotted names, as unquoted keys such as ``boom.joint_damping`` make
    them.

    Args:
        entry_keys: keys of a table that is itself an entry, with values that are not all tables;
            none where entries are plain values."""
    if not isinstance(raw, dict):
        return raw
    results: dict[str, Any] = {}
    for name, value in raw.items():
        is_nested = isinstance(value, dict)
        if is_nested and entry_keys:
            inside = all(isinstance(item, dict | list) for item in value.values())
            is_nested = bool(value) and inside and not entry_keys & set(value)
        inner = {name: value}
        if is_nested:
            inner = {f"{name}.{key}": item for key, item in dotted(value, entry_keys).items()}
        if twice := sorted(set(inner) & set(results)):
            raise ValueError(message("config.given_twice", twice=twice[0]))
        results |= inner
    return results


ByParameter = Annotated[dict[str, str], BeforeValidator(dotted)]
