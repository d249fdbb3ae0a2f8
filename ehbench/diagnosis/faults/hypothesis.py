"""A row of the fault table applied to a rig: what a fault of size δ makes of rig and sensors, and
the lines that free it in a fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ehbench.config.recipe.sensor import ESTIMATE, Sensor
from ehbench.config.rig import Rig
from ehbench.data.record import Record
from ehbench.diagnosis.faults.scales import Scales
from ehbench.parts.fault import Amount, Fault
from ehbench.preprocessing.sensors import Term
from ehbench.vocabulary import Z95, Message, message, quantity
from ehbench.vocabulary.fields import Value
from ehbench.vocabulary.messages import templates

# how sure a number of the rig file is by its source, the least sure first
CERTAINTY = ("assumed", "restored", "companion", "datasheet", "printed", "identified")
Edit = tuple[tuple[Any, ...], str, dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class Number:
    """A number of the rig that a fault moves [SI]: what it is at δ = 0, by how much a unit of δ
    moves it, where searches begin and end, how sure it is and its standard error.
    """

    name: str
    here: float
    unit: float
    starts: tuple[float, ...]
    upper: float | None
    sure: str
    std: float | None = None

    @classmethod
    def of(cls, fault: Fault, key: str, name: str, known: Value | None, scales: Scales) -> Number:
        """A number of a row; ``known`` is that of the rig file, if it has one."""
        added = fault.adds.get(key.rpartition(".")[2]) if known is None else None
        here = float(known) if known is not None else scales.of(fault.neutral)
        unit = here if fault.unit == "share" else scales[fault.unit]
        if fault.moved and key not in fault.moved:
            unit = 0.0
            here = scales.of(added) if isinstance(added, Amount) else here
        if isinstance(added, Amount):
            starts = tuple(scales.of(added, k) for k in range(len(added.factors)))
        else:
            starts = (max(here, scales.of(fault.start)) if fault.start else here,)
        upper = scales.of(fault.upper) if fault.upper is not None else None
        upper = None if known is not None and known.upper is not None else upper
        sure, std = ("assumed", None) if known is None else (known.sure, known.std)
        return cls(name, here, unit, starts, upper, sure, std)

    def at(self, delta: float) -> float:
        """Its value with a fault of size δ; of what is never negative no less than zero."""
        value = self.here + delta * self.unit
        return value if self.signed else max(value, 0.0)

    @property
    def signed(self) -> bool:
        """Whether it may be below zero."""
        return quantity(self.name).lower < 0.0

    def begin(self, delta: float) -> float:
        """Where a search begins [SI] that a slope says to end at δ."""
        value = self.at(delta) if self.unit else max(self.here, *self.starts)
        return value if self.upper is None else min(value, 0.9 * self.upper)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A fault that a machine may have: a row of the table, what it is ``about``, the ``numbers``
    that it moves, the ``readings`` (channel, word of a sensor, SI per δ), the ``edits`` of the rig
    file's tables, and the ``cylinder`` whose logs it changes, empty for all. ``alike``
    is of a part among several that may have it together."""

    row: Fault
    about: str
    numbers: tuple[Number, ...] = ()
    readings: tuple[tuple[str, str, float], ...] = ()
    edits: tuple[Edit, ...] = ()
    cylinder: str = ""
    alike: bool = False

    @property
    def kind(self) -> str:
        return self.row.kind

    @property
    def name(self) -> str:
        """Such as ``deadband of press.servo``."""
        return f"{self.kind} of {self.about}"

    @property
    def rank(self) -> tuple[int, int]:
        """Of two that explain alike the one of lower rank comes first: of the less sure number,
        sensors and what the rig file lacks being as sure as a data sheet; several alike before one.
        """
        known = self.numbers and not self.edits
        sure = self.certainty if known else CERTAINTY.index("datasheet")
        return sure, self.row.rank - (len(self.numbers) > 1)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the numbers."""
        return tuple(number.name for number in self.numbers)

    @property
    def certainty(self) -> int:
        """How sure the present numbers are: 0 of what is assumed, more of what was measured."""
        sure = [number.sure for number in self.numbers if number.unit != 0.0]
        ranks = [CERTAINTY.index(s) if s in CERTAINTY else len(CERTAINTY) for s in sure]
        return min(ranks, default=0)

    def beyond(self, delta: float) -> float:
        """By how many half-widths of its interval a fault of size δ moves an identified number."""
        return max(
            (
                abs(delta * n.unit) / (Z95 * n.std)
                for n in self.numbers
                if n.sure == "identified" and n.std
            ),
            default=0.0,
        )

    @property
    def bounds(self) -> tuple[float, float]:
        """The smallest and the largest δ."""
        low, high = self.row.low, self.row.high
        for number in self.numbers:
            if number.unit > 0.0 and not number.signed:
                low = max(low, -number.here / number.unit)
        return low, high

    @property
    def inside(self) -> float:
        """The step δ of a difference, to the side that its bounds allow."""
        step, (low, high) = self.row.step, self.bounds
        return step if low <= step <= high else -step

    def rig(self, rig: Rig, delta: float) -> Rig:
        """A rig with the fault.

        Raises:
            EhbenchError, ValueError: there is no such rig.
        """
        moved = {n.name: n.at(delta) for n in self.numbers} if not self.readings else {}
        return (self.altered(rig) if moved else rig).with_values(moved) if moved else rig

    def altered(self, rig: Rig) -> Rig:
        """A rig with the parts and laws that the fault adds, as where a search begins.

        Raises:
            ValueError: there is no such rig.
        """
        if not self.edits:
            return rig
        tables = _mutable(rig.as_toml())
        for place, table, content, also in self.edits:
            target = tables
            for key in place:
                target = target.setdefault(key, {}) if isinstance(target, dict) else target[key]
            target |= dict(content) if not table or table in content else {table: dict(content)}
            target |= also
        return Rig.model_validate(tables)

    def record(self, record: Record, delta: float) -> Record:
        """A log whose commands do more at its end, which only drift makes."""
        if self.kind != "drift":
            return record
        grows = 1.0 + delta * (record.t - record.t[0]) / np.ptp(record.t)
        names = [name for name, _, _ in self.readings if name in record]
        given = {name: record[name] * grows for name in names}
        return replace(record, channels=record.channels | given)

    def terms(self, terms: Sequence[Term], bias: Mapping[str, float], delta: float) -> Any:
        """(the terms of sensors, their bias) of a log with the fault."""
        known = {term.name for term in terms}
        more = [Term(c, w, 0.0, 1.0, 0.0, False) for c, w, _ in self.readings if w != "drift"]
        bias = dict(bias)
        for channel, word, unit in self.readings:
            name = f"{channel}.{word}"
            bias[name] = bias.get(name, 0.0) + delta * unit
        return (*terms, *(term for term in more if term.name not in known)), bias

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """What a recipe estimates of sensors."""
        if self.numbers or self.kind == "drift":
            return ()
        return tuple(
            Sensor(channel=channel, sign=-1)
            if self.kind.endswith("sign")
            else Sensor.model_validate({"channel": channel, word: ESTIMATE})
            for channel, word, _ in self.readings
        )

    @cached_property
    def starts(self) -> tuple[dict[str, float], ...]:
        """Where searches begin, by name [SI]; of sensors their bias."""
        if not self.numbers and self.row.step:
            return tuple(
                {f"{channel}.{word}": delta * unit for channel, word, unit in self.readings}
                for delta in self.row.trials or (0.0,)
            )
        count = max((len(number.starts) for number in self.numbers), default=1)
        return tuple(
            {n.name: n.starts[min(k, len(n.starts) - 1)] for n in self.numbers}
            for k in range(count)
        )

    @property
    def upper(self) -> dict[str, float]:
        """Upper bounds of the search by name [SI]."""
        return {n.name: n.upper for n in self.numbers if n.upper is not None}

    @property
    def freedom(self) -> int:
        """How many numbers it frees."""
        return len(self.numbers) or len(self.sensors)

    def without(self, names: Collection[str], bounded: Collection[str]) -> Hypothesis:
        """It without numbers that are free already, and without bounds that a recipe has."""
        rest = tuple(n for n in self.numbers if n.name not in names)
        return replace(
            self, numbers=tuple(replace(n, upper=None) if n.name in bounded else n for n in rest)
        )

    def parts(self, others: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Those of others that it is made of or an elaboration of."""
        parameters = {*self.parameters}
        return [o for o in others if o.numbers and {*o.parameters} < parameters and not o.edits]

    def sentence(self, rig: Rig, delta: float) -> Message:
        """What a fault of size δ is, and how it shows."""
        name = self.kind.replace(" ", "_")
        signed = f"{name}_{'more' if delta > 0.0 else 'less'}"
        key = signed if signed in templates("faults") else name
        return message(f"faults.{key}", **self._fields(rig, delta))

    def remedy(self, rig: Rig, delta: float) -> Message:
        """The line of the recipe, the rig file or the map of columns that frees it or puts it
        right.
        """
        fields = self._fields(rig, delta)
        if self.kind == "drift":
            return message("faults.fit_apart")
        if self.kind == "late command":
            return message("faults.written_late", **fields)
        if self.edits and len(self.readings) != 1:
            block = self.rig_lines(rig, delta)
            lines = "; ".join(block).replace("# in ", "").replace("\n", " ")
            return message("faults.add_lines", lines=lines, block="\n".join(block))
        if self.edits or not self.numbers:
            given = (
                "sign = -1" if self.kind.endswith("sign") else f'{fields["word"]} = "{ESTIMATE}"'
            )
            lines = [f'[[sensor]] channel = "{name}", {given}' for name, _, _ in self.readings]
            return message("faults.free_sensor", lines="; ".join(lines))
        if all(number.sure == "identified" for number in self.numbers):
            return message("faults.fitted", **fields)
        return message("faults.free", **fields)

    def _fields(self, rig: Rig, delta: float) -> dict[str, Any]:
        number = next((n for n in self.numbers if n.unit != 0.0), None)
        channel, word, unit = self.readings[0] if self.readings else ("", "", 0.0)
        fields = {
            "about": self.about,
            "names": ", ".join(self.parameters),
            "quoted": ", ".join(f'"{name}"' for name in self.parameters),
            "channel": channel,
            "channels": ", ".join(reading[0] for reading in self.readings),
            "word": word,
            "percent": 100.0 * abs(delta),
            "rest": 100.0 * (1.0 - abs(delta)),
            "ms": 1e3 * abs(delta),
            "volts": delta * unit,
        }
        if number is not None:
            by, there = abs(delta * number.unit), number.at(delta)
            fine = 2 + int(math.log10(max(10.0, abs(there) / by))) if by else 3  # shows the change
            value = rig.shown(number.name, there, fine)
            return fields | {"by": rig.shown(number.name, by, 3), "value": value}
        return fields | {"by": "", "value": ""}

    def recipe_lines(self, rig: Rig) -> tuple[str, ...]:
        """What it adds to the recipe."""
        lines: list[str] = []
        if self.parameters:
            quoted = ", ".join(f'"{name}"' for name in self.parameters)
            lines.append(message("faults.parameters_line", quoted=quoted))
        for name, value in self.upper.items():
            lines.append(f'[upper] "{name}" = "{rig.shown(name, value, 5)}"')
        for sensor in self.sensors:
            word = next((w for c, w, _ in self.readings if c == sensor.channel), "")
            given = f'{word} = "{ESTIMATE}"' if sensor.sign == 1 else "sign = -1"
            lines.append(f'[[sensor]] channel = "{sensor.channel}", {given}')
        return tuple(lines)

    def rig_lines(self, rig: Rig, delta: float | None = None) -> tuple[str, ...]:
        """What it adds to the rig file: where, and the keys below, one a line; numbers as where a
        search begins, or of a fault of size δ of this rig.
        """
        results, found = [], {}
        if delta is not None:
            shown = [(n.name, rig.shown(n.name, n.at(delta), 5)) for n in self.numbers if n.unit]
            found = {name.rpartition(".")[2]: value for name, value in shown}
            found = found if len(found) == len(shown) else {}  # several alike, each with its own
        for place, table, content, also in self.edits:
            content = _with_values(content, found)
            keys, whole = content, not table or table in content
            where = message("faults.in_table", where=_where(rig, place))
            if not whole and any(isinstance(key, int) for key in place):
                keys = {table: content}
            elif not whole:
                where = f"[{'.'.join([*place, table])}]"
            if delta is not None:
                for key in also:  # in motion no more than at break-away
                    (number,) = (n for n in self.numbers if n.unit)
                    most = number.at(delta)
                    there = float(rig.parameters()[f"{number.name.rpartition('.')[0]}.{key}"])
                    also = also | {key: rig.shown(number.name, min(there or most, most), 5)}
            lines = [f"{key} = {_toml(value)}" for key, value in (keys | also).items()]
            results.append("\n".join([where, *lines]))
        return tuple(results)


def joined(several: Sequence[Hypothesis], about: str) -> Hypothesis:
    """Faults of one kind together."""
    return replace(
        several[0],
        about=about,
        numbers=tuple(number for item in several for number in item.numbers),
        edits=tuple(edit for item in several for edit in item.edits),
    )


def _mutable(tables: Any) -> Any:
    """Nested plain values whose tables and lists can be altered."""
    if isinstance(tables, Mapping):
        return {key: _mutable(value) for key, value in tables.items()}
    return [_mutable(table) for table in tables] if isinstance(tables, list | tuple) else tables


def _with_values(tables: Any, values: Mapping[str, str]) -> Any:
    """Nested tables with other values of some keys."""
    if isinstance(tables, list):
        return [_with_values(table, values) for table in tables]
    if not isinstance(tables, Mapping):
        return tables
    leaves = {
        key: values[key] for key in tables.keys() & values if not isinstance(tables[key], list)
    }
    return {key: leaves.get(key) or _with_values(item, values) for key, item in tables.items()}


def _where(rig: Rig, place: Sequence[Any]) -> str:
    """A place of the rig file as its headers have it, such as ``[[cylinder]] press``; what has no
    name is counted.
    """
    words, headers = [], []
    part: Any = rig
    for key in place:
        if isinstance(key, int):
            part = part[key]
            name = getattr(part, "name", None) or key + 1
            headers.append(f"[[{'.'.join(words)}]] {name}")
        else:
            part = getattr(part, key) if not isinstance(part, Mapping) else part
            words.append(key)
    return ", ".join(headers) or f"[{'.'.join(words)}]"


def _toml(value: Any) -> str:
    """A value in a line of TOML, numbers to five digits."""
    if isinstance(value, Mapping) and "value" in value:
        return _toml(value["value"])
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if not isinstance(value, str):
        return str(value).lower() if isinstance(value, bool) else f"{value:.5g}"
    number, _, unit = value.partition(" ")
    try:
        return f'"{float(number):.5g} {unit}"' if math.isfinite(float(number)) else f'"{value}"'
    except ValueError:
        return f'"{value}"'
