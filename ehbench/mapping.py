"""A draft of a map of columns: what a foreign file holds, and what each column may be.

A guess goes by the unit that the file says, the words in the column's name and the names in the
rig. What is not sure stands in the draft as a remark, for the user to decide."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ehbench.errors import EhbenchError, InputError
from ehbench.logs import read_record
from ehbench.quantities import VOCABULARY
from ehbench.readers import Column, Source, Table, open_source, reader_of
from ehbench.recipe.columns import ENDING
from ehbench.report.style import ACCENT, MUTED, canvas, thin
from ehbench.rig import Rig
from ehbench.units import is_of

_CYLINDER, _VALVE = "cylinder", "valve"  # where no rig says how they are called
_ROUNDED = "rounded"
_MOST_DRAWN = 24
_FEW = 0.01  # share of a column that may be bad and yet be left out by itself
_MARKS = {"\t": "tab", " ": "space"}
_TIME = {"t", "time", "zeit", "temps", "tiempo", "tempo", "timestamp", "zeitstempel", "uhrzeit"}
_TIME |= {"clock", "datetime", "seconds", "sec"}
_WORDS = {
    "p_supply": {"supply", "pump", "system", "sys", "ps", "versorgung", "pumpe", "sup"},
    "p_tank": {"tank", "return", "reservoir", "rücklauf", "drain"},
    "p_rod": {"b", "rod", "annulus", "annular", "ring", "stange", "stangenseite", "2", "p2"},
    "p_head": {"a", "head", "bore", "cap", "piston", "blind", "boden", "kolben", "1", "p1"},
}
_COMMAND = {"cmd", "command", "valve", "ventil", "servo", "spool", "setpoint", "soll", "u", "ao"}
_COMMAND |= {"ref", "drive", "joystick", "output", "sollwert", "stellgrösse", "input", "uv"}
_PRESSURE = {"p", "pt", "press", "pressure", "druck", "pression", "presion"}
_PLACE = {"x", "pos", "position", "stroke", "weg", "hub", "lvdt", "displacement", "length"}
_PLACE |= {"travel", "extension", "distance"}
_ANGLE = {"q", "angle", "winkel", "theta", "phi", "encoder", "joint", "rotation"}
_SPEED = {"v", "vel", "velocity", "speed", "geschwindigkeit", "rate", "xd", "qd"}
_CURRENTS = {"mA", "A"}
# what compounds are made of: Systemdruck, Ventilstrom, supplypressure
_STEMS = tuple(
    word
    for words in (*_WORDS.values(), _COMMAND, _PRESSURE, _PLACE, _ANGLE, _SPEED, _TIME)
    for word in sorted(words)
    if len(word) >= 4
)


@dataclass(frozen=True)
class Guess:
    """What a column may be: ``channel`` ('' where nothing is known), the unit of its numbers ('' of
    none), whether it goes into the map by itself, a remark, and two points where its numbers are no
    volts.
    """

    channel: str = ""
    unit: str = ""
    sure: bool = False
    remark: str = ""
    ends: tuple[str, str, str, str] | None = None


@dataclass(frozen=True)
class Draft:
    """A map as text, the picture that belongs to it, and what is to be said of both."""

    path: Path
    picture: Path
    lines: tuple[str, ...]


def draft(path: Path, out: Path | None = None, rig: Rig | None = None) -> Draft:
    """Look at a file and write a map of its columns with a picture of each.

    Args:
        path: the file.
        out: the map to write; ``<name>.map.toml`` here if None.
        rig: whose cylinders and valves the columns may be of.

    Raises:
        InputError: something stands there already.
        LogError: the file cannot be read.
    """
    stem = path.name.partition(".")[0] or path.name
    out = out or Path(stem + ENDING)
    picture = out.with_name(out.name.removesuffix(".toml").removesuffix(".map") + ".map.svg")
    for one in (out, picture):
        if one.exists() or one.is_symlink():
            raise InputError(
                "stands already; nothing was written", file=one, hint="name another by --out"
            )
    source = open_source(path)
    guesses = guessed(source, rig)
    text = drafted(path, source, guesses)
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(text)
        _draw(picture, source, guesses)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=out) from None
    said = _overview(path, source, guesses)
    return Draft(out, picture, (*said, *_tried(path, out, guesses, rig)))


def guessed(source: Source, rig: Rig | None) -> dict[str, Guess]:
    """A guess for each column, by name; a channel is given once."""
    found: dict[str, Guess] = {}
    taken: set[str] = set()
    for name, (i, j) in source.names().items():
        table = source.tables[i]
        guess = _guess(name, table.columns[j], table, rig)
        if guess.channel in taken:
            twice = f"{guess.channel} as well?"
            guess = Guess(guess.channel, guess.unit, False, twice, guess.ends)
        if guess.sure:
            taken.add(guess.channel if guess.channel != "t" else f"t of {table.name}")
        found[name] = guess
    return found


def _guess(name: str, column: Column, table: Table, rig: Rig | None) -> Guess:
    unit, words = column.known_unit, _words(name)
    if table.name.startswith("/"):  # a topic is what its field is of
        words |= _words(table.name)
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return Guess(remark="holds no number")
    if is_time := _time(column, unit, words, table):
        return is_time
    cylinder, sure = _cylinder(words, rig)
    if channel := _reading(unit, words):
        place = channel if channel in ("p_supply", "p_tank") else f"{cylinder}.{channel}"
        alone = channel in ("p_supply", "p_tank")
        if not unit:
            return Guess(place, "", False, "in which unit?")
        return Guess(place, unit, sure or alone, "")
    if words & _COMMAND or (unit in (*_CURRENTS, "V", "%") and unit):
        return _command(unit, words, known, (cylinder, sure), rig)
    return Guess(remark="")


def _words(name: str) -> set[str]:
    """The words of a name, small: of ``PT-101 cylA [bar]`` pt, 101, cyl, a; and those that a word
    begins or ends with: of ``Systemdruck`` system and druck too.
    """
    plain = re.sub(r"[\[({][^\])}]*[\])}]\s*$", "", name)
    parts = re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain))
    words = {part.lower() for part in parts}
    return words | {stem for stem in _STEMS for word in words if _made_of(word, stem)}


def _made_of(word: str, stem: str) -> bool:
    return word.startswith(stem) or word.endswith(stem)


def _time(column: Column, unit: str, words: set[str], table: Table) -> Guess | None:
    """A column that may be the time: it goes on, and is called so or in seconds."""
    values = column.values[np.isfinite(column.values)]
    steps = np.diff(values)
    if not steps.size or steps.min() < 0.0 or values[0] == values[-1]:
        return None
    is_time = bool(unit) and is_of(unit, VOCABULARY["t"])
    lvm = words >= {"x", "value"}
    if not (is_time or lvm or (words & _TIME and not unit)):
        even = steps.min() > 0.0 and np.ptp(steps) < 1e-3 * steps.min() and steps[0] != 1.0
        even &= column is table.columns[0] and table.t is None and not unit
        return Guess("t", "s", False, "rises evenly: the time?") if even else None
    if table.t is not None:
        return Guess(remark="the file knows its time without it")
    if steps.min() == 0.0:
        rate = (values.size - 1) / (values[-1] - values[0])
        return Guess(
            "t", unit or "s", False, f"{_ROUNDED}; about {rate:.5g} samples a {unit or 's'}"
        )
    tick = float(np.median(steps))
    if not is_time:
        unit = "s" if tick < 0.1 else "ms" if tick < 100 else "us"
        return Guess("t", unit, True, "the unit is a guess")
    return Guess("t", unit, True)


def _reading(unit: str, words: set[str]) -> str:
    """The quantity of a sensor, '' of none: by the unit, where it says none by the name."""

    def may(row: str, named: set[str]) -> bool:
        return is_of(unit, VOCABULARY[row]) if unit else bool(words & named)

    if may("p_head", _PRESSURE):
        named = words if words & _PRESSURE else words - {"1", "2"}  # AI2 is no second chamber
        ends = (end for end in ("p_supply", "p_tank", "p_rod", "p_head") if named & _WORDS[end])
        return next(ends, "")
    if unit and is_of(unit, VOCABULARY["command"]):
        return ""
    for row, named in (("v", _SPEED), ("qd", _SPEED), ("x", _PLACE), ("q", _ANGLE)):
        if may(row, named) and (unit or row != "qd") and not words & _COMMAND:
            return row
    return ""


def _cylinder(words: set[str], rig: Rig | None) -> tuple[str, bool]:
    """(the cylinder that a name speaks of, whether that is sure)."""
    if rig is None:
        return _CYLINDER, True
    names = [cylinder.name for cylinder in rig.cylinder]
    named = [name for name in names if _words(name) <= words]
    if len(named) == 1 or len(names) == 1:
        return (named or names)[0], True
    return names[0], False


def _command(
    unit: str, words: set[str], known: np.ndarray, of: tuple[str, bool], rig: Rig | None
) -> Guess:
    """A command to a valve: its numbers, where they are no volts, as two points of the driver."""
    cylinder, sure = of
    valve, low, high = _VALVE, -10.0, 10.0
    if rig is not None:
        own = next(one for one in rig.cylinder if one.name == cylinder)
        named = [one for one in own.valve if _words(one.name) <= words]
        sure &= len(named) == 1 or len(own.valve) == 1
        if not own.valve:
            return Guess(remark="a command?")
        chosen = (named or list(own.valve))[0]
        valve, low, high = chosen.name, float(chosen.command_min), float(chosen.command_max)
    channel = f"{cylinder}.{valve}.command"
    if unit and is_of(unit, VOCABULARY["command"]):
        return Guess(channel, unit, sure and bool(words & _COMMAND), "a command?")
    spans = {"mA": (4.0, 20.0), "A": (0.004, 0.02), "%": (-100.0, 100.0)}
    if unit not in spans:
        return Guess(channel, unit, False, "a command? say what its numbers mean at the valve")
    first, last = spans[unit]
    if unit == "mA" and known.min() < 3.0:
        first, last = (-20.0, 20.0) if known.min() < -0.5 else (0.0, 20.0)
    if unit == "%" and low >= 0.0:
        first = 0.0
    ends = (f"{first:g} {unit}", f"{last:g} {unit}", f"{low:g} V", f"{high:g} V")
    return Guess(channel, unit, sure, "the range is a guess: see the driver", ends)


# --- the map as a file
# -------------------------------------------------------------------------------------------------


def drafted(path: Path, source: Source, guesses: dict[str, Guess]) -> str:
    """The draft of a map as TOML: what is sure as keys, the rest as remarks."""
    lines = [
        f"# What the columns of {_remark(path.name)} are: a draft. Look at each line, "
        "then name this file",
        '# in a recipe above its tables:  columns = "<this file>"',
        "",
        *_dialect(source),
        *_rate(source, guesses),
        *_policy(source, guesses),
        "",
        "[names]",
    ]
    for name, (i, j) in source.names().items():
        lines.append(_line(name, guesses[name], source.tables[i].columns[j]))
    return "\n".join(lines) + "\n"


def _dialect(source: Source) -> list[str]:
    """The keys of a text file."""
    found = source.dialect
    if found.separator is None:
        return []
    keys = {
        "separator": _MARKS.get(found.separator, found.separator),
        "decimal": found.decimal,
        "skip": found.skip,
        "unit_row": found.unit_row,
        "encoding": found.encoding,
    }
    return [f"{key} = {json.dumps(value)}" for key, value in keys.items()]


def _rate(source: Source, guesses: dict[str, Guess]) -> list[str]:
    """The key ``rate``, where no table has a time."""
    names = source.names()
    timed = {
        names[name][0] for name, guess in guesses.items() if guess.channel == "t" and guess.sure
    }
    if timed or any(table.t is not None for table in source.tables):
        return []
    for name, guess in guesses.items():
        if guess.channel == "t" and guess.remark.startswith(_ROUNDED):
            values = source.tables[names[name][0]].columns[names[name][1]].values
            scale = {"ms": 1e-3, "us": 1e-6}.get(guess.unit, 1.0)
            rate = (values.size - 1) / (np.nanmax(values) - np.nanmin(values)) / scale
            return [
                f'rate = "{rate:.6g} Hz"                 # from {_remark(name)}, which is rounded'
            ]
    return ['# rate = "1 kHz"              # no column is the time: say how often it was sampled']


def _policy(source: Source, guesses: dict[str, Guess]) -> list[str]:
    """The key ``bad_samples``, where cells of the mapped columns hold no number."""
    counts, size = {}, 0
    for name, (i, j) in source.names().items():
        values = source.tables[i].columns[j].values
        size = max(size, values.size)
        bad = int((~np.isfinite(values)).sum())
        if bad and guesses[name].sure:
            counts[name] = bad
    if not counts:
        return []
    places = ", ".join(f"{count} in {_remark(name)}" for name, count in counts.items())
    few = max(counts.values()) <= max(_FEW * size, 1)
    key = 'bad_samples = "leave out"' if few else '# bad_samples = "leave out"'
    return [f"{key}     # blank, or no number: {places}"]


def _line(name: str, guess: Guess, column: Column) -> str:
    """A line of the map; a remark where nothing sure is known."""
    key, unit = _quoted(name), f" [{guess.unit}]" if guess.unit else ""
    if guess.ends is not None:
        first, last, low, high = guess.ends
        value = (
            f'{{ channel = "{guess.channel}", from = ["{first}", "{last}"], '
            f'to = ["{low}", "{high}"] }}'
        )
    else:
        value = _quoted((guess.channel or "?") + unit)
    said = ", ".join(part for part in (_range(column), guess.remark) if part)
    return f"{'' if guess.sure else '# '}{key} = {value}    # {said}"


def _range(column: Column) -> str:
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return "no number"
    unit = f" {column.known_unit or _remark(column.unit)}".rstrip()
    return f"{known.min():.4g} … {known.max():.4g}{unit}"


def _quoted(text: str) -> str:
    """A text of the file as TOML has it."""
    escaped = {'"': '\\"', "\\": "\\\\"}
    plain = (escaped.get(c, c) if c.isprintable() else f"\\U{ord(c):08x}" for c in text)
    return '"' + "".join(plain) + '"'


def _remark(text: str) -> str:
    """A text of the file as a remark may hold it."""
    return "".join(c if c.isprintable() else " " for c in text)[:60]


# --- what is said and drawn
# -------------------------------------------------------------------------------------------------


def _overview(path: Path, source: Source, guesses: dict[str, Guess]) -> list[str]:
    """What was found, a line a column."""
    names, found = source.names(), source.dialect
    lines = [f"{path.name}: {reader_of(path).name}"]
    if found.separator is not None:
        mark = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "white space"}[found.separator]
        sign = "comma" if found.decimal == "," else "point"
        header = f"header in line {(found.skip or 0) + 1}"
        units = ", units below it" if found.unit_row else ""
        lines[0] += f", {found.encoding}, separated by {mark}, decimal {sign}, {header}{units}"
    for index, table in enumerate(source.tables):
        called = f"table '{table.name}'" if table.name else "table"
        lines.append(f"{called}: {table.size} rows{_span(table, index, names, guesses)}")
        wide = max((len(name) for name, at in names.items() if at[0] == index), default=0)
        for name, (i, j) in names.items():
            if i != index:
                continue
            guess, column = guesses[name], table.columns[j]
            unit = f" [{guess.unit}]" if guess.unit and guess.channel and not guess.ends else ""
            said = f"{guess.channel}{unit}" + ("" if guess.sure else "?") if guess.channel else "?"
            bad = int((~np.isfinite(column.values)).sum())
            odd = f", {bad} no number" if bad else ""
            remark = f"  ({guess.remark})" if guess.remark else ""
            lines.append(f"  {name:<{min(wide, 40)}}  {_range(column)}{odd}  → {said}{remark}")
    return [*lines, *source.losses]


def _span(
    table: Table, index: int, names: dict[str, tuple[int, int]], guesses: dict[str, Guess]
) -> str:
    """How long a table is and how often it was sampled, as far as that is known."""
    t = table.t
    for name, (i, j) in names.items():
        if i == index and guesses[name].channel == "t" and t is None:
            scale = {"ms": 1e-3, "us": 1e-6, "min": 60.0}.get(guesses[name].unit, 1.0)
            t = table.columns[j].values * scale
    if t is None or t.size < 2:
        return ""
    step = float(np.nanmedian(np.diff(t)))
    rate = f", {1 / step:.5g} Hz" if step > 0.0 else ""
    return f", {np.nanmax(t) - np.nanmin(t):.5g} s{rate}"


def _tried(path: Path, out: Path, guesses: dict[str, Guess], rig: Rig | None) -> list[str]:
    """Whether the draft takes the file as it stands, and what to do next."""
    lines = []
    if rig is None and any(_CYLINDER in guess.channel for guess in guesses.values()):
        lines.append(
            f"no rig was given: put the names of your rig in place of '{_CYLINDER}' and "
            f"'{_VALVE}', or call it with --rig"
        )
    if not any(guess.sure and guess.channel != "t" for guess in guesses.values()):
        return [*lines, f"next: say in {out} which columns are which channels"]
    try:
        record = read_record(path, columns=out)
    except EhbenchError as error:
        return [*lines, f"not yet: {error}"]
    lines.append(f"taken with this map: {record!r}")
    lines += [f"  {loss}" for loss in record.losses]
    return [
        *lines,
        f"next: look at {out} and its picture, then name it in the recipe, from where that lies: "
        f'columns = "{out.name}"',
    ]


def _draw(picture: Path, source: Source, guesses: dict[str, Guess]) -> None:
    """Each column over the time, or over its rows."""
    names = source.names()
    shown = [name for name, guess in guesses.items() if guess.channel != "t"]
    shown = [one for one in shown if np.isfinite(_column(source, names[one]).values).any()]
    shown = shown[:_MOST_DRAWN] or list(names)[:1]
    rows = len(shown)
    with canvas(picture, rows, 1, (7.2, 1.35 * rows + 0.5), squeeze=False) as (_, axes):
        for ax, name in zip(axes[:, 0], shown):
            index = names[name][0]
            table, column = source.tables[index], _column(source, names[name])
            across, t = "row", np.arange(column.values.size, dtype=float)
            if table.t is not None:
                across, t = "time [s]", table.t
            for other, guess in guesses.items():
                if table.t is None and guess.channel == "t" and names[other][0] == index:
                    across, t = f"time [{guess.unit}]", _column(source, names[other]).values
            good = np.isfinite(t)
            ax.plot(*thin(t[good], column.values[good]))
            guess = guesses[name]
            label = f" → {guess.channel}{'' if guess.sure else ' ?'}" if guess.channel else ""
            label += " (red: no number)" if _bad(column) else ""
            unit = column.known_unit or column.unit
            ax.set_title(_remark(name) + label, color="black" if guess.sure else MUTED)
            ax.set_ylabel(unit or "–")
            ax.set_xlabel(across)
            for at in _bad(column):
                ax.axvline(t[at], color=ACCENT, linewidth=0.8)


def _column(source: Source, at: tuple[int, int]) -> Column:
    return source.tables[at[0]].columns[at[1]]


def _bad(column: Column) -> Sequence[int]:
    """Rows of a few bad samples, to be marked."""
    return np.flatnonzero(~np.isfinite(column.values))[:20].tolist()
