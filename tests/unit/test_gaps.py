"""Logs with gaps: what is bridged, where they are cut, what is left out and told."""

import numpy as np
import pytest

from ehbench.app import inspection
from ehbench.data import read
from ehbench.data.logs import write_log
from ehbench.data.record import Record, recovered
from ehbench.data.record import lost as lost_of
from ehbench.preprocessing.time_base import parts_of
from tests.shared import ROOT

T = np.arange(0.0, 3.0, 0.001)


def log(*missing: tuple[int, int]) -> Record:
    """3 s at 1 kHz whose command changes each 0.5 s, without samples from one up to another."""
    keep = np.ones(T.size, bool)
    for first, last in missing:
        keep[first:last] = False
    command = np.where(T % 1.0 < 0.5, 0.0, 2.0)
    whole = Record(T, {"press.x": np.sin(T), "press.servo.command": command})
    return whole.at(np.flatnonzero(keep))


def test_logs_that_stay_as_they_are():
    record = log()
    parts, said = parts_of("log", record, driven=True)
    assert said == [] and len(parts) == 1 and parts[0].record is record
    record = log((100, 400), (500, 2900)).between(0.0, 0.45)
    assert parts_of("log", record, driven=True) == ([("log", record)], [])


def test_a_few_samples_are_bridged_and_told():
    parts, said = parts_of("log", log((200, 203), (500, 501), (1000, 1005)))
    whole = log()
    assert len(parts) == 1 and parts[0].name == "log"
    assert [note.key for note in said] == ["preprocessing.bridged"]
    gaps = "4 ms after t = 0.199 s (3), 2 ms after t = 0.499 s (1), 6 ms after t = 0.999 s (5)"
    assert said[0].fields["gaps"] == gaps
    found = parts[0].record
    np.testing.assert_allclose(found.t, T, atol=1e-12)
    np.testing.assert_allclose(found["press.x"], whole["press.x"], atol=1e-5)
    late = np.flatnonzero(found["press.servo.command"] != whole["press.servo.command"])
    # a command that changed in the gap is held until its end
    assert late.tolist() == [500, *range(1000, 1005)]


def test_a_longer_gap_cuts_the_log_in_two():
    parts, said = parts_of("log", log((700, 860), (1500, 1502)), driven=True)
    assert [part.name for part in parts] == ["log_part1", "log_part2"]
    assert [(part.record.t[0], part.record.t[-1]) for part in parts] == [
        (0.0, pytest.approx(0.699)),
        (pytest.approx(0.86), pytest.approx(2.999)),
    ]
    assert all(np.allclose(np.diff(part.record.t), 1e-3) for part in parts)
    assert [note.key.split(".")[1] for note in said] == ["bridged", "cut", "parts"]
    assert said[1].fields["gaps"] == "161 ms after t = 0.699 s (160)"
    assert "log_part2 from 0.86 to 2.999 s" in said[2].fields["parts"]


@pytest.mark.parametrize(
    ("missing", "driven", "within", "kept"),
    [
        ((100, 400), False, None, (0.4, 2.999)),  # too short before it
        ((2450, 2600), True, None, (0.0, 2.449)),  # behind it no command changes
        ((1000, 1100), False, (1.5, 2.9), (1.1, 2.999)),  # before it nothing counts
    ],
)
def test_parts_that_tell_nothing_are_left_out_and_told(missing, driven, within, kept):
    parts, said = parts_of("log", log(missing), driven=driven, within=within)
    assert [part.name for part in parts] == ["log"]
    assert (parts[0].record.t[0], parts[0].record.t[-1]) == pytest.approx(kept)
    assert said[-1].key == "preprocessing.parts_left_out"


def test_another_rate_is_no_gap():
    record = log(*((at, at + 1) for at in range(0, 2000, 2)))
    parts, said = parts_of("log", record)
    assert said == [] and parts[0].record is record


@pytest.mark.parametrize("share", [0.01, 0.05, 0.14])
def test_few_samples_in_a_row_are_bridged_however_many_there_are(share):
    """As a bus loses frames, here and there."""
    lost = np.flatnonzero(np.random.default_rng(3).random(T.size - 1) < share) + 1
    record = log(*((at, at + 1) for at in lost if at < T.size - 1))
    parts, notes = parts_of("log", record)
    assert len(parts) == 1
    np.testing.assert_allclose(parts[0].record.t, T, atol=1e-12)
    (line,) = recovered("log", notes)
    assert line.fields["share"] == pytest.approx(100.0 * (1.0 - record.t.size / T.size))
    assert lost_of(notes) == [] and len(line.split()) < 12


def test_a_log_whose_gaps_are_bridged_is_whole(tmp_path, capsys):
    lost = np.random.default_rng(4).choice(np.arange(1, T.size - 1), 150, replace=False)
    rows = np.setdiff1d(np.arange(T.size), lost)
    text = "".join(f"{T[row]:.3f},{np.sin(T[row]):.6f}\n" for row in rows)
    (tmp_path / "a.csv").write_text("t [s],press.x [m]\n" + text)
    file = inspection.check(tmp_path / "a.csv")
    assert file.code == 0 and sum("interpolated" in line for line in file.lines) == 1
    assert len(inspection.check(tmp_path / "a.csv", verbose=True).lines) > len(file.lines)


def test_a_recipe_takes_a_log_with_a_gap_as_two(tmp_path):
    whole = read(ROOT / "datasets/slide_servo/steps/press_no_load.mcap")
    write_log(tmp_path / "gap.mcap", whole.at(np.flatnonzero(abs(whole.t - 1.38) > 0.08)))
    (tmp_path / "fit.toml").write_text(
        f'stage = "identify"\nwhat = "hydraulics"\nrig = "{ROOT}/recipes/rigs/slide_servo.toml"\n'
        'data = ["gap.mcap"]\nparameters = ["bulk_modulus"]\n'
    )
    found = inspection.check(tmp_path / "fit.toml")
    assert not found.errors
    assert any("gap_part2 from 1.46 to 2 s" in line for line in found.lines)
    file = inspection.check(tmp_path / "gap.mcap")
    assert file.code == 3 and any("the log is cut there" in line for line in file.lines)
