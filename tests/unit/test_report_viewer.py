"""Interactive pages: the numbers of a log, whole or by their extremes, in one file."""

import base64
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from ehbench.data import read
from ehbench.report import viewer
from ehbench.vocabulary.errors import InputError
from tests.unit.report_runs import flow_map_run, hydraulics_run

LOG = Path(__file__).parents[2] / "datasets" / "slide_servo" / "steps" / "press_no_load.mcap"


def data_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_a_log_is_in_its_page_sample_by_sample():
    record = read(LOG)
    (sheet,) = data_of(viewer.page([LOG]))["sheets"]
    curves = {one["name"]: one for panel in sheet["panels"] for one in panel["curves"]}
    one = curves["press.p_head"]
    assert numbers(sheet["xs"][one["x"]], "<f8") == pytest.approx(record.t)
    assert numbers(one["y"], "<f4") == pytest.approx(record["press.p_head"] / 1e3, rel=1e-6)
    changing = {name for name, values in record.channels.items() if np.ptp(values) > 0.0}
    assert set(curves) == changing and len(sheet["still"]) == len(record.channels) - len(changing)
    (title,) = [p["title"] for p in sheet["panels"] if one in p["curves"]]
    assert title.endswith("[kPa]") and "ead-end pressure" in title


def test_the_page_needs_no_network_and_runs_its_own_scripts_only():
    text = viewer.page([LOG])
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy and len(scripts) == 2 and "default-src 'none'" in policy[1]
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy[1]
    assert not re.search(r'(?:src|href)="', text) and "The MIT License" in text


def test_two_of_a_kind_lie_over_one_another():
    page = data_of(viewer.page([LOG, LOG]))
    (sheet,) = page["sheets"]
    curves = [one for panel in sheet["panels"] for one in panel["curves"]]
    assert [one["of"] for one in curves].count(0) == [one["of"] for one in curves].count(1) > 0
    assert len(page["names"]) == 2


def test_runs_show_their_maps_and_comparisons(tmp_path):
    maps = data_of(viewer.page([flow_map_run(tmp_path)]))["sheets"]
    names = [one["name"] for one in maps[0]["panels"][0]["curves"]]
    assert "10 V" in names and names[-1] == "readings" and len(maps) == 3
    (fit,) = data_of(viewer.page([hydraulics_run(tmp_path)]))["sheets"]
    names = {one["name"].split(" ")[1] for panel in fit["panels"] for one in panel["curves"]}
    assert names == {"recorded", "simulated"}


def test_thinned_curves_keep_every_extreme():
    t = np.linspace(0.0, 10.0, 100_003)
    y = np.sin(t) + 0.01 * np.sin(700.0 * t)
    y[[17, 54_321, 100_002]] = [5.0, -7.0, 3.0]
    x, kept = viewer.extremes(t, y, 2000)
    assert x.size == kept.size <= 2200 and np.all(np.diff(x) > 0.0)
    assert {5.0, -7.0, 3.0} <= set(kept)
    assert viewer.extremes(t, y, y.size)[1] is y
    y[1000:3000] = np.nan
    assert np.isnan(viewer.extremes(t, y, 2000)[1]).any()


def test_a_page_replaces_a_page_of_its_own_and_nothing_else(tmp_path):
    mine, page = tmp_path / "mine.html", tmp_path / "page.html"
    mine.write_text("<p>mine</p>")
    page.write_text(viewer.page([LOG]))
    assert viewer.place([LOG], page) == page
    with pytest.raises(InputError, match="is no page of"):
        viewer.place([LOG], mine)
    with pytest.raises(InputError, match="is a folder"):
        viewer.place([LOG], tmp_path)


@pytest.mark.parametrize(("name", "says"), [("no.mcap", "no such file"), ("x.docx", "cannot show")])
def test_what_cannot_be_shown_is_said(tmp_path, name, says):
    if name != "no.mcap":
        (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match=says):
        viewer.page([tmp_path / name])


def test_names_from_a_file_stay_text(tmp_path):
    folder = hydraulics_run(tmp_path / "</script><b>")
    text = viewer.page([folder])
    assert text.count("</script>") == 3
