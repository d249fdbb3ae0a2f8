"""Maps of columns: what they make of numbers, of bad samples, and where they are named."""

import re
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ehbench.app import cli, converting, inspection, mapping
from ehbench.config.recipe import MappedColumn, load_columns, load_recipe, load_rig
from ehbench.data import read, read_log
from ehbench.data.flowmeter import read_flowmeter
from ehbench.data.readers import open_source
from ehbench.data.readers.table import Source, SourceColumn, SourceTable, unit_in
from ehbench.data.record import lost, recovered
from ehbench.report import terminal
from ehbench.signals.series import lowpass
from ehbench.vocabulary import message
from ehbench.vocabulary.errors import InputError, LogError, UnitError
from tests.shared import ROOT
from tools.fuzz import foreign

RIG = ROOT / "recipes/rigs/slide_servo.toml"
LOG = ROOT / "datasets/slide_servo/steps/press_no_load.mcap"


@pytest.fixture
def unpictured(monkeypatch) -> None:
    """Drafts have an empty picture, for tests that look at none: to draw takes most of a draft."""
    monkeypatch.setattr(mapping, "draw", lambda path, *_: path.touch())


def column(**keys) -> MappedColumn:
    return MappedColumn(**keys)


DRIVER, STROKE = {"channel": "a.b.command"}, {"channel": "ram.x"}
LAWS = {
    "a unit": ({"channel": "ram.p_head", "unit": "bar"}, 3.0, 3e5),
    "a unit of an instrument": ({"channel": "ram.p_head", "unit": "psi"}, 1.0, 6894.757),
    "a scale": ({"channel": "ram.x", "unit": "mm", "scale": 2.0}, 3.0, 6e-3),
    "volts of a sensor": ({"channel": "ram.p_rod", "unit": "V", "scale": "25 bar/V"}, 4.0, 1e7),
    "counts": ({"channel": "ram.x", "unit": "counts", "scale": "0.01 mm/counts"}, 500.0, 5e-3),
    "a sign and a neutral": (
        {"channel": "a.b.command", "unit": "V", "neutral": "2.5 V", "sign": -1},
        3.0,
        -0.5,
    ),
    "a neutral in another unit": (
        {"channel": "a.b.command", "unit": "V", "neutral": "2500 mV"},
        3.0,
        0.5,
    ),
    "an offset": ({"channel": "ram.p_head", "unit": "bar", "offset": "-1 bar"}, 3.0, 2e5),
    "an offset in the unit of the file": (
        {"channel": "ram.p_head", "unit": "bar", "offset": -0.4},
        3.0,
        2.6e5,
    ),
    "a current": (DRIVER | {"from": ("4 mA", "20 mA"), "to": ("-10 V", "10 V")}, 16.0, 5.0),
    "amperes": (DRIVER | {"unit": "A", "from": ("4 mA", "20 mA"), "to": ("0 V", "8 V")}, 0.012, 4),
    "a share": (DRIVER | {"from": ("-100 %", "100 %"), "to": ("-10 V", "10 V")}, 30.0, 3.0),
    "a duty": ({"channel": "a.b.command", "unit": "duty", "scale": "10 V/duty"}, 0.25, 2.5),
    "a speed of a drive": ({"channel": "a.b.command", "unit": "rpm", "scale": "5 mV/rpm"}, 1e3, 5),
    "a factor": (DRIVER | {"unit": "mA", "scale": "0.625 V/mA", "neutral": 12}, 20.0, 5.0),
    "degrees": ({"channel": "temperature", "unit": "degC", "offset": "2 degC"}, 20.0, 295.15),
}


@pytest.mark.parametrize("law", LAWS)
def test_a_column_becomes_si(law):
    keys, reading, si = LAWS[law]
    gain, zero = column(**keys).line("")
    assert gain * reading + zero == pytest.approx(si, rel=1e-6)


WRONG = {
    "no such word": ({"channel": "ram.p_haed"}, "unknown channel 'ram.p_haed'; nearest.*p_head"),
    "half a line": ({"channel": "ram.x", "from": ("1 V", "2 V")}, "belong together"),
    "two ways": (STROKE | {"from": ("1 V", "2 V"), "to": ("1 m", "2 m"), "scale": 2.0}, "say all"),
    "one point": (STROKE | {"from": ("1 V", "1 V"), "to": ("1 m", "2 m")}, "one point twice"),
    "a wrong unit": ({"channel": "ram.x", "unit": "bar"}, "cannot be turned into m"),
    "a bare current": (DRIVER | {"unit": "mA"}, "cannot be turned into V.*from = .*4 mA"),
    "a bare offset": (STROKE | {"unit": "V", "scale": "1 m/V", "offset": 1.0}, "offset = 1 has no"),
    "a bare end": ({"channel": "ram.x", "from": ("0", "1"), "to": ("0", "1")}, "has no unit"),
    "an endless unit": (STROKE | {"unit": "V", "scale": "1 m/V**9**9**9"}, "unknown unit"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_map_that_cannot_be_right_is_refused(mistake):
    keys, said = WRONG[mistake]
    with pytest.raises(ValueError, match=said):
        column(**keys)


def test_mistakes_in_a_map_name_its_line(tmp_path):
    path = tmp_path / "a.map.toml"
    path.write_text('skip = 3\n[names]\nt = "t [s]"\n"p A" = "ram.p_haed [bar]"\n')
    with pytest.raises(InputError, match=r"a.map.toml:4: names.p A: unknown channel"):
        load_columns(path)
    path.write_text('skipp = 3\n[names]\nt = "t [s]"\n')
    with pytest.raises(InputError, match=r"a.map.toml:1: unknown key 'skipp' .did you mean 'skip'"):
        load_columns(path)
    path.write_text('[names]\na = "ram.x [m]"\nb = "ram.x [m]"\n')
    with pytest.raises(InputError, match="two columns are 'ram.x'"):
        load_columns(path)


def test_a_map_takes_keys_from_another_and_not_from_itself(tmp_path):
    base, own = tmp_path / "base.map.toml", tmp_path / "own.map.toml"
    base.write_text('skip = 3\ndecimal = ","\n[names]\nA = "ram.x [mm]"\nB = "ram.v [m/s]"\n')
    own.write_text('file = "base.map.toml"\nskip = 5\n[names]\nA = "ram.x [m]"\n')
    found = load_columns(own)
    assert (found.columns.skip, found.columns.decimal) == (5, ",")
    assert found.columns.names["A"].unit == "m" and found.columns.names["B"].unit == "m/s"
    assert found.files == (own, base)
    assert found.at("names", "A")["file"] == own and found.at("names", "B")["file"] == base
    base.write_text('file = "own.map.toml"\n')
    with pytest.raises(InputError, match="takes its own keys"):
        load_columns(own)


def write(folder: Path, rows: list[str], names: str = "") -> tuple[Path, Path]:
    (folder / "a.csv").write_text("time;A;AO\n" + "\n".join(rows) + "\n")
    own = names or 'time = "t [s]"\nA = "ram.p_head [bar]"\nAO = "ram.spool.command [V]"\n'
    (folder / "m.toml").write_text(own if "[names]" in own else "[names]\n" + own)
    return folder / "a.csv", folder / "m.toml"


def rows() -> list[str]:
    return [f"{i / 1000:.3f};{50 + i / 100:g};{i % 2:g}" for i in range(200)]


TIME, HEAD = 'time = "t [s]"\n', 'A = "ram.p_head [bar]"\n'
REFUSED = {  # the row of line 42, the map, the message's key, the line, what is quoted
    "blank": ("0.040;;0", TIME + HEAD, "data.bad_sample", 42, "blank"),
    "a word": ("0.040;abc;0", TIME + HEAD, "data.bad_sample", 42, "'abc'"),
    "NaN": ("0.040;NaN;0", TIME + HEAD, "data.bad_sample", 42, "nan"),
    "implausible": ("0.040;50000;0", TIME + HEAD, "data.bad_value", 42, "5e+06 kPa"),
    "a cell too many": ("0.040;50;0;7", TIME + HEAD, "data.row_width", 42, "4 cells"),
    "one more in a channel": (
        *("0.040;50;0;7", 'rate = "1 kHz"\n[names]\n' + HEAD, "data.bad_sample", 42),
        "4 cells, the header has 3",
    ),
    "no time": ("0.040;50;0", HEAD, "data.no_time", None, "rate = "),
    "no column": (
        "0.040;50;0",
        TIME + HEAD.replace("A", "AOO"),
        "data.no_column",
        None,
        "'AO'",
    ),
    "no unit": ("0.040;50;0", f'{TIME}A = "ram.p_head"\n', "data.column_error", 3, 'unit = "kPa"'),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_is_refused_with_its_line_and_what_would_be_right(name, tmp_path):
    row, names, key, line, quoted = REFUSED[name]
    path, columns = write(tmp_path, [*rows()[:40], row, *rows()[41:]], names)
    with pytest.raises(InputError) as caught:
        read(path, columns=columns)
    assert (caught.value.key, caught.value.line) == (key, line)
    assert quoted in str(caught.value)


def test_a_channel_of_which_nothing_is_left_is_named(tmp_path):
    """Such as psi that are called bar: also where bad samples are left out."""
    names = 'bad_samples = "leave out"\n[names]\n' + TIME + HEAD
    lines = [f"{i / 1000:.3f};50000;0" for i in range(200)]
    path, columns = write(tmp_path, [*lines[:100], *rows()[100:]], names)
    assert read(path, columns=columns).t.size == 100
    path, columns = write(tmp_path, lines, names)
    with pytest.raises(InputError) as caught:
        read(path, columns=columns)
    assert (caught.value.key, caught.value.line) == ("data.bad_value", 2)
    assert "column 'A'" in str(caught.value.hint)


def test_a_column_without_numbers_is_named_with_what_it_holds(tmp_path):
    path, columns = write(tmp_path, [row.replace(";5", ";5 ") for row in rows()])
    with pytest.raises(LogError, match=r"a.csv:2: column 'A' holds no numbers: '5 0'"):
        read(path, columns=columns)


def test_outside_of_the_window_a_bad_sample_is_no_matter(tmp_path):
    lines = rows()
    lines[40] = "0.040;;0"
    lines[150] = "x;1e9;0"
    path, columns = write(tmp_path, lines)
    record = read(path, columns=columns, window=(0.05, 0.14))
    inside = (record.t >= 0.05) & (record.t <= 0.14)
    assert inside.sum() == 91 and np.isfinite(record["ram.p_head"][inside]).all()
    assert record.losses == ()
    with pytest.raises(LogError, match="is blank"):
        read(path, columns=columns, window=(0.03, 0.14))


def test_of_a_csv_with_channels_as_names_too(tmp_path):
    lines = [f"{i / 1000:.3f},{5 + i / 1000:g}" for i in range(200)]
    lines[40], lines[180] = "0.040,abc", "0.180,nan"
    path = tmp_path / "a.csv"
    path.write_text("t [s],ram.p_head [MPa]\n" + "\n".join(lines) + "\n")
    record = read(path, window=(0.05, 0.14))
    assert np.isnan(record["ram.p_head"][[40, 180]]).all()
    for window, line in (((0.0, 0.1), 42), ((0.1, 1.0), 182), (None, 42)):
        with pytest.raises(LogError) as error:
            read(path, window=window)
        assert (error.value.line, "ram.p_head" in error.value.message) == (line, True)
    lines[40] = "0.040,nan"
    path.write_text("t [s],ram.p_head [MPa]\n" + "\n".join(lines) + "\n")
    with pytest.raises(LogError) as error:
        read(path)
    assert 'bad_samples = "leave out"' in str(error.value)  # which does without names
    (tmp_path / "m.toml").write_text('bad_samples = "leave out"\n')
    mended = read(path, columns=tmp_path / "m.toml")
    assert len(mended.losses) == 1 and np.isfinite(mended["ram.p_head"]).all()


def test_left_out_samples_are_named_counted_and_bridged_where_they_are_few(tmp_path):
    lines = rows()
    for at in (20, 21, 60):
        lines[at] = f"{at / 1000:.3f};;{at % 2}"
    for at in range(100, 120):
        lines[at] = f"{at / 1000:.3f};{50 + at / 100:g};?"
    lines[30] = "0.030;50.3;"
    path, columns = write(tmp_path, lines)
    columns.write_text('bad_samples = "leave out"\n' + columns.read_text())
    record = read(path, columns=columns)
    notes = [(note.key.removeprefix("data."), note.fields) for note in record.losses]
    keys = "samples_bridged command_bridged rows_left_out samples_missing"
    assert [key for key, _ in notes] == keys.split()
    bridged, command, rows_gone, missing = (fields for _, fields in notes)
    assert (bridged["channel"], bridged["times"]) == ("ram.p_head", "0.02, 0.021, 0.06")
    assert bridged["lines"] == " (lines 22, 23, 62)" and command["lines"] == " (line 32)"
    assert (rows_gone["first"], rows_gone["last"]) == pytest.approx((0.1, 0.119))
    assert rows_gone["samples"] == "20 bad samples" and missing["samples"] == "20 samples"
    assert record.t.size == 180 and not ((record.t > 0.0995) & (record.t < 0.1195)).any()
    at = np.searchsorted(record.t, [0.020, 0.021, 0.060]) + 0
    np.testing.assert_allclose(record["ram.p_head"][at], [50.2e5, 50.21e5, 50.6e5])
    assert record["ram.spool.command"][30] == record["ram.spool.command"][29]


def test_a_position_beyond_the_travel_is_bridged_before_a_filter_smears_it(tmp_path):
    (tmp_path / "a.csv").write_text(
        "\n".join(["t,x", *(f"{k / 1000},{-9999 if k == 50 else 100 + k}" for k in range(200))])
    )
    (tmp_path / "a.map.toml").write_text(
        'bad_samples = "leave out"\n[names]\nt = "t [s]"\n'
        'x = { channel = "ram.x", unit = "mm", filter = "100 Hz" }\n'
    )
    columns = replace(load_columns(tmp_path / "a.map.toml"), travels={"ram.x": 0.4})
    record = read(tmp_path / "a.csv", columns=columns)
    assert [note.key for note in record.losses] == ["data.samples_bridged"]
    np.testing.assert_allclose(record["ram.x"][40:60], 1e-3 * np.arange(140, 160), atol=1e-4)


@pytest.mark.parametrize(
    ("unit", "mapped", "said"),
    [
        ("cm", '"ram.x [mm]"', {"name": "x", "unit": "cm", "mapped": "mm"}),
        ("mm", '"ram.x [mm]"', None),
        ("L/min", '"ram.flow_head [l/min]"', None),
        ("mV", '{ channel = "ram.x", unit = "V", scale = "20 mm/V" }', {"unit": "mV"}),
        ("V", '{ channel = "ram.x", unit = "mm" }', None),
        ("V", '"ram.x [mm]"', None),
        ("K", '"temperature [°C]"', {"unit": "K"}),
        ("°C", '"temperature"', None),
        ("psia", '"ram.p_head [psi]"', {"unit": "psia", "mapped": "psi"}),
        ("psia", '{ channel = "ram.p_head", unit = "psi", offset = "-14.7 psi" }', None),
    ],
)
def test_a_unit_that_a_map_overrules_is_said(unit, mapped, said, tmp_path):
    lines = ["t,x", f"s,{unit}", *(f"{k / 1000},{5 + k % 3}" for k in range(200))]
    (tmp_path / "a.csv").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "a.map.toml").write_text(f'[names]\nt = "t [s]"\nx = {mapped}\n', encoding="utf-8")
    losses = read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml").losses
    notes = [note for note in losses if note.key == "data.unit_overruled"]
    assert [said.items() <= note.fields.items() for note in notes] == [True] * (said is not None)
    assert lost(losses) == [] and recovered("a", losses) == notes


def test_a_name_that_is_not_there_is_answered_by_all_that_may_be_meant(tmp_path):
    """Each table that has it; what was not read; that pressures are gauge."""
    columns = tuple(SourceColumn(name, np.zeros(2)) for name in ("t", "p"))
    tables = SourceTable("fast", columns), SourceTable("slow", columns)
    for losses in ((), ("not read: q",)):
        with pytest.raises(LogError, match="no column 'p'") as caught:
            Source(tables, losses=losses).place("p", tmp_path)
        assert caught.value.hint == "; ".join(["it has 'fast/p', 'slow/p'", *losses])
    (tmp_path / "a.csv").write_text("t [s],p [bara]\n" + "0.1,2\n0.2,3\n0.3,4\n")
    (tmp_path / "a.map.toml").write_text('[names]\n"t [s]" = "t"\n"p [bara]" = "ram.p_head"\n')
    with pytest.raises(UnitError) as caught:
        read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml")
    assert caught.value.hint == message("vocabulary.instead_gauge", gauge="bar")


def test_a_column_has_a_policy_of_its_own(tmp_path):
    lines = rows()
    lines[40] = "0.040;;?"
    names = (
        'time = "t [s]"\nAO = "ram.spool.command [V]"\n'
        'A = { channel = "ram.p_head", unit = "bar", bad_samples = "leave out" }\n'
    )
    path, columns = write(tmp_path, lines, names)
    with pytest.raises(LogError, match="ram.spool.command: '.' is no number"):
        read(path, columns=columns)
    path, columns = write(tmp_path, [*lines[:40], "0.040;;0", *lines[41:]], names)
    assert "1 bad sample left out" in read(path, columns=columns).losses[0]


@pytest.mark.parametrize(("turn", "unit"), [(360.0, "deg"), (4096.0, "counts")])
def test_a_position_goes_on_where_it_begins_again(turn, unit, tmp_path):
    x = turn * (0.98 + 0.1 * np.sin(np.arange(300) / 40.0))
    lines = [f"{k / 1000},{value}" for k, value in enumerate(x % turn)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x", *lines]))
    law = f'channel = "ram.q", unit = "{unit}", scale = "{1.0 / turn} turn/{unit}"'
    (tmp_path / "a.map.toml").write_text(f'[names]\nt = "t [s]"\nx = {{ {law} }}\n')
    q = read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml")["ram.q"]
    np.testing.assert_allclose(q, 2.0 * np.pi * x / turn, rtol=1e-9)


def test_what_was_written_late_is_put_back(tmp_path):
    """A command 12 ms late and a stroke 4 ms early, of samples each 2 ms."""
    t = np.arange(100) * 2e-3
    true = {"ram.a.command": np.where(t < 0.1, 1.0, 3.0), "ram.x": 0.1 + 0.2 * t}
    late = {"ram.a.command": np.where(t - 0.012 < 0.1, 1.0, 3.0), "ram.x": 0.1 + 0.2 * (t + 0.004)}
    rows = [f"{a:.4f},{b:.1f},{c:.7f}" for a, b, c in zip(t, *late.values(), strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,u,x", *rows]))
    (tmp_path / "a.map.toml").write_text(
        '[names]\nt = "t [s]"\n'
        'u = { channel = "ram.a.command", unit = "V", late = "12 ms" }\n'
        'x = { channel = "ram.x", unit = "m", late = "-4 ms" }\n'
    )
    record = read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml")
    kept = slice(2, 94)
    assert np.allclose(record.t, t[kept])
    for name, values in true.items():
        assert np.allclose(record[name], values[kept], atol=1e-9), name
    known = (tmp_path / "a.map.toml").read_text()
    (tmp_path / "a.map.toml").write_text(known.replace("12 ms", "13 ms"))
    record = read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml")
    stairs = record["ram.a.command"][(record.t > 0.095) & (record.t < 0.103)]
    assert stairs == pytest.approx([1.0, 2.0, 3.0, 3.0])  # half a sample early
    later = known.replace("12 ms", "12 s")
    (tmp_path / "a.map.toml").write_text(later)
    says = r"nothing is left of 0\.198 s .*ram\.a\.command by 12000 ms"
    with pytest.raises(LogError, match=says):
        read(tmp_path / "a.csv", columns=tmp_path / "a.map.toml")


def test_a_filter_runs_both_ways(tmp_path):
    rng = np.random.default_rng(3)
    noise = 50.0 + rng.normal(size=400)
    lines = [f"{i / 1000:.3f};{value!r};0" for i, value in enumerate(noise.tolist())]
    names = 'time = "t [s]"\nA = { channel = "ram.p_head", unit = "bar", filter = "20 Hz" }\n'
    path, columns = write(tmp_path, lines, names)
    found = read(path, columns=columns)["ram.p_head"]
    np.testing.assert_allclose(found, lowpass(noise, 1e-3, 20.0) * 1e5, rtol=1e-9)


def test_a_rate_stands_for_a_time_that_is_rounded(tmp_path):
    lines = [f"{i // 10 / 100:.2f};50;0" for i in range(200)]
    path, columns = write(tmp_path, lines)
    with pytest.raises(LogError, match="stands still.*rate = "):
        read(path, columns=columns)
    columns.write_text('rate = "1 kHz"\n' + columns.read_text())
    np.testing.assert_allclose(read(path, columns=columns).t, np.arange(200) / 1e3)


# --- recipes


def raw_log(path: Path) -> None:
    """A shipped log as a foreign recorder would have written it."""
    log = read(LOG)
    milliamps = 12.0 + 0.8 * log["press.servo.command"]
    table = [log.t, log["press.x"] * 1e3, log["press.p_head"] / 1e5, log["press.p_rod"] / 1e5]
    lines = ["Tester;me", "", "Zeit;Weg;Druck A;Druck B;Ventil", "s;mm;bar;bar;mA"]
    lines += [";".join(f"{one:.9g}" for one in row) for row in zip(*table, milliamps)]
    path.write_text("\n".join(lines).replace(".", ",") + "\n", encoding="cp1252")


MAP = (
    'Zeit = "t [s]"\nWeg = "press.x"\n"Druck A" = "press.p_head"\n"Druck B" = "press.p_rod"\n'
    'Ventil = { channel = "press.servo.command", from = ["4 mA", "20 mA"], '
    'to = ["-10 V", "10 V"] }\n'
)
RECIPES = {
    "identify": 'what = "hydraulics"\nparameters = ["bulk_modulus"]\nchannels = ["p_head"]\n',
    "validate": 'channels = ["x", "p_head"]\n',
    "response": 'input = "press.servo.command"\noutput = "press.x"\n',
}


@pytest.mark.parametrize("stage", RECIPES)
@pytest.mark.parametrize("way", ["table", "file", "entry"])
def test_every_stage_that_reads_logs_takes_a_map(stage, way, tmp_path):
    raw_log(tmp_path / "raw.csv")
    (tmp_path / "my.map.toml").write_text("[names]\n" + MAP)
    head = {"table": "", "file": 'columns = "my.map.toml"\n', "entry": ""}[way]
    entry = '{ path = "raw.csv", columns = "my.map.toml" }' if way == "entry" else '"raw.csv"'
    tail = f"[columns.names]\n{MAP}" if way == "table" else ""
    text = f'stage = "{stage}"\nrig = "{RIG}"\ndata = [{entry}]\n{head}{RECIPES[stage]}{tail}'
    (tmp_path / "r.toml").write_text(text)
    found = inspection.check(tmp_path / "r.toml")
    assert not found.errors and any("raw.csv (2 s" in line for line in found.lines)


def test_a_mistake_in_a_recipes_map_names_the_recipes_line(tmp_path):
    raw_log(tmp_path / "raw.csv")
    text = f'stage = "validate"\nrig = "{RIG}"\ndata = ["raw.csv"]\n[columns.names]\n'
    (tmp_path / "r.toml").write_text(text + 'Zeit = "t [s]"\nWeg = "press.q"\n')
    (found,) = inspection.check(tmp_path / "r.toml").errors
    assert str(found).startswith(f"{tmp_path}/r.toml:6: column 'Weg': 'mm' cannot be turned")
    (tmp_path / "r.toml").write_text(text + 'Weg = "press.z"\n')
    with pytest.raises(InputError, match="r.toml:5: columns.names.Weg: unknown channel"):
        load_recipe(tmp_path / "r.toml")


def test_the_map_is_an_input_of_the_run_and_each_gap_is_listed_with_v_alone(undrawn, tmp_path):
    """The map's content goes into the run's hash."""
    from ehbench import workflow
    from ehbench.report.terminal import answer

    raw_log(tmp_path / "raw.csv")
    lines = (tmp_path / "raw.csv").read_text(encoding="cp1252").split("\n")
    del lines[100:102]
    (tmp_path / "raw.csv").write_text("\n".join(lines), encoding="cp1252")
    (tmp_path / "my.map.toml").write_text("[names]\n" + MAP)
    (tmp_path / "r.toml").write_text(
        f'stage = "response"\nrig = "{RIG}"\ndata = ["raw.csv"]\ncolumns = "my.map.toml"\n'
        + RECIPES["response"]
    )
    run = workflow.run(tmp_path / "r.toml", workflow.Session(root=tmp_path / "reports"))
    roles = {entry["role"]: entry["path"] for entry in run.json("run")["inputs"]}
    assert roles["columns"].endswith("my.map.toml")
    shown = answer(run.folder)
    assert len(shown.details) == 2  # by the reader, and where it is bridged
    for whole in (True, False):
        words = " ".join(" ".join(shown.lines(whole=whole)).split())
        assert all((detail in words) == whole for detail in shown.details)


def test_a_python_user_names_the_map_by_its_file(tmp_path):
    raw_log(tmp_path / "raw.csv")
    (tmp_path / "my.map.toml").write_text("[names]\n" + MAP)
    frame = read_log(tmp_path / "raw.csv", columns=tmp_path / "my.map.toml")
    assert frame["press.p_head"].max() == pytest.approx(8.839e6, rel=1e-3)


# --- drafts


def test_a_raw_file_is_taken_at_the_first_go(tmp_path, monkeypatch):
    """Facts above the header, a row of units, decimal commas, another encoding, a blank cell."""
    monkeypatch.chdir(tmp_path)
    raw_log(tmp_path / "raw.csv")
    lines = (tmp_path / "raw.csv").read_text(encoding="cp1252").split("\n")
    lines[50] = ";".join([*lines[50].split(";")[:2], "", *lines[50].split(";")[3:]])
    (tmp_path / "raw.csv").write_text("\n".join(lines), encoding="cp1252")
    made = mapping.draft(Path("raw.csv"), None, load_rig(RIG))
    assert made.place == Path("raw.map.toml")
    assert made.values["picture"].read_text().startswith("<svg")
    assert any(line.startswith("taken with this map: <Record: 2001") for line in made.notes)
    record, log = read(Path("raw.csv"), columns=made.place), read(LOG)
    assert "1 bad sample left out" in record.losses[0] and "line 51" in record.losses[0]
    for name in ("press.x", "press.p_head", "press.p_rod"):
        whole = np.arange(log.t.size) != 46  # that of line 51
        np.testing.assert_allclose(record[name][whole], log[name][whole], rtol=1e-8)
    ends = 'from = ["4 mA", "20 mA"]'
    assert ends in made.place.read_text() and "press.servo.command" in record
    with pytest.raises(InputError, match="raw.map.toml: stands already"):
        mapping.draft(Path("raw.csv"), None, load_rig(RIG))
    made.place.unlink()
    with pytest.raises(InputError, match="raw.map.svg: stands already"):
        mapping.draft(Path("raw.csv"))
    assert not made.place.exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", foreign.WRITERS)
def test_a_draft_of_each_format_can_be_read_back(name, tmp_path, unpictured):
    path, out = tmp_path / name, tmp_path / "out.map.toml"
    foreign.WRITERS[name](path)
    mapping.draft(path, out, None)
    columns = load_columns(out).columns
    assert "?" not in {one.channel for one in columns.names.values()}
    if ".mat" not in name and name not in ("a_bag", "a_db3"):
        record = read(path, columns=out)
        assert {"cylinder.p_head", "p_supply"} <= set(record.channels)
        np.testing.assert_allclose(record["cylinder.p_head"], foreign.HEAD * 1e5, atol=100.0)


def test_what_a_draft_is_not_sure_of_stands_as_a_remark(tmp_path):
    rows = [f"{i // 10 / 100:.2f},{50 + i},{i % 7},{i}" for i in range(200)]
    (tmp_path / "a.csv").write_text('time,pressure A,"AI7 ""new""",Kraft\n' + "\n".join(rows))
    made = mapping.draft(tmp_path / "a.csv", tmp_path / "a.map.toml")
    text = made.place.read_text()
    assert 'rate = "1000' in text or 'rate = "10' in text
    assert '# "pressure A" = "cylinder.p_head"' in text
    assert load_columns(made.place).columns.names == {}
    assert made.steps[0].fields["column"] == "time"
    assert made.steps[0].key == "steps.complete_map"


def test_readings_of_a_flowmeter_are_drafted_and_taken(tmp_path):
    """Units below the names, a differential, a column of words, a time that nobody needs."""
    rows = [
        f"{i / 10}\t{('PB', 'PA')[i % 2]}\t{4 + i % 40 * 0.4:.3f}\t{100 + i % 7}\t{i % 40 / 9:.3f}"
        for i in range(200)
    ]
    names = "\t".join(("Time", "Valve port", "Solenoid Current", "Delta P", "Flow"))
    head = f"Sweep 12\n{names}\n(s)\t()\t(mA)\t(psid)\t(gpm)\n"
    (tmp_path / "sweep.txt").write_text(head + "\n".join(rows))
    made = mapping.draft(tmp_path / "sweep.txt", tmp_path / "sweep.map.toml")
    names = load_columns(made.place).columns.names
    truth = {"Valve port": "valve", "Solenoid Current": "command"}
    truth |= {"Delta P": "pressure_drop", "Flow": "flow"}
    assert {name: one.channel for name, one in names.items()} == truth
    assert "100 of PA forward" in made.notes[-1] and "100 of PB forward" in made.notes[-1]
    columns = load_columns(made.place)
    data = read_flowmeter(tmp_path / "sweep.txt", columns)
    assert data.pressure_drop[0] == pytest.approx(100 * 6894.757, rel=1e-6)
    assert data.command[:2] == pytest.approx([-10.0, -9.5])


def test_a_workbook_with_a_sheet_a_valve_is_one_of_readings(tmp_path, monkeypatch):
    openpyxl = pytest.importorskip("openpyxl")
    monkeypatch.chdir(tmp_path)
    book = openpyxl.Workbook()
    for sheet in (book.active, book.create_sheet()):
        sheet.title = {"Sheet": "pa"}.get(sheet.title, "bt")
        sheet.append(["Current", "dp", "Q"])
        sheet.append(["mA", "psi", "gpm (US)"])
        for mA in (13.0, 15.0, 18.0):
            sheet.append([mA, 100, mA - 12.0 if sheet.title == "pa" else 2.0 * (mA - 12.0)])
    book.save("flow.xlsx")
    lines = mapping.draft(Path("flow.xlsx")).notes
    assert "the same columns: table 'bt'" in lines and "3 of bt forward, 3 of pa" in lines[-1]
    data = read_flowmeter(Path("flow.xlsx"), load_columns("flow.map.toml"))
    flows = {valve: data.select(valve, "forward").flow for valve in ("pa", "bt")}
    assert np.allclose(flows["bt"], 2.0 * flows["pa"]) and flows["pa"][0] > 0.0


def test_pressures_on_both_sides_make_the_drop_and_one_alone_is_it(tmp_path, unpictured):
    def channels(*names):
        table = np.random.default_rng(1).uniform(1.0, 9.0, (40, len(names)))
        rows = [",".join(f"{one:.3f}" for one in row) for row in table]
        (tmp_path / "a.csv").write_text("\n".join([",".join(names), *rows]))
        made = mapping.draft(tmp_path / "a.csv", tmp_path / "a.map.toml")
        found = load_columns(made.place).columns.names
        made.place.unlink()
        made.values["picture"].unlink()
        return [found[name].channel if name in found else "" for name in names]

    sides = ["upstream_pressure", "downstream_pressure"]
    flow = ["Durchfluss [L/min]", "Ventil [V]"]
    assert channels("Druck vor [bar]", "Druck nach [bar]", *flow) == [*sides, "flow", "command"]
    assert channels("Druck [bar]", *flow) == ["pressure_drop", "flow", "command"]
    assert channels("Druck 1 [bar]", "Druck 7 [bar]", *flow)[:2] == ["", ""]
    # without a time p1 and p2 are of two sides, and not of two chambers
    assert channels("p1 [bar]", "p2 [bar]", *flow) == [*sides, "flow", "command"]
    log = channels("p head [bar]", "p rod [bar]", "flow [L/min]", "valve [V]", "t [s]")
    assert log[:2] == ["cylinder.p_head", "cylinder.p_rod"]


@pytest.mark.parametrize(
    ("current", "most"), [(lambda n: 40 * (-1) ** (n // 20), 40), (lambda n: n % 400 - 140, 300)]
)
def test_a_current_of_either_sign_rests_at_none(current, most, tmp_path):
    """Beyond a loop of 20 mA, also where it is driven further one way than the other."""
    rows = "".join(f"{0.01 * n:.2f},{current(n)}\n" for n in range(500))
    (tmp_path / "a.csv").write_text("t [s],Solenoid current [mA]\n" + rows)
    guess = mapping.guessed(open_source(tmp_path / "a.csv"), load_rig(RIG))
    assert guess["Solenoid current [mA]"].ends == (f"-{most} mA", f"{most} mA", "-10 V", "10 V")


@pytest.mark.parametrize(("name", "unit"), [("micros", "us"), ("millis", "ms"), ("Seconds", "s")])
def test_the_name_of_a_clock_says_its_unit(name, unit, tmp_path):
    """Whatever its steps look like."""
    (tmp_path / "a.csv").write_text(
        f"{name},x [mm]\n" + "".join(f"{10 * n},{n}\n" for n in range(99))
    )
    guess = mapping.guessed(open_source(tmp_path / "a.csv"), load_rig(RIG))[name]
    assert (guess.channel, guess.unit, guess.certainty) == ("t", unit, "certain")


def test_what_a_name_says_is_guessed(tmp_path):
    rng = np.random.default_rng(1)
    names = {
        "P1 [bar]": "cylinder.p_head",
        "druckStange (bar)": "cylinder.p_rod",
        "Supply pressure [psi]": "p_supply",
        "Systemdruck [MPa]": "p_supply",
        "Tankdruck [kPa]": "p_tank",
        "return line (bar)": "p_tank",
        "P_S [bar]": "p_supply",
        "Druck P [bar]": "p_supply",
        "p_P [bar]": "p_supply",
        "pressure T [bar]": "p_tank",
        "AI2 [bar]": "",
        "stroke [mm]": "cylinder.x",
        "winkel [°]": "cylinder.q",
        "speed [m/s]": "cylinder.v",
        "valve cmd [V]": "cylinder.valve.command",
        "Befehl (V)": "cylinder.valve.command",
        "AI_CMD_TILT_mA": "cylinder.valve.command",
        "Course [cm]": "cylinder.x",
        "Vitesse [mm/s]": "cylinder.v",
        "Ref_pos [mm]": "",
        "oil temp [°C]": "",
        "who knows": "",
    }
    table = rng.normal(size=(50, len(names)))
    rows = [f"{i};" + ";".join(f"{one:.4f}" for one in row) for i, row in enumerate(table)]
    header = ";".join(["ms since start [ms]", *names])
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    guesses = mapping.guessed(open_source(tmp_path / "a.csv"), None)
    time = guesses["ms since start [ms]"]
    assert (time.channel, time.unit, time.sure) == ("t", "ms", True)
    found = {name: guesses[name].channel for name in names}
    assert found == names
    assert not any(guess.sure for name, guess in guesses.items() if not guess.channel)


def test_a_command_of_no_named_valve_is_of_none_of_several(tmp_path):
    names = ["Valve 1 cmd [V]", "boom ht valve [V]", "sr [V]"]
    rows = "".join(f"{n % 7},{n % 5},{n % 3}\n" for n in range(50))
    (tmp_path / "a.csv").write_text(f"{','.join(names)}\n{rows}")
    found = mapping.guessed(
        open_source(tmp_path / "a.csv"), load_rig(RIG.with_stem("boom_four_valve"))
    )
    channels = [f"boom.{name}.command" for name in ("valve", "ht", "sr")]
    assert [found[name].channel for name in names] == channels
    assert found[names[0]].remark.key == "app.which_valve"
    assert [found[name].sure for name in names] == [False, True, False]


def test_a_clock_that_begins_again_is_named_as_one(tmp_path):
    """It is the time still, and what is wrong with it stands beside it and in the refusal."""
    rows = "".join(f"{0.01 * (n % 300):.2f},{50 + n % 7}\n" for n in range(500))
    (tmp_path / "a.csv").write_text("Time (s),lift.p_head [bar]\n" + rows)
    guess = mapping.guessed(open_source(tmp_path / "a.csv"), load_rig(RIG))["Time (s)"]
    assert guess.channel == "t" and not guess.sure and "began again" in guess.remark
    head = "t [s],lift.p_head [bar]\n"
    (tmp_path / "b.csv").write_text(head + rows)
    with pytest.raises(LogError, match="goes back from 2.99 s to 0 s .*into a file of its own"):
        read(tmp_path / "b.csv")


def test_the_commands_say_where_their_files_lie(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    raw_log(tmp_path / "raw.csv")
    for line, last in (
        (["map", "raw.csv", "--rig", str(RIG)], "raw.map.toml"),
        (["convert", "raw.csv", "--columns", "raw.map.toml", "--to", "mat"], "raw.mat"),
        (["show", "raw.csv", "--columns", "raw.map.toml"], "raw.html"),
    ):
        with suppress(SystemExit):
            cli.app(line, standalone_mode=False)
        assert capsys.readouterr().out.splitlines()[-1] == last
    assert "press.p_head" in (tmp_path / "raw.html").read_text()


# --- conversion


@pytest.mark.parametrize("to", ["parquet", "mat"])
def test_a_log_is_written_and_comes_back(to, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = converting.convert(LOG, to)[0]
    assert out == Path(f"press_no_load.{to}")
    record, log = read(out), read(LOG)
    assert set(record.channels) == set(log.channels)
    assert log.meta["payload"] == "none" and record.meta == log.meta
    np.testing.assert_array_equal(record.t, log.t)
    for name in log.channels:
        np.testing.assert_array_equal(record[name], log[name])
    with pytest.raises(InputError, match="stands already"):
        converting.convert(LOG, to)
    assert [one.name for one in tmp_path.iterdir()] == [out.name]


def test_the_wall_clock_goes_along(tmp_path):
    import pandas as pd
    from scipy.io import loadmat

    foreign.write_tdms(tmp_path / "a.tdms")
    (tmp_path / "m.toml").write_text(foreign.map_of("a.tdms"))
    for to in ("parquet", "mat"):
        converting.convert(tmp_path / "a.tdms", to, tmp_path / f"b.{to}", tmp_path / "m.toml")
    frame = pd.read_parquet(tmp_path / "b.parquet")
    assert str(frame["time"][1]) == "2026-03-01 12:00:00.001000+00:00"
    found = loadmat(tmp_path / "b.mat", squeeze_me=True, struct_as_record=False)
    assert found["posix_time"][0] == foreign.BEGAN
    assert found["meta"].began.startswith("2026-03-01T12:00:00")
    assert found["units"].ram_p_head == "Pa" and found["names"].ram_p_head == "ram.p_head"


LOSSES = {  # rows of a log: the exit code, what its notes say, how many notes there are with -v
    "a cell bridged": ("convert", {40: "0.040;;0"}, 0, ["% of samples interpolated"], 2),
    "rows left out": (
        "convert",
        {n: f"0.{n:03};;0" for n in range(40, 60)},
        3,
        ["20 bad samples", "about 20 samples missing"],
        2,
    ),
    "rows missing": ("convert", dict.fromkeys(range(40, 44), ""), 0, ["about 4 samples"], 1),
    "rows missing in a page": ("show", dict.fromkeys(range(40, 44), ""), 0, ["about 4 samples"], 1),
}


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_a_line_each_and_a_list_with_v(name, tmp_path, monkeypatch, capsys):
    command, changed, code, said, count = LOSSES[name]
    lines = [changed.get(n, row) for n, row in enumerate(rows())]
    _, columns = write(tmp_path, [line for line in lines if line])
    columns.write_text('bad_samples = "leave out"\n' + columns.read_text())
    monkeypatch.chdir(tmp_path)
    line = [command, "a.csv", "--columns", "m.toml", *["--to", "mat"] * (command == "convert")]
    assert cli.app(line, standalone_mode=False) == code
    printed = capsys.readouterr()
    notes = [text for text in printed.err.splitlines() if text.startswith("note: ")]
    assert len(notes) == len(said) and all(word in note for word, note in zip(said, notes))
    assert len(printed.out.splitlines()) == 1
    cli.app([*line, "-v", "--out", "b"], standalone_mode=False)
    assert sum(text.startswith("- ") for text in capsys.readouterr().out.splitlines()) == count


@pytest.mark.parametrize("facts", [b"\xff", b"[1]", b'{"meta": 3}', b'{"meta": {"payload": 5}}'])
def test_facts_of_another_program_are_passed_over(facts, tmp_path):
    import pyarrow.parquet as parquet

    path = tmp_path / "a.parquet"
    converting.convert(LOG, "parquet", path)
    table = parquet.read_table(path)
    parquet.write_table(table.replace_schema_metadata({b"ehbench": facts}), path)
    record, log = read(path), read(LOG)
    assert "payload" not in record.meta
    np.testing.assert_array_equal(record["press.p_head"], log["press.p_head"])


def test_without_pyarrow_parquet_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="written by pyarrow, which is not installed"):
        converting.convert(LOG, "parquet", tmp_path / "a.parquet")
    assert not list(tmp_path.iterdir())


# --- flowmeter readings

READINGS = ROOT / "datasets/boom_four_valve/flowmeter/sh.csv"


def raw_readings(path: Path, valves: bool = True) -> None:
    """Shipped readings as a foreign bench writes them: per cent of command, two pressures."""
    first = "Ventil" if valves else "Nr"
    lines = ["Bench 3", "", f"{first};Soll;p1;p2;Q", ";%;bar;bar;l/min"]
    data = read_flowmeter(READINGS)
    for at in range(len(data)):
        drop, flow = data.pressure_drop[at] / 1e5, data.flow[at] * 6e4
        first = "sh" if valves else str(at + 1)
        cells = (f"{10 * data.command[at]:.9g}", f"{100 + drop:.9g}", "100", f"{flow:.9g}")
        lines.append(";".join((first, *cells)))
    path.write_text("\n".join(lines).replace(".", ","), encoding="utf-8")


READING_MAP = (
    'Soll = { channel = "command", from = ["0 %", "100 %"], to = ["0 V", "10 V"] }\n'
    'p1 = "upstream_pressure"\np2 = "downstream_pressure"\nQ = "flow"\n'
)


@pytest.mark.parametrize("valves", [True, False])
def test_flowmeter_readings_take_a_map_too(valves, tmp_path):
    raw_readings(tmp_path / "sh.csv", valves)
    own = READING_MAP + ('Ventil = "valve"\n' if valves else "")
    entry = 'data = [{ path = "sh.csv", columns = "m.toml" }]\n'
    (tmp_path / "r.toml").write_text(
        f'stage = "identify"\nwhat = "flow_map"\nrig = "{ROOT}/recipes/rigs/boom_four_valve.toml"\n'
        + (f'data = ["sh.csv"]\n[columns.names]\n{own}' if valves else entry)
    )
    (tmp_path / "m.toml").write_text("[names]\n" + own)
    found = inspection.check(tmp_path / "r.toml")
    data = read_flowmeter(READINGS)
    assert not found.errors
    assert any(f"sh.csv ({len(data)} readings of sh" in line for line in found.lines)
    back = read_flowmeter(tmp_path / "sh.csv", load_columns(tmp_path / "m.toml"))
    for name in ("command", "flow", "pressure_drop"):
        np.testing.assert_allclose(getattr(back, name), getattr(data, name), rtol=1e-6, atol=1e-9)
    assert back.line[0] == 5
    (tmp_path / "m.toml").write_text("[names]\n" + own.replace('"flow"', '"flow [cm^3/s]"'))
    (note,) = read_flowmeter(tmp_path / "sh.csv", load_columns(tmp_path / "m.toml")).warnings
    assert note.key == "data.unit_overruled"
    assert valves or f"  note: {note}" in inspection.check(tmp_path / "r.toml").lines
    text = (tmp_path / "r.toml").read_text()
    timed = re.sub(r"^data = .*", 'data = [{ path = "sh.csv", stop = "1 s" }]', text, flags=re.M)
    (tmp_path / "r.toml").write_text(timed)
    with pytest.raises(InputError, match="has no 'stop'"):
        inspection.check(tmp_path / "r.toml")


AT_A_DROP = '{{ channel = "sh.flow", unit = "L/min", pressure_drop = "{drop} bar" }}'
AT_A_COMMAND = '{{ channel = "sh.flow", unit = "L/min", command = "{command} V" }}'


@pytest.mark.parametrize("by", ["pressure_drop", "command"])
def test_columns_of_flow_are_readings_at_one_drop_or_command_each(by, tmp_path):
    """A wide table, as of a data sheet; a blank cell was not read."""
    rest, shape = (
        ("command", AT_A_DROP) if by == "pressure_drop" else ("pressure_drop", AT_A_COMMAND)
    )
    unit, scale = {"command": ("V", 1.0), "pressure_drop": ("bar", 1e5)}[rest]
    (tmp_path / "wide.csv").write_text("x;a;b\n1;10;20\n2;;40\n3;30;60\n4;40;80\n")
    lines = [f'x = "{rest} [{unit}]"']
    lines += [f"{name} = {shape.format(drop=at, command=at)}" for name, at in (("a", 0), ("b", 8))]
    own = tmp_path / "m.toml"
    own.write_text("\n".join(["[names]", *lines]))
    data = read_flowmeter(tmp_path / "wide.csv", load_columns(own))
    assert data.groups() == [("sh", "forward")] and data.line.tolist() == [2, 4, 5, 2, 3, 4, 5]
    assert data.flow * 6e4 == pytest.approx([10, 30, 40, 20, 40, 60, 80])
    assert getattr(data, rest) / scale == pytest.approx([1, 3, 4, 1, 2, 3, 4])
    other = {"command": 1.0, "pressure_drop": 1e5}[by]
    assert getattr(data, by) / other == pytest.approx([0] * 3 + [8] * 4)
    for wrong, key in (
        ([lines[0], lines[1], lines[1].replace("a =", "b =")], "config.two_columns"),
        ([lines[0], 'a = "flow [L/min]"'], "data.missing_in_map"),
        ([f'b = "{by} [{ {"V": "bar", "bar": "V"}[unit] }]"', *lines[:2]], "data.column_twice"),
        ([lines[0].replace('"', '{ channel = "', 1).replace(" [", '", command = "1 V", unit = "')
          .replace(']"', '" }')], "config.read_at"),
    ):  # fmt: skip
        own.write_text("\n".join(["[names]", *wrong]))
        with pytest.raises(InputError) as error:
            read_flowmeter(tmp_path / "wide.csv", load_columns(own))
        assert error.value.key == key


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *(("Flow Rate LPM", "L/min"), ("Q_lpm", "L/min"), ("flow cm3/s", "cm3/s")),
        *(("Q m³/h", "m³/h"), ("Boom rate deg/s", "deg/s"), ("gyro_rad/s", "rad/s")),
        *(("Gyro °/s", "deg/s"), ("Vorder rad", ""), ("swing deg/s2", "")),
        *(("PT_head_psig", "psi"), ("p_A barg", "bar"), ("dp_psid", "")),
    ],
)
def test_a_name_ends_in_its_unit(name, unit):
    assert unit_in(name) == unit


def test_a_draft_takes_the_drop_from_the_names_of_columns_of_flow(tmp_path, undrawn):
    head = "Consigne (V);Q @ 10 bar (l/min);Q @ 20,5 bar (l/min)\n"
    (tmp_path / "sh.csv").write_text(head + "".join(f"{k},0;{k}1,5;{k}2,5\n" for k in range(1, 9)))
    made = mapping.draft(tmp_path / "sh.csv", tmp_path / "sh.map.toml")
    data = read_flowmeter(tmp_path / "sh.csv", load_columns(made.place))
    assert sorted({*data.pressure_drop}) == pytest.approx([1e6, 2.05e6]) and len(data) == 16
    # where a column has the drops, two of flow are two guesses
    head = head.replace("Consigne (V)", "dp (bar)")
    (tmp_path / "sh.csv").write_text(head + "".join(f"{k},0;{k}1,5;{k}2,5\n" for k in range(1, 9)))
    made = mapping.draft(tmp_path / "sh.csv", tmp_path / "other.map.toml")
    assert {one.channel for one in load_columns(made.place).columns.names.values()} == {
        "pressure_drop"
    }


def test_a_bad_reading_is_refused_or_left_out(undrawn, tmp_path):
    raw_readings(tmp_path / "sh.csv")
    text = (tmp_path / "sh.csv").read_text().split("\n")
    text[9] = "sh;;;;"
    (tmp_path / "sh.csv").write_text("\n".join(text))
    own = tmp_path / "m.toml"
    own.write_text("[names]\n" + READING_MAP + 'Ventil = "valve"\n')
    with pytest.raises(InputError) as error:
        read_flowmeter(tmp_path / "sh.csv", load_columns(own))
    assert (error.value.key, error.value.line) == ("data.blank", 10)
    own.write_text('bad_samples = "leave out"\n' + own.read_text())
    back = read_flowmeter(tmp_path / "sh.csv", load_columns(own), leave_out=True)
    assert len(back) == len(read_flowmeter(READINGS)) - 1 and 10 not in back.line
    (tmp_path / "r.toml").write_text(
        f'stage = "identify"\nwhat = "flow_map"\nrig = "{ROOT}/recipes/rigs/boom_four_valve.toml"\n'
        'data = ["sh.csv"]\ncolumns = "m.toml"\n'
    )
    from ehbench import workflow

    run = workflow.run(tmp_path / "r.toml", workflow.Session(root=tmp_path / "reports"))
    said = terminal.answer(run.folder, run.notes, run.code)
    counts = [sum("sh.csv:10: " in line for line in said.lines(whole=whole)) for whole in (0, 1)]
    assert run.code == 3 and counts == [0, 1]
