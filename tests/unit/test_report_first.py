"""The first screen of a report, its words and its colours."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ehbench.report import build, terminal
from ehbench.report.blocks import Cell, Grid
from ehbench.report.content import Findings, Headline, SectionContent, StageReport
from ehbench.report.first_screen import Chapter, cards_of, logs_judged
from ehbench.report.page import rig_table
from ehbench.report.saved import Saved, Table
from ehbench.report.stages import report_of
from ehbench.report.stages.validation import silence
from ehbench.report.words import shown
from ehbench.runs.rundir import write_json
from ehbench.vocabulary.messages import Message
from tests.shared import shipped
from tests.unit.report_runs import fill_reported

FOLLOWS = {"follows": []}
RESULTS = ("parameters.json", "validation.json")


def findings_of(folder: Path) -> Findings:
    run = Saved(folder)
    return report_of(run).findings(run)


def section(text: str, name: str) -> str:
    found = re.search(rf'<section id="{name}".*?</section>', text, re.DOTALL)
    assert found
    return found[0]


def words_of(html: str) -> str:
    bare = re.sub(r"<svg.*?</svg>", " ", html, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", bare).split())


@pytest.fixture(scope="module")
def folders(made_once):
    root = made_once("reported", fill_reported)
    return [root / "fit", root / "judged"]


def changed(run: Path, into: Path, **entries) -> Path:
    """A copy of a run, with these entries in its result."""
    shutil.copytree(run, into)
    (file,) = (into / name for name in RESULTS if (into / name).is_file())
    write_json(file, json.loads(file.read_text()) | entries)
    return into


def test_a_fit_alone_shows_its_parameters_and_asks_for_a_validation(folders):
    text = build(folders[:1])
    told = words_of(section(text, "glance"))
    assert "Effective bulk modulus 271.3 ± 4.8 MPa 95 % interval 266.5 … 276.1 MPa" in told
    assert "Viscous damping at the joint, boom" in told
    assert "No verdict" in told and "in a validate recipe" in told
    assert "boom.joint_damping is at bound" in told and "--profile boom.joint_damping" in told
    assert section(text, "glance").count("<svg") == 1


def test_title_verdict_and_chapters_stand_on_the_first_screen(folders):
    text = build(folders)
    assert "<title>Electrohydraulic arm of the thesis</title>" in text
    told = words_of(section(text, "glance"))
    table = json.loads((folders[1] / "validation.json").read_text())
    assert ("Model accepted" if table["accepted"] else "Model rejected") in told
    assert all(reason.lower().rstrip(".")[:40] in told.lower() for reason in table["reasons"][:2])
    rows = re.findall(r"<tr>.*?</tr>", section(text, "chapters"), re.DOTALL)
    assert len(rows) == 3
    assert max(len(re.findall(r"\d[\d.]*", words_of(row))) for row in rows) <= 8


def test_a_log_that_two_runs_judged_counts_once(tmp_path):
    logs = [{"status": "held_out", "scored": None}, {"status": "seen", "scored": None}]
    digests = {"a": ("1", "2"), "b": ("1", "3"), "c": ("4", "2")}
    runs = []
    for name, both in digests.items():
        (tmp_path / name).mkdir()
        write_json(tmp_path / name / "validation.json", {"logs": logs})
        inputs = [{"role": "log", "path": "x", "sha256": one} for one in both]
        write_json(tmp_path / name / "run.json", {"stage": "x", "name": name, "inputs": inputs})
        runs.append(Saved(tmp_path / name))
    assert len(logs_judged(runs[0]) | logs_judged(runs[1])) == 1
    assert len(logs_judged(runs[0]) | logs_judged(runs[2])) == 2


def test_five_numbers_one_a_rank_the_machine_before_the_model(folders):
    found = [
        Findings([Headline(0, "a", "1"), Headline(3, "machine", "2"), Headline(6, "x", "9")]),
        Findings([Headline(3, "model", "3", on_model=True)] + [Headline(6, "y", "8")] * 4),
    ]
    stage, none = StageReport("", None, None), SectionContent("", "", [])
    chapters = [
        Chapter(Saved(folder), stage, none, lambda key: [], item, f"run-{place}")
        for place, (folder, item) in enumerate(zip(folders, found, strict=True), 1)
    ]
    cards = cards_of(chapters)
    assert [card.label for card in cards] == ["a", "machine", "x", "y", "y"]
    assert cards[0].link == "#run-1" and cards[-1].link == "#run-2"


def test_what_a_verdict_does_not_go_by_is_said(tmp_path):
    channel = {"fit_percent": 52.0, "cross_correlation": [{"of": "u", "outside_percent": 3.0}]}
    late = channel | {"channel": "boom.q", "autocorrelation": {"outside_percent": 40.0}}
    quick = channel | {"channel": "boom.qd", "fit_percent": 88.0, "autocorrelation": None}
    logs = [{"status": "held_out", "channels": [late, quick]}]
    asked = {"fit_percent": {"qd": 50.0}, "outside_percent": 15.0, "whiteness": False}
    text = silence(Table({"logs": logs, "thresholds": asked}, tmp_path))
    assert "joint angle (fit 52 %)" in text and "in 1 of 1 channel" in text
    assert "velocity" not in text and "commands" not in text
    every = {"fit_percent": {"q": 1.0, "qd": 1.0}, "outside_percent": 15.0, "whiteness": True}
    assert silence(Table({"logs": logs, "thresholds": every}, tmp_path)) == ""


def test_the_page_suits_paper_phones_and_dark_rooms_and_runs_its_script_alone(folders):
    text = build(folders)
    for rule in ("@media print", "@page", "(max-width: 40rem)", "prefers-color-scheme: dark"):
        assert rule in text
    figures = re.findall(r'<figure id="([^"]+)"( class="paper")?', text)
    on_paper = [name for name, paper in figures if paper]
    assert 1 < len(on_paper) < len(figures) and "first-figure" in on_paper
    margins = re.search(r"@page { size: A4; margin: (\d+)mm (\d+)mm (\d+)mm;", text)
    sheet = re.search(r"\.sheets body { width: (\d+)mm; height: (\d+)mm;.*columns: (\d+)mm", text)
    assert margins and sheet
    top, side, bottom = map(int, margins.groups())
    wide = 210 - 2 * side
    assert [int(size) for size in sheet.groups()] == [wide, 297 - top - bottom, wide]
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy and f"script-src 'sha256-{digest}';" in policy[1]
    assert "default-src 'none'" in policy[1] and "onclick" not in text


@pytest.mark.skipif(
    not (shutil.which("chromium") and shutil.which("pdftotext")), reason="needs a browser"
)
def test_printed_contents_have_the_pages_on_which_chapters_begin(folders, tmp_path):
    page, paper = tmp_path / "report.html", tmp_path / "report.pdf"
    page.write_text(build(folders), encoding="utf-8")
    browser = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer"]
    subprocess.run([*browser, f"--print-to-pdf={paper}", f"file://{page}"], check=True, timeout=120)
    text = ["pdftotext", "-layout", paper, "-"]
    done = subprocess.run(text, capture_output=True, text=True, check=True)
    sheets = done.stdout.split("\f")[:-1]
    chapters = re.findall(r'<section id="[^"]+">\s*<h2>([^<]+?)\s*(?:<|$)', page.read_text())
    told = 0
    for name in chapters:
        number = re.search(rf"^.*?{re.escape(name)} +(\d+)(?: {{2,}}|$)", sheets[0], re.MULTILINE)
        if number:
            assert any(name in line for line in sheets[int(number[1]) - 1].splitlines()[-200:])
            told += 1
    assert told > 1 and len(sheets) > 1


def test_a_rigs_table_has_the_interval_of_the_fit_that_a_value_came_from(tmp_path):
    rig = shipped("slide_servo")
    name, value = next((n, v) for n, v in rig.parameters().items() if float(v) > 0.0)
    ends = [0.9 * float(value), 1.1 * float(value)]
    fit = Table({"name": name, "value": value.value, "interval": ends}, tmp_path)
    (grid,) = (one for one in rig_table(rig, [fit]) if isinstance(one, Grid))
    told = [row[2].text for row in grid.rows if isinstance(row[2], Cell) and "±" in row[2].text]
    half = 0.1 * float(shown(rig, name, float(value)))
    assert any(text.endswith(f"± {half:.2g}") for text in told)


def test_the_cures_of_a_verdict_are_what_to_do_next(folders, tmp_path):
    cures = [{"remedy": text} for text in ("free the gain of hect", "free the gain of hect", "b")]
    folder = changed(folders[1], tmp_path / "judged", structure={"findings": cures})
    steps = findings_of(folder).next
    assert [step.fields["remedy"] for step in steps] == ["free the gain of hect", "b"]


@pytest.mark.parametrize(("half", "settled"), [(0.005, []), (0.05, ["boom.joint_damping"])])
def test_a_test_is_proposed_for_the_least_known_and_none_in_vain(folders, tmp_path, half, settled):
    """Of two that the logs know only together; both to half a percent need no test."""
    fit = json.loads((folders[0] / "parameters.json").read_text())["parameters"][:2]
    for item, share in zip(fit, (0.002, half), strict=True):
        ends = [item["value"] * (1.0 + sign * share) for sign in (-1, 1)]
        item |= {"status": "correlated", "interval": ends}
    folder = changed(folders[0], tmp_path / "fitted", parameters=fit)
    steps = [step for step in findings_of(folder).next if step.key == "steps.settle"]
    assert [step.fields["parameter"] for step in steps] == settled


def test_what_explains_most_leads_the_sentence_and_the_steps(folders, tmp_path):
    def doubt(share: dict[str, float], line: str) -> Message:
        """A reservation that explains a share; none of what is odd about a log."""
        fields = {**share, "cause": f"cause {line}", "remedy": f'add "{line}" to parameters'}
        return Message("text", "validation.cause", fields)

    less, most = doubt({"share": 0.6}, "a"), doubt({"share": 0.9}, "b")
    every = [less, most, doubt({}, "c")]
    logs = json.loads((folders[1] / "validation.json").read_text())["logs"]
    logs = [log | {"checks": [check | {"passed": True} for check in log["checks"]]} for log in logs]
    more = {"accepted": True, "reasons": [], "reservations": every, "structure": None, "logs": logs}
    folder = changed(folders[1], tmp_path / "doubted", **more)
    assert [step.hint for step in findings_of(folder).next] == ['"c",', '"b",', '"a",']
    assert ": cause c;" in terminal.answer(folder).verdict


def test_an_accepted_model_says_the_likeliest_cause_of_what_it_leaves_over(folders, tmp_path):
    found = [
        {"sentence": "boom.p_head reads low", "remedy": "add an offset", "explains": 0.46},
        {"sentence": "lag", "remedy": "add a lag", "explains": 0.3},
    ]
    cause = "46 % of the residual has one likely cause: boom.p_head reads low; add an offset"
    for name, findings, against in (("one", found, [cause]), ("two", [], [])):
        more = {"accepted": True, "reasons": [], "structure": {"findings": findings} | FOLLOWS}
        folder = changed(folders[1], tmp_path / name, **more)
        assert list(findings_of(folder).against) == against
        assert list(terminal.answer(folder).notes) == against


LEAN = {"name": "late.delay", "remedy": 'add "late.delay" to parameters'}
LEAN |= {"sentence": "late.delay is held at 1 ms, and these logs would have 2.5 ms"}
MOVED = {"bulk_modulus": 3.0, "boom.joint_damping": 0.5}
LEAN |= {
    "explains": 0.4,
    "moved": [{"name": name, "halves": halves} for name, halves in MOVED.items()],
}


def test_what_a_fit_leans_on_stands_first_against_it(folders, tmp_path):
    before = findings_of(folders[0])
    folder = changed(folders[0], tmp_path / "fit", leans=[LEAN])
    found = findings_of(folder)
    assert list(found.against) == [LEAN["sentence"], *before.against]
    assert found.next[0].hint == '"late.delay",'
    told = terminal.answer(folder).lines(200, whole=True)
    assert f"- {LEAN['sentence']}" in told and "1 estimated, doubtful" in told[0]
    (row,) = [line for line in told if line.startswith("bulk_modulus ")]
    assert "estimated, doubtful" in row
    (row,) = [line for line in told if line.startswith("boom.joint_damping ")]
    assert "doubtful" not in row


def test_what_stood_at_an_end_of_its_range_is_doubtful_beside_what_a_fit_leans_on(
    folders, tmp_path
):
    known = json.loads((folders[0] / "parameters.json").read_text())["parameters"]
    ranged = [item | {"error_from": "range", "status": "estimated"} for item in known]
    for leans, doubtful in (([LEAN], True), ([], False)):
        folder = changed(folders[0], tmp_path / str(len(leans)), leans=leans, parameters=ranged)
        told = terminal.answer(folder).lines(200, whole=True)
        (row,) = [line for line in told if line.startswith("boom.joint_damping ")]
        assert ("doubtful" in row) == doubtful


@pytest.mark.parametrize(("value", "doubtful"), [(36e6, True), (360e6, False), (3.6e9, True)])
def test_an_oil_that_no_machine_has_is_doubtful(folders, tmp_path, value, doubtful):
    known = json.loads((folders[0] / "parameters.json").read_text())["parameters"]
    known = [{**item, "value": value} if item["name"] == "bulk_modulus" else item for item in known]
    told = terminal.answer(changed(folders[0], tmp_path / "fit", parameters=known)).lines(
        200, whole=True
    )
    (row,) = [line for line in told if line.startswith("bulk_modulus ")]
    assert ("doubtful" in row) == doubtful


def test_a_sensitive_fit_gives_a_reservation(folders, tmp_path):
    reserves = {"accepted": True, "reasons": [], "reservations": [LEAN["sentence"]]}
    folder = changed(folders[1], tmp_path / "judged", **reserves)
    told = terminal.answer(folder).lines(200, whole=True)
    assert told[0].startswith("ACCEPTED WITH RESERVATION on ") and f"- {LEAN['sentence']}" in told
    assert findings_of(folder).against[0] == LEAN["sentence"]
    glance = words_of(section(build([folder]), "glance"))
    assert "that it was not fitted to, with reservation: " in glance
    # in a report with the fit behind it, told of that alone
    fit = changed(folders[0], tmp_path / "fit", leans=[LEAN])
    both = words_of(section(build([fit, folder]), "glance"))
    assert both.count("and these logs would have 2.5 ms") == 1 == glance.count("have 2.5 ms")


def test_what_a_fit_leaves_over_speaks_against_it(folders, tmp_path):
    before = findings_of(folders[0])
    said = "the model leaves 27 % of boom.p_rod in a, 3 times its noise"
    left = f"{said}: something is missing"
    found = findings_of(changed(folders[0], tmp_path / "fit", left_over=left))
    assert list(found.against) == [said, *before.against]
    assert "--suggest" in found.next[0].hint and list(found.next[1:]) == list(before.next)
