"""Logs cut, flipped, holed and mistyped: true samples come back, and what is missing is said."""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from ehbench.data import read
from ehbench.data.logs import LogWriter, write_log
from ehbench.data.record import Record
from ehbench.vocabulary.errors import EhbenchError, LogError, UnitError

SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "mcap"
NAMES = ["boom.q", "boom.p_head", "boom.hect.command"]
CHUNK = 200  # samples; a reader meets each chunk, so six small ones tell what large ones do


@pytest.fixture(scope="module")
def truth() -> Record:
    rng = np.random.default_rng(7)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 6 * CHUNK))
    channels = {name: rng.uniform(0, 10, t.size) for name in NAMES}
    return Record(t, channels, {"rig": "a rig"}, {"rig.toml": b"[rig]\nname = 'a rig'\n" * 20})


@pytest.fixture(scope="module")
def log(truth, tmp_path_factory) -> bytes:
    """A closed log of six chunks, made live so that the chunks are small."""
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    table = np.stack(list(truth.channels.values()), axis=1)
    with LogWriter(path, NAMES, truth.meta, truth.attachments, sync=None) as writer:
        for start in range(0, truth.t.size, CHUNK):
            writer.extend(truth.t[start : start + CHUNK], table[start : start + CHUNK])
            writer.flush()
    return path.read_bytes()


def records(data: bytes) -> list[tuple[int, int, int]]:
    """(opcode, first byte, end) of every record."""
    found, at = [], 8
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def judge(path: Path, data: bytes, truth: Record) -> Record | None:
    """Read broken bytes: a LogError, or true samples with a word about what is not there."""
    path.write_bytes(data)
    try:
        back = read(path)
    except LogError:
        return None
    at = np.searchsorted(truth.t, back.t)
    assert np.array_equal(truth.t[at], back.t)
    assert list(back.channels) == NAMES
    for name in NAMES:
        assert np.array_equal(truth[name][at], back[name])
    facts = (back.meta, back.attachments) == (truth.meta, truth.attachments)
    assert back.losses or (facts and back.t.size == truth.t.size)
    return back


def test_the_unbroken_log_has_no_losses(log, truth, tmp_path):
    back = judge(tmp_path / "a.mcap", log, truth)
    assert back.losses == () and back.t.size == truth.t.size


def test_cut_anywhere(log, truth, tmp_path):
    rng = np.random.default_rng(1)
    chunks = [(first, stop) for opcode, first, stop in records(log) if opcode == 6]
    data_end = next(first for opcode, first, _ in records(log) if opcode == 15)
    cuts = [*rng.integers(0, len(log), 150), *range(12), *(len(log) - n for n in range(1, 40))]
    for cut in map(int, cuts):
        back = judge(tmp_path / "a.mcap", log[:cut], truth)
        whole = sum(stop <= cut for _, stop in chunks)
        # a cut costs no chunk that is there in full
        assert (back.t.size if back else 0) == whole * CHUNK
        if back and cut < data_end:
            last = back.losses[-1]
            assert last.key == "data.breaks_off"
            assert last.fields["last"] == f"{truth.t[whole * CHUNK - 1]:.9g} s"
        elif back:
            assert back.losses


def test_a_cut_says_how_many_bytes_are_gone(log, truth, tmp_path):
    _, first, stop = [each for each in records(log) if each[0] == 6][5]
    back = judge(tmp_path / "a.mcap", log[: stop - 10], truth)
    fields = {key: back.losses[0].fields[key] for key in ("first", "last", "size")}
    assert fields == {"first": first, "last": stop - 10, "size": stop - 10}


def test_random_bit_flips_never_change_a_sample(log, truth, tmp_path):
    rng = np.random.default_rng(2)
    read = 0
    for _ in range(400):
        data = bytearray(log)
        for _ in range(rng.integers(1, 4)):
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        back = judge(tmp_path / "a.mcap", bytes(data), truth)
        assert back is None or back.losses  # nothing in the file is without a checksum
        read += back is not None
    assert read > 350


@pytest.mark.slow
def test_every_bit_of_every_record_head(log, truth, tmp_path):
    heads = [
        (opcode, first)
        for opcode in range(1, 16)
        for first in [first for each, first, _ in records(log) if each == opcode][::2]
    ]
    for opcode, first in heads:
        for bit in range(72):
            data = bytearray(log)
            data[first + bit // 8] ^= 1 << bit % 8
            back = judge(tmp_path / "a.mcap", bytes(data), truth)
            assert back is not None
            # a broken head costs at most the chunk it belongs to or, swallowed by a wrong length,
            # the one behind it
            assert back.t.size >= truth.t.size - 2 * CHUNK, (opcode, bit, back.losses)


def test_a_damaged_chunk_is_named_and_the_rest_kept(log, truth, tmp_path):
    chunks = [(first, stop) for opcode, first, stop in records(log) if opcode == 6]
    for n, (first, stop) in enumerate(chunks):
        data = bytearray(log)
        data[(first + stop) // 2] ^= 16
        back = judge(tmp_path / "a.mcap", bytes(data), truth)
        assert back.t.size == truth.t.size - CHUNK
        assert back.losses[0].startswith(f"bytes {first} to {stop} of {len(log)} are lost")
        if 0 < n < len(chunks) - 1:
            before, after = truth.t[CHUNK * n - 1], truth.t[CHUNK * (n + 1)]
            fields = back.losses[1].fields
            assert (fields["count"], fields["most"]) == (CHUNK, CHUNK)
            assert (fields["first"], fields["last"]) == (before, after)
        if n == 0:
            fields = back.losses[1].fields
            assert (fields["count"], fields["t"]) == (CHUNK, truth.t[CHUNK])


def test_holes_and_doubled_bytes(log, truth, tmp_path):
    rng = np.random.default_rng(3)
    for _ in range(100):
        first = int(rng.integers(len(log)))
        size = int(rng.integers(1, 5000))
        holed = log[:first] + bytes(min(size, len(log) - first)) + log[first + size :]
        for data in (
            holed,
            log[:first] + log[first + size :],
            log[:first] + rng.bytes(size) + log[first:],
        ):
            back = judge(tmp_path / "a.mcap", data, truth)
            assert back is None or back.losses


def test_flips_in_foreign_files_raise_nothing_else(tmp_path):
    rng = np.random.default_rng(4)
    files = sorted(SHARED.rglob("*.mcap")) if SHARED.is_dir() else []
    if not files:
        pytest.skip("the shared recordings are not here")
    for path in files:
        for _ in range(20):
            data = bytearray(path.read_bytes())
            for _ in range(3):
                data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            (tmp_path / "a.mcap").write_bytes(bytes(data))
            with pytest.raises(LogError):
                read(tmp_path / "a.mcap")


def by_others(path: Path, rows: list[tuple[float, float]], kind: str = "float64") -> Path:
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        id = writer.register_schema(
            "lab/msg/Arm", "ros2msg", f"float64 t # t [s]\n{kind} p # boom.p_head [Pa]\n".encode()
        )
        id = writer.register_channel("/arm", "cdr", id)
        for row in rows:
            packed = struct.pack("<dq" if kind == "int64" else "<2d", *row)
            writer.add_message(id, 0, b"\x00\x01\x00\x00" + packed, 0)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("rows", "error", "said"),
    [
        ([(0, 1e5), (1, 1e5), (1, 1e5)], LogError, "the time stands still at 1 s"),
        ([(0, 1e5), (1, 1e5), (0.5, 1e5)], LogError, "the time goes back from 1 s to 0.5 s"),
        ([(0, 1e5), (1, float("nan"))], LogError, "boom.p_head is nan at t = 1 s"),
        ([(0, 1e5), (float("inf"), 1e5)], LogError, "the time is inf"),
        ([(0, 1e5), (1, 7e9)], UnitError, r"boom.p_head = 7e\+09 Pa at t = 1 s lies outside"),
        ([], LogError, "holds no samples"),
    ],
)
def test_wrong_data_in_mcap(tmp_path, rows, error, said):
    path = by_others(tmp_path / "a.mcap", rows)
    with pytest.raises(error, match=said) as caught:
        read(path)
    assert caught.value.file == str(path)
    if rows:
        assert read(path, check=False).t.size == len(rows)


def test_an_integer_that_no_float_is_is_refused(tmp_path):
    for number, exact in ((2**54, True), (2**53 + 1, False)):
        path = by_others(tmp_path / "a.mcap", [(0, 1), (1, number)], "int64")
        if exact:
            assert int(read(path, check=False)["boom.p_head"][1]) == number
            continue
        with pytest.raises(LogError) as caught:
            read(path)
        assert (caught.value.file, caught.value.key) == (str(path), "data.integer_rounded")


@pytest.mark.parametrize(
    "data", [b"", b"not a log", b"\x89MCAP0\r\n", b"PK\x03\x04" + bytes(100), bytes(9)]
)
@pytest.mark.parametrize("name", ["a.mcap", "a.csv", "a.bin"])
def test_no_log_at_all(tmp_path, data, name):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(EhbenchError) as caught:
        read(tmp_path / name)
    assert caught.value.file == str(tmp_path / name) and caught.value.exit_code == 2


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(LogError, match="cannot be read"):
            read(path)
    with pytest.raises(LogError, match="cannot be written: No such file"):
        write_log(tmp_path / "none" / "a.mcap", Record(np.arange(2.0), {"boom.q": np.arange(2.0)}))


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    late = 1e-3 * np.arange(40_000.0)  # more than is written at once, and few chunks
    late[-1] = 0
    with pytest.raises(LogError, match="goes back") as caught:
        write_log(path, Record(late, {"boom.q": late}))
    assert caught.value.file == str(path)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"] and path.read_bytes() == b"old"


HEAD = "t [s],boom.q [rad],boom.p_head [kPa]\n"


@pytest.mark.parametrize(
    ("text", "error", "line", "key"),
    [
        ("", LogError, None, "data.no_header"),
        ("# nothing\n\n", LogError, None, "data.no_header"),
        (HEAD, LogError, 1, "data.no_rows"),
        ("0,1,2\n1,2,3\n", LogError, 1, "data.header_missing"),
        ("t [s],boom.q,boom.p_head [kPa]\n0,0,0\n", UnitError, 1, "data.label_without_unit"),
        ("#c\nt [s],boom.p_head (kPa)\n0,0\n", UnitError, 2, "data.label_without_unit"),
        ("t [s],boom.q []\n0,0\n", UnitError, 1, "data.label_without_unit"),
        ("t [s],boom.q [kPa]\n0,0\n", UnitError, 1, "data.label_error"),
        ("t [s],boom.q [radd]\n0,0\n", UnitError, 1, "data.label_error"),
        ("t [s],boom.p_heda [kPa]\n0,0\n", LogError, 1, "data.unknown_channel"),
        ("t [s],Boom.Q [rad]\n0,0\n", LogError, 1, "data.unknown_channel"),
        ("t [s],.q [rad]\n0,0\n", LogError, 1, "data.unknown_channel"),
        ("t [s],boom.q [rad],boom.q [deg]\n0,0,0\n", LogError, 1, "data.column_twice"),
        ("boom.x [m],boom.q [rad]\n0,0\n", LogError, 1, "data.no_time_or_channel"),
        ("t [s]\n0\n", LogError, 1, "data.no_time_or_channel"),
        (HEAD + "0,0,0\n1,0\n", LogError, 3, "data.row_width_comma"),
        (HEAD + "0,0,0\n1,0,0,0\n", LogError, 3, "data.row_width_comma"),
        (HEAD + "0,0,0\n# c\n\n1,x,0\n", LogError, 5, "data.no_number"),
        (HEAD + "0,0,0\n1,,0\n", LogError, 3, "data.blank"),
        (HEAD + "0,0,0\n1,1_0,0\n", LogError, 3, "data.no_number"),
        (HEAD + "0,0,0\n1,nan,0\n", LogError, 3, "data.not_finite"),
        (HEAD + "0,0,0\n1,inf,0\n", LogError, 3, "data.not_finite"),
        (HEAD + "0,0,0\nnan,0,0\n", LogError, 3, "data.not_finite"),
        (HEAD + "0,0,0\n1,0,0\n1,0,0\n", LogError, 4, "data.time_stands_still"),
        (HEAD + "0,0,0\n# c\n1,0,0\n0.5,0,0\n", LogError, 5, "data.time_goes_back"),
        ("t [s],boom.p_head [MPa]\n0,0\n1,6895\n", UnitError, 3, "data.implausible_unit"),
        ("t [s],boom.q [rad]\n0,1\n1,-400\n", UnitError, 3, "data.implausible_unit"),
    ],
)
def test_wrong_csv(tmp_path, text, error, line, key):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(error) as caught:
        read(path)
    assert (caught.value.file, caught.value.line) == (str(path), line)
    assert caught.value.key == key


@pytest.mark.parametrize(("column", "unit"), [("boom.operator [1]", ""), ("boom.x [mm]", " mm")])
def test_a_number_without_unit_is_shown_without_one(tmp_path, column, unit):
    path = tmp_path / "log.csv"
    path.write_text(f"t [s],{column}\n0,0\n1,1e6\n")
    with pytest.raises(UnitError) as caught:
        read(path)
    assert (caught.value.key[:16], caught.value.fields["unit"]) == ("data.implausible", unit)
