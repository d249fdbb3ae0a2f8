"""MDF 3 and 4 measurements, by asammdf: a table a channel group, on the group's own time;
conversion formulas are worked out without running anything of the file."""

import ast
import operator
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from asammdf import MDF

from ehbench.data.readers.table import Dialect, Source, SourceColumn, SourceTable, column_names
from ehbench.data.record import floats
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import LogError, message

DEPTH = 9  # of conversions that refer to conversions; a file with more is damaged
# kinds of channel by version: the group's time, written or counted; samples of different lengths
_CLOCKS, _VARYING = {3: (1,), 4: (2, 3)}, {3: (), 4: (1,)}
# kinds of conversion by version
_RATIONAL, _RANGES = {3: 9, 4: 2}, {3: -1, 4: 6}
_FORMULA_LIMIT = 400  # characters; every step of a formula costs a pass over all samples
_VARIABLES = ("X", "X1")  # the readings
_TOKEN = re.compile(r"[A-Za-z]\w*|(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?!\w)|[-+*/^(), ]", re.ASCII)
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
# name: function, arguments; "log" is none of them: it means ln here and log10 there
_FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    **{name: (getattr(np, name), 1) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: (getattr(np, name), 1) for name in ("exp", "log10", "sqrt", "abs")},
    **{f"a{name}": (getattr(np, f"arc{name}"), 1) for name in ("sin", "cos", "tan")},
    **{f"arc{name}": (getattr(np, f"arc{name}"), 1) for name in ("sin", "cos", "tan")},
    "ln": (np.log, 1),
    "pow": (np.power, 2),
}


def read(path: Path, dialect: Dialect) -> Source:
    """The groups of a measurement.

    Raises:
        LogError: a damaged file with a channel outside the records of its group."""
    with MDF(str(path)) as file:
        sizes = [group.channel_group.cycles_nr * len(group.channels) for group in file.groups]
        refuse_beyond(16.0 * sum(sizes))
        groups: list[Any] = file.groups
        for group in groups:  # asammdf reads and writes beyond the records, and dies
            head = group.channel_group
            room = 8 * (head.samples_byte_nr + getattr(head, "invalidation_bytes_nr", 0))
            for channel in group.channels:
                if _version(channel) == 4:
                    begin = 8 * channel.byte_offset + channel.bit_offset
                else:
                    begin = 8 * channel.additional_byte_offset + channel.start_offset
                if begin + channel.bit_count > room:
                    raise LogError(message("data.channel_outside_records", name=channel.name))
        began = file.start_time.timestamp() if file.start_time else None
        tables, losses = [], []
        for index, group in enumerate(file.groups):
            if not group.channel_group.cycles_nr:
                continue
            name = getattr(group.channel_group, "acq_name", "") or f"group {index + 1}"
            table, unread = _group(file, index, name, began)
            losses += unread
            if table.columns:
                tables.append(table)
    names = column_names([table.name for table in tables])
    tables = [replace(table, name=name) for name, table in zip(names, tables)]
    return Source(tuple(tables), losses=tuple(losses))


def _has_formula(conversion, depth: int = DEPTH) -> bool:
    """Whether a conversion is a formula, or refers to one.

    asammdf hands a formula to numexpr, which evaluates it as Python code, and returns the raw
    readings where that fails."""
    if conversion is None:
        return False
    if depth == 0 or getattr(conversion, "formula", None):
        return True
    references = getattr(conversion, "referenced_blocks", None) or {}
    blocks = [block for block in references.values() if hasattr(block, "conversion_type")]
    return any(_has_formula(block, depth - 1) for block in blocks)


def _converted(samples: np.ndarray, conversion) -> np.ndarray:
    """Readings converted here, those of the library as they are: asammdf evaluates formulas as
    Python code, works out polynomials in the readings' own integers, which overflow, and finds no
    integer in a table of ranges.

    Raises:
        LogError: the formula is not understood, or one in a table of others; an integer that no
            float is."""
    values = floats(samples)
    if conversion is None:
        return values
    kind, version = conversion.conversion_type, _version(conversion)
    if kind == _RANGES[version]:
        count = (conversion.val_param_nr - 1) // 3
        ranges = [[conversion[f"{key}_{n}"] for key in ("lower", "upper")] for n in range(count)]
        upper = np.less if samples.dtype.kind == "f" else np.less_equal
        inside = [(values >= low) & upper(values, high) for low, high in ranges]
        results = [conversion[f"phys_{n}"] for n in range(count)]
        return np.select(inside, results, conversion.default) if count else values
    if kind == _RATIONAL[version]:
        above, below = ([getattr(conversion, f"P{n}") for n in of] for of in ((1, 2, 3), (4, 5, 6)))
        with np.errstate(all="ignore"):
            return np.polyval(above, values) / np.polyval(below, values)
    if formula := getattr(conversion, "formula", None):
        return evaluate(formula.strip("\0 "), values)
    raise LogError(message("data.formula_among_others"))


def _group(file, index: int, name: str, began: float | None) -> tuple[SourceTable, list[str]]:
    """(a channel group, sentences on the channels in it that are not read).

    Raises:
        LogError: the time of the group is converted by a formula."""
    group, master = file.groups[index], file.masters_db.get(index)
    columns, unread, t = [], [], None
    if master is not None and _has_formula(group.channels[master].conversion):
        raise LogError(message("data.time_by_formula", name=name))
    by_library, by_raw = [], []
    for at, channel in enumerate(group.channels):
        conversion, version = channel.conversion, _version(channel)
        kind = getattr(conversion, "conversion_type", None)
        if channel.channel_type in _VARYING[version]:  # a damaged file crashes over them
            unread.append(message("data.not_read", name=f"{name}/{channel.name}"))
        elif at != master:
            here = _has_formula(conversion) or kind in (_RATIONAL[version], _RANGES[version])
            (by_raw if here else by_library).append(at)
    signals = {}
    for raw, places in ((False, by_library), (True, by_raw)):
        required = [(None, index, at) for at in places]
        selected = file.select(required, raw=raw, copy_master=False) if required else ()
        signals |= zip(places, selected, strict=True)
    for at, signal in sorted(signals.items()):
        samples = np.asarray(signal.samples)
        t = np.asarray(signal.timestamps, float)
        whole = f"{name}/{signal.name}"
        if samples.ndim != 1 or samples.dtype.kind not in "fiub":
            unread.append(message("data.not_read", name=whole))
            continue
        try:
            values = _converted(samples, group.channels[at].conversion if at in by_raw else None)
        except LogError as error:
            unread.append(message("data.not_converted", name=whole, reason=error.message))
            continue
        if signal.invalidation_bits is not None:
            values[np.asarray(signal.invalidation_bits, bool)] = np.nan
        columns.append(SourceColumn(signal.name, values, signal.unit or ""))
    names = column_names([column.name for column in columns])
    built = [replace(column, name=name) for name, column in zip(names, columns)]
    clock = None if master is None else group.channels[master]
    timed = clock is not None and clock.channel_type in _CLOCKS[_version(clock)]
    return SourceTable(name, tuple(built), t if timed else None, began), unread


def _version(channel) -> int:
    """Of the format that a block is of, 3 or 4."""
    return 4 if type(channel).__module__.endswith("v4_blocks") else 3


def evaluate(text: str, values: np.ndarray) -> np.ndarray:
    """What a formula such as ``25*(X1-0.4)`` makes of readings, NaN where that is no finite number.

    Raises:
        LogError: the formula has anything else in it than numbers, operators and functions."""
    calls = set(re.findall(r"[a-z]+(?=\s*\()", text.lower()[:_FORMULA_LIMIT]))
    key = "log" if "log" in calls else "condition" if calls & {"if", "iif"} else "not_understood"
    refusal = LogError(message(f"data.formula_{key}", formula=text[:_FORMULA_LIMIT]))
    if len(text) > _FORMULA_LIMIT or _TOKEN.sub("", text):
        raise refusal
    readings = values.astype(float)

    def value_of(node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return np.float64(number)
            case ast.Name() if node.id in _VARIABLES:
                return readings
            case ast.UnaryOp() if type(node.op) in _OPERATORS:
                return _OPERATORS[type(node.op)](value_of(node.operand))
            case ast.BinOp() if type(node.op) in _OPERATORS:
                return _OPERATORS[type(node.op)](value_of(node.left), value_of(node.right))
            case ast.Call(func=ast.Name(id=name), keywords=[]) if name.lower() in _FUNCTIONS:
                function, count = _FUNCTIONS[name.lower()]
                if len(node.args) == count:
                    return function(*map(value_of, node.args))
        raise refusal

    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval")
        with np.errstate(all="ignore"):
            result = np.broadcast_to(value_of(tree.body), readings.shape).astype(float)
    except (SyntaxError, ValueError, OverflowError, RecursionError, MemoryError):
        raise refusal from None
    return np.where(np.isfinite(result), result, np.nan)
