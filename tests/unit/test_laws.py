"""The registry of controllers: what every law has to say of itself."""

import pytest

from ehbench.control import LAW_NAMES
from ehbench.control.registry import LAWS
from ehbench.vocabulary.quantities import VOCABULARY


@pytest.mark.parametrize("name", LAW_NAMES)
def test_a_law_is_called_as_its_file_and_has_words_for_what_it_takes_and_tells(name):
    law = LAWS[name]
    assert law.name == name
    assert set(law.telemetry) <= set(VOCABULARY) and len(set(law.telemetry)) == len(law.telemetry)
    assert all(row is None or row in VOCABULARY.values() for row in law.gains.values())
    assert set(law.bounds) <= set(law.gains)
    assert law.required is None or law.required.gain in law.gains
    # the desired motion comes first: a trial puts it out by these names after a stop
    assert law.telemetry[:4] == ("x_desired", "v_desired", "a_desired", "j_desired")


def test_laws_of_one_record_share_one_step():
    steps = {}
    for law in LAWS.values():
        assert steps.setdefault(law.record, law.step) is law.step
