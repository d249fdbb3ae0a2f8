"""What a column of a foreign log may be, by its unit, the words of its name and the rig's names.

Each piece of evidence has a weight. A quantity or a place that words name in full is certain, a
port's letter or number, or a unit alone, makes it likely. What contradicts, or fits several,
leaves a column undecided."""

import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import READING_WORDS
from ehbench.config.rig import Cylinder, Rig
from ehbench.data.rates import SETTINGS, apart, is_bad
from ehbench.data.readers import Source, SourceColumn, SourceTable
from ehbench.data.readers.clock import since_1970
from ehbench.preprocessing.sensors import ATMOSPHERE
from ehbench.signals.timestamps import rate_of_rounded, resolution, unrounded, unwrapped
from ehbench.vocabulary import VOCABULARY, from_si, message, setting, to_si
from ehbench.vocabulary.units import is_of, is_share, named_unit

CYLINDER, VALVE = "cylinder", "valve"  # where no rig says how they are called
CERTAIN, LIKELY, UNDECIDED = "certain", "likely", "undecided"  # of two the later is less certain
DIFFERENTIAL = ("psid", "bard")  # units of a pressure across something
CURRENTS = {"mA", "A"}
# of valve drivers, in their unit
_FULL_SCALES = (10, 20, 25, 30, 40, 50, 60, 75, 80, 100, 150, 200, 250, 300, 400, 500, 600, 800)


with Path(__file__).with_name("words.toml").open("rb") as _file:
    WORDS = {key: set(words) for key, words in tomllib.load(_file).items()}
_ENDS = ("p_supply", "p_tank", "p_rod", "p_head")
# what compounds are made of: Systemdruck, Ventilstrom, supplypressure
_STEMS = tuple(
    word
    for key in (*_ENDS, "command", "pressure", "place", "angle", "speed", "time")
    for word in sorted(WORDS[key])
    if len(word) >= 4 and word not in WORDS["whole"]
)


# quantities of sensors, their words, and whether a unit alone may say so
_SENSORS = (
    ("rod_force", "force", True),
    ("v", "speed", False),
    ("qd", "speed", False),
    ("x", "place", True),
    ("q", "angle", True),
)


@dataclass(frozen=True)
class GuessSettings:
    """Numbers by which a draft decides."""

    again: float = setting(0.01, "", "share of rows at which a clock begins again", "restarts")
    days: float = setting(2e-5, "d", "step below which a count from 20 000 on is of days", "2 s")
    loop: float = setting(25.0, "mA", "current from which it is that of a coil", "4 to 20 mA")
    even: float = setting(0.01, "", "share by which a mean step may be off the median", "rounding")
    slow: float = setting(
        0.09, "s", "step of a time without a unit from which it may be in ms", "10 rows a second"
    )
    few: float = setting(0.01, "", "share of bad cells that a draft leaves out", "faults are rare")


LIMITS = GuessSettings()


@dataclass(frozen=True)
class Guess:
    """What a column may be: ``channel`` ('' where nothing is known), the unit of its numbers ('' of
    none), how certain that is, a remark, two points where its numbers are no volts, the offset of
    an absolute pressure, why, and the drop at which a column of flows was read."""

    channel: str = ""
    unit: str = ""
    certainty: str = UNDECIDED
    remark: str = ""
    ends: tuple[str, str, str, str] | None = None
    offset: str = ""
    why: tuple[str, ...] = ()
    drop: str = ""

    @property
    def sure(self) -> bool:
        """Whether it goes into the map by itself."""
        return self.certainty != UNDECIDED


def guessed(source: Source, rig: Rig | None) -> dict[str, Guess]:
    """A guess for each column, by name; only the most certain column of a channel has it."""
    results: dict[str, Guess] = {}
    for name, (i, j) in source.names().items():
        table = source.tables[i]
        guess = _guess(name, table.columns[j], table, rig)
        column, row = table.columns[j], guess.channel.rpartition(".")[2]
        if column.doubt is not None:
            guess = replace(guess, certainty=UNDECIDED, remark=column.doubt[1])
        elif guess.sure and guess.channel != "t" and guess.ends is None and row in VOCABULARY:
            values = to_si(column.values[np.isfinite(column.values)], guess.unit, VOCABULARY[row])
            if np.mean(is_bad(guess.channel, values)) > LIMITS.few:
                note = message("app.out_of_range", unit=guess.unit)
                guess = replace(guess, certainty=UNDECIDED, remark=note)
        results[name] = guess
    _without_rivals(results)
    for index, table in enumerate(source.tables):
        times = [name for name, at in source.names().items() if at[0] == index]
        for name, after in zip(times, times[1:]):  # two side by side: the nearer is the time
            if results[name].channel == results[after].channel == "t" and results[after].sure:
                note = message("app.time_known")
                results[name] = replace(results[name], certainty=UNDECIDED, remark=note)
    return results


def _without_rivals(results: dict[str, Guess]) -> None:
    """Leave undecided what another column is at least as certainly."""
    every = [(guess.channel, guess.drop, guess.certainty) for guess in results.values()]
    for name, guess in results.items():
        of = guess.channel, guess.drop
        rivals = sum(
            of == (channel, drop) and level <= guess.certainty for channel, drop, level in every
        )
        if guess.sure and guess.channel != "t" and rivals > 1:
            note = message("app.as_well", channel=guess.channel)
            results[name] = replace(guess, certainty=UNDECIDED, remark=note)


def _guess(name: str, column: SourceColumn, table: SourceTable, rig: Rig | None) -> Guess:
    plain, _, count = column.name.rpartition(" ")
    again = count.isdigit() and plain in (item.name for item in table.columns)
    # the number of a name that comes again is that of no port
    unit = column.known_unit or column.absolute
    words = words_of(plain if again else column.name)
    if name != column.name:  # the number of a run is that of no port
        words |= {word for word in words_of(table.name) if not word.isdigit()}
    if column.unit.strip("()[]").lower() in DIFFERENTIAL:
        words |= {"dp"}
    if table.name.startswith("/"):  # a topic is what its field is of
        words |= words_of(table.name)
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return Guess(remark=message("app.no_number_held"))
    if is_time := _time(column, unit, words, table):
        return is_time
    sensor = words & (WORDS["pressure"] | WORDS["angle"] | WORDS["force"] | WORDS["sensed"])
    driven = unit in (*CURRENTS, "V", "%")
    if driven and sensor and not words & WORDS["commanded"]:
        return Guess(unit=unit, remark=message("app.sensor_signal", unit=unit))
    channel, certainty, why = reading_of(unit, words)
    if unit:
        why = (message("app.why_unit", unit=unit), *why)
    if channel:
        return _placed(channel, certainty, why, (column, unit, words), rig)
    valves = [item for _, item in rig.valves()] if rig and driven else []
    named = any(words_of(item.name) <= words for item in valves)
    if named or words & WORDS["command"] or (driven and words & WORDS["command_port"]):
        return command_guess(unit, words, known, rig)
    if is_share(unit) and sensor:
        return Guess(unit=unit, remark=message("app.sensor_signal", unit=unit))
    is_pressure = bool(unit) and is_of(unit, VOCABULARY["p_head"])
    return Guess(unit=unit, remark=message("app.which_port" if is_pressure else "app.no_word"))


def _placed(
    channel: str,
    certainty: str,
    why: tuple[str, ...],
    of: tuple[SourceColumn, str, set[str]],
    rig: Rig | None,
) -> Guess:
    """A reading at its place on the rig."""
    column, unit, words = of
    if channel in ("p_supply", "p_tank"):
        place, where = channel, ()
    else:
        cylinder, known, where = _cylinder(words, rig)
        place = f"{cylinder}.{channel}"
        certainty = max(certainty, known)
    if not unit:
        return Guess(place, "", UNDECIDED, message("app.which_unit"), why=(*why, *where))
    remark, offset = "", ""
    if VOCABULARY[channel].unit == "Pa" and (column.absolute or words & WORDS["absolute"]):
        remark = message("app.absolute")
        offset = f"{from_si(-ATMOSPHERE, unit, VOCABULARY[channel]):.4g} {unit}"
    if channel == "rod_force":
        remark = message("app.push_positive")
    if certainty == UNDECIDED and not remark and place.startswith(f"{CYLINDER}.") and rig:
        names = ", ".join(cylinder.name for cylinder in rig.cylinder)
        remark = message("app.which_cylinder", names=names)
    return Guess(place, unit, certainty, remark, None, offset, (*why, *where))


def words_of(name: str) -> set[str]:
    """The words of a name, small: of ``PT-101 cylA [bar]`` pt, 101, cyl, a; and those that a word
    begins or ends with: of ``Systemdruck`` system and druck too; of ``p_P``, pressure at
    port P, pp. A letter or number behind ``channel`` or ``AI`` counts the recorder's channels."""
    plain = re.sub(r"[\[({][^\])}]*[\])}]\s*$", "", name)
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])(?!Sec)", " ", plain)  # mSec are no seconds
    parts = re.findall(r"[^\W\d_]+|\d+", spaced)
    parts = [part.lower() for part in parts]
    parts = [
        part
        for at, part in enumerate(parts)
        if parts[at - 1 : at] not in _COUNTED or not (part.isdigit() or len(part) == 1)
    ]
    words = set(parts) | ({"pp"} if parts.count("p") > 1 else set())
    ends = {
        (stem, word.startswith(stem) or word.endswith(stem)) for stem in _STEMS for word in words
    }
    return words | {stem for stem, is_part in ends if is_part}


_COUNTED = [[word] for word in WORDS["counted"]]


def _time(column: SourceColumn, unit: str, words: set[str], table: SourceTable) -> Guess | None:
    """A column that may be the time: it goes on, and is called so or in seconds."""
    if not unit:  # micros, millis, seconds
        units = map(named_unit, sorted(words & WORDS["time"]))
        unit = next((item for item in units if item and is_of(item, VOCABULARY["t"])), "")
    is_time = bool(unit) and is_of(unit, VOCABULARY["t"])
    named = is_time or words >= {"x", "value"} or (words & WORDS["time"] and not unit)
    unnamed = bool(re.fullmatch(r"column \d+", column.name))
    if not named and (unit or not (unnamed or column is table.columns[0])):
        return None
    others = [item for item in table.columns if item is not column]
    rows = apart(others)[0][1] if others else np.ones(column.values.size, bool)
    values = unwrapped(column.values)[np.isfinite(column.values) & rows]
    steps = np.diff(values)
    if not steps.size or values[0] == values[-1]:
        return None
    if steps.min() < 0.0:
        if not (is_time and words & WORDS["time"] and np.mean(steps < 0.0) < LIMITS.again):
            return None
        return Guess("t", unit, UNDECIDED, message("app.time_goes_back"))
    if not named:
        even = steps.min() > 0.0 and np.ptp(steps) < 1e-3 * steps.min() and steps[0] != 1.0
        if not even or table.t is not None:
            return None
        unit, certainty = _time_unit(values)
        certainty = certainty if unnamed else UNDECIDED
        return Guess("t", unit, certainty, message("app.rises_evenly"))
    if table.t is not None:
        return Guess(remark=message("app.time_known"))
    even = unrounded(values, max(resolution(values)))
    if even is values and np.mean(steps == 0.0) > SETTINGS.repeated:
        rate = rate_of_rounded(values)
        note = message("app.time_rounded", rate=rate, unit=unit or "s")
        return Guess("t", unit or "s", UNDECIDED, note)
    tick = float(np.median(steps))
    if not is_time and tick < LIMITS.days and since_1970(86400.0 * float(values[0]), True):
        return Guess("t", "d", LIKELY, message("app.days_guessed"))
    if not is_time:
        return Guess("t", *_time_unit(values), message("app.unit_guessed"))
    still = int((steps == 0.0).sum()) if even is values else 0
    certainty = CERTAIN if words & WORDS["time"] else LIKELY
    note = message("app.time_stands_still", count=still) if still else ""
    return Guess("t", unit, certainty, note, why=(message("app.why_unit", unit=unit),))


def _time_unit(values: np.ndarray) -> tuple[str, str]:
    """(the unit in which the steps of a time are those of a recorder, how certain that is)."""
    tick = float(np.median(np.diff(values)))
    if LIMITS.slow <= tick < 1.0 and np.any(values != np.round(values)):
        return "s", UNDECIDED  # ten rows a second, or in a millisecond?
    return "s" if tick < LIMITS.slow else "ms" if tick < 100 else "us", LIKELY


def reading_of(unit: str, words: set[str]) -> tuple[str, str, tuple[str, ...]]:
    """(quantity of a sensor or '', certainty, why), by the unit, without one by the name."""

    def may(row: str, named: set[str]) -> bool:
        if unit and is_share(unit):  # counts and percents are none
            return False
        return is_of(unit, VOCABULARY[row]) if unit else bool(words & named)

    if may("load_pressure", set()) and words & (WORDS["drop"] | WORDS["across"]):
        return "load_pressure", LIKELY, ()
    if may("p_head", WORDS["pressure"]):
        pressure = words & WORDS["pressure"]
        named = words if pressure else words - {"1", "2"}  # AI2 is no second chamber
        ports = {end: named & WORDS[f"{end}_port"] for end in _ENDS}
        if unit == "Pa":
            ports["p_head"] = ports["p_head"] - {"pa"}
        for end in ("p_supply", "p_tank"):  # beside a word: Druck P
            ports[end] = {port for port in words & WORDS[f"{end}_port"] if pressure - {port}}
        weights = {end: (bool(named & WORDS[end]), bool(ports[end])) for end in _ENDS}
        first, second = sorted(weights, key=weights.__getitem__, reverse=True)[:2]
        if weights[first] == weights[second]:
            return "", UNDECIDED, ()
        alone = weights[first][0] and not any(weights[second])
        spoken = sorted((named & WORDS[first]) | ports[first])
        why = tuple(message("app.why_word", word=word) for word in spoken)
        return first, CERTAIN if alone else LIKELY, why
    if unit and is_of(unit, VOCABULARY["command"]) or words & WORDS["command"]:
        return "", UNDECIDED, ()
    for channel, kind, by_unit in _SENSORS:
        named = WORDS[kind] & words
        if may(channel, named) and (unit or channel not in ("qd", "rod_force")):
            why = tuple(message("app.why_word", word=word) for word in sorted(named))
            alone = LIKELY if by_unit else UNDECIDED
            return channel, CERTAIN if named else alone, why
    return "", UNDECIDED, ()


def _cylinder(words: set[str], rig: Rig | None) -> tuple[str, str, tuple[str, ...]]:
    """(the cylinder that a name speaks of by its name or its joint's, how certain that is, why)."""
    if rig is None:
        return CYLINDER, LIKELY, ()

    def weight(cylinder: Cylinder) -> int:
        names = (words_of(cylinder.name), words_of(cylinder.joint))
        return sum(all(any(w.startswith(n) for w in words) for n in item) for item in names)

    weights = {cylinder.name: weight(cylinder) for cylinder in rig.cylinder}
    best = [name for name, count in weights.items() if count == max(weights.values())]
    if len(weights) == 1:
        return best[0], CERTAIN, (message("app.why_only"),)
    if len(best) == 1:
        return best[0], CERTAIN, (message("app.why_word", word=best[0]),)
    return CYLINDER, UNDECIDED, ()


def command_guess(unit: str, words: set[str], known: np.ndarray, rig: Rig | None) -> Guess:
    """A command to a valve: its numbers, where they are no volts, as two points of the driver."""
    cylinder, certainty, why = _cylinder(words, rig)
    valve, low, high = VALVE, -10.0, 10.0
    if rig is not None and certainty != UNDECIDED:
        valves = rig.cylinder_named(cylinder).valve
        named = [item for item in valves if words_of(item.name) <= words]
        if len(named) != 1 and len(valves) > 1:
            certainty = UNDECIDED
        chosen = (named or list(valves))[0]
        valve = VALVE if certainty == UNDECIDED else chosen.name
        low, high = float(chosen.command_min), float(chosen.command_max)
    if any(unit and not is_share(unit) and is_of(unit, VOCABULARY[row]) for row in ("x", "q")):
        return Guess(unit=unit, remark=message("app.commanded_position"))
    is_opening = bool(words & WORDS["spool"])
    channel = f"{cylinder}.{valve}.{'opening' if is_opening else 'command'}"
    remark = message("app.opening_guessed" if is_opening else "app.command_guessed")
    if rig is not None and valve == VALVE and cylinder != CYLINDER:
        names = ", ".join(item.name for item in rig.cylinder_named(cylinder).valve)
        remark = message("app.which_valve", names=names)
    spoken = words & WORDS["command"]
    why = (message("app.why_unit", unit=unit), *why) if unit else why
    why += tuple(message("app.why_word", word=word) for word in sorted(spoken))
    if not spoken:
        certainty = UNDECIDED
    elif not words & WORDS["commanded"] or is_opening:
        certainty = max(certainty, LIKELY)
    if unit and is_of(unit, VOCABULARY["command"]):
        remark = "" if certainty == CERTAIN else remark
        return Guess(channel, unit, certainty, remark, why=why)
    if unit not in (*CURRENTS, "%"):
        note = message("app.say_its_meaning", guess=remark)
        return Guess(channel, unit, UNDECIDED, note, why=why)
    first, last = _span_of(unit, known, low)
    ends = (f"{first:g} {unit}", f"{last:g} {unit}", f"{low:g} V", f"{high:g} V")
    note = message("app.range_guessed")
    return Guess(channel, unit, max(certainty, LIKELY), note, ends, why=why)


def _span_of(unit: str, known: np.ndarray, low: float) -> tuple[float, float]:
    """The readings that may stand for the ends of a driver's range."""
    if unit == "%":
        return (0.0 if low >= 0.0 else -100.0), 100.0
    scale = 1e-3 if unit == "A" else 1.0
    minimum, maximum = float(known.min()) / scale, float(known.max()) / scale
    reach = max(-minimum, maximum)
    whole = next((item for item in _FULL_SCALES if reach <= item), 50.0 * np.ceil(reach / 50.0))
    if reach <= LIMITS.loop and minimum >= 3.0:
        first, last = 4.0, 20.0
    elif minimum < -0.5:  # of either sign, so none of it is rest
        first, last = -max(whole, 20.0), max(whole, 20.0)
    elif reach > LIMITS.loop:
        first, last = 50.0 * np.floor(minimum / 50.0), 50.0 * np.ceil(maximum / 50.0)
    else:
        first, last = 0.0, 20.0
    return first * scale, last * scale


def holds_readings(source: Source) -> bool:
    """Whether a file is of a flowmeter: a column of flow, none of how a cylinder moves, and not the
    pressures of both its chambers, unless it has no time: then two pressures are of two sides."""
    columns = [column for table in source.tables for column in table.columns]

    def has(row: str) -> bool:
        return any(item.known_unit and is_of(item.known_unit, VOCABULARY[row]) for item in columns)

    ends = {reading_of(item.known_unit, words_of(item.name))[0] for item in columns}
    timed = has("t") or any(table.t is not None for table in source.tables)
    log = ({"p_head", "p_rod"} <= ends and timed) or bool(ends & {"x", "v", "q", "qd"})
    return len(source.tables) == 1 and has("flow") and not log


_SIDES = ("upstream_pressure", "downstream_pressure")


def reading_guesses(source: Source, rig: Rig | None) -> dict[str, Guess]:
    """A guess for each column by name; what several may be, none of them is for sure."""
    table, names = source.tables[0], source.names()
    results = {name: _reading_guess(name, table.columns[j], rig) for name, (_, j) in names.items()}

    def given() -> set[str]:
        return {guess.channel for guess in results.values() if guess.sure}

    sides = given() & {*_SIDES}
    for name, guess in results.items() if "pressure_drop" not in given() else ():
        # alone it is the drop; a side needs the other
        if guess.channel == "pressure":
            level, note = (UNDECIDED, message("app.which_side")) if sides else (CERTAIN, "")
            results[name] = Guess("pressure_drop", guess.unit, level, note)
        elif guess.channel in _SIDES and len(sides) < 2:
            note = message("app.needs_both_sides")
            results[name] = replace(guess, certainty=UNDECIDED, remark=note)
    drops = {name: _drop_in(name) for name, guess in results.items() if guess.channel == "flow"}
    if all(drops.values()) and not {"pressure_drop", *_SIDES} & given():
        for name, drop in drops.items():
            results[name] = replace(results[name], drop=drop)
    _without_rivals(results)
    for name in table.words:
        what = next((item for item in READING_WORDS if words_of(name) & WORDS[item]), "")
        results[name] = Guess(what, "", CERTAIN if what else UNDECIDED, "words")
    return results


def _drop_in(name: str) -> str:
    """The drop that a column's name speaks of, as ``Q at 10 bar``; '' of none."""
    for number, unit in re.findall(r"(\d+(?:[.,]\d+)?) *([A-Za-z]+)", name):
        if (known := named_unit(unit)) and is_of(known, VOCABULARY["pressure_drop"]):
            return f"{number.replace(',', '.')} {known}"
    return ""


def _reading_guess(name: str, column: SourceColumn, rig: Rig | None) -> Guess:
    unit, words = column.known_unit, words_of(name)
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return Guess(remark=message("app.no_number_held"))
    kinds = ("flow", "temperature", "pressure_drop")
    kind = next((row for row in kinds if unit and is_of(unit, VOCABULARY[row])), "")
    if kind == "pressure_drop":
        across = words & WORDS["drop"] or column.unit.strip("()[]").lower() in DIFFERENTIAL
        side = next((side for side in _SIDES if words & WORDS[side.partition("_")[0]]), "")
        kind = kind if across else side
        return Guess(kind or "pressure", unit, CERTAIN if kind else UNDECIDED)
    if kind:
        return Guess(kind, unit, CERTAIN)
    if words & WORDS["trial"] and np.all(known == np.round(known)) and known.min() > 0.0:
        return Guess("trial", "", CERTAIN)
    driven = unit in (*CURRENTS, "V", "%")
    if words & (WORDS["command"] | WORDS["command_port"]) or driven:
        guess = command_guess(unit, words, known, rig)
        certainty = CERTAIN if driven else guess.certainty
        return Guess("command", guess.unit, certainty, guess.remark, guess.ends)
    return Guess(remark="")
