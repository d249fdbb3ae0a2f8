"""Formats that need no compiled code: numbers and linear models for MATLAB, the mechanism."""

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ehbench.config.rig import Rig
from ehbench.export.component import distinct, identifier
from ehbench.export.content import Export, Written
from ehbench.export.linear import StateSpace, state_spaces
from ehbench.runtime.disk import replacing
from ehbench.vocabulary import EhbenchError, message, quantity
from ehbench.vocabulary.errors import one_line

KEYWORDS = set(
    "break case catch classdef continue else elseif end for function global if otherwise parfor"
    " persistent return spmd switch try while".split()
)
Fitted = Mapping[str, Mapping[str, Any]]  # rows of ``parameters.json`` by name


def write_matlab(export: Export, folder: Path) -> list[Written]:
    """Write parameters and linear models into ``matlab``."""
    spaces, note = [], ""
    try:
        spaces = state_spaces(export.rig, export.maps)
    except EhbenchError as error:
        note = message("export.no_linear", reason=error.message)
    files = matlab_files(export.rig, export.fitted, spaces)
    *others, last = _written(folder / "matlab", files, message("export.about_matlab"))
    return [*others, last._replace(note=note)]


def write_mechanism(
    export: Export, folder: Path, ending: str, text: Callable[[Rig], bytes]
) -> list[Written]:
    """Write the mechanism, as a ``text`` has it, into ``mechanism``."""
    carrying = export.rig.with_payload(export.trial.recipe.payload)
    files = {f"{export.rig.name}.{ending}": text(carrying)}
    return _written(folder / "mechanism", files, message("export.about_mechanism"))


def _written(folder: Path, files: dict[str, bytes], about: str) -> list[Written]:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        with replacing(folder / name) as place:
            place.write_bytes(content)
    return [Written(f"{folder.name}/{name}", about) for name in files]


def matlab_files(rig: Rig, fitted: Fitted, linear: Sequence[StateSpace]) -> dict[str, bytes]:
    """The files by name.

    In both ``p`` holds the value of each parameter [SI] in nested structs, ``p.boom.stroke``;
    ``info`` has its unit, 95 % interval (NaN where nobody estimated it), status and source at the
    same place. The MAT file has the state spaces as the struct array ``linear`` too.

    Args:
        rig: of which the numbers are.
        fitted: what identification says of some.
        linear: state spaces."""
    name = _matlab_name(rig.name)
    facts = dict(_places(_facts(rig, fitted)))
    lines = [
        f"% {rig.name}: SI. p: values; info: unit, 95 % interval, status, source.",
        f"% Linear models: load('{name}.mat'); sys = ss(linear(1).A, linear(1).B, linear(1).C, 0);",
    ]
    for path, row in facts.items():
        place, low, high = ".".join(path), *(_matlab_number(end) for end in row["interval"])
        texts = ", ".join(f"'{key}', {_quoted(row[key])}" for key in ("unit", "status", "source"))
        lines.append(f"p.{place} = {_matlab_number(row['value'])};  % [{row['unit']}]")
        lines.append(f"info.{place} = struct('interval', [{low}, {high}], {texts});")
    return {
        f"{name}_parameters.m": ("\n".join(lines) + "\n").encode(),
        f"{name}.mat": _mat(facts, linear),
    }


def _facts(rig: Rig, fitted: Fitted) -> dict[str, Any]:
    """What is known of each parameter, in tables by the words of its name; the keys of tables end
    in a dot."""
    tables: dict[str, Any] = {}
    for name, value in rig.parameters().items():
        row, inner = fitted.get(name, {}), tables
        *words, last = name.split(".")
        for word in words:
            inner = inner.setdefault(f"{word}.", {})
        inner[last] = {
            "value": float(value),
            "unit": quantity(name).unit,
            "interval": row.get("interval") or (math.nan, math.nan),
            "status": row.get("status", "fixed"),
            "source": one_line(value.source or ""),
        }
    return tables


def _places(
    tables: dict[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    names = distinct(map(_matlab_name, tables))
    for (word, item), name in zip(tables.items(), names, strict=True):
        if word.endswith("."):
            yield from _places(item, (*path, name))
        else:
            yield (*path, name), item


def _mat(facts: Mapping[tuple[str, ...], Mapping[str, Any]], linear: Sequence[StateSpace]) -> bytes:
    """The MAT file, the same bytes whenever it is written."""
    from scipy.io import savemat

    tables: dict[str, Any] = {"p": {}, "info": {}}
    for path, row in facts.items():
        about = {key: item for key, item in row.items() if key != "value"}
        about["interval"] = np.array([row["interval"]], dtype=float)
        for table, item in (("p", row["value"]), ("info", about)):
            inner = tables[table]
            for word in path[:-1]:
                inner = inner.setdefault(word, {})
            inner[path[-1]] = item
    rows = []
    for space in linear:
        names = (np.array(n, object) for n in (space.states, space.inputs, space.outputs))
        rows.append((space.name, *names, space.a, space.b, space.c, space.at, space.counts))
    columns = ("name", "states", "inputs", "outputs", "A", "B", "C", "at", "counts")
    tables["linear"] = np.array(rows, dtype=[(column, "O") for column in columns])
    file = io.BytesIO()
    savemat(file, tables, do_compression=True, long_field_names=True)
    header = b"MATLAB 5.0 MAT-file, written by ehbench".ljust(116)
    return header + file.getvalue()[116:]


def _matlab_name(word: str) -> str:
    plain = identifier(word)[:60]
    return f"c{plain}" if plain in KEYWORDS else plain


def _matlab_number(value: float) -> str:
    return repr(float(value)).replace("nan", "NaN").replace("inf", "Inf")


def _quoted(text: str) -> str:
    return "'" + str(text).replace("'", "''") + "'"
