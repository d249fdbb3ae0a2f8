"""A rig's numbers and linear models for MATLAB: ``NAME_parameters.m`` and ``NAME.mat``."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ehbench.config.rig import Rig, parameter_row
from ehbench.export.linear import StateSpace

Fitted = Mapping[str, Mapping[str, Any]]  # rows of ``parameters.json`` by name


def matlab_files(rig: Rig, fitted: Fitted, linear: Sequence[StateSpace]) -> dict[str, bytes]:
    """The files by name.

    In both ``p`` holds the value of each parameter [SI] in nested structs, ``p.boom.stroke``;
    ``info`` has its unit, 95 % interval (NaN where nobody estimated it), status and source at the
    same place. The MAT file has the state spaces as the struct array ``linear`` too.

    Args:
        rig: of which the numbers are.
        fitted: what identification says of some.
        linear: state spaces.
    """
    name = _matlab_name(rig.name)
    facts = dict(_facts(rig, fitted))
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


def _facts(rig: Rig, fitted: Fitted) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """What is known of each parameter, by its place in the structs."""
    for name, value in rig.parameters().items():
        row = fitted.get(name, {})
        yield (
            tuple(_matlab_name(word) for word in name.split(".")),
            {
                "value": float(value),
                "unit": parameter_row(name).unit,
                "interval": row.get("interval") or (math.nan, math.nan),
                "status": row.get("status", "fixed"),
                "source": value.source or "",
            },
        )


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
    """A word as MATLAB takes it for a name."""
    plain = re.sub(r"\W", "_", word, flags=re.ASCII)[:60]
    return plain if plain[:1].isalpha() else f"c{plain}"


def _matlab_number(value: float) -> str:
    return repr(float(value)).replace("nan", "NaN").replace("inf", "Inf")


def _quoted(text: str) -> str:
    return "'" + str(text).replace("'", "''") + "'"
