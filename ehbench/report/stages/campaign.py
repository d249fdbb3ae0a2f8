"""What a campaign adds to the page: title, note, sections of text, and titles of figures and
tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from ehbench.config.recipe import Campaign
from ehbench.config.rig import Rig
from ehbench.report.blocks import Block, Section, prose, slug
from ehbench.report.captions import capital
from ehbench.report.saved import Saved
from ehbench.report.words import words
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import message


class Titles:
    """Titles that a campaign gives to figures and tables by their keys, ``key`` or ``run/key``;
    remembers which keys there were.
    """

    def __init__(self, campaign: Campaign | None) -> None:
        self._campaign = campaign
        self._given = dict(campaign.figures) if campaign else {}
        self._keys: set[str] = set()

    def of(self, run: Saved, key: str) -> tuple[str, int] | None:
        """(the campaign's title of a figure or table, its place among all); None where it gives
        none.
        """
        names = (f"{run.name}/{key}", key)
        self._keys.update(names)
        name = next((name for name in names if name in self._given), None)
        return None if name is None else (self._given[name], [*self._given].index(name))

    def refuse_unused(self) -> None:
        """See that every title found its figure.

        Raises:
            InputError: one did not; names the nearest key.
        """
        for key in self._given:
            if key not in self._keys:
                near = get_close_matches(key, self._keys, 1, 0.3)
                place = self._campaign.at("figures", key) if self._campaign else {}
                hint = f"nearest is '{near[0]}'" if near else None
                raise InputError(message("report.no_title", key=key), hint=hint, **place)


def heading(campaign: Campaign | None, rigs: Sequence[Rig]) -> tuple[str, Sequence[Block]]:
    """(title, note) of the page: the campaign's, else those of the rigs."""
    if campaign is not None:
        return campaign.title or words(campaign.name).capitalize(), prose(campaign.note)
    titles = dict.fromkeys(rig.title or capital(words(rig.name)) for rig in rigs)
    notes = prose(rigs[0].note) if len(titles) == 1 else []
    return ", ".join(titles) or "Report", notes[:1]


def campaign_sections(campaign: Campaign | None) -> list[Section]:
    """The campaign's own sections, which stand before those of the runs."""
    written = campaign.section if campaign else []
    return [
        Section(item.title, prose(item.text), f"section-{i}-{slug(item.title)}")
        for i, item in enumerate(written, 1)
    ]
