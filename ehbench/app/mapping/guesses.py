"""What a column of a foreign log may be, by its unit, the words of its name and the rig's names."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.rates import SETTINGS, apart
from ehbench.data.readers import Source, SourceColumn, SourceTable
from ehbench.data.readers.clock import since_1970
from ehbench.preprocessing.sensors import ATMOSPHERE
from ehbench.vocabulary.messages import message
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si, is_of

CYLINDER, VALVE = "cylinder", "valve"  # where no rig says how they are called
AGAIN = 0.01  # share of the rows at most at which a clock begins again
DAYS_TICK = 2e-5  # below which a count from 20 000 on is of days, not of seconds
DIFFERENTIAL = ("psid", "bard")  # units of a pressure across something
CURRENTS = {"mA", "A"}


with Path(__file__).with_name("words.toml").open("rb") as _file:
    WORDS = {key: set(words) for key, words in tomllib.load(_file).items()}
_ENDS = ("p_supply", "p_tank", "p_rod", "p_head")
_PORTS = {"p": "p_supply", "t": "p_tank"}  # beside another word for pressure: Druck P
_LOOP = 25.0  # [mA] beyond which a current is no signal of 4 to 20 mA but that of a coil
# what compounds are made of: Systemdruck, Ventilstrom, supplypressure
_STEMS = tuple(
    word
    for key in (*_ENDS, "command", "pressure", "place", "angle", "speed", "time")
    for word in sorted(WORDS[key])
    if len(word) >= 4
)


@dataclass(frozen=True)
class Guess:
    """What a column may be: ``channel`` ('' where nothing is known), the unit of its numbers ('' of
    none), whether it goes into the map by itself, a remark, two points where its numbers are no
    volts, and the offset of an absolute pressure.
    """

    channel: str = ""
    unit: str = ""
    sure: bool = False
    remark: str = ""
    ends: tuple[str, str, str, str] | None = None
    offset: str = ""


def guessed(source: Source, rig: Rig | None) -> dict[str, Guess]:
    """A guess for each column, by name; a channel is given once."""
    results: dict[str, Guess] = {}
    taken: set[str] = set()
    for name, (i, j) in source.names().items():
        table = source.tables[i]
        guess = _guess(name, table.columns[j], table, rig)
        if guess.channel in taken:
            twice = message("app.as_well", channel=guess.channel)
            guess = Guess(guess.channel, guess.unit, False, twice, guess.ends)
        if guess.sure:
            taken.add(guess.channel if guess.channel != "t" else f"t of {table.name}")
        results[name] = guess
    return results


def _guess(name: str, column: SourceColumn, table: SourceTable, rig: Rig | None) -> Guess:
    unit, words = column.known_unit or column.absolute, words_of(name)
    if column.unit.strip("()[]").lower() in DIFFERENTIAL:
        words |= {"dp"}
    if table.name.startswith("/"):  # a topic is what its field is of
        words |= words_of(table.name)
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return Guess(remark=message("app.no_number_held"))
    if is_time := _time(column, unit, words, table):
        return is_time
    cylinder, sure = _cylinder(words, rig)
    if channel := reading_of(unit, words):
        place = channel if channel in ("p_supply", "p_tank") else f"{cylinder}.{channel}"
        alone = channel in ("p_supply", "p_tank")
        if not unit:
            return Guess(place, "", False, message("app.which_unit"))
        if VOCABULARY[channel].unit == "Pa" and (column.absolute or words & WORDS["absolute"]):
            offset = f"{from_si(-ATMOSPHERE, unit, VOCABULARY[channel]):.4g} {unit}"
            return Guess(place, unit, sure or alone, message("app.absolute"), None, offset)
        return Guess(
            place,
            unit,
            sure or alone,
            message("app.push_positive") if channel == "rod_force" else "",
        )
    if words & WORDS["command"] or (unit in (*CURRENTS, "V", "%") and unit):
        return command_guess(unit, words, known, (cylinder, sure), rig)
    return Guess(remark="")


def words_of(name: str) -> set[str]:
    """The words of a name, small: of ``PT-101 cylA [bar]`` pt, 101, cyl, a; and those that a word
    begins or ends with: of ``Systemdruck`` system and druck too; of ``p_P``, pressure at
    port P, pp.
    """
    plain = re.sub(r"[\[({][^\])}]*[\])}]\s*$", "", name)
    parts = re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain))
    words = {part.lower() for part in parts}
    words |= {"pp"} if [part.lower() for part in parts].count("p") > 1 else set()
    return words | {stem for stem in _STEMS for word in words if _made_of(word, stem)}


def _made_of(word: str, stem: str) -> bool:
    return word.startswith(stem) or word.endswith(stem)


def _time(column: SourceColumn, unit: str, words: set[str], table: SourceTable) -> Guess | None:
    """A column that may be the time: it goes on, and is called so or in seconds."""
    others = [item for item in table.columns if item is not column]
    rows = apart(others)[0][1] if others else np.ones(column.values.size, bool)
    values = column.values[np.isfinite(column.values) & rows]
    steps = np.diff(values)
    if not steps.size or values[0] == values[-1]:
        return None
    is_time = bool(unit) and is_of(unit, VOCABULARY["t"])
    if steps.min() < 0.0:
        if not (is_time and words & WORDS["time"] and np.mean(steps < 0.0) < AGAIN):
            return None
        return Guess("t", unit, False, message("app.time_goes_back"))
    lvm = words >= {"x", "value"}
    if not (is_time or lvm or (words & WORDS["time"] and not unit)):
        even = steps.min() > 0.0 and np.ptp(steps) < 1e-3 * steps.min() and steps[0] != 1.0
        even &= column is table.columns[0] and table.t is None and not unit
        return Guess("t", "s", False, message("app.rises_evenly")) if even else None
    if table.t is not None:
        return Guess(remark=message("app.time_known"))
    if np.mean(steps == 0.0) > SETTINGS.repeated:
        rate = (values.size - 1) / (values[-1] - values[0])
        note = message("app.time_rounded", rate=rate, unit=unit or "s")
        return Guess("t", unit or "s", False, note)
    tick = float(np.median(steps))
    if not is_time and tick < DAYS_TICK and since_1970(86400.0 * float(values[0]), True):
        return Guess("t", "d", True, message("app.days_guessed"))
    if not is_time:
        unit = "s" if tick < 0.1 else "ms" if tick < 100 else "us"
        return Guess("t", unit, True, message("app.unit_guessed"))
    still = int((steps == 0.0).sum())
    return Guess("t", unit, True, message("app.time_stands_still", count=still) if still else "")


def reading_of(unit: str, words: set[str]) -> str:
    """The quantity of a sensor, '' of none: by the unit, where it says none by the name."""

    def may(row: str, named: set[str]) -> bool:
        if row == "q" and unit == "%":  # a share is no angle
            return False
        return is_of(unit, VOCABULARY[row]) if unit else bool(words & named)

    if may("load_pressure", set()) and words & (WORDS["drop"] | WORDS["across"]):
        return "load_pressure"
    if may("p_head", WORDS["pressure"]):
        named = (
            words if words & WORDS["pressure"] else words - {"1", "2"}
        )  # AI2 is no second chamber
        named = named - {"pa"} if unit == "Pa" else named
        ends = (end for end in _ENDS if named & WORDS[end])
        ports = (end for letter, end in _PORTS.items() if {letter} < named)
        return next(ends, next(ports, ""))
    if unit and is_of(unit, VOCABULARY["command"]):
        return ""
    if may("rod_force", set()) and not words & WORDS["command"]:
        return "rod_force"
    for row, named in (
        ("v", WORDS["speed"]),
        ("qd", WORDS["speed"]),
        ("x", WORDS["place"]),
        ("q", WORDS["angle"]),
    ):
        if may(row, named) and (unit or row != "qd") and not words & WORDS["command"]:
            return row
    return ""


def _cylinder(words: set[str], rig: Rig | None) -> tuple[str, bool]:
    """(the cylinder that a name speaks of, whether that is sure)."""
    if rig is None:
        return CYLINDER, True
    names = [cylinder.name for cylinder in rig.cylinder]
    named = [name for name in names if words_of(name) <= words]
    if len(named) == 1 or len(names) == 1:
        return (named or names)[0], True
    return names[0], False


def command_guess(
    unit: str, words: set[str], known: np.ndarray, of: tuple[str, bool], rig: Rig | None
) -> Guess:
    """A command to a valve: its numbers, where they are no volts, as two points of the driver."""
    cylinder, sure = of
    valve, low, high = VALVE, -10.0, 10.0
    if rig is not None:
        own = next(item for item in rig.cylinder if item.name == cylinder)
        named = [item for item in own.valve if words_of(item.name) <= words]
        sure &= len(named) == 1 or len(own.valve) == 1
        if not own.valve:
            return Guess(remark=message("app.command_guessed"))
        chosen = (named or list(own.valve))[0]
        valve, low, high = chosen.name, float(chosen.command_min), float(chosen.command_max)
    word = "opening" if words & WORDS["spool"] else "command"
    channel = f"{cylinder}.{valve}.{word}"
    guessed_as = "app.opening_guessed" if word == "opening" else "app.command_guessed"
    if any(unit and unit != "%" and is_of(unit, VOCABULARY[row]) for row in ("x", "q")):
        return Guess(remark=message("app.commanded_position"))
    if unit and is_of(unit, VOCABULARY["command"]):
        return Guess(channel, unit, sure and bool(words & WORDS["command"]), message(guessed_as))
    spans = {"mA": (4.0, 20.0), "A": (0.004, 0.02), "%": (-100.0, 100.0)}
    if unit not in spans:
        return Guess(
            channel, unit, False, message("app.say_its_meaning", guess=message(guessed_as))
        )
    first, last = spans[unit]
    if unit == "mA" and known.min() < 3.0:
        first, last = (-20.0, 20.0) if known.min() < -0.5 else (0.0, 20.0)
    if unit == "mA" and known.max() > _LOOP:
        first, last = 50.0 * np.floor(known.min() / 50.0), 50.0 * np.ceil(known.max() / 50.0)
        if first < 0.0:  # of either sign, so none of it is rest
            first, last = -max(-first, last), max(-first, last)
    if unit == "%" and low >= 0.0:
        first = 0.0
    ends = (f"{first:g} {unit}", f"{last:g} {unit}", f"{low:g} V", f"{high:g} V")
    return Guess(channel, unit, sure, message("app.range_guessed"), ends)
