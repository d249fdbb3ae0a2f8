"""Logs as others see them, and back: MCAP by the plain mcap library and by hand, CSV."""

import io
import json
import re
import runpy
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from ehbench.data import read, read_log
from ehbench.data.logs import CHUNK_SIZE, LogWriter, check_record, write_log
from ehbench.data.record import Record
from ehbench.vocabulary.errors import LogError, UnitError

SHARED = Path(__file__).parents[2].parent / "shared" / "data" / "mcap"


def recording(samples: int = 3000, seed: int = 1) -> Record:
    """Uneven times and values of full precision, so that any rounding shows."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, samples))
    scale = {"boom.q": 1, "stick.x": 0.3, "boom.p_head": 7e6, "boom.hect.command": 10}
    scale |= {"p_supply": 7e6, "stick.p_rod": 5e6}
    channels = {name: top * rng.uniform(0, 1, samples) for name, top in scale.items()}
    files = {"rig.toml": b"[rig]\n", "lock.txt": bytes(range(256))}
    return Record(t, channels, {"rig": "a rig", "note": "ünïcode"}, files)


def same(a: Record, b: Record) -> bool:
    return (
        np.array_equal(a.t, b.t)
        and list(a.channels) == list(b.channels)
        and all(np.array_equal(a[name], b[name]) for name in a.channels)
        and (a.meta, a.attachments, a.losses) == (b.meta, b.attachments, b.losses)
    )


def test_a_record_comes_back_bit_for_bit(tmp_path):
    record = recording()
    write_log(tmp_path / "a.mcap", record)
    assert same(read(tmp_path / "a.mcap"), record)


def test_a_log_replaces_another_whole_and_the_same_record_has_the_same_bytes(tmp_path):
    plain = recording(50)
    lossy = Record(plain.t, plain.channels, losses=("half of it is missing",))
    written = []
    for record in (lossy, plain, lossy):
        write_log(tmp_path / "a.mcap", record)
        written.append((tmp_path / "a.mcap").read_bytes())
        assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]
        assert same(read(tmp_path / "a.mcap"), record)
    assert written[0] == written[2] != written[1]


def test_the_plain_library_reads_every_message(tmp_path):
    record = recording(10_000)
    write_log(tmp_path / "a.mcap", record)
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary.statistics.message_count == record.t.size
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 3
        assert summary.statistics.message_end_time == round(record.t[-1] * 1e9)
        files = {each.name: each.data for each in reader.iter_attachments()}
        assert json.loads(files.pop("ehbench/facts.json"))["meta"] == record.meta
        assert files == record.attachments
        assert [each.metadata for each in reader.iter_metadata()] == [record.meta]
        for n, (schema, channel, message) in enumerate(reader.iter_messages()):
            fields = [line.split()[:2] for line in schema.data.decode().splitlines()]
            kinds = (schema.encoding, channel.message_encoding, message.sequence)
            assert kinds == ("ros2msg", "cdr", n) and {kind for kind, _ in fields} == {"float64"}
            assert message.log_time == message.publish_time == round(record.t[n] * 1e9)
            assert message.data[:4] == b"\x00\x01\x00\x00"
            values = struct.unpack(f"<{len(fields)}d", message.data[4:])
            labels = [channel.metadata[name] for _, name in fields]
            assert labels[:4] == ["t [s]", "boom.q [rad]", "stick.x [m]", "boom.p_head [Pa]"]
            assert values == (record.t[n], *(each[n] for each in record.channels.values()))
    assert n == record.t.size - 1
    # the stream reader also checks the checksum of the whole data section
    with open(tmp_path / "a.mcap", "rb") as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > record.t.size


def test_seeking_and_message_indexes(tmp_path):
    record = recording(10_000)
    write_log(tmp_path / "a.mcap", record)
    data = (tmp_path / "a.mcap").read_bytes()
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        start, stop = 1_000_000_000, 1_500_000_000
        messages = reader.iter_messages(starting_at=start, ending_before=stop)
        times = [message.log_time for _, _, message in messages]
        stamps = np.rint(record.t * 1e9)
        assert times == list(stamps[(stamps >= start) & (stamps < stop)])
        for index in reader.get_summary().chunk_indexes:
            at = index.chunk_start_offset + 9
            chunk = Chunk.read(ReadDataStream(io.BytesIO(data[at : at + index.chunk_length - 9])))
            body = zstandard.decompress(chunk.data)
            assert len(body) <= CHUNK_SIZE
            for channel, offset in index.message_index_offsets.items():
                entries = MessageIndex.read(ReadDataStream(io.BytesIO(data[offset + 9 :]))).records
                for log_time, place in entries:
                    opcode, _, id, _, there = struct.unpack_from("<BQHIQ", body, place)
                    assert (opcode, id, there) == (5, channel, log_time)


def test_ros_names_are_legal_and_unique(tmp_path):
    names = ["Boom-2.q", "boom_2.q", "2.q", "_.x", "ärm.x", "a__b.t", "t.q"]
    values = {name: np.arange(3.0) for name in names}
    write_log(tmp_path / "a.mcap", Record(np.arange(3.0), values))
    with open(tmp_path / "a.mcap", "rb") as file:
        (schema,) = make_reader(file).get_summary().schemas.values()
    fields = [line.split()[1] for line in schema.data.decode().splitlines()]
    assert len(set(fields)) == len(names) + 1
    assert all(re.fullmatch(r"[a-z](_?[a-z0-9])*", name) for name in fields)
    assert re.fullmatch(r"ehbench/msg/[A-Z][A-Za-z0-9]*", schema.name)
    assert list(read(tmp_path / "a.mcap").channels) == names


def test_live_samples_give_the_same_record(tmp_path):
    record = recording(60)
    with LogWriter(
        tmp_path / "a.mcap", list(record.channels), record.meta, record.attachments, sync=0.0
    ) as writer:
        for n, row in enumerate(np.stack(list(record.channels.values()), axis=1)):
            writer.append(record.t[n], row)
    assert same(read(tmp_path / "a.mcap"), record)


def test_an_exception_still_closes_the_log(tmp_path):
    with pytest.raises(RuntimeError), LogWriter(tmp_path / "a.mcap", ["boom.q"]) as writer:
        writer.append(0.0, [1.0])
        raise RuntimeError
    back = read(tmp_path / "a.mcap")
    assert back["boom.q"] == [1.0] and back.losses == ()


def test_times_before_zero_round_trip(tmp_path):
    record = Record(np.array([-0.3, -0.1, 0.2]), {"boom.q": np.arange(3.0)})
    write_log(tmp_path / "a.mcap", record)
    assert same(read(tmp_path / "a.mcap"), record)
    with open(tmp_path / "a.mcap", "rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages()]
        assert times == [0, 200_000_000, 500_000_000]


def test_slow_topics_come_on_the_fast_time_base(tmp_path):
    """Readings on straight lines between their samples, commands held."""
    groups = {"/fast": ["boom.q", "boom.p_head"], "/slow": ["boom.temperature", "boom.a.command"]}
    fast = np.arange(20) * 1e-3
    names = ["boom.temperature", "boom.q", "boom.p_head", "boom.a.command"]
    with LogWriter(tmp_path / "a.mcap", names, groups=groups) as writer:
        for n, t in enumerate(fast):
            writer.append(t, [n, 1e5 * n], "/fast")
            if n in (2, 7, 12, 17):
                writer.append(t, [300.0 + n, 0.1 * n], "/slow")
    back = read(tmp_path / "a.mcap")
    assert list(back.channels) == names
    assert np.array_equal(back.t, fast[2:])
    assert np.array_equal(back["boom.q"], np.arange(2.0, 20.0))
    assert back["boom.temperature"] == pytest.approx([*range(302, 318), 317, 317])
    held = [*[2] * 5, *[7] * 5, *[12] * 5, *[17] * 3]
    assert back["boom.a.command"] == pytest.approx(0.1 * np.array(held))
    assert back.periods == pytest.approx({"boom.temperature": 5e-3, "boom.a.command": 5e-3})
    assert back.losses == ()  # that it begins within a sample of the slow topic is none


def test_a_slow_topic_is_not_held_past_its_end(tmp_path):
    groups = {"/fast": ["boom.q"], "/slow": ["boom.x"]}
    with LogWriter(tmp_path / "a.mcap", ["boom.q", "boom.x"], groups=groups) as writer:
        writer.extend(np.arange(100) * 1e-3, np.zeros((100, 1)), "/fast")
        writer.extend(np.arange(3) * 10e-3, np.ones((3, 1)), "/slow")
    back = read(tmp_path / "a.mcap")
    assert back.t[-1] == pytest.approx(30e-3) and back.losses[0].fields["rows"] == "69 rows"


def test_groups_of_one_rate_share_the_time_base(tmp_path):
    record = recording(2000)
    names = list(record.channels)
    groups = {"boom": names[::2], "others/2": names[1::2]}
    with LogWriter(tmp_path / "a.mcap", names, record.meta, record.attachments, groups) as writer:
        writer.extend(record.t, np.stack(list(record.channels.values()), axis=1))
    assert same(read(tmp_path / "a.mcap"), record)


def test_a_topic_that_never_spoke_is_named(tmp_path):
    groups = {"/a": ["boom.q"], "/b": ["boom.x"]}
    with LogWriter(tmp_path / "a.mcap", ["boom.q", "boom.x"], groups=groups) as writer:
        writer.append(0.0, [1.0], "/a")
    assert read(tmp_path / "a.mcap").losses == ("no samples of boom.x",)


@pytest.mark.parametrize(
    "groups",
    [
        {"a": ["boom.q"]},
        {"a": ["boom.q", "boom.x", "boom.v"]},
        {"a": ["boom.q", "boom.x"], "b": ["boom.x"]},
        {},
    ],
)
def test_groups_that_do_not_fit_are_refused(tmp_path, groups):
    with pytest.raises(LogError, match="exactly one topic"):
        LogWriter(tmp_path / "a.mcap", ["boom.q", "boom.x"], groups=groups)
    assert not list(tmp_path.iterdir())


def test_the_writer_refuses_what_no_reader_could_trust(tmp_path):
    with LogWriter(tmp_path / "a.mcap", ["boom.q", "boom.x"]) as writer:
        writer.append(1.0, [0.0, 0.0])
        for t in (1.0, 0.5):
            with pytest.raises(LogError, match="stands still|goes back"):
                writer.append(t, [0.0, 0.0])
        with pytest.raises(LogError, match="no usable time"):
            writer.append(float("nan"), [0.0, 0.0])
        with pytest.raises(LogError, match=r"goes back from 3 s to 2 s"):
            writer.extend(np.array([3.0, 2.0]), np.zeros((2, 2)))
        with pytest.raises(ValueError, match="shape"):
            writer.extend(np.array([3.0, 4.0]), np.zeros((2, 3)))
    with pytest.raises(LogError, match="never overwrites"):
        LogWriter(tmp_path / "a.mcap", ["boom.q"])
    with pytest.raises(LogError, match=r"unknown channel 'boom.p_haed'.*nearest is 'boom.p_head'"):
        LogWriter(tmp_path / "b.mcap", ["boom.p_haed"])
    assert read(tmp_path / "a.mcap").t == [1.0]


def test_frame_has_units_and_losses(tmp_path):
    record = recording(20)
    write_log(tmp_path / "a.mcap", record)
    frame = read_log(tmp_path / "a.mcap")
    assert list(frame.columns) == ["t", *record.channels] and len(frame) == 20
    assert frame.attrs["units"]["boom.p_head"] == "Pa" and frame.attrs["losses"] == []
    assert np.array_equal(frame["boom.p_head"], record["boom.p_head"])


# --- CSV


def csv(tmp_path: Path, text: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_csv_in_any_unit_comes_in_si(tmp_path):
    text = (
        "# recorded by hand\n\n  # boom only\n"
        't [ms], boom.q [deg] ,boom.p_head [kPa],"boom.temperature [degC]",boom.hect.flow [gpm]\n'
        "0,180,1000,20,1\n# a remark\n0.5,-90,2.5e3,25.5,-1\n"
    )
    record = read(csv(tmp_path, text))
    assert list(record.channels) == ["boom.q", "boom.p_head", "boom.temperature", "boom.hect.flow"]
    # one multiplication by a factor that is itself rounded: a few units in the last place
    close = {"rtol": 1e-14, "atol": 0}
    np.testing.assert_allclose(record.t, [0, 0.5e-3], **close)
    np.testing.assert_allclose(record["boom.q"], [np.pi, -np.pi / 2], **close)
    np.testing.assert_allclose(record["boom.p_head"], [1e6, 2.5e6], **close)
    np.testing.assert_allclose(record["boom.temperature"], [293.15, 298.65], **close)
    gallon = 231 * 0.0254**3
    np.testing.assert_allclose(record["boom.hect.flow"], [gallon / 60, -gallon / 60], **close)


@pytest.mark.parametrize("comma", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_csv_dialects(tmp_path, comma, encoding, end):
    text = end.join(
        comma.join(row) for row in (["t [s]", "boom.q [rad]"], ["0", "0.1"], ["1", "0.2"])
    )
    record = read(csv(tmp_path, text, encoding))
    assert list(record.t) == [0, 1] and list(record["boom.q"]) == [0.1, 0.2]


def test_csv_and_mcap_tell_the_same(tmp_path):
    record = recording(40)
    units = {"q": "rad", "x": "m", "command": "V"}
    heads = [f"{name} [{units.get(name.split('.')[-1], 'Pa')}]" for name in record.channels]
    table = np.column_stack([record.t, *record.channels.values()]).tolist()
    rows = [",".join(map(repr, row)) for row in table]
    back = read(csv(tmp_path, "\n".join([",".join(["t [s]", *heads]), *rows])))
    assert np.array_equal(back.t, record.t)
    assert all(np.array_equal(back[name], record[name]) for name in record.channels)


# --- files by others

MIXED = (
    "uint8 K=3\nbool on\nfloat32 p  # pressure\nint16 count\nfloat64 angle\n"
    "uint8 tail # boom.command [V]\n"
)
LABELS = {"p": "boom.p_head [kPa]", "angle": "boom.q [deg]"}


def foreign(
    path: Path, labels: dict[str, str], schema: str = MIXED, encoding: str = "cdr", **options
) -> Path:
    """A log as another ROS 2 recorder might write it: mixed types, epoch time, no ``t``."""
    with open(path, "wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2")
        words = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        text = writer.register_channel("/rosout", "cdr", words)
        arm = writer.register_schema("lab/msg/Arm", "ros2msg", schema.encode())
        id = writer.register_channel("/arm", encoding, arm, labels)
        epoch = 1_700_000_000_000_000_000
        for n in range(30):
            # by hand: bool at 0, float32 aligned to 4, int16 at 8, float64 aligned to 16, uint8 at
            # 24
            data = b"\x00\x01\x00\x00" + struct.pack("<?3xfh6xdB", True, 100.5 + n, -n, 90.0 - n, 7)
            writer.add_message(id, epoch + 10_000_000 * n, data, epoch)
            if n % 7 == 3:
                data = b"\x00\x01\x00\x00\x03\x00\x00\x00hi\x00"
                writer.add_message(text, epoch + 10_000_000 * n, data, epoch)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
@pytest.mark.parametrize("chunked", [True, False])
def test_labelled_ros_topics_are_read(tmp_path, compression, chunked):
    path = foreign(
        tmp_path / "a.mcap", LABELS, compression=compression, use_chunking=chunked, chunk_size=400
    )
    record = read(path)
    n = np.arange(30)
    np.testing.assert_array_equal(record.t, n / 100)
    np.testing.assert_array_equal(record["boom.p_head"], 1000 * (100.5 + n))
    np.testing.assert_allclose(record["boom.q"], np.radians(90.0 - n), rtol=1e-15)
    np.testing.assert_array_equal(record["boom.command"], np.full(30, 7.0))
    assert record.losses == ("topic not read: /rosout (cdr, std_msgs/msg/String)",)


def test_ros_topics_without_labels_are_refused_by_name(tmp_path):
    bare = MIXED.replace(" # boom.command [V]", "")
    says = r"/rosout \(cdr, std_msgs/msg/String\), /arm \(cdr, lab/msg/Arm\).*ehbench reads"
    with pytest.raises(LogError, match=says):
        read(foreign(tmp_path / "a.mcap", {}, bare))
    with pytest.raises(LogError, match=r"/arm \(json, lab/msg/Arm\)"):
        read(foreign(tmp_path / "b.mcap", LABELS, encoding="json"))


@pytest.mark.parametrize(
    ("label", "error", "said"),
    [
        ("boom.p_head", UnitError, "no unit.*boom.p_head \\[kPa\\]"),
        ("boom.p_head [V]", UnitError, "cannot be turned into Pa"),
        ("boom.p_haed [kPa]", LogError, "nearest is 'boom.p_head'"),
        ("boom.p_head [GPa]", UnitError, "outside"),
    ],
)
def test_wrong_labels_are_refused(tmp_path, label, error, said):
    with pytest.raises(error, match=said):
        read(foreign(tmp_path / "a.mcap", {**LABELS, "p": label}))


@pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings are not here")
def test_every_shared_recording_opens_or_is_refused_with_a_sentence():
    files = sorted(SHARED.rglob("*.mcap"))
    assert files
    for path in files:
        try:
            assert read(path).t.size
        except LogError as error:
            assert error.file == str(path)
            with open(path, "rb") as file:
                records = list(StreamReader(file).records)
            channels = {item.id: item for item in records if isinstance(item, Channel)}
            topics = {item.channel_id for item in records if isinstance(item, Message)}
            for channel in map(channels.get, topics):
                assert f"{channel.topic} ({channel.message_encoding}" in str(error)
            if not topics:
                assert "holds no samples" in str(error)


def test_check_record_names_the_place_in_the_unit_of_the_file():
    t = np.arange(4.0)
    check_record(Record(t, {"boom.q": t}))
    bad = Record(t, {"boom.p_head": np.array([1e6, 1e6, 7e9, 1e6])})
    says = r"^x: boom.p_head = 7e\+06 kPa at t = 2 s lies outside -200 to 200000 kPa .*in Pa it"
    with pytest.raises(UnitError, match=says):
        check_record(bad, "x", units={"boom.p_head": "kPa"})
    with pytest.raises(LogError, match=r"the time is -inf"):
        check_record(Record(np.array([-np.inf, 1.0]), {}))


def test_the_examples_of_the_documentation_run(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "reference" / "logs.md").read_text()
    blocks = re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    (table,) = [body for kind, body in blocks if kind == "csv"]
    Path("step.csv").write_text(table)
    for body in [body for kind, body in blocks if kind == "python"]:
        Path("example.py").write_text(body)
        runpy.run_path("example.py")
    assert same(read("step.mcap"), read("step.csv"))
