"""Targets in processes of their own: responders in C and Python, the served bench, ends killed."""

import errno
import logging
import math
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from ehbench.app.linking import moved_to, serve, wire
from ehbench.config.recipe import TrialRecipe, load_recipe
from ehbench.data import read_log
from ehbench.links.can import CanLink, Frames
from ehbench.links.layout import FRAMES, WRITERS, Layout, write_files
from ehbench.links.opening import Address, open_machine
from ehbench.links.quality import measure
from ehbench.links.responder import ALIVE, ARMED, HEADER, REASONS, RUNNING, STOPPED
from ehbench.links.transport import REASON, SEQUENCE, STATE, TOKEN, UdpLink
from ehbench.preprocessing.time_base import parts_of
from ehbench.trial import prepare, run
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT, refused, shipped

RIG = shipped("slide_servo")
LAYOUT = Layout.of(RIG)
# a watchdog that a busy computer does not meet
TEXT = """stage = "trial"
rig = "RIG"
rate = "100 Hz"
[motion]
kind = "point_to_point"
cylinder = "press"
waypoints = ["160 mm", "180 mm", "160 mm"]
speed = "20 mm/s"
[controller]
kind = "position"
[limits]
stroke_margin = "20 mm"
sample_age = "400 ms"
overrun = "400 ms"
"""


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture
def started():
    """Starts processes, which end with the test."""
    running = []

    def start(*words, until="", **keys):
        running.append(subprocess.Popen(words, stderr=subprocess.PIPE, text=True, **keys))
        while until and until not in (line := running[-1].stderr.readline()):
            assert line or running[-1].poll() is None
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.wait()
        process.stderr.close()


@pytest.fixture
def trial(tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(TEXT.replace("RIG", str(ROOT / "recipes/rigs/slide_servo.toml")))
    return path


def served(started, trial, url, *words):
    line = ["-m", "ehbench", "serve", str(trial), "--at", url, "--watchdog", "400", *words]
    return started(sys.executable, *line, until="serving", cwd=ROOT)


def prepared(trial, on="model"):
    recipe = load_recipe(trial)
    assert isinstance(recipe, TrialRecipe)
    return prepare(recipe.model_copy(update={"on": on}), RIG)


def test_layouts_name_every_number(tmp_path):
    for kind, (name, text, _) in WRITERS.items():
        written = text(LAYOUT, 1000.0)
        files = write_files(LAYOUT, 1000.0, kind, tmp_path)
        assert files[0].name == name and files[0].read_text() == written
        flat = written.lower().replace(".", "_")
        for word in ("press_p_head", "press_servo_command"):
            assert word in flat, kind
    assert len({LAYOUT.number(mode) for mode in ("stream", "setpoint", "buffered")}) == 3
    for name in ("responder.c", "responder.py"):
        assert len((tmp_path / name).read_text().splitlines()) <= 150


def conversation(port):
    """What a target says from the first packet to a stop by its watchdog."""
    number, count = LAYOUT.number("stream"), len(LAYOUT.commands.names)
    link, states, sequence = UdpLink("127.0.0.1", port), [], 0
    newest = np.zeros(0)

    def say(wish, seconds, values=count, token=77):
        nonlocal sequence, newest
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            sequence += 1
            header = [number, token, sequence, 0.0, 0.0, wish, 0.0, 0.0]
            link.send(np.array(header + [1.5] * values))
            for newest in link.receive(0.01):
                states.append(int(newest[STATE]))
        return newest

    end = time.monotonic() + 10.0
    while not states and time.monotonic() < end:
        say(ALIVE, 0.05, 0)
    while ARMED not in states and time.monotonic() < end:
        say(ARMED, 0.05)
    newest = say(RUNNING, 0.3)
    assert newest[SEQUENCE] > 100 and newest[TOKEN] == 77
    assert newest.size == len(HEADER) + len(LAYOUT.up) and newest[-1] == 1.5
    until = time.monotonic() + 3.0
    while time.monotonic() < until and (states[-1] != STOPPED or newest[-1] != 0.0):
        for newest in link.receive(0.01):  # silent: its watchdog lets the valves go
            states.append(int(newest[STATE]))
    link.close()
    assert list(dict.fromkeys(states)) == [1, 2, 3, 4, 5]
    assert REASONS[int(newest[REASON])] == "watchdog" and newest[-1] == 0.0


def test_a_trial_is_moved_to_a_machine_by_an_option(trial, inside):
    assert moved_to(load_recipe(trial), "udp://rig:1").on == "udp://rig:1"
    for words, problem in ((["--on", "tcp://rig"], "tcp://rig"), ([], "simulation")):
        done = inside("run-trial", trial, "--arm", *words)
        assert done.returncode == 2 and problem in done.stderr


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a compiler")
def test_the_responder_in_c_is_a_target(tmp_path, started):
    write_files(LAYOUT, 1000.0, "c", tmp_path)
    line = ["cc", "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "responder.c", "-o", "target"]
    subprocess.run([*line, "-lm"], cwd=tmp_path, check=True)
    port = free_port()
    started(str(tmp_path / "target"), str(port), "0.4")
    conversation(port)


def test_the_responder_in_python_is_a_target(tmp_path, started):
    write_files(LAYOUT, 1000.0, "py", tmp_path)
    port = free_port()
    main = (
        "from responder import *\nfrom ehb_wire import *\nimport responder, sys\n"
        "responder.SAMPLE = SAMPLE\n"
        "target = Target(Rig(), COMMANDS, {LAYOUT: (len(COMMANDS), list)}, RATE, 0.4)\n"
        "serve(target, int(sys.argv[1]))\n"
    )
    started(sys.executable, "-c", main, str(port), cwd=tmp_path)
    conversation(port)


HOST = """
import sys
from pathlib import Path
sys.path.insert(0, TESTS)
from test_link_processes import *
machine = open_machine(prepared(Path(sys.argv[1])), sys.argv[2])
begin = machine._begin
def told():
    begin()
    print(machine.token, file=sys.stderr, flush=True)
machine._begin = told
tick = machine.tick
def ticked(command):
    if machine.row == 100:
        print("moving", file=sys.stderr, flush=True)
    return tick(command)
machine.tick = ticked
run(machine.prepared, machine, log=Path(sys.argv[3]), fast=False)
""".replace("TESTS", repr(str(Path(__file__).parent)))


def test_either_end_is_safe_when_the_other_is_killed(tmp_path, started, trial):
    port = free_port()
    url = f"udp://127.0.0.1:{port}"
    target = served(started, trial, url)
    quality = measure(Address.of(url).link(), url, 1.0)
    assert quality.ticks > 50 and quality.rate == pytest.approx(100.0, rel=0.02)
    assert quality.watchdog == 0.4
    log = tmp_path / "killed.mcap"
    host = started(sys.executable, "-c", HOST, str(trial), url, str(log), cwd=ROOT)
    said = []
    while not said or said[-1] != "moving\n":
        said.append(host.stderr.readline())
        assert said[-1], said
    time.sleep(0.5)
    os.kill(host.pid, signal.SIGKILL)
    host.wait()
    time.sleep(0.7)  # its watchdog and ramp
    rows = len(read_log(log))
    assert rows >= 100  # a second and a half ran, the last may be lost
    token = next(int(line) for line in reversed(said) if line.strip().isdigit())
    link, newest = UdpLink("127.0.0.1", port), np.zeros(0)
    for sequence in range(10**6, 10**6 + 20):
        header = [LAYOUT.number("stream"), token, sequence, 0.0, 0.0, ALIVE, 0.0, 0.0]
        link.send(np.array(header))
        for newest in link.receive(0.02):
            pass
    link.close()
    assert newest[STATE] == STOPPED and REASONS[int(newest[REASON])] == "watchdog"
    assert newest[-1] == 0.0  # the valve's command

    ready = prepared(trial)
    machine = open_machine(ready, url)
    tick = machine.tick
    machine.tick = lambda command: (machine.row != 100 or target.kill(), tick(command))[1]
    result = run(ready, machine, log=tmp_path / "log.mcap", fast=False)
    assert result.facts.stop is not None and result.facts.stop.limit == "sample_age"
    assert result.facts.after.still is None  # no sensor says so
    record = result.record
    assert (np.diff(record.t) > 0.0).all() and record["press.servo.command"][-1] == 0.0
    assert len(read_log(tmp_path / "log.mcap")) == record.t.size
    (part,), notes = parts_of("log", record)  # the limit is 400 ms
    assert part.record.t[-1] == pytest.approx(result.facts.stop.t - 0.41, abs=0.03)
    assert "preprocessing.none_came" in [note.key for note in notes]


def test_a_served_bench_speaks_modbus(started, trial):
    pytest.importorskip("pymodbus")
    url = f"modbus://127.0.0.1:{free_port()}?clock=virtual"
    served(started, trial, url, "--on", "bench")
    ready = prepared(trial)
    over = run(ready, open_machine(ready, url), fast=False)
    here = run(prepared(trial, "bench"), fast=False)
    assert over.facts.stop is None and over.record.t.size == here.record.t.size
    for name in ("press.x", "press.servo.command"):
        scale = np.ptp(here.record[name])
        np.testing.assert_allclose(over.record[name], here.record[name], atol=3e-2 * scale)


def test_a_served_bench_speaks_can(tmp_path, started, trial):
    pytest.importorskip("can")
    pytest.importorskip("cantools")
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)
    url = f"can://udp_multicast/239.74.163.9?map={dbc}"
    short = trial.read_text().replace("[motion]", '[motion]\nhold = "0.1 s"')
    trial.write_text(short.replace('"180 mm", "160 mm"', '"170 mm"'))
    served(started, trial, url)
    ready = prepared(trial)
    over = run(ready, open_machine(ready, url), fast=False)
    assert over.facts.stop is None
    assert over.facts.measures["tracking"]["max_error"] < 3e-3


def test_a_vector_of_which_a_frame_was_lost_does_not_count(tmp_path):
    """Its numbers would be those of the vector before."""
    pytest.importorskip("can")
    pytest.importorskip("cantools")
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)
    names = (*LAYOUT.channels, *(f"{name}.command" for name in LAYOUT.commands.names), *HEADER)

    def frames(offset):
        return Frames("up", names, dbc).encode(np.arange(len(names)) + offset)

    def taken(lost, first=names):
        """The first number of each vector that counts, of five whose frames ``lost`` are lost."""
        taking = Frames("up", first, dbc)
        came = [f for n in range(5) for k, f in enumerate(frames(100 * n)) if (n, k) not in lost]
        whole = [item for frame in came if (item := taking.take(frame)) is not None]
        for item in whole:
            assert item.tolist() == [names.index(n) + item[0] for n in first]
        return [item[0] for item in whole]

    last = len(frames(0)) - 1
    assert taken({(1, 0)}) == [0, 200, 300, 400]
    assert taken({(1, last)}) == [0, 200, 300, 400]
    assert taken({(1, last), (2, 0)}) == [0, 300, 400], "the first frame of 1 is none of 2"
    assert taken({(1, last), (2, 1), (3, 0)}) == [0, 400]


def test_frames_that_are_none_of_the_vector_change_nothing(tmp_path):
    """Short ones, requests, another's with the same number, a controller's report; and a value
    that the file gives a word is a number."""
    can = pytest.importorskip("can")
    pytest.importorskip("cantools")
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)
    names, first = (*LAYOUT.up, *HEADER), FRAMES["up"]
    state = first + names.index("state") // 2
    dbc.write_text(dbc.read_text() + f'VAL_ {state} up_state 3 "running" ;\n')
    other, link = (
        can.Bus("c", interface="virtual"),
        CanLink("virtual", "c", (names, ("state",)), dbc),
    )
    bad = [
        can.Message(arbitration_id=first, data=b"ab", is_extended_id=False),
        can.Message(arbitration_id=first, is_remote_frame=True, is_extended_id=False),
        can.Message(arbitration_id=first, data=bytes(8), is_extended_id=True),
        can.Message(arbitration_id=first, data=bytes(8), is_error_frame=True, is_extended_id=False),
    ]
    numbers = np.arange(len(names)) + 1.0
    numbers[names.index("state")] = RUNNING

    sent = Frames("up", names, dbc).encode(numbers)
    with closing(link), other:
        for message in bad:
            for frame in (sent[0], message, *sent[1:]):
                other.send(frame)
            (came,) = link.receive(1.0)
            assert came.tolist() == numbers.tolist(), message


def test_a_bus_or_network_that_goes_down_loses_packets_and_ends_nothing(tmp_path, monkeypatch):
    can = pytest.importorskip("can")
    pytest.importorskip("cantools")
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)

    def down(*_):
        raise can.CanOperationError("the network is down")

    with closing(CanLink("virtual", "down", LAYOUT.names("stream"), dbc)) as link:
        for name in ("send", "recv"):
            monkeypatch.setattr(link._bus, name, down)
        link.send(np.zeros(len(HEADER)))
        assert link.receive(0.01) == []

    class Down:
        def __getattr__(self, name):
            if name in ("send", "recv"):
                raise OSError(errno.ENETUNREACH, "the network is down")
            return lambda *_: None

    link = UdpLink("127.0.0.1", 9)
    link.close()
    # pyrefly: ignore[bad-assignment]
    link._socket = Down()
    link.send(np.zeros(len(HEADER)))
    assert link.receive(0.01) == []


def test_a_link_of_headers_alone_sends_and_counts_all_frames(tmp_path):
    """It stands for a trial's link: a target with two valves takes its vectors, and a frame of
    nothing but samples that is lost is a lost sample."""
    pytest.importorskip("can")
    pytest.importorskip("cantools")
    layout = Layout.of(shipped("thesis_arm"))
    (dbc,) = write_files(layout, 100.0, "dbc", tmp_path)
    up, down = layout.names("stream")

    bus = Frames("down", HEADER, dbc).encode(np.arange(len(HEADER)) + 1.0)
    target = Frames("down", down, dbc)
    (taken,) = [item for frame in bus if (item := target.take(frame)) is not None]
    assert taken[: len(HEADER)].tolist() == [1, 2, 3, 4, 5, 6, 7, 8]

    bus = Frames("up", up, dbc).encode(np.arange(len(up)) + 1.0)
    for lost in range(len(bus)):
        link = Frames("up", HEADER, dbc)
        assert all(link.take(f) is None for k, f in enumerate(bus) if k != lost), lost


def test_a_map_of_registers_scales_numbers(tmp_path):
    from ehbench.links.modbus import blocks

    header = "".join(f'"{name}" = {{ address = {2 * i} }}\n' for i, name in enumerate(HEADER))
    (tmp_path / "map.toml").write_text(
        f'[up]\n{header}"press.x" = {{ address = 40, type = "int16", scale = 1e-5 }}\n'
        '"press.p_head" = { address = 41, type = "uint32", scale = 100.0, offset = -1e5 }\n'
        f"[down]\n{header}"
    )
    up, _ = blocks(*LAYOUT.names("stream"), tmp_path / "map.toml")
    numbers = np.zeros(len(up.names))
    numbers[up.names.index("press.x")] = -0.12345
    numbers[up.names.index("press.p_head")] = 7.0e6
    registers = up.encode(numbers)
    assert registers[40] == 65536 - 12345 and registers[41:43] == [71000 >> 16, 71000 & 0xFFFF]
    again = up.decode(registers)
    assert again[up.names.index("press.x")] == pytest.approx(-0.12345)
    assert again[up.names.index("press.p_head")] == 7.0e6
    assert np.isnan(again[up.names.index("press.v")])  # no register, so no sensor


def test_a_number_that_its_register_or_signal_cannot_hold_is_named(tmp_path):
    from ehbench.links.modbus import blocks

    pytest.importorskip("can")
    pytest.importorskip("cantools")
    entry = '"sequence" = { address = 0, type = "int16" }\n'
    (tmp_path / "map.toml").write_text(f"[up]\n{entry}[down]\n{entry}")
    up, _ = blocks(HEADER, HEADER, tmp_path / "map.toml")
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)
    lines = dbc.read_text().replace("32|32@1- (1,0)", "32|16@1- (1,0)").splitlines()
    dbc.write_text("\n".join(line for line in lines if "down_sequence : 1;" not in line))
    down = Frames("down", LAYOUT.names("stream")[1], dbc)
    numbers = np.zeros(len(HEADER))
    for number in (2.0**15, math.nan):
        numbers[SEQUENCE] = number
        for encode in (up.encode, down.encode):
            with refused("links.no_room", InputError):
                encode(numbers)


@pytest.mark.parametrize(
    ("sequence", "command", "fits"),
    [("float32", "int16", True), ("float32", "int8", False), ("int8", "int16", False)],
)
def test_registers_too_narrow_for_a_trial_are_refused_before_it(
    tmp_path, trial, sequence, command, fits
):
    """10 V in steps of 10 mV are 1000, and the trial has more than 127 ticks."""
    pytest.importorskip("pymodbus")
    narrow = {"int8": ("int16", 1 / 256), "int16": ("int16", 1.0), "float32": ("float32", 1.0)}
    down = {name: ("float32", 1.0) for name in HEADER} | {"sequence": narrow[sequence]}
    kind, scale = narrow[command]
    down["press.servo.command"] = (kind, 0.01 * scale)
    text = "".join(
        f'{way}."{name}" = {{ address = {2 * i}, type = "{of[0]}", scale = {of[1]!r} }}\n'
        for way, places in (("up", {name: ("float32", 1.0) for name in HEADER}), ("down", down))
        for i, (name, of) in enumerate(places.items())
    )
    (tmp_path / "map.toml").write_text(text)
    url = f"modbus://127.0.0.1:9?map={tmp_path / 'map.toml'}"
    if fits:
        return open_machine(prepared(trial), url).close()
    with refused("links.no_room", InputError):
        open_machine(prepared(trial), url)


def answers_of(server, *wrong):
    """What a Modbus link takes of a server in plain sockets that first answers as given."""
    from ehbench.links.modbus import ModbusLink

    taken, names = [], (HEADER, HEADER)
    with closing(ModbusLink("127.0.0.1", server.getsockname()[1], names)) as link:
        for count in range(len(wrong) + 1):
            taken.append((link.send(np.full(len(HEADER), count + 1.0)), link.receive(0.0))[1])
    return taken


def test_answers_that_are_none_of_a_server_end_nothing():
    """An exception, too few registers, noise, a connection that breaks; then a sound answer."""
    pytest.importorskip("pymodbus")
    short, sound = b"\x17\x04" + bytes(4), b"\x17\x20" + struct.pack(">8f", *range(8))
    wrong = (b"\x97\x02", short, b"noise", None)

    def serve():
        left, connection = [*wrong, sound], None
        while left:
            connection = connection or server.accept()[0]
            asked = connection.recv(300)
            if not asked:
                connection = connection.close()
                continue
            body = left.pop(0)
            head = asked[:4] + struct.pack(">HB", 1 + len(body or b""), asked[6])
            if body == b"noise":
                connection.sendall(bytes(range(40)))
            elif body is not None:
                connection.sendall(head + body)
            if body in (b"noise", None):
                reset = struct.pack("ii", 1, 0)  # at once, and not in good order
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
                connection = connection.close()
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        taken = answers_of(server, *wrong)
        thread.join(5.0)
    assert [[item.size for item in came] for came in taken[:2]] == [[0], [0]]  # each is counted
    assert taken[2:4] == [[], []] and taken[4][0].tolist() == [*range(8)]


@pytest.mark.parametrize(
    ("url", "key"),
    [
        ("udp://no.such.host.invalid:1", "links.system"),
        ("can://virtual/x?map=no_such.dbc", "links.system"),
        ("can://no_such/x?map={dbc}", "links.system"),
        ("labjack://ANY?map=card.toml", "links.card"),
    ],
)
def test_a_link_that_cannot_open_is_an_error_of_the_input(tmp_path, url, key):
    for needed in ("can", "cantools") if url.startswith("can:") else ():
        pytest.importorskip(needed)
    (dbc,) = write_files(LAYOUT, 100.0, "dbc", tmp_path)
    with refused(key, InputError) as error:
        Address.of(url.format(dbc=dbc)).link()
    assert error.value.fields.get("why", "said")


@pytest.mark.parametrize(
    ("url", "key"),
    [
        ("udp://127.0.0.1:{port}", "links.system"),
        ("udp://127.0.0.1:{port}?clock=virtual", "links.system"),
        ("modbus://127.0.0.1:{port}", "links.system"),
        ("nidaq://Dev1?map=x", "links.card"),
    ],
)
def test_a_port_in_use_and_a_card_are_refused_and_not_announced(
    trial, url, key, capsys, monkeypatch
):
    """Nor does the library of Modbus add lines of its own."""
    pytest.importorskip("pymodbus")
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # those of pytest would take them
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as also,
    ):
        also.bind(taken.getsockname())
        with refused(key, InputError):
            place = url.format(port=taken.getsockname()[1])
            serve(trial, place, None, 100.0, 0.02, allow_code=False)
    assert capsys.readouterr().err == ""


def test_a_responder_that_is_filled_in_stays(tmp_path):
    for kind, name in (("c", "responder.c"), ("py", "responder.py")):
        (tmp_path / name).write_text("mine")
        files = write_files(LAYOUT, 1000.0, kind, tmp_path)
        assert [path.name for path in files] == [WRITERS[kind][0]]
        assert (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("tcp://x:1", "scheme"),
        ("udp://", "scheme"),
        ("udp://x:port", "scheme"),
        ("udp://x?a=1", "option"),
        ("udp://x?mode=fast", "mode"),
        ("can://x/y", "map"),
        ("modbus://x?mode=buffered", "buffered"),
    ],
)
def test_an_address_that_is_none_is_refused(url, why):
    with refused("links.url", InputError) as error:
        Address.of(url)
    assert error.value.fields["why"].key == f"links.url_{why}"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('VERSION ""\nBO_ nonsense', "links.dbc"),
        ("\x00\xff", "links.dbc"),
        (
            'VERSION ""\nBU_: a\nBO_ 256 m: 8 a\n SG_ other : 0|8@1+ (1,0) [0|0] "" a\n',
            "links.dbc_signals",
        ),
    ],
)
def test_a_dbc_file_that_is_none_or_another_is_named(tmp_path, text, key):
    pytest.importorskip("cantools")
    pytest.importorskip("can")
    path = tmp_path / "bus.dbc"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError) as error:
        Address.of(f"can://virtual/x?map={path}").link(LAYOUT)
    assert error.value.key == key and error.value.file == str(path)


def test_a_layout_of_a_recipe_is_refused(trial):
    with pytest.raises(InputError) as error:
        wire(trial, ("csv",), 1000.0, None)
    assert error.value.key == "links.wire_rig" and error.value.file == str(trial)


def test_every_layout_that_is_asked_for_is_written(tmp_path):
    run = tmp_path / "run"  # the folder of a run with a rig
    run.mkdir()
    shutil.copy(ROOT / "recipes/rigs/slide_servo.toml", run / "rig.toml")
    written = wire(run, ("c", "m", "csv"), 1000.0, tmp_path)
    names = [Path(line) for line in written.splitlines()]
    assert all(name.is_file() for name in names)
    assert {name.suffix for name in names} == {".h", ".c", ".m", ".csv"}
