"""Two machines of others, from a wrong model to the right one by what the tool says, as their
READMEs have it."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ehbench import load_rig, workflow
from ehbench.config.recipe.columns import load_columns
from ehbench.data import read
from ehbench.data.additional import AdditionalFile
from ehbench.identification.hydraulics import FitOptions, identify_hydraulics
from ehbench.validation import validate_rig
from tests.shared import RECIPES, result
from tests.strangers import LOADER, PRESS, logs_of, steps

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


def test_stops_and_cushions_of_a_stranger_spoil_no_numbers(tmp_path):
    """The loader runs into stops a tenth as stiff as the model's, from either side; its damping
    came out six times too large, and the exact model was blamed."""
    machine = replace(LOADER, stroke=0.07, stop=3e7)
    truth = {"bulk_modulus": machine.bulk, "arm.damping": machine.damping}
    truth["lift.friction_coulomb"] = machine.coulomb
    sizes = {"lift.stroke": machine.stroke, "lift.spool.overlap": machine.lap}
    sizes |= {"lift.volume_rod": machine.dead + machine.areas[1] * machine.stroke}
    sizes |= {"lift.spool.null": machine.middle}
    rig = load_rig(RECIPES / "loader/better_rig.toml").with_values(sizes)
    logs = []
    for k, levels in enumerate(((5.0, -3.5, 0.0, 6.0, -6.0), (-6.0, 4.0, 5.0, -4.0, 3.0))):
        lever, file = steps(levels), tmp_path / f"{k}.csv"
        file.write_text(machine.recorded(lambda t, x, lever=lever: lever(t), 2.8, k))
        logs.append((f"log {k}", read(file, RECIPES / "loader/daq.map.toml")))
    ends = [record["lift.x"] for _, record in logs]
    assert ends[0].max() > machine.stroke and ends[1].min() < 0.0
    fit = identify_hydraulics(rig, logs, [*truth], FitOptions(start={"lift.friction_coulomb": 200}))
    for item in fit.parameters:
        low, high = item.interval
        assert abs(truth[item.name] - item.value) < high - low < 0.25 * item.value, item
    exact = validate_rig(rig.with_values(truth), logs)
    notes = [note.key for log in exact.logs for note in log.warnings if hasattr(note, "key")]
    assert exact.verdict == "accepted" and notes.count("validation.at_end") == 2


@pytest.mark.slow
def test_a_slow_position_hides_no_friction_from_fast_pressures(tmp_path):
    """The loader's stroke from a second recorder, at 50 Hz: its noise is that of 50 Hz."""
    lines = (RECIPES / "loader/run_3.csv").read_text().splitlines()
    rows = [line.split(";") for line in lines]
    fast, slow = tmp_path / "fast.csv", tmp_path / "slow.csv"
    fast.write_text("\n".join(";".join((row[0], row[1], *row[4:])) for row in rows))
    slow.write_text("\n".join(";".join((row[0], row[2])) for row in (rows[0], *rows[1::20])))
    maps = RECIPES / "loader/daq.map.toml"
    for file, gone in ((fast, ("x (", "v (")), (slow, ("u (", "v (", "PA", "PB"))):
        kept = [
            line
            for line in maps.read_text().splitlines()
            if not line.startswith(tuple(f'"{g}' for g in gone))
        ]
        file.with_suffix(".toml").write_text("\n".join(kept))
    other = AdditionalFile(slow, load_columns(slow.with_suffix(".toml")), shared_clock=False)
    record = read(fast, fast.with_suffix(".toml"), additional=[other])
    truth = STRANGERS["loader"][0]
    rig = load_rig(RECIPES / "loader/better_rig.toml").with_values(truth)
    assert validate_rig(rig, [("run", record)]).verdict == "accepted"
    coulomb = "lift.friction_coulomb"
    verdict = validate_rig(rig.with_values({coulomb: 1.3 * truth[coulomb]}), [("run", record)])
    first = verdict.structure.findings[0]
    assert (verdict.verdict, first.kind) == ("accepted with reservation", "friction")
    assert first.sentence.fields["value"] == "400 N"
