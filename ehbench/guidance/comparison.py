"""What the logs of a fit should be compared by: the position where the rate is noise, a tied
position where the commands follow it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.data.record import Record
from ehbench.identification.hydraulics import PreparedFit
from ehbench.identification.simulator import Log
from ehbench.plant.ties import TIED, position_channel, tied_words
from ehbench.preprocessing.observations import column, noise_of, position_of
from ehbench.vocabulary import Message, message, setting


@dataclass(frozen=True)
class ComparisonSettings:
    """Numbers by which another comparison is proposed."""

    noise: float = setting(
        0.5, "", "share of noise in a rate's variance from which it shows no motion", "half"
    )
    follows: float = setting(
        0.5,
        "",
        "correlation of the noise of a command with that of a position, from which it follows it",
        "none by chance: 1000 samples give 0.1",
    )
    rough: float = setting(
        -0.5,
        "",
        "first autocorrelation of third differences, below which they are noise",
        "−0.75 of white noise, 1 of what is smooth",
    )
    late: int = setting(5, "", "samples by which a command may follow a position", "controllers")


SETTINGS = ComparisonSettings()


@dataclass(frozen=True)
class Comparison:
    """What a fit should compare: its ``channels``, whether its position is ``tied``, the ``lines``
    of the recipe that say so, and the ``steps``, none where the recipe has it so."""

    channels: tuple[str, ...]
    tied: bool = False
    lines: tuple[str, ...] = ()
    steps: tuple[Message, ...] = ()

    def records(self, records: Sequence[tuple[str, Record]]) -> list[tuple[str, Record]]:
        """Records as they are then compared."""
        more = {TIED: "position"} if self.tied else {}
        return [(name, replace(record, meta={**record.meta, **more})) for name, record in records]


def comparison_of(prepared: PreparedFit) -> Comparison:
    """What the logs of a fit should be compared by."""
    channels = tuple(prepared.options.channels)
    if prepared.options.method != "output_error" or prepared.options.response is not None:
        return Comparison(channels)
    logs = prepared.logs
    if any(
        _follows(log, name) for log in logs for name in log.commanded if not tied_words(log.record)
    ):
        steps = (message("steps.tie_position"),)
        return Comparison(channels, True, ('tied = "position"',), steps)
    noisy = {c.rpartition(".")[2] for log in logs for c in log.channels if _only_noise(log, c)}
    if not noisy:
        return Comparison(channels)
    place = position_of(f".{min(noisy)}").removeprefix(".")
    words = [c for c in channels if c.rpartition(".")[2] not in ("qd", "v")]
    channels = (place, *words)
    quoted = ", ".join(f'"{word}"' for word in channels)
    line = f"channels = [{quoted}]"
    return Comparison(channels, False, (line,), (message("steps.compare_position", line=line),))


def _only_noise(log: Log, channel: str) -> bool:
    """Whether a rate is noise, and the log has a position that moves in its place."""
    place, values = position_of(channel), column(log.record, channel, log.record)
    if place == channel or place not in log.record or values is None:
        return False
    if float(np.ptp(log.record[place])) == 0.0:
        return False
    return noise_of(log.record, channel) ** 2 > SETTINGS.noise * float(np.var(values))


def _follows(log: Log, cylinder: str) -> bool:
    """Whether commands of a cylinder follow its position: the noise of that is in them."""
    place = position_channel(log.record, cylinder)
    if place is None:
        return False
    x = np.diff(log.record[place], 3)
    if x.size < 4 * SETTINGS.late or _alike(x[1:], x[:-1]) > SETTINGS.rough:
        return False
    commands = [
        np.diff(y, 3)
        for name, y in log.record.channels.items()
        if name.startswith(f"{cylinder}.") and name.endswith(".command")
    ]
    return any(
        abs(_alike(u[late:], x[: x.size - late])) > SETTINGS.follows
        for u in commands
        for late in range(SETTINGS.late + 1)
    )


def _alike(y: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two series about zero, 0 where one is zero."""
    size = float(np.linalg.norm(y) * np.linalg.norm(other))
    return float(y @ other) / size if size > 0.0 else 0.0
