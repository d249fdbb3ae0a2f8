"""Two machines of others, from a wrong model to the right one by what the tool says, as their
READMEs have it."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from ehbench import workflow
from tests.shared import RECIPES, result
from tests.strangers import LOADER, PRESS, logs_of

# by machine: numbers of the machine [SI] by parameter, and the change that leads to them
STRANGERS = {
    "press": (
        {
            "bulk_modulus": PRESS.bulk,
            "tool.damping": PRESS.damping,
            "press.friction_coulomb": PRESS.coulomb,
            "press.leakage_internal": PRESS.leakage,
        },
        "leakage of press.leakage_internal",
    ),
    "loader": (
        {
            "bulk_modulus": LOADER.bulk,
            "arm.damping": LOADER.damping,
            "lift.friction_coulomb": LOADER.coulomb,
            "lift.spool.overlap": LOADER.lap,
            "lift.spool.null": LOADER.middle,
        },
        "overlap of lift.spool",
    ),
}


@pytest.mark.parametrize("machine", STRANGERS)
def test_the_logs_of_a_stranger_are_what_its_equations_give(machine):
    """Their first 0.4 s, with a step; to one digit of seven, which another SciPy may change."""
    for name, text in logs_of(machine, 0.4).items():
        head, *rows = text.splitlines()
        shipped = (RECIPES / machine / name).read_text().splitlines()
        made, kept = (
            np.loadtxt((row.replace(",", ".") for row in lines), delimiter=";")
            for lines in (rows, shipped[1 : len(rows) + 1])
        )
        assert head == shipped[0] and made[:, 1].any()
        np.testing.assert_allclose(made, kept, rtol=2e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("machine", STRANGERS)
def test_a_wrong_model_of_a_stranger_is_led_to_the_right_one(
    machine, inside, undrawn, tmp_path, monkeypatch
):
    truth, change = STRANGERS[machine]
    shutil.copytree(RECIPES / machine, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    readme = Path("README.md").read_text(encoding="utf-8")
    codes, answers = {}, {}
    for words in re.findall(r"^    ehbench (.+)$", readme, re.M):
        done = inside(*words.split(), cwd=tmp_path)
        codes[words], answers[words] = done.returncode, done.stdout
    wrong = [words for words, code in codes.items() if code]
    assert wrong == ["validate judge_first.toml"] and codes[wrong[0]] == workflow.REJECTED
    suggested = answers["identify first.toml --suggest"]
    assert change in next(line for line in suggested.splitlines() if re.match(r" *[\d.]+ %", line))
    first, better = (result(name, "parameters")["parameters"] for name in ("first", "better"))
    damping = next(row for row in first if row["name"].endswith("damping"))
    assert damping["value"] > 2.0 * truth[damping["name"]]
    found = {row["name"]: row["value"] for row in better}
    assert found == pytest.approx(truth, rel=0.025)
    assert result("judge_better", "validation")["verdict"] == "accepted"
    assert len(readme.split()) < 300
