"""Run folders as the report reads them; a missing key is an error with file and key."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict

from ehbench.config.recipe import load_rig
from ehbench.config.rig import Rig
from ehbench.data.logs.text import read_csv
from ehbench.data.text import head_of, text_table
from ehbench.runs.rundir import read_json, write_json
from ehbench.vocabulary import VOCABULARY, InputError, grouped, message, to_si
from ehbench.vocabulary.text import unlike

_INDEX = "figures/index.json"
_POINTS = "valve direction command pressure_drop flow fitted method outlier".split()


class Table(dict[str, Any]):
    """A JSON object of a run folder whose missing keys are the file's fault and not ours."""

    def __init__(self, values: Any, file: Path, where: str = "") -> None:
        if not isinstance(values, dict):
            raise InputError(message("report.no_table", name=where or "the file"), file=file)
        self._file, self._where = file, where
        super().__init__((key, self._wrap(value, self._name(key))) for key, value in values.items())

    def __missing__(self, key: str) -> Any:
        raise InputError(message("report.no_key", name=self._name(key)), file=self._file)

    def get(self, key: str, default: Any = None) -> Any:
        """The value, or ``default`` where the key is missing or null."""
        value = super().get(key)
        return default if value is None else value

    def having(self, key: str, value: Any) -> Table:
        """The same with another value."""
        return Table(self | {key: value}, self._file, self._where)

    def number(self, key: str) -> float | None:
        """A number, or None for null.

        Raises:
            InputError: missing or no number."""
        value = self[key]
        if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float))):
            text = message("report.not_a_number", name=f"{self._where}.{key}", value=value)
            raise InputError(text, file=self._file)
        return value

    def _name(self, key: str) -> str:
        return f"{self._where}.{key}" if self._where else key

    def _wrap(self, value: Any, name: str) -> Any:
        if isinstance(value, dict):
            return Table(value, self._file, name)
        if isinstance(value, list):
            return [self._wrap(item, f"{name}[{i}]") for i, item in enumerate(value)]
        return value


@dataclass(frozen=True)
class Series:
    """A saved comparison, SI: time [s] and, by channel, what was recorded and simulated."""

    t: np.ndarray
    recorded: dict[str, np.ndarray]
    simulated: dict[str, np.ndarray]

    def cylinders(self) -> dict[str, list[str]]:
        """Channels by cylinder (what stands before the last dot), commands left out."""
        channels = dict.fromkeys([*self.recorded, *self.simulated])
        seen = (channel for channel in channels if not channel.endswith(".command"))
        return grouped(seen, lambda channel: channel.rpartition(".")[0])


class _File(TypedDict, total=False):
    role: str
    path: str
    sha256: str


class _Facts(TypedDict, total=False):
    """The kinds of what every ``run.json`` holds, as far as it holds it."""

    stage: str
    name: str
    what: str | None
    title: str | None
    hash: str
    commit: str
    schema: int
    methods: dict[str, int]
    recipe: _File
    inputs: list[_File]
    outputs: dict[str, str]
    versions: dict[str, str]
    seeds: dict[str, int] | None
    warnings: list[str] | None
    details: list[str]
    recorded_on: str | list[str] | None


class Saved:
    """One run folder.

    Raises:
        InputError: its ``run.json`` is not there, or is none."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        if self.folder.exists() and not (self.folder / "run.json").exists():
            place = self.folder if self.folder.name else self.folder.resolve()
            raise InputError(message("report.no_run"), file=place)
        self.facts = self.json("run.json")
        try:
            TypeAdapter(_Facts).validate_python(self.facts, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            name, reason = (
                ".".join(map(str, first["loc"])),
                first["msg"][0].lower() + first["msg"][1:],
            )
            text = message("report.bad_fact", name=name, reason=reason)
            raise InputError(text, file=self.folder / "run.json") from None
        self.stage, self.name = self.facts["stage"], self.facts["name"]
        self.what = self.facts.get("what", "")

    @property
    def title(self) -> str:
        """The recipe's title, or its name as prose."""
        return self.facts.get("title") or self.name.replace("_", " ").capitalize()

    @property
    def has_rig(self) -> bool:
        """Whether the run left a rig."""
        return (self.folder / "rig.toml").is_file()

    @cached_property
    def rig(self) -> Rig:
        """The rig that the run left."""
        return load_rig(self.folder / "rig.toml")

    def json(self, name: str) -> Table:
        """A JSON file of the folder that holds a table.

        Raises:
            InputError: not there, not JSON, no table."""
        path = self.folder / name
        return Table(read_json(path), path)

    def rows(self, name: str) -> list[Table]:
        """A JSON file of the folder that holds a list of tables.

        Raises:
            InputError: not there, not JSON, no list of tables."""
        path = self.folder / name
        tables = read_json(path)
        if not isinstance(tables, list):
            raise InputError(message("report.no_tables"), file=path)
        return [Table(row, path, f"[{i}]") for i, row in enumerate(tables)]

    def figures(self) -> list[Table]:
        """What the run's figures are, in order: file, key, title, caption, about."""
        return self.json(_INDEX)["figures"]

    def series(self, log: str) -> Series | None:
        """The series of a log; None where it could not be simulated."""
        path = self.folder / "series" / f"{log}.csv"
        return read_series(path) if path.is_file() else None


class FigureIndex:
    """The figures of a run folder as they are drawn: hands out file names that do not collide.

    A figure's ``key`` is what a campaign names it by; ``about`` says what it shows: by these words
    a section finds it again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.figures: list[dict[str, Any]] = []

    def add(self, key: str, title: str, caption: str, kind: str, **about: str) -> Path:
        """The path to draw the figure ``key`` to."""
        taken = {figure["file"].removesuffix(".svg") for figure in self.figures}
        file = unlike(re.sub(r"[^A-Za-z0-9_.-]+", "_", key), taken) + ".svg"
        shows = {"kind": kind, **about}
        row = {"file": file, "key": key, "title": title, "caption": caption, "about": shows}
        self.figures.append(row)
        return self.folder / "figures" / file

    def save(self) -> None:
        """Write the index beside the figures."""
        path = self.folder / _INDEX
        path.parent.mkdir(exist_ok=True)
        write_json(path, {"figures": self.figures})


def read_series(path: Path) -> Series:
    """A saved comparison: columns ``t [s]``, ``boom.q [rad]`` (recorded) and ``simulated.boom.q
    [rad]``.

    Raises:
        LogError: no time, an unknown channel, a cell that is no number."""
    record = read_csv(path, check=False)
    sides: dict[str, dict[str, np.ndarray]] = {"recorded": {}, "simulated": {}}
    for name, values in record.channels.items():
        channel = name.removeprefix("simulated.")
        sides["recorded" if channel == name else "simulated"][channel] = values
    return Series(record.t, **sides)


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """A saved table of numbers as it is written: columns by their name without the unit, nan for an
    empty cell.

    Raises:
        InputError: a cell is no number."""
    table = text_table(path, "t [s],boom.q [rad]")
    columns = np.ascontiguousarray(table.floats(range(len(table.header))).T)
    return {head_of(name)[0]: column for name, column in zip(table.header, columns, strict=True)}


def read_points(path: Path) -> np.recarray:
    """Flowmeter readings as a flow-map run saved them, SI, a row a reading: ``valve, direction,
    command, pressure_drop, flow, fitted, method, outlier``.

    Raises:
        InputError: a column is missing, or a cell is no number."""
    table = text_table(path, "valve,direction,command [V],pressure_drop [kPa],flow [gpm]")
    heads = map(head_of, table.header)
    columns = {name: (i, unit) for i, (name, unit) in enumerate(heads)}
    values_of: dict[str, np.ndarray] = {}
    for name in _POINTS:
        if name not in columns:
            text = message("data.no_column", name=name, there=", ".join(columns))
            raise InputError(text, file=path, line=1)
        place, unit = columns[name]
        values_of[name] = np.array(table.cells(place), dtype=str)
        if name == "outlier":
            values_of[name] = values_of[name] == "1"
        elif row := VOCABULARY.get("flow" if name == "fitted" else name):
            values = table.floats([place])[:, 0]
            values_of[name] = to_si(values, unit, row) if unit else values
    # pyrefly: ignore[no-matching-overload]
    return np.rec.fromarrays([*values_of.values()], names=[*values_of])
