"""Odd spellings, formulas with code, files that swell, names of any bytes, figures with rules."""

import gzip
import io
import os
import re
import tempfile
import zipfile
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np

from ehbench.app import mapping
from ehbench.config.recipe import ColumnMap
from ehbench.config.recipe.columns import Columns, MappedColumn
from ehbench.data import read
from ehbench.data.readers import open_source
from ehbench.vocabulary.errors import LogError

ROWS = 12


class Written(NamedTuple):
    """A file: its name, its bytes, and what its column of forces means [N] (None: not known)."""

    name: str
    data: bytes
    values: np.ndarray | None = None
    time: np.ndarray | None = None


def take_written(given: Written, folder: Path) -> None:
    """It is read by a map of its two columns: refused, or the numbers that were written."""
    path = folder / os.fsdecode(given.name)
    path.write_bytes(given.data)
    names = {
        "t": MappedColumn(channel="t", unit="s"),
        "p": MappedColumn(channel="ram.load_force", unit="N"),
    }
    record = read(path, ColumnMap(Columns(names=names)))
    if given.values is not None and record.t.size == given.values.size:
        known = np.isfinite(given.values)
        wrong = record["ram.load_force"][known] - given.values[known]
        assert np.allclose(wrong, 0.0, atol=1e-6), "numbers changed silently"
    if given.time is not None and record.t.size == given.time.size:
        assert np.allclose(record.t - record.t[0], given.time - given.time[0], atol=2e-6), (
            "times changed silently"
        )


# --- spellings of numbers and times


def _grouped(text: str, mark: str, sign: str) -> str:
    whole, _, rest = text.partition(".")
    digits = whole.lstrip("-")
    groups = [digits[max(end - 3, 0) : end] for end in range(len(digits), 0, -3)][::-1]
    return "-" * whole.startswith("-") + mark.join(groups) + (sign + rest if rest else "")


CLOCKS: dict[str, Callable[[datetime], str]] = {
    "iso": lambda at: at.isoformat(sep=" ", timespec="microseconds"),
    "iso T": lambda at: at.isoformat(timespec="milliseconds"),
    "dots": lambda at: at.strftime("%d.%m.%Y %H:%M:%S.%f"),
    "slashes": lambda at: at.strftime("%d/%m/%Y %H:%M:%S.%f"),
    "american": lambda at: at.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
    "short": lambda at: at.strftime("%m/%d/%y %H:%M:%S.%f"),
    "named": lambda at: at.strftime("%d-%b-%Y %H:%M:%S.%f"),
    "time of day": lambda at: at.strftime("%H:%M:%S.%f"),
    "minutes": lambda at: at.strftime("%M:%S.%f"),
    "duration": lambda at: f"0 days {at.strftime('%H:%M:%S.%f')}",
}


def spelled(rng: Random) -> Written:
    """A table of time and force in a random dialect, some cells odd or without a value."""
    step = rng.choice((0.001, 0.01, 0.1, 1.0))
    time = np.arange(ROWS) * step
    top = rng.choice((9.0, 90.0, 900.0, 2_000.0, 90_000.0, 3e6))
    places = rng.choice((0, 0, 1, 2, 3, 6))
    values = np.array([round(rng.uniform(-0.2, 1.0) * top, places) for _ in time])
    decimal = rng.choice(".,")
    separator = rng.choice([mark for mark in (",", ";", "\t", "; ") if mark != decimal])
    mark = rng.choice(("", "", "," if decimal == "." else ".", "'", "\u00a0", "\u202f", " "))
    share, quote = rng.choice((0.0, 0.1, 1.0)), rng.random() < 0.3 or mark == separator
    minus, odd = rng.choice(("-", "-", "\u2212")), rng.choice(("", "", "", "NaN", "---", "OVLD"))
    cells = []
    for row, value in enumerate(values):
        text = f"{value:.{places}f}"
        spell = _grouped(text, mark if rng.random() < share else "", decimal)
        spell = spell.replace("-", minus)
        if odd and rng.random() < 0.1 and 0 < row < ROWS - 1:
            spell, values[row] = odd, np.nan
        cells.append(f'"{spell}"' if quote else spell)
    if rng.random() < 0.5:
        times = [f"{value:.3f}".replace(".", decimal) for value in time]
    else:
        first = datetime(2026, rng.randrange(1, 13), rng.randrange(1, 29), 12, 59, 59, 500_000)
        form = CLOCKS[rng.choice(list(CLOCKS))]
        times = [form(first + timedelta(seconds=float(value))) for value in time]
    lines = [separator.join(("t", "p")), *map(separator.join, zip(times, cells))]
    end, encoding = rng.choice(("\n", "\r\n")), rng.choice(("utf-8", "utf-8-sig", "utf-16"))
    return Written("a.csv", (end.join(lines) + end).encode(encoding), values, time)


def columns_odd(rng: Random) -> Written:
    """A table with sentinels, wrapped angles, several times, double names, empty cells."""
    time = np.arange(40) / rng.choice((10.0, 1000.0))
    heads = ["Time", rng.choice(("p3_bar", "PT-101 [PSI]", "valve (mA)", "x\n[mm]", "angle °", ""))]
    columns = [time, 50.0 + 10.0 * np.sin(time)]
    for _ in range(rng.randrange(4)):
        heads.append(rng.choice((heads[-1], "Time", "Tstart", "%", "\u2212", "n [RPM]", "Pa_Pa")))
        columns.append(rng.choice((time * 2.0, np.cumsum(0.3 * time), 100.0 * np.cos(time))))
    table = np.round(np.column_stack(columns), 4)
    sentinel = rng.choice((-999.25, 9999.0, 1e37, -1e38, 32767.0, 65535.0, 0.0))
    table[rng.randrange(40), rng.randrange(table.shape[1])] = sentinel
    if rng.random() < 0.3:
        table[:, -1] %= rng.choice((360.0, 2.0 * np.pi, 4096.0))
    rows = [[f"{value:g}" for value in row] for row in table]
    for _ in range(rng.randrange(4)):
        row = rng.choice(rows)
        row[rng.randrange(len(row))] = rng.choice(("", " ", "x", "1e", "٣", "#REF!", "-", "12:00"))
    if rng.random() < 0.1:
        del rng.choice(rows)[-1]
    quoted = [f'"{head}"' if "\n" in head else head for head in heads]
    text = "\n".join(",".join(row) for row in [quoted, *rows])
    return Written("a.csv", text.encode())


def take_draft(given: Written, folder: Path) -> None:
    """A map is drafted of it."""
    path = folder / os.fsdecode(given.name)
    path.write_bytes(given.data)
    source = open_source(path)
    mapping.drafted(path, source, mapping.guessed(source, None))


def stacked(rng: Random) -> Written:
    """Tables below one another, under one head that comes again or under others; what the columns
    called p hold together."""
    lines, values = [], []
    for table in range(rng.randrange(1, 5)):
        name = "p" if table == 0 else rng.choice("pppx")
        lines += [f"Run;{table}"] * rng.randrange(2) + [f"t;{name}"] + ["s;N"] * rng.randrange(2)
        for row in range(rng.choice((3, 10, 25, 60))):
            number = round(rng.uniform(-9.0, 9.0), 3) + 0.0001
            lines.append(f"{len(lines) / 100:.2f};{number:.4f}")
            values += [number] if name == "p" else []
        lines += [""] * rng.randrange(1, 3)
        lines += [rng.choice(("Operator;me", "Remark", "end of run;1;2"))] * (rng.random() < 0.2)
    return Written("a.csv", "\n".join(lines).encode(), np.array(values))


def take_stacked(given: Written, folder: Path) -> None:
    """Its numbers stand under their names, or a cell that is none shows where they do not."""
    path = folder / given.name
    path.write_bytes(given.data)
    tables = open_source(path).tables
    columns = [column for table in tables for column in table.columns]
    each = [column.values for column in columns if column.name.startswith("p")]
    found, truth = np.concatenate([np.zeros(0), *each]), np.asarray(given.values)
    same = found.size == truth.size and np.allclose(found, truth, atol=1e-9)
    assert same or any(cell for column in columns for cell in column.odd.values()), "numbers moved"


# --- formulas


WIDTH = 220  # characters of a formula
WORDS = ("X1", "X", "1", "25", "0.4", "1e999", "+", "-", "*", "/", "^", "**", "(", ")", ",", " ")
CALLS = ("sin(", "ln(", "pow(", "abs(", "if(", "max(", "__import__(", "open(", "lambda:", "'", '"')
HOSTILE = (
    """("'", (lambda: open('ran', 'w'))(), "'")""",
    """("'",__import__('os').mkdir('ran'),"'")""",
    "9**9**9**9",
    "X1" + "**X1" * 50,
    "(" * 100 + "X1" + ")" * 100,
    "X1.__class__.__mro__",
)


@cache
def template() -> bytes:
    """An MDF 4 file whose force goes by a formula of blanks."""
    from asammdf import MDF, Signal

    time = np.arange(ROWS) / 100.0
    formula = {"formula": "X1".ljust(WIDTH, "_"), "__class__": "x"}
    with tempfile.TemporaryDirectory() as folder, MDF(version="4.10") as file:
        # pyrefly: ignore[bad-argument-type]
        signal = Signal(np.arange(ROWS) * 1.0, time, unit="N", name="p", conversion=formula)
        file.append([signal])
        file.save(Path(folder) / "a.mf4", overwrite=True)
        return (Path(folder) / "a.mf4").read_bytes()


def formula(rng: Random) -> Written:
    """An MDF 4 file with a random formula, some of them with code in it."""
    text = rng.choice(HOSTILE)
    if rng.random() < 0.7:
        text = "".join(rng.choice((*WORDS, *CALLS)) for _ in range(rng.randrange(1, 12)))
    data = template()
    assert b"X1".ljust(WIDTH, b"_") in data
    return Written("a.mf4", data.replace(b"X1".ljust(WIDTH, b"_"), text.encode().ljust(WIDTH)))


def take_formula(given: Written, folder: Path) -> None:
    """It is read where code would leave a mark."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        take_draft(given, folder)
    finally:
        os.chdir(before)
        assert not (folder / "ran").exists(), "code of a file ran"


# --- small files that swell, names, figures


def _zip(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as book:
        for name, data in members.items():
            book.writestr(name, data)
    return file.getvalue()


def bomb(rng: Random) -> Written:
    """A small file that is large inside, or refers to itself or to other files."""
    import h5py

    size = rng.choice((10**6, 5 * 10**6))
    kind = rng.randrange(6)
    if kind == 0:
        return Written("a.csv.gz", gzip.compress(b"t,p\n" + b"0,0\n" * (size // 4), 1, mtime=0))
    if kind == 1:
        return Written("a.xlsx", _zip({"[Content_Types].xml": b" " * size}))
    if kind == 2:
        return Written("a.zip", _zip({f"{n}.csv": b"t,p\n" for n in range(size // 10**4)}))
    file = io.BytesIO()
    with h5py.File(file, "w") as book:
        if kind == 3:
            book.create_dataset("p", (size * 10,), dtype="f8", chunks=(10**6,))
        elif kind == 4:
            layout = h5py.VirtualLayout((ROWS,), "f8")
            layout[:] = h5py.VirtualSource(".", "p", (ROWS,))
            book.create_virtual_dataset("p", layout)
        else:
            book.create_dataset("p", (ROWS,), "u1", external=[("/etc/passwd", 0, ROWS)])
            book["loop"] = h5py.SoftLink("/loop")
    return Written("a.h5", file.getvalue())


def named(rng: Random) -> Written:
    """A sound table under a name of any bytes."""
    letters = [byte for byte in range(1, 256) if byte != ord("/")]
    stem = bytes(rng.choice(letters) for _ in range(rng.randrange(1, 60)))
    text = "t;p\n" + "".join(f"{row / 100:g};{row}.5\n" for row in range(ROWS))
    time = np.arange(ROWS) / 100.0
    name = os.fsdecode(stem + b".csv")
    return Written(name, text.encode(), np.arange(ROWS) + 0.5, time)


RULES = ("} .warn {display:none} .x{", "</style><script>1</script>", "}@import 'x';{", "}\\{")


def figure(rng: Random) -> str:
    """A figure with rules of a style sheet in its texts, attributes and styles."""
    rule, inside = (
        rng.choice(RULES),
        rng.choice((' style="{}"', " style='{}'", "{}", "<!-- {} -->")),
    )
    text = inside.format(rng.choice(("", "fill:red;")) + rule)
    text = text.replace("<", "&lt;") if rng.random() < 0.5 else text
    texts = (f"<text>{text}</text>", f'<g id="a" {text}/>', f"<style>{text}</style>")
    inner = "".join(rng.choice(texts) for _ in range(rng.randrange(1, 4)))
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><g>{inner}</g></svg>'


def take_figure(svg: str, _: Path) -> None:
    """It is made part of a page; no rule of its own gets into the page's style sheet."""
    from ehbench.report.blocks import inline

    looks: dict[str, str] = {}
    try:
        body = inline(svg, "f-", "a title", looks)
    except ValueError as error:
        raise LogError(str(error)) from None
    assert not re.search(r"[{}<>@\\]", "".join(looks)), "a rule in the page's style sheet"
    assert "<script" not in body and "<style" not in body, "code in the page"


RECORDERS: dict[str, tuple[Callable[[Random], Any], Callable[[Any, Path], None], float]] = {
    "spelled tables": (spelled, take_written, 0.04),
    "stacked tables": (stacked, take_stacked, 0.02),
    "odd columns": (columns_odd, take_draft, 0.03),
    "MDF formulas": (formula, take_formula, 0.01),
    "bombs": (bomb, take_draft, 0.002),
    "file names": (named, take_written, 0.03),
    "figures": (figure, take_figure, 0.02),
}
