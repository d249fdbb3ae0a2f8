"""A search that is stopped at any of its steps goes on, and ends with the same bytes."""

import json
from pathlib import Path

import pytest

from ehbench import workflow
from ehbench.identification import journal as journals
from ehbench.identification.journal import Journal, journal_of, place_of
from ehbench.vocabulary.errors import InputError, InsufficientData
from tests.shared import ROOT, contents, refused

RECIPE = f"""
stage = "identify"
what = "hydraulics"
rig = "{ROOT}/recipes/rigs/slide_servo.toml"
data = [{{ path = "{ROOT}/datasets/slide_servo/steps/press_no_load.mcap", stop = "0.6 s" }}]
parameters = ["bulk_modulus", "carriage.damping"]
"""


@pytest.fixture
def recipe(tmp_path, monkeypatch, undrawn):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(journals, "EVERY", 0.0)
    path = tmp_path / "fit.toml"
    path.write_text(RECIPE)
    return path


@pytest.mark.parametrize("place", ["fit.toml/run", "/dev/null/run"])
def test_a_place_where_nothing_can_lie_is_refused_as_such(place, recipe):
    with refused("runs.no_place", InputError):
        workflow.run(recipe, workflow.Session(out=Path(place)))


def keys(outcome):
    return [getattr(note, "key", "") for note in outcome.notes]


def breaking(monkeypatch, count):
    """Let the search be stopped as it writes its journal for the time ``count``."""
    made, write = [], Journal.write

    def stopped(self):
        write(self)
        if self.path is None:  # what is asked of fixed numbers is asked again
            return
        made.append(self)
        if len(made) == count:
            raise KeyboardInterrupt

    monkeypatch.setattr(Journal, "write", stopped)
    return made


@pytest.mark.slow
def test_a_stopped_search_goes_on_and_ends_with_the_same_bytes(recipe, monkeypatch):
    written = breaking(monkeypatch, 0)
    workflow.run(recipe, workflow.Session(out=Path("whole")))
    assert not place_of(Path("whole")).exists()
    steps = len(written)
    assert steps > 8
    for at in (1, steps // 2, steps - 1):  # in the first look, in a descent, at the end
        fit, left = Path(f"fit{at}"), Path(f"fit{at}.search.json")
        with monkeypatch.context() as patch:
            breaking(patch, at)
            with pytest.raises(KeyboardInterrupt) as stopped:
                workflow.run(recipe, workflow.Session(out=fit))
        assert "--resume" in stopped.value.__notes__[0]
        assert not fit.exists()
        told = json.loads(left.read_text())
        assert 100e6 < told["stands"]["parameters"]["bulk_modulus"] < 1800e6
        with monkeypatch.context() as patch:
            again = breaking(patch, 0)
            outcome = workflow.run(recipe, workflow.Session(out=fit, resume=True))
        assert "stages.begun_anew" not in keys(outcome)
        assert len(again) <= steps - at + 2  # what had been done is not done again
        assert contents(fit) == contents(Path("whole"))
        assert not left.exists()
    left.with_name("other.search.json").write_text(json.dumps(told | {"hash": "another recipe"}))
    outcome = workflow.run(recipe, workflow.Session(out=Path("other"), resume=True))
    assert "stages.begun_anew" in keys(outcome) and contents(Path("other")) == contents(fit)


def test_what_is_known_of_other_inputs_or_torn_is_not_gone_on_with(tmp_path):
    final = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt), journal_of(final, {"hash": "1"}, False) as journal:
        assert journal.begin("a") == {}
        journal.keep({}, costs=[1.0])
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), journal_of(final, {"hash": "1"}, True) as journal:
        assert journal.begin("a")["costs"] == [1.0]
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), journal_of(final, {"hash": "2"}, True) as journal:
        assert journal.begin("a") == {}
        raise KeyboardInterrupt
    with journal_of(final, {"hash": "2"}, True) as journal:
        assert journal.begin("b") == {}
    place_of(final).write_text('{"hash": "1", "steps": [{')
    with pytest.raises(InsufficientData), journal_of(final, {"hash": "1"}, True) as journal:
        assert journal.begin("a") == {}
        raise InsufficientData("the logs tell nothing")
    assert not place_of(final).exists()
