"""What is fuzzed: a corpus, how an input is made of it, and what takes it."""

import io
import json
import shutil
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ehbench import workflow
from ehbench.app import cli, inspection, mapping
from ehbench.config.recipe import load_columns
from ehbench.data import read
from ehbench.data.flowmeter import read_flowmeter
from ehbench.data.logs import write_log
from ehbench.data.readers import open_source
from ehbench.data.record import Record
from ehbench.report import build
from ehbench.runs import rundir
from ehbench.vocabulary.errors import EhbenchError
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import parse
from tests.shared import RIGS, ROOT
from tools.fuzz import foreign, mutants, recorders

SMALL = 40  # rows of a table in the corpus


@dataclass(frozen=True)
class Kind:
    """``make(rng)`` gives an input, ``take(input, folder)`` hands it over; ``share`` of all."""

    make: Callable[[Random], Any]
    take: Callable[[Any, Path], None]
    share: float


def _written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


@cache
def rigs() -> tuple[str, ...]:
    """The rig files that ship."""
    paths = (*sorted(RIGS.glob("*.toml")), ROOT / "ehbench" / "workspace" / "rig.toml")
    return tuple(path.read_text(encoding="utf-8") for path in paths)


def take_rig(data: bytes, folder: Path) -> None:
    inspection.check(_written(folder, "rig.toml", data))


@cache
def recipes() -> tuple[str, ...]:
    """The recipes that ship, with their paths made whole, and small trials."""
    found = []
    for path in sorted((ROOT / "recipes").rglob("*.toml")):
        if path.parent not in (RIGS, ROOT / "recipes" / "bench"):
            text = path.read_text(encoding="utf-8")
            found.append(text.replace('"../', f'"{path.parent.parent}/'))
    small = (
        f'stage = "trial"\nrig = "{RIGS}/slide_servo.toml"\nduration = "1 s"\nrate = "1 kHz"\n'
        'posture = { press = "150 mm" }\n[limits]\nspeed_max = "0.5 m/s"\nramp = "50 ms"\n'
    )
    step = '[[command]]\nvalve = "press.servo"\nkind = "step"\namplitude = "2 V"\nstop = "1 s"\n'
    waves = (
        '[[command]]\nvalve = "press.servo"\nkind = "multisine"\namplitude = "2 V"\n'
        'frequency = "1 Hz"\nfrequency_max = "9 Hz"\nlines = 5\nseed = 1\n'
    )
    loop = (
        '[motion]\nkind = "point_to_point"\nwaypoints = ["100 mm", "200 mm"]\nhold = "0.2 s"\n'
        'speed = "80 mm/s"\nacceleration = "1 m/s^2"\njerk = "9 m/s^3"\n'
    )
    levels = '[motion]\nkind = "velocity_steps"\nlevels = ["30 %", "-80 mm/s"]\ntravel = "9 mm"\n'
    law = '[controller]\nkind = "position"\n'
    own = '[controller]\nclass = "mine:C"\ngains = { a = 1, low_pressure = "2 bar" }\n'
    trials = [small + step, small + waves, small + law + loop, small + own + loop]
    trials.append(small + law + levels)
    return (*found, *(10 * trials))


def take_recipe(data: bytes, folder: Path) -> None:
    path = _written(folder, "recipe.toml", data)
    if str(RIGS / "slide_servo.toml").encode() in data and b'"trial"' in data:
        inspection.check(path)
    else:  # the logs behind the others take long to read
        workflow.load_recipe(path)


@cache
def csv_logs() -> tuple[str, ...]:
    """Small logs as text, in the dialects that are read."""
    t = np.arange(SMALL) / 1e3
    rows = [f"{a:.6g},{0.1 + a:.6g},{2 + a:.6g},{1e3 * a:.6g}" for a in t]
    comma = "\n".join(["t [s],press.x [m],press.p_head [MPa],p_supply [kPa]", *rows]) + "\n"
    return comma, comma.replace(",", ";"), "# a remark\n" + comma.replace(",", "\t")


def take_csv(data: bytes, folder: Path) -> None:
    inspection.check(_written(folder, "log.csv", data))


@cache
def mcap_logs() -> tuple[bytes, ...]:
    """Small logs: one rate, two rates with attachments."""
    t = np.arange(SMALL) / 1e3
    channels = {name: 0.1 + t for name in ("press.x", "press.v", "press.servo.command")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        files = {"rig.toml": rigs()[0].encode()[:500], "a.json": b"{}"}
        write_log(path, Record(t, channels, {"rig": "a rig", "payload": "none"}, files))
        one = path.read_bytes()
        path.unlink()
        write_log(path, Record(20 * t, channels))
        return one, path.read_bytes()


def take_mcap(data: bytes, folder: Path) -> None:
    read(_written(folder, "log.mcap", data))


@cache
def readings() -> tuple[str, ...]:
    """Flowmeter readings in the dialects that are read."""
    head = "valve,direction,command [V],pressure_drop [kPa],flow [gpm],trial,method,note\n"
    rows = [
        f"hepc,forward,{c},{p},{c * p / 9e3},1,flowmeter,\n" for c in (2, 5, 9) for p in (300, 999)
    ]
    comma = head + "".join(rows)
    shipped = sorted((ROOT / "datasets").rglob("flowmeter/*.csv"))[0].read_text(encoding="utf-8")
    return (
        comma,
        comma.replace(",", ";").replace(".", ","),
        "".join(shipped.splitlines(True)[:SMALL]),
    )


def take_readings(data: bytes, folder: Path) -> None:
    read_flowmeter(_written(folder, "flow.csv", data), supply_pressure=2e7)


def make_unit(rng: Random) -> tuple[str, str]:
    row = VOCABULARY[name := rng.choice(list(VOCABULARY))]
    text = f"{rng.choice(mutants.NUMBERS)} {rng.choice(mutants.UNITS)}"
    if rng.random() < 0.4:
        sound = f"{rng.choice(('1', '0.5', '-2e-3', '7'))} {rng.choice((row.unit, row.display))}"
        return mutants.characters(sound, rng) if rng.random() < 0.7 else sound, name
    if rng.random() < 0.7:
        parts = [
            rng.choice((*mutants.UNITS, "*", "/", "^", "**", "(", ")", " ", "2")) for _ in "1234"
        ]
        text = rng.choice(("5 ", "", "1e3")) + "".join(parts[: rng.randrange(5)])
    return text, name


def take_unit(given: tuple[str, str], _: Path) -> None:
    parse(given[0], VOCABULARY[given[1]])


COMMANDS = "init check identify validate tune run-trial report reproduce x".split()
WORDS = (
    *"--out --help -h -q --quiet --allow-code --unvalidated -- - . .. / /dev/null".split(),
    *"/dev/full nowhere.toml b/../a loop full link rig.toml trial.toml log.csv log.mcap".split(),
    *"--out=loop --out=full run.json *.toml ü --version 0 -1 pipe".split(),
    *("", "a" * 300, "a" * 5000, "\udcff"),
)


def make_line(rng: Random) -> list[str]:
    return [rng.choice(COMMANDS), *(rng.choice(WORDS) for _ in range(rng.randrange(4)))]


def take_line(line: list[str], folder: Path) -> None:
    """In a folder with files of each kind, none of which is sound enough to run for long."""
    import os

    (folder / "full").mkdir()
    (folder / "full" / "mine.txt").write_text("mine")
    (folder / "a").mkdir()
    (folder / "a" / "mine.txt").write_text("mine")
    (folder / "loop").symlink_to("loop")
    (folder / "link").symlink_to("full")
    os.mkfifo(folder / "pipe")
    for name, text in (
        ("rig.toml", rigs()[0][:900]),
        ("trial.toml", 'stage = "trial"\nrig = "rig.toml"\nduration = "1 s"\n'),
        ("log.csv", csv_logs()[0]),
        ("run.json", "{}"),
    ):
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "log.mcap").write_bytes(mcap_logs()[0])
    before, said = Path.cwd(), io.StringIO()
    os.chdir(folder)
    try:
        with redirect_stdout(said), redirect_stderr(said):
            cli.app(line, standalone_mode=True)
    except SystemExit as error:
        if error.code not in (0, None):
            raise EhbenchError("refused") from None
    finally:
        os.chdir(before)
        for name in ("full", "a"):
            assert (folder / name / "mine.txt").read_text() == "mine", "a file was lost"


@cache
def runs() -> Path:
    """A small run with a report's worth of files."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz_run_"))
    (folder / "trial.toml").write_text(
        f'stage = "trial"\nrig = "{RIGS}/slide_servo.toml"\nduration = "0.2 s"\n[[command]]\n'
        'valve = "press.servo"\nkind = "step"\namplitude = "2 V"\n'
    )
    return workflow.run(folder / "trial.toml", workflow.Session(root=folder)).folder


def make_run(rng: Random) -> tuple[str, bytes]:
    files = [p for p in sorted(runs().rglob("*")) if p.is_file()]
    path = rng.choice([*files, *(p for p in files if p.suffix == ".json")])
    name, data = path.relative_to(runs()).as_posix(), path.read_bytes()
    if path.suffix == ".mcap":
        return name, mutants.bytes_mutant([data], rng)
    if path.suffix == ".json" and rng.random() < 0.7:
        return name, json.dumps(_odd(json.loads(data), rng)).encode()
    return name, mutants.text_mutant([data.decode("utf-8")], rng)


def _odd(value: Any, rng: Random) -> Any:
    """A JSON value with something in it gone or of another kind."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.2:
            return {name: one for name, one in value.items() if name != key}
        return value | {key: _odd(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        return [*value[:at], _odd(value[at], rng), *value[at + 1 :]]
    return rng.choice(
        (None, -1, 0, 1e308, 10**400, "", "x", [], {}, [[]], {"a": 1}, True, "../x", "$$")
    )


def take_run(given: tuple[str, bytes], folder: Path) -> None:
    """The run is looked at, another one put in its place, and a report made of it."""
    place = folder / "run"
    shutil.copytree(runs(), place)
    (place / given[0]).write_bytes(given[1])
    facts = rundir.read_json(place / "run.json")
    if given[0] != "run.json":  # made right again, by another version
        facts["outputs"][given[0]] = rundir.sha256(place / given[0])
        rundir.write_json(place / "run.json", facts | {"schema": 99})
    (folder / "recipe.toml").write_text("stage = 'trial'\n")
    try:
        rundir.is_whole(place)
        build([place])
    finally:
        with rundir.open_run(place, "trial", folder / "recipe.toml", []):
            pass


@cache
def foreign_texts() -> tuple[str, ...]:
    """Small tables as other recorders write them."""
    rows = [f"{i / 1e3:g};{50 + i / 10:g};{12 + i % 3};RUN" for i in range(SMALL)]
    head = "Bench;3\nSamples;40;40;40\n\nTime (s);PT-101 cyl A;AO0 valve;state\ns;bar;mA;\n"
    text = head + "\n".join(rows) + "\n"
    clocked = [row.replace("0.0", "01.03.2026 12:00:00.0", 1) for row in rows]
    return (
        text,
        text.replace(".", ","),
        "# remark\n" + text.replace(";", "\t"),
        "stamp;p [bar(g)];u [%];state\n" + "\n".join(clocked),
        "\n".join(row.replace(";", "  ") for row in rows),
    )


def take_foreign(data: bytes, folder: Path, name: str = "a.txt") -> None:
    """A map is drafted, and the file read by it."""
    path = _written(folder, name, data)
    source = open_source(path)
    text = mapping.drafted(path, source, mapping.guessed(source, None))
    columns = _written(folder, "m.map.toml", text.encode())
    if load_columns(columns).columns.names:
        read(path, columns=columns)


@cache
def foreign_files() -> dict[str, bytes]:
    """Small recordings of the formats that libraries read, by a name of theirs."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, write in foreign.WRITERS.items():
            path = Path(folder) / name
            write(path)
            files = sorted(path.glob(f"{name}.*")) if path.is_dir() else [path]
            found |= {one.name: one.read_bytes() for one in files}
    return found


def make_file(rng: Random) -> tuple[str, bytes]:
    name = rng.choice(list(foreign_files()))
    return name, mutants.bytes_mutant([foreign_files()[name]], rng)


@cache
def maps() -> tuple[str, ...]:
    """Maps of columns with every key."""
    every = (
        'separator = ";"\ndecimal = ","\nskip = 3\nunit_row = true\nencoding = "utf-8"\n'
        'bad_samples = "leave out"\n[names]\n"Time (s)" = "t [s]"\n'
        '"PT-101 cyl A" = { channel = "ram.p_head", unit = "V", scale = "-2 bar/V", '
        'offset = "-1 bar", neutral = "2 V", sign = -1, filter = "50 Hz", '
        'bad_samples = "refuse" }\n'
        f'"AO0 valve" = {{ channel = "ram.spool.command", {foreign.CURRENTS} }}\n'
    )
    return every, every.replace("bad", 'rate = "1 kHz"\nbad', 1)


def take_map(data: bytes, folder: Path) -> None:
    """It is checked, and a text read by it."""
    path = _written(folder, "m.map.toml", data)
    load_columns(path)
    read(_written(folder, "a.csv", foreign_texts()[1].encode()), columns=path)


KINDS = {
    "unit texts": Kind(make_unit, take_unit, 0.13),
    "MCAP logs": Kind(lambda rng: mutants.mcap_mutant(mcap_logs(), rng), take_mcap, 0.18),
    "flowmeter CSV": Kind(lambda rng: mutants.text_mutant(readings(), rng), take_readings, 0.14),
    "CSV logs": Kind(lambda rng: mutants.text_mutant(csv_logs(), rng), take_csv, 0.14),
    "foreign texts": Kind(
        lambda rng: mutants.text_mutant(foreign_texts(), rng), take_foreign, 0.03
    ),
    "foreign files": Kind(
        make_file, lambda given, folder: take_foreign(given[1], folder, given[0]), 0.02
    ),
    "maps of columns": Kind(lambda rng: mutants.text_mutant(maps(), rng), take_map, 0.03),
    "recipe TOML": Kind(lambda rng: mutants.text_mutant(recipes(), rng), take_recipe, 0.08),
    "rig TOML": Kind(lambda rng: mutants.text_mutant(rigs(), rng), take_rig, 0.08),
    "command lines": Kind(make_line, take_line, 0.03),
    "run folders": Kind(make_run, take_run, 0.02),
    **{name: Kind(*item) for name, item in recorders.RECORDERS.items()},
}
