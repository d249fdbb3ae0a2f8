"""Time stamps that jitter: which rows are missing, what becomes of the others, and what is told."""

from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_columns
from ehbench.data import read
from ehbench.data.record import Record
from ehbench.preprocessing.time_base import evened, parts_of
from ehbench.signals.timestamps import (
    rate_of_rounded,
    resolution,
    timestamps_of,
    unrounded,
    unwrapped,
)
from ehbench.vocabulary.errors import LogError

PERIOD = 0.01
ROWS = np.arange(1500)


def late(rng: np.random.Generator, kind: str) -> np.ndarray:
    """By how much each row is stamped late [s]."""
    if kind == "tail":
        return rng.gamma(1.5, 0.0008, ROWS.size)
    if kind == "both":
        return rng.uniform(-0.0035, 0.0035, ROWS.size)
    return np.where(rng.random(ROWS.size) < 0.03, rng.uniform(0.0, 0.009, ROWS.size), 0.0)


@pytest.mark.parametrize("kind", ["tail", "both", "seldom"])
@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_rows_get_the_beats_that_they_were_taken_at(kind, epoch):
    rng = np.random.default_rng(5)
    keep = np.ones(ROWS.size, bool)
    keep[[200, 201, 640, 644, *range(900, 960)]] = False
    by = late(rng, kind)
    by[[i + d for i in (200, 201, 640, 644, 900, 959) for d in (-2, -1, 1, 2)]] = 0.0
    stamps = timestamps_of(epoch + (1.00002 * PERIOD * ROWS + by)[keep])
    assert stamps is not None and stamps.even
    np.testing.assert_array_equal(stamps.number, ROWS[keep])
    assert stamps.period == pytest.approx(1.00002 * PERIOD, rel=3e-5)
    np.testing.assert_allclose(stamps.off, (by - by[keep].mean())[keep], atol=0.03 * PERIOD)


def test_no_even_rate_is_seen_where_there_is_none():
    rng = np.random.default_rng(6)
    stamps = timestamps_of(np.cumsum(rng.uniform(0.002, 0.02, 800)))
    assert stamps is not None and not stamps.even
    assert timestamps_of(np.arange(10) * PERIOD) is None


def recording(by: np.ndarray, keep: np.ndarray) -> Record:
    t = PERIOD * ROWS
    command = np.where(t % 3.0 < 1.5, 0.0, 2.0)
    channels = {"press.x": np.sin(2.0 * (t + by)), "press.servo.command": command}
    return Record(t + by, channels).at(np.flatnonzero(keep))


def test_a_log_of_late_stamps_is_cut_where_rows_are_missing_alone():
    """A late stamp looks like a missing row before it; the log was refused, or cut."""
    by = late(np.random.default_rng(7), "seldom")
    keep = np.ones(ROWS.size, bool)
    keep[[300, *range(700, 712)]] = False
    by[295:306] = by[695:716] = 0.0
    parts, said = parts_of("log", recording(by, keep))
    assert [part.name for part in parts] == ["log_part1", "log_part2"]
    assert said[0].fields["gaps"].endswith("after t = 2.99 s (1)")
    assert said[1].key == "preprocessing.cut" and said[1].fields["gaps"].endswith("(12)")
    whole, notes = evened("log", parts[1].record)
    assert notes[0].key == "preprocessing.jitter" and notes[0].fields["rate"] == "100 Hz"
    assert np.ptp(np.diff(whole.t)) < 1e-9 and whole.t.size == 788
    np.testing.assert_allclose(whole["press.x"], np.sin(2.0 * whole.t), atol=2e-4)
    command = "press.servo.command"
    np.testing.assert_array_equal(whole[command], parts[1].record[command])


def test_rows_in_which_no_sample_came_are_none_of_the_machine():
    """A log goes on where a link is silent: its rows repeat the last sample, under commands that
    nobody says acted. A few are bridged, at many the log is cut, and it ends with the last."""
    record = recording(np.zeros(ROWS.size), np.ones(ROWS.size, bool))
    number = ROWS.astype(float)
    for first, stop in ((300, 302), (700, 740), (1300, ROWS.size)):
        number[first:stop] = number[first - 1]
        record["press.x"][first:stop] = record["press.x"][first - 1]
    channels = {**record.channels, "sample_sequence": number}
    parts, said = parts_of("log", Record(record.t, channels))
    assert [(part.record.t[0], part.record.t[-1]) for part in parts] == [(0.0, 6.99), (7.4, 12.99)]
    keys = ("none_came", "bridged", "cut", "parts")
    assert [note.key for note in said] == [f"preprocessing.{key}" for key in keys]
    assert said[0].fields["last"] == 12.99 and said[0].fields["end"] == record.t[-1]
    for part in parts:
        x = np.sin(2.0 * part.record.t)
        np.testing.assert_allclose(part.record["press.x"], x, atol=(2.0 * 3 * PERIOD) ** 2 / 8.0)
    number[1300:] = ROWS[1300:]
    parts, said = parts_of("log", Record(record.t, channels).at(slice(800, None)))
    assert not said and len(parts) == 1


def test_time_without_a_rate_is_refused_with_what_helps():
    t = np.cumsum(np.random.default_rng(8).uniform(0.002, 0.02, 800))
    with pytest.raises(LogError, match="not evenly sampled.*rate = "):
        evened("log", Record(t, {"press.x": np.sin(t)}))


def mapped(tmp_path: Path, stamps: np.ndarray) -> Record:
    path, columns = tmp_path / "bus.csv", tmp_path / "bus.map.toml"
    path.write_text("time;A\n" + "".join(f"{t:.4f};{t:.4f}\n" for t in stamps))
    columns.write_text('rate = "100 Hz"\n[names]\ntime = "t [s]"\nA = "ram.p_head [bar]"\n')
    return read(path, columns=load_columns(columns))


def test_a_rate_beside_stamps_keeps_what_they_say_of_missing_rows(tmp_path):
    """Counted by the rate alone every row behind a lost one came too early, and nobody said so."""
    keep = np.ones(ROWS.size, bool)
    keep[[250, *range(800, 809)]] = False
    by = late(np.random.default_rng(9), "tail")
    by[[248, 249, 251, 252, 798, 799, 809, 810]] = 0.0
    record = mapped(tmp_path, (PERIOD * ROWS + by)[keep])
    np.testing.assert_allclose(record.t, PERIOD * ROWS[keep], atol=1e-12)
    assert record.losses == (
        "ram.p_head: about 10 samples missing, 1 between t = 2.49 and 2.51 s, "
        "9 between t = 7.99 and 8.09 s",
    )


def test_rounded_stamps_that_last_longer_than_their_rows_are_told(tmp_path):
    keep = np.ones(ROWS.size, bool)
    assert mapped(tmp_path, np.floor(PERIOD * ROWS * 5.0) / 5.0).losses == ()
    keep[500:600] = False
    record = mapped(tmp_path, np.floor(PERIOD * ROWS[keep] * 5.0) / 5.0)
    assert "the rows last 13.99 s, and by their stamps 14.8 s" in record.losses[0]


@pytest.mark.parametrize(
    ("rate", "start", "rounded"),
    [
        (4000.0, 3600.0, np.float32),
        (3000.0, 3600.0, np.float32),
        (1000.0, 30000.0, np.float32),
        (2000.0, 100.0, lambda t: np.round(t, 3)),
        (1003.0, 100.0, lambda t: np.round(t, 3)),
    ],
)
def test_rounded_stamps_of_an_even_rate_are_even_again(rate, start, rounded):
    true = start + np.arange(8000) / rate
    stamps = np.asarray(rounded(true), dtype=float)
    t = unrounded(stamps - stamps[0], max(resolution(stamps)))
    np.testing.assert_allclose(np.diff(t), 1.0 / rate, rtol=1e-5)


@pytest.mark.parametrize(("rate", "start"), [(1000.0, 5000.0), (500.0, 9000.0), (2000.0, 3000.0)])
def test_rows_that_a_coarse_clock_lost_are_counted(rate, start):
    """Floats of 32 bits, up to three quarters of the sample time apart."""
    rows = np.setdiff1d(np.arange(4000), [500, 1500, 1501, 2500, 2501, 2502])
    stamps = (start + rows / rate).astype(np.float32).astype(float)
    assert max(resolution(stamps)) > 0.2 / rate
    t = unrounded(stamps, max(resolution(stamps)))
    np.testing.assert_array_equal(np.rint((t - t[0]) * rate), rows)
    np.testing.assert_allclose(t - t[0], rows / rate, atol=0.02 / rate)


@pytest.mark.parametrize("top", [5e-324, 1e-310, 9.999999999999999e22, 1e300])
def test_numbers_of_any_size_have_a_resolution(top):
    assert max(resolution(np.array([0.0, top]))) >= 0.0


@pytest.mark.parametrize("lost", [1, 7, 80])
def test_missing_samples_are_no_rounding(lost):
    rows = np.setdiff1d(np.arange(8000), np.random.default_rng(1).choice(8000, lost, False))
    t = np.round(rows / 1000.0, 3)
    assert unrounded(t, max(resolution(t))) is t


@pytest.mark.parametrize("turn", [2.0**16, 2.0**32])
def test_a_counter_that_begins_again_goes_on_and_one_that_was_reset_stays(turn):
    truth = np.concatenate([[np.nan], turn - 1e4 + 10.0 * np.cumsum(np.arange(300) % 4 + 1)])
    for zero in (0.0, 0.5 * turn):  # of a signed one too
        np.testing.assert_array_equal(unwrapped(truth % turn - zero), truth - zero)
    for other in (np.where(truth < turn, truth, truth - turn + 500.0), truth % turn + 0.5):
        np.testing.assert_array_equal(unwrapped(other), other)


@pytest.mark.parametrize("rows", [130, 400, 1999])
def test_the_rate_of_a_time_in_whole_seconds_is_that_of_its_rows(rows):
    assert rate_of_rounded(np.floor(0.3 + np.arange(rows) / 50.0)) == pytest.approx(50.0)
