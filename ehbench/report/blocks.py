"""What a report page is made of: plain pieces that the template turns into HTML."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias
from xml.etree import ElementTree

from ehbench.report.svg import sound


@dataclass(frozen=True)
class Cell:
    """A table cell; ``look``: ``number``, ``code``, or a chip: ``good``, ``bad``, ``warn``…"""

    text: str
    look: str = ""
    link: str = ""
    hint: str = ""


@dataclass(frozen=True)
class Text:
    """A paragraph; ``look`` may be ``lead``, ``head``, ``note``, ``warn``, ``good`` or ``bad``."""

    text: str
    look: str = ""


@dataclass(frozen=True)
class Bullets:
    """A list; ``look`` as in `Text`."""

    items: Sequence[str]
    look: str = ""


@dataclass(frozen=True)
class Grid:
    """A table: head, rows of `Cell` or text, a caption above; ``key`` is what a campaign names it
    by, ``title`` what it calls it; ``look`` may be ``stack``: rows become blocks on a phone."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell | str]]
    caption: str = ""
    key: str = ""
    title: str = ""
    look: str = ""


@dataclass(frozen=True)
class Card:
    """A number of the first screen: its name, the number with its unit, a remark, a link."""

    label: str
    value: str
    about: str = ""
    link: str = ""


@dataclass(frozen=True)
class Cards:
    """Numbers side by side."""

    cards: Sequence[Card]


@dataclass(frozen=True)
class Heat:
    """A small square matrix of correlations from −1 to 1 with its row and column names."""

    names: Sequence[str]
    values: Sequence[Sequence[float | None]]
    limit: float = 0.95


@dataclass(frozen=True)
class Picture:
    """A figure: inline SVG with its title and caption. ``named``: the place of its title in the
    campaign's list, None where the campaign has none; ``paper``: shown in print."""

    svg: str
    title: str
    caption: str = ""
    id: str = ""
    named: int | None = None
    paper: bool = False


@dataclass(frozen=True)
class Fold:
    """Pieces that open on a click."""

    title: str
    inside: Sequence[Block]


Block: TypeAlias = Text | Bullets | Cards | Grid | Heat | Picture | Fold


@dataclass(frozen=True)
class Part:
    """A headed part of a section; ``paper``: shown in print."""

    title: str
    inside: Sequence[Block]
    id: str = ""
    paper: bool = True


@dataclass(frozen=True)
class Section:
    """A section of the page: ``chip`` beside the title; its parts are in the table of contents."""

    title: str
    inside: Sequence[Block]
    id: str
    chip: Cell | None = None
    parts: Sequence[Part] = field(default_factory=tuple)


def prose(text: str) -> list[Text | Bullets]:
    """Paragraphs of plain text: blank lines part them; lines that begin with ``- `` are a list."""
    blocks: list[Text | Bullets] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        lead, *items = re.split(r"(?:^|\n)\s*- ", paragraph)
        if lead.strip():
            blocks.append(Text(" ".join(lead.split())))
        if items:
            blocks.append(Bullets([" ".join(item.split()) for item in items]))
    return blocks


def slug(text: str, joint: str = "-") -> str:
    """Text as part of an id or key: ``30 %`` → ``30``."""
    return re.sub(r"[^a-z0-9]+", joint, text.lower()).strip(joint) or "x"


_FOUR = re.compile(r"(?:-?[0-9.]+\s+){3}-?[0-9]+(?:\.[0-9]*)?")


def inline(svg: str, prefix: str, title: str, looks: dict[str, str] | None = None) -> str:
    """A saved SVG as part of a page: nothing but its drawing, ids made its own by ``prefix``, sized
    by the page.

    With ``looks`` every style becomes a class of the page: the class by the style, grown here. Only
    attributes of the parsed elements are styles, never their texts.

    Raises:
        ValueError: it is no SVG."""
    root = sound(svg)
    for item in list(root.iter()):
        item.tag = item.tag.rpartition("}")[2]
        item.text, item.tail = (
            text if text and text.strip() else None for text in (item.text, item.tail)
        )
        for name, value in list(item.attrib.items()):
            del item.attrib[name]
            name = name.rpartition("}")[2]
            if name == "style" and looks is not None:
                name, value = "class", looks.setdefault(value, f"k{len(looks)}")
            elif name == "id":
                value = prefix + value
            elif name == "href":
                value = re.sub("^#", f"#{prefix}", value)
            item.set(name, value.replace("url(#", f"url(#{prefix}"))
    shape = root.get("viewBox", "").strip()
    shape = shape if _FOUR.fullmatch(shape) else "0 0 525 300"
    width = float(shape.split()[2]) * 4 / 3  # points to CSS pixels
    root.attrib.clear()
    root.attrib |= {
        "viewBox": shape,
        "style": f"max-width:{width:.0f}px",
        "role": "img",
        "aria-label": title,
    }
    return ElementTree.tostring(root, encoding="unicode", short_empty_elements=True)


def digest(script: str) -> str:
    """The SHA-256 by which a page allows a script of its own."""
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode()
