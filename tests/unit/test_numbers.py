"""One grammar of numbers for all text: what a cell means, and where it may mean two things."""

import numpy as np
import pytest

from ehbench.config.recipe.columns import ColumnMap, Columns, MappedColumn
from ehbench.data import read
from ehbench.data.flowmeter import read_flowmeter
from ehbench.data.readers import SourceColumn, open_source
from ehbench.data.text import number
from ehbench.vocabulary.errors import InputError, LogError

CELLS = {  # cell: (with a decimal point, with a decimal comma)
    "1234.5": (1234.5, None),
    "1,234.5": (1234.5, None),
    "1.234,5": (None, 1234.5),
    "1,234,567": (1234567.0, None),
    "1.000": (1.0, 1000.0),
    "1,000": (1000.0, 1.0),
    "0,123": (None, 0.123),
    "-1e3": (-1000.0, -1000.0),
    "−2.5": (-2.5, None),
    "1\u00a0234,5": (None, 1234.5),
    "12\u202f345.25": (12345.25, None),
    "1\u2009234": (1234.0, 1234.0),
    "1'234.5": (1234.5, None),
    "1,23,456": (None, None),
    "12 345": (None, None),
    "1_000": (None, None),
    "0x10": (None, None),
    "٣": (None, None),
    "1.2.3": (None, None),
}


@pytest.mark.parametrize("cell", CELLS)
def test_a_cell_is_the_number_it_says_or_none(cell):
    assert (number(cell, "."), number(cell, ",")) == CELLS[cell]


def _read(path, unit, decimal=None):
    names = {
        "t": MappedColumn(channel="t", unit="s"),
        "p": MappedColumn(channel="p_supply", unit=unit),
    }
    return read(path, ColumnMap(Columns(decimal=decimal, names=names)))


TWO_READINGS = {
    "integers grouped": ("t;p\n0;999\n1;999\n2;1,000\n3;999\n", 4, (1000.0, 1.0)),
    "grouped by points": ("t;p\n0;999\n1;999\n2;1.000\n3;999\n", 4, (1.0, 1000.0)),
    "points beside commas": ("t;p\n0,1;999\n0,2;1.002\n0,3;999\n", 3, (1.002, 1002.0)),
    "commas beside points": ("t\tp\n0.1\t999\n0.2\t1,002\n0.3\t999\n", 3, (1002.0, 1.002)),
    "in quotes": ('t,p\n0.1,999\n0.2,"1,002"\n0.3,999\n', 3, (1002.0, 1.002)),
    "below a remark": ("# lab\nt;p\n0;900\n1;-12,345\n", 4, (-12345.0, -12.345)),
}


@pytest.mark.parametrize("name", TWO_READINGS)
def test_a_number_of_two_readings_is_refused_with_both_and_its_line(name, tmp_path):
    text, line, readings = TWO_READINGS[name]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(LogError) as caught:
        _read(tmp_path / "a.csv", "mbar")
    assert caught.value.line == line and "decimal" in str(caught.value.hint)
    error = caught.value.message
    assert all(f"{value:g}" in error or f"{value:.15g}" in error for value in readings)


@pytest.mark.parametrize(("decimal", "value"), [(".", 1000.0), (",", 1.0)])
def test_the_map_says_which_reading_is_meant(decimal, value, tmp_path):
    (tmp_path / "a.csv").write_text("t;p\n0;900\n1;999\n2;1,000\n3;999\n")
    record = _read(tmp_path / "a.csv", "mbar", decimal)
    assert record["p_supply"][2] == pytest.approx(100.0 * value)


SURE = {
    "quoted groups": ('t,p\n0.1,"1,234.5"\n0.2,"999.5"\n0.3,"1,000"\n', [1234.5, 999.5, 1000.0]),
    "groups and commas": ("t;p\n0,1;1.234,5\n0,2;999,5\n0,3;1.000\n", [1234.5, 999.5, 1000.0]),
    "three decimals": ("t;p\n0.000;12.345\n0.001;12.346\n0.002;1.000\n", [12.345, 12.346, 1.0]),
    "commas between": ("t,p\n1.001,12.345\n1.002,12.346\n1.003,1.000\n", [12.345, 12.346, 1.0]),
    "minus signs": ("t,p\n0.1,−1.5\n0.2,−2\n0.3,3\n", [-1.5, -2.0, 3.0]),
}


@pytest.mark.parametrize("name", SURE)
def test_what_the_file_itself_decides_is_read(name, tmp_path):
    text, values = SURE[name]
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    (column,) = open_source(tmp_path / "a.csv").tables[0].columns[1:]
    assert column.doubt is None and column.values.tolist() == values


@pytest.mark.parametrize("second", ["1 570,285", "1 570", '"1 570,285"'])
def test_a_blank_between_tabs_ends_no_number(second, tmp_path):
    (tmp_path / "a.csv").write_text(f"t\tp\n0,000\t722,481\n0,010\t{second}\n0,020\t874,118\n")
    with pytest.raises(LogError):
        _read(tmp_path / "a.csv", "mbar")


@pytest.mark.parametrize("cell", ["9" * 400, "0" * 5000 + "7", "0" * 5000 + "9" * 17])
def test_many_digits_are_a_number_or_a_sentence(cell, tmp_path):
    (tmp_path / "a.csv").write_text(f"t;p\n0;1\n1;{cell}\n2;3\n")
    try:
        assert _read(tmp_path / "a.csv", "mbar")["p_supply"][1] == pytest.approx(700.0)
    except LogError as error:
        assert cell.lstrip("0")[0] == "9" and error.line == 3


def test_a_header_goes_on_over_lines_and_a_second_name_retains_its_unit(tmp_path):
    text = '"Time\n[s]","Pressure\r\n[kPa]","Pressure\n[kPa]"\n0.1,1,4\n0.2,2,5\n0.3,x,6\n'
    (tmp_path / "a.csv").write_bytes(text.encode())
    (table,) = open_source(tmp_path / "a.csv").tables
    assert [column.known_unit for column in table.columns] == ["s", "kPa", "kPa"]
    assert [column.name for column in table.columns][:2] == ["Time [s]", "Pressure [kPa]"]
    assert table.lines == [5, 6, 7]


def test_a_rate_in_the_end_of_a_name_has_its_unit():
    """As CAN loggers write them."""
    assert SourceColumn("TILT_RATE_dps", np.zeros(3)).known_unit == "deg/s"


DOORS = {  # a table of every kind that is text: (header, the row of a cell, what reads it)
    "a foreign table": ("t{m}p", "{n}{m}{cell}", lambda path: _read(path, "mbar")["p_supply"]),
    "a log": ("t [s]{m}p_supply [mbar]", "{n}{m}{cell}", lambda path: read(path)["p_supply"]),
    "flowmeter readings": (
        "valve{m}command [V]{m}pressure_drop [mbar]{m}flow [L/min]",
        "a{m}1{m}{cell}{m}{n}",
        lambda path: read_flowmeter(path).pressure_drop,
    ),
}
ONE_GRAMMAR = {  # cells of a column with semicolons: the numbers, None where the file is refused
    "1.5 2.5 1234.5": [1.5, 2.5, 1234.5],
    "1,5 2,5 1.234,5": [1.5, 2.5, 1234.5],
    "1.5 2.5 1,234.5": [1.5, 2.5, 1234.5],
    "−1,5 2,5 1e3": [-1.5, 2.5, 1000.0],
    "1,5 2,5 1.5": None,
    "1,5 2,5 1.000": None,
    "999 998 1,000": None,
    "1.5 2.5 1_000": None,
    "1.5 2.5 0x10": None,
    "1.5 2.5 1.5V": None,
    "1.5 2.5 ٣": None,
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("cells", ONE_GRAMMAR)
def test_every_table_has_one_grammar(door, cells, tmp_path):
    header, row, reader = DOORS[door]
    rows = [row.format(m=";", n=n, cell=cell) for n, cell in enumerate(cells.split(), 1)]
    (tmp_path / "a.csv").write_text("\n".join([header.format(m=";"), *rows]), encoding="utf-8")
    numbers = ONE_GRAMMAR[cells]
    if numbers is None:
        with pytest.raises(InputError):
            reader(tmp_path / "a.csv")
    elif numbers[0] > 0.0 or "flow" not in door:  # a drop against its flow is refused
        assert reader(tmp_path / "a.csv") == pytest.approx([100.0 * number for number in numbers])


TOO_WIDE = {  # header, sound rows, the third row
    "a decimal comma between commas": ("t,p", "0.{n},12", "0.3,12,5"),
    "grouped digits between commas": ("t,p,q", "0.{n},900,1", "0.3,1,234.5,1"),
    "grouped by blanks": ("t p", "0.{n} 999.5", "0.3 1 000.5"),
    "a mark twice": ("t;p", "0.{n};5", "0.3;5;6"),
}


@pytest.mark.parametrize("name", TOO_WIDE)
def test_a_row_with_a_number_too_many_is_refused_with_its_line(name, tmp_path):
    header, row, wrong = TOO_WIDE[name]
    rows = [wrong if n == 3 else row.format(n=n) for n in range(1, 10)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(LogError) as caught:
        _read(tmp_path / "a.csv", "mbar")
    assert caught.value.line == 4
    (table,) = open_source(tmp_path / "a.csv").tables
    header_cells = wrong.count(" " if " " in wrong else ";" if ";" in wrong else ",")
    says = f"has {header_cells + 1} cells, the header has {header_cells}"
    assert all(column.odd == {2: says} for column in table.columns)


@pytest.mark.parametrize(("clock", "cell"), [("{}.250", "63.990"), ("{},250", "16,000")])
def test_the_fraction_of_a_time_tells_no_decimal_sign(clock, cell, tmp_path):
    """Times come from one part of a recorder's program and numbers from another."""
    rows = [f"2026-11-25 {clock.format(f'10:00:0{n}')};{cell}" for n in range(1, 6)]
    (tmp_path / "a.csv").write_text("Zeit;p [bar]\n" + "\n".join(rows))
    (table,) = open_source(tmp_path / "a.csv").tables
    assert table.columns[1].doubt is not None
    assert table.columns[0].values.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
