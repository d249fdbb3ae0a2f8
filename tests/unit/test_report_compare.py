"""What differs between two runs."""

import json
import math
import re
import shutil
from pathlib import Path

import pytest

from ehbench.report.compare import Shift, answer, compare, rig_of
from ehbench.vocabulary.errors import InputError
from tests.unit.report_runs import flow_map_run, hydraulics_run


@pytest.fixture
def pair(tmp_path):
    first = hydraulics_run(tmp_path)
    second = tmp_path / "other"
    shutil.copytree(first, second)
    table = json.loads((second / "parameters.json").read_text())
    table["parameters"][0] |= {"value": 2.9e8, "interval": [2.87e8, 2.93e8]}
    (second / "parameters.json").write_text(json.dumps(table))
    facts = json.loads((second / "run.json").read_text())
    facts["inputs"][0]["sha256"] = "9" * 64
    (second / "run.json").write_text(json.dumps(facts))
    return first, second


def test_what_differs_is_told_and_by_how_many_intervals(pair):
    found = compare(*pair)
    assert [(one.what, one.second) for one in found.inputs] == [("data readings.csv", "9" * 64)]
    (one,) = found.parameters
    assert one.name == "bulk_modulus" and found.same == 2
    # the halves that point to one another: 4.8 MPa up from the first, 3 MPa down from the second
    assert one.intervals == pytest.approx(18.7 / math.hypot(4.8, 3.0))
    told = "\n".join(answer(compare(*pair), rig_of(pair[0])).lines(200, whole=True))
    assert "271.3 ± 4.8" in told and "290.0 ± 3.0" in told
    assert re.search(r"bulk_modulus .* MPa .* 3\.3\b", told)
    assert "99999999" in told and "MPa" in told
    found = compare(pair[0], pair[0])
    assert not found.inputs and not found.parameters and not found.numbers and found.same == 3
    assert answer(found, None).verdict.fields["inputs"] == 0


def test_what_cannot_be_compared_is_named(pair, tmp_path, monkeypatch):
    maps = flow_map_run(tmp_path)
    with pytest.raises(InputError, match="is a run of 'flow map', the other of 'hydraulics'"):
        compare(pair[0], maps)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no run folder") as refused:
        compare(Path("."), Path("."))
    assert refused.value.file == str(tmp_path)


@pytest.mark.parametrize(
    ("first", "second", "apart"),
    [
        ((1.0, (0.9, 1.3)), (2.0, (1.6, 2.1)), 1.0 / math.hypot(0.3, 0.4)),
        ((2.0, (1.6, 2.1)), (1.0, (0.9, 1.3)), 1.0 / math.hypot(0.3, 0.4)),
        ((1.0, None), (2.0, (1.5, 2.5)), 2.0),
        ((1.0, None), (2.0, None), None),
        ((1.0, (1.0, 1.0)), (1.0, None), 0.0),
        ((None, None), (1.0, (0.0, 2.0)), None),
    ],
)
def test_distance_in_intervals(first, second, apart):
    found = Shift("x", *first, *second).intervals
    assert found == (apart if apart is None else pytest.approx(apart))
