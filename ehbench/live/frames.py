"""What a live view shows of a trial, from the numbers on its board."""

import math
import time
from collections.abc import Iterator, Sequence
from typing import Any

from ehbench.live import board
from ehbench.vocabulary.codes import FUNCTIONS

STATES = ("waiting", "running", "stopping", "ended")


def frame_of(facts: board.Facts, numbers: Sequence[float]) -> dict[str, Any]:
    """What is to be seen now, in the units of the rig's file; None for what is not measured.

    Args:
        facts: of the trial.
        numbers: of the board."""
    values = dict(zip(facts.names, numbers[board.FIRST : facts.first_lever], strict=True))
    inputs, cylinders = numbers[facts.first_lever :], []
    levers = dict(zip(facts.levers, inputs[board.LEVERS :], strict=True))
    for name, stroke in facts.strokes.items():
        row: dict[str, Any] = {"name": name, "stroke": _displayed(facts, "x", stroke)}
        row["lever"] = levers.get(name)
        for word in ("x", "v", "p_head", "p_rod"):
            for key in (word, f"{word}_desired"):
                row[key] = _displayed(facts, word, values.get(f"{name}.{key}", math.nan))
        function = values.get(f"{name}.function", math.nan)
        row["function"] = FUNCTIONS[int(function)] if function >= 0.0 else None
        cylinders.append(row)
    state = int(numbers[board.STATE])
    silent = time.monotonic() - inputs[board.HEARD] > board.VIEW.silence
    return {
        "state": STATES[state],
        "stop": facts.stops[int(numbers[board.LIMIT])] if state == board.STOPPING else "",
        "held": bool(inputs[board.HELD]) and not silent if levers else None,
        "t": numbers[board.TIME],
        "late": int(numbers[board.LATE]),
        "cylinders": cylinders,
        "margins": list(_margins(facts, values)),
    }


def _displayed(facts: board.Facts, word: str, value: float) -> float | None:
    return value * facts.units[word][1] if math.isfinite(value) else None


def _margins(facts: board.Facts, values: dict[str, float]) -> Iterator[dict[str, Any]]:
    """Each limit that the recipe sets: what is nearest to it, how far that is from it, and the
    share of the way there that is ``used``."""
    limits = facts.limits

    def row(limit: str, channel: str, word: str, margin: float, span: float) -> dict[str, Any]:
        value = values[channel] if word != "following_error" else span - margin
        used = min(max(1.0 - margin / span, 0.0), 1.0) if math.isfinite(margin) else None
        shown = {"value": _displayed(facts, word, value), "margin": _displayed(facts, word, margin)}
        named = {"limit": limit, "channel": channel, "unit": facts.units[word][0]}
        return named | shown | {"used": used}

    for name, stroke in facts.strokes.items():
        x, v, *chambers = (f"{name}.{word}" for word in ("x", "v", "p_head", "p_rod"))
        known = [chamber for chamber in chambers if math.isfinite(values[chamber])]
        if known and (bound := limits.get("pressure_max")) is not None:
            fullest = max(known, key=lambda chamber: values[chamber])
            yield row("pressure_max", fullest, "p_head", bound - values[fullest], bound)
        if known and (bound := limits.get("pressure_min")) is not None:
            emptiest = min(known, key=lambda chamber: values[chamber])
            yield row("pressure_min", emptiest, "p_head", values[emptiest] - bound, facts.pressure)
        if (bound := limits.get("stroke_margin")) is not None:
            margin = min(values[x], stroke - values[x]) - bound
            yield row("stroke_margin", x, "x", margin, 0.5 * stroke - bound)
        if (bound := limits.get("speed_max")) is not None:
            yield row("speed_max", v, "v", bound - abs(values[v]), bound)
        if math.isfinite(bound := facts.following[name]):
            apart = abs(values[x] - values.get(f"{name}.x_desired", math.nan))
            yield row("following_error", x, "following_error", bound - apart, bound)
    if (bound := limits.get("command_max")) is not None:
        commands = [name for name in facts.names if name.endswith(".command")]
        widest = max(commands, key=lambda command: abs(values[command]))
        yield row("command_max", widest, "command", bound - abs(values[widest]), bound)
