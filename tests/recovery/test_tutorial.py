"""The path of the tutorial from a rejected first fit to an accepted model."""

from __future__ import annotations

from pathlib import Path

import pytest

from ehbench import workflow

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "recipes" / "tutorial"


@pytest.mark.slow
def test_the_tutorial_leads_from_a_rejected_fit_to_an_accepted_model(undrawn, tmp_path):
    session = workflow.Session(root=tmp_path)
    first = workflow.run(TUTORIAL / "first_validation.toml", session)
    assert first.code == workflow.REJECTED
    reasons = first.json("validation")["reasons"]
    assert len(reasons) == 3 and "press speed fit 6" in reasons[0]
    assert any("press.v is 4.8 ms behind the model" in note for note in first.notes)
    better = workflow.run(TUTORIAL / "better_validation.toml", session)
    assert better.code == workflow.DONE and better.json("validation")["accepted"]
    (reserve,) = better.json("validation")["reservations"]  # of the delay that was left out
    assert reserve.startswith("press.servo.command is held to have no delay")
    assert "bulk_modulus would then come out" in reserve
    fits = {  # as the validations have made them
        name: session.outcome_of(TUTORIAL / f"{name}_fit.toml") for name in ("first", "better")
    }
    damping = {name: fit.parameters.loc["carriage.damping"].to_dict() for name, fit in fits.items()}
    assert damping["first"]["low"] > damping["better"]["high"]  # what a wrong gain does to it
    (lag,) = fits["better"].json("parameters")["sensors"]
    assert lag["interval"][0] < 0.005 < lag["interval"][1]
    bare = tmp_path / "bare.toml"
    log = ROOT / "datasets/slide_servo/heldout/press_no_load.mcap"
    bare.write_text(
        f'stage = "validate"\nrig = "{fits["better"].folder}"\ndata = ["{log}"]\n'
        'channels = ["v", "p_head", "p_rod"]\nstructure = false\n'
        "[thresholds]\nfit_percent = { v = 85, p_head = 94, p_rod = 94 }\n"
    )
    inherits = workflow.run(bare, session)  # the lag that the fit found, as its recipe says none
    assert inherits.code == workflow.DONE
    assert any("press.v is taken with lag 4.9 ±" in note for note in inherits.notes)
    text = (ROOT / "docs" / "explanation" / "identification.md").read_text(encoding="utf-8")
    for name in ("first_fit", "first_validation", "better_fit", "better_validation"):
        assert f"recipes/tutorial/{name}.toml" in text
