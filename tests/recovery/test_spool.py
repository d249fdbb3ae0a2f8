"""One overlap and one null of a whole spool, from the flows of its edges to a suggested recipe."""

import pytest

from ehbench.config.rig import Rig
from ehbench.diagnosis.faults import hypotheses
from ehbench.guidance.suggestions import suggest
from ehbench.identification.hydraulics import identify_hydraulics, prepare_fit
from ehbench.plant.model import Model
from tests.shared import shipped
from tools.virtual_logs import virtual_log


def slide(**spool) -> Rig:
    """The slide, its spool with these keys."""
    tables = shipped("slide_servo").as_toml()
    tables["cylinder"][0]["valve"][0].update(spool)
    return Rig.model_validate(tables)


@pytest.mark.parametrize(("overlap", "null"), [("0.3 V", "0.1 V"), ("-0.2 V", "-0.05 V")])
def test_edges_of_a_spool_open_about_its_null(overlap, null):
    """Those for extending from null + overlap on, those for retracting from null − overlap."""
    rig = slide(overlap=overlap, null=null)
    wide, middle = (float(text.split()[0]) for text in (overlap, null))
    edges = Model.of(rig).plant.edges
    assert edges["deadband"] == pytest.approx(wide + edges["sign"] * middle)
    assert float(rig.parameters()["press.servo.overlap"]) == pytest.approx(wide)
    again = rig.with_values({"press.servo.null": 0.2})
    assert Model.of(again).plant.edges["deadband"] == pytest.approx(wide + 0.2 * edges["sign"])


def test_an_overlap_and_a_null_come_back_from_noisy_logs():
    machine = slide(overlap="0.25 V", null="0.08 V")
    logs = [(kind, virtual_log("slide_servo", machine, kind, 3, 2.6)) for kind in ("steps", "sine")]
    rig = slide(overlap="0.05 V", null="0.01 V")
    fit = identify_hydraulics(
        rig, logs, ["bulk_modulus", "press.servo.overlap", "press.servo.null"]
    )
    for name, true in (("press.servo.overlap", 0.25), ("press.servo.null", 0.08)):
        low, high = fit[name].interval or (1.0, 0.0)
        assert low <= true <= high and high - low < 0.02


def test_a_spool_that_is_open_at_rest_and_off_its_middle_is_suggested():
    """By two numbers, where four dead bands would not do: they end at zero."""
    machine = slide(overlap="-0.15 V", null="0.06 V")
    log = virtual_log("slide_servo", machine, "quick steps", 3, 1.2)
    fit = prepare_fit(slide(), [("log", log)], ["bulk_modulus", "carriage.damping"])
    first = suggest(fit, [("log", log)], lambda text, share: None, 3600.0, 1).rows[0]
    assert first.changes == ("overlap of press.servo",) and first.misfit < 0.1
    assert first.recipe_lines == ('parameters: add "press.servo.overlap", "press.servo.null"',)
    assert first.rig_lines[0].splitlines()[1].startswith("overlap = ")


def test_a_spool_has_one_row_and_a_cartridge_none():
    rows = {}
    for name in ("slide_servo", "boom_four_valve"):
        rig = shipped(name)
        who = rig.cylinder[0].name
        log = virtual_log(name, rig, "quick steps", 3, 1.0)
        known = hypotheses(rig, [who], [f"{who}.v"], [log])
        rows[name] = [row for row in known if row.kind == "overlap"]
    (row,) = rows["slide_servo"]
    assert row.about == "press.servo" and row.bounds[0] < 0.0 and rows["boom_four_valve"] == []
