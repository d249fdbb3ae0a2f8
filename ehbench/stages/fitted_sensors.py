"""What a fit knows of the sensors of its logs, for whoever judges its rig on other logs."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ehbench.config.recipe.sensor import ESTIMATE, WORDS, Sensor, reading_row
from ehbench.config.rig import Rig
from ehbench.preprocessing.sensors import ATMOSPHERE
from ehbench.runs import rundir
from ehbench.vocabulary.terms import Z95
from ehbench.vocabulary.units import from_si

FILE, TABLES = "parameters.json", "sensor_tables"


def tables_of(sensors: Sequence[Sensor]) -> dict[str, Any]:
    """What a fit writes of its ``[[sensor]]`` tables, to be taken over; nothing of none."""
    return {TABLES: [sensor.as_toml() for sensor in sensors]} if sensors else {}


def inherited(
    folder: Path, own: Sequence[Sensor], channels: Collection[str], rig: Rig
) -> tuple[Sequence[Sensor], tuple[str, ...]]:
    """(a recipe's own sensors and those of the fit behind its rig, a sentence for each of these).

    What the fit was told stays as it is, what it estimated of all its logs is held by its standard
    error, what it estimated of each log by itself is estimated anew.

    Args:
        folder: run of the fit, or one that carries its ``parameters.json``.
        own: of the recipe; a table of theirs goes before that of the fit.
        channels: that all logs have; what reads another channel is left out.
    """
    path = folder / FILE
    result = rundir.read_json(path) if path.is_file() else {}
    named = {item.channel for item in own}
    tables = {
        str(item["channel"]): dict(item)
        for item in result.get(TABLES, [])
        if item["channel"] in channels and item["channel"] not in named
    }
    messages = []
    for row in result.get("sensors", []):
        channel, word = row["channel"], row["word"]
        if row["log"] or channel in named or channel not in channels:
            continue
        table = tables.setdefault(channel, {"channel": channel})
        value, std = _value(row, table), row["std"]
        table[word] = _held(channel, word, value, std)
        messages.append(f"{channel} is taken to have {_shown(rig, channel, word, value, std)}")
    messages += [
        f"{channel} is taken to be read with {', '.join(message)}"
        for channel, table in tables.items()
        if (message := list(_told(table, result.get("sensors", []))))
    ]
    end = ", as the fit of this rig found; a [[sensor]] table of the recipe goes before it"
    return (
        (*own, *map(Sensor.model_validate, tables.values())),
        tuple(item + end for item in messages),
    )


def _value(row: Mapping[str, Any], table: Mapping[str, Any]) -> float:
    """What a fit found as a table says it: without the sign and the atmosphere that stand there."""
    value, word = float(row["value"]), row["word"]
    if word == "offset" and table.get("pressure") == "absolute":
        return value - ATMOSPHERE
    if word == "offset":
        return value
    return max(abs(value) if word == "scale" else value, 0.0)


def _held(channel: str, word: str, value: float, std: float) -> Any:
    """A value [SI] with its standard error, as a table has it."""
    if word == "scale":
        return {"value": value, "std": std} if std > 0.0 else value
    unit = reading_row(channel, word).unit
    shown = f"{value!r} {unit}"
    return {"value": shown, "std": f"{std!r} {unit}"} if std > 0.0 else shown


def _shown(rig: Rig, channel: str, word: str, value: float, std: float) -> str:
    """Such as ``a lag of 4.9 ± 0.2 ms``."""
    row, half = reading_row(channel, word), Z95 * std
    if word == "scale":
        return f"a scale of {value:.4g} ± {half:.2g}"
    unit = "ms" if word in ("lag", "delay") else rig.unit_of(row.name)
    size, wide = (float(from_si(item, unit, row)) for item in (value, half))
    article = "an" if word == "offset" else "a"
    return f"{article} {word} of {size:.2g} ± {wide:.2g} {unit}"


def _told(table: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What a table says beside what its fit estimated of all logs."""
    shared = {row["word"] for row in rows if row["channel"] == table["channel"] and not row["log"]}
    if table.get("sign") == -1:
        yield "sign -1"
    if table.get("pressure") == "absolute":
        yield "absolute pressure"
    for word in WORDS:
        if word in table and word not in shared:
            own = table[word] == ESTIMATE
            yield f"{word} of each log by itself" if own else f"{word} {_plain(table[word])}"


def _plain(given: Any) -> str:
    return str(given["value"]) if isinstance(given, Mapping) else str(given)
