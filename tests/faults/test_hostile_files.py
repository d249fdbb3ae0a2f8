"""Small files that crash a library, fill the memory or take for ever: one sentence each."""

import io
import os
import resource
import signal
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ehbench.data import readers
from ehbench.data.readers import READERS, Reader, open_source
from ehbench.runtime.confined import Bounds, Ended, confined
from ehbench.runtime.landlock import restrict
from ehbench.vocabulary.errors import LogError
from tests.shared import ROOT

SMALL = Bounds(memory=5e8, seconds=2.0, wait=20.0)


def sparse(path: Path) -> None:
    """3e8 values that were never written."""
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("p", (300_000_000,), dtype="f8", chunks=(1_000_000,))


def equal_values(path: Path) -> None:
    """A hundred million equal values in a dictionary."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    indices = pa.array(np.zeros(50_000_000, np.int8))
    column = pa.DictionaryArray.from_arrays(indices, pa.array([1.5]))
    with pq.ParquetWriter(path, pa.schema([("p", column.type)])) as file:
        for _ in range(4):
            file.write_table(pa.table({"p": column}), row_group_size=50_000_000)


def zeros(path: Path) -> None:
    """A MAT file of zeros, packed."""
    from scipy.io import savemat

    savemat(path, {"p": np.zeros((100_000_000, 1), np.uint8)}, do_compression=True)


def nested(path: Path) -> None:
    """Groups in groups: to name each takes as long as it is deep."""
    import h5py

    with h5py.File(path, "w") as file:
        group = file
        for _ in range(1500):
            group = group.create_group("g")
        group["p"] = np.arange(9.0)


BOMBS = {"a.h5": sparse, "deep.h5": nested, "a.parquet": equal_values, "a.mat": zeros}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_swells_is_refused(name, tmp_path):
    BOMBS[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size < 3_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError) as error:
        open_source(tmp_path / name)
    assert any(word in error.value.message for word in ("memory", "large", "deep"))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("cell", ["XFD1048576", "A1048576", "XFD3"])
def test_a_workbook_with_a_far_cell_is_read(cell, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in [["t [s]", "p [bar]"], *([i / 10, 5.0 + i] for i in range(30))]:
        book.active.append(row)
    book.active[cell] = 1.0
    book.save(tmp_path / "a.xlsx")
    (table,) = open_source(tmp_path / "a.xlsx").tables
    assert [column.name for column in table.columns[:2]] == ["t [s]", "p [bar]"]
    assert table.columns[1].values[:30].tolist() == [5.0 + i for i in range(30)]


def fill() -> None:
    np.ones(10**9).sum()


def spin() -> None:
    while True:
        pass


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def leave() -> None:
    os._exit(3)


@pytest.mark.parametrize(
    ("work", "key"),
    [
        (fill, "data.unreadable_as"),
        (spin, "data.reading_late"),
        (crash, "data.reading_crashed"),
        (leave, "data.reading_crashed"),
    ],
)
def test_a_library_that_misbehaves_is_a_sentence(work, key, tmp_path, monkeypatch):
    module = ModuleType("ehbench.data.readers.worst")
    module.read = lambda path, dialect: work()
    monkeypatch.setitem(sys.modules, module.__name__, module)
    worst = Reader("worst", (".worst",), "worst", "", (b"WORST",))
    monkeypatch.setattr(readers, "READERS", (*READERS, worst))
    settings = readers.ReaderSettings(memory=SMALL.memory, seconds=1.0)
    monkeypatch.setattr(readers, "SETTINGS", settings)
    (tmp_path / "a.worst").write_bytes(b"WORST")
    with pytest.raises(LogError) as error:
        open_source(tmp_path / "a.worst")
    assert error.value.key == key and error.value.exit_code == 2


def test_a_child_ends_with_the_wait_for_it_and_prints_nothing(capfd):
    """One that sleeps is not stopped by its computing; nothing of it is left."""
    with pytest.raises(Ended) as end:
        confined(lambda pipe: time.sleep(60.0), Bounds(1e9, 60.0, 0.3))
    assert end.value.late
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)

    def work(pipe: io.BufferedIOBase) -> None:
        os.write(1, b"noise")
        os.write(2, b"noise")
        pipe.write(bytes(3_000_000))

    assert confined(work, SMALL) == bytes(3_000_000)
    assert capfd.readouterr() == ("", "")


def test_a_child_opens_its_file_and_no_other(tmp_path):
    """As a file may name others that lie beside it, or anywhere."""
    (tmp_path / "given").write_text("given")
    (tmp_path / "other").write_text("other")

    def work(pipe: io.BufferedIOBase) -> None:
        Path("beside").write_text("what a library packs out")
        pipe.write((tmp_path / "given").read_bytes())
        for path in (tmp_path / "other", Path.home(), tmp_path):
            try:
                pipe.write(path.read_bytes() if path.is_file() else bytes(os.listdir(path)))
            except PermissionError:
                pipe.write(b" refused")
        try:
            (tmp_path / "new").write_text("new")
        except PermissionError:
            pipe.write(b" refused")

    result = confined(work, SMALL, [tmp_path / "given"])
    if confined(lambda pipe: pipe.write(bytes(restrict([], tmp_path))), SMALL) == b"":
        pytest.skip("this system has no Landlock")
    assert result == b"given refused refused refused refused"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["given", "other"]


def test_a_confined_reader_finds_the_files_of_the_package_however_it_is_installed(monkeypatch):
    monkeypatch.setattr(sys, "path", [name for name in sys.path if not (ROOT / name) == ROOT])
    texts = ROOT / "ehbench/vocabulary/messages/data.toml"
    result = confined(lambda pipe: pipe.write(texts.read_bytes()), SMALL)
    assert result == texts.read_bytes()
