"""What differs between two runs of one kind: inputs, parameters, verdict, headline numbers."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ehbench.config.rig import Rig
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


Ends = tuple[float, float]
Change = dict[str, str]  # what differs, and how it was in the ``first`` and the ``second`` run


def compare(first: Path, second: Path) -> Answer:
    """What differs between two runs, in the units of the first one's rig: parameters first, then
    other numbers, inputs. As values [SI] the same, how many parameters are the ``same``, and the
    ``changes`` by which a run is supported no more.

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
    names = dict.fromkeys([*known, *known_after])
    shifts: list[dict[str, Any]] = []
    for name in names:
        pairs = known.get(name, (None, None)), known_after.get(name, (None, None))
        (a, ends), (b, ends_after) = pairs
        if a != b:
            row = {"name": name, "first": a, "first_interval": ends, "second": b}
            row |= {"second_interval": ends_after, "intervals": intervals_between(*pairs)}
            shifts.append(row)
    shifts.sort(key=lambda row: -(math.inf if row["intervals"] is None else row["intervals"]))
    numbered = item.what not in ("hydraulics", "flow_map")  # their numbers are the parameters
    heads = (
        {n.label: n.value for n in chapter.findings.numbers if numbered} for chapter in chapters
    )
    values = {
        "stage": item.what or item.stage,
        "verdicts": [chapter.content.status for chapter in chapters],
        "inputs": list(_changes(_inputs(item), _inputs(other))),
        "parameters": shifts,
        "same": len(names) - len(shifts),
        "numbers": list(_changes(*heads)),
        "changes": list(dict.fromkeys([*unsupported(first), *unsupported(second)])),
    }
    tables = [
        _shift_table(item.rig if item.has_rig else None, shifts),
        _change_table("number", values["numbers"]),
        _change_table("input", values["inputs"]),
    ]
    before, after = map(words, values["verdicts"])
    fields = {"verdict": before if before == after else f"{before} → {after}"}
    fields |= {"stage": words(values["stage"]), "inputs": len(values["inputs"])}
    key = "report.compared_changed" if values["changes"] else "report.compared"
    return Answer(
        message(key, **fields, same=values["same"], changed=len(shifts)),
        [table for table in tables if table.rows],
        notes=[message("report.unsupported", change=change) for change in values["changes"]],
        values=values,
    )


def intervals_between(
    first: tuple[float | None, Ends | None], second: tuple[float | None, Ends | None]
) -> float | None:
    """The distance of two numbers, each with its 95 % interval, by √(a² + b²) of the facing half
    intervals; None without any."""
    (a, ends), (b, ends_after) = first, second
    if a is None or b is None or not (ends or ends_after):
        return None
    upper = b > a
    towards = [] if ends is None else [abs(ends[upper] - a)]
    if ends_after is not None:
        towards.append(abs(b - ends_after[not upper]))
    whole = math.hypot(*towards)
    return 0.0 if a == b else abs(b - a) / whole if whole > 0.0 else None


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


def _changes(first: Mapping[str, str], second: Mapping[str, str]) -> Iterator[Change]:
    for what in dict.fromkeys([*first, *second]):
        if first.get(what) != second.get(what):
            yield {"what": what, "first": first.get(what, ""), "second": second.get(what, "")}


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


def _shift_table(rig: Rig | None, shifts: Sequence[Mapping[str, Any]]) -> Grid:
    """A row a parameter; in SI the numbers alone."""
    rows = []
    for row in shifts:
        name, texts, unit = row["name"], [number(row[key]) for key in ("first", "second")], ""
        if rig is not None:
            known = [(row[k], *(row[f"{k}_interval"] or (None, None))) for k in ("first", "second")]
            texts = [with_interval(*(shown(rig, name, x) for x in some)) for some in known]
            unit = pretty(unit_of(rig, name))
        rows.append([name, *map(num, texts), unit, num(number(row["intervals"], 2))])
    return Grid(["parameter", "first", "second", "unit", "intervals apart"], rows)


def _change_table(what: str, changes: Sequence[Change]) -> Grid:
    short = re.compile("(?<=^[0-9a-f]{8})[0-9a-f]{56}$")  # the rest of a digest
    ends = ([short.sub("", row[k]) or DASH for k in ("first", "second")] for row in changes)
    rows = [[row["what"], *texts] for row, texts in zip(changes, ends, strict=True)]
    return Grid([what, "first", "second"], rows)
