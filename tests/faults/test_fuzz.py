"""A small fuzz of each kind; `make fuzz` is the large one."""

import pytest

from ehbench.vocabulary.errors import InputError
from tools.fuzz.fuzzer import KINDS, several, table
from tools.fuzz.kinds import Kind

COUNT = 60
FEW = {"run folders": 15, "command lines": 30, "foreign files": 30, "MDF formulas": 20, "bombs": 6}
SOUND = ("odd columns", "file names", "stacked tables")  # all of them are taken


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_inputs_of_each_kind_are_taken_or_refused_with_a_sentence(kind):
    count = FEW.get(kind, COUNT)
    tally = several(kind, range(count), seed=1)
    assert not tally.findings, "\n".join(finding.text for finding in tally.findings)
    assert (tally.refused > 0) == (kind not in SOUND) and tally.taken + tally.refused == count


def test_what_goes_wrong_is_found_and_counted(monkeypatch):
    """A traceback, a hang and a sentence that is none."""

    def take(given, folder):
        if given < 2:
            raise ZeroDivisionError
        if given < 3:
            while True:
                pass
        if given < 4:
            error = InputError("a sentence")
            error.message = "two\nlines"
            raise error
        if given < 6:
            raise InputError("a sentence")

    monkeypatch.setattr("tools.fuzz.fuzzer.LONGEST", 0.2)
    numbers = iter(range(10))
    monkeypatch.setitem(KINDS, "own", Kind(lambda rng: next(numbers), take, 1.0))
    tally = several("own", range(10), seed=0)
    assert [finding.number for finding in tally.findings] == [0, 1, 2, 3]
    assert (tally.taken, tally.refused) == (4, 2)
    assert "Hang" in tally.findings[2].what and "no sentence" in tally.findings[3].what
    said = table({"own": tally})
    assert "2 × ZeroDivisionError" in said and '--again "own:0"' in said
