"""What differs between two runs of one kind: inputs, parameters, verdict, headline numbers."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ehbench.report.blocks import Grid
from ehbench.report.content import num
from ehbench.report.provenance import unsupported
from ehbench.report.saved import Saved, Table
from ehbench.report.terminal import Answer, reported
from ehbench.report.words import DASH, number, pretty, shown, unit_of, with_interval, words
from ehbench.runs.rundir import read_json
from ehbench.runs.versions import read_versions
from ehbench.vocabulary import Z95, InputError, message

_RUN = re.compile(r"_[0-9a-f]{8}$")  # the end of a run folder's name


@dataclass(frozen=True)
class InputChange:
    """An input that differs: ``what`` it is, and as it was in either run (empty: not there)."""

    what: str
    first: str
    second: str


Ends = tuple[float, float]


@dataclass(frozen=True)
class Shift:
    """A parameter [SI] in two runs, with its 95 % interval in either."""

    name: str
    first: float | None
    first_interval: Ends | None
    second: float | None
    second_interval: Ends | None

    @property
    def intervals(self) -> float | None:
        """Their distance by √(a² + b²) of the facing half intervals; None without any."""
        a, b = self.first, self.second
        known = [ends for ends in (self.first_interval, self.second_interval) if ends]
        if a is None or b is None or not known:
            return None
        upper = b > a
        towards = [] if self.first_interval is None else [abs(self.first_interval[upper] - a)]
        if self.second_interval is not None:
            towards.append(abs(b - self.second_interval[not upper]))
        whole = math.hypot(*towards)
        return 0.0 if a == b else abs(b - a) / whole if whole > 0.0 else None


@dataclass(frozen=True)
class Comparison:
    """What differs; ``same`` counts equal parameters, ``changes`` is what supports no more."""

    stage: str
    verdicts: tuple[str, str]
    inputs: tuple[InputChange, ...]
    parameters: tuple[Shift, ...]
    same: int
    numbers: tuple[InputChange, ...]
    changes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        shifts = [asdict(item) | {"intervals": item.intervals} for item in self.parameters]
        return asdict(self) | {"parameters": shifts}


def compare(first: Path, second: Path) -> Comparison:
    """What differs between two runs.

    Raises:
        InputError: no run, or runs of different kinds."""
    chapters = reported(first)[0], reported(second)[0]
    item, other = (chapter.run for chapter in chapters)
    if item.what != other.what or item.stage != other.stage:
        kinds = {
            "first": words(item.what or item.stage),
            "second": words(other.what or other.stage),
        }
        raise InputError(message("report.other_kind", **kinds), file=second)
    known, known_after = _parameters(item), _parameters(other)
    shifts = [
        Shift(name, *known.get(name, (None, None)), *known_after.get(name, (None, None)))
        for name in dict.fromkeys([*known, *known_after])
    ]
    changed = [shift for shift in shifts if shift.first != shift.second]
    changed.sort(key=lambda shift: -(math.inf if shift.intervals is None else shift.intervals))
    numbered = item.what not in ("hydraulics", "flow_map")  # their numbers are the parameters
    heads = [
        {n.label: n.value for n in chapter.findings.numbers if numbered} for chapter in chapters
    ]
    return Comparison(
        item.what or item.stage,
        (chapters[0].content.status, chapters[1].content.status),
        tuple(_changes(_inputs(item), _inputs(other))),
        tuple(changed),
        len(shifts) - len(changed),
        tuple(_changes(*heads)),
        tuple(dict.fromkeys([*unsupported(first), *unsupported(second)])),
    )


def _inputs(run: Saved) -> dict[str, str]:
    """What a run was made from: digests by what they are of, run folders without their hash."""
    facts = run.facts
    known = {"recipe": facts["recipe"]["sha256"]}
    for item in facts["inputs"]:
        known[f"{item['role']} {_RUN.sub('', Path(item['path']).name)}"] = item["sha256"]
    for name, version in read_versions(facts).rows():
        known[name if name == "schema" else f"method {name}"] = str(version)
    known |= {f"version of {name}": str(value) for name, value in facts["versions"].items()}
    return known | {f"seed of {k}": str(v) for k, v in facts.get("seeds", {}).items()}


def _changes(first: Mapping[str, str], second: Mapping[str, str]) -> Iterator[InputChange]:
    for what in dict.fromkeys([*first, *second]):
        if first.get(what) != second.get(what):
            yield InputChange(what, first.get(what, ""), second.get(what, ""))


def _parameters(run: Saved) -> dict[str, tuple[float | None, Ends | None]]:
    """What the run fitted, else what its maps and gains are, else its rig's numbers."""
    path = run.folder / "parameters.json"
    if path.is_file():
        rows = Table(read_json(path), path)["parameters"]
        return {row["name"]: (row.number("value"), _interval(row.get("interval"))) for row in rows}
    if run.what == "flow_map":
        return {
            f"{row['valve']}.{row['direction']}.deadband": (
                row.number("deadband"),
                _interval(row["deadband_interval"]),
            )
            for row in run.rows("summary.json")
        }
    if not run.has_rig:
        return {}
    known: dict[str, tuple[float | None, Ends | None]] = {}
    for name, value in run.rig.parameters().items():
        centre = float(value)
        half = Z95 * value.std if value.std else None
        known[name] = (centre, None if half is None else (centre - half, centre + half))
    return known


def _interval(interval: Any) -> Ends | None:
    return (interval[0], interval[1]) if interval and None not in interval else None


def answer(result: Comparison, first: Path) -> Answer:
    """What differs, in the units of a run's rig: parameters first, then other numbers, inputs."""
    rig = run.rig if (run := Saved(first)).has_rig else None
    head = ["parameter", "first", "second", "unit", "intervals apart"]
    inputs, numbers = (
        [[item.what, _abbreviated(item.first), _abbreviated(item.second)] for item in items]
        for items in (result.inputs, result.numbers)
    )
    rows = []
    for item in result.parameters:
        pairs = ((item.first, item.first_interval), (item.second, item.second_interval))
        known = [[value, *(ends or (None, None))] for value, ends in pairs]
        texts, unit = [number(value) for value, _ in pairs], ""  # in SI the numbers alone
        if rig is not None:
            texts = [with_interval(*(shown(rig, item.name, x) for x in some)) for some in known]
            unit = pretty(unit_of(rig, item.name))
        rows.append([item.name, *map(num, texts), unit, num(number(item.intervals, 2))])
    tables = [
        Grid(head, rows),
        Grid(["number", "first", "second"], numbers),
        Grid(["input", "first", "second"], inputs),
    ]
    before, after = (words(status) for status in result.verdicts)
    fields = {"stage": words(result.stage), "inputs": len(inputs), "same": result.same}
    verdict = before if before == after else f"{before} → {after}"
    key = "report.compared_changed" if result.changes else "report.compared"
    return Answer(
        message(key, verdict=verdict, **fields, changed=len(result.parameters)),
        [table for table in tables if table.rows],
        notes=[message("report.unsupported", change=change) for change in result.changes],
        values=result.as_json(),
    )


def _abbreviated(text: str) -> str:
    return text[:8] if re.fullmatch("[0-9a-f]{64}", text) else text or DASH
