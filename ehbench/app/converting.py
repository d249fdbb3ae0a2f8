"""Any log that is read, written as Parquet or MAT."""

import json
import re
from datetime import datetime
from pathlib import Path

import numpy as np

from ehbench.data import read
from ehbench.data.record import Record
from ehbench.runtime.disk import replacing
from ehbench.vocabulary import InputError, message, quantity
from ehbench.vocabulary.text import unlike


def convert(
    path: Path, to: str, out: Path | None = None, columns: Path | None = None
) -> tuple[Path, Record]:
    """Write a log, or that of a trial's run folder, as ``parquet`` or ``mat``, in SI; (the file,
    by default ``<name>.<to>`` here; the log's record).

    Raises:
        LogError: the log cannot be read.
        InputError: something stands there already, or what writes it is not installed."""
    log = path / "log.mcap" if (path / "log.mcap").is_file() else path
    named = path.resolve().name if log != path else path.name.partition(".")[0]
    out = out or Path(f"{named}.{to}")
    if out.exists() or out.is_symlink():
        raise InputError(message("app.stands_already"), file=out)
    record = read(log, columns=columns)
    try:
        with replacing(out) as part:
            {"parquet": _parquet, "mat": _mat}[to](part, record)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(message("app.unwritable", reason=reason), file=out) from None
    return out, record


def moments(record: Record) -> np.ndarray | None:
    """The wall clock of each sample (UTC, [ns]), None where the log does not say when it began."""
    if "began" not in record.meta:
        return None
    try:
        began = datetime.fromisoformat(record.meta["began"]).timestamp()
    except ValueError:
        return None
    whole = round(began * 1e6) * 1000 + np.rint(record.t * 1e9).astype(np.int64)
    return whole.astype("datetime64[ns]")


def _parquet(path: Path, record: Record) -> None:
    """A column a channel, its unit in the metadata of its field."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise InputError(message("app.no_pyarrow")) from None
    fields = [pa.field("t", pa.float64(), metadata={"unit": "s"})]
    values = [pa.array(record.t)]
    if (clock := moments(record)) is not None:
        fields.append(pa.field("time", pa.timestamp("ns", tz="UTC")))
        values.append(pa.array(clock, pa.timestamp("ns", tz="UTC")))
    for name, channel in record.channels.items():
        fields.append(pa.field(name, pa.float64(), metadata={"unit": quantity(name).unit}))
        values.append(pa.array(channel))
    about = {
        "ehbench": json.dumps({"meta": dict(record.meta), "losses": list(record.losses)}).encode()
    }
    with path.open("wb") as file:  # pyarrow takes no name that is not UTF-8
        pq.write_table(pa.table(values, schema=pa.schema(fields, metadata=about)), file)


def _mat(path: Path, record: Record) -> None:
    """A vector a channel, with dots as underscores; ``names`` and ``units`` by the same names."""
    from scipy.io import savemat

    if 8 * record.t.size >= 2**31:  # bytes of a variable in a MAT file
        raise InputError(message("app.mat_too_large", count=record.t.size))
    variables = dict(zip(record.channels, _variables(list(record.channels))))
    results: dict[str, object] = {"t": record.t[:, None]}
    if (clock := moments(record)) is not None:
        results["posix_time"] = clock.astype(np.int64)[:, None] / 1e9
    results |= {variables[name]: values[:, None] for name, values in record.channels.items()}
    results["units"] = {"t": "s", **{v: quantity(name).unit for name, v in variables.items()}}
    results["names"] = {"t": "t", **{v: name for name, v in variables.items()}}
    about = {key: text for key, text in record.meta.items() if len(text) < 1000}
    results["meta"] = dict(zip(_variables(list(about)), about.values())) or {"none": ""}
    if record.losses:
        results["losses"] = np.array(record.losses, object)
    with path.open("wb") as file:
        savemat(file, results, do_compression=True, long_field_names=True)


def _variables(names: list[str]) -> list[str]:
    """Names as MATLAB takes them, of 63 letters at most, each once and none of those taken."""
    results: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)[:60]
        plain = plain if plain[:1].isalpha() else f"c{plain}"
        taken = (*results, "t", "names", "units", "meta", "losses", "posix_time")
        results.append(unlike(plain, taken))
    return results
