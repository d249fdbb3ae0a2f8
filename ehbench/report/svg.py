"""Saved figures made small: the same picture in a third of the bytes."""

from __future__ import annotations

import re
from functools import lru_cache
from xml.etree import ElementTree

# drawn for the first; Verdana is as wide, most others are narrower
FONTS = "DejaVu Sans, Verdana, sans-serif"
FONT_SIZE = "9px"
_SVG = "{http://www.w3.org/2000/svg}"
_LINK = "{http://www.w3.org/1999/xlink}href"
_TOKEN = re.compile(r"[MLCQz]|-?[\d.]+(?:e-?\d+)?")
_POINTED = re.compile(r'(url\(#|href="#)([^")]+)')
_NAMED = re.compile(r'( id="|url\(#|href="#)([^")]+)')
_PAIRS = {"M": 1, "L": 1, "Q": 2, "C": 3, "z": 0}
_DROPPED = {"metadata", "style"}
_ROUNDED = ("x", "y", "width", "height")


# what a figure is drawn with; a saved one may come from anyone
_ELEMENTS = frozenset(
    "svg g defs clipPath path rect circle ellipse line polyline polygon text tspan use marker "
    "symbol title desc linearGradient radialGradient stop pattern image".split()
)
_ATTRIBUTE = re.compile(r"(?!on)[a-zA-Z][-\w]*(?::\w+)?", re.I)
_IMAGE = re.compile(r"data:image/(?:png|jpeg);base64,[\w+/=\s]*")


def sound(svg: str) -> str:
    """A saved figure without anything that is no drawing: scripts, handlers of events, links out of
    the page, styles that fetch. A figure of ours comes back as it is.

    Raises:
        ValueError: it is no SVG.
    """
    if "<!DOCTYPE" in svg.upper() or "<!ENTITY" in svg.upper():
        svg = re.sub(r"<!DOCTYPE[^>\[]*>", "", svg, count=1)
        if "<!" in svg.replace("<!--", ""):
            raise ValueError("declares entities")
    try:
        root = ElementTree.fromstring(svg)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise ValueError(f"is no SVG: {error}") from None
    if root.tag != f"{_SVG}svg":
        raise ValueError("is no SVG")
    plain = "<!" not in svg and "<?" not in svg
    if _purged(root) and plain:
        return svg
    for item in root.iter():
        if _LINK in item.attrib:
            item.set("href", item.attrib.pop(_LINK))
    ElementTree.register_namespace("", _SVG[1:-1])
    return ElementTree.tostring(root, encoding="unicode")


def _purged(root: ElementTree.Element) -> bool:
    """Take what is no drawing out of an element and all below it; whether there was nothing."""
    clean, waiting = True, [root]
    while waiting:
        item = waiting.pop()
        for name in [name for name, value in item.attrib.items() if not _harmless(name, value)]:
            del item.attrib[name]
            clean = False
        for inner in list(item):
            tag = inner.tag if isinstance(inner.tag, str) else ""
            if tag.removeprefix(_SVG) in _ELEMENTS and tag.startswith(_SVG):
                waiting.append(inner)
            else:
                item.remove(inner)
                clean = False
    return clean


def _harmless(name: str, value: str) -> bool:
    """Whether an attribute only draws."""
    if name in (_LINK, "href"):
        return value.startswith("#") or bool(_IMAGE.fullmatch(value))
    if name.startswith("{http://www.w3.org/XML/1998/namespace}"):
        return True
    if not _ATTRIBUTE.fullmatch(name):
        return False
    if "url" in value.lower() or name == "style":
        return not re.search(r"url\(\s*(?!#)|[{}<>@\\]|/\*|expression|javascript", value, re.I)
    return "javascript:" not in value.lower()


def shrink(svg: str) -> str:
    """matplotlib's SVG without what nobody sees: a tenth of a point, empty groups, unused used,
    defaults said each time.

    Text stays text, in `FONTS`. Markers, which are small, keep a hundredth of a point.
    """
    root = ElementTree.fromstring(svg)
    used = {
        name: f"i{place}"
        for place, name in enumerate(dict.fromkeys(result[1] for result in _POINTED.findall(svg)))
    }
    body = ElementTree.Element(
        "g", {"font-family": FONTS, "font-size": FONT_SIZE, "stroke-linejoin": "round"}
    )
    body.extend(_kept(root, used, 1))
    head = "".join(f' {name}="{root.get(name)}"' for name in ("width", "height", "viewBox"))
    inside = ElementTree.tostring(body, encoding="unicode")
    inside = _NAMED.sub(lambda match: match[1] + used[match[2]], inside)
    return f'<svg xmlns="http://www.w3.org/2000/svg"{head}>{inside}</svg>\n'


def _kept(
    element: ElementTree.Element, used: dict[str, str], places: int
) -> list[ElementTree.Element]:
    """The children of an element as they are kept; those of a group that says nothing stand in its
    place.
    """
    results: list[ElementTree.Element] = []
    for item in element:
        tag = item.tag.removeprefix(_SVG)
        if tag in _DROPPED:
            continue
        inner = _kept(item, used, 2 if tag == "defs" else places)
        says = _attributes(item, used, places)
        if tag == "g" and not says:
            results += inner
        elif inner or tag not in ("g", "defs"):
            retained = ElementTree.Element(tag, says)
            retained.text = item.text if tag == "text" else None
            retained.extend(inner)
            results.append(retained)
    return _grouped(results)


def _attributes(item: ElementTree.Element, used: dict[str, str], places: int) -> dict[str, str]:
    attributes = {}
    for name, value in item.attrib.items():
        if (
            name == "id"
            and value not in used
            or name == "transform"
            and value.startswith("rotate(-0 ")
        ):
            continue
        if name == "d":
            value = _path(value, places)
        elif name == "style":
            value = _style(value)
        elif name in _ROUNDED:
            value = _decimal(round(float(value) * 10**places), places)
        elif name == "transform":
            value = re.sub(r"(\.\d)\d+", r"\1", value)
        if value:
            attributes["href" if name == _LINK else name] = value
    return attributes


def _style(text: str) -> str:
    parts = [part.split(": ", 1) for part in text.split("; ")]
    return ";".join(
        f"{name}:{value}"
        for name, value in parts
        if name != "font-family" and (name, value) != ("font-size", FONT_SIZE)
    )


def _grouped(elements: list[ElementTree.Element]) -> list[ElementTree.Element]:
    """Runs of markers with one style as a group that says it once."""
    groups: list[ElementTree.Element] = []
    for element in elements:
        style = element.get("style")
        last = groups[-1] if groups else None
        if (
            element.tag == "use"
            and style is not None
            and last is not None
            and last.get("style") == style
            and last.tag in ("use", "g")
        ):
            if last.tag == "use":
                groups[-1] = ElementTree.Element("g", {"style": style})
                groups[-1].append(last)
                del last.attrib["style"]
            del element.attrib["style"]
            groups[-1].append(element)
        else:
            groups.append(element)
    return groups


@lru_cache(1 << 16)  # a figure's points lie close to each other: the same steps, over and over
def _decimal(value: int, places: int) -> str:
    """An integer count of ``10**-places`` as the shortest decimal number."""
    text = f"{value / 10**places:.{places}f}".rstrip("0").rstrip(".")
    return re.sub(r"^(-?)0\.", r"\1.", text) if text not in ("-0", "") else "0"


def _path(text: str, places: int) -> str:
    """A path in relative coordinates; rounded where it is, so that errors do not add up."""
    tokens, out, last = _TOKEN.findall(text), [], ""
    scale, at, x, y = 10**places, 0, 0, 0
    x_start, y_start = 0, 0
    while at < len(tokens):
        command = tokens[at]
        at += 1
        pairs = _PAIRS[command]
        ends = [round(float(token) * scale) for token in tokens[at : at + 2 * pairs]]
        at += 2 * pairs
        if command == "z":
            x, y = x_start, y_start
        elif command == "L" and ends == [x, y] and last == "L":
            continue
        numbers = [_decimal(value - (y if i % 2 else x), places) for i, value in enumerate(ends)]
        joined = "".join(n if n[0] == "-" or not i else f" {n}" for i, n in enumerate(numbers))
        same = command == last and command != "M" or command == "L" and last == "M"
        out.append((("" if joined[:1] == "-" else " ") if same else command.lower()) + joined)
        if ends:
            x, y = ends[-2:]
        if command == "M":
            x_start, y_start = x, y
        last = command
    return "".join(out)
