"""Time as recorders write it: forms of dates, a column of time for each channel, counts of days."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from ehbench.config.recipe.columns import ColumnMap, Columns, MappedColumn
from ehbench.data import read
from ehbench.vocabulary.errors import LogError

ROWS = 40
NOON = datetime(2026, 11, 25, 12, 34, 59, 900000, tzinfo=UTC)
MOMENTS = [NOON + timedelta(milliseconds=10 * row) for row in range(ROWS)]
Q = MappedColumn(channel="boom.q", unit="deg")


def _read(path, header, rows, mapped, **keys):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return read(path, ColumnMap(Columns(names=mapped, **keys)))


def _stamps(form):
    """Each moment by strftime, with milliseconds for %f."""
    return [f"{m:{form}}".replace(f"{m:%f}", f"{m:%f}"[:3]) for m in MOMENTS]


WITH_A_DATE = ["%Y-%m-%d %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S.%f", "%m/%d/%y %H:%M:%S.%f"]
WITH_A_DATE += ["%d-%b-%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%b %d %Y %H:%M:%S.%f"]
WITH_A_DATE += ["%m/%d/%Y %I:%M:%S.%f %p", "%Y/%m/%dT%H:%M:%S.%fZ", "%d %B %Y %H:%M:%S.%f"]


@pytest.mark.parametrize("form", WITH_A_DATE)
def test_a_date_with_a_time_of_day(form, tmp_path):
    rows = [f"{stamp};{row}" for row, stamp in enumerate(_stamps(form))]
    record = _read(tmp_path / "a.csv", "when;q", rows, {"when": MappedColumn(channel="t"), "q": Q})
    np.testing.assert_allclose(record.t, 0.01 * np.arange(ROWS), atol=1e-9)
    assert abs(datetime.fromisoformat(record.meta["began"]) - NOON) < timedelta(microseconds=2)


OTHERS = {
    "minutes over the hour": [
        f"{59 + (s >= 60):02d}:{s % 60:06.3f}" for s in np.arange(59, 61, 0.05)
    ],
    "hours": [f"10:00:{0.05 * row:06.3f}" for row in range(ROWS)],
    "over midnight": [
        f"{'23:59' if row < 20 else '00:00'}:{(59 + 0.05 * row) % 60:06.3f}" for row in range(ROWS)
    ],
    "milliseconds behind a colon": [f"10:00:00:{50 * row:03d}" for row in range(20)],
    "durations": [f"0 days 00:00:{0.05 * row:09.6f}" for row in range(ROWS)],
    "a day and more": [f"1 day, 0:00:{0.05 * row:09.6f}" for row in range(ROWS)],
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_time_without_a_date(name, tmp_path):
    stamps = [s.replace("60:0", "00:0") if name.startswith("min") else s for s in OTHERS[name]]
    rows = [f"{stamp};{row}" for row, stamp in enumerate(stamps)]
    record = _read(tmp_path / "a.csv", "when;q", rows, {"when": MappedColumn(channel="t"), "q": Q})
    np.testing.assert_allclose(record.t, 0.05 * np.arange(len(rows)), atol=1e-6)


def test_a_date_and_a_time_in_two_columns(tmp_path):
    rows = [f"{m:%d/%m/%Y};{m:%H:%M:%S.%f};{row}" for row, m in enumerate(MOMENTS)]
    names = {"time": MappedColumn(channel="t"), "q": Q}
    record = _read(tmp_path / "a.csv", "date;time;q", rows, names)
    np.testing.assert_allclose(record.t, 0.01 * np.arange(ROWS), atol=1e-6)
    assert datetime.fromisoformat(record.meta["began"]).date() == NOON.date()


@pytest.mark.parametrize(("day_first", "month"), [(None, 0), (True, 11), (False, 5)])
def test_a_date_of_two_readings_is_refused_until_the_map_decides(day_first, month, tmp_path):
    rows = [f"05/11/2026 10:00:{row:02d};{row}" for row in range(ROWS)]
    names = {"when": MappedColumn(channel="t"), "q": Q}
    if day_first is not None:
        record = _read(tmp_path / "a.csv", "when;q", rows, names, day_first=day_first)
        assert datetime.fromisoformat(record.meta["began"]).month == month
        return
    with pytest.raises(LogError) as caught:
        _read(tmp_path / "a.csv", "when;q", rows, names)
    assert caught.value.line == 2 and "day_first" in str(caught.value.hint)
    assert all(text in caught.value.message for text in ("5 November", "11 May", "05/11/2026"))


def test_minutes_or_hours_is_asked(tmp_path):
    rows = [f"12:{row:02d};{row}" for row in range(ROWS)]
    with pytest.raises(LogError, match="12:00"):
        _read(tmp_path / "a.csv", "when;q", rows, {"when": MappedColumn(channel="t"), "q": Q})


MOMENT = datetime(2026, 11, 25, 12, 35, tzinfo=UTC)
COUNTS = {  # the unit of a count, its first, seconds of the unit
    "days of a spreadsheet": ("d", 46351.524305, 86400.0),
    "days of MATLAB": ("d", 740311.524305, 86400.0),
    "seconds since 1904": ("s", 3878454900.0, 1.0),
    "seconds since 1970": ("s", 1795610100.0, 1.0),
}


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_since_the_beginning_of_a_calendar(name, tmp_path):
    unit, first, scale = COUNTS[name]
    rows = [f"{first + 0.05 * row / scale:.11f};{row}" for row in range(ROWS)]
    names = {"when": MappedColumn(channel="t", unit=unit), "q": Q}
    record = _read(tmp_path / "a.csv", "when;q", rows, names)
    np.testing.assert_allclose(record.t, 0.05 * np.arange(ROWS), atol=1e-4)
    assert abs(datetime.fromisoformat(record.meta["began"]) - MOMENT) < timedelta(seconds=1)


def test_a_channel_goes_by_the_nearest_time_to_its_left(tmp_path):
    """A slow angle and a fast pressure, each beside its time, in one table of 200 rows."""
    fast, slow = np.arange(200) / 100.0, np.arange(100) / 50.0 + 0.003
    rows = []
    for row in range(200):
        left = f"{slow[row]:.3f};{20.0 * slow[row]:.6f}" if row < 100 else ";"
        rows.append(f"{left};{fast[row]:.2f};{50.0 + 5.0 * fast[row]:.4f}")
    names = {
        "Time Q": MappedColumn(channel="t", unit="s"),
        "Q": Q,
        "Time P": MappedColumn(channel="t", unit="s"),
        "P": MappedColumn(channel="boom.p_head", unit="bar"),
    }
    record = _read(tmp_path / "a.csv", "Time Q;Q;Time P;P", rows, names)
    inside = record.t <= slow[-1]
    angle = np.rad2deg(record["boom.q"])[inside]
    np.testing.assert_allclose(angle, 20.0 * record.t[inside], atol=1e-6)
    np.testing.assert_allclose(record["boom.p_head"] / 1e5, 50.0 + 5.0 * record.t, atol=1e-6)
    assert record.t[-1] > 1.9 and not record.losses


def test_times_of_32_bits_have_no_gaps(tmp_path):
    import pandas as pd

    t = np.float32(3600.0 + np.arange(8000) / 4000.0)
    frame = pd.DataFrame({"time": t, "q": np.sin(np.arange(8000.0))})
    frame.to_parquet(tmp_path / "a.parquet")
    names = {"time": MappedColumn(channel="t", unit="s"), "q": Q}
    record = read(tmp_path / "a.parquet", ColumnMap(Columns(names=names)))
    assert not record.losses
    np.testing.assert_allclose(np.diff(record.t), 1.0 / 4000.0, rtol=1e-4)


@pytest.mark.parametrize("kind", ["timedelta64[us]", "datetime64[ms]"])
def test_durations_and_moments_of_parquet(kind, tmp_path):
    import pandas as pd

    t = (1000 * np.arange(50)).astype("timedelta64[us]" if "delta" in kind else "datetime64[us]")
    pd.DataFrame({"when": t.astype(kind), "q": np.arange(50.0)}).to_parquet(tmp_path / "a.parquet")
    names = {"when": MappedColumn(channel="t"), "q": Q}
    record = read(tmp_path / "a.parquet", ColumnMap(Columns(names=names)))
    np.testing.assert_allclose(record.t, 0.001 * np.arange(50), atol=1e-9)
