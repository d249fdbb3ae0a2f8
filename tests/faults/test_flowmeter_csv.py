"""Flowmeter CSVs: what is read, and what is refused with file, line and what would be right."""

import csv
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from ehbench.config.rig import Rig
from ehbench.data.flowmeter import merge_flowmeter, read_flowmeter
from ehbench.flow_maps.readings import FlowMapOptions
from ehbench.flow_maps.tables import (
    PreparedReadings,
    fit_edge,
    points_table,
    prepare_readings,
    signs,
    summary,
)
from ehbench.physics.flow_map import collect, table
from ehbench.report import terminal
from ehbench.vocabulary.errors import InputError, UnitError
from tests.shared import RIGS, shipped

GPM = 3.785411784e-3 / 60.0
HEADER = "valve,command [V],pressure_drop [kPa],flow [gpm]"


@pytest.fixture
def write(tmp_path):
    def _write(text: str | bytes, name: str = "hect.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return _write


def test_reads_any_order_unit_and_comment_and_keeps_the_lines(write):
    path = write(
        "\ufeff# bench of 12 May\n"
        "flow [L/min], trial, valve, pressure_drop [bar], command [mV], method, temperature "
        "[degC], direction, note\n"
        "\n"
        "30.0, 2, regen, 10.5, 4000, Cylinder, 40, Head -> Rod, first\n"
        "# pause\n"
        '-0.01, 1, "regen", 70, 0, , , ,\n'
    )
    data = read_flowmeter(path)
    assert data.line.tolist() == [4, 6] and data.valve.tolist() == ["regen", "regen"]
    assert len(data) == 2
    assert data.direction.tolist() == ["head->rod", "forward"]
    assert data.method.tolist() == ["cylinder", "flowmeter"]
    np.testing.assert_allclose(data.flow, [30 / 6e4, -0.01 / 6e4])
    np.testing.assert_allclose(data.pressure_drop, [10.5e5, 70e5])
    np.testing.assert_allclose(data.command, [4.0, 0.0])
    assert data.trial.tolist() == [2, 1] and data.temperature[0] == pytest.approx(313.15)
    assert math.isnan(data.temperature[1])
    assert data.groups() == [("regen", "forward"), ("regen", "head->rod")]
    assert set(data.file) == {str(path)}


def test_two_pressures_make_the_drop(write):
    header = "valve,downstream_pressure [psi],upstream_pressure [kPa],command [V],flow [gpm]"
    data = read_flowmeter(write(header + "\na,100,6894.757,4,2\n"))
    assert data.pressure_drop[0] == pytest.approx(6894757 - 100 * 6894.757, rel=1e-6)


@pytest.mark.parametrize("mark", [";", "\t"])
def test_decimal_commas_between_semicolons_or_tabs(write, mark):
    text = HEADER.replace(",", mark) + "\n" + mark.join(["a", "2,25", "689,4", "1,5"]) + "\n"
    data = read_flowmeter(write(text))
    first = (data.command[0], data.pressure_drop[0], data.flow[0])
    assert first == pytest.approx((2.25, 689400.0, 1.5 * GPM))
    with pytest.raises(InputError) as caught:
        read_flowmeter(write(text.replace("1,5", "1.5")))
    assert (caught.value.key, caught.value.line) == ("data.no_number", 2)


def test_old_line_ends_keep_the_line_numbers(write):
    mixed, old = "\r\na,1,100,1\r\n\r\na,2,100,2\r\n", "\ra,1,100,1\ra,2,100,2\r"
    for rows, lines in ((mixed, [2, 4]), (old, [2, 3])):
        assert read_flowmeter(write(HEADER + rows)).line.tolist() == lines


def test_both_negative_without_a_direction_is_the_reverse_direction(write):
    data = read_flowmeter(write(HEADER + "\na,4,1000,2\na,4,-1000,-1.5\na,0,1000,-0.01\n"))
    assert data.direction.tolist() == ["forward", "reverse", "forward"]
    np.testing.assert_allclose(data.flow, np.array([2, 1.5, -0.01]) * GPM)
    assert data.pressure_drop.tolist() == [1e6, 1e6, 1e6]


def test_select_and_merge_keep_file_and_line(write):
    one = read_flowmeter(write(HEADER + "\na,1,100,1\nb,2,100,2\n"))
    two = read_flowmeter(write(HEADER + "\na,3,100,3\n", "second.csv"))
    both = merge_flowmeter([one, two]).select("a")
    assert both.line.tolist() == [2, 2]
    assert [Path(name).name for name in both.file] == ["hect.csv", "second.csv"]
    says = "no readings of 'c' in direction forward .*a forward, b forward"
    with pytest.raises(InputError, match=says):
        one.select("c")


BROKEN = tomllib.loads(Path(__file__).with_name("flowmeter_slips.toml").read_text("utf-8"))
BROKEN["UTF-16"] = ((HEADER + "\n").encode("utf-16"), 0, "data.no_readings")
BROKEN["binary"] = (b"\x00\x01\x02", 0, "data.readings_no_text")


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_with_file_line_and_remedy(write, name):
    text, line, key = BROKEN[name]
    path = write(text.replace("{}", HEADER) if isinstance(text, str) else text)
    with pytest.raises(InputError) as caught:
        read_flowmeter(path)
    error = caught.value
    assert (error.file, error.line or 0, error.key) == (str(path), line, key)
    assert error.exit_code == 2


def test_a_drop_beyond_the_supply_is_a_slip_of_unit(write):
    header = "valve,command [V],pressure_drop [bar],flow [gpm]\n"
    assert len(read_flowmeter(write(header + "a,1,100,1\n"), supply_pressure=6.9e6)) == 1
    with pytest.raises(UnitError, match="6000 bar"):  # above the plausible range without a supply
        read_flowmeter(write(header + "a,1,60,1\na,2,6000,2\n"))
    path = write(header + "a,1,60,1\na,2,600,2\n")
    assert len(read_flowmeter(path)) == 2
    says = "600 bar is 8.7 times the supply pressure of 69 bar.*really bar"
    with pytest.raises(UnitError, match=says) as caught:
        read_flowmeter(path, supply_pressure=6.9e6)
    assert caught.value.line == 3


def test_drops_far_below_the_supply_are_kept_with_a_warning(write):
    data = read_flowmeter(write(HEADER + "\na,1,6.5,1\n"), supply_pressure=6.9e6)
    assert "under 0.5 %" in data.warnings[0]
    assert merge_flowmeter([data, data]).warnings == data.warnings * 2
    assert read_flowmeter(write(HEADER + "\na,1,650,1\n"), supply_pressure=6.9e6).warnings == ()


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_flowmeter(tmp_path / "none.csv")
    with pytest.raises(InputError, match="cannot be read"):
        read_flowmeter(tmp_path)


SERVO_HEADER = "valve,direction,command [V],pressure_drop [MPa],flow [L/min],trial"


def servo_rows(direction: str, sign: int, seed: int = 1, scale: float = 1.0) -> list[str]:
    """Readings of one edge of the slide's servo valve, two trials, 1 %."""
    rng = np.random.default_rng(seed)
    rows = []
    for volts in (0, 1, 2, 4, 6, 8, 10):
        for drop in (1, 2, 4, 7):
            for trial in (1, 2):
                noise = 1 + 0.01 * rng.standard_normal()
                flow = scale * 1.5 * max(volts - 0.4, 0.0) * drop**0.5 * noise
                rows.append(f"servo,{direction},{sign * volts},{drop},{flow!r},{trial}")
    return rows


def fitted(rig: Rig, parts, **options):
    edges = prepare_readings(rig, parts).edges
    return [fit_edge(rig, edge, FlowMapOptions(**options)) for edge in edges]


def fit_rows(write, rows: list[str], rig: Rig | None = None):
    path = write(SERVO_HEADER + "\n" + "\n".join(rows) + "\n", "servo.csv")
    return fitted(rig or shipped("slide_servo"), [read_flowmeter(path)])


def about(fits, words: str) -> list[str]:
    """The warnings of maps that have these words."""
    return [text for one in fits for text in one.warnings if words in text]


def test_rows_copied_by_mistake_are_told_once_a_file_with_their_lines(write):
    rows = servo_rows("supply->head", 1) + servo_rows("supply->rod", -1, 2)
    assert not about(fit_rows(write, rows), "repeat")
    said = about(fit_rows(write, [*rows, *rows[20:27], rows[90]]), "repeat an")
    first = len(rows) + 2
    assert len(said) == 1 and said[0].startswith("servo.csv: 8 rows repeat an earlier one")
    assert f"(line {', '.join(str(first + k) for k in range(5))}, …)" in said[0]
    # the same command, drop and flow in another trial is a repeat, and zeros of a meter at rest are
    # none
    again = rows[20].removesuffix(",1").removesuffix(",2") + ",3"
    assert not about(fit_rows(write, [*rows, again, rows[0]]), "repeat")


def test_flows_that_one_slip_makes_large_are_an_outlier_and_no_unit(write):
    rows = servo_rows("supply->head", 1)
    cells = rows[-1].split(",")
    cells[4] = "3000"
    (one,) = fit_rows(write, [*rows[:-1], ",".join(cells)])
    assert [outlier.line for outlier in one.outliers] == [len(rows) + 1]
    assert not about([one], "check the unit")


@pytest.mark.parametrize("limit", [math.inf, 0.0])
@pytest.mark.parametrize(("scale", "says"), [(1.0, []), (60.0, ["flow_maps.flow_and_gain"])])
def test_without_a_limit_of_the_supply_flows_are_doubted_by_the_gain(write, scale, says, limit):
    rig = shipped("slide_servo")
    supply = rig.supply.model_copy(update={"flow_limit": limit})
    endless = rig.model_copy(update={"supply": supply})
    fits = fit_rows(write, servo_rows("supply->head", 1, scale=scale), endless)
    assert [getattr(text, "key", "") for text in about(fits, "check the unit")] == says


def test_flows_in_a_wrong_unit_are_doubted_where_people_look_first(undrawn, write, tmp_path):
    write(SERVO_HEADER + "\n" + "\n".join(servo_rows("supply->head", 1, scale=60.0)), "servo.csv")
    head = 'stage = "identify"\nwhat = "flow_map"\ndata = ["servo.csv"]\n'
    recipe = write(f'{head}rig = "{RIGS}/slide_servo.toml"\n', "r.toml")
    run = workflow.run(recipe, workflow.Session(root=tmp_path / "reports"))
    shown = " ".join(" ".join(terminal.answer(run.folder, run.notes, run.code).lines()).split())
    assert "the supply's limit of 60 L/min: check the unit" in shown


def test_what_the_reader_doubts_reaches_the_map(write):
    path = write(
        "valve,direction,command [V],pressure_drop [kPa],flow [L/min],trial\n"
        + "\n".join(servo_rows("supply->head", 1))
    )
    part = read_flowmeter(path, supply_pressure=1.4e7)
    (one,) = fitted(shipped("slide_servo"), [part])
    # by the file's name alone: a result must not depend on where the data lie
    assert one.warnings[0].startswith("hect.csv: the largest drop is 7 kPa")
    assert "/" not in one.warnings[0]


def test_volts_of_an_edge_that_opens_on_negative_commands_have_their_sign(write):
    fits = fit_rows(write, servo_rows("supply->head", 1) + servo_rows("supply->rod", -1, 2))
    rig = shipped("slide_servo")
    by_sign = {one.sign: one for one in fits}
    assert sorted(by_sign) == [-1, 1] and set(signs(fits).values()) == {-1, 1}
    opened = by_sign[-1]
    assert opened.rows.command.min() == 0.0 and opened.map.deadband > 0  # maps take openings
    points = csv.DictReader(points_table(fits, rig).splitlines())
    assert (rows := [row for row in points if row["valve"] == opened.map.valve])
    assert all(float(row["driver_command [V]"]) == -float(row["command [V]"]) for row in rows)
    assert "-0" not in {row["driver_command [V]"] for row in rows}
    told = {plain["sign"]: plain for plain in summary(fits, rig)}
    assert told[-1]["deadband"] > 0 and told[-1]["valve"] == opened.map.valve
    made = table(collect([one.map for one in fits]), signs(fits), "L/min", "bar")
    grid = csv.DictReader(made.splitlines())
    sent = [float(row["driver_command [V]"]) for row in grid if row["valve"] == opened.map.valve]
    assert min(sent) == -10.0 and max(sent) == 0.0
    path = write(SERVO_HEADER + "\n" + "\n".join(servo_rows("supply->rod", -1)) + "\n", "servo.csv")
    (one,) = fitted(rig, [read_flowmeter(path)], calibration=[(4.0, 1e-4, 0.05)])
    assert summary([one], rig)[0]["calibration_sentences"][0].startswith("-4 V gives")


def sheet(**wrong: str) -> str:
    """A sheet of one edge, 9 commands by 5 drops, with lines replaced by number: ``l20="…"``."""
    rows = [HEADER]
    for command in (0, 0.5, 1, 2, 3, 4, 6, 8, 10):
        for drop in (500, 1000, 2000, 4000, 6000):
            rows.append(f"sh,{command},{drop},{max(command - 0.6, 0) * 0.02 * drop**0.5:.4g}")
    for line, text in wrong.items():
        rows[int(line[1:]) - 1] = text
    return "\n".join(rows) + "\n"


WILD = {
    "a flow that changed its sign": ("sh,4,2000,-3", "runs against its drop"),
    "a drop that changed its sign": ("sh,4,-2000,3", "runs against its drop"),
    "both, in one reading": ("sh,4,-2000,-3", "negative, as in few of its readings"),
    "a drop beyond all bounds": ("sh,4,9e9,3", "lies outside"),
    "a drop beyond the supply": ("sh,4,90000,3", "times the supply"),
    "a word": ("sh,4,2000,off", "'off', which is no number"),
    "a command of the other side": ("sh,-4,2000,3", "opens on positive commands"),
    "a command no driver gives": ("sh,40,2000,3", "gives 0 to 10 V"),
}


@pytest.mark.parametrize("name", WILD)
def test_a_wild_reading_is_refused_with_its_line_or_left_out_and_named(write, name):
    row, words = WILD[name]
    path, rig = write(sheet(l30=row), "sh.csv"), shipped("boom_four_valve")

    def taken(leave_out: bool) -> PreparedReadings:
        data = read_flowmeter(path, supply_pressure=6.9e6, leave_out=leave_out)
        return prepare_readings(rig, [data], [path.name] * leave_out)

    if "both" not in name:  # which is a reading of the other direction, one of few
        with pytest.raises(InputError, match=words) as caught:
            taken(False)
        assert caught.value.line == 30 and "leave such readings out" in str(caught.value)
    found = taken(True)
    assert len(found.losses) == 1 and "sh.csv: 1 reading left out: line 30" in found.losses[0]
    assert words in found.losses[0]
    assert [len(one.rows) for one in found.edges] == [44] and 30 not in found.edges[0].rows.line


def test_too_many_wild_readings_are_no_slips(write):
    wrong = {f"l{line}": f"sh,4,2000,-{line}" for line in range(20, 40)}
    with pytest.raises(InputError, match="20 of 45 readings of sh, too many.*sign = -1"):
        read_flowmeter(write(sheet(**wrong)), leave_out=True)
    few = read_flowmeter(write(sheet(**dict(list(wrong.items())[:6]))), leave_out=True)
    assert len(few) == 39 and "6 readings left out" in few.losses[0]
    assert few.losses[0].endswith("; lines 24, 25") and read_flowmeter(write(sheet())).losses == ()
    assert len(few.details) == 6 and all(":2" in note for note in few.details)


WARM = HEADER + ",temperature [degC]"


def warm_sheet(kelvin, effect: float = 0.0, seed: int = 3) -> str:
    """A sheet in two trials whose oil is at 40 °C + kelvin(command, share of the drop, order), with
    flows that grow by ``effect`` a kelvin."""
    rng, rows, count = np.random.default_rng(seed), [WARM], 0
    for _ in range(2):
        for command in (0, 0.5, 1, 2, 3, 4, 6, 8, 10):
            for drop in (500, 1000, 2000, 4000, 6000):
                more = kelvin(command, (drop / 6000) ** 0.5, count / 90, rng)
                flow = max(command - 0.6, 0) * 0.02 * drop**0.5
                flow *= (1.0 + effect * more) * (1.0 + 0.005 * rng.standard_normal())
                flow += 0.005 * rng.standard_normal()
                rows.append(f"sh,{command},{drop},{flow:.5g},{40 + more:.1f}")
                count += 1
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("kelvin", "key", "fields"),
    [
        (lambda u, d, n, rng: 15.0 * d, "warm_with_drop", {"cold": "44.3 degC"}),
        # of a curve the straight line of least squares
        (lambda u, d, n, rng: 15.0 * d**3, "warm_with_drop", {"cold": "38.8 degC"}),
        (lambda u, d, n, rng: -1.2 * u, "warm_with_command", {"cold": "40 degC", "low": "0 V"}),
        (lambda u, d, n, rng: rng.uniform(-6, 6), "warm_flow", {"kelvin": 10.0}),
        (lambda u, d, n, rng: rng.uniform(-0.7, 0.7), None, {}),
    ],
)
def test_oil_that_warms_with_drop_or_command_is_told(write, kelvin, key, fields):
    rig = shipped("boom_four_valve")
    data = read_flowmeter(write(warm_sheet(kelvin, 0.004), "sh.csv"))
    notes = about(fitted(rig, [data]), "oil")
    assert [note.key for note in notes[:1]] == ([f"flow_maps.{key}"] if key else [])
    assert all(notes[0].fields[name] == value for name, value in fields.items())
    if key == "warm_flow":  # 0.4 % for each kelvin
        assert abs(notes[0].fields["share"] - 4.0) < notes[0].fields["half"] < 1.0
        bare = replace(data, temperature=np.full(len(data), np.nan))
        assert not about(fitted(rig, [bare]), "oil")
