"""NumPy's archives and arrays: a column for each array, or several for a matrix or records; a table
for the arrays of one folder and length."""

import zipfile
from pathlib import Path

import numpy as np

from ehbench.data.readers.table import Dialect, Gathered, Source
from ehbench.runtime.memory import refuse_beyond
from ehbench.vocabulary import message


def read(path: Path, dialect: Dialect) -> Source:
    """The arrays of a file by name; pickled objects are not unpacked."""
    gathered = Gathered()
    losses = gathered.losses
    if not zipfile.is_zipfile(path):
        gathered.add("", path.stem, np.load(path, allow_pickle=False))
        return Source(gathered.tables())
    with zipfile.ZipFile(path) as archive:
        refuse_beyond(3.0 * sum(item.file_size for item in archive.infolist()))
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            place, _, last = name.rpartition("/")
            try:
                values = arrays[name]
            except ValueError as error:  # objects, or another file among the arrays
                reason = str(error).split(" when ")[0]
                losses.append(message("data.not_converted", name=name, reason=reason))
                continue
            of_numbers = isinstance(values, np.ndarray) and gathered.add(place, last, values)
            if not of_numbers and np.size(values) > 1:
                losses.append(message("data.not_read", name=name))
    return Source(gathered.tables(), losses=tuple(losses))
