"""What would take too much memory or time is refused before it begins, with what it would take."""

import json
import os
import struct
import time
from zlib import crc32

import numpy as np
import pytest
import zstandard
from mcap.records import Attachment, Chunk, Header
from mcap.writer import CompressionType, Writer

from ehbench.app import inspection
from ehbench.config.recipe import load_recipe, load_rig
from ehbench.data import read
from ehbench.data.flowmeter import read_flowmeter
from ehbench.data.logs import LogWriter, write_log
from ehbench.data.logs.layout import MAGIC, pack
from ehbench.data.record import Record
from ehbench.runs import rundir
from ehbench.trial import run_trial
from ehbench.vocabulary.errors import EhbenchError, InputError, LogError, SimulationError
from tests.shared import ROOT

RIG = ROOT / "recipes" / "rigs" / "slide_servo.toml"
OPEN = f"stage = 'trial'\nrig = '{RIG}'\n"
STEP = "[[command]]\nvalve = 'press.servo'\nkind = 'step'\namplitude = '2 V'\n"
LOOP = (
    "[controller]\nkind = 'open_loop'\n[motion]\nkind = 'point_to_point'\n"
    "waypoints = ['100 mm', '200 mm']\nspeed = '80 mm/s'\n"
)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("duration = '1e6 s'\n" + STEP, r"1e\+06 s at 1000 Hz are 1e\+09 samples"),
        ("duration = '9000 s'\n" + STEP, r"a trial of 9000001 samples would take .* GB of memory"),
        ("duration = '1 s'\nstep = '1e-7 s'\nrate = '0.001 Hz'\n" + STEP, "steps of 1e-07 s|short"),
        ("duration = '9000 s'\nstep = '1e-7 s'\nrate = '10 Hz'\n" + STEP, "9e.10 steps of 1e-07 s"),
        ("duration = '1e6 s'\n" + LOOP, r"1e\+09 samples"),
        ("duration = '1 s'\nrate = '1 MHz'\nlimits.ramp = '10 s'\n" + STEP, "a trial of 140"),
        (LOOP + "acceleration = '1e-9 m/s^2'\n", "samples"),
        (LOOP + "jerk = '1e-12 m/s^3'\n", "samples"),
        (LOOP + "hold = '1e6 s'\n", "samples"),
        (LOOP.replace("80 mm/s", "1e-9 m/s"), "samples"),
    ],
)
def test_a_trial_without_end_is_refused_at_once(tmp_path, monkeypatch, text, says):
    monkeypatch.setattr("ehbench.runtime.memory.available", lambda: 8e9)
    (tmp_path / "trial.toml").write_text(OPEN + text)
    begun = time.monotonic()
    (error,) = inspection.check(tmp_path / "trial.toml").errors
    assert time.monotonic() - begun < 20.0 and error.line is not None
    with pytest.raises(InputError, match=says):
        raise error


def test_a_trial_that_runs_away_ends_as_such(tmp_path):
    """Pressures beyond any rig's: exit 5 with a word on the trial, not a hint on the log."""
    heavy = RIG.read_text(encoding="utf-8").replace('"250 kg"', '"5e4 kg"')
    heavy = heavy.replace('"350 kg"', '"9e4 kg"').replace("relief_pressure", "# relief_pressure")
    (tmp_path / "rig.toml").write_text(heavy, encoding="utf-8")
    stop = STEP.replace("'2 V'", "'10 V'\nstop = '1.2 s'")
    (tmp_path / "trial.toml").write_text(
        OPEN + "duration = '2 s'\nposture = { press = '20 mm' }\n" + stop
    )
    with pytest.raises(SimulationError, match="the trial diverged: press.p_") as error:
        run_trial(load_rig(tmp_path / "rig.toml"), load_recipe(tmp_path / "trial.toml"))
    assert error.value.exit_code == 5 and "limits" in str(error.value.hint)


def chunk_of(body: bytes, size: int | None = None) -> bytes:
    packed = zstandard.ZstdCompressor().compress(body)
    return pack(Chunk("zstd", packed, 1, 0, crc32(body), size or len(body)))


def hollow(size: int) -> bytes:
    """One record of a kind that readers pass over, of so many bytes."""
    return struct.pack("<BQ", 0x80, size - 9) + bytes(size - 9)


def test_a_bomb_is_not_unpacked(tmp_path):
    """A file of some kilobytes that would unpack to gigabytes: said, with what is sound read."""
    good, bad = tmp_path / "good.mcap", tmp_path / "bad.mcap"
    write_log(good, Record(np.arange(100) / 1e3, {"press.x": np.full(100, 0.1)}))
    data = good.read_bytes()
    bomb = chunk_of(hollow(100 * 2**20))
    end = data.index(struct.pack("<BQ", 0x0F, 4))
    bad.write_bytes(data[:end] + bomb + data[end:])
    begun = time.monotonic()
    record = read(bad)
    assert record.t.size == 100 and any("would unpack to more" in loss for loss in record.losses)
    assert time.monotonic() - begun < 5.0
    many = data[:end] + 30 * chunk_of(hollow(4 * 2**20)) + data[end:]
    bad.write_bytes(many)
    assert any("would unpack" in loss for loss in read(bad).losses)


def test_a_damaged_size_does_not_keep_sound_chunks_from_being_read(tmp_path):
    path = tmp_path / "a.mcap"
    t = np.arange(3000) / 1e3
    write_log(path, Record(t, {"press.x": 0.1 + 0 * t}))
    data = bytearray(path.read_bytes())
    first = data.index(b"\x04\x00\x00\x00zstd") - 12 - 8 + 4
    size = data.index(struct.pack("<Q", struct.unpack_from("<Q", data, first)[0]), first)
    data[size + 4] ^= 0x40
    path.write_bytes(bytes(data))
    assert 2400 <= read(path).t.size < 3000


@pytest.mark.parametrize("every", [1, 3, 100])
def test_topics_in_no_order_are_read_in_a_time_that_goes_with_their_number(tmp_path, every):
    samples, path = 20_000, tmp_path / "a.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=2**22)
        writer.start(profile="ros2")
        schema = writer.register_schema("p/msg/X", "ros2msg", b"float64 x  # press.x [m]\n")
        text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        a = writer.register_channel("/a", "cdr", schema)
        b = writer.register_channel("/log", "cdr", text)
        for i in range(samples):
            value = bytes([0, 1, 0, 0]) + struct.pack("<d", i * 1e-5)
            writer.add_message(a, i * 1_000_000, value, i * 1_000_000)
            if i % every == 0:
                said = bytes(4 + (7 * i) % 23)
                writer.add_message(b, i * 1_000_000, said, i * 1_000_000)
        writer.finish()
    begun = time.monotonic()
    record = read(path)
    assert time.monotonic() - begun < 3.0
    assert np.array_equal(record["press.x"], np.arange(samples) * 1e-5)


@pytest.mark.parametrize(
    "facts",
    [
        b"[" * 100_000,
        b"9" * 10_000,
        b"[]",
        b'"x"',
        json.dumps({"channels": [[]], "losses": [], "meta": {}}).encode(),
        json.dumps({"channels": [], "losses": [3], "meta": {}}).encode(),
        json.dumps({"channels": [], "losses": [], "meta": {"a": {}}}).encode(),
        json.dumps({"channels": {}, "losses": [], "meta": {}}).encode(),
    ],
)
def test_facts_of_any_shape_are_a_loss_and_no_more(tmp_path, facts):
    path = tmp_path / "a.mcap"
    write_log(path, Record(np.arange(9) / 1e3, {"press.x": np.full(9, 0.1)}, {"rig": "r"}))
    data = path.read_bytes()
    head = MAGIC + pack(Header("ros2", "x"))
    chunk = data.index(b"\x04\x00\x00\x00zstd") - 28 - 9
    extra = pack(Attachment(0, 0, "ehbench/facts.json", "application/json", facts))
    path.write_bytes(head + extra + data[chunk:])
    record = read(path)
    assert record.t.size == 9 and record.losses


@pytest.mark.parametrize("reading", [read, read_flowmeter, load_rig, load_recipe])
def test_a_pipe_keeps_nobody_waiting(tmp_path, reading):
    os.mkfifo(tmp_path / "a.csv")
    for reader in (reading, inspection.check):
        with pytest.raises(EhbenchError, match="pipe"):
            reader(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "name", ["a\0b", "x" * 5000, "loop", "/dev/null", "/dev/zero", ".", "pipe"]
)
@pytest.mark.parametrize("key", ["rig = '{}'", "flow_maps = '{}'", "bench = '{}'\non = 'bench'"])
def test_what_a_recipe_names_is_a_file_or_a_sentence(tmp_path, name, key):
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    name = name.replace("\0", "\\u0000")
    line = key.format(name).replace("'", '"')
    rest = OPEN if not key.startswith("rig") else "stage = 'trial'\n"
    (tmp_path / "trial.toml").write_text(f"{rest}{line}\nduration = '1 s'\n{STEP}")
    try:
        found = inspection.check(tmp_path / "trial.toml")
    except EhbenchError as error:
        assert len(str(error)) < 1000
    else:
        assert found.errors and all(len(str(error)) < 1000 for error in found.errors)


def test_a_file_too_large_is_not_read(tmp_path):
    with open(tmp_path / "a.toml", "wb") as file:
        file.truncate(10**9)
    with pytest.raises(InputError, match="is 1000 MB large, more than the"):
        load_rig(tmp_path / "a.toml")
    with open(tmp_path / "a.mcap", "wb") as file:
        file.truncate(10**11)
    with pytest.raises(LogError, match="MB large"):
        read(tmp_path / "a.mcap")
    with pytest.raises(InputError):
        rundir.sha256(tmp_path / "a.mcap")


def test_a_flipped_bit_takes_one_chunk_of_half_a_second_at_most(tmp_path):
    path, rng = tmp_path / "a.mcap", np.random.default_rng(3)
    names = [f"press.{word}" for word in ("x", "v", "p_head", "p_rod")]
    t = np.arange(2001) / 1e3
    write_log(path, Record(t, {name: rng.uniform(0, 1, t.size) for name in names}))
    data = path.read_bytes()
    for at in rng.integers(1000, len(data) - 1000, 60):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(flipped))
        record = read(path)
        assert record.t.size >= 2001 - 501, at
        assert record.losses or record.t.size == 2001


def test_slow_samples_are_in_chunks_of_half_a_second_too(tmp_path):
    for rate, chunks in ((1.0, 4), (10.0, 1), (1e3, 1)):
        path = tmp_path / f"{rate}.mcap"
        with LogWriter(path, ["press.x"], sync=None) as writer:
            for i in range(4):
                writer.append(i / rate, [0.1])
        assert path.read_bytes().count(b"\x04\x00\x00\x00zstd") == 2 * chunks  # and in the index
        assert np.array_equal(read(path).t, np.arange(4) / rate)
