"""A bus logger's row for each message: signals of several rates in one table."""

from dataclasses import replace

import numpy as np
import pytest

from ehbench.app.mapping import draft
from ehbench.data import read
from ehbench.data.logs import write_log
from ehbench.data.readers import open_source
from ehbench.data.record import PERIODS, Record
from ehbench.preprocessing.observations import column, noise_of
from ehbench.vocabulary.errors import LogError
from ehbench.vocabulary.units import absolute_unit

MAP = """bad_samples = "{policy}"
[names]
"time (s)" = "t [s]"
"pressure (bar)" = "ram.p_head [bar]"
"angle (deg)" = "ram.q [deg]"
"coil (V)" = "ram.spool.command [V]"
"""
HEAD = "time (s),pressure (bar),angle (deg),coil (V)"


def bus(turns: int = 300) -> list[str]:
    """Pressures at 100 Hz, commands 2 ms later, an angle at 50 Hz 7 ms later, along lines."""
    rows = []
    for n in range(turns):
        t = 0.01 * n
        rows += [f"{t:.4f},{20 + 10 * t:.6f},,", f"{t + 0.002:.4f},,,{n // 50}"]
        if n % 2 == 0:
            rows += [f"{t + 0.007:.4f},,{5 - 40 * (t + 0.007):.6f},"]
    return rows


def read_bus(tmp_path, rows: list[str], policy: str = "refuse"):
    (tmp_path / "bus.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    (tmp_path / "m.toml").write_text(MAP.format(policy=policy))
    return read(tmp_path / "bus.csv", columns=tmp_path / "m.toml")


@pytest.mark.parametrize("turns", [300, 800])  # rows that are looked at may fall in step
def test_signals_that_take_turns_are_each_of_their_own_rate(turns, tmp_path):
    """All on the times of the fastest, by time; no sample is bad, and a late begin no loss."""
    record = read_bus(tmp_path, bus(turns))
    assert record.losses == ()
    assert np.median(np.diff(record.t)) == pytest.approx(0.01)
    assert record.t.size >= turns - 3
    np.testing.assert_allclose(record["ram.p_head"], (20 + 10 * record.t) * 1e5, rtol=1e-6)
    angle = np.radians(5 - 40 * record.t)  # beyond its last sample it stands
    inside = record.t <= 0.01 * turns - 0.02
    np.testing.assert_allclose(record["ram.q"][inside], angle[inside], atol=1e-7)
    held = np.floor((record.t - 0.0019) / 0.01) // 50
    np.testing.assert_array_equal(record["ram.spool.command"], held)


def test_a_slow_signal_in_rows_of_the_fast_one_has_its_own_rate(tmp_path):
    angles = [f"{3.0 * n:.1f}" if n % 10 == 0 else "" for n in range(200)]
    rows = [f"{0.01 * n:.4f},{20 + 0.1 * n:.6f},{q},0" for n, q in enumerate(angles)]
    record = read_bus(tmp_path, rows)
    np.testing.assert_allclose(np.degrees(record["ram.q"][:191]), 3.0 * np.arange(191), atol=1e-9)


@pytest.mark.parametrize("gone", [lambda n: n % 7 == 3, lambda n: n < 150, lambda n: n > 120])
def test_a_signal_that_is_missing_is_no_slow_one(gone, tmp_path):
    rows = [f"{0.01 * n:.4f},20,{'' if gone(n) else '1.5'},0" for n in range(200)]
    with pytest.raises(LogError, match="ram.q: is blank"):
        read_bus(tmp_path, rows)


def test_rows_written_twice_are_named_and_left_out(tmp_path):
    rows = bus()
    rows.insert(10, rows[9])
    with pytest.raises(LogError, match=r"bus.csv:12: the time stands still.*repeat the one before"):
        read_bus(tmp_path, rows)
    record = read_bus(tmp_path, rows, "leave out")
    assert len(record.losses) == 1
    note = record.losses[0]
    assert (note.key, note.fields["rows"]) == ("data.repeated_rows", "1 row")
    assert note.fields["lines"] == " (line 12)"
    rows[10] += "1"  # the same time, another value
    with pytest.raises(LogError, match="the time stands still"):
        read_bus(tmp_path, rows, "leave out")


def test_a_time_that_stands_still_is_found_where_rows_went_before(tmp_path):
    """Rows that are left out keep neither their cells nor their lines."""
    rows = [f"{0.01 * n:.2f},{20 + n},{5 - n / 9:.3f},{n // 50}" for n in range(200)]
    rows[20] = rows[20].replace("0.20", "n/a", 1)
    rows[100] = rows[100].replace("1.00", "0.99", 1)
    with pytest.raises(LogError, match=r"bus.csv:102: the time stands still at 0.99 s"):
        read_bus(tmp_path, rows, "leave out")


def test_a_draft_of_such_a_file_knows_its_time_and_rates(tmp_path, monkeypatch):
    rows = bus()
    rows.insert(10, rows[9])
    (tmp_path / "bus.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    monkeypatch.chdir(tmp_path)
    said = "\n".join(draft(tmp_path / "bus.csv").lines(200, whole=True))
    text = (tmp_path / "bus.map.toml").read_text()
    assert '\n"time (s)" = "t [s]"' in text
    assert "rate =" not in text and "bad_samples" not in text
    assert "in 150 rows of its own" in said and "no number" not in said


def test_a_draft_of_readings_in_percent(tmp_path, monkeypatch):
    lines = ["Run\tCommand (%)\tdp (psi)\tFlow (gpm)"]
    lines += [f"1\t{10 * n}\t{700 + n}\t{0.5 * n}" for n in range(10)]
    (tmp_path / "pa.txt").write_text("\n".join(lines) + "\n")
    monkeypatch.chdir(tmp_path)
    assert any("10 of pa forward" in line for line in draft(tmp_path / "pa.txt").notes)


def test_absolute_pressures_are_drafted_with_their_offset(tmp_path, monkeypatch):
    """A row of units with one that is not gauge is a row of units still."""
    lines = ["Zeit\tpA Kolben\tpB Ring\tSpule", "s\tbar(a)\tbar(g)\tmA"]
    lines += [f"{0.001 * n:.3f}\t5{n % 3}\t3{n % 2}\t{300 + n}" for n in range(50)]
    (tmp_path / "p.txt").write_text("\n".join(lines) + "\n")
    units = [column.unit for column in open_source(tmp_path / "p.txt").tables[0].columns]
    assert units == ["s", "bar(a)", "bar", "mA"]
    monkeypatch.chdir(tmp_path)
    draft(tmp_path / "p.txt")
    text = (tmp_path / "p.map.toml").read_text()
    assert '{ channel = "cylinder.p_head", unit = "bar", offset = "-1.013 bar" }' in text
    assert '"pB Ring" = "cylinder.p_rod [bar]"' in text
    assert '["300 mA", "350 mA"]' in text  # of a coil, not 4 to 20 mA


def test_what_is_absolute():
    said = ("bara", "bar(a)", "Bar abs", "psia", "kPa absolute", "[mbar_a]")
    assert [absolute_unit(one) for one in said] == ["bar", "bar", "bar", "psi", "kPa", "mbar"]
    assert not any(map(absolute_unit, ("bar", "barg", "a", "Pa", "rad", "")))


def test_the_noise_of_a_slow_channel_is_that_of_its_own_samples():
    """White noise of 25 Hz on straight lines at 500 Hz; of what becomes of it, by its spread."""
    rng, slow = np.random.default_rng(5), np.arange(0.0, 80.0, 0.04)
    t = np.arange(0.0, 79.9, 0.002)
    q = np.interp(t, slow, 0.01 * rng.standard_normal(slow.size))
    record = Record(t, {"arm.q": q}, {PERIODS: '{"arm.q": 0.04}'})
    rate = column(record, "arm.qd", record)
    assert rate is not None
    for channel, y in (("arm.q", q), ("arm.qd", rate)):
        for each in (1, 5):
            means = y[: y.size // each * each].reshape(-1, each).mean(axis=1)
            # 2000 samples tell a standard deviation to 1.6 %, those of a rate are fewer
            assert noise_of(record, channel, each) == pytest.approx(np.std(means), rel=0.06)


def test_what_was_read_slowly_knows_its_period(tmp_path):
    record = read_bus(tmp_path, bus())
    assert record.periods == pytest.approx({"ram.q": 0.02})
    assert record.between(0.5, 1.0).periods == record.periods
    write_log(tmp_path / "a.mcap", record)
    assert read(tmp_path / "a.mcap").periods == record.periods
    for text in ("5", "[1]", '{"ram.q": "x"}', "{", '{"ram.q": -1.0}'):  # of another program
        assert replace(record, meta={PERIODS: text}).periods == {}
