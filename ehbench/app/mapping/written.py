"""A draft of a map as TOML, and a picture of every column."""

import json
from pathlib import Path

import numpy as np

from ehbench.app.mapping.guesses import LIMITS, Guess
from ehbench.data.rates import apart
from ehbench.data.readers import Source, SourceColumn
from ehbench.report.style import ACCENT, MUTED, canvas, thin
from ehbench.signals.timestamps import rate_of_rounded
from ehbench.vocabulary import message

_SEPARATOR_KEYS = {"|": "pipe", "\t": "tab", " ": "space"}


def drafted(path: Path, source: Source, guesses: dict[str, Guess]) -> str:
    """The draft of a map as TOML: what is sure as keys, the rest as remarks."""
    lines = [
        *(f"# {line}" for line in message("app.draft_head", file=remark(path.name)).splitlines()),
        "",
        *_dialect(source),
        *_rate(source, guesses),
        *_policy(source, guesses),
        "",
        "[names]",
    ]
    for name, (i, j) in source.names().items():
        lines.append(_line(name, guesses[name], source.tables[i].columns[j]))
    for name in source.tables[0].words if source.tables else ():
        if name in guesses and guesses[name].channel and name not in source.names():
            lines.append(f"{_quoted(name)} = {_quoted(guesses[name].channel)}")
    return "\n".join(lines) + "\n"


def _dialect(source: Source) -> list[str]:
    result = source.dialect
    if result.separator is None:
        return []
    keys = {
        "separator": _SEPARATOR_KEYS.get(result.separator, result.separator),
        "decimal": result.decimal,
        "skip": result.skip,
        "unit_row": result.unit_row,
        "encoding": result.encoding,
    }
    lines = {key: f"{key} = {json.dumps(value)}" for key, value in keys.items()}
    for column in (column for table in source.tables for column in table.columns):
        if column.doubt is not None:
            doubt = column.doubt[1]
            keys = {"data.two_readings": "decimal", "data.integer_rounded": ""}
            key = keys.get(doubt.key, "day_first")
            if not key:
                continue
            lines[key] = f"# {key} = ?    # {remark(doubt, 200)}"
    return [*lines.values()]


def _rate(source: Source, guesses: dict[str, Guess]) -> list[str]:
    """The key ``rate``, where no table has a time."""
    names = source.names()
    if any(guess.channel == "flow" for guess in guesses.values()):
        return []  # readings have no time
    timed = {
        names[name][0] for name, guess in guesses.items() if guess.channel == "t" and guess.sure
    }
    if timed or any(table.t is not None for table in source.tables):
        return []
    for name, guess in guesses.items():
        if getattr(guess.remark, "key", "") == "app.time_rounded":
            values = source.tables[names[name][0]].columns[names[name][1]].values
            scale = {"ms": 1e-3, "us": 1e-6}.get(guess.unit, 1.0)
            rate = rate_of_rounded(values[np.isfinite(values)]) / scale
            note = message("app.rate_of_rounded", name=remark(name))
            return [f'rate = "{rate:.6g} Hz"                 # {note}']
    return ['# rate = "1 kHz"              # ' + message("app.no_time_column")]


def own_rows(source: Source, guesses: dict[str, Guess]) -> dict[str, np.ndarray]:
    """By column, the rows of its table that are those of its rate, True; all for a time."""
    names, result = source.names(), {}
    for index, table in enumerate(source.tables):
        here = {name: table.columns[j] for name, (i, j) in names.items() if i == index}
        result |= {name: np.ones(table.size, bool) for name in here}
        signals = [name for name in here if guesses[name].channel != "t"]
        groups = apart([here[name] for name in signals])
        if len(groups) > 1:
            result |= {signals[at]: rows for item, rows in groups for at in item}
    return result


def _policy(source: Source, guesses: dict[str, Guess]) -> list[str]:
    """The key ``bad_samples``, where cells of the mapped columns hold no number."""
    counts, size, rows = {}, 0, own_rows(source, guesses)
    for name, (i, j) in source.names().items():
        values = source.tables[i].columns[j].values[rows[name]]
        size = max(size, values.size)
        bad = int((~np.isfinite(values)).sum())
        if bad and guesses[name].sure:
            counts[name] = bad
    if not counts:
        return []
    places = ", ".join(f"{count} in {remark(name)}" for name, count in counts.items())
    few = max(counts.values()) <= max(LIMITS.few * size, 1)
    key = 'bad_samples = "leave out"' if few else '# bad_samples = "leave out"'
    return [f"{key}     # " + message("app.bad_cells", places=places)]


def _line(name: str, guess: Guess, column: SourceColumn) -> str:
    """A line of the map; a remark where nothing sure is known."""
    key, unit = _quoted(name), f" [{guess.unit}]" if guess.unit else ""
    keys = f'channel = "{guess.channel}"'
    if guess.ends is not None:
        first, last, low, high = guess.ends
        value = f'{{ {keys}, from = ["{first}", "{last}"], to = ["{low}", "{high}"] }}'
    elif guess.drop:
        value = f'{{ {keys}, unit = "{guess.unit}", pressure_drop = "{guess.drop}" }}'
    elif guess.offset:
        value = f'{{ {keys}, unit = "{guess.unit}", offset = "{guess.offset}" }}'
    else:
        value = _quoted((guess.channel or "?") + unit)
    about = ", ".join(part for part in (range_of(column), *guess.why, guess.remark) if part)
    mark = "" if guess.sure else "# "
    return f"{mark}{key} = {value}    # {guess.certainty}: {remark(about, 300)}"


def range_of(column: SourceColumn) -> str:
    known = column.values[np.isfinite(column.values)]
    if not known.size:
        return "no number"
    unit = f" {column.known_unit or remark(column.unit)}".rstrip()
    return f"{known.min():.4g} … {known.max():.4g}{unit}"


def _quoted(text: str) -> str:
    """A text of the file as TOML has it."""
    escaped = {'"': '\\"', "\\": "\\\\"}
    plain = (escaped.get(c, c) if c.isprintable() else f"\\U{ord(c):08x}" for c in text)
    return '"' + "".join(plain) + '"'


def remark(text: str, maximum: int = 60) -> str:
    """A text of the file as a remark may hold it."""
    return "".join(c if c.isprintable() else " " for c in text)[:maximum]


def draw(picture: Path, source: Source, guesses: dict[str, Guess]) -> None:
    """Each column over the time, or over its rows."""
    names, rows_of = source.names(), own_rows(source, guesses)
    columns = {name: source.tables[i].columns[j] for name, (i, j) in names.items()}
    shown = [name for name in names if guesses[name].channel != "t"]
    shown = [name for name in shown if np.isfinite(columns[name].values).any()][:24]
    shown = shown or list(names)[:1]
    rows = len(shown)
    with canvas(picture, rows, 1, (7.2, 1.35 * rows + 0.5), squeeze=False) as (_, axes):
        for ax, name in zip(axes[:, 0], shown):
            index = names[name][0]
            table, column = source.tables[index], columns[name]
            across, t = "row", np.arange(column.values.size, dtype=float)
            if table.t is not None:
                across, t = "time [s]", table.t
            for other, guess in guesses.items():
                if table.t is None and guess.channel == "t" and names[other][0] == index:
                    across, t = f"time [{guess.unit}]", columns[other].values
            good = np.isfinite(t)
            ax.plot(*thin(t[good], column.values[good]))
            guess = guesses[name]
            label = f" → {guess.channel}{'' if guess.sure else ' ?'}" if guess.channel else ""
            # a few bad samples among those of its rate
            bad = np.flatnonzero(rows_of[name] & ~np.isfinite(column.values))[:20].tolist()
            label += message("app.red_marks") if bad else ""
            unit = column.known_unit or column.unit
            ax.set_title(remark(name) + label, color="black" if guess.sure else MUTED)
            ax.set_ylabel(unit or "–")
            ax.set_xlabel(across)
            for at in bad:
                ax.axvline(t[at], color=ACCENT, linewidth=0.8)
