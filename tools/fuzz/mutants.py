"""Inputs made wrong on purpose: by bytes, by lines, and by what people and programs write."""

import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from zlib import crc32

NUMBERS = (
    *"0|-0|-1|1e-300|1e300|1e400|-1e400|nan|inf|-inf|+5|5.|.5|1_000|0x10|1,5|1e|e5|٣|１２".split(
        "|"
    ),
    "9" * 400,
    "9" * 5000,
    *"1e-9|1e9|²|1 2|--1|1.5.2|true|1979-05-27|99999999999999999999".split("|"),
)
UNITS = (
    *(
        "|m|mm|bar|psi|kPa|L/min|gpm|V|s|kg|N*m|rad/s|deg|degC|Hz|%|mL/min/bar|m*9**9**9|"
        "9**9**9*s|m^2^2^2|((((m))))|1/0|m**-9|furlong|√Pa|m·s|°|in|__import__('os')|m\x00|"
        "m\n|µm|1e99|lambda|(m|m)|m//s"
    ).split("|"),
    "a" * 500,
    *"degC*m|dB|pi|percent|1/s/s/s/s/s/s/s".split("|"),
)
TEXTS = (
    *"| |x|../..|/etc/passwd|/dev/zero|.|$\\frac{$|<script>|a\\u0000b".split("|"),
    "a" * 5000,
    *"none|boom|{}|%s%n|press.servo|ü|\\ud800|\\n|‮|NaN".split("|"),
)
VALUES = (
    *'[]|{}|true|1|-1|1e400|nan|""|[[]]|{ a = { b = 1 } }|["1 m"]'.split("|"),
    "[" * 300 + "]" * 300,
    *(
        '{ value = 1 }|{ value = "1 m", std = "-1 m" }|1979-05-27|"1 m"|"5 m*9**9**9"|'
        '"-5 bar"|"0 kg"|"1e6 s"|"1e-9 m/s^2"|"1e-9 mm/s"'
    ).split("|"),
)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_UNIT = re.compile(r"(?<=[\d\[ ])\s?[a-zA-Z/*^µ]+[\w/*^().]*(?=[\"\]])")
_QUOTED = re.compile(r'"[^"\n]*"')
_VALUE = re.compile(r"(?<==)[^\n#]+")
Change = Callable[[str, Random, Sequence[str]], str]


def _swapped(pattern: re.Pattern[str], choices: Sequence[str], quote: str = "") -> Change:
    def change(text: str, rng: Random, _: Sequence[str]) -> str:
        found = list(pattern.finditer(text))
        if not found:
            return text
        one = rng.choice(found)
        return text[: one.start()] + quote + rng.choice(choices) + quote + text[one.end() :]

    return change


def _lines(text: str, rng: Random, corpus: Sequence[str]) -> str:
    """A line gone, doubled, moved, or one of another file in its place."""
    lines = text.splitlines()
    if not lines:
        return text
    at, kind = rng.randrange(len(lines)), rng.randrange(5)
    line = lines.pop(at)
    if kind == 1:
        lines[at:at] = [line, line]
    elif kind == 2:
        lines.insert(rng.randrange(len(lines) + 1), line)
    elif kind == 3:
        lines.insert(at, rng.choice(rng.choice(corpus).splitlines() or [""]))
    elif kind == 4:
        lines = lines[: rng.randrange(len(lines) + 1)]
    return "\n".join(lines) + "\n"


def characters(text: str, rng: Random, _: Sequence[str] = ()) -> str:
    """Some characters gone, doubled or replaced."""
    at, size = rng.randrange(len(text) + 1), rng.choice((1, 1, 2, 10, 200))
    some = ("", "", chr(rng.randrange(32, 127)), text[at : at + size] * 2, "\r\n", "." * size)
    new = rng.choice((*some, "[" * 2000, *"\x00\ufeff\"'[]=#,;\t\u2028é"))
    return text[:at] + new + text[at + size :]


def _spliced(text: str, rng: Random, corpus: Sequence[str]) -> str:
    other = rng.choice(corpus)
    return text[: rng.randrange(len(text) + 1)] + other[rng.randrange(len(other) + 1) :]


def _renamed(text: str, rng: Random, corpus: Sequence[str]) -> str:
    """A word in place of another one of the same file, everywhere or once."""
    words = sorted(set(re.findall(r"[A-Za-z_]{2,}", text)))
    if len(words) < 2:
        return text
    old, new = rng.choice(words), rng.choice(words)
    return text.replace(old, new, rng.choice((1, -1)))


CHANGES: tuple[Change, ...] = (
    _swapped(_NUMBER, NUMBERS),
    _swapped(_NUMBER, NUMBERS),
    _swapped(_UNIT, UNITS),
    _swapped(_QUOTED, TEXTS, '"'),
    _swapped(_VALUE, VALUES),
    _swapped(_VALUE, VALUES),
    _lines,
    _lines,
    characters,
    _spliced,
    _renamed,
)


def text_mutant(corpus: Sequence[str], rng: Random) -> bytes:
    """One of the texts with one to four changes."""
    text = rng.choice(corpus)
    for _ in range(rng.choice((1, 1, 2, 4))):
        text = rng.choice(CHANGES)(text, rng, corpus)
    data = text.encode("utf-8", "surrogatepass")
    return bytes_mutant([data], rng) if rng.random() < 0.05 else data


def bytes_mutant(corpus: Sequence[bytes], rng: Random) -> bytes:
    """One of the files with bits flipped, bytes gone, doubled or zeroed, or its end cut off."""
    data = bytearray(rng.choice(corpus))
    for _ in range(rng.choice((1, 1, 2, 8))):
        at, size = rng.randrange(len(data) + 1), rng.choice((1, 4, 9, 64, 1000))
        kind = rng.randrange(8)
        if kind <= 2 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 3:
            del data[at : at + size]
        elif kind == 4:
            data[at:at] = data[at : at + size]
        elif kind == 5:
            data[at : at + size] = bytes(len(data[at : at + size]))
        elif kind == 6:
            data[at : at + 8] = struct.pack("<Q", rng.choice((0, 1, 2**31, 2**63, 2**64 - 1)))
        else:
            del data[at:]
    return bytes(data)


def _records(data: bytes) -> list[bytes]:
    found, at = [], 8
    while at + 9 <= len(data) - 8:
        stop = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
        found.append(data[at:stop])
        at = stop
    return found


def mcap_mutant(corpus: Sequence[bytes], rng: Random) -> bytes:
    """A log with wrong bytes, records lost, doubled or moved, odd texts; checksums right."""
    kind = rng.randrange(4)
    data = rng.choice(corpus)
    if kind <= 1:
        return bytes_mutant([data], rng)
    records = _records(data)
    if kind == 2:
        for _ in range(rng.choice((1, 3))):
            at, to = rng.randrange(len(records)), rng.randrange(len(records))
            records[to : to + rng.randrange(2)] = [records[at]]
    else:
        at = rng.choice([i for i, one in enumerate(records) if one[0] in (0x09, 0x0C)] or [0])
        body = bytearray(text_mutant([records[at][9:].decode("latin-1")], rng))
        if records[at][0] == 0x09 and len(body) > 4:
            body[-4:] = struct.pack("<I", crc32(bytes(body[:-4])))
        records[at] = records[at][:1] + struct.pack("<Q", len(body)) + bytes(body)
    return data[:8] + b"".join(records) + data[-8:]
