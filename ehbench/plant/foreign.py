"""A rig whose laws a user's FMU takes the place of: it is started, stepped and read by the names of
the rig's ``[model]``."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock

import numpy as np

from ehbench.config.rig import Rig
from ehbench.data.record import BlockAverages, Record
from ehbench.parts.cylinder import joint_of, linkage_arrays
from ehbench.physics.arm import SLIDE
from ehbench.plant.build import Kept, Maps
from ehbench.plant.integrate import STEP
from ehbench.plant.model import FREE, Model, Start
from ehbench.plant.paced import Step
from ehbench.plant.ties import late_of, supplied, tied_words
from ehbench.runtime.fmu import FmuProcess, Variable, fmu_of
from ehbench.vocabulary import InputError, LogError, message, quantity
from ehbench.vocabulary.errors import FmuError

SAME = {"q": "x", "x": "q", "qd": "v", "v": "qd"}  # what a linkage makes of each


class Binding:
    """The variables of an FMU by the names of a rig, and its idle processes."""

    def __init__(self, file: Path, tables: Mapping[str, Mapping[str, str]]) -> None:
        self.fmu = fmu_of(file)
        self.names = {key: tuple(table) for key, table in tables.items()}
        self.variables: dict[str, list[Variable]] = {}
        for key, table in tables.items():
            self.variables[key] = []
            for given, name in table.items():
                row = quantity("command" if key == "commands" else given)
                unit = row.unit if row.name != "number" else None  # that of the FMU
                self.variables[key].append(self.fmu.variable(name, unit, key))
        self._idle: list[FmuProcess] = []
        self._lock = Lock()

    def open(self) -> FmuProcess:
        """A process of the caller's own."""
        given = [*self.variables["settable"], *self.variables["start"]]
        lists = {"start": given} | {key: self.variables[key] for key in ("commands", "channels")}
        references = {key: [item.reference for item in row] for key, row in lists.items()}
        return FmuProcess(self.fmu, references)

    @contextmanager
    def process(self) -> Iterator[FmuProcess]:
        """A process, which stays for the next who asks, but for one that failed."""
        with self._lock:
            process = self._idle.pop() if self._idle else None
        process = process or self.open()
        try:
            yield process
        except BaseException:
            process.close()
            raise
        with self._lock:
            self._idle.append(process)

    def taken(self, *keys: str) -> tuple[np.ndarray, np.ndarray]:
        """(factors, offsets) from the FMU's numbers to SI, of tables one behind the other."""
        items = [item for key in keys for item in self.variables[key]]
        return np.array([i.factor for i in items]), np.array([i.offset for i in items])


# by the file, when it was written, and the tables as pairs
_bound = lru_cache(maxsize=8)(
    lambda file, stamp, tables: Binding(file, {key: dict(pairs) for key, pairs in tables})
)


@dataclass(frozen=True)
class FmuModel(Model):
    """A model whose replays its rig's FMU makes; where they start is as the laws have it."""

    @property
    def binding(self) -> Binding:
        """The variables of the FMU.

        Raises:
            InputError: there is no such file or variable, or it is not for this platform."""
        model = self.rig.model
        assert model is not None  # else it is a `Model`
        keys = ("channels", "commands", "settable", "start")
        tables = tuple((key, tuple(getattr(model, key).items())) for key in keys)
        stamp = model.place.stat().st_mtime_ns if model.place.exists() else 0
        return _bound(model.place, stamp, tables)

    def starts(self, number: str) -> bool:
        """Whether a number of an initial state is one that the FMU takes."""
        owner, _, word = number.rpartition(".")
        known = self.binding.names["start"]
        return number in known or f"{owner}.{SAME.get(word, word)}" in known

    def shows(self, channel: str) -> bool:
        """Whether the FMU gives a channel."""
        return channel in self.completed(
            {name: np.zeros(1) for name in self.binding.names["channels"]}, Start(np.zeros(0))
        )

    def values_at(self, start: Start) -> np.ndarray:
        """What the FMU is given before it begins, in its units: parameters, then first values."""
        binding, known = self.binding, self.rig.parameters()
        values = [float(known[name]) for name in binding.names["settable"]]
        for name in binding.names["start"]:
            owner, _, word = name.rpartition(".")
            if not owner:
                supply, tank = start.supply, start.tank
                given = supply if word == "p_supply" else tank
                plant = self.plant
                rig = plant.supply.pressure if word == "p_supply" else plant.tank_pressure
                values.append(float(rig if given is None else given))
                continue
            index = self.layout.cylinders.index(owner)
            row = self.plant.cylinders[index]
            if word.startswith("p_"):
                values.append(float(start.y[self.layout.state(word, index)]))
                continue
            q, qd = (start.y[self.layout.state(each, int(row.joint))] for each in ("q", "qd"))
            x, lever = linkage_arrays(row, np.array([q]))
            values.append(float({"q": q, "qd": qd, "x": x[0], "v": lever[0] * qd}[word]))
        factor, offset = binding.taken("settable", "start")
        return (np.array(values) - offset) / factor

    def commanded(self, commands: np.ndarray) -> np.ndarray:
        """Commands [V], shape (…, valves), as the FMU takes them."""
        binding = self.binding
        order = [self.layout.valves.index(name) for name in binding.names["commands"]]
        factor, offset = binding.taken("commands")
        return (commands[..., order] - offset) / factor

    def channels_of(self, rows: np.ndarray, start: Start) -> dict[str, np.ndarray]:
        """Rows of the FMU's numbers as channels [SI], with what follows from them."""
        factor, offset = self.binding.taken("channels")
        columns = (rows * factor + offset).T
        return self.completed(dict(zip(self.binding.names["channels"], columns)), start)

    def completed(self, given: Mapping[str, np.ndarray], start: Start) -> dict[str, np.ndarray]:
        """Channels with what follows from them: angles or strokes, set pressures of supply and
        tank."""
        channels = dict(given)
        for name, row in zip(self.layout.cylinders, self.plant.cylinders, strict=True):
            q, x, v, qd = (channels.get(f"{name}.{word}") for word in ("q", "x", "v", "qd"))
            if q is None and x is not None:
                reached = np.clip(x, 0.0, float(row.stroke))
                q = x if self.plant.kind == SLIDE else joint_of(row, reached)
            if q is None:
                continue
            stroke, lever = linkage_arrays(row, np.asarray(q, dtype=float))
            v = lever * qd if v is None and qd is not None else v
            qd = v / lever if qd is None and v is not None else qd
            motion = {"q": q, "x": stroke if x is None else x, "v": v, "qd": qd}
            channels |= {f"{name}.{word}": y for word, y in motion.items() if y is not None}
        size = len(next(iter(given.values())))
        for name, pressure, usual in (
            ("p_supply", start.supply, self.plant.supply.pressure),
            ("p_tank", start.tank, self.plant.tank_pressure),
        ):
            channels.setdefault(name, np.full(size, float(usual if pressure is None else pressure)))
        return channels

    def replay(self, record: Record, step: Step = STEP, start: Start | None = None) -> Record:
        """As `Model.replay`, by the FMU; ``step`` is its own affair.

        Raises:
            LogError: uneven time.
            InputError: a recording that ties motions or the supply.
            FmuError: the FMU crashes, hangs, reports an error or numbers that are not finite."""
        if not record.even:
            raise LogError(message("plant.uneven"))
        if tied_words(record) or supplied(record):
            raise InputError(message("plant.fmu_tied"))
        start = start or self.rest_start(record)
        table = self.commands_of(record)
        share = np.zeros(table.shape[1])  # of a sample, over which an FMU has the mean
        share[: len(self.layout.valves)] = late_of(record, self.layout.valves) / record.sample_time
        given = self.commanded(table - share * np.diff(table, axis=0, prepend=table[:1]))
        with self.binding.process() as process:
            first = process.start(np.concatenate([self.values_at(start), given[0]]))
            rows = np.vstack([first, process.steps(given[:-1], record.sample_time)])
        if len(rows) < record.t.size or not np.isfinite(rows).all():
            bad = int(np.argmin(np.isfinite(rows).all(axis=1)))
            channel = self.binding.names["channels"][int(np.argmin(np.isfinite(rows[bad])))]
            t = float(record.t[bad])
            text = message("plant.fmu_not_finite", channel=channel, t=t)
            raise FmuError(text, file=self.binding.fmu.file)
        channels = self.channels_of(rows, start)
        commands = {f"{name}.command": table[:, i] for i, name in enumerate(self.layout.valves)}
        return Record(record.t, channels | commands, record.meta)

    def replay_paced(
        self,
        record: Record,
        start: Start,
        mesh: np.ndarray = FREE,
        slack: float = 1.0,
        means: BlockAverages | None = None,
    ) -> tuple[Record, np.ndarray]:
        """As `Model.replay_paced`: `replay`, every sample of it, and no steps."""
        return self.replay(record, start=start), FREE


def model_of(
    rig: Rig, maps: Maps | None = None, payload: str | None = None, shared: Kept | None = None
) -> Model:
    """What replays recordings of a rig: `Model.of`, or its FMU.

    Raises:
        InputError: as `Model.of`."""
    return (Model if rig.model is None else FmuModel).of(rig, maps, payload, shared)
