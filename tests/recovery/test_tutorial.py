"""The tutorial, run as a reader would: its files written, its commands given, its results found."""

import re
import shlex
from pathlib import Path

import pytest

from ehbench import workflow
from tests.shared import ROOT, result

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
STEPS = re.compile(
    r"```(?:toml|python)\n(?P<text>.*?)```|^    ehbench (?P<words>[^\n]+)$", re.S | re.M
)


def arguments(words: str) -> list[str]:
    return [
        match
        for word in shlex.split(words)
        for match in (map(str, sorted(Path().glob(word))) if "*" in word else [word])
    ]


@pytest.mark.slow
def test_the_tutorial_leads_from_raw_files_to_a_trial(inside, undrawn, tmp_path, monkeypatch):
    for name in ("recipes", "datasets"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    codes = {}
    for step in STEPS.finditer(PAGE):
        if (words := step["words"]) is not None:
            if "--suggest" not in words:
                done = inside(*arguments(words), cwd=tmp_path)
                codes[words] = done.returncode
                assert done.returncode == 0 or words == "validate judge_first.toml", done.stderr
        elif (name := re.match(r"# (\S+\.toml)\n", step["text"])) is not None:
            Path(name[1]).write_text(step["text"], encoding="utf-8")
        else:
            exec(compile(step["text"], "tutorial.md", "exec"), {"__name__": "tutorial"})
    assert codes["validate judge_first.toml"] == workflow.REJECTED and len(codes) >= 10
    assert "press.servo.command" in Path("run_1.map.toml").read_text()  # as drafted

    damping = {
        name: next(
            row["interval"]
            for row in result(name, "parameters")["parameters"]
            if row["name"] == "carriage.damping"
        )
        for name in ("first", "better")
    }
    assert damping["first"][0] > damping["better"][1]  # what the wrong gains do to it
    judged = result("judge_better", "validation")
    assert judged["verdict"] == "accepted", judged["reservations"]
    first = result("judge_first", "validation")
    assert len(first["reasons"]) == 3 and not first["accepted"]
    assert result("trial", "trial")["measures"]["tracking"]["max_error"] < 2e-3


@pytest.mark.slow
def test_the_tutorials_model_without_its_delay_is_rejected(undrawn, tmp_path, monkeypatch):
    """And a validation takes over the lag that the fit found."""
    for name in ("recipes", "datasets"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    for step in STEPS.finditer(PAGE):
        text = step["text"] or ""
        if (name := re.match(r"# (\S+\.toml)\n", text)) is not None:
            delay = '\n[[sensor]]\nchannel = "press.servo.command"\ndelay = "estimate"\n'
            Path(name[1]).write_text(text.replace(delay, ""), encoding="utf-8")
        elif text:
            exec(compile(text, "tutorial.md", "exec"), {"__name__": "tutorial"})
    outcome = workflow.run(tmp_path / "judge_better.toml", workflow.Session(root=tmp_path))
    verdict = outcome.json("validation")
    assert verdict["verdict"] == "rejected"
    assert any(
        "press.servo.command" in text and "bulk_modulus" in text for text in verdict["reasons"]
    )
    taken = [note for note in outcome.notes if "press.v is taken with" in note]
    assert any(" 5 " in note for note in taken), taken
