"""Names in a rig file, and where in it several keys are wrong together."""

import re
import unicodedata
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, BaseModel

from ehbench.vocabulary import message
from ehbench.vocabulary.fields import FileModel

NODES = ("supply", "tank", "head", "rod")


class Misplaced(ValueError):
    """What is wrong with several keys; ``where`` is the key below the checked table to name."""

    def __init__(self, message: str, *where: str | int) -> None:
        super().__init__(message)
        self.where = where


def _name(name: str) -> str:
    if not re.fullmatch(r"\w[\w-]*", name):
        raise ValueError(message("config.no_name", name=name))
    return name


def ascii_words(text: str) -> str:
    """The letters and digits of a text that ASCII has, with _ for what stands between them."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")


def plain_name(name: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        plain = ascii_words(name.casefold()).lstrip("0123456789_") or "my_rig"
        raise ValueError(message("config.no_rig_name", name=name, plain=plain))
    return name


Name = Annotated[str, AfterValidator(_name)]


def second(names: Sequence[str]) -> int | None:
    """The index of the first repeated name."""
    return next((at for at, name in enumerate(names) if name in names[:at]), None)


def tables_of(model: BaseModel) -> dict[str, FileModel]:
    """The tables within a part of the rig."""
    fields = {name: getattr(model, name) for name in type(model).model_fields}
    return {name: part for name, part in fields.items() if isinstance(part, FileModel)}
