"""Saved figures made small: the same picture in a third of the bytes."""

import re
from functools import lru_cache
from xml.etree import ElementTree

FONTS = "DejaVu Sans, Verdana, sans-serif"  # drawn for the first; the second is as wide
_SVG = "{http://www.w3.org/2000/svg}"
_LINK = "{http://www.w3.org/1999/xlink}href"
_XML = "{http://www.w3.org/XML/1998/namespace}"

# what a figure is drawn with; a saved one may come from anyone
_ELEMENTS = frozenset(
    "svg g defs clipPath path rect circle ellipse line polyline polygon text tspan use marker "
    "symbol title desc linearGradient radialGradient stop pattern image".split()
)
_ATTRIBUTE = re.compile(r"(?!on)[a-zA-Z][-\w]*(?::\w+)?", re.I)
_IMAGE = re.compile(r"data:image/(?:png|jpeg);base64,[\w+/=\s]*")
_FETCHES = re.compile(r"url\(\s*(?!#)|[{}<>@\\]|/\*|expression|javascript", re.I)


def sound(svg: str) -> ElementTree.Element:
    """A saved figure without anything that is no drawing: scripts, handlers of events, links out of
    the page, styles that fetch.

    Raises:
        ValueError: it is no SVG."""
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
    waiting = [root]
    while waiting:
        item = waiting.pop()
        for name in [name for name, value in item.attrib.items() if not _harmless(name, value)]:
            del item.attrib[name]
        for inner in list(item):
            tag = inner.tag if isinstance(inner.tag, str) else ""
            if tag.removeprefix(_SVG) in _ELEMENTS and tag.startswith(_SVG):
                waiting.append(inner)
            else:
                item.remove(inner)
    return root


def _harmless(name: str, value: str) -> bool:
    """Whether an attribute only draws."""
    if name in (_LINK, "href"):
        return value.startswith("#") or bool(_IMAGE.fullmatch(value))
    if name.startswith(_XML):
        return True
    if not _ATTRIBUTE.fullmatch(name):
        return False
    if "url" in value.lower() or name == "style":
        return not _FETCHES.search(value)
    return "javascript:" not in value.lower()


def shrink(svg: str) -> str:
    """matplotlib's SVG without what nobody sees: a tenth of a point, empty groups, names that
    nothing points to. Text stays text, in `FONTS`. Markers keep a hundredth of a point."""
    pointed = dict.fromkeys(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))
    used = {name: f"i{place}" for place, name in enumerate(pointed)}
    root = ElementTree.fromstring(svg)
    body = ElementTree.Element("g", {"font-family": FONTS, "stroke-linejoin": "round"})
    body.extend(_shrunk(root, used, 1))
    head = "".join(f' {name}="{root.get(name)}"' for name in ("width", "height", "viewBox"))
    inside = ElementTree.tostring(body, encoding="unicode")
    return f'<svg xmlns="http://www.w3.org/2000/svg"{head}>{inside}</svg>\n'


def _shrunk(element: ElementTree.Element, used: dict[str, str], places: int) -> list:
    """The children of an element; those of a group that says nothing stand in its place."""
    results: list[ElementTree.Element] = []
    for item in element:
        tag, attributes = item.tag.removeprefix(_SVG), {}
        if tag in ("metadata", "style"):
            continue
        for name, value in item.attrib.items():
            if name == "d":
                value = _path(value, places)
            elif name == "style":
                parts = (part for part in value.split("; ") if not part.startswith("font-family"))
                value = ";".join(parts).replace(": ", ":")
            elif name in ("x", "y", "width", "height"):
                value = _decimal(round(float(value) * 10**places), places)
            elif name == "transform":
                value = "" if "rotate(-0 " in value else re.sub(r"(\.\d)\d+", r"\1", value)
            elif name == "id":
                value = used.get(value, "")
            value = re.sub(r"(?<=url\(#)[^)]+", lambda match: used[match[0]], value)
            if name == _LINK:
                name = "href"
                value = f"#{used[value[1:]]}" if value.startswith("#") else value.replace(" ", "")
            if value:
                attributes[name] = value
        inner = _shrunk(item, used, 2 if tag == "defs" else places)
        if tag == "g" and not attributes:
            results += inner
        elif inner or tag not in ("g", "defs"):
            retained = ElementTree.Element(tag, attributes)
            retained.text = item.text if tag == "text" else None
            retained.extend(inner)
            results.append(retained)
    return results


@lru_cache(1 << 16)  # a figure's points lie close to each other: the same steps, over and over
def _decimal(value: int, places: int) -> str:
    """An integer count of ``10**-places`` as the shortest decimal number."""
    text = f"{value / 10**places:.{places}f}".rstrip("0").rstrip(".")
    return re.sub(r"^(-?)0\.", r"\1.", text) if text not in ("-0", "") else "0"


def _path(text: str, places: int) -> str:
    """A path in relative coordinates; rounded where it is, so that errors do not add up."""
    pairs, out, last = {"M": 1, "L": 1, "Q": 2, "C": 3, "z": 0}, [], ""
    tokens = iter(re.findall(r"[MLCQz]|-?[\d.]+(?:e-?\d+)?", text))
    start = here = [0, 0]
    for command in tokens:
        ends = [round(float(next(tokens)) * 10**places) for _ in range(2 * pairs[command])]
        if command == last == "L" and ends == here:
            continue
        steps = (_decimal(value - here[i % 2], places) for i, value in enumerate(ends))
        same = command == last and command != "M" or command == "L" and last == "M"
        out.append(" ".join(["" if same else command.lower(), *steps]))
        here = ends[-2:] or start
        start = here if command == "M" else start
        last = command
    # a blank between numbers, where no minus and no letter parts them
    return re.sub(r" +(?=[-a-z])|(?<=[a-z]) +", "", "".join(out)).strip()
