"""The recipe of a campaign: several recipes and one report over them."""

from typing import Annotated, Literal

from pydantic import Field

from ehbench.config.recipe.base import Recipe
from ehbench.vocabulary.fields import FileModel


class TextSection(FileModel):
    """A section of a report in the user's own words; blank lines part paragraphs, lines that begin
    with ``- `` make a list."""

    title: str
    text: str


class Campaign(Recipe):
    """Several recipes in order and one report over all of them.

    ``section`` are texts that stand before the runs; ``figures`` gives figures and tables titles by
    their key (of a figure as in a run's ``figures/index.json``), or by ``<recipe's name>/<key>``
    where several runs have the key."""

    stage: Literal["campaign"]
    recipes: Annotated[tuple[str, ...], Field(min_length=1)]
    section: tuple[TextSection, ...] = ()
    figures: dict[str, str] = {}
