"""Files as the libraries of their formats write them are read for what stands in them."""

import gzip
import json
import struct
import sys
import zipfile
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ehbench.app.converting import convert
from ehbench.app.inspection import check
from ehbench.app.mapping import draft, guessed
from ehbench.data import read, readers
from ehbench.data.flowmeter import is_flowmeter
from ehbench.data.readers import (
    READERS,
    Dialect,
    Reader,
    Source,
    SourceColumn,
    SourceTable,
    open_source,
    reader_of,
    suffixes,
)
from ehbench.data.readers.clock import clock
from ehbench.data.record import lost
from ehbench.vocabulary.errors import InputError, LogError
from tests.shared import ROOT, refused
from tools.fuzz import foreign

SHARED = ROOT.parent / "shared" / "data"
DIGITS = {"a.csv": 1e-3}  # [bar] of what the text holds
CLOCKED = {"a.mf4", "a.tdms", "a.parquet", "a_bag", "a_db3"}


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("foreign")
    for name, write in foreign.WRITERS.items():
        write(folder / name)
    return {name: folder / name for name in foreign.WRITERS}


@pytest.mark.parametrize("name", foreign.WRITERS)
def test_a_foreign_file_comes_back_in_si(name, files, tmp_path):
    """Of several rates all come on the fastest; the supply rises along a line, so that it is the
    same between its samples.
    """
    (tmp_path / "m.toml").write_text(foreign.map_of(name))
    record = read(files[name], columns=tmp_path / "m.toml")
    # behind its last sample a slow channel stands for one of its periods
    np.testing.assert_allclose(record.t, foreign.T, atol=1e-9)
    off = DIGITS.get(name, 1e-6) * 1e5
    np.testing.assert_allclose(record["ram.p_head"], foreign.HEAD * 1e5, atol=off)
    volts = (foreign.CURRENT - 12.0) / 8.0 * 10.0
    np.testing.assert_allclose(record["ram.spool.command"], volts, atol=1e-9)
    rises = np.interp(foreign.T, foreign.SLOW, foreign.SUPPLY) * 1e5
    np.testing.assert_allclose(record["p_supply"], rises, atol=max(off, 0.1))
    assert record.losses == ()  # what no map asks for is no loss
    assert ("began" in record.meta) == (name in CLOCKED)
    if name in CLOCKED:
        assert record.meta["began"].startswith("2026-03-01T12:00:00")
    if name.startswith("a_"):
        np.testing.assert_allclose(record["ram.q"], 0.1 * foreign.T, atol=1e-12)
        assert any("/words" in loss for loss in open_source(files[name]).losses)


@pytest.mark.parametrize(("name", "package"), foreign.PACKAGES.items())
def test_without_its_library_a_file_is_refused_with_what_to_install(
    name, package, files, monkeypatch
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(LogError, match=f"read by {package}, which is not installed.*import"):
        open_source(files[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in foreign.WRITERS if not name.startswith("a_")])
def test_a_cut_file_is_a_sentence_or_sound_samples(name, files, tmp_path):
    data = files[name].read_bytes()
    for share in (0.0, 0.02, 0.4, 0.7, 0.97):
        path = tmp_path / name
        path.write_bytes(data[: int(share * len(data))])
        try:
            source = open_source(path)
        except LogError as error:
            assert "\n" not in str(error)
        else:
            assert source.tables


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_mdf_comes_with_its_time_and_a_channel_outside_its_records_is_a_sentence(version, tmp_path):
    """Its offset alone is damaged; the library would write where the process has no memory."""
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "a.mdf"
    t = np.linspace(0.0, 1.0, 40)
    with asammdf.MDF(version=version) as file:
        file.append([asammdf.Signal(t, t, unit="bar", name="Supply")])
        path = Path(file.save(path, overwrite=True))
    (table,) = open_source(path, Dialect()).tables
    assert len(table.columns) == 1 and table.t == pytest.approx(t)
    with asammdf.MDF(path) as file:
        channel = file.groups[0].channels[1]
        if version == "3.30":  # the first bit, behind links, kind, names and texts
            at, put = channel.address + 186, struct.pack("<H", 0xFFF8)
        else:  # the first byte, behind links and four kinds
            at, put = channel.address + 24 + 8 * channel.links_nr + 4, struct.pack("<I", 1 << 23)
    whole = bytearray(path.read_bytes())
    whole[at : at + len(put)] = put
    path.write_bytes(whole)
    with pytest.raises(LogError, match="the channel 'Supply' lies outside its group's records"):
        open_source(path, Dialect())


def _formula(kind: str, text: str) -> dict:
    """A conversion for asammdf: a formula by itself, or one that a table of ranges refers to."""
    if kind == "formula":
        return {"formula": text}
    return {"lower_0": 0.0, "upper_0": 2e9, "text_0": {"formula": text}}


@pytest.mark.parametrize(
    ("version", "kind"), [("3.30", "formula"), ("4.10", "formula"), ("4.10", "table")]
)
@pytest.mark.parametrize(
    "text",
    ["('X1', open({marker!r}, 'w'), 'X1')[0]", "X1.tofile({marker!r})", "log(X1)"],
)
def test_a_formula_in_an_mdf_file_is_never_evaluated(version, kind, text, tmp_path):
    """The library would run it as Python code, or give the raw readings as if converted."""
    asammdf = pytest.importorskip("asammdf")
    from asammdf.blocks.conversion_utils import from_dict

    marker, path, t = tmp_path / "ran", tmp_path / "a.mdf", np.linspace(0.0, 1.0, 40)
    text = text.format(marker=str(marker))
    with asammdf.MDF(version=version) as file:
        conversion = from_dict(_formula(kind, text))
        supply = asammdf.Signal(t, t, unit="bar", name="Supply")
        file.append([supply, asammdf.Signal(t, t, unit="bar", name="Head", conversion=conversion)])
        path = Path(file.save(path, overwrite=True))
    source = open_source(path, Dialect())
    (table,) = source.tables
    assert [column.name for column in table.columns] == ["Supply"]
    assert any("Head" in loss and "formula" in loss for loss in source.losses)
    assert not marker.exists()


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_a_time_that_a_formula_converts_refuses_the_file(version, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    from asammdf.blocks.conversion_utils import conversion_transfer, from_dict

    path, t = tmp_path / "a.mdf", np.linspace(0.0, 1.0, 40)
    with asammdf.MDF(version=version) as file:
        file.append([asammdf.Signal(t, t, unit="bar", name="Supply")])
        # pyrefly: ignore[no-matching-overload]
        conversion = conversion_transfer(from_dict({"formula": "X1*2"}), int(version[0]))
        file.groups[0].channels[0].conversion = conversion
        path = Path(file.save(path, overwrite=True))
    with pytest.raises(LogError, match="the time of .* is converted by a formula"):
        open_source(path, Dialect())


def test_several_rates_are_said(files, tmp_path):
    (tmp_path / "m.toml").write_text(foreign.map_of("a.mf4"))
    record = read(files["a.mf4"], columns=tmp_path / "m.toml")
    assert record.meta["rates"] == "table 'slow': 100 Hz, brought to 1000 Hz"


def test_a_gap_is_named_and_not_bridged(tmp_path):
    """In the fast table the samples are gone; in the slow one the rows of the fast one are."""
    from nptdms import ChannelObject, TdmsWriter

    keep = (foreign.SLOW < 0.1) | (foreign.SLOW >= 0.2)
    with TdmsWriter(tmp_path / "a.tdms") as file:
        about = {"wf_increment": 1e-3, "wf_start_offset": 0.0, "unit_string": "bar"}
        file.write_segment([ChannelObject("fast", "A", foreign.HEAD, about)])
        columns = {"t": foreign.SLOW[keep], "P": foreign.SUPPLY[keep]}
        file.write_segment([ChannelObject("slow", key, one) for key, one in columns.items()])
    names = 'A = "ram.p_head"\nt = "t [s]"\nP = "p_supply [bar]"\n'
    (tmp_path / "m.toml").write_text("[names]\n" + names)
    record = read(tmp_path / "a.tdms", columns=tmp_path / "m.toml")
    assert "table 'slow': about 10 samples missing, 10 between t = 0.09 and 0.2 s" in record.losses
    assert any("rows left out" in loss for loss in record.losses)
    assert not ((record.t > 0.0905) & (record.t < 0.1995)).any()
    assert record.t.size == pytest.approx(290, abs=2)


def test_every_reader_has_a_file_of_its_own_and_knows_its_endings():
    for reader in READERS:
        assert (ROOT / f"ehbench/data/readers/{reader.module}.py").is_file()
        assert set(reader.suffixes) <= set(suffixes())


def test_a_file_is_known_by_how_it_begins(files, tmp_path):
    path = tmp_path / "named_wrong.csv"
    path.write_bytes(files["a.tdms"].read_bytes())
    assert reader_of(path).name == "TDMS"
    path.write_bytes(files["a.xlsx"].read_bytes())
    assert [table.name for table in open_source(path).tables] == ["Log", "Slow"]
    for name in ("text.mat", "text.parquet", "text.mcap", "text.xlsx"):
        (tmp_path / name).write_text("t [s],ram.q [deg]\n0,1\n1,2\n2,4\n", encoding="utf-16")
        assert read(tmp_path / name)["ram.q"] == pytest.approx(np.radians([1, 2, 4]))
    with pytest.raises(LogError, match="does not know '.py' files"):
        reader_of(Path(foreign.__file__))
    with pytest.raises(LogError, match="no ROS 2 bag"):
        reader_of(tmp_path)


@pytest.mark.parametrize(
    ("name", "begins", "key"),
    [
        (
            "a.asc",
            b"date Tue May 12 10:11:12.5 am 2026\r\nbase hex  timestamps absolute\r\n",
            "bus",
        ),
        ("a.trc", b";$FILEVERSION=1.1\r\n;$STARTTIME=46154.42\r\n", "bus"),
        ("a.blf", b"LOGG\x90\0\0\0", "bus"),
        ("a.log", b"(1588771234.123456) can0 18FF01F1#0102030405060708\n", "bus"),
        ("a.xlsx", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "old"),
        ("a.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "old"),
    ],
)
def test_what_another_program_must_convert_first_is_told(name, begins, key, tmp_path):
    (tmp_path / name).write_bytes(begins + b"0.1 1 2\n" * 9)
    keys = {"bus": "data.bus_frames", "old": "data.old_or_locked_workbook"}
    with refused(keys[key], LogError):
        open_source(tmp_path / name)


@pytest.mark.parametrize("name", ["a.mcap.gz", "a.mf4.gz", "a.parquet.gz", "a.xlsx.gz"])
def test_a_binary_file_that_gzip_packed_is_to_be_unpacked(name, tmp_path):
    (tmp_path / name).write_bytes(gzip.compress(b"\x89MCAP0\r\n" * 9))
    with refused("data.packed", LogError):
        open_source(tmp_path / name)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"t,x\n0,1\n1,2\n2,4\n"))
    assert open_source(tmp_path / "a.csv.gz").tables[0].size == 3


ANNOTATED = """#group,false,false,true,true,false,false,true,true
#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string
#default,_result,,,,,,,
,result,table,_start,_stop,_time,_value,_field,_measurement
"""


def long_rows(order, late=0.0):
    """Rows (time [ms], name, value) of two signals, one after the other or in turns."""
    names = ("p", "x")
    each = [(n + late * (name == "x"), name, n + 7.5 * (name == "x")) for name in names for n in N]
    return each if order == "blocks" else sorted(each, key=lambda row: (row[0], row[1]))


N = range(40)


@pytest.mark.parametrize("order", ["blocks", "turns"])
@pytest.mark.parametrize("late", [0.0, 0.5])
def test_a_value_in_each_row_becomes_a_column_for_each_name(order, late, tmp_path):
    """As InfluxDB and data frames write them; signals of two clocks are two tables."""
    rows = long_rows(order, late)
    text = "time,signal,value\n" + "".join(f"{t / 1e3:.4f},{name},{y}\n" for t, name, y in rows)
    (tmp_path / "long.csv").write_text(text)
    day, begins = "2023-11-14T22:13:", "2023-11-14T22:13:20Z,2023-11-14T22:14:20Z"
    text = ANNOTATED
    for t, name, y in rows:
        text += f",,{int(name == 'x')},{begins},{day}{20 + t / 1e3:07.4f}Z,{y},{name},ram\n"
    (tmp_path / "influx.csv").write_text(text)
    for file in ("long.csv", "influx.csv"):
        tables = open_source(tmp_path / file).tables
        assert len(tables) == 1 + bool(late)
        found = {column.name: column for table in tables for column in table.columns}
        assert found["p"].values.tolist() == [float(n) for n in N]
        assert found["x"].values.tolist() == [n + 7.5 for n in N]
        for table in tables:
            steps = np.diff(table.columns[0].values)
            assert steps == pytest.approx(np.full(39, 1e-3)) and table.lines is not None


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("time,state,p", lambda n: f"{n},{'on' if n % 9 > 4 else 'off'},{n % 7}"),
        ("time,run,p,x", lambda n: f"{n % 20},{'A' if n < 20 else 'B'},{n % 7},{n}"),
        ("drop,valve,flow", lambda n: f"{n % 20},{'A' if n < 20 else 'B'},{n % 7}"),
    ],
)
def test_words_beside_signals_do_not_name_them(head, row, tmp_path):
    (tmp_path / "a.csv").write_text(f"{head}\n" + "".join(f"{row(n)}\n" for n in N))
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.size == 40 and len(table.words) == 1
    assert len(table.columns) == head.count(",")


def test_an_oscilloscopes_letters_of_units(tmp_path):
    """mS are milliseconds, and the V of CH1V is its unit."""
    rows = "".join(f"{n}.5,{n}.25\n" for n in N)
    (tmp_path / "a.csv").write_text("#CLOCK=10.00mS\nCH1V,CH2mV\n" + rows)
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.t is not None and np.diff(table.t) == pytest.approx(np.full(39, 0.01))
    assert [column.known_unit for column in table.columns] == ["V", "mV"]
    assert {guess.channel for guess in guessed(open_source(tmp_path / "a.csv"), None).values()} == {
        ""
    }
    (tmp_path / "b.csv").write_text("Time(mS),CH1(V)\n" + "".join(f"{n},{n % 7}\n" for n in N))
    guess = guessed(open_source(tmp_path / "b.csv"), None)["Time(mS)"]
    assert (guess.channel, guess.unit, guess.certainty) == ("t", "ms", "certain")


def test_titles_before_each_name_need_no_row_of_units(tmp_path):
    """As an older TwinCAT Scope exports: an address below the names is none."""
    pairs = ("Name\tpA\tName\tpB", "SampleTime[ms]\t1\tSampleTime[ms]\t1")
    pairs += ("SymbolName\tGVL.a\tSymbolName\tGVL.b", "NetID\t5.1.2\tNetID\t5.1.2")
    rows = [f"{k}\t{k},5\t{k}\t{2 * k},5" for k in range(40)]
    (tmp_path / "a.csv").write_text("\n".join(["Name\tProject\t", "", *pairs, "", *rows]))
    (table,) = open_source(tmp_path / "a.csv").tables
    assert [column.name for column in table.columns][1::2] == ["pA", "pB"]
    assert table.columns[0].known_unit == "ms"


def test_a_table_is_chosen_by_its_name(files):
    source = open_source(files["a.xlsx"], Dialect(table="Slow"))
    assert [table.name for table in source.tables] == ["Slow"]
    with pytest.raises(LogError, match="has no table 'Fast' .it has 'fast', 'slow'"):
        open_source(files["a.mf4"], Dialect(table="Fast"))


TEXTS = {
    "a LabVIEW file": (
        "LabVIEW Measurement\t\nWriter_Version\t2\n***End_of_Header***\t\n\t\nChannels\t2\t\t\n"
        "Samples\t5\t5\t\nX0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.001\t0.001\t\n***End_of_Header***\t\t\n"
        "X_Value\tVoltage\tVoltage\tComment\n0.0\t1.5\t2.5\n0.1\t1.5\t2.5\n0.2\t1.5\t2.5\n",
        {"X_Value": "", "Voltage": "", "Voltage 2": ""},
    ),
    "white space and a remark as header": (
        "# t p_A\n# s bar\n0.0  1.5\n0.1  2.5\n0.2\t3.5\n",
        {"t": "s", "p_A": "bar"},
    ),
    "no header": ("0.0,1.5\n0.1,2.5\n0.2,3.5\n", {"column 1": "", "column 2": ""}),
    "units in names": (
        "Zeit in ms;Druck / bar;Weg [mm];Winkel (°)\n0;1,5;3;4\n1;1,5;3;4\n2;1,5;3;4\n",
        {"Zeit in ms": "ms", "Druck / bar": "bar", "Weg [mm]": "mm", "Winkel (°)": "deg"},
    ),
    "quoted, with commas in names": (
        '"t","p, head [bar(g)]"\n"0.0","1.5"\n"0.1","2.5"\n"0.2","3.5"\n',
        {"t": "", "p, head [bar(g)]": "bar"},
    ),
    "times of day": (
        "stamp;p\n01.03.2026 12:00:00,000;1,5\n01.03.2026 12:00:00,100;2,5\n"
        "01.03.2026 12:00:00,200;3,5\n",
        {"stamp": "s", "p": ""},
    ),
    "times of day, with a row that says their form": (
        "Prüfstand;2\n\nUhrzeit;Druck A;Ventil\nhh:mm:ss,ms;bar;%\n12:00:00,000;1,5;2\n"
        "12:00:00,100;2,5;2\n12:00:00,200;3,5;2\n",
        {"Uhrzeit": "s", "Druck A": "bar", "Ventil": "%"},
    ),
    "units of which one is unheard of": (
        "time,p_cap,state,flow\ns,kN/cm2,flag8,gpm (US)\n0.0,1.5,1,2\n0.1,2.5,1,2\n0.2,3.5,1,2\n",
        {"time": "s", "p_cap": "kN/cm2", "state": "", "flow": "gpm"},
    ),
    "numbers in quotes with decimal commas": (
        '"t [s]","p_A bar"\n"0,0","1,5"\n"0,1","2,5"\n"0,2","3,5"\n',
        {"t [s]": "s", "p_A bar": "bar"},
    ),
    "more rows of facts below the header": (
        "Name\tp1\tp2\nUnit\tbar\tV\nRate\t1000\t1000\n"
        "0.0\t1.5\t2.5\n0.1\t1.5\t2.5\n0.2\t1.5\t2.5\n",
        {"Name": "", "p1": "bar", "p2": "V"},
    ),
    "a unit as a remark": (
        "#CHANNEL:CH1\n#CLOCK=1.0mS\n#SIZE=3\n#UNITS:V\n\n1.5\n2.5\n3.5\n",
        {"column 1": "V"},
    ),
    "a unit of channels beside a number of the row": (
        "#CHANNEL:CH1\n#CLOCK=1.0mS\n#UNITS:V\n0,1.5\n1,2.5\n2,3.5\n",
        {"column 1": "", "column 2": ""},
    ),
    "names and units as remarks with titles": (
        "#title: a, b\n#units: s, bar\n#names: Time, p_A\n0.0,1.5\n0.1,2.5\n0.2,3.5\n",
        {"Time": "s", "p_A": "bar"},
    ),
    "a remark as wide as the rows": (
        "# Rate: 1 kHz\n# Operator: A, B at 10:30\n0.0,1.5\n0.1,2.5\n0.2,3.5\n",
        {"column 1": "", "column 2": ""},
    ),
    "a remark as header, whose cells say their units": (
        "# t: s, p_A: bar\n0.0,1.5\n0.1,2.5\n0.2,3.5\n",
        {"t: s": "", "p_A: bar": "bar"},
    ),
    "facts of each channel above the names": (
        "Gating,0.0% to 100.0%,\nProbe Attenuation,1,1\nVertical Units,V,A\n"
        "Vertical Scale,0.5,0.5\nLabel,p_A,coil\nTIME,CH1,CH2\n"
        "0.0,1.5,0\n0.1,2.5,0\n0.2,3.5,0\n",
        {"TIME": "", "CH1": "V", "CH2": "A"},
    ),
    "facts of each channel between names and units": (
        "Time  1 - default sample rate\tp_A\nT0 = 11.05.2026 10:11:12\tT0 = 11.05.2026 10:11:12\n"
        "Comment:\tamplifier 2\ns\tbar\n0,0\t1,5\n0,1\t2,5\n0,2\t3,5\n",
        {"Time  1 - default sample rate": "s", "p_A": "bar"},
    ),
    "titled names above rows that begin blank": (
        '"path","","Model/p_A"\n"trace_names","Time","p_A"\n"trace_values"\n'
        ",0.0,1.5\n,0.1,2.5\n,0.2,3.5\n",
        {"Time": "", "p_A": ""},
    ),
    "an 'in' before each unit": (
        "in s,C1 in V\n0.0,1.5\n0.1,2.5\n0.2,3.5\n",
        {"in s": "s", "C1 in V": "V"},
    ),
    "words beside": (
        "t,p,state\n0.0,1.5,RUN\n0.1,2.5,RUN\n0.2,3.5,STOP\n",
        {"t": "", "p": ""},
    ),
}


def _block(head: str, rows: int, factor: float, t0: float = 0.0) -> str:
    return head + "".join(f"{t0 + n / 50:g};{factor * n:g}\n" for n in range(rows))


def test_tables_below_one_another_are_read_apart_or_as_one(tmp_path):
    """Two heads, a head that comes again, and a block of words that is none."""
    first, second = "Run;1\nt;p\ns;bar\n", "Run;2\nt;x\ns;mm\n"
    again = _block(first, 25, 3.0) + "\n" + _block(first, 30, 3.0, 0.5)
    words = "\nOperator;me\n\nRemark;none\n"
    (tmp_path / "a.csv").write_text(again + words + "\n" + _block(second, 40, -2.0))
    source = open_source(tmp_path / "a.csv")
    assert [(table.name, table.size) for table in source.tables] == [("1", 55), ("2", 40)]
    assert set(source.names()) == {"1/t", "2/t", "p", "x"}
    pressure, stroke = (table.columns[1] for table in source.tables)
    assert pressure.values.tolist() == [3.0 * n for n in (*range(25), *range(30))]
    assert stroke.values.tolist() == [-2.0 * n for n in range(40)]
    assert [column.unit for column in (pressure, stroke)] == ["bar", "mm"]
    assert [table.lines and table.lines[-1] for table in source.tables] == [62, 110]
    (alone,) = open_source(tmp_path / "a.csv", Dialect(table="2")).tables
    assert [column.name for column in alone.columns] == ["t", "x"]


def test_rows_without_a_time_have_the_one_that_the_facts_above_say(tmp_path):
    facts = "TraceName,p,q\nVUnit,bar,deg\nHResolution,2.0E-03,{}\nHOffset,-0.5,-0.5\n\n"
    rows = "".join(f",{n}.5,{n}.25\n" for n in range(30))
    (tmp_path / "a.csv").write_text(facts.format("2.0E-03") + rows)
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.t is not None and table.t.tolist() == [-0.5 + 2e-3 * n for n in range(30)]
    facts = "X,CH1,Start,Increment,\nSequence,Volt,-5E-01,2E-03\n"  # below their titles
    (tmp_path / "b.csv").write_text(facts + "".join(f"{n},{n}.5,,\n" for n in range(30)))
    (again,) = open_source(tmp_path / "b.csv").tables
    assert again.t is not None and again.t.tolist() == table.t.tolist()
    assert [(one.name, one.unit) for one in again.columns] == [("X", "counts"), ("CH1", "V")]
    rate = "Sample rate: 0.5 kHz\nt0 = -500 ms\np [bar]\tq [deg]\n"  # behind their titles
    (tmp_path / "c.txt").write_text(rate + rows.replace(",", "\t").replace("\n\t", "\n")[1:])
    (again,) = open_source(tmp_path / "c.txt").tables
    assert again.t is not None and again.t.tolist() == pytest.approx(table.t.tolist())
    facts = "TraceName,p,q\nVUnit,bar,deg\nHResolution,2.0E-03,{}\nHOffset,-0.5,-0.5\n\n"
    (tmp_path / "a.csv").write_text(facts.format("1.0E-03") + rows)  # each its own: nobody knows
    assert open_source(tmp_path / "a.csv").tables[0].t is None


def test_a_header_alone_is_said(tmp_path):
    path = tmp_path / "a.csv"
    for text, key in (("Zeit;Weg\ns;mm\n", "data.only_header"), ("", "data.no_rows_of_numbers")):
        path.write_text(text)
        with refused(key):
            open_source(path)


def test_seconds_and_their_nanoseconds_are_one_clock(tmp_path):
    rows = [(1700000000 + n // 4, n % 4 * 250000000, n) for n in range(30)]
    text = "".join("{},{},{}.5\n".format(*row) for row in rows)
    (tmp_path / "a.csv").write_text("header.stamp.sec,header.stamp.nanosec,p [bar]\n" + text)
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.columns[0].values.tolist() == [0.25 * n for n in range(30)]
    assert table.columns[0].unit == "s" and table.began == 1700000000.0
    (tmp_path / "a.csv").write_text("sec,nsec,p [bar]\n" + text.replace(",250000000,", ",2e9,"))
    (table,) = open_source(tmp_path / "a.csv").tables  # no part of a second
    assert table.columns[0].values[0] == 1700000000.0


@pytest.mark.parametrize(
    "text, values",
    [
        ('[{"t": 0, "p": {"q": 1.125}},\n {"t": 1}, {"t": 2, "p": {"q": 3}}]', [1.125, 3.0]),
        ('{"p.q": [1.5, "n/a", 2, NaN], "t": [0, 1, 2, 3]}', [1.5, 2.0]),
        ('{"t": 0}\n{"t": 1, "p": {"q": 2}}\n{"t": 2, "p": {"q": 3}}\n{"t": 3, "p', [2.0, 3.0]),
        ('{"t": 1}', "data.no_records"),
        ("[1, 2]", "data.no_records"),
    ],
)
def test_json_of_records_or_columns_is_read(text, values, tmp_path):
    (tmp_path / "a.json").write_text(text)
    if isinstance(values, str):
        with refused(values, LogError):
            open_source(tmp_path / "a.json")
        return
    source = open_source(tmp_path / "a.json")
    column = next(one for one in source.tables[0].columns if one.name == "p.q")
    assert column.values[np.isfinite(column.values)].tolist() == values
    assert len(source.losses) == text.endswith("p")


def test_ticks_of_windows_are_a_wall_clock(tmp_path):
    began = datetime(2022, 5, 2, 13, 56, 24, 376000, UTC)
    ticks = 132959733843760000  # as a library of others says of that moment
    rows = "".join(f"{ticks + 5000 * n},{n}.5\n" for n in range(30))
    (tmp_path / "a.csv").write_text("FileTime,p [bar]\n" + rows)
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.began == began.timestamp() and table.columns[0].unit == "ns"
    assert table.columns[0].values.tolist() == [5e5 * n for n in range(30)]


@pytest.mark.parametrize("text", TEXTS)
def test_the_dialect_of_a_text_is_found(text, tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(TEXTS[text][0], encoding="utf-8")
    source = open_source(path)
    (table,) = source.tables
    assert {column.name: column.known_unit for column in table.columns} == TEXTS[text][1]
    assert table.size == 3 and all(np.isfinite(one.values).all() for one in table.columns)
    again = open_source(path, source.dialect)  # said in a map, it is the same
    assert [one.name for one in again.tables[0].columns] == list(TEXTS[text][1])
    assert again.dialect == source.dialect


@pytest.mark.parametrize(
    "encoding", "utf-8 utf-8-sig utf-16 utf-16-le utf-16-be utf-32 cp1252".split()
)
def test_encodings(encoding, tmp_path):
    """Of UTF-16 with its mark and without."""
    (tmp_path / "a.csv").write_bytes("t;Öl °C\n0;1,5\n1;2,5\n2;3,5\n".encode(encoding))
    (table,) = open_source(tmp_path / "a.csv").tables
    assert [column.name for column in table.columns] == ["t", "Öl °C"]
    assert table.columns[1].values.tolist() == [1.5, 2.5, 3.5]


def test_cells_that_are_no_number_are_kept_as_they_are(tmp_path):
    rows = [f"{i / 10},{i}" for i in range(1200)]
    rows[1], rows[700], rows[900] = "0.1,abc", "70.0,", "90.0"
    (tmp_path / "a.csv").write_text("t,p\n" + "\n".join(rows) + "\n")
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.columns[1].odd == {1: "abc", 700: "", 900: ""}
    assert np.isnan(table.columns[1].values[[1, 700, 900]]).all()
    assert np.nansum(table.columns[1].values) == sum(range(1200)) - 1 - 700 - 900
    assert table.lines[700] == 702


def test_clock_goes_on_over_midnight_and_knows_zones():
    seconds, began = clock(["23:59:59.5", "00:00:00.5", "", "00:00:01"])
    np.testing.assert_allclose(seconds, [0.0, 1.0, np.nan, 1.5])
    assert began is None
    assert clock(["2026-03-01T13:00:00.25+01:00"])[1] == foreign.BEGAN + 0.25
    assert clock(["3/1/2026 12:00:00 PM"])[1] == foreign.BEGAN
    assert clock(["31.02.2026 12:00:00"])[1] is None


def test_an_archive_is_known_by_what_is_in_it(files, tmp_path, monkeypatch):
    """All archives begin alike. A workbook is one under any name, a new reader gets those with
    its members, and an archive of neither is refused with what it holds.
    """
    module = ModuleType("ehbench.data.readers.lists")

    def read_lists(path: Path, dialect: Dialect) -> Source:
        with zipfile.ZipFile(path) as archive:
            lists = {name: json.loads(archive.read(name)) for name in archive.namelist()}
        columns = (SourceColumn(n.removesuffix(".list"), np.array(x)) for n, x in lists.items())
        return Source((SourceTable("", tuple(columns)),))

    module.read = read_lists
    monkeypatch.setitem(sys.modules, module.__name__, module)
    new = Reader("lists", (".lists",), "lists", "", (readers.ZIP,), "*.list")
    monkeypatch.setattr(readers, "READERS", (*READERS, new))

    def archive(name: str, member: str) -> Path:
        with zipfile.ZipFile(tmp_path / name, "w") as file:
            for channel in ("boom.p_head [bar]", "t [s]"):
                file.writestr(f"{channel}{member}", "[0.0, 1.0, 2.0, 3.0]")
        return tmp_path / name

    for name in ("a.lists", "a.zip", "a.xlsx"):
        assert read(archive(name, ".list"))["boom.p_head"][-1] == pytest.approx(3e5)
    assert reader_of(files["a.xlsx"].rename(tmp_path / "b.zip")).name == "Excel"
    (tmp_path / "b.zip").rename(files["a.xlsx"])
    other = archive("c.xlsx", ".csv")
    for door in (read, open_source, draft, partial(convert, to="mat"), check):
        with refused("data.unknown_archive", InputError):
            door(other)


def test_a_bomb_is_refused(tmp_path, monkeypatch):
    import gzip

    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"0,0\n" * 2_000_000))
    monkeypatch.setattr("ehbench.data.text.available", lambda: 8e6)
    with pytest.raises(InputError, match="unpacks to more than"):
        open_source(tmp_path / "a.csv.gz")


@pytest.mark.skipif(not SHARED.is_dir(), reason="no recordings by others here")
@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("actuator_linkoping/actuator.csv", 1024),
        ("actuator_linkoping/actuator.mat", 1024),
        ("mts_servohydraulic_vrths/0A.txt.gz", 61500),
        ("mts_servohydraulic_vrths/pexdata.mat", None),
        ("mcap/rosbag2/cdr_test_0.mcap", None),
        ("mcap/rosbag2/topics_and_services.mcap", None),
    ],
)
def test_real_recordings_are_read(name, rows):
    source = open_source(SHARED / name)
    assert source.tables and (rows is None or source.tables[0].size == rows)


@pytest.mark.skipif(not SHARED.is_dir(), reason="no recordings by others here")
def test_a_bag_without_numbers_says_what_is_in_it():
    with pytest.raises(LogError, match="no column of numbers.*/chatter .std_msgs/msg/String"):
        open_source(SHARED / "mcap/rosbag2/multiple_files_0.mcap")


def test_a_table_that_the_map_leaves_alone_is_noted_and_no_loss(tmp_path):
    text = _block("t;p\ns;bar\n", 25, 3.0) + "\n" + _block("t;x\ns;mm\n", 25, 3.0)
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "a.map.toml").write_text('[names]\n"1/t" = "t [s]"\np = "ram.p_head [bar]"\n')
    record = read(tmp_path / "a.csv", tmp_path / "a.map.toml")
    (note,) = record.losses
    assert (note.key, note.fields) == ("data.unused_table", {"table": "2", "line": 31})
    assert lost(record.losses) == [] and record.t.size == 25


def test_a_clock_that_mostly_stands_ends_no_reading_without_checks(tmp_path):
    still = "t;p\ns;bar\n" + "".join(f"{n // 20};{n}\n" for n in range(40))
    (tmp_path / "a.csv").write_text(still + "\n" + _block("t;x\ns;mm\n", 40, 3.0))
    (tmp_path / "a.map.toml").write_text(
        '[names]\n"1/t" = "t [s]"\np = "ram.p_head [bar]"\n"2/t" = "t [s]"\nx = "ram.x [mm]"\n'
    )
    record = read(tmp_path / "a.csv", tmp_path / "a.map.toml", check=False)
    assert np.isfinite(record.t).all() and set(record.channels) == {"ram.p_head", "ram.x"}
    with pytest.raises(LogError):
        read(tmp_path / "a.csv", tmp_path / "a.map.toml")


@pytest.mark.parametrize(
    ("header", "readings"),
    [
        ("Time [s],Angle [deg],Valve [V]", False),
        ("Timestamp,Flow [L/min]", False),
        ("t [s],flow [L/min]", False),
        ("valve,command [V],pressure_drop [bar],flow [L/min]", True),
        ("Flow [L/min],Drop [bar]", True),
    ],
)
def test_a_table_with_a_time_is_no_flowmeters(header, readings, tmp_path):
    (tmp_path / "a.csv").write_text(header + "\n" + "1,2,3,4\n")
    assert is_flowmeter(tmp_path / "a.csv") is readings


@pytest.mark.parametrize(
    ("text", "unit", "values", "odd"),
    [
        ("t,p\n0 sec,1.5 bar\n1 sec,-2 bar\n", "bar", [1.5, -2.0], {}),
        ('t;p\n"0";"1,5 °C"\n"1";"2,25 °C"\n', "°C", [1.5, 2.25], {}),
        ("t,p\n0,1.5 bar\n1,2 mbar\n2,3\n", "bar", [1.5, np.nan, 3.0], {1: "2 mbar"}),
        ("t p\n0 1.5D+02\n1 -2.5d-1\n", "", [150.0, -0.25], {}),
        ("t,p\n0,1.5\n1,2\n" + "\0" * 512, "", [1.5, 2.0], {}),
    ],
)
def test_what_stands_beside_digits_changes_no_number(text, unit, values, odd, tmp_path):
    """Units in the cells, the exponents of Fortran, the padding of a file made larger."""
    (tmp_path / "a.txt").write_text(text, "utf-8")
    column = open_source(tmp_path / "a.txt").tables[0].columns[-1]
    np.testing.assert_array_equal(column.values, values)
    assert (column.unit, column.odd) == (unit, odd)


_ROWS = [f"{n / 100:.2f},{n}.5,{-n}.25" for n in range(60)]
HEADS = {  # amid numbers: the lines, and the second column of each table
    "that comes again": (["t,p,q", *_ROWS[:30], "t,p,q", *_ROWS[30:]], [range(60)]),
    "with its units": (
        ["t,p,q", "s,bar,deg", *_ROWS[:30], "t,p,q", "s,bar,deg", *_ROWS[30:]],
        [range(60)],
    ),
    "in another order": (
        ["t,p,q", *_ROWS[:30], "t,q,p", *_ROWS[30:]],
        [range(30), range(30, 60)],
    ),
    "of other units": (
        ["t,p,q", "s,bar,deg", *_ROWS[:30], "t,p,q", "s,MPa,deg", *_ROWS[30:]],
        [range(30), range(30, 60)],
    ),
    "below a note": (
        ["t,p,q", *_ROWS[:20], "", "a note", *_ROWS[20:40], "", "t,p,q", *_ROWS[40:]],
        [[*range(20), np.nan, *range(20, 60)]],
    ),
    "of words that name nothing": (
        ["t,p,q", *_ROWS[:30], "PAUSE,PAUSE,PAUSE", *_ROWS[30:]],
        [[*range(30), np.nan, *range(30, 60)]],
    ),
}


@pytest.mark.parametrize("name", HEADS)
def test_no_row_is_lost_or_renamed_by_a_head_amid_numbers(name, tmp_path):
    lines, truth = HEADS[name]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    tables = open_source(tmp_path / "a.csv").tables
    assert len(tables) == len(truth)
    for table, rows in zip(tables, truth):
        np.testing.assert_array_equal(table.columns[1].values, np.array(rows) + 0.5)


def test_percent_of_a_sheet_are_as_shown(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["t [s]", "valve", "duty [%]"])
    truth = [10.125, -50.0, 100.0, 0.0]
    for row, value in enumerate(truth, 2):
        sheet.append([float(row), value / 100.0, value])
        sheet.cell(row, 2).number_format = "0.0%"
    book.save(tmp_path / "a.xlsx")
    (table,) = open_source(tmp_path / "a.xlsx").tables
    for column in table.columns[1:]:
        assert column.known_unit == "%" and column.doubt is None
        np.testing.assert_allclose(column.values, truth, rtol=1e-15)
