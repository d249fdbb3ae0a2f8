"""What a fit knows of the sensors of its logs, for whoever judges its rig on other logs."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from ehbench.config.recipe.sensor import ESTIMATE, WORDS, Sensor, reading_row
from ehbench.config.rig import Rig
from ehbench.preprocessing.sensors import ATMOSPHERE
from ehbench.runs import rundir
from ehbench.vocabulary import Z95, from_si, message

FILE, TABLES = "parameters.json", "sensor_tables"


def tables_of(sensors: Sequence[Sensor]) -> dict[str, Any]:
    """What a fit writes of its ``[[sensor]]`` tables, to be taken over; nothing of none."""
    return {TABLES: [sensor.as_toml() for sensor in sensors]} if sensors else {}


def inherited(
    folder: Path, sensors: Sequence[Sensor], channels: Collection[str], rig: Rig
) -> tuple[Sequence[Sensor], tuple[str, ...]]:
    """(a recipe's sensors and those of the fit of its rig, a note for each of these).

    What the fit was given stays as it is, what it estimated of all its logs is taken with its
    standard error, what it estimated of each log separately is estimated again.

    Args:
        folder: run of the fit, or one that carries its ``parameters.json``.
        sensors: of the recipe; a table of theirs precedes that of the fit.
        channels: that all logs have; what reads another channel is left out.
        rig: whose units the notes use."""
    path = folder / FILE
    result = rundir.read_json(path) if path.is_file() else {}
    named = {item.channel for item in sensors}
    tables = {
        str(item["channel"]): dict(item)
        for item in result.get(TABLES, [])
        if item["channel"] in channels and item["channel"] not in named
    }
    rows, notes = result.get("sensors", []), []
    for row in rows:
        channel, word = row["channel"], row["word"]
        if row["log"] or channel in named or channel not in channels:
            continue
        table = tables.setdefault(channel, {"channel": channel})
        value, std = float(row["value"]), row["std"]
        # as a table states it: without the sign and the atmosphere that stand there
        if word == "offset":
            value -= ATMOSPHERE * (table.get("pressure") == "absolute")
        else:
            value = max(abs(value) if word == "scale" else value, reading_row(channel, word).lower)
        unit = "" if word == "scale" else f" {reading_row(channel, word).unit}"
        exact = value if not unit else f"{value!r}{unit}"
        spread = std if not unit else f"{std!r}{unit}"
        table[word] = {"value": exact, "std": spread} if std > 0.0 else exact
        term = _shown(rig, channel, word, value, std)
        notes.append(message("stages.sensor_term", channel=channel, term=term))
    for channel, table in tables.items():
        # what it states in addition to what its fit estimated of all logs
        shared = {row["word"] for row in rows if row["channel"] == channel and not row["log"]}
        terms = ["sign -1"] * (table.get("sign") == -1)
        terms += ["absolute pressure"] * (table.get("pressure") == "absolute")
        for word in (word for word in WORDS if word in table and word not in shared):
            value = table[word]
            plain = value["value"] if isinstance(value, Mapping) else value
            terms.append(f"{word} of each log" if value == ESTIMATE else f"{word} {plain}")
        if terms:
            text = message("stages.sensor_given", channel=channel, terms=", ".join(terms))
            notes.append(text)
    return (*sensors, *map(Sensor.model_validate, tables.values())), tuple(notes)


def _shown(rig: Rig, channel: str, word: str, value: float, std: float) -> str:
    """Such as ``lag 4.9 ± 0.2 ms``."""
    row, half = reading_row(channel, word), Z95 * std
    if word == "scale":
        return f"scale {value:.4g} ± {half:.2g}"
    unit = "ms" if word in ("lag", "delay") else rig.unit_of(row.name)
    size, wide = (float(from_si(item, unit, row)) for item in (value, half))
    return f"{word} {size:.2g} ± {wide:.2g} {unit}"
