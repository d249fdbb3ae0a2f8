"""Drafts of files in the style of real recorders: no wrong column is certain, nothing vanishes."""

import numpy as np
import pytest

from ehbench.app import inspection, mapping
from ehbench.config.recipe import load_columns
from ehbench.config.rig import Rig
from ehbench.data.channels import dialect_of
from ehbench.data.readers import open_source
from ehbench.signals.oddities import oddities
from tests.recorder_files import RECORDINGS
from tests.shared import shipped


@pytest.fixture(autouse=True)
def unpictured(monkeypatch) -> None:
    monkeypatch.setattr(mapping, "draw", lambda path, *_: path.touch())


def rig_of(two_cylinders: bool) -> Rig:
    """The crane, or one with two cylinders whose signals carry the names of the joints."""
    rig = shipped("crane_proportional")
    if not two_cylinders:
        return rig
    (lift,) = rig.cylinder
    names = {"left": "boom", "right": "stick"}
    pair = tuple(lift.model_copy(update={"name": c, "joint": j}) for c, j in names.items())
    return rig.model_copy(update={"cylinder": pair})


def test_there_are_many_recorders():
    assert len(RECORDINGS) >= 30


@pytest.mark.parametrize("style", RECORDINGS)
def test_no_wrong_column_is_certain(style, tmp_path):
    recording = RECORDINGS[style]
    recording.write(path := tmp_path / recording.file)
    guesses = mapping.guessed(open_source(path), rig_of(recording.two_cylinders))
    assert set(recording.truth) <= set(guesses)
    for name, channel in recording.truth.items():
        guess = guesses[name]
        if guess.certainty == mapping.guesses.CERTAIN:
            assert guess.channel == channel and guess.why, (name, guess)
        if guess.sure and not channel:
            assert not guess.channel, (name, guess)
    drafted = {name: guesses[name].channel for name in recording.required if guesses[name].sure}
    assert drafted == {name: recording.truth[name] for name in recording.required}


@pytest.mark.parametrize("style", RECORDINGS)
def test_each_column_is_listed_and_what_is_undecided_is_a_remark(style, tmp_path):
    recording = RECORDINGS[style]
    recording.write(path := tmp_path / recording.file)
    made = mapping.draft(path, tmp_path / "a.map.toml", None)
    text = "\n".join(made.notes)
    drafted = load_columns(made.place).columns.names
    for name in recording.truth:
        line = " ".join(map(str, next(row for row in made.tables[0].rows if row[0] == name)))
        assert any(word in line for word in ("certain", "likely", "undecided"))
        assert (name in drafted) == ("undecided" not in line)
    drafted_as = dialect_of(load_columns(made.place))
    for table, again in zip(open_source(path).tables, open_source(path, drafted_as).tables):
        for column, other in zip(table.columns, again.columns, strict=True):
            np.testing.assert_array_equal(column.values, other.values)
            assert (column.name, column.unit) == (other.name, other.unit)
    whole = all(name in drafted for name in recording.truth)
    assert ("taken with this map" in text) <= whole


def test_columns_without_numbers_are_listed_with_their_first_cell(tmp_path):
    rows = "".join(f"{0.01 * n:.2f},{n % 7}.5,{'RUN' if n else ''},1.2.3\n" for n in range(50))
    (tmp_path / "a.csv").write_text("t [s],p rod [bar],state,version\n" + rows)
    (table,) = mapping.draft(tmp_path / "a.csv", tmp_path / "a.map.toml", None).tables
    for name, cell, line in (("state", "'RUN'", "line 3"), ("version", "'1.2.3'", "line 2")):
        found = " ".join(map(str, next(row for row in table.rows if row[0] == name)))
        assert cell in found and line in found and "undecided" in found


ODD = {  # what happens to a slow sine: (kind, count, first row)
    "a sentinel": (lambda y: np.put(y, [100, 101, 102], -999.25), ("sentinel", 3, 100)),
    "one within the range of a sensor": (
        lambda y: np.put(y, range(50, 55), 99.9),
        ("sentinel", 5, 50),
    ),
    "jumps": (lambda y: np.put(y, [30, 200], [80.0, 81.0]), ("jump", 2, 30)),
    "an encoder": (lambda y: np.copyto(y, (np.arange(y.size) * 1.7) % 360.0), ("wrap", 1, 212)),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_samples_are_counted_and_located(name, tmp_path):
    change, (kind, count, first) = ODD[name]
    noise = 0.01 * np.random.default_rng(2).normal(size=400)
    y = 20.0 + 5.0 * np.sin(np.arange(400) / 40.0) + noise
    assert oddities(y) == []
    change(y)
    (odd,) = oddities(y)
    assert (odd.kind, odd.count, odd.first) == (kind, count, first)
    rows = "".join(f"{0.01 * n:.2f},{value:.4f}\n" for n, value in enumerate(y))
    (tmp_path / "a.csv").write_text("t [s],lift.q [deg]\n" + rows)
    drafted = mapping.draft(tmp_path / "a.csv", tmp_path / "a.map.toml", rig_of(False)).notes
    assert any(f"line {first + 2}" in line for line in drafted)
    checked = inspection.check(tmp_path / "a.csv").lines
    assert any(f"t = {0.01 * first:g} s" in line for line in checked)
