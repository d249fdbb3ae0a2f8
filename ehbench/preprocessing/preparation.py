"""A log prepared for identification or validation: of this rig, evenly sampled, in the units it
says, what is known of its sensors taken out.

A slip of a unit or a name gives a fit that looks like one. So every log passes here first: what
cannot be right is refused with what would be right, what is merely odd comes back as a note."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ehbench.config.recipe.sensor import Sensor
from ehbench.data.record import Record
from ehbench.plant.model import Model
from ehbench.preprocessing import plausibility
from ehbench.preprocessing.sensors import Term, known_taken_out, terms_of
from ehbench.preprocessing.time_base import evened
from ehbench.vocabulary import InputError, Message, message
from ehbench.vocabulary.text import numbered


@dataclass(frozen=True)
class PreparedLog:
    """A log as identification and validation take it: evenly sampled, what is known of its sensors
    taken out, for the rig of ``model``, which carries its payload. ``terms`` are the numbers of its
    sensors that are estimated, and known lags and delays; ``notes`` say what is odd about it."""

    name: str
    record: Record
    model: Model
    terms: tuple[Term, ...] = ()
    notes: tuple[Message, ...] = ()


def prepare(name: str, record: Record, model: Model, sensors: Sequence[Sensor] = ()) -> PreparedLog:
    """A log as it was read prepared for a model with its payload, by what is known of its sensors
    and drivers, or estimated.

    Raises:
        InputError, LogError: as `preprocess`; a sensor of no channel of the log."""
    record = known_taken_out(name, record, sensors)
    terms = terms_of(sensors, [record])
    record, notes = preprocess(name, record, model)
    return PreparedLog(name, record, model, terms, notes)


def preprocess(name: str, record: Record, model: Model) -> tuple[Record, tuple[Message, ...]]:
    """(the log, evenly sampled; notes on what is odd about it) for a rig carrying the log's
    payload.

    Raises:
        LogError: not evenly sampled, with the worst gap; an angle that the stroke does not allow.
        InputError: too few or too coarse samples, a sample that is no number, no channel of the
            rig, a command, angle or position outside its range, pressures that cannot be in their
            unit."""
    count, rig = record.t.size, model.rig
    if count < plausibility.LEAST_SAMPLES:
        text = message(
            "preprocessing.few_samples", log=name, count=count, least=plausibility.LEAST_SAMPLES
        )
        raise InputError(text)
    for channel, values in record.channels.items():
        if not np.isfinite(values).all():
            when = record.t[int(np.argmin(np.isfinite(values)))]
            text = message("preprocessing.not_a_number", log=name, channel=channel, time=when)
            raise InputError(text)
    notes = [*plausibility.foreign_channels(name, record, rig), *plausibility.undriven(record, rig)]
    plausibility.refuse_sample_time(name, record, rig)
    record, jitter = evened(name, record)
    notes += jitter
    if rig.payload and not record.meta.get("payload"):
        notes.append(message("preprocessing.no_payload", payloads=", ".join(rig.payload)))
    plausibility.refuse_commands(name, record, rig)
    plausibility.refuse_angles(name, record, model)
    plausibility.refuse_positions(name, record, rig)
    rest = model.rest_samples(model.commands_of(record))
    on = plausibility.on_at_first(record, rig, rest)
    moving = plausibility.moving_at_first(record, rig, rest)
    begun = [message("preprocessing.starts_on", channel=name, command=on[name]) for name in on]
    begun += [message("preprocessing.starts_moving", cylinder=name) for name in moving]
    plausibility.refuse_supply(name, record, model)
    plausibility.refuse_pressures(name, record, model, rest, still=not begun)
    notes += [*begun, *plausibility.notes_on_channels(record, model)]
    notes += plausibility.replay_notes(name, record, model)
    notes += plausibility.begins_elsewhere(record, model, rest)
    notes += plausibility.idle_at_first(record, rig, on, rest)
    return record, tuple(notes)


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """A name for each log: its file's stem, with its folder where others have the same."""
    names = [Path(path.name.removesuffix(".gz")).stem for path in paths]
    crowd, pairs = Counter(names), zip(paths, names, strict=True)
    return numbered(f"{p.parent.name}_{name}" if crowd[name] > 1 else name for p, name in pairs)
