"""Limits on readings and foreign logs: a fifth inside is taken, a fifth outside is not."""

import numpy as np
import pytest

from ehbench.data.bad_samples import _short
from ehbench.data.channels import _rate_note
from ehbench.data.flowmeter import read_flowmeter
from ehbench.data.rates import Group, apart, gaps, joined, repeated
from ehbench.data.readers import SourceColumn, SourceTable
from ehbench.vocabulary.errors import InputError
from tests.shared import refused

SUPPLY = 1e7  # Pa


def group(t: np.ndarray, channel: str = "ram.x", stamped: np.ndarray | None = None) -> Group:
    return Group(
        SourceTable("", ()), t, None, channels={channel: np.zeros(t.size)}, stamped=stamped
    )


def column(rows: np.ndarray, size: int) -> SourceColumn:
    values = np.full(size, np.nan)
    values[rows] = 1.0
    return SourceColumn("a", values)


def test_five_bad_samples_in_a_row_are_bridged_and_six_are_not():
    bad = np.zeros(40, bool)
    bad[10:15] = bad[20:26] = True
    assert np.flatnonzero(_short(bad)).tolist() == [10, 11, 12, 13, 14]


def test_a_sample_is_missing_from_one_and_a_half_steps_on():
    for step, missing in ((1.4, False), (1.7, True)):
        t = np.array([0.0, 1.0, 2.0, 3.0, 3.0 + step, 4.0 + step])
        assert bool(gaps(group(t), None)) == missing
    base = group(np.arange(0.0, 12.0, 0.25), "ram.v")
    for step, lost in ((6.2, False), (6.8, True)):
        slow = np.concatenate([np.arange(4.0), np.arange(3.0 + step, 12.0)])
        t, _, _ = joined([base, group(slow)], [])
        assert bool(((t > 3.0) & (t < 3.0 + step)).any()) != lost


def test_rows_that_last_another_time_than_their_stamps_are_noted():
    t = np.arange(2001) / 1e3
    for stretch, noted in ((1.010, False), (1.012, True)):
        assert bool(_rate_note(group(t, stamped=t * stretch))) == noted


def test_rows_repeat_the_one_before_unless_many_do():
    for count, found in ((4, 4), (6, 0)):
        t = np.arange(100.0)
        t[10 : 10 + 5 * count : 5] -= 1.0
        columns = [SourceColumn("a", np.where(np.arange(100) < 90, 1.0, 2.0))]
        assert repeated(t, columns).sum() == found


def test_a_signal_in_every_second_row_has_a_rate_of_its_own():
    size = 400
    every, second = column(np.arange(size), size), column(np.arange(0, size, 2), size)
    assert len(apart([every, second])) == 2
    odd = np.arange(1, size, 2)
    for overlap, groups in ((16, 2), (24, 1)):
        both = np.union1d(odd, np.arange(0, 16 * overlap, 16)[:overlap])
        assert len(apart([second, column(both, size)])) == groups


def test_four_values_tell_a_rate_and_three_do_not():
    every = column(np.arange(40), 40)
    for count, groups in ((3, 1), (4, 2)):
        assert len(apart([every, column(np.arange(0, 5 * count, 5), 40)])) == groups


def sheet(tmp_path, *rows: str):
    path = tmp_path / "sh.csv"
    head = "valve,command [V],pressure_drop [kPa],flow [L/min]"
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def test_the_sign_of_a_flow_counts_from_a_fiftieth_of_the_largest_on(tmp_path):
    full = "sh,10,1000,100"
    assert len(read_flowmeter(sheet(tmp_path, full, "sh,0,1000,-1.6"))) == 2
    with refused("data.flow_against_drop", InputError):
        read_flowmeter(sheet(tmp_path, full, "sh,0,1000,-2.4"))


@pytest.mark.parametrize(("drop", "key"), [(14000, ""), (16500, "data.drop_beyond_supply")])
def test_a_drop_of_one_and_a_half_supplies_is_a_slip(tmp_path, drop, key):
    path = sheet(tmp_path, "sh,5,1000,50", f"sh,10,{drop},100")
    if not key:
        assert len(read_flowmeter(path, supply_pressure=SUPPLY)) == 2
        return
    with refused(key, InputError):
        read_flowmeter(path, supply_pressure=SUPPLY)


@pytest.mark.parametrize(("drop", "warned"), [(40, True), (60, False)])
def test_drops_under_half_a_percent_of_the_supply_are_doubted(tmp_path, drop, warned):
    data = read_flowmeter(sheet(tmp_path, f"sh,5,{drop},50"), supply_pressure=SUPPLY)
    assert [note.key for note in data.warnings] == ["data.small_drops"] * warned


def test_a_third_of_the_readings_may_be_left_out(tmp_path):
    good = ["sh,5,1000,50"] * 7
    assert len(read_flowmeter(sheet(tmp_path, *good, *["sh,5,1000,x"] * 3), leave_out=True)) == 7
    with refused("data.too_many_left_out", InputError):
        read_flowmeter(sheet(tmp_path, *good[1:], *["sh,5,1000,x"] * 4), leave_out=True)


@pytest.mark.parametrize(("count", "reverse"), [(3, 0), (4, 4)])
def test_four_readings_with_both_signs_turned_are_a_direction(tmp_path, count, reverse):
    rows = ["sh,5,1000,50"] * 10 + ["sh,5,-1000,-50"] * count
    data = read_flowmeter(sheet(tmp_path, *rows), leave_out=True)
    assert (data.direction == "reverse").sum() == reverse
